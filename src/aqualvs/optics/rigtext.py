"""The text of a rig file: strict reading of YAML, tidy writing."""

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from aqualvs.errors import RigError

_HEADER = "# A rig of aqualvs: lengths in mm, angles in degrees, frame 'dome' (docs/rig.md).\n"
# A list stays on one line, however many digits it has.
_WIDTH = 1000


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


class TidyDumper(yaml.SafeDumper):
    """Writes mappings in the style asked for, and lists of plain values always on one line."""


def _tidy_list(dumper: yaml.SafeDumper, values: Sequence[Any]) -> yaml.SequenceNode:
    """Represent a list; one that holds lists or mappings gets a line for each of them."""
    flat = not any(isinstance(value, list | dict) for value in values)
    flow = True if flat else None
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=flow)


TidyDumper.add_representer(list, _tidy_list)


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file.

    Raises
    ------
    RigError
        One line, if the file is missing, unreadable, not text or not YAML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RigError(f"{path}: no such file; give the path of a rig file") from None
    except IsADirectoryError:
        raise RigError(f"{path}: is a folder; give the path of a rig file in it") from None
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise RigError(f"{path}: is not text; give the path of a rig file, which is YAML") from None
    try:
        # The loader is a SafeLoader: it makes nothing but plain values.
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as error:
        raise RigError(f"{path}: is not YAML: {_where(error)}") from None
    except yaml.YAMLError:
        raise RigError(f"{path}: is not YAML; give the path of a rig file") from None


def _where(error: yaml.MarkedYAMLError) -> str:
    problem = " ".join((error.problem or error.context or "malformed").split())
    if error.problem_mark is None:
        return f"{problem}; mend it"
    return f"{problem} in line {error.problem_mark.line + 1}; mend that line"


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
