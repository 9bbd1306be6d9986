"""Chunks: pieces of stripe, the units that agree with a surface or do not."""

from dataclasses import dataclass

from aqualvs.geometry.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Chunks:
    """Pieces of stripe, C of them, ordered by laser.

    Attributes
    ----------
    table : array, shape (7, C)
        Rows as `plane_search` names them: centroid in `dome` (m), mean derivative of the points by
        the stripe's position (m/px), and voice: its light, but a long stretch has no more
        voice than a few strands, because all of it may follow one strand off the sheet's middle.
    light : array, shape (C,)
        Search lines in it, each as far as its return looks like laser light.
    n_lines : int array, shape (C,)
        Search lines in it.
    first_line, last_line : int array, shape (C,)
        Its extent in search lines; tells lit from dark stretches.
    laser : int array, shape (C,)
        Index of the laser; ascending.
    """

    table: FloatArray
    light: FloatArray
    n_lines: IntArray
    first_line: IntArray
    last_line: IntArray
    laser: IntArray

    def __len__(self) -> int:
        """Return the number of chunks."""
        return len(self.laser)
