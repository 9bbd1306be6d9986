"""`points.arrows`: the points of a run that is under way, as an Arrow IPC stream.

Parquet cannot be read before its footer is written; a stream can be read up to its last whole
batch, whatever happened after it.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa

from aqualvs.app.append_file import AppendFile, is_locked
from aqualvs.errors import OutputError
from aqualvs.scanning.scan import Label, Scan

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

`label` says what a point lies on (`Label`), `used` whether it entered the posture; `intensity` is
the stripe's height above its background in grey levels, `width_px` its full width at half of that.
"""

_LABEL_NAMES = pa.array(LABELS, pa.string())


class PointsJournal:
    """Writer of `points.arrows`, a few frames at a time as `AppendFile` does it.

    Parameters
    ----------
    path : Path
        Written anew.
    exclusive : bool
        As for `AppendFile`.

    Raises
    ------
    OSError
        From the constructor and from `write`, as the system says it.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        self._file = AppendFile(path, exclusive=exclusive)
        self._file.lock()
        self._waiting = io.BytesIO()
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._waiting, "w"), POINTS_SCHEMA)
        self._closed = False

    def write(self, *scans: Scan) -> Any:
        """Append the points of frames, all or none; those without points leave no trace.

        Returns
        -------
        batch : pyarrow.RecordBatch or None
            What was appended.
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
        """Hand over what Arrow has written as many small parts."""
        self._file.append(self._waiting.getvalue())
        self._waiting.seek(0)
        self._waiting.truncate()

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the stream, or leave it as it is where writing failed."""
        if isinstance(fault, OSError):
            self.abandon()
        else:
            self.close()


def points_batch(*scans: Scan) -> Any:
    """Return the points of frames as a record batch of `POINTS_SCHEMA`."""
    points = [scan.points for scan in scans]
    counts = [len(one) for one in points]
    numbers = np.empty((9, sum(counts)), np.float32)
    end = 0
    for one in points:
        first, end = end, end + len(one)
        mine = numbers[:, first:end]
        mine[0:2] = one.pixels.T
        mine[2:5] = one.points_in_dome.T
        mine[5] = one.sigma
        mine[6] = one.quality
        mine[7] = one.intensity
        mine[8] = one.width
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


def read_journal(path: Path) -> Iterator[Any]:
    """Yield the whole record batches of a journal, up to where it was cut off."""
    with pa.OSFile(str(path), "rb") as file:
        try:
            yield from pa.ipc.open_stream(file)
        except (pa.ArrowInvalid, OSError):
            return


def check_idle(path: Path) -> None:
    """Raise if another process is still writing this journal.

    Raises
    ------
    OutputError
        If it is.
    """
    if is_locked(path):
        raise OutputError(
            f"{path.parent}: a run is still writing here; wait for its end or stop it first"
        )
