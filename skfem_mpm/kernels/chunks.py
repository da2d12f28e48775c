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


@njit(**INLINE)
def _range(row, p0, p1):
    """Lowest and highest number; four at a time, for processors take one after the other only if they must."""
    a = b = c = d = e = f = g = h = row[U(p0)]
    last = p0 + (p1 - p0) // 4 * 4
    for q in range(p0, last, 4):
        i, j, k, m = row[U(q)], row[U(q + 1)], row[U(q + 2)], row[U(q + 3)]
        a, e = i if i < a else a, i if i > e else e
        b, f = j if j < b else b, j if j > f else f
        c, g = k if k < c else c, k if k > g else g
        d, h = m if m < d else d, m if m > h else h
    for q in range(last, p1):
        i = row[U(q)]
        a, e = i if i < a else a, i if i > e else e
    return min(min(a, b), min(c, d)), max(max(e, f), max(g, h))


@njit(**INLINE)
def _furthest(row, other, p0, p1):
    a = b = c = d = 0.0
    last = p0 + (p1 - p0) // 4 * 4
    for q in range(p0, last, 4):
        i, j = abs(other[U(q)] - row[U(q)]), abs(other[U(q + 1)] - row[U(q + 1)])
        k, m = abs(other[U(q + 2)] - row[U(q + 2)]), abs(other[U(q + 3)] - row[U(q + 3)])
        a, b, c, d = i if i > a else a, j if j > b else b, k if k > c else c, m if m > d else d
    for q in range(last, p1):
        i = abs(other[U(q)] - row[U(q)])
        a = i if i > a else a
    return max(max(a, b), max(c, d))


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
        for j in range(limits.shape[1]):
            limits[tile, j] = 0.0
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
