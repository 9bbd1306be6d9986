"""Share of lines that the tests run, by package of `src/aqualvs`, from `coverage json`.

`python tools/coverage_by_package.py out/coverage/lines.json` prints a table and ends with 1 if a
package lies below 80 %. `make coverage` measures and calls it.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path, PurePosixPath

LEAST = 0.8


def by_package(files: dict[str, dict[str, dict[str, int]]]) -> dict[str, tuple[int, int]]:
    """Return lines that ran and all lines by package; modules beside packages count as one.

    Parameters
    ----------
    files : dict
        `files` of the output of `coverage json`.
    """
    sums: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0])
    for path, content in files.items():
        below = PurePosixPath(path).parts[PurePosixPath(path).parts.index("aqualvs") + 1 :]
        total = sums[below[0] if len(below) > 1 else "(modules)"]
        total[0] += content["summary"]["covered_lines"]
        total[1] += content["summary"]["num_statements"]
    return {name: (ran, lines) for name, (ran, lines) in sorted(sums.items())}


def main() -> int:
    """Print the table; return 1 if a package is below `LEAST`."""
    packages = by_package(json.loads(Path(sys.argv[1]).read_text())["files"])
    for name, (ran, lines) in packages.items():
        print(f"{name:14} {ran:6} of {lines:6} lines {ran / max(lines, 1):7.1%}")
    ran, lines = (sum(column) for column in zip(*packages.values(), strict=True))
    print(f"{'all':14} {ran:6} of {lines:6} lines {ran / lines:7.1%}")
    low = [name for name, (ran, lines) in packages.items() if ran < LEAST * lines]
    if low:
        print(f"below {LEAST:.0%}: {', '.join(low)}", file=sys.stderr)
    return 1 if low else 0


if __name__ == "__main__":
    sys.exit(main())
