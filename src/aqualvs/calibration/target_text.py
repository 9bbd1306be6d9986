"""The text of target files: tolerant of notes, strict about everything else."""

import re
from pathlib import Path
from typing import Any

from aqualvs.errors import CalibrationError, OutputError
from aqualvs.yamlfile import parse_yaml, read_text

# Free text that people write without quotes, colons and all, which YAML would trip over.
_FREE_TEXT = re.compile(
    r"^(frame|corner_order|note):[ \t]+(?![\"'|>\[{&*!%@`])(?P<text>\S.*?)[ \t]*$", re.MULTILINE
)


def read_mapping(path: Path, what: str) -> dict[Any, Any]:
    """Return the keys and values of a YAML file; `what` says what it should be.

    Raises
    ------
    CalibrationError
        One line, if the file cannot be read or does not hold keys and values.
    """
    text = _FREE_TEXT.sub(_quoted, read_text(path, what, CalibrationError))
    content = parse_yaml(text, str(path), CalibrationError)
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
