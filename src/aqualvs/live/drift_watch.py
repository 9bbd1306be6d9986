"""Watching for a laser that has moved, beside the live loop: a verdict takes its time."""

import queue
import threading
import time

from aqualvs.errors import RigError
from aqualvs.optics.rig import Rig
from aqualvs.scanning.agreement import AgreementState, LaserAgreement
from aqualvs.scanning.scan import Scan

_VERDICT_EVERY_S, _PATIENCE_S = 5.0, 3.0


class DriftWatch:
    """Judges the lasers every few seconds, in a thread of its own.

    Parameters
    ----------
    rig : Rig
        With one laser, or without a dome, there is nothing to watch.

    Attributes
    ----------
    off : dict
        Number of the laser to what is wrong with it; empty where nothing is.
    """

    def __init__(self, rig: Rig) -> None:
        self.off: dict[int, str] = {}
        self._scans: queue.Queue[Scan | None] = queue.Queue(8)
        self._thread: threading.Thread | None = None
        agreement = _agreement_of(rig)
        if agreement is not None:
            self._thread = threading.Thread(
                target=self._watch, args=(agreement,), name="drift", daemon=True
            )
            self._thread.start()

    def offer(self, scan: Scan) -> None:
        """Pass a scan on; one that finds the thread busy is not missed."""
        if self._thread is not None and not self._scans.full():
            self._scans.put_nowait(scan)

    def close(self) -> None:
        """End the thread."""
        if self._thread is None:
            return
        while not self._scans.empty():
            self._scans.get_nowait()
        self._scans.put(None)
        self._thread.join(_PATIENCE_S)
        self._thread = None

    def _watch(self, agreement: LaserAgreement) -> None:
        judged_s = time.monotonic()
        while (scan := self._scans.get()) is not None:
            agreement.add(scan)
            if time.monotonic() - judged_s > _VERDICT_EVERY_S:
                self.off = _off(agreement)
                judged_s = time.monotonic()


def _agreement_of(rig: Rig) -> LaserAgreement | None:
    if rig.dome is None or len(rig.lasers) < 2:
        return None
    try:
        return LaserAgreement(rig)
    except RigError:
        # What the rig says of its own uncertainty does not parse; measuring does not need it.
        return None


def _off(agreement: LaserAgreement) -> dict[int, str]:
    verdict = agreement.verdict()
    if verdict.state not in (AgreementState.DRIFTED, AgreementState.DISAGREE):
        return {}
    return dict.fromkeys(verdict.suspects, verdict.sentence())
