r"""Stress as a field, in any dimension: what happens in the cells.

A cell that holds points has the inverse ``Q`` of its Gram matrix, the integrals ``amount (cells, monomials)`` of the
monomials and ``corner (cells, tables, corners, monomials)`` of these times what corner nodes have in a gradient; see
:mod:`skfem_mpm.integration.fit` and :mod:`skfem_mpm.integration.field`, of which this is the twin.  ``exps`` holds the
exponents of the monomials, ``strides`` those of tensors of integrals of products of powers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import APART, CHUNKS, INLINE, OPTIONS

U = np.uint64
UNIT = (1.0, 0.0, 1 / 12, 0.0, 1 / 80)       # integrals of powers from -1/2 to 1/2
SWEEPS = 30


@njit(**OPTIONS)
def classify(occupied, beyond, steps, state):
    """Cells that hold points (1), are full (2), or have cut cells around (4)."""
    reach = steps[-1]
    state[:] = 0
    for i in range(reach, len(state) - reach):
        full = occupied[i]
        if full:
            for step in steps:
                full &= occupied[i + step] | beyond[i + step]
        state[i] = occupied[i] | full << 1
    for i in range(reach, len(state) - reach):
        if occupied[i]:
            for step in steps:
                if state[i + step] & 3 == 1:
                    state[i] |= 4


# -- the fit ----------------------------------------------------------------------------------------------------------


@njit(**APART)
def _factorised(a, size, shift, out):
    """Cholesky factor of a matrix less a multiple of the identity; whether there is one."""
    for i in range(size):
        for j in range(i + 1):
            value = a[i, j] - (shift if i == j else 0.0)
            for k in range(j):
                value -= out[i, k] * out[j, k]
            if i == j:
                if not value > 0:
                    return False
                out[i, i] = np.sqrt(value)
            else:
                out[i, j] = value / out[j, j]
    return True


@njit(**APART)
def _inverted(factor, size, out):
    """Inverse of a matrix from its Cholesky factor, by unit vectors."""
    for c in range(size):
        for i in range(size):
            value = 1.0 if i == c else 0.0
            for k in range(i):
                value -= factor[i, k] * out[k, c]
            out[i, c] = value / factor[i, i]
        for i in range(size - 1, -1, -1):
            value = out[i, c]
            for k in range(i + 1, size):
                value -= factor[k, i] * out[k, c]
            out[i, c] = value / factor[i, i]


@njit(**APART)
def _rotate(a, v, size, i, j):
    """Turn a symmetric matrix such that an entry vanishes, and the vectors with it."""
    theta = (a[j, j] - a[i, i]) / (2 * a[i, j])
    t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1))
    c = 1 / np.sqrt(t * t + 1)
    s = t * c
    for k in range(size):
        a[k, i], a[k, j] = c * a[k, i] - s * a[k, j], s * a[k, i] + c * a[k, j]
    for k in range(size):
        a[i, k], a[j, k] = c * a[i, k] - s * a[j, k], s * a[i, k] + c * a[j, k]
    for k in range(size):
        v[k, i], v[k, j] = c * v[k, i] - s * v[k, j], s * v[k, i] + c * v[k, j]


@njit(**APART)
def _damped(a, size, flat, v, out):
    """Inverse of a symmetric matrix with eigenvalues below ``flat`` damped, by Jacobi's method; uses up the matrix."""
    for i in range(size):
        for j in range(size):
            v[i, j], out[i, j] = 1.0 * (i == j), 0.0
    for _ in range(SWEEPS):
        off = 0.0
        for i in range(size):
            for j in range(i):
                off += a[i, j] ** 2
        if off <= 1e-40:
            break
        for i in range(size):
            for j in range(i + 1, size):
                if a[i, j] != 0:
                    _rotate(a, v, size, i, j)
    for k in range(size):
        value = 1 / a[k, k] if a[k, k] > flat else max(a[k, k], 0.0) / flat ** 2
        for i in range(size):
            for j in range(size):
                out[i, j] += value * v[i, k] * v[j, k]


@njit(**APART)
def _degree(gram, Q, low, high, flat, slope, schur, factor, block):
    """Add a degree, the monomials from ``low`` to ``high``, to the inverse of the Gram matrix."""
    size, weight = high - low, gram[0, 0]
    for i in range(low):
        for j in range(size):
            slope[i, j] = 0.0
            for k in range(low):
                slope[i, j] += Q[i, k] * gram[k, low + j]
    for i in range(size):
        for j in range(size):
            value = gram[low + i, low + j]
            for k in range(low):
                value -= gram[k, low + i] * slope[k, j]
            schur[i, j] = value / weight
    if _factorised(schur, size, flat, factor) and _factorised(schur, size, 0.0, factor):
        _inverted(factor, size, block)
    else:
        _damped(schur, size, flat, factor, block)
    for i in range(high):
        for j in range(size):
            value = block[i - low, j] if i >= low else 0.0
            for k in range(size if i < low else 0):
                value -= slope[i, k] * block[k, j]
            Q[i, low + j] = value / weight
    for i in range(low):
        for j in range(low):
            for k in range(size):
                Q[i, j] -= Q[i, low + k] * slope[j, k]
        for j in range(size):
            Q[low + j, i] = Q[i, low + j]


@njit(**OPTIONS)
def fit(moments, state, pair, flat, Q, c0, c1):
    """Inverses of the Gram matrices, degree by degree; ``flat`` holds the threshold of each degree."""
    n, nb = len(state), len(pair)
    dim = (len(flat) == 2) * (nb - 1)
    if len(flat) == 3:
        while (dim + 1) * (dim + 2) // 2 < nb:
            dim += 1
    gram, slope = np.empty((nb, nb)), np.empty((nb, nb))
    schur, factor, block = np.empty((nb, nb)), np.empty((nb, nb)), np.empty((nb, nb))
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        Q[i] = 0.0
        if state[i] & 1 and moments[i, 0] > 0:
            for a in range(nb):
                for b in range(nb):
                    gram[a, b] = moments[i, pair[a, b]]
            Q[i, 0, 0] = 1 / gram[0, 0]
            _degree(gram, Q[i], 1, dim + 1, flat[1], slope, schur, factor, block)
            if nb > dim + 1:
                _degree(gram, Q[i], dim + 1, nb, flat[2], slope, schur, factor, block)


# -- integrals --------------------------------------------------------------------------------------------------------


@njit(**INLINE)
def _integrals(boxed, full, strides, widths, radius, hoop, area, measure, dims):
    """Integrals of products of powers over what is covered of a cell, without and with the radius."""
    volume = 1.0
    for k in range(len(dims)):
        volume *= widths[k]
    for m in range(len(area)):
        value, rest = 1.0, m
        for k in range(len(dims)):
            a = rest // strides[k]
            rest -= a * strides[k]
            value *= UNIT[a]
        area[m] = volume * (value if full else boxed[m])
    for m in range(len(area)):
        measure[m] = area[m]
        if len(hoop):
            measure[m] *= radius
            if m + strides[0] < len(area):
                measure[m] += widths[0] * area[m + strides[0]]


@njit(**INLINE)
def _at_corner(tensor, first, corner, t, strides, dims):
    """Integral of the slope of a corner's function along an axis (or its value) times a monomial."""
    total, dim = 0.0, len(dims)
    for subset in range(1 << dim):
        if t == dim or not subset >> t & 1:
            value, m = 1.0, first
            for k in range(dim):
                sign = 1.0 if corner >> (dim - 1 - k) & 1 else -1.0
                if k == t:
                    value *= sign
                elif subset >> k & 1:
                    value *= sign
                    m += strides[k]
                else:
                    value *= 0.5
            total += value * tensor[m]
    return total


@njit(**OPTIONS)
def integrate(boxed, state, knots, frame, exps, strides, hoop, amount, corner, dims, c0, c1):
    """Integrals of the monomials, and of these times what corner nodes have in a gradient."""
    n, dim, nb = len(state), len(dims), amount.shape[1]
    widths, area, measure = np.empty(dim), np.empty(boxed.shape[1]), np.empty(boxed.shape[1])
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        if not state[i] & 1:
            continue
        rest, radius = i, 0.0
        for k in range(dim):
            c = rest // frame[1, k]
            rest -= c * frame[1, k]
            c += frame[0, k]
            widths[k] = knots[k, c + 2] - knots[k, c + 1]
            if k == 0:
                radius = (knots[k, c + 2] + knots[k, c + 1]) / 2
        _integrals(boxed[i], state[i] & 2, strides, widths, radius, hoop, area, measure, dims)
        for b in range(nb):
            first = 0
            for k in range(dim):
                first += exps[b, k] * strides[k]
            amount[i, b] = measure[first]
            for t in range(corner.shape[1]):
                tensor = area if t == dim else measure
                width = 1.0 if t == dim else widths[t]
                for I in range(1 << dim):
                    corner[i, t, I, b] = _at_corner(tensor, first, I, t, strides, dims) / width


@njit(**OPTIONS)
def weigh(state, moments, amount, Q, weights, positive, c0, c1):
    """What makes V* of weighted monomials: of the fit, and of constants."""
    n, nb = len(state), amount.shape[1]
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        held = state[i] & 1 and moments[i, 0] > 0
        positive[i] = amount[i, 0] / moments[i, 0] if held else 0.0
        for b in range(nb):
            weights[i, b] = 0.0
            for a in range(nb if held else 0):
                weights[i, b] += amount[i, a] * Q[i, a, b]


# -- the limiter ------------------------------------------------------------------------------------------------------


@njit(**OPTIONS)
def lacking(volume, sure, cell, frame, least, want):
    """What share of constants the cells around a host cell should take for points that have too little, if any has."""
    found = False
    want[:] = 0.0
    for p in range(len(volume)):
        if volume[p] < least * sure[p] * (1 - 1e-9):
            if not found:
                found = True
            host = (cell[p, 0] - frame[0, 0]) * frame[1, 0]
            for k in range(1, cell.shape[1]):
                host += (cell[p, k] - frame[0, k]) * frame[1, k]
            want[host] = max(want[host], (least * sure[p] - volume[p]) / (sure[p] - volume[p]))
    return found


@njit(**OPTIONS)
def blend(state, moments, steps, want, share, own, Q):
    """Take more of the fit by constants: ``share`` of it in each cell."""
    for i in range(len(state)):
        if state[i] & 1:
            for step in steps:
                share[i] += (1 - share[i]) * want[i - step]
            if share[i] > 0:
                Q[i] = own[i] * (1 - share[i])
                Q[i, 0, 0] += share[i] / moments[i, 0]


# -- force and gradient -----------------------------------------------------------------------------------------------


@njit(**OPTIONS)
def forces(state, stress, Q, corner, packed, parts, dims, c0, c1):
    """Internal force that a cell gives its corners, ``parts (cells, corners * dim)``."""
    n, nb, dim = len(state), Q.shape[1], len(dims)
    ncomp = stress.shape[1] // nb
    field = np.empty((nb, ncomp))
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        parts[i] = 0.0
        if not state[i] & 1:
            continue
        for a in range(nb):
            for s in range(ncomp):
                field[a, s] = 0.0
            for b in range(nb):
                for s in range(ncomp):
                    field[a, s] += Q[i, a, b] * stress[i, b * ncomp + s]
        for t in range(corner.shape[1]):
            for k in range(1 if t == dim else dim):
                s = packed[k, t]
                for I in range(1 << dim):
                    for a in range(nb):
                        parts[i, I * dim + k] -= corner[i, t, I, a] * field[a, s]


@njit(**OPTIONS)
def gather(parts, corners, out, dims, c0, c1):
    """Sums at the nodes of what cells give their corners."""
    n, dim = len(parts), len(dims)
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        for k in range(dim):
            out[i, k] = 0.0
        for I in range(len(corners)):
            if i >= corners[I]:
                for k in range(dim):
                    out[i, k] += parts[i - corners[I], I * dim + k]


@njit(**OPTIONS)
def slopes(state, nodal, Q, corner, corners, nrows, out, dims, c0, c1):
    """What makes gradients of weighted monomials, ``out (cells, monomials * rows)``."""
    n, nb, dim = len(state), Q.shape[1], len(dims)
    rough = np.empty((nb, nrows))
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        out[i] = 0.0
        if not state[i] & 1:
            continue
        rough[:] = 0.0
        for t in range(corner.shape[1]):
            for I in range(1 << dim):
                node = i + corners[I]
                for k in range(1 if t == dim else dim):
                    row = dim * dim if t == dim else k * dim + t
                    for a in range(nb):
                        rough[a, row] += corner[i, t, I, a] * nodal[node, k]
        for a in range(nb):
            for b in range(nb):
                for row in range(nrows):
                    out[i, b * nrows + row] += Q[i, a, b] * rough[a, row]


@njit(**OPTIONS)
def trace(state, Q, corner, out, dims, c0, c1):
    """What makes slopes of nodes of weighted monomials, ``out (cells, dim, corners, monomials)``."""
    n, nb = len(state), Q.shape[1]
    for i in range(n * c0 // CHUNKS, n * c1 // CHUNKS):
        out[i] = 0.0
        if state[i] & 1:
            for t in range(len(dims)):
                for I in range(corner.shape[2]):
                    for a in range(nb):
                        for b in range(nb):
                            out[i, t, I, b] += corner[i, t, I, a] * Q[i, a, b]
