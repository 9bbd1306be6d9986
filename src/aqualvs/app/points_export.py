"""From the journal of a run to `points.parquet` and `points.ply`, batch by batch."""

import itertools
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from aqualvs.app.journal import POINTS_SCHEMA, read_journal
from aqualvs.app.report_words import bgr, laser_colour

_ROWS_PER_GROUP = 1 << 17
_N_LASERS = 128
# Only names are worth a dictionary: to look for repetition in numbers takes longer than to write
# them. What repeats is short once compressed, and of measured numbers the bytes that resemble each
# other, signs and exponents, are put side by side: the file is a sixth smaller so, and the fast
# compression makes it hardly larger than the thorough one.
_NAMES = ("label",)
_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)


def export_points(journal: Path, points_parquet: Path, points_ply: Path) -> int:
    """Write the points of a journal as Parquet, and those that entered a posture as PLY.

    Both files appear whole or not at all; memory does not grow with the journal.

    Parameters
    ----------
    journal : Path
        May lack its end; what follows the last whole batch is left out.
    points_parquet : Path
        Columns as `POINTS_SCHEMA`, or those that an older journal has.
    points_ply : Path
        Binary PLY: x, y, z in `dome` in metres, red, green, blue by laser.

    Returns
    -------
    n_points : int
        Points in `points_parquet`.

    Raises
    ------
    OSError
        As the system says it, a full disk for example; the journal is left as it is.
    """
    drafts = [path.with_name(path.name + ".part") for path in (points_parquet, points_ply)]
    try:
        n_points = _write_drafts(journal, *drafts)
        os.replace(drafts[0], points_parquet)
        os.replace(drafts[1], points_ply)
    finally:
        for draft in drafts:
            draft.unlink(missing_ok=True)
    return n_points


def _write_drafts(journal: Path, parquet_draft: Path, ply_draft: Path) -> int:
    n_points, n_vertices = 0, 0
    batches = read_journal(journal)
    first = next(batches, None)
    schema = POINTS_SCHEMA if first is None else first.schema
    head = [] if first is None else [first]
    with (
        parquet.ParquetWriter(
            parquet_draft,
            schema,
            compression="lz4",
            use_dictionary=[name for name in _NAMES if name in schema.names],
            use_byte_stream_split=[field.name for field in schema if field.type == pa.float32()],
        ) as table_file,
        ply_draft.open("wb") as ply,
        ThreadPoolExecutor(1) as beside,
    ):
        ply.write(_ply_header(0))
        written: Future[None] | None = None
        for table in _row_groups(itertools.chain(head, batches)):
            if written is not None:
                written.result()
            written = beside.submit(table_file.write_table, table)
            vertices = _vertices(table)
            vertices.tofile(ply)
            n_points += table.num_rows
            n_vertices += len(vertices)
        if written is not None:
            written.result()
        ply.seek(0)
        ply.write(_ply_header(n_vertices))
    return n_points


def _row_groups(batches: Iterable[Any]) -> Iterator[Any]:
    """Join batches into tables of `_ROWS_PER_GROUP` rows, whatever the batches' borders are."""
    waiting: list[Any] = []
    n_rows = 0
    for batch in batches:
        waiting.append(batch)
        n_rows += batch.num_rows
        while n_rows >= _ROWS_PER_GROUP:
            table = pa.Table.from_batches(waiting)
            yield table.slice(0, _ROWS_PER_GROUP).combine_chunks()
            n_rows -= _ROWS_PER_GROUP
            waiting = table.slice(_ROWS_PER_GROUP).to_batches()
    if n_rows:
        yield pa.Table.from_batches(waiting).combine_chunks()


def _vertices(table: Any) -> NDArray[np.void]:
    """Return the points of a table that entered a posture, as PLY vertices."""
    target = table["used"].to_numpy()
    vertices = np.empty(np.count_nonzero(target), _VERTEX)
    for axis in "xyz":
        vertices[axis] = table[f"{axis}_m"].to_numpy()[target]
    colours = _LASER_RGB[table["laser"].to_numpy()[target]]
    vertices["red"], vertices["green"], vertices["blue"] = colours.T
    return vertices


def _ply_header(n_vertices: int) -> bytes:
    """Return a header of the same length for any count: a comment takes up the slack."""
    count = f"element vertex {n_vertices}"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment target points in dome coordinates, metres {'.' * (40 - len(count))}",
        count,
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _laser_rgb() -> NDArray[np.uint8]:
    """Return red, green, blue of every laser that an int8 can number, shape (128, 3)."""
    return np.array([bgr(laser_colour(i))[::-1] for i in range(_N_LASERS)], np.uint8)


_LASER_RGB = _laser_rgb()
