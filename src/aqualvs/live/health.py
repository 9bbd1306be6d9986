"""How well a live run goes: rates, delays, drops, lasers, links."""

from dataclasses import dataclass, field
from enum import StrEnum


class State(StrEnum):
    """Of a part of the system; a pilot reads it as a colour."""

    OK = "ok"
    WARN = "warn"
    """Works, but not as it should."""
    FAULT = "fault"
    """Does not work; it is tried again."""
    OFF = "off"
    """Not in use."""


@dataclass(frozen=True, slots=True)
class PartHealth:
    """Of the stream, of one output, of one laser.

    Attributes
    ----------
    name : str
    state : State
    detail : str
        In a few words, also for a part that is well.
    n_dropped : int
        Samples, or frames, that it could not take.
    """

    name: str
    state: State
    detail: str = ""
    n_dropped: int = 0


@dataclass(frozen=True, slots=True)
class StageDelay:
    """Delay that a stage adds, over the last seconds, in seconds."""

    name: str
    median_s: float
    p99_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Of a live run, over the last seconds.

    Attributes
    ----------
    rate_hz : float
        Frames measured per second.
    valid_share : float
        Share of them with a posture; NaN without frames.
    n_frames, n_dropped, n_lost : int
        Since the start: measured; skipped because a newer one had come; not decoded.
    delays : tuple of StageDelay
        From the decoded frame on.
    source : PartHealth
    lasers, outputs : tuple of PartHealth
    quality : float
        Mean stripe quality on the target, 0 to 1; NaN without points.
    n_water, sigma_n_water : float
        Refractive index in use, and its standard deviation where it is measured on line (else NaN).
    """

    rate_hz: float = 0.0
    valid_share: float = float("nan")
    n_frames: int = 0
    n_dropped: int = 0
    n_lost: int = 0
    delays: tuple[StageDelay, ...] = ()
    source: PartHealth = field(default_factory=lambda: PartHealth("source", State.OFF))
    lasers: tuple[PartHealth, ...] = ()
    outputs: tuple[PartHealth, ...] = ()
    quality: float = float("nan")
    n_water: float = float("nan")
    sigma_n_water: float = float("nan")

    @property
    def state(self) -> State:
        """The worst state of any part in use."""
        parts = (self.source, *self.lasers, *self.outputs)
        order = (State.FAULT, State.WARN, State.OK)
        return next((s for s in order if any(part.state is s for part in parts)), State.OFF)
