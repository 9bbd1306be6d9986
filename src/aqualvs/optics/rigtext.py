"""Write the text of a rig file."""

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

_HEADER = "# A rig of aqualvs: lengths in mm, angles in degrees, frame 'dome' (docs/rig.md).\n"
# A list stays on one line, however many digits it has.
_WIDTH = 1000


class TidyDumper(yaml.SafeDumper):
    """Writes mappings in the style asked for, and lists of plain values always on one line."""


def _tidy_list(dumper: yaml.SafeDumper, values: Sequence[Any]) -> yaml.SequenceNode:
    """Represent a list; one that holds lists or mappings gets a line for each of them."""
    flat = not any(isinstance(value, list | dict) for value in values)
    flow = True if flat else None
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=flow)


TidyDumper.add_representer(list, _tidy_list)


def rig_text(content: Mapping[str, Any]) -> str:
    """Return the content of a rig file as YAML: short lists and mappings on one line."""
    return _HEADER + "".join(_block(key, value) for key, value in content.items())


def _block(key: str, value: object) -> str:
    # YAML wraps a lone scalar in braces unless told to use the block style; what a calibration
    # notes down reads better below one another.
    flow = None if isinstance(value, list | dict) and key != "solved_from" else False
    text: str = yaml.dump(
        {key: value},
        Dumper=TidyDumper,
        sort_keys=False,
        allow_unicode=True,
        width=_WIDTH,
        default_flow_style=flow,
    )
    return text
