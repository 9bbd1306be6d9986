"""Hooks of the documentation site, for pages without a network.

Formulas (blocks of LaTeX after ```math) become MathML, which browsers draw themselves. The script
that lets the search work on pages opened as files comes with the site.
"""

import re
import tomllib
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

_BLOCK = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PROJECT = Path(__file__).parents[1] / "pyproject.toml"
_SHIM = "https://unpkg.com/iframe-worker/shim"


def on_config(config: Any) -> Any:
    """Name the version that the site describes at the bottom of its pages."""
    project = tomllib.loads(_PROJECT.read_text(encoding="utf-8"))["project"]
    config["copyright"] = f"{project['name']} {project['version']}"
    return config


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Set the formulas of a page."""
    return _BLOCK.sub(_formula, markdown)


def on_post_page(output: str, *, page: Any, **_: Any) -> str:
    """Load the script for the search from the site."""
    return output.replace(_SHIM, "../" * page.url.count("/") + "iframe-worker.js")


def _formula(block: re.Match[str]) -> str:
    formula = " ".join(block[1].split())
    return f'<div class="formula">{convert(formula, display="block")}</div>'
