"""Numbers of pictures, with gaps for lost ones."""

import heapq

from av.packet import Packet
from av.video.stream import VideoStream


class Ledger:
    """Numbers pictures by the packets that announced them, so that lost ones leave a gap.

    Parameters
    ----------
    counts_packets : bool
        Whether each packet shows a picture.

    Attributes
    ----------
    first_pts : int or None
        Time of the first picture, in ticks of its stream.
    n_packets : int
        Packets noted.
    """

    def __init__(self, *, counts_packets: bool) -> None:
        self.first_pts: int | None = None
        self.n_packets = 0
        self._counts_packets = counts_packets
        self._pending: list[int] = []
        self._next = 0

    @property
    def n_known(self) -> int:
        """Pictures numbered so far and announced ones that have not come."""
        return self._next + len(self._pending)

    def expect(self, packet: "Packet[VideoStream]") -> None:
        """Note a packet; the empty one that flushes the decoder does not count.

        Parameters
        ----------
        packet : Packet
        """
        if packet.size == 0:
            return
        self.n_packets += 1
        if packet.pts is None or packet.is_discard or not self._counts_packets:
            return
        heapq.heappush(self._pending, packet.pts)

    def number(self, pts: int | None) -> int:
        """Return the number of a picture, counting those lost before it.

        Parameters
        ----------
        pts : int or None
            Its time, in ticks of its stream.

        Returns
        -------
        index : int
            Greater than that of the picture before.
        """
        if self.first_pts is None and pts is not None:
            self.first_pts = min(pts, *self._pending[:1])
        while pts is not None and self._pending and self._pending[0] < pts:
            heapq.heappop(self._pending)
            self._next += 1
        while pts is not None and self._pending and self._pending[0] == pts:
            heapq.heappop(self._pending)
        self._next += 1
        return self._next - 1

    def skip(self, n: int) -> None:
        """Count pictures as lost whose packets never came.

        Parameters
        ----------
        n : int
            Not negative.
        """
        self._next += n

    def restart(self) -> None:
        """Count announced pictures that have not come as lost; the stream's ticks begin anew."""
        self._next = self.n_known
        self._pending.clear()
