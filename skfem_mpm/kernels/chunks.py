"""Chunks of points, the bands of nodes that they touch, and what every chunk knows of its points."""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import CHUNKS, INLINE, OPTIONS, RANGES, SUMS, TILE

U = np.uint64
NOT_FINITE, FAR, TURNED, OUTSIDE, ELSEWHERE = 1, 2, 4, 8, 16     # what a survey may find


@njit(**INLINE)
def cut(n, c):
    """First point of a chunk: chunks are made of whole tiles."""
    return min(n, -(-n // TILE) * c // CHUNKS * TILE)


@njit(**INLINE)
def band(rows, frame, c):
    """First and last node that a chunk touches; ``rows`` holds these nodes along the first axis."""
    return (rows[c, 0] - frame[0, 0]) * frame[1, 0], (rows[c, 1] - frame[0, 0]) * frame[1, 0]


@njit(**INLINE)
def clear(g, low, high):
    """Set nodes to zero."""
    flat, columns = g.ravel(), g.shape[1]
    for i in range(low * columns, high * columns):
        flat[U(i)] = 0.0


@njit(**INLINE)
def pour(g, out, low, high, start, end):
    """Add a chunk's band to all nodes, of which those from ``start`` to ``end`` were written before; the new range."""
    if start == end:
        start, end = low, low
    to, source, columns = out.ravel(), g.ravel(), out.shape[1]
    clear(out, end, low)
    clear(out, high, start)
    a, b = max(low, min(start, high)), min(high, max(end, low))         # the part that was written before
    shift = low * columns
    for i in range(low * columns, a * columns):
        to[U(i)] = source[U(i - shift)]
    for i in range(a * columns, b * columns):
        to[U(i)] += source[U(i - shift)]
    for i in range(b * columns, high * columns):
        to[U(i)] = source[U(i - shift)]
    return min(low, start), max(high, end)


@njit(**OPTIONS)
def sum_bands(frame, copies, rows, out, c0, c1):
    """Sum the chunks' grids in a fixed order, for the same shares of all nodes."""
    n, columns = len(out), out.shape[1]
    n0, n1 = n * c0 // CHUNKS, n * c1 // CHUNKS
    clear(out, n0, n1)
    for c in range(CHUNKS):
        low, high = band(rows, frame, c)
        flat, copy = out.ravel(), copies[c].ravel()
        for i in range(max(low, n0) * columns, min(high, n1) * columns):
            flat[U(i)] += copy[U(i)]


@njit(**RANGES)
def _range(row, p0, p1):
    low = high = row[U(p0)]
    for q in range(U(p0), U(p1)):
        here = row[q]
        low, high = here if here < low else low, here if here > high else high
    return low, high


@njit(**RANGES)
def _furthest(row, other, p0, p1):
    far = 0.0
    for q in range(U(p0), U(p1)):
        here = abs(other[q] - row[q])
        far = here if here > far else far
    return far


@njit(**SUMS)
def finite(row, p0, p1):
    """Zero if all are finite, else not a number."""
    total = 0.0
    for q in range(U(p0), U(p1)):
        total += row[q] * 0.0
    return total


@njit(**INLINE)
def measure(x, ahead, v, limits, p0, p1):
    """What a survey needs of a tile: whether velocities are finite, the box of positions, how far points move."""
    dim = len(x)
    limits[0] = 0.0
    for k in range(dim):
        limits[0] += finite(v[k], p0, p1)
        limits[1 + dim + k], limits[1 + 2 * dim + k] = _range(ahead[k], p0, p1)
        limits[1 + 3 * dim + k] = _furthest(x[k], ahead[k], p0, p1)


@njit(**OPTIONS)
def measure_all(x, v, limits):
    """The same of points at rest, all tiles."""
    for tile in range(len(limits)):
        limits[tile] = 0.0
        measure(x, x, v, limits[tile], tile * TILE, min((tile + 1) * TILE, x.shape[1]))


@njit(**INLINE)
def search(knots, k, cells, x):
    """Cell of a coordinate; cells hold their first faces, the last one also its last."""
    low, high = 0, cells
    while high - low > 1:
        middle = (low + high) // 2
        if x < knots[k, middle + 1]:
            high = middle
        else:
            low = middle
    return low


@njit(**OPTIONS)
def survey(limits, bad, knots, sizes, widths, reach, box, rows, work):
    """Sum up what was measured of the tiles after a step.

    ``box (2, dim)`` takes the lowest and highest cells, ``rows (CHUNKS, 2)`` the nodes along the first axis that each
    chunk may touch, ``work`` the sums of mass times mean velocity.  Returns what was found.
    """
    tiles, dim, found = len(limits), len(sizes), 0
    work[:] = 0.0
    low, high = limits[0, 1 + dim:1 + 2 * dim].copy(), limits[0, 1 + 2 * dim:1 + 3 * dim].copy()
    for tile in range(tiles):
        row = limits[tile]
        found |= NOT_FINITE * (row[0] != 0 or bad[tile, 1] != 0) | TURNED * (bad[tile, 0] != 0)
        for k in range(dim):
            work[k] += row[1 + k]
            low[k], high[k] = min(low[k], row[1 + dim + k]), max(high[k], row[1 + 2 * dim + k])
            found |= FAR * (not row[1 + 3 * dim + k] <= widths[k])
    for k in range(dim):
        found |= OUTSIDE * (not (low[k] >= knots[k, 1] and high[k] <= knots[k, sizes[k, 0] + 1]))
    if found & ~TURNED:
        return found
    for k in range(dim):
        first, last = search(knots, k, sizes[k, 0], low[k]), search(knots, k, sizes[k, 0], high[k])
        found |= ELSEWHERE * (first != box[0, k] or last != box[1, k])
        box[0, k], box[1, k] = first, last
    for c in range(CHUNKS):
        t0, t1 = tiles * c // CHUNKS, tiles * (c + 1) // CHUNKS
        rows[c] = box[0, 0]
        if t1 > t0:
            rows[c, 0] = search(knots, 0, sizes[0, 0], limits[t0:t1, 1 + dim].min()) - reach
            rows[c, 1] = search(knots, 0, sizes[0, 0], limits[t0:t1, 1 + 2 * dim].max()) + 2 + reach
    return found
