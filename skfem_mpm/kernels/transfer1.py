"""Mapping to the grid and back in one dimension; see :mod:`skfem_mpm.kernels.transfer2` for what functions do."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, INLINE, OPTIONS, TILE

U = np.uint64


@njit(**INLINE)
def _clear(g, band):
    for i in range(band[0], band[1]):
        for j in range(g.shape[1]):
            g[i, j] = 0.0


@njit(**OPTIONS)
def _p2g(base, w, m, v, volume, sigma, x, hoop, frame, g, band, kt, p0, p1):
    _clear(g, band)
    for q in range(p0, p1):
        p = U(q)
        mass, momentum = m[p], m[p] * v[0, p]
        stress = -volume[p] * sigma[0, p]
        ring = -volume[p] * sigma[2, p] / x[0, p] if hoop else 0.0
        node = U(base[p, 0] - frame[0, 0])
        for a in range(len(kt)):
            i, value, slope = node + U(a), w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            g[i, 0] += value * mass
            g[i, 1] += value * momentum
            g[i, 2] += slope * stress + value * ring


@njit(parallel=True, **OPTIONS)
def p2g(base, w, m, v, volume, sigma, x, hoop, frame, copies, bands, kt):
    """Mass, momentum and internal force."""
    n = len(m)
    for c in prange(CHUNKS):
        _p2g(base, w, m, v, volume, sigma, x, hoop, frame, copies[c], bands[c], kt, n * c // CHUNKS,
             n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _p2g_momentum(base, w, m, v, frame, g, band, kt, p0, p1):
    _clear(g, band)
    for q in range(p0, p1):
        p = U(q)
        mass, momentum = m[p], m[p] * v[0, p]
        node = U(base[p, 0] - frame[0, 0])
        for a in range(len(kt)):
            i, value = node + U(a), w[p, 0, 0, U(a)]
            g[i, 0] += value * mass
            g[i, 1] += value * momentum


@njit(parallel=True, **OPTIONS)
def p2g_momentum(base, w, m, v, frame, copies, bands, kt):
    """Mass and momentum."""
    n = len(m)
    for c in prange(CHUNKS):
        _p2g_momentum(base, w, m, v, frame, copies[c], bands[c], kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _p2g_force(base, w, volume, sigma, x, hoop, frame, g, band, kt, p0, p1):
    _clear(g, band)
    for q in range(p0, p1):
        p = U(q)
        stress = -volume[p] * sigma[0, p]
        ring = -volume[p] * sigma[2, p] / x[0, p] if hoop else 0.0
        node = U(base[p, 0] - frame[0, 0])
        for a in range(len(kt)):
            g[node + U(a), 0] += w[p, 0, 1, U(a)] * stress + w[p, 0, 0, U(a)] * ring


@njit(parallel=True, **OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, copies, bands, kt):
    """Internal force."""
    n = len(volume)
    for c in prange(CHUNKS):
        _p2g_force(base, w, volume, sigma, x, hoop, frame, copies[c], bands[c], kt, n * c // CHUNKS,
                   n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _interpolate(base, w, nodal, frame, out, kt, p0, p1):
    for q in range(p0, p1):
        p = U(q)
        node = U(base[p, 0] - frame[0, 0])
        total = 0.0
        for a in range(len(kt)):
            total += w[p, 0, 0, U(a)] * nodal[node + U(a), 0]
        out[0, p] = total


@njit(parallel=True, **OPTIONS)
def interpolate(base, w, nodal, frame, out, kt):
    """Nodal vectors at the points."""
    n = out.shape[1]
    for c in prange(CHUNKS):
        _interpolate(base, w, nodal, frame, out, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    low = high = x[0, p0]
    work, bad = 0.0, 0.0
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        node = U(base[p, 0] - frame[0, 0])
        moving = gained = slope = 0.0
        for a in range(len(kt)):
            i, value = node + U(a), w[p, 0, 0, U(a)]
            moving += value * nodal[i, 0]
            gained += value * nodal[i, 1]
            slope += w[p, 0, 1, U(a)] * nodal[i, 0]
        v[0, p] = flip * (v[0, p] + gained) + (1 - flip) * moving
        x[0, p] += dt * moving
        work += m[p] * (moving - gained / 2)
        bad += v[0, p] * 0.0
        low, high = x[0, p] if x[0, p] < low else low, x[0, p] if x[0, p] > high else high
        if len(grad):
            grad[0, at] = dt * slope
            if hoop:
                grad[1, at] = dt * moving / x[0, p]
    limits[0], limits[1], limits[2], limits[3] = bad, work, low, high


@njit(parallel=True, **OPTIONS)
def g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, limits, kt):
    """Move points with the grid; displacement gradient too if there is room for it."""
    for tile in prange(len(limits)):
        _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, 0, limits[tile], kt, tile * TILE,
             min((tile + 1) * TILE, len(m)))


@njit(**OPTIONS)
def _gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, p0, p1):
    for q in range(p0, p1):
        p = U(q)
        node = U(base[p, 0] - frame[0, 0])
        here = slope = 0.0
        for a in range(len(kt)):
            here += w[p, 0, 0, U(a)] * nodal[node + U(a), 0]
            slope += w[p, 0, 1, U(a)] * nodal[node + U(a), 0]
        grad[0, p] = dt * slope
        if hoop:
            grad[1, p] = dt * here / x[0, p]


@njit(parallel=True, **OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt):
    """Displacement gradient over a step."""
    n = x.shape[1]
    for c in prange(CHUNKS):
        _gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)
