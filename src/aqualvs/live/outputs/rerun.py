"""Samples to a viewer of Rerun, or to its file (extra `rerun`)."""

import math
import socket
import time
from pathlib import Path

from aqualvs.errors import OptionError, OutputError
from aqualvs.live.mavlink.ports import parse_host_port, why
from aqualvs.live.outputs.base import Output
from aqualvs.recording.rerun_log import RRD, RerunLog, rerun_sdk
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State

VIEWER = "viewer"
"""Word for a viewer that is opened on this machine."""

_CHECK_EVERY_S, _REACH_S = 1.0, 0.3


class RerunOutput(Output):
    """Output to Rerun; a viewer that is absent or leaves is looked for once a second.

    `where`: `viewer` to open one, HOST:PORT of one that is open, or a file that ends in `.rrd`.
    Raises `OptionError` if rerun-sdk is not installed, or it is none of these. Raises `OutputError`
    if the file exists or cannot be written.
    """

    name = "rerun"

    def __init__(self, where: str) -> None:
        rerun_sdk()
        self._where = where
        self.keeps_all = where.endswith(RRD)  # A file gets all samples.
        self._log: RerunLog | None = None
        self._address: tuple[str, int] | None = None
        self._next_s, self._closed = -math.inf, False
        if self.keeps_all:
            self._log = _file_log(Path(where))
        elif where != VIEWER:
            host, port = parse_host_port(where) or ("", None)
            if not host or port is None:
                raise OptionError(
                    f"--rerun {where}: not understood; give {VIEWER}, HOST:PORT (Rerun listens on "
                    f"port 9876), or a file that ends in {RRD}"
                )
            self._address = host, port

    def send(self, sample: LiveSample) -> None:
        """Log a sample.

        Raises `OSError` or `RuntimeError` if no viewer is there.
        """
        if self._closed:
            return
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._check_viewer()
            # It may have taken seconds.
            self._next_s = time.monotonic() + _CHECK_EVERY_S
        if self._log is not None:
            self._log.write(sample)

    def health(self) -> PartHealth:
        """Return whether samples arrive."""
        if self._closed:
            return PartHealth(self.name, State.OFF, "closed")
        if self._log is None:
            return PartHealth(self.name, State.WARN, f"no viewer at {self._where}")
        return PartHealth(self.name, State.OK, f"to {self._where}")

    def close(self) -> None:
        """Finish the file, or leave the viewer; further calls do nothing."""
        self._closed = True
        if self._log is not None:
            self._log.close()

    def _check_viewer(self) -> None:
        """Find the viewer, or see whether it is still there."""
        if self.keeps_all:
            return
        if self._log is None:
            self._log = self._connect()
        elif self._address is not None:
            # The SDK waits seconds for a viewer that has gone; a knock tells at once.
            try:
                self._check_reachable(self._address)
            except OSError:
                left, self._log = self._log, None
                left.close()
                raise

    def _connect(self) -> RerunLog:
        log = RerunLog()
        if self._address is None:
            log.spawn()
        else:
            self._check_reachable(self._address)
            host, port = self._address
            log.connect(f"rerun+http://{f'[{host}]' if ':' in host else host}:{port}/proxy")
        return log

    def _check_reachable(self, address: tuple[str, int]) -> None:
        try:
            socket.create_connection(address, _REACH_S).close()
        except OSError as fault:
            raise OSError(f"no viewer at {self._where} ({why(fault)})") from fault


def _file_log(path: Path) -> RerunLog:
    if path.exists():
        raise OutputError(f"--rerun {path}: exists; choose another name")
    log = RerunLog()
    try:
        log.save(path)
    except (OSError, ValueError) as fault:
        raise OutputError(
            f"--rerun {path}: cannot be written ({why(fault)}); choose another place"
        ) from fault
    return log
