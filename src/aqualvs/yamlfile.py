"""YAML files: the only reader and writer of the package, and the comments of rig files.

Values are plain: None, bool, int, float, str, lists and dicts of them. Numbers are decimal, as
PyYAML writes them; text that looks like a date, an octal or a sexagesimal number stays text.
Parsing does not recurse, so that no file, however nested, exhausts the stack.

`carry_comments` transfers the comments of a YAML text to a new text of the same file.
"""

import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import yaml

from aqualvs.errors import AqualvsError, OutputError
from aqualvs.special_files import refuse_special

_HEADER = "# A rig of aqualvs: lengths in mm, angles in degrees, frame 'dome' (docs/rig.md).\n"


def write_text(path: Path, text: str) -> None:
    """Write a file.

    Raises `OutputError` if it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot be written ({fault.strerror}); choose another place"
        ) from None


class _TidyDumper(yaml.SafeDumper):
    """YAML dumper with mappings in the requested style and lists of plain values on one line."""


def _tidy_list(dumper: yaml.SafeDumper, values: Sequence[Any]) -> yaml.SequenceNode:
    """Represent a list; one that holds lists or mappings gets a line for each of them."""
    flat = not any(isinstance(value, list | dict) for value in values)
    flow = True if flat else None
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=flow)


_TidyDumper.add_representer(list, _tidy_list)


def yaml_text(content: Mapping[str, Any], *, flow: bool | None = False) -> str:
    """Return keys and values as YAML in their own order, each list of plain values on one line.

    With `flow` None a mapping of plain values is on one line too.
    """
    # Lists stay on one line, regardless of their digits.
    width = 1000
    text: str = yaml.dump(
        dict(content),
        Dumper=_TidyDumper,
        sort_keys=False,
        allow_unicode=True,
        width=width,
        default_flow_style=flow,
    )
    return text


def rig_text(content: Mapping[str, Any]) -> str:
    """Return the content of a rig file as YAML: short lists and mappings on one line."""
    return _HEADER + "".join(_block(key, value) for key, value in content.items())


def _block(key: str, value: object) -> str:
    # YAML wraps a lone scalar in braces unless told to use the block style; records of calibrations
    # read better in block style.
    flow = None if isinstance(value, list | dict) and key != "solved_from" else False
    return yaml_text({key: value}, flow=flow)


MAX_BYTES = 8_000_000
"""Size of a file; a list of 10,000 dives has about one million bytes."""
MAX_DEPTH = 50
"""Levels of lists and mappings; a rig in a run.yaml has 7."""
MAX_VALUES = 400_000
"""Scalars, lists and mappings of a file, each alias counted as its expansion."""

# PyYAML's own resolver (YAML 1.1) less octal, hexadecimal, binary and sexagesimal numbers.
_INT = re.compile(r"[-+]?(?:0|[1-9][0-9_]*)")
_FLOAT = re.compile(
    r"(?:[-+]?[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+][0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)
_WORDS: Final[dict[str, bool | None]] = {
    **dict.fromkeys(["yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"], True),
    **dict.fromkeys(["no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"], False),
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
}
# NumPy's and the recording's integers have 64 bits.
_MAX_INT = 2**63 - 1
_MAX_DIGITS = len(str(_MAX_INT))
_TAG = "tag:yaml.org,2002:"
_COLLECTION_TAGS = (None, "!", f"{_TAG}seq", f"{_TAG}map")
# The parser in C is ten times as fast; not every build of PyYAML has it.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_UNPRINTABLE = yaml.reader.Reader.NON_PRINTABLE
_NO_KEY: Final = object()
_MERGE: Final = object()


class _TextError(Exception):
    """A fault of a text, its line (from 1; 0 if unknown), and the remedy."""

    def __init__(self, problem: str, line: int, remedy: str = "fix that line") -> None:
        super().__init__(problem)
        place = f" in line {line}" if line else ""
        self.text = f"{problem}{place}; {remedy}"


def read_yaml(path: Path, what: str, error: type[AqualvsError]) -> Any:
    """Return the content of a YAML file; `what` is its kind in messages, such as "a rig file".

    Raises `error` with one line that names the file, the line in it and the remedy.
    """
    return parse_yaml(read_text(path, what, error), str(path), error)


def read_text(path: Path, what: str, error: type[AqualvsError]) -> str:
    """Return the text of a file in UTF-8, with or without a byte order mark.

    `path`, `what`, `error`: as `read_yaml` takes them. Raises `AqualvsError` of type `error`; one
    line, if the file is missing, unreadable, too large or not text.
    """
    remedy = f"give the path of {what}"
    try:
        if path.is_dir():
            raise error(f"{path}: is a folder; {remedy} in it")
        refuse_special(path, error, remedy)
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise error(f"{path}: no such file; {remedy}") from None
    except OSError as fault:
        raise error(f"{path}: cannot be read ({fault.strerror}); {remedy}") from None
    except ValueError:
        raise error(f"{str(path)!r}: is not a path; {remedy}") from None
    if len(content) > MAX_BYTES:
        raise error(f"{path}: is larger than {MAX_BYTES / 1e6:g} MB; {remedy}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: is not text in UTF-8; save it as UTF-8") from None


def parse_yaml(text: str, source: str, error: type[AqualvsError]) -> Any:
    """Return the content of a YAML text; `source` is its name in messages.

    Raises `error` with one line that names the source, the line in it and the remedy.
    """
    try:
        return _parse(text)
    except _TextError as fault:
        raise error(f"{source}: {fault.text}") from None


def _parse(text: str) -> Any:
    control = _UNPRINTABLE.search(text)
    if control is not None:
        line = text.count("\n", 0, control.start()) + 1
        raise _TextError(f"is not YAML: control character U+{ord(control[0]):04X}", line)
    builder = _Builder()
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            builder.add(event)
    except yaml.MarkedYAMLError as error:
        problem = " ".join((error.problem or error.context or "malformed").split())
        mark = error.problem_mark
        # The parser in C reports faults at the end in the line after the last.
        line = 0 if mark is None else min(mark.line + 1, max(1, len(text.splitlines())))
        if "nesting depth" in problem:
            # libyaml from 0.2.6 on has a limit of its own, 1000 levels, which its scanner meets
            # before it has told of the first 50.
            raise _too_deep(line) from None
        raise _TextError(f"is not YAML: {problem}", line) from None
    except (yaml.YAMLError, ValueError):
        # The parser in Python leaks a ValueError for an escape that is no character.
        raise _TextError("is not YAML", 0, "fix it") from None
    return builder.content


@dataclass(slots=True, eq=False)
class _Node:
    """A value under construction, or an anchored one."""

    value: Any
    anchor: str | None
    # Values that it holds, itself included, and levels of lists and mappings.
    count: int = 1
    height: int = 0
    # Key of a mapping that waits for its value, or `_NO_KEY`, or `_MERGE` (`<<`).
    key: Any = _NO_KEY
    merges: bool = False  # Whether it is `<<`, plain and without a tag.
    merged: Sequence[dict[Any, Any]] = ()  # Mappings to fill up from.


class _Builder:
    """Builder of plain values from a parser's events."""

    def __init__(self) -> None:
        self.content: Any = None
        self._open: list[_Node] = []
        self._anchors: dict[str, _Node] = {}
        self._n_documents = 0
        self._n_values = 0

    def add(self, event: yaml.Event) -> None:
        """Process the next event.

        Raises `_TextError` if a limit is passed, or a value is not plain.
        """
        line = 0 if event.start_mark is None else event.start_mark.line + 1
        if isinstance(event, yaml.ScalarEvent):
            node = _Node(_scalar(event, line), event.anchor)
            node.merges = event.value == "<<" and event.tag is None and event.implicit[0]
            self._place(node, line)
        elif isinstance(event, yaml.AliasEvent):
            self._place(self._anchored(event.anchor or "", line), line)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._begin(event, line)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._end(line)
        elif isinstance(event, yaml.DocumentStartEvent):
            self._n_documents += 1
            if self._n_documents > 1:
                raise _TextError("a second document begins", line, "leave it out")

    def _begin(self, event: yaml.CollectionStartEvent, line: int) -> None:
        if event.tag not in _COLLECTION_TAGS:
            raise _foreign(event.tag, line)
        if len(self._open) >= MAX_DEPTH:
            raise _too_deep(line)
        parent = self._open[-1] if self._open else None
        if parent is not None and isinstance(parent.value, dict) and parent.key is _NO_KEY:
            raise _TextError("a key that is a list or a mapping", line, "write a word as the key")
        value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._open.append(_Node(value, event.anchor, height=1))

    def _end(self, line: int) -> None:
        node = self._open.pop()
        for extra in node.merged:
            for key, value in extra.items():
                node.value.setdefault(key, value)
        self._place(node, line)

    def _anchored(self, name: str, line: int) -> _Node:
        node = self._anchors.get(name)
        if node is None:
            raise _TextError(f"alias *{name} without its anchor before it", line)
        if len(self._open) + node.height > MAX_DEPTH:
            raise _too_deep(line)
        self._n_values += node.count - 1
        return _Node(node.value, None, count=node.count, height=node.height)

    def _place(self, node: _Node, line: int) -> None:
        """Put a finished value where it belongs."""
        self._n_values += 1
        if self._n_values > MAX_VALUES:
            raise _TextError(
                f"more than {MAX_VALUES:,} values", line, "split the file, or thin it out"
            )
        if node.anchor is not None:
            self._anchors[node.anchor] = node
        if not self._open:
            self.content = node.value
            return
        parent = self._open[-1]
        parent.count += node.count
        parent.height = max(parent.height, node.height + 1)
        if isinstance(parent.value, list):
            parent.value.append(node.value)
        elif parent.key is _NO_KEY:
            self._take_key(parent, node, line)
        elif parent.key is not _MERGE:
            parent.value[parent.key] = node.value
            parent.key = _NO_KEY
        else:
            merged = node.value if isinstance(node.value, list) else [node.value]
            if parent.merged or not all(isinstance(one, dict) for one in merged):
                raise _TextError("<< that is not a mapping, or appears twice", line)
            parent.merged, parent.key = merged, _NO_KEY

    @staticmethod
    def _take_key(parent: _Node, node: _Node, line: int) -> None:
        if isinstance(node.value, dict | list):
            raise _TextError("a key that is a list or a mapping", line, "write a word as the key")
        if node.merges:
            parent.key = _MERGE
        elif node.value in parent.value:
            raise _TextError(f"key {_shown(node.value)} appears twice", line, "keep one of them")
        else:
            parent.key = node.value


def _scalar(event: yaml.ScalarEvent, line: int) -> Any:
    """Return the value of a scalar: by its tag, resolved if it is plain, else its text."""
    text: str = event.value
    tag, plain = event.tag, bool(event.implicit[0])
    if tag in (f"{_TAG}str", "!") or (tag is None and not plain):
        return text
    value = _plain(text, line)
    if tag is None:
        return value
    name = tag.removeprefix(_TAG)
    kinds = {"bool": bool, "float": float, "int": int, "null": type(None)}
    if name not in kinds or name == tag:
        raise _foreign(tag, line)
    if name == "float" and type(value) is int:
        value = float(value)
    if type(value) is not kinds[name]:
        raise _TextError(f"{_shown(text)} is not a {name}", line)
    return value


def _plain(text: str, line: int) -> Any:
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        digits = text.replace("_", "")
        if len(digits.lstrip("+-")) > _MAX_DIGITS or abs(int(digits)) > _MAX_INT:
            raise _TextError(
                f"whole number of {len(digits.lstrip('+-'))} digits", line, "shorten it"
            )
        return int(digits)
    if _FLOAT.fullmatch(text):
        return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
    return text


def _shown(value: object) -> str:
    """Return a value in one line, cut where it is long."""
    text = f"'{value}'" if isinstance(value, str) and value.isprintable() else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _foreign(tag: str, line: int) -> _TextError:
    shown = f"!!{tag.removeprefix(_TAG)}" if tag.startswith(_TAG) else tag
    return _TextError(f"tag {_shown(shown)}", line, "leave the tag out")


def _too_deep(line: int) -> _TextError:
    return _TextError(f"nested deeper than {MAX_DEPTH} levels", line, "remove levels")


_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
_COMMENT = re.compile("#[^\n\r\x85\u2028\u2029]*")
# A comment on the line that opens a block of text belongs to the token of the text.
_BLOCK_HEAD = re.compile("[|>][-+0-9]*[ \t]+(#[^\n\r\x85\u2028\u2029]*)")


_Place: TypeAlias = tuple[object, ...]
"""Keys from the top; an item of a list by its `name`, or its number."""


class _Comment(NamedTuple):
    line: int
    text: str
    alone: bool


def carry_comments(old: str, new: str) -> str:
    """Return a text with the comments of an older one.

    A comment at the end of a line stays with the key or item of that line, one on a line of its own
    with the key or item that follows; items of lists are identified by their `name`. Where that is
    gone the comment moves to the enclosing key, or to the top. No comment is lost, unless `old` has
    more than 500,000 characters. The values are those of `new`.

    `old`, `new`: YAML texts; an `old` that is not YAML has no comments.
    """
    # Comments of texts beyond these are not placed: rigs have up to 50,000 characters.
    max_characters, max_comments = 500_000, 1000
    if "#" not in old or len(old) > max_characters:
        return new
    try:
        before = parse_yaml(old, "", AqualvsError)
    except AqualvsError:
        return new
    known = {one.text for one in _comments(new)}
    comments = [one for one in _comments(old) if one.text not in known]
    if not comments or not isinstance(before, dict):
        return new
    if len(comments) <= max_comments:
        carried = _carried(old, new, comments)
        if _content(new) == _content(carried):
            found = "\n".join(one.text for one in _comments(carried))
            if all(one.text in found for one in comments):
                return carried
    lines = _BREAK.split(new)
    top = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return "\n".join([*lines[:top], *(one.text for one in comments), *lines[top:]])


def _content(text: str) -> str | None:
    try:
        return repr(parse_yaml(text, "", AqualvsError))
    except AqualvsError:
        return None


def _comments(text: str) -> list[_Comment]:
    """Return the comments of a text, which begin with # outside its tokens."""
    found, end = [], 0
    for token in yaml.scan(text, Loader=yaml.SafeLoader):
        found += [(m.start(), m[0]) for m in _COMMENT.finditer(text, end, token.start_mark.index)]
        if isinstance(token, yaml.ScalarToken) and token.style in ("|", ">"):
            head = _BLOCK_HEAD.match(text, token.start_mark.index)
            found += [] if head is None else [(head.start(1), head[1])]
        end = max(end, token.end_mark.index)
    found += [(m.start(), m[0]) for m in _COMMENT.finditer(text, end)]
    starts = [0, *(m.end() for m in _BREAK.finditer(text))]
    comments = []
    for start, words in found:
        line = bisect_right(starts, start) - 1
        alone = not text[starts[line] : start].strip()
        comments.append(_Comment(line, words.rstrip(), alone))
    return comments


def _places(text: str) -> list[tuple[int, int, _Place]]:
    """Return first line, last line and place of every key and item, in the order of the text."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    return [] if root is None else list(_below(root, ()))


def _below(node: yaml.Node, place: _Place) -> Iterator[tuple[int, int, _Place]]:
    if isinstance(node, yaml.MappingNode):
        entries = [(str(key.value), key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        entries = [(_name(item, i), item, item) for i, item in enumerate(node.value)]
    else:
        return
    for name, first, value in entries:
        inner = (*place, name)
        yield first.start_mark.line, value.end_mark.line, inner
        # The lines of an alias's content are elsewhere.
        if value.start_mark.index >= first.start_mark.index:
            yield from _below(value, inner)


def _name(item: yaml.Node, number: int) -> Any:
    if isinstance(item, yaml.MappingNode):
        for key, value in item.value:
            if key.value == "name" and isinstance(value, yaml.ScalarNode):
                return ("name", value.value)
    return number


def _carried(old: str, new: str, comments: list[_Comment]) -> str:
    lines = _BREAK.split(new)
    old_places = _places(old)
    first: dict[_Place, int] = {}
    for line, _, place in _places(new):
        first.setdefault(place, line)
    # Lines that end within a value, in which # begins no comment.
    broken: set[int] = set()
    for token in yaml.scan(new, Loader=yaml.SafeLoader):
        if isinstance(token, yaml.ScalarToken):
            broken |= set(range(token.start_mark.line, token.end_mark.line))
    above: dict[int, list[str]] = {}
    behind: dict[int, list[str]] = {}
    for comment in comments:
        owner = _owner(comment, old_places)
        if owner is None:
            above.setdefault(len(lines) - 1, []).append(comment.text)
            continue
        place, exact = owner, owner in first
        while place and place not in first:
            place = place[:-1]
        line = first.get(place, 0)
        stays = exact and not comment.alone and line not in broken
        (behind if stays else above).setdefault(line, []).append(comment.text)
    result = []
    for number, text in enumerate(lines):
        indent = text[: len(text) - len(text.lstrip())]
        result += [f"{indent}{one}" for one in above.get(number, [])]
        result.append("  ".join([text, *behind.get(number, [])]))
    return "\n".join(result)


def _owner(comment: _Comment, places: list[tuple[int, int, _Place]]) -> _Place | None:
    """Return the place that a comment belongs to; None after the last one."""
    if comment.alone:
        return next((place for line, _, place in places if line > comment.line), None)
    begun = [place for line, _, place in places if line == comment.line]
    # At the end of a value that began on an earlier line.
    earlier = [place for line, end, place in places if line < comment.line <= end]
    found = begun or earlier[-1:]
    return found[0] if found else None
