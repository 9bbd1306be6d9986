"""Recording on and off while a run goes on."""

import threading
from datetime import UTC, datetime
from pathlib import Path

from aqualvs.errors import OutputError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.recorder.recorder import Recorder
from aqualvs.live.recorder.sample_encoder import RecorderOptions
from aqualvs.live.sample import LiveSample


class RecorderSwitch:
    """An output that records when told to; every start makes a file of its own.

    Parameters
    ----------
    folder : Path
        Made when it is needed.
    options : RecorderOptions, optional
        Defaults if left out.

    Attributes
    ----------
    name, inline, keeps_all
        As in `Output`.
    """

    name = "recorder"
    inline = False
    keeps_all = True

    def __init__(self, folder: Path, options: RecorderOptions | None = None) -> None:
        self._folder, self._options = folder, options or RecorderOptions()
        self._lock = threading.Lock()
        self._recorder: Recorder | None = None
        self._last: PartHealth | None = None

    @property
    def path(self) -> Path | None:
        """File that is being written, None where none is."""
        recorder = self._recorder
        return None if recorder is None else recorder.path

    def start(self, path: Path | None = None) -> Path:
        """Begin to record, if that is not yet so.

        Parameters
        ----------
        path : Path or None
            File to write, which must not exist; None names it by the time (UTC).

        Returns
        -------
        path : Path
            File that is being written.

        Raises
        ------
        OutputError
            If it cannot be begun.
        """
        with self._lock:
            if self._recorder is None:
                self._recorder = Recorder(path or self._free_path(), self._options)
            return self._recorder.path

    def stop(self) -> Path | None:
        """Close the file; returns it, or None if nothing was being recorded."""
        with self._lock:
            recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        recorder.close()
        self._last = recorder.health()
        return recorder.path

    def send(self, sample: LiveSample) -> None:
        """Record a sample, if recording is on."""
        recorder = self._recorder
        if recorder is not None:
            recorder.send(sample)

    def health(self) -> PartHealth:
        """Return how the recording is; off says what the last one was."""
        recorder = self._recorder
        if recorder is not None:
            return recorder.health()
        return self._last or PartHealth(self.name, State.OFF, "not recording")

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self.stop()

    def _free_path(self) -> Path:
        """Return a name by the time that no file has."""
        stem = f"dive_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise OutputError(
                f"{self._folder}: cannot be made ({fault.strerror}); choose another folder"
            ) from fault
        path, n = self._folder / f"{stem}.mcap", 1
        while path.exists():
            n += 1
            path = self._folder / f"{stem}_{n}.mcap"
        return path
