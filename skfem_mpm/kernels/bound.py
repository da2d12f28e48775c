r"""Norms of the stiffness blocks of pairs of nodes, and the consistent mass: what bounds the highest frequency.

Twin of :mod:`skfem_mpm.explicit.bound` for isotropic elasticity in two and three dimensions.  A block is
:math:`K_{IJ} = \lambda M + G (M^T + 1 \operatorname{tr} M)` with
:math:`M = \sum_p V_p \nabla N_I \otimes \nabla N_J`.  Nodes are handled row by row along the first axis, so what
a row sums stays in the cache.

Tables ``(nnodes, (2 * reach + 1)**dim)`` have a slot for each node around a node.  Where the table is its own
transpose, only those of nodes in the row of a node and in the rows after it are filled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import search
from .options import CHUNKS, INLINE, OPTIONS, TILE

U = np.uint64


@njit(**OPTIONS)
def rows_of_tiles(limits, knots, sizes, frame, reach, rows):
    """Rows of nodes that each tile may touch, in the window."""
    dim = len(sizes)
    for tile in range(len(limits)):
        rows[tile, 0] = search(knots, 0, sizes[0, 0], limits[tile, 1 + dim]) - reach - frame[0, 0]
        rows[tile, 1] = search(knots, 0, sizes[0, 0], limits[tile, 1 + 2 * dim]) + 2 + reach - frame[0, 0]


@njit(**INLINE)
def norm(block, dim, lam, shear):
    """Norm of a block of the stiffness from its sum of products of slopes."""
    trace = total = most = 0.0
    for i in range(dim * dim):
        most += abs(block[i])
    if most == 0:
        return 0.0
    for i in range(dim):
        trace += block[i * dim + i]
    for i in range(dim):
        for k in range(dim):
            value = lam * block[i * dim + k] + shear * block[k * dim + i]
            if i == k:
                value += shear * trace
            total += value * value
    return np.sqrt(total)


@njit(**INLINE)
def _add2(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks):
    span = 2 * reach + 1
    wi, di = volume[p] * factors[p, 0, 0, a], volume[p] * factors[p, 0, 1, a]
    j, shift0, shift1 = force[p, 1] - frame[0, 1], strain[p, 0] - force[p, 0], strain[p, 1] - force[p, 1] + reach
    for a2 in range(len(ks)):
        da = shift0 + a2 - a
        if same and da < 0:
            continue
        ww, wd = wi * others[p, 0, 0, a2], wi * others[p, 0, 1, a2]
        dw, dd = di * others[p, 0, 0, a2], di * others[p, 0, 1, a2]
        for b in range(len(kf)):
            wb, db = factors[p, 1, 0, b], factors[p, 1, 1, b]
            slot = (da + reach) * span + shift1 - b
            for b2 in range(len(ks)):
                w2, d2 = others[p, 1, 0, b2], others[p, 1, 1, b2]
                row = m[j + b, slot + b2]
                row[0] += dd * wb * w2
                row[1] += dw * wb * d2
                row[2] += wd * db * w2
                row[3] += ww * db * d2


@njit(**INLINE)
def _add3(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks):
    span = 2 * reach + 1
    wi, di = volume[p] * factors[p, 0, 0, a], volume[p] * factors[p, 0, 1, a]
    start = (force[p, 1] - frame[0, 1]) * frame[1, 1] + force[p, 2] - frame[0, 2]
    shift0 = strain[p, 0] - force[p, 0]
    shift1, shift2 = strain[p, 1] - force[p, 1] + reach, strain[p, 2] - force[p, 2] + reach
    for a2 in range(len(ks)):
        da = shift0 + a2 - a
        if same and da < 0:
            continue
        ww, wd = wi * others[p, 0, 0, a2], wi * others[p, 0, 1, a2]
        dw, dd = di * others[p, 0, 0, a2], di * others[p, 0, 1, a2]
        for b in range(len(kf)):
            wb, db = factors[p, 1, 0, b], factors[p, 1, 1, b]
            for b2 in range(len(ks)):
                w2, d2 = others[p, 1, 0, b2], others[p, 1, 1, b2]
                bww, bwd, bdw, bdd = wb * w2, wb * d2, db * w2, db * d2
                c0, c1, c2, c3, c4 = dd * bww, dw * bwd, dw * bww, wd * bdw, ww * bdd
                c5, c6, c7, c8 = ww * bdw, wd * bww, ww * bwd, ww * bww
                node, slot = start + b * frame[1, 1], ((da + reach) * span + shift1 + b2 - b) * span + shift2
                for c in range(len(kf)):
                    wc, dc = factors[p, 2, 0, c], factors[p, 2, 1, c]
                    for e in range(len(ks)):
                        we, de = others[p, 2, 0, e], others[p, 2, 1, e]
                        cww, cwd, cdw = wc * we, wc * de, dc * we
                        row = m[node + c, slot + e - c]
                        row[0] += c0 * cww
                        row[1] += c1 * cww
                        row[2] += c2 * cwd
                        row[3] += c3 * cww
                        row[4] += c4 * cww
                        row[5] += c5 * cwd
                        row[6] += c6 * cdw
                        row[7] += c7 * cdw
                        row[8] += c8 * dc * de


@njit(**OPTIONS)
def norms2(force, factors, strain, others, volume, lam, shear, frame, rows, reach, same, out, kf, ks, c0, c1):
    """Norms of the blocks; force and strain may have the ``same`` stencil."""
    n, size = len(volume), frame[1, 0]
    count = len(out) // size
    m = np.empty((size, out.shape[1], 4))
    for r in range(count * c0 // CHUNKS, count * c1 // CHUNKS):
        m[:] = 0.0
        for tile in range(len(rows)):
            if rows[tile, 0] <= r < rows[tile, 1]:
                for p in range(tile * TILE, min((tile + 1) * TILE, n)):
                    a = r - (force[p, 0] - frame[0, 0])
                    if 0 <= a < len(kf):
                        _add2(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks)
        for j in range(size):
            for slot in range(out.shape[1]):
                out[r * size + j, slot] = norm(m[j, slot], 2, lam, shear)


@njit(**OPTIONS)
def norms3(force, factors, strain, others, volume, lam, shear, frame, rows, reach, same, out, kf, ks, c0, c1):
    """Norms of the blocks in three dimensions; force and strain may have the ``same`` stencil."""
    n, size = len(volume), frame[1, 0]
    count = len(out) // size
    m = np.empty((size, out.shape[1], 9))
    for r in range(count * c0 // CHUNKS, count * c1 // CHUNKS):
        m[:] = 0.0
        for tile in range(len(rows)):
            if rows[tile, 0] <= r < rows[tile, 1]:
                for p in range(tile * TILE, min((tile + 1) * TILE, n)):
                    a = r - (force[p, 0] - frame[0, 0])
                    if 0 <= a < len(kf):
                        _add3(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks)
        for j in range(size):
            for slot in range(out.shape[1]):
                out[r * size + j, slot] = norm(m[j, slot], 3, lam, shear)


@njit(**INLINE)
def _pairs2(base, w, mass, p, frame, a, reach, out, row, kt):
    span, j = 2 * reach + 1, row + base[p, 1] - frame[0, 1]
    for a2 in range(a, len(kt)):
        both = mass * w[p, 0, 0, a] * w[p, 0, 0, a2]
        for b in range(len(kt)):
            part, slot = both * w[p, 1, 0, b], (a2 - a + reach) * span + reach - b
            for b2 in range(len(kt)):
                out[j + b, slot + b2] += part * w[p, 1, 0, b2]


@njit(**INLINE)
def _pairs3(base, w, mass, p, frame, a, reach, out, row, kt):
    span, j = 2 * reach + 1, row + (base[p, 1] - frame[0, 1]) * frame[1, 1] + base[p, 2] - frame[0, 2]
    for a2 in range(a, len(kt)):
        both = mass * w[p, 0, 0, a] * w[p, 0, 0, a2]
        for b in range(len(kt)):
            for b2 in range(len(kt)):
                most = both * w[p, 1, 0, b] * w[p, 1, 0, b2]
                node, slot = j + b * frame[1, 1], ((a2 - a + reach) * span + b2 - b + reach) * span + reach
                for c in range(len(kt)):
                    for e in range(len(kt)):
                        out[node + c, slot + e - c] += most * w[p, 2, 0, c] * w[p, 2, 0, e]


@njit(**OPTIONS)
def masses2(base, w, m, frame, rows, reach, out, kt, c0, c1):
    """Consistent mass, its own transpose."""
    n, size = len(m), frame[1, 0]
    count = len(out) // size
    for r in range(count * c0 // CHUNKS, count * c1 // CHUNKS):
        for tile in range(len(rows)):
            if rows[tile, 0] <= r < rows[tile, 1]:
                for p in range(tile * TILE, min((tile + 1) * TILE, n)):
                    a = r - (base[p, 0] - frame[0, 0])
                    if 0 <= a < len(kt):
                        _pairs2(base, w, m[p], p, frame, a, reach, out, r * size, kt)


@njit(**OPTIONS)
def masses3(base, w, m, frame, rows, reach, out, kt, c0, c1):
    """Consistent mass in three dimensions, its own transpose."""
    n, size = len(m), frame[1, 0]
    count = len(out) // size
    for r in range(count * c0 // CHUNKS, count * c1 // CHUNKS):
        for tile in range(len(rows)):
            if rows[tile, 0] <= r < rows[tile, 1]:
                for p in range(tile * TILE, min((tile + 1) * TILE, n)):
                    a = r - (base[p, 0] - frame[0, 0])
                    if 0 <= a < len(kt):
                        _pairs3(base, w, m[p], p, frame, a, reach, out, r * size, kt)


@njit(**OPTIONS)
def multiply(table, steps, own, z, y, pad):
    """Add the product of a table with ``z`` to ``y``, both with ``pad`` entries more at either end.

    If the table is its own transpose, ``own`` is the number of its slots in the row of a node: those before are empty,
    those after count twice.  It is zero for other tables.
    """
    span = len(steps)
    middle, late = (span - own) // 2 if own else 0, (span + own) // 2
    for q in range(len(table)):
        here, total = z[q + pad], 0.0
        for slot in range(middle, span):
            total += table[U(q), U(slot)] * z[U(q + pad + steps[U(slot)])]
        y[q + pad] += total
        if own and here != 0:
            for slot in range(late, span):
                y[U(q + pad + steps[U(slot)])] += table[U(q), U(slot)] * here
