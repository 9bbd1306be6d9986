"""Carry the comments of a YAML text over to a new text of the same file."""

import re
from bisect import bisect_right
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

import yaml

from aqualvs.errors import AqualvsError
from aqualvs.yamlfile import parse_yaml

__all__ = ["carry_comments"]

_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
_COMMENT = re.compile("#[^\n\r\x85\u2028\u2029]*")
# A comment on the line that opens a block of text belongs to the token of the text.
_BLOCK_HEAD = re.compile("[|>][-+0-9]*[ \t]+(#[^\n\r\x85\u2028\u2029]*)")

# Comments of texts beyond these are not placed: rigs have up to 50,000 characters.
_MAX_CHARACTERS, _MAX_COMMENTS = 500_000, 1000

_Place: TypeAlias = tuple[object, ...]
"""Keys from the top; an item of a list by its `name`, or its number."""


class _Comment(NamedTuple):
    line: int
    text: str
    alone: bool


def carry_comments(old: str, new: str) -> str:
    """Return a text with the comments of an older one.

    A comment at the end of a line stays with the key or item of that line, one on a line of its
    own with what follows it; items of lists are told by their `name`. Where that is gone the
    comment moves to what held it, or to the top. None is lost, unless `old` has more than 500,000
    characters, and the values are those of `new`.

    Parameters
    ----------
    old, new : str
        YAML; an `old` that is none has no comments.
    """
    if "#" not in old or len(old) > _MAX_CHARACTERS:
        return new
    try:
        before = parse_yaml(old, "", AqualvsError)
    except AqualvsError:
        return new
    known = {one.text for one in _comments(new)}
    comments = [one for one in _comments(old) if one.text not in known]
    if not comments or not isinstance(before, dict):
        return new
    if len(comments) <= _MAX_COMMENTS:
        carried = _carried(old, new, comments)
        if _content(new) == _content(carried) and _holds(carried, comments):
            return carried
    lines = _BREAK.split(new)
    top = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return "\n".join([*lines[:top], *(one.text for one in comments), *lines[top:]])


def _content(text: str) -> str | None:
    try:
        return repr(parse_yaml(text, "", AqualvsError))
    except AqualvsError:
        return None


def _holds(text: str, comments: list[_Comment]) -> bool:
    found = "\n".join(one.text for one in _comments(text))
    return all(one.text in found for one in comments)


def _comments(text: str) -> list[_Comment]:
    """Return the comments of a text: what begins with # outside its tokens."""
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
        # What an alias stands for has its lines elsewhere.
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
    broken = _broken_lines(new)
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


def _broken_lines(text: str) -> set[int]:
    """Return the lines that end within a value, where # is no comment."""
    found: set[int] = set()
    for token in yaml.scan(text, Loader=yaml.SafeLoader):
        if isinstance(token, yaml.ScalarToken):
            found |= set(range(token.start_mark.line, token.end_mark.line))
    return found


def _owner(comment: _Comment, places: list[tuple[int, int, _Place]]) -> _Place | None:
    """Return what a comment belongs to; None for what follows all else."""
    if comment.alone:
        return next((place for line, _, place in places if line > comment.line), None)
    begun = [place for line, _, place in places if line == comment.line]
    # At the end of a value that began on an earlier line.
    earlier = [place for line, end, place in places if line < comment.line <= end]
    found = begun or earlier[-1:]
    return found[0] if found else None
