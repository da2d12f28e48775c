"""Chunks of points, the bands of nodes that they touch, and what every chunk knows of its points."""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import CHUNKS, INLINE, OPTIONS, SUMS, TILE

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
def opened(out, copies, c, low, high, start, end):
    """The grid that a chunk adds to, its band cleared.

    That is its own copy; or if there is only one copy, all nodes, of which those from ``start`` to ``end`` were written
    before: the copy keeps what the chunk's band has of them.
    """
    if len(copies) > 1:
        clear(copies[c], low, high)
        return copies[c]
    if start == end:
        start, end = low, low
    first, last = max(low, start) * out.shape[1], min(high, end) * out.shape[1]
    source, kept = out.ravel(), copies[0].ravel()
    for i in range(first, last):
        kept[U(i - first)] = source[U(i)]
    clear(out, low, high)
    clear(out, end, low)
    clear(out, high, start)
    return out


@njit(**INLINE)
def closed(out, copies, low, high, start, end):
    """Add what was kept; the range of nodes written so far."""
    if len(copies) > 1:
        return start, end
    if start == end:
        start, end = low, low
    first, last = max(low, start) * out.shape[1], min(high, end) * out.shape[1]
    to, kept = out.ravel(), copies[0].ravel()
    for i in range(first, last):
        to[U(i)] += kept[U(i - first)]
    return min(low, start), max(high, end)


@njit(**INLINE)
def finish(out, copies, start, end):
    """Clear the nodes that no chunk has written."""
    if len(copies) == 1:
        clear(out, 0, start)
        clear(out, end, len(out))


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


@njit(**INLINE)
def _rank(number):
    """A whole number that is the larger the larger a number is; processors compare many of these at once."""
    bits = np.float64(number).view(np.int64)
    return bits ^ ((bits >> 63) & np.int64(0x7fffffffffffffff))


@njit(**INLINE)
def _ranked(rank):
    """The number of a rank."""
    return np.int64(rank ^ ((rank >> 63) & np.int64(0x7fffffffffffffff))).view(np.float64)


@njit(**INLINE)
def _extremes(row, other, p0, p1):
    """Lowest and highest number of the other row, and the largest difference of the two."""
    low = high = _rank(other[U(p0)])
    far = np.int64(0)
    for q in range(U(p0), U(p1)):
        rank = _rank(other[q])
        low, high, far = min(low, rank), max(high, rank), max(far, _rank(abs(other[q] - row[q])))
    return _ranked(low), _ranked(high), _ranked(far)


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
        low, high, far = _extremes(x[k], ahead[k], p0, p1)
        limits[1 + dim + k], limits[1 + 2 * dim + k], limits[1 + 3 * dim + k] = low, high, far


@njit(**OPTIONS)
def measure_all(x, ahead, v, limits):
    """The same of all tiles."""
    for tile in range(len(limits)):
        measure(x, ahead, v, limits[tile], tile * TILE, min((tile + 1) * TILE, x.shape[1]))


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


@njit(**INLINE)
def _extent(limits, k, dim, t0, t1):
    """Lowest and highest coordinate of the points of some tiles."""
    low, high = limits[t0, 1 + dim + k], limits[t0, 1 + 2 * dim + k]
    for tile in range(t0 + 1, t1):
        low, high = min(low, limits[tile, 1 + dim + k]), max(high, limits[tile, 1 + 2 * dim + k])
    return low, high


@njit(**OPTIONS)
def survey(limits, bad, knots, sizes, widths, reach, box, rows, work):
    """Sum up what was measured of the tiles after a step.

    ``box (2, dim)`` takes the lowest and highest cells, ``rows (CHUNKS, 2)`` the nodes along the first axis that each
    chunk may touch, ``work`` the sums of mass times mean velocity.  Returns what was found.
    """
    tiles, dim, found = len(limits), len(sizes), 0
    for tile in range(tiles):
        found |= NOT_FINITE * (limits[tile, 0] != 0 or bad[tile, 1] != 0) | TURNED * (bad[tile, 0] != 0)
    for k in range(dim):
        work[k] = 0.0
        for tile in range(tiles):
            work[k] += limits[tile, 1 + k]
            found |= FAR * (not limits[tile, 1 + 3 * dim + k] <= widths[k])
        low, high = _extent(limits, k, dim, 0, tiles)
        found |= OUTSIDE * (not (low >= knots[k, 1] and high <= knots[k, sizes[k, 0] + 1]))
    if found:
        return found
    for k in range(dim):
        low, high = _extent(limits, k, dim, 0, tiles)
        first, last = search(knots, k, sizes[k, 0], low), search(knots, k, sizes[k, 0], high)
        found |= ELSEWHERE * (first != box[0, k] or last != box[1, k])
        box[0, k], box[1, k] = first, last
    for c in range(CHUNKS):
        t0, t1 = tiles * c // CHUNKS, tiles * (c + 1) // CHUNKS
        rows[c, 0] = rows[c, 1] = box[0, 0]
        if t1 > t0:
            low, high = _extent(limits, 0, dim, t0, t1)
            rows[c, 0] = search(knots, 0, sizes[0, 0], low) - reach
            rows[c, 1] = search(knots, 0, sizes[0, 0], high) + 2 + reach
    return found
