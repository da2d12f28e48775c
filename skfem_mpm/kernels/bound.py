r"""Norms of the stiffness blocks of pairs of nodes, and the bound of the highest frequency that they give.

Twin of :mod:`skfem_mpm.explicit.bound` for isotropic elasticity in two and three dimensions.  A block is
:math:`K_{IJ} = \lambda M + G (M^T + 1 \operatorname{tr} M)` with
:math:`M = \sum_p V_p \nabla N_I \otimes \nabla N_J`.  Each row of nodes along the first axis is a task of its own, so
what it sums stays in the cache.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, OPTIONS


@njit(**OPTIONS)
def _norm(block, dim, lam, shear):
    trace = 0.0
    for i in range(dim):
        trace += block[i * dim + i]
    total = 0.0
    for i in range(dim):
        for k in range(dim):
            value = lam * block[i * dim + k] + shear * block[k * dim + i]
            if i == k:
                value += shear * trace
            total += value * value
    return np.sqrt(total)


@njit(**OPTIONS)
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


@njit(**OPTIONS)
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
def _finish(m, r, size, dim, lam, shear, out):
    for j in range(size):
        for slot in range(m.shape[1]):
            block = m[j, slot]
            if block[0] != 0 or block[dim * dim - 1] != 0:
                out[r * size + j, slot] = _norm(block, dim, lam, shear)


@njit(**OPTIONS)
def _row2(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks, r):
    n, size = len(volume), frame[1, 0]
    m = np.zeros((size, out.shape[1], 4))
    for c in range(CHUNKS):
        if bands[c, 0] <= r * size < bands[c, 1]:
            for p in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
                a = r - (force[p, 0] - frame[0, 0])
                if 0 <= a < len(kf):
                    _add2(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks)
    _finish(m, r, size, 2, lam, shear, out)


@njit(**OPTIONS)
def _row3(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks, r):
    n, size = len(volume), frame[1, 0]
    m = np.zeros((size, out.shape[1], 9))
    for c in range(CHUNKS):
        if bands[c, 0] <= r * size < bands[c, 1]:
            for p in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
                a = r - (force[p, 0] - frame[0, 0])
                if 0 <= a < len(kf):
                    _add3(force, factors, strain, others, p, volume, frame, a, reach, same, m, kf, ks)
    _finish(m, r, size, 3, lam, shear, out)


@njit(parallel=True, **OPTIONS)
def norms2(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks):
    """Norms of the blocks, ``(nnodes, (2 * reach + 1)**dim)``.

    If force and strain have the ``same`` stencil, only those of nodes in the row of a node and in the rows after it.
    """
    for r in prange(len(out) // frame[1, 0]):
        _row2(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks, r)


@njit(parallel=True, **OPTIONS)
def norms3(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks):
    """The same in three dimensions."""
    for r in prange(len(out) // frame[1, 0]):
        _row3(force, factors, strain, others, volume, lam, shear, frame, bands, reach, same, out, kf, ks, r)


@njit(**OPTIONS)
def _multiply(norms, steps, same, middle, active, scale, z, pad, y, n0, n1):
    """One row per active node; blocks below the own row are transposes of those above if ``same``."""
    for i in range(n0, n1):
        if not active[i]:
            continue
        total = 0.0
        for slot in range(len(steps)):
            other = i + steps[slot]
            if slot < middle and same:
                if 0 <= other < len(norms):
                    total += norms[other, len(steps) - 1 - slot] * z[other + pad]
            else:
                total += norms[i, slot] * z[other + pad]
        y[i] = scale[i] * total


@njit(parallel=True, **OPTIONS)
def multiply(norms, steps, same, middle, active, scale, z, pad, y):
    """Product of the scaled norms with ``z``, which has ``pad`` entries more at either end."""
    n = len(norms)
    for c in prange(CHUNKS):
        _multiply(norms, steps, same, middle, active, scale, z, pad, y, n * c // CHUNKS, n * (c + 1) // CHUNKS)
