"""Counting lit cells near lit cells, with a spatial hash; what `mesh.mesh_filter` compiles to."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel


class Limits(NamedTuple):
    """When a cell belongs to the mesh (paper, Algorithm 1).

    Attributes
    ----------
    a, b, c : int
        Greatest squared distance, in cells, of the cells of the regions A, B and C.
    least_in_a, most_in_a : int
        Lit cells in A.
    most_in_ab : int
        Lit cells in A and B together.
    least_in_c, most_in_c : int
        Lit cells in C.
    reach : int
        Side of the blocks of the hash, in cells; not below the radius of C.
    """

    a: int
    b: int
    c: int
    least_in_a: int
    most_in_a: int
    most_in_ab: int
    least_in_c: int
    most_in_c: int
    reach: int


class _Numbering(NamedTuple):
    """Distinct pairs of integers, numbered in the order in which they first appear.

    Attributes
    ----------
    table : int64 array
        Hash table of the numbers; -1 in empty slots.
    number : int64 array, shape (N,)
        Number of every pair.
    first : int64 array, shape (n,)
        Where every numbered pair first appears.
    """

    table: IntArray
    number: IntArray
    first: IntArray


class _Blocks(NamedTuple):
    """Cells sorted by the block that they lie in.

    Attributes
    ----------
    m, n : array, shape (n_cells,)
        The cells, block by block. Whole numbers kept as floats, which processors square faster.
    start : int64 array, shape (n_blocks + 1,)
        Where every block begins.
    place : int64 array, shape (n_cells,)
        Where every cell went.
    """

    m: FloatArray
    n: FloatArray
    start: IntArray
    place: IntArray


@kernel
def keep_points(columns: IntArray, rows: IntArray, limits: Limits, out: BoolArray) -> None:
    """Decide Algorithm 1 of the paper for points in cells (columns, rows), each of shape (N,)."""
    cells = _number_pairs(columns, rows)
    m, n = columns[cells.first], rows[cells.first]
    block_m, block_n = m // limits.reach, n // limits.reach
    known = _number_pairs(block_m, block_n)
    blocks = _sort_by_block(m, n, known)
    keep = np.empty(m.shape[0], dtype=np.bool_)
    near = np.empty(9, dtype=np.int64)
    for i_block in range(known.first.shape[0]):
        home = known.first[i_block]
        n_near = _neighbours(block_m, block_n, home, known, near)
        for place in range(blocks.start[i_block], blocks.start[i_block + 1]):
            keep[place] = _belongs(blocks, place, near, n_near, limits)
    for k in range(columns.shape[0]):
        out[k] = keep[blocks.place[cells.number[k]]]


@inline_kernel
def _slot(x: int, y: int, mask: int) -> int:
    """Hash two integers to a slot (constants of Teschner et al., VMV 2003)."""
    mixed = x * 73856093 ^ y * 19349663
    return (mixed ^ (mixed >> 15)) & mask


@inline_kernel
def _number_pairs(x: IntArray, y: IntArray) -> _Numbering:
    size = 8
    while size < 2 * x.shape[0]:
        size *= 2
    table = np.full(size, -1, dtype=np.int64)
    number = np.empty(x.shape[0], dtype=np.int64)
    first = np.empty(x.shape[0], dtype=np.int64)
    n_known = 0
    for k in range(x.shape[0]):
        slot = _find(x, y, x[k], y[k], table, first)
        if table[slot] < 0:
            table[slot] = n_known
            first[n_known] = k
            n_known += 1
        number[k] = table[slot]
    return _Numbering(table, number, first[:n_known])


@inline_kernel
def _find(x: IntArray, y: IntArray, at_x: int, at_y: int, table: IntArray, first: IntArray) -> int:
    """Return the slot of a pair, or the empty slot where it would go."""
    mask = table.shape[0] - 1
    slot = _slot(at_x, at_y, mask)
    while table[slot] >= 0:
        known = first[table[slot]]
        if x[known] == at_x and y[known] == at_y:
            break
        slot = (slot + 1) & mask
    return slot


@inline_kernel
def _sort_by_block(m: IntArray, n: IntArray, known: _Numbering) -> _Blocks:
    n_cells, n_blocks = m.shape[0], known.first.shape[0]
    start = np.zeros(n_blocks + 1, dtype=np.int64)
    for i in range(n_cells):
        start[known.number[i] + 1] += 1
    for i in range(n_blocks):
        start[i + 1] += start[i]
    free = start.copy()
    place = np.empty(n_cells, dtype=np.int64)
    sorted_m, sorted_n = np.empty(n_cells), np.empty(n_cells)
    for i in range(n_cells):
        at = free[known.number[i]]
        free[known.number[i]] += 1
        place[i], sorted_m[at], sorted_n[at] = at, m[i], n[i]
    return _Blocks(sorted_m, sorted_n, start, place)


@inline_kernel
def _neighbours(
    block_m: IntArray, block_n: IntArray, home: int, known: _Numbering, near: IntArray
) -> int:
    """Write the numbers of the blocks around a cell's block, and itself; return how many."""
    count = 0
    for bm in range(block_m[home] - 1, block_m[home] + 2):
        for bn in range(block_n[home] - 1, block_n[home] + 2):
            slot = _find(block_m, block_n, bm, bn, known.table, known.first)
            if known.table[slot] >= 0:
                near[count] = known.table[slot]
                count += 1
    return count


@inline_kernel
def _belongs(blocks: _Blocks, place: int, near: IntArray, n_near: int, limits: Limits) -> bool:
    """Compare the lit cells in the regions around a cell with the limits."""
    m, n = blocks.m[place], blocks.n[place]
    in_a, in_ab, in_abc = 0, 0, 0
    for i in range(n_near):
        for k in range(blocks.start[near[i]], blocks.start[near[i] + 1]):
            dm, dn = blocks.m[k] - m, blocks.n[k] - n
            distance = dm * dm + dn * dn
            in_a += distance <= limits.a
            in_ab += distance <= limits.b
            in_abc += distance <= limits.c
        # Counts only grow: a cell amid a wall or a fish needs no further look.
        if in_abc > limits.most_in_ab + limits.most_in_c:
            return False
    in_c = in_abc - in_ab
    return (
        limits.least_in_a <= in_a <= limits.most_in_a
        and in_ab <= limits.most_in_ab
        and limits.least_in_c <= in_c <= limits.most_in_c
    )
