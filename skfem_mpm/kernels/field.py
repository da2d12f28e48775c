r"""Stress as a field, in any dimension: what points give to the cells around them, and take from them.

Twin of :mod:`skfem_mpm.integration.field` and :mod:`skfem_mpm.explicit.boxes`; cells are handled in
:mod:`~skfem_mpm.kernels.cells` and numbered by their first nodes.

A point sees three cells along each axis.  ``w (n, dim * powers * 3)`` holds :math:`\omega\,\xi^a` for each axis, power
and cell, with weights :math:`\omega` that are products over the axes; ``at (cells, monomials, dim)`` says which of
these numbers make the weighted monomials in the cells around.  ``steps`` lead to the cells around, ``monos`` and
``dims`` are tuples whose lengths tell how many monomials and axes there are.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .bound import norm
from .chunks import band, closed, cut, finish, opened
from .options import CHUNKS, INLINE, OPTIONS, TILE
from .stencil import number

U = np.uint64


@njit(**INLINE)
def _weight(xi, kappa):
    """Weight of a point in the fit of a cell, along one axis; a negative ``kappa`` stands for linear interpolation."""
    return max(0.0, 1.0 - abs(xi)) if kappa < 0 else np.exp(-kappa * xi * xi)


@njit(**OPTIONS)
def place(x, knots, inverse, cell, kappa, powers, w, c0, c1):
    """Weights times powers of local coordinates."""
    n, dim = x.shape[1], x.shape[0]
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        for k in range(dim):
            for j in range(3):
                first = U(cell[p, k] + j)
                xi = (x[k, p] - (knots[k, first] + knots[k, first + U(1)]) / 2) * inverse[k, first]
                value = _weight(xi, kappa)
                for a in range(len(powers)):
                    w[p, U((k * len(powers) + a) * 3 + j)] = value
                    value *= xi


@njit(**INLINE)
def _term(w, at, p, c, b, dims):
    """A weighted monomial."""
    value = w[p, U(at[c, b, 0])]
    for k in range(1, len(dims)):
        value *= w[p, U(at[c, b, k])]
    return value


@njit(**OPTIONS)
def moments(w, at, steps, cell, frame, out, copies, rows, monos, dims, c0, c1):
    """Sums of the weighted monomials in each cell."""
    n, start, end = len(w), 0, 0
    for chunk in range(c0, c1):
        low, high = band(rows, frame, chunk)
        g = opened(out, copies, chunk, low, high, start, end)
        for q in range(cut(n, chunk), cut(n, chunk + 1)):
            p = U(q)
            host = np.int64(number(cell, frame, p))
            for c in range(len(steps)):
                node = U(host + steps[c])
                for b in range(len(monos)):
                    g[node, b] += _term(w, at, p, c, b, dims)
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def stresses(w, at, steps, cell, frame, sigma, out, copies, rows, monos, comps, dims, c0, c1):
    """Sums of the weighted monomials times stress: ``out (cells, monomials * components)``."""
    n, start, end, own = len(w), 0, 0, np.empty(len(comps))
    for chunk in range(c0, c1):
        low, high = band(rows, frame, chunk)
        g = opened(out, copies, chunk, low, high, start, end)
        for q in range(cut(n, chunk), cut(n, chunk + 1)):
            p = U(q)
            host = np.int64(number(cell, frame, p))
            for i in range(len(comps)):
                own[i] = sigma[U(i), p]
            for c in range(len(steps)):
                node = U(host + steps[c])
                for b in range(len(monos)):
                    value = _term(w, at, p, c, b, dims)
                    for i in range(len(comps)):
                        g[node, U(b * len(comps) + i)] += value * own[i]
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def volumes(w, at, steps, cell, frame, weights, positive, volume, sure, monos, dims, c0, c1):
    """V* of the points, and what constants instead of the fit would give them."""
    n = len(w)
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        host = np.int64(number(cell, frame, p))
        found = plain = 0.0
        for c in range(len(steps)):
            node = U(host + steps[c])
            plain += positive[node] * _term(w, at, p, c, 0, dims)
            for b in range(len(monos)):
                found += weights[node, U(b)] * _term(w, at, p, c, b, dims)
        volume[p], sure[p] = found, plain


@njit(**OPTIONS)
def gradients(w, at, steps, cell, frame, slopes, volume, dt, grad, nrows, monos, dims, c0, c1):
    """Displacement gradient of the points over a step from ``slopes (cells, monomials * rows)``."""
    n, total = len(w), np.empty(len(nrows))
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        host = np.int64(number(cell, frame, p))
        total[:] = 0.0
        for c in range(len(steps)):
            node = U(host + steps[c])
            for b in range(len(monos)):
                value = _term(w, at, p, c, b, dims)
                for i in range(len(nrows)):
                    total[i] += value * slopes[node, U(b * len(nrows) + i)]
        scale = dt / volume[p]
        for i in range(len(nrows)):
            grad[i, p] = scale * total[i]


# -- boxes ------------------------------------------------------------------------------------------------------------


@njit(**INLINE)
def _intervals(x, length, knots, cell, p, k, edge, middle):
    """Edges and middles of the pieces of a box along an axis, in cells from the middles of these."""
    c = cell[p, k]
    start, width = knots[k, c + 1], knots[k, c + 2] - knots[k, c + 1]
    half = min(length[k, p], 2 * min(x[k, p] - knots[k, c], knots[k, c + 3] - x[k, p])) / 2
    low, high = x[k, p] - start - half, x[k, p] - start + half
    before, after = start - knots[k, c], knots[k, c + 3] - knots[k, c + 2]
    edge[k, 0], middle[k, 0] = max(-low, 0.0) / before, 0.5 + min(low, 0.0) / (2 * before)
    edge[k, 1] = (min(high, width) - max(low, 0.0)) / width
    middle[k, 1] = (min(high, width) + max(low, 0.0)) / (2 * width) - 0.5
    edge[k, 2], middle[k, 2] = max(high - width, 0.0) / after, max(high - width, 0.0) / (2 * after) - 0.5


@njit(**INLINE)
def _powers(size, middle, out):
    """Integrals of powers over an interval."""
    square = size * size / 12
    for a in range(len(out)):
        if a == 0:
            out[a] = size
        elif a == 1:
            out[a] = size * middle
        elif a == 2:
            out[a] = size * (middle ** 2 + square)
        elif a == 3:
            out[a] = size * middle * (middle ** 2 + 3 * square)
        else:
            out[a] = size * (middle ** 4 + 6 * square * middle ** 2 + 1.8 * square * square)


@njit(**INLINE)
def _measure(knots, cell, p, edge, middle, offsets, c, hoop, dims):
    """Size of the piece of a box in a cell, or its ring volume."""
    size = 1.0
    for k in range(len(dims)):
        j, first = offsets[c, k], cell[p, k] + offsets[c, k]
        width = knots[k, first + 1] - knots[k, first]
        size *= edge[k, j] * width
        if len(hoop) and k == 0:
            size *= knots[0, first] + (middle[0, j] + 0.5) * width
    return size


@njit(**INLINE)
def _add_piece(edge, middle, offsets, c, scale, g, node, powers, strides, dims):
    """Add integrals of products of powers over the piece of a box in a cell."""
    for k in range(len(dims)):
        _powers(edge[k, offsets[c, k]], middle[k, offsets[c, k]], powers[k])
    for m in range(g.shape[1]):
        value, rest = scale, m
        for k in range(len(dims)):
            a = rest // strides[k]
            rest -= a * strides[k]
            value *= powers[k, a]
        g[node, m] += value


@njit(**OPTIONS)
def boxes(x, length, volume, knots, cell, state, offsets, steps, strides, frame, hoop, out, copies, rows, dims, c0, c1):
    """Integrals of products of powers, in cells that are cut, over the boxes of points as they are in these cells.

    ``state`` says of each cell whether it holds points (1), is full (2), or has cut cells around (4).
    """
    n, start, end, dim = len(volume), 0, 0, len(dims)
    edge, middle, powers = np.empty((dim, 3)), np.empty((dim, 3)), np.empty((dim, strides[-2] if dim > 1 else
                                                                             out.shape[1]))
    for chunk in range(c0, c1):
        low, high = band(rows, frame, chunk)
        g = opened(out, copies, chunk, low, high, start, end)
        for p in range(cut(n, chunk), cut(n, chunk + 1)):
            host, held = np.int64(number(cell, frame, p)), 0.0
            if not state[host] & 4:
                continue
            for k in range(dim):
                _intervals(x, length, knots, cell, p, k, edge, middle)
            for c in range(len(steps)):
                if state[host + steps[c]] & 1:
                    held += _measure(knots, cell, p, edge, middle, offsets, c, hoop, dims)
            for c in range(len(steps)):
                if state[host + steps[c]] & 3 == 1:
                    _add_piece(edge, middle, offsets, c, volume[p] / held, g, host + steps[c], powers, strides, dims)
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


# -- the stiffness ----------------------------------------------------------------------------------------------------


@njit(**OPTIONS)
def tables(w, at, steps, cell, frame, traced, places, volume, out, monos, dims, c0, c1):
    """Slopes ``out (n, nodes, dim)`` of the functions of the points, from ``traced (cells, dim, corners, monomials)``.

    ``places (cells, corners)`` says which of its nodes are the corners of the cells around a point.
    """
    n = len(w)
    for p in range(cut(n, c0), cut(n, c1)):
        host = np.int64(number(cell, frame, p))
        out[p] = 0.0
        for c in range(len(steps)):
            node = host + steps[c]
            for b in range(len(monos)):
                value = _term(w, at, p, c, b, dims) / volume[p]
                for corner in range(places.shape[1]):
                    for k in range(len(dims)):
                        out[p, places[c, corner], k] += value * traced[node, k, corner, b]


@njit(**INLINE)
def _add_pairs(table, volume, first, a, places, slots, m, dims):
    """Add a point to the blocks of pairs of nodes, the first of which are in one row."""
    dim, size = len(dims), len(slots) // 4
    for i in range(a * size, (a + 1) * size):
        node = first + places[i - a * size]
        for j in range(a * size, len(slots)):
            block = m[node, slots[i, j]]
            for k in range(dim):
                value = volume * table[i, k]
                for l in range(dim):
                    block[k * dim + l] += value * table[j, l]


@njit(**OPTIONS)
def norms(table, cell, volume, lam, shear, frame, rows, places, slots, out, dims, c0, c1):
    """Norms of the blocks of the stiffness, see :mod:`~skfem_mpm.kernels.bound`, of four nodes along each axis."""
    n, size, dim = len(volume), frame[1, 0], len(dims)
    count = len(out) // size
    m = np.empty((size, out.shape[1], dim * dim))
    for r in range(count * c0 // CHUNKS, count * c1 // CHUNKS):
        m[:] = 0.0
        for tile in range(len(rows)):
            if rows[tile, 0] <= r < rows[tile, 1]:
                for p in range(tile * TILE, min((tile + 1) * TILE, n)):
                    a, first = r - (cell[p, 0] - 1 - frame[0, 0]), 0
                    for k in range(1, dim):
                        first += (cell[p, k] - 1 - frame[0, k]) * frame[1, k]
                    if 0 <= a < 4:
                        _add_pairs(table[p], volume[p], first, a, places, slots, m, dims)
        for j in range(size):
            for slot in range(out.shape[1]):
                out[r * size + j, slot] = norm(m[j, slot], dim, lam, shear)
