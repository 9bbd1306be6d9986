"""Time since the start of a stream, from the stream's own clock."""

_DISAGREE_S = 5.0
"""Stream and arrival differ by less while the sender's clock runs on: buffers hold no more."""


class Unwrapper:
    """Continues a counter of fixed width past its end.

    Parameters
    ----------
    bits : int
        Width of the counter: 32 for the time in RTP, 33 for that in MPEG-TS.
    """

    def __init__(self, bits: int) -> None:
        self._span = 1 << bits
        self._last: int | None = None

    def __call__(self, value: int) -> int:
        """Return the value on an endless line, nearest to the one before.

        Parameters
        ----------
        value : int
            As received; may lie a little before the last one.

        Returns
        -------
        continued : int
        """
        if self._last is None:
            self._last = value
        else:
            half = self._span // 2
            self._last += (value - self._last + half) % self._span - half
        return self._last


class StreamClock:
    """Time since the first picture, which never falls, also over a sender that starts anew.

    A sender that starts anew counts from any number. Where its time disagrees with the time of
    arrival by more than 5 s, or falls, the stream goes on as long after the last picture as the
    new one arrived after it.

    Parameters
    ----------
    tick : float
        Length of a tick in seconds; positive.
    """

    def __init__(self, tick: float) -> None:
        self._tick = tick
        self._anchor = 0.0
        self._anchor_ticks: int | None = None
        self._last = 0.0
        self._last_arrival: float | None = None

    def set_tick(self, tick: float) -> None:
        """Go on with ticks of another length, after a new connection.

        Parameters
        ----------
        tick : float
            Seconds; positive.
        """
        self._tick = tick
        self._anchor_ticks = None

    def time_of(self, ticks: int | None, arrival: float) -> float:
        """Return the time of a picture.

        Parameters
        ----------
        ticks : int or None
            By the stream's clock; None where it has none, then the arrival counts.
        arrival : float
            Seconds on this machine's monotonic clock.

        Returns
        -------
        time : float
            Seconds since the first picture asked for.
        """
        passed = 0.0 if self._last_arrival is None else max(0.0, arrival - self._last_arrival)
        expected = self._last + passed
        time = self._from_ticks(ticks, expected)
        if time < self._last or abs(time - expected) > _DISAGREE_S:
            self._anchor, self._anchor_ticks = expected, ticks
            time = expected
        self._last, self._last_arrival = time, arrival
        return time

    def _from_ticks(self, ticks: int | None, expected: float) -> float:
        if ticks is None:
            return expected
        if self._anchor_ticks is None:
            self._anchor, self._anchor_ticks = expected, ticks
        return self._anchor + (ticks - self._anchor_ticks) * self._tick
