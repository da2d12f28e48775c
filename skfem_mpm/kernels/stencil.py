"""Cells and stencils: for each point and axis the first node, and value and slope of its K nodes.

Axes come as ``knots (dim, size + 2)``, coordinates with one more node at either end, and ``inverse (dim, size + 1)``,
one over the widths between them; cell ``c`` lies between ``knots[c + 1]`` and ``knots[c + 2]``.  ``sizes (dim, 2)``
holds the number of cells and whether they are equal.  ``frame`` holds first node and stride of the window of nodes, per
axis.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, INLINE, OPTIONS, TILE

U = np.uint64


@njit(**INLINE)
def _search(knots, k, cells, x):
    low, high = 0, cells
    while high - low > 1:
        middle = (low + high) // 2
        if x < knots[k, middle + 1]:
            high = middle
        else:
            low = middle
    return low


@njit(**OPTIONS)
def _locate(x, k, knots, inverse, cells, cell, p0, p1):
    """Cells hold their first faces, the last ones also their last; arithmetic is corrected against the true faces."""
    axis, last = knots[k], np.int64(cells - 1)
    first, scale = axis[1], inverse[k, 1]
    for q in range(p0, p1):
        p = U(q)
        here = x[k, p]
        c = np.int64((here - first) * scale)
        c = 0 if c < 0 else c
        c = last if c > last else c
        c -= np.int64(here < axis[U(c + 1)])
        c += np.int64(here >= axis[U(c + 2)])
        cell[p, k] = last if c > last else c


@njit(**OPTIONS)
def _search_all(x, k, knots, cells, cell, p0, p1):
    for p in range(p0, p1):
        cell[p, k] = _search(knots, k, cells, x[k, p])


@njit(**INLINE)
def _number(cell, frame, p):
    """Number of a cell in the window, that of its first node."""
    node = (cell[p, 0] - frame[0, 0]) * frame[1, 0]
    if cell.shape[1] > 1:
        node += (cell[p, 1] - frame[0, 1]) * frame[1, 1]
    if cell.shape[1] > 2:
        node += (cell[p, 2] - frame[0, 2]) * frame[1, 2]
    return U(node)


@njit(**OPTIONS)
def _mark(cell, frame, occupied, p0, p1):
    for q in range(p0, p1):
        occupied[_number(cell, frame, U(q))] = 1


@njit(**OPTIONS)
def _band(cell, frame, reach, bands, c, p0, p1):
    bands[c] = 0
    if p1 == p0:
        return
    low = high = cell[p0, 0]
    for q in range(p0, p1):
        here = cell[U(q), 0]
        low, high = here if here < low else low, here if here > high else high
    bands[c, 0] = (low - reach - frame[0, 0]) * frame[1, 0]
    bands[c, 1] = (high + 2 + reach - frame[0, 0]) * frame[1, 0]


@njit(parallel=True, **OPTIONS)
def locate(x, knots, inverse, sizes, frame, reach, cell, bands, occupied):
    """Cells of the points, and the band of nodes that each chunk may touch; marks occupied cells if there is room."""
    n = x.shape[1]
    for c in prange(CHUNKS):
        p0, p1 = n * c // CHUNKS, n * (c + 1) // CHUNKS
        for k in range(len(sizes)):
            if sizes[k, 1]:
                _locate(x, k, knots, inverse, sizes[k, 0], cell, p0, p1)
            else:
                _search_all(x, k, knots, sizes[k, 0], cell, p0, p1)
        _band(cell, frame, reach, bands, c, p0, p1)
        if len(occupied):
            _mark(cell, frame, occupied, p0, p1)


@njit(**OPTIONS)
def _place_linear(x, knots, inverse, sizes, cell, w, p0, p1):
    """Cells and finite element functions on equal cells."""
    for k in range(x.shape[0]):
        axis, first, scale, last = knots[k], knots[k, 1], inverse[k, 1], sizes[k, 0] - 1
        for q in range(p0, p1):
            p = U(q)
            here = x[k, p]
            c = np.int64((here - first) * scale)
            c -= np.int64(here < axis[U(c + 1)])
            c += np.int64(here >= axis[U(c + 2)])
            c = last if c > last else c
            cell[p, k] = c
            t = (here - axis[U(c + 1)]) * scale
            w[p, k, 0, 0] = 1 - t
            w[p, k, 0, 1] = t
            w[p, k, 1, 0] = -scale
            w[p, k, 1, 1] = scale


@njit(**OPTIONS)
def _place_gimp(x, length, step, knots, inverse, base, w, p0, p1):
    """First nodes and functions of narrow domains on equal cells."""
    for k in range(x.shape[0]):
        axis, first, scale = knots[k], knots[k, 1], inverse[k, 1]
        for q in range(p0, p1):
            p = U(q)
            size = length[k, p * step] * scale
            b = np.int64((x[k, p] - first) * scale - size / 2)
            base[p, k] = b
            a = (x[k, p] - axis[U(b + 1)]) * scale - size / 2       # start of the domain, in cells from the first node
            e = a + size
            b1 = e if e < 1 else 1.0
            b2 = e - b1
            share, middle = 1 / size, (b1 * b1 - a * a) / 2
            right, slope = b2 * b2 / 2, share * scale
            w[p, k, 0, 0] = (b1 - a - middle) * share
            w[p, k, 0, 1] = (middle + b2 - right) * share
            w[p, k, 0, 2] = right * share
            w[p, k, 1, 0] = (a - b1) * slope
            w[p, k, 1, 1] = (b1 - a - b2) * slope
            w[p, k, 1, 2] = b2 * slope


@njit(parallel=True, **OPTIONS)
def place_linear(x, knots, inverse, sizes, frame, cell, bands, occupied, w):
    """Cells, bands and finite element functions on equal cells, all in one go."""
    n, tiles = x.shape[1], -(-x.shape[1] // TILE)
    for tile in prange(tiles):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, n)
        _place_linear(x, knots, inverse, sizes, cell, w, p0, p1)
        if len(occupied):
            _mark(cell, frame, occupied, p0, p1)
    for c in prange(CHUNKS):
        _band(cell, frame, 0, bands, c, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(parallel=True, **OPTIONS)
def place_gimp(x, length, knots, inverse, frame, base, bands, w):
    """First nodes, bands and functions of GIMP on equal cells with domains no longer than a cell, away from edges.

    ``length`` is ``(dim, n)``, or ``(dim, 1)`` if all points have the same.
    """
    n, step = x.shape[1], U(length.shape[1] > 1)
    for tile in prange(-(-n // TILE)):
        _place_gimp(x, length, step, knots, inverse, base, w, tile * TILE, min((tile + 1) * TILE, n))
    for c in prange(CHUNKS):
        _band(base, frame, 1, bands, c, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _linear(x, knots, inverse, cell, w, p0, p1):
    for k in range(x.shape[0]):
        for q in range(p0, p1):
            p = U(q)
            c = U(cell[p, k])
            scale = inverse[k, c + U(1)]
            t = (x[k, p] - knots[k, c + U(1)]) * scale
            w[p, k, 0, 0] = 1 - t
            w[p, k, 0, 1] = t
            w[p, k, 1, 0] = -scale
            w[p, k, 1, 1] = scale


@njit(parallel=True, **OPTIONS)
def fill_linear(x, knots, inverse, cell, w):
    """Finite element functions; the first node is that of the cell."""
    n = x.shape[1]
    for tile in prange(-(-n // TILE)):
        _linear(x, knots, inverse, cell, w, tile * TILE, min((tile + 1) * TILE, n))


@njit(**OPTIONS)
def _gimp_masked(x, length, knots, inverse, sizes, cell, frame, sides, base, w, p0, p1):
    for p in range(p0, p1):
        code = sides[_number(cell, frame, p)]
        for k in range(x.shape[0]):
            c = cell[p, k]
            base[p, k] = c - 1
            left, right = code >> (2 * k) & 1, code >> (2 * k + 1) & 1
            width, half = knots[k, c + 2] - knots[k, c + 1], length[k, p] / 2
            start, end = x[k, p] - knots[k, c + 1] - half, x[k, p] - knots[k, c + 1] + half
            inner0, inner1 = max(start, 0.0), min(end, width)
            length0, length1, length2 = max(-start, 0.0) * left, inner1 - inner0, max(end - width, 0.0) * right
            total = 1 / (length0 + length1 + length2)
            share0, share1, share2 = length0 * total, length1 * total, length2 * total
            middle0 = 1 + min(start, 0.0) * inverse[k, c] / 2
            middle1 = (inner0 + inner1) * inverse[k, c + 1] / 2
            middle2 = max(end - width, 0.0) * inverse[k, c + 2] / 2
            first, last = c > 0, c < sizes[k, 0] - 1             # nodes that do not exist carry nothing
            w[p, k, 0, 0] = share0 * (1 - middle0) * first
            w[p, k, 0, 1] = share0 * middle0 + share1 * (1 - middle1)
            w[p, k, 0, 2] = share1 * middle1 + share2 * (1 - middle2)
            w[p, k, 0, 3] = share2 * middle2 * last
            w[p, k, 1, 0] = -share0 * inverse[k, c] * first
            w[p, k, 1, 1] = share0 * inverse[k, c] - share1 * inverse[k, c + 1]
            w[p, k, 1, 2] = share1 * inverse[k, c + 1] - share2 * inverse[k, c + 2]
            w[p, k, 1, 3] = share2 * inverse[k, c + 2] * last


@njit(parallel=True, **OPTIONS)
def fill_gimp_masked(x, length, knots, inverse, sizes, cell, frame, sides, base, w):
    """GIMP with domains of any length up to the neighbours, cut off where ``sides`` has no neighbour."""
    n = x.shape[1]
    for tile in prange(-(-n // TILE)):
        _gimp_masked(x, length, knots, inverse, sizes, cell, frame, sides, base, w, tile * TILE,
                     min((tile + 1) * TILE, n))


@njit(**INLINE)
def _cubic(flat, i, t, scale):
    """Value and slope at ``t`` of the polynomial with coefficients at ``i``, ``i + 4``, ..."""
    a0, a1, a2, a3 = flat[i], flat[i + U(4)], flat[i + U(8)], flat[i + U(12)]
    return a0 + t * (a1 + t * (a2 + t * a3)), (a1 + t * (2 * a2 + t * (3 * a3))) * scale


@njit(**OPTIONS)
def _cmpm(x, knots, inverse, sizes, cell, frame, sides, table, base, w, p0, p1):
    flat, rows = table.ravel(), table.shape[1]
    for k in range(x.shape[0]):
        axis, equal = knots[k], sizes[k, 1]
        for q in range(p0, p1):
            p = U(q)
            code, c = np.int64(sides[_number(cell, frame, p)]), cell[p, k]
            base[p, k] = c - 1
            scale = inverse[k, U(c + 1)]
            t = (x[k, p] - axis[U(c + 1)]) * scale
            i = U(((k * rows + (0 if equal else c)) * 4 + (code >> (2 * k) & 3)) * 16)
            v0, s0 = _cubic(flat, i, t, scale)
            v1, s1 = _cubic(flat, i + U(1), t, scale)
            v2, s2 = _cubic(flat, i + U(2), t, scale)
            v3, s3 = _cubic(flat, i + U(3), t, scale)
            w[p, k, 0, 0], w[p, k, 0, 1], w[p, k, 0, 2], w[p, k, 0, 3] = v0, v1, v2, v3
            w[p, k, 1, 0], w[p, k, 1, 1], w[p, k, 1, 2], w[p, k, 1, 3] = s0, s1, s2, s3


@njit(parallel=True, **OPTIONS)
def fill_cmpm(x, knots, inverse, sizes, cell, frame, sides, table, base, w):
    """CMPM from the polynomials of :func:`cmpm_table`."""
    n = x.shape[1]
    for tile in prange(-(-n // TILE)):
        _cmpm(x, knots, inverse, sizes, cell, frame, sides, table, base, w, tile * TILE, min((tile + 1) * TILE, n))
