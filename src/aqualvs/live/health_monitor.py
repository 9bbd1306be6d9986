"""Keeps account of how a live run goes."""

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.live.drift_watch import DriftWatch
from aqualvs.live.health import Health, PartHealth, StageDelay, State
from aqualvs.live.sample import Instants
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import Scan

WINDOW_S = 5.0
"""Rates and delays are those of so many last seconds."""

STAGES = ("wait", "measure", "send", "total")
"""From the decoded frame to the moment the measuring thread takes it; the measurement; the sending
to outputs that never wait; all of it."""

# A laser that shows nothing on the target for so long, while others do, is off or covered.
_DARK_S = 2.0


@dataclass(frozen=True, slots=True)
class _Passed:
    """What is kept of one frame."""

    at_ns: int
    valid: bool
    quality: float
    delays_s: tuple[float, float, float, float]


class HealthMonitor:
    """Gathers figures frame by frame; `health` is cheap.

    Parameters
    ----------
    rig : Rig
        Whose lasers are watched.
    """

    def __init__(self, rig: Rig) -> None:
        self._names = [laser.name for laser in rig.lasers]
        self._drift = DriftWatch(rig)
        self._passed: deque[_Passed] = deque()
        self._lit_ns = [0] * len(self._names)
        self._valid_ns = 0
        self._n_frames = 0

    def add(self, scan: Scan, instants: Instants, sent_ns: int) -> None:
        """Take note of a frame that has been measured and sent."""
        if not scan.posture and scan.posture.reason is Reason.NO_FRAMES:
            return
        self._n_frames += 1
        used = scan.points.used
        quality = float(scan.points.quality[used].mean()) if used.any() else float("nan")
        times = (instants.arrived_ns, instants.taken_ns, instants.scanned_ns, sent_ns)
        wait, measure, send = (1e-9 * (b - a) for a, b in itertools.pairwise(times))
        total = wait + measure + send
        self._passed.append(
            _Passed(sent_ns, bool(scan.posture), quality, (wait, measure, send, total))
        )
        if scan.posture:
            self._valid_ns = sent_ns
            for i in np.unique(scan.points.laser[used]).tolist():
                self._lit_ns[i] = sent_ns
        self._drift.offer(scan)

    def close(self) -> None:
        """Stop watching the lasers."""
        self._drift.close()

    def health(
        self,
        now_ns: int,
        *,
        source: PartHealth,
        outputs: Sequence[PartHealth],
        n_dropped: int,
        n_lost: int,
        n_water: float,
        sigma_n_water: float,
    ) -> Health:
        """Return the state of things."""
        while self._passed and now_ns - self._passed[0].at_ns > 1e9 * WINDOW_S:
            self._passed.popleft()
        recent = self._passed
        return Health(
            rate_hz=self._rate_hz(now_ns),
            valid_share=sum(p.valid for p in recent) / len(recent) if recent else float("nan"),
            n_frames=self._n_frames,
            n_dropped=n_dropped,
            n_lost=n_lost,
            delays=self._delays(),
            source=source,
            lasers=self._laser_health(),
            outputs=tuple(outputs),
            quality=_mean([p.quality for p in recent]),
            n_water=n_water,
            sigma_n_water=sigma_n_water,
        )

    def _rate_hz(self, now_ns: int) -> float:
        if len(self._passed) < 2:
            return 0.0
        # While frames come the span ends with the last one; in silence the rate falls.
        period_ns = (self._passed[-1].at_ns - self._passed[0].at_ns) / (len(self._passed) - 1)
        silent_ns = now_ns - self._passed[-1].at_ns
        span_ns = self._passed[-1].at_ns - self._passed[0].at_ns + max(0.0, silent_ns - period_ns)
        return (len(self._passed) - 1) / max(1e-9 * span_ns, 1e-9)

    def _delays(self) -> tuple[StageDelay, ...]:
        if not self._passed:
            return ()
        delays = np.array([p.delays_s for p in self._passed])
        middle, worst = np.quantile(delays, [0.5, 0.99], axis=0)
        return tuple(
            StageDelay(name, float(m), float(w))
            for name, m, w in zip(STAGES, middle, worst, strict=True)
        )

    def _laser_health(self) -> tuple[PartHealth, ...]:
        return tuple(self._one_laser(i) for i in range(len(self._names)))

    def _one_laser(self, i: int) -> PartHealth:
        name = self._names[i]
        if not self._valid_ns:
            return PartHealth(name, State.OFF, "not seen yet")
        dark_s = 1e-9 * (self._valid_ns - self._lit_ns[i])
        if dark_s > _DARK_S:
            return PartHealth(name, State.WARN, "not on the target: off, covered or out of view")
        off = self._drift.off.get(i, "")
        return PartHealth(name, State.WARN if off else State.OK, off)


def _mean(values: list[float]) -> float:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")
