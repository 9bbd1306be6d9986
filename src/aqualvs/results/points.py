"""Stripe points of a run: `points.arrows` during it, `points.parquet` and `points.ply` at its end.

`points.arrows` is an Arrow IPC stream: it can be read up to its last whole batch, whatever happened
after it, whereas Parquet cannot be read before its footer is written. All are written batch by
batch.
"""

import contextlib
import io
import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from aqualvs.closing import Closing
from aqualvs.errors import OutputError
from aqualvs.results.files import AppendFile, is_locked
from aqualvs.scanning.scan import Label, Scan
from aqualvs.text import bgr, laser_colour

LABELS = tuple(label.name.lower() for label in Label)
POINTS_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("time_s", pa.float64()),
        ("laser", pa.int8()),
        *((name, pa.float32()) for name in ("u_px", "v_px", "x_m", "y_m", "z_m")),
        *((name, pa.float32()) for name in ("sigma_m", "quality")),
        ("label", pa.dictionary(pa.int8(), pa.string())),
        ("used", pa.bool_()),
        *((name, pa.float32()) for name in ("intensity", "width_px")),
    ]
)
"""Columns of `points.arrows` and `points.parquet`: pixels in `image`, metres in `dome`.

`label` is the kind of surface of a point (`Label`), `used` whether it entered the posture;
`intensity` is the stripe's height above its background in grey levels, `width_px` its full width at
half of that.
"""

_LABEL_NAMES = pa.array(LABELS, pa.string())


class PointsStream(Closing):
    """Writer of `points.arrows`, a few frames at a time, with the parameters of `AppendFile`.

    The constructor and `write` raise `OSError` as the system says it.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        self._file = AppendFile(path, exclusive=exclusive)
        self._file.lock()
        self._waiting = io.BytesIO()
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._waiting, "w"), POINTS_SCHEMA)
        self._closed = False

    def write(self, *scans: Scan) -> Any:
        """Append the points of frames, all or none, and return them as a record batch.

        Frames without points leave no trace.
        """
        if not any(len(scan.points) for scan in scans):
            return None
        batch = points_batch(*scans)
        self._writer.write_batch(batch)
        self._append()
        return batch

    def close(self) -> None:
        """Finish the stream; further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.close()
            self._append()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is after a failed write: with every whole frame."""
        self._closed = True
        self._file.close()

    def _append(self) -> None:
        """Append Arrow's many small writes as one piece."""
        self._file.append(self._waiting.getvalue())
        self._waiting.seek(0)
        self._waiting.truncate()

    def __exit__(self, *raised: object) -> None:
        """Finish the stream, or leave it as it is where writing failed."""
        if isinstance(raised[1], OSError):
            self.abandon()
        else:
            self.close()


def points_batch(*scans: Scan) -> Any:
    """Return the points of frames as a record batch of `POINTS_SCHEMA`."""
    points = [scan.points for scan in scans]
    counts = [len(one) for one in points]
    rows = [
        (*one.pixels.T, *one.points_in_dome.T, one.sigma, one.quality, one.intensity, one.width)
        for one in points
    ]
    numbers = [np.concatenate(parts).astype(np.float32) for parts in zip(*rows, strict=True)]
    head = (
        np.repeat(np.array([scan.index for scan in scans], np.int32), counts),
        np.repeat(np.array([scan.time_s for scan in scans]), counts),
        np.concatenate([one.laser for one in points]),
    )
    label = pa.array(np.concatenate([one.label for one in points]).view(np.int8))
    names = pa.DictionaryArray.from_arrays(label, _LABEL_NAMES, safe=False)
    used = pa.array(np.concatenate([one.used for one in points]))
    columns = [pa.array(column) for column in (*head, *numbers)]
    arrays = [*columns[:10], names, used, *columns[10:]]
    return pa.RecordBatch.from_arrays(arrays, schema=POINTS_SCHEMA)


def read_points_stream(path: Path) -> Iterator[Any]:
    """Yield the whole record batches of a journal, up to where it was cut off."""
    with pa.OSFile(str(path), "rb") as file:
        try:
            yield from pa.ipc.open_stream(file)
        except (pa.ArrowInvalid, OSError):
            return


def points_file(run_folder: Path) -> Path:
    """Return the file with the points of a run: the journal of one that was killed."""
    points_stream = run_folder / "points.arrows"
    path = run_folder / "points.parquet"
    return path if path.exists() or not points_stream.exists() else points_stream


def stored_batches(path: Path, rows: int, columns: Sequence[str] | None = None) -> Iterator[Any]:
    """Yield the record batches of `points_file`, the first without rows.

    Those of a Parquet file have at most `rows` rows, so that memory stays flat however long the
    dive, and of its columns the given ones, as far as they are there.
    """
    if path.suffix == ".arrows":
        yield from read_points_stream(path)
        return
    with parquet.ParquetFile(path.absolute(), pre_buffer=False) as file:
        schema = file.schema_arrow
        names = [name for name in schema.names if columns is None or name in columns]
        # It shows the columns of a file without rows.
        yield pa.RecordBatch.from_pylist([], schema=pa.schema(map(schema.field, names)))
        yield from file.iter_batches(batch_size=rows, columns=names, use_threads=False)


def plain_column(column: Any, *, labels: bool) -> NDArray[Any]:
    """Return a column as an array; names of labels as `Label` values, unknown ones as clutter."""
    if not labels or pa.types.is_integer(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    coded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    known = {name: code for code, name in enumerate(LABELS)}
    codes = [known.get(name, int(Label.CLUTTER)) for name in coded.dictionary.to_pylist()]
    table = np.array(codes or [0], np.uint8)
    return np.asarray(table[coded.indices.to_numpy(zero_copy_only=False)])


def check_idle(path: Path) -> None:
    """Raise `OutputError` if another process is still writing this journal."""
    if is_locked(path):
        raise OutputError(
            f"{path.parent}: a run is still writing here; wait for its end or stop it first"
        )


DRAFT = ".part"
"""Suffix of the names of unfinished files."""

_ROWS_PER_GROUP = 1 << 17
# Dictionary encoding for names only: to look for repetitions in numbers takes longer than to write
# them, and compression shortens them anyway. For measured numbers, BYTE_STREAM_SPLIT puts similar
# bytes (signs, exponents) side by side: the file is a sixth smaller, and the fast compression level
# makes it hardly larger than the thorough one.
_NAMES = ("label",)
# Statistics for ascending columns only, so that readers of a part of the dive can skip row groups.
# In the other columns each group spans the whole range, and to find minimum and maximum takes a
# third of the time of writing.
_ASCENDING = ("frame", "time_s")
_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)


class PointsExport:
    """Writer of `points.parquet` and `points.ply`; both appear whole at the end, or not at all.

    Rows are gathered to groups of always the same size, which a thread of its own writes: the files
    do not depend on how the points come, and memory does not grow with their number.
    `points.ply` is a binary PLY of the points that entered a posture: x, y, z in `dome` in metres,
    red, green, blue by laser. `schema`: columns of what will be added, `POINTS_SCHEMA` or those of
    an older journal. Every method raises `OSError` as the system says it, a full disk for example;
    `discard` is to be called then.
    """

    def __init__(
        self, points_parquet: Path, points_ply: Path, schema: pa.Schema = POINTS_SCHEMA
    ) -> None:
        self._paths = points_parquet, points_ply
        self._drafts = [path.with_name(path.name + DRAFT) for path in self._paths]
        self._waiting: list[Any] = []
        self._n_waiting, self._n_vertices = 0, 0
        self._written: Future[None] | None = None
        with contextlib.ExitStack() as stack:
            self._ply = stack.enter_context(self._drafts[1].open("wb"))
            self._ply.write(_ply_header(0))
            self._table_file = stack.enter_context(
                parquet.ParquetWriter(
                    # Absolute: Arrow takes a name with a colon for an address.
                    self._drafts[0].absolute(),
                    schema,
                    compression="lz4",
                    use_dictionary=[name for name in _NAMES if name in schema.names],
                    use_byte_stream_split=[f.name for f in schema if f.type == pa.float32()],
                    write_statistics=[name for name in _ASCENDING if name in schema.names],
                )
            )
            # The thread ends before its files are closed.
            self._thread = stack.enter_context(ThreadPoolExecutor(1))
            self._open_files = stack.pop_all()

    def add(self, batch: Any) -> None:
        """Add a record batch; it must not be changed afterwards."""
        self._waiting.append(batch)
        self._n_waiting += batch.num_rows
        while self._n_waiting >= _ROWS_PER_GROUP:
            table = pa.Table.from_batches(self._waiting)
            self._begin_group(table.slice(0, _ROWS_PER_GROUP))
            self._waiting = table.slice(_ROWS_PER_GROUP).to_batches()
            self._n_waiting -= _ROWS_PER_GROUP

    def finish(self) -> None:
        """Complete both files."""
        if self._n_waiting:
            self._begin_group(pa.Table.from_batches(self._waiting))
        self._await_group()
        self._ply.seek(0)
        self._ply.write(_ply_header(self._n_vertices))
        self._open_files.close()
        for draft, path in zip(self._drafts, self._paths, strict=True):
            os.replace(draft, path)

    def discard(self) -> None:
        """Remove the files that will not be finished."""
        with contextlib.suppress(OSError):
            self._open_files.close()
        for draft in self._drafts:
            draft.unlink(missing_ok=True)

    def _begin_group(self, table: Any) -> None:
        self._await_group()
        self._written = self._thread.submit(self._write_group, table)

    def _await_group(self) -> None:
        if self._written is not None:
            self._written.result()

    def _write_group(self, table: Any) -> None:
        group = table.combine_chunks()
        self._table_file.write_table(group)
        vertices = _vertices(group)
        vertices.tofile(self._ply)
        self._n_vertices += len(vertices)


def export_points(batches: Iterator[Any], points_parquet: Path, points_ply: Path) -> None:
    """Write record batches, as of `read_points_stream`, to the files of `PointsExport`.

    Raises `OSError` as the system says it, a full disk for example; nothing is left of the files
    then.
    """
    first = next(batches, None)
    schema = POINTS_SCHEMA if first is None else first.schema
    export = PointsExport(points_parquet, points_ply, schema)
    try:
        for batch in itertools.chain([] if first is None else [first], batches):
            export.add(batch)
        export.finish()
    except BaseException:
        export.discard()
        raise


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


_LASER_RGB = np.array([bgr(laser_colour(i))[::-1] for i in range(128)], np.uint8)
"""Red, green, blue of every laser that an int8 can number, shape (128, 3)."""
