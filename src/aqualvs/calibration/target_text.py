"""The text of target files: tolerant of notes, strict about everything else."""

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from aqualvs.errors import CalibrationError, OutputError

# Free text that people write without quotes, colons and all, which YAML would trip over.
_FREE_TEXT = re.compile(
    r"^(frame|corner_order|note):[ \t]+(?![\"'|>\[{&*!%@`])(?P<text>\S.*?)[ \t]*$", re.MULTILINE
)


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that appears twice, of which YAML would quietly drop one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    problem=f"key '{key}' appears twice", problem_mark=node.value[i][0].start_mark
                )
        return super().construct_mapping(node, deep)


def read_text(path: Path, what: str) -> str:
    """Return the text of a file; `what` says what it should be.

    Raises
    ------
    CalibrationError
        One line, if the file is missing, unreadable or not text.
    """
    try:
        # Spreadsheets begin their text with a byte order mark.
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file; give the path of {what}") from None
    except IsADirectoryError:
        raise CalibrationError(f"{path}: is a folder; give the path of {what} in it") from None
    except OSError as fault:
        raise CalibrationError(f"{path}: cannot be read ({fault.strerror})") from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not text; give the path of {what}") from None


def read_mapping(path: Path, what: str) -> dict[Any, Any]:
    """Return the keys and values of a YAML file; `what` says what it should be.

    Raises
    ------
    CalibrationError
        One line, if the file cannot be read or does not hold keys and values.
    """
    text = _FREE_TEXT.sub(_quoted, read_text(path, what))
    try:
        # The loader is a SafeLoader: it makes nothing but plain values.
        content = yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as fault:
        problem = " ".join((fault.problem or fault.context or "malformed").split())
        mark = fault.problem_mark
        where = "" if mark is None else f" in line {mark.line + 1}; mend that line"
        raise CalibrationError(f"{path}: is not YAML: {problem}{where}") from None
    except yaml.YAMLError:
        raise CalibrationError(f"{path}: is not YAML; give the path of {what}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: holds no keys; give the path of {what}")
    return content


def _quoted(match: re.Match[str]) -> str:
    text = match["text"].replace("'", "''")
    return f"{match[1]}: '{text}'"


def write_text(path: Path, text: str) -> None:
    """Write a file.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot be written ({fault.strerror}); choose another place"
        ) from None
