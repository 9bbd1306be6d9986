"""Depth as ArduSub tells it, from the best message that there is."""

from typing import Final

from aqualvs.live.mavlink_link import MavlinkLink

# As in logs: height above home, which ArduSub puts at the surface; then above mean sea level; then
# that of the spare estimator.
_CANDIDATES: Final = (
    ("GLOBAL_POSITION_INT", "relative_alt", -1e-3),
    ("VFR_HUD", "alt", -1.0),
    ("AHRS2", "altitude", -1.0),
)
_PRESSURE: Final = ("SCALED_PRESSURE2", "press_abs", 100.0 / (1025.0 * 9.80665))
# An estimate that stands still while the outer pressure changes is that of a filter without
# origin, not a depth.
_STUCK_SHARE, _DIVED_M = 0.1, 0.5


class DepthChoice:
    """Reads the depth; remembers which estimates stood still.

    Parameters
    ----------
    link : MavlinkLink
    fresh_s : float
        Older messages do not count.
    """

    def __init__(self, link: MavlinkLink, fresh_s: float) -> None:
        self._link, self._fresh_s = link, fresh_s
        self._spans: dict[str, tuple[float, float]] = {}

    def read(self) -> float | None:
        """Return the depth in metres, positive down; None if none is known."""
        # Only its span counts: what the pressure was at the surface, nobody says.
        self._value(*_PRESSURE)
        found = {kind: self._value(kind, field, scale) for kind, field, scale in _CANDIDATES}
        for kind, depth in found.items():
            if depth is not None and not self._stands_still(kind):
                return depth
        return None

    def _value(self, kind: str, field: str, scale: float) -> float | None:
        received = self._link.latest(kind, system=self._link.system)
        if received is None or received.age_s > self._fresh_s:
            return None
        value = scale * float(getattr(received.message, field))
        low, high = self._spans.get(kind, (value, value))
        self._spans[kind] = (min(low, value), max(high, value))
        return value

    def _stands_still(self, kind: str) -> bool:
        dived = self._span(_PRESSURE[0])
        return dived > _DIVED_M and self._span(kind) < _STUCK_SHARE * dived

    def _span(self, kind: str) -> float:
        low, high = self._spans.get(kind, (0.0, 0.0))
        return high - low
