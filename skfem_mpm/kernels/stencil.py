"""Cells and stencils: for each point and axis the first node, and value and slope of its K nodes.

Axes come as ``knots (dim, size + 2)``, coordinates with one more node at either end, and ``inverse (dim, size + 1)``,
one over the widths between them; cell ``c`` lies between ``knots[c + 1]`` and ``knots[c + 2]``.  ``sizes (dim, 2)``
holds the number of cells and whether they are equal.  ``frame`` holds first node and stride of the window of nodes, per
axis.  Points must be inside the grid.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import cut, search
from .options import INLINE, OPTIONS, TILE

U = np.uint64
# The least value of a linear function: a point on a face gives the far nodes, which it sees by their slopes, a mass
# that is next to nothing but not nothing.  So nodes that are read have mass; products of three stay above zero too.
LEAST = 2.0 ** -200
BLOCK = 32       # points of which few enough are near the surface for most blocks to be inside


@njit(**INLINE)
def number(cell, frame, p):
    """Number of a cell in the window, that of its first node."""
    node = (cell[p, 0] - frame[0, 0]) * frame[1, 0]
    if cell.shape[1] > 1:
        node += (cell[p, 1] - frame[0, 1]) * frame[1, 1]
    if cell.shape[1] > 2:
        node += (cell[p, 2] - frame[0, 2]) * frame[1, 2]
    return U(node)


@njit(**OPTIONS)
def mark(cell, frame, occupied, c0, c1):
    """Mark occupied cells."""
    n = len(cell)
    for q in range(cut(n, c0), cut(n, c1)):
        occupied[number(cell, frame, U(q))] = 1


@njit(**OPTIONS)
def locate(x, knots, inverse, sizes, cell, c0, c1):
    """Cells of the points: arithmetic, corrected against the true faces, where cells are equal; search elsewhere."""
    n = x.shape[1]
    for k in range(len(sizes)):
        axis, first, scale, last = knots[k], knots[k, 1], inverse[k, 1], sizes[k, 0] - 1
        for q in range(cut(n, c0), cut(n, c1)):
            p = U(q)
            here = x[k, p]
            if sizes[k, 1]:
                c = np.int64((here - first) * scale)
                c -= np.int64(here < axis[U(c + 1)])
                c += np.int64(here >= axis[U(c + 2)])
                cell[p, k] = last if c > last else c
            else:
                cell[p, k] = search(knots, k, sizes[k, 0], here)


@njit(**OPTIONS)
def place_linear(x, knots, inverse, sizes, cell, w, c0, c1):
    """Cells and finite element functions on equal cells."""
    n = x.shape[1]
    for t in range(cut(n, c0), cut(n, c1), BLOCK):
        for k in range(x.shape[0]):
            axis, first, scale, last = knots[k], knots[k, 1], inverse[k, 1], sizes[k, 0] - 1
            for q in range(t, min(t + BLOCK, n)):
                p = U(q)
                here = x[k, p]
                i = np.int64((here - first) * scale)
                start = axis[U(i + 1)]
                if not start <= here < axis[U(i + 2)] or i > last:      # next to a face, or on the last one
                    i += np.int64(here >= axis[U(i + 2)]) - np.int64(here < start)
                    i = min(i, last)
                    start = axis[U(i + 1)]
                cell[p, k] = i
                at = (here - start) * scale
                rest = 1 - at
                w[p, k, 0, 0] = rest if rest > LEAST else LEAST
                w[p, k, 0, 1] = at if at > LEAST else LEAST
                w[p, k, 1, 0] = -scale
                w[p, k, 1, 1] = scale


@njit(**OPTIONS)
def fill_linear(x, knots, inverse, cell, w, c0, c1):
    """Finite element functions of points whose cells are known; the first node is that of the cell."""
    n = x.shape[1]
    for k in range(x.shape[0]):
        for q in range(cut(n, c0), cut(n, c1)):
            p = U(q)
            i = U(cell[p, k])
            scale = inverse[k, i + U(1)]
            at = (x[k, p] - knots[k, i + U(1)]) * scale
            rest = 1 - at
            w[p, k, 0, 0] = rest if rest > LEAST else LEAST
            w[p, k, 0, 1] = at if at > LEAST else LEAST
            w[p, k, 1, 0] = -scale
            w[p, k, 1, 1] = scale


@njit(**OPTIONS)
def place_gimp(x, length, step, knots, inverse, base, w, c0, c1):
    """First nodes and functions of GIMP on equal cells with domains no longer than a cell, away from edges.

    ``length`` is ``(dim, n)`` with a ``step`` of 1, or that of all points with a step of 0.
    """
    n = x.shape[1]
    for t in range(cut(n, c0), cut(n, c1), TILE):
        for k in range(x.shape[0]):
            axis, first, scale = knots[k], knots[k, 1], inverse[k, 1]
            for q in range(t, min(t + TILE, n)):
                p = U(q)
                size = length[k, p * step] * scale
                b = np.int64((x[k, p] - first) * scale - size / 2)
                base[p, k] = b
                a = (x[k, p] - axis[U(b + 1)]) * scale - size / 2   # start of the domain, in cells from the first node
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


@njit(**OPTIONS)
def fill_gimp_masked(x, length, knots, inverse, sizes, cell, frame, sides, base, w, c0, c1):
    """GIMP with domains of any length up to the neighbours, cut off where ``sides`` has no neighbour."""
    n = x.shape[1]
    for p in range(cut(n, c0), cut(n, c1)):
        code = sides[number(cell, frame, p)]
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


@njit(**INLINE)
def _cubic(at, scale, w, p, k):
    """All four polynomials where both neighbours are there and cells are equal, Eq. (8)."""
    u, s, r, sixth = 1 - at, 1 + at, 2 - at, 1 / 6
    w[p, k, 0, 0] = -at * u * r * sixth
    w[p, k, 0, 1] = s * u * r / 2
    w[p, k, 0, 2] = s * at * r / 2
    w[p, k, 0, 3] = -s * at * u * sixth
    w[p, k, 1, 0] = -(3 * at * at - 6 * at + 2) * (sixth * scale)
    w[p, k, 1, 1] = (3 * at * at - 4 * at - 1) / 2 * scale
    w[p, k, 1, 2] = -(3 * at * at - 2 * at - 2) / 2 * scale
    w[p, k, 1, 3] = (3 * at * at - 1) * (sixth * scale)


@njit(**INLINE)
def _listed(flat, i, at, scale, w, p, k):
    """Those of a table."""
    for j in range(4):
        a1, a2, a3 = flat[i + U(1), j], flat[i + U(2), j], flat[i + U(3), j]
        w[p, k, 0, j] = flat[i, j] + at * (a1 + at * (a2 + at * a3))
        w[p, k, 1, j] = (a1 + at * (2 * a2 + at * (3 * a3))) * scale


@njit(**OPTIONS)
def fill_cmpm(x, knots, inverse, sizes, cell, frame, sides, table, base, w, c0, c1):
    """CMPM; from the polynomials of :func:`~skfem_mpm.kernels.axes.cmpm_table` but inside, among equal cells."""
    n, rows, flat, codes = x.shape[1], table.shape[1], table.reshape(-1, 4), np.empty(BLOCK, dtype=np.uint8)
    for t in range(cut(n, c0), cut(n, c1), BLOCK):
        end = min(t + BLOCK, n)
        for q in range(t, end):
            codes[U(q - t)] = sides[number(cell, frame, U(q))]
        for k in range(x.shape[0]):
            axis, equal, inner = knots[k], sizes[k, 1], True
            for q in range(t, end):
                inner &= codes[U(q - t)] >> (2 * k) & 3 == 3
            if equal and inner:
                scale = inverse[k, 1]
                for q in range(t, end):
                    p = U(q)
                    base[p, k] = cell[p, k] - 1
                    _cubic((x[k, p] - axis[U(cell[p, k] + 1)]) * scale, scale, w, p, k)
                continue
            for q in range(t, end):
                p = U(q)
                kind, c = np.int64(codes[U(q - t)] >> (2 * k) & 3), np.int64(cell[p, k])
                base[p, k] = c - 1
                scale = inverse[k, U(c + 1)]
                at = (x[k, p] - axis[U(c + 1)]) * scale
                if equal and kind == 3:
                    _cubic(at, scale, w, p, k)
                else:
                    _listed(flat, U(((k * rows + (0 if equal else c)) * 4 + kind) * 4), at, scale, w, p, k)
