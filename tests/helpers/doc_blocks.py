"""What the documentation tells people to type: commands, and code by language."""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from repository import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"\s{2,}#.*$|\s{4,}[a-z].*$")


class Command(NamedTuple):
    """One `aqualvs ...` line, without its comment."""

    page: str
    arguments: list[str]
    into: str | None

    def __str__(self) -> str:
        return f"{self.page}: aqualvs {shlex.join(self.arguments)}"


class Block(NamedTuple):
    """One fenced block."""

    page: str
    number: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}-{self.number}"


def blocks(language: str) -> list[Block]:
    found = []
    for page in PAGES:
        for number, match in enumerate(_FENCE.finditer(page.read_text(encoding="utf-8")), 1):
            if match[1] == language:
                found.append(Block(page.name, number, language, match[2]))
    return found


def commands(page: Path) -> list[Command]:
    """Commands of a page's indented and console blocks, in order; `\\` joins lines."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    found = []
    for line in text.splitlines():
        match = re.match(r"(?: {4}|\$ )(aqualvs .*)", line)
        if match:
            words = shlex.split(_COMMENT.sub("", match[1]))
            into = words[words.index(">") + 1] if ">" in words else None
            end = words.index(">") if into else len(words)
            found.append(Command(page.name, words[1:end], into))
    return found


def all_commands() -> list[Command]:
    return [command for page in PAGES for command in commands(page)]
