"""A file that grows by whole pieces: a piece is in it entirely, or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows locks open files by itself.
    fcntl = None  # type: ignore[assignment]


class AppendFile:
    """Write pieces to a file, each handed to the system at once.

    What has been appended survives the death of the process, though not a loss of power. A piece
    that does not fit on the disk is taken back.

    Parameters
    ----------
    path : Path
        Written anew.
    exclusive : bool
        Whether to raise `FileExistsError` where there is a file.

    Raises
    ------
    OSError
        From the constructor and from `append`, as the system says it.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        self._file = path.open("xb" if exclusive else "wb", buffering=0)
        self._n_bytes = 0

    def append(self, piece: bytes | memoryview) -> None:
        """Write one piece."""
        rest = memoryview(piece)
        try:
            while len(rest):
                # A disk that fills up takes a part; the next try makes it say why.
                rest = rest[self._file.write(rest) :]
        except OSError:
            self._take_back()
            raise
        self._n_bytes += len(piece)

    def _take_back(self) -> None:
        if os.fstat(self._file.fileno()).st_size > self._n_bytes:
            self._file.truncate(self._n_bytes)

    def lock(self) -> None:
        """Mark the file as being written until it is closed, also by the death of the process."""
        if fcntl is not None:
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX)

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._file.close()


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Let one process at a time in; where folders cannot be locked, all."""
    number = None
    try:
        if fcntl is not None:
            with contextlib.suppress(OSError):
                number = os.open(folder, os.O_RDONLY)
                fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        if number is not None:
            os.close(number)


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock of `AppendFile.lock` on a file."""
    if fcntl is None or not path.exists():
        return False
    with path.open("rb") as file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
