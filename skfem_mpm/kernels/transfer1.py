"""Mapping to the grid and back in one dimension; see :mod:`skfem_mpm.kernels.transfer2` for what functions do."""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import band, closed, cut, finish, measure, opened
from .domains import centre, plain
from .options import INLINE, OPTIONS, TILE

U = np.uint64


@njit(**OPTIONS)
def p2g(base, w, m, v, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Mass, momentum and internal force."""
    n, start, end, row = len(m), 0, 0, plain(w)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mass, momentum = m[p], m[p] * v[0, p]
            stress = -volume[p] * sigma[0, p]
            ring = -volume[p] * sigma[2, p] / x[0, p] if len(hoop) else 0.0
            node = U(base[p, 0] - frame[0, 0])
            for a in range(len(kt)):
                i, value, slope = node + U(a), w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
                g[i, 0] += value * mass
                g[i, 1] += value * momentum
                g[i, 2] += slope * stress + w[p, 0, row, U(a)] * ring
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_mass(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Mass and momentum."""
    n, start, end = len(m), 0, 0
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mass, momentum = m[p], m[p] * v[0, p]
            node = U(base[p, 0] - frame[0, 0])
            for a in range(len(kt)):
                i, value = node + U(a), w[p, 0, 0, U(a)]
                g[i, 0] += value * mass
                g[i, 1] += value * momentum
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_momentum(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Momentum alone."""
    n, start, end = len(m), 0, 0
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            momentum, node = m[p] * v[0, p], U(base[p, 0] - frame[0, 0])
            for a in range(len(kt)):
                g[node + U(a), 0] += w[p, 0, 0, U(a)] * momentum
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_tilt(base, w, m, slope, x, knots, frame, out, copies, rows, kt, c0, c1):
    """Momentum of velocity gradients."""
    n, start, end = len(m), 0, 0
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            size, node, middle = m[p] * slope[0, p], U(base[p, 0] - frame[0, 0]), centre(base, w, knots, x, kt, p, 0)
            for a in range(len(kt)):
                g[node + U(a), 0] += w[p, 0, 0, U(a)] * size * (knots[0, base[p, 0] + a + 1] - middle)
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Internal force."""
    n, start, end, row = len(volume), 0, 0, plain(w)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            stress = -volume[p] * sigma[0, p]
            ring = -volume[p] * sigma[2, p] / x[0, p] if len(hoop) else 0.0
            node = U(base[p, 0] - frame[0, 0])
            for a in range(len(kt)):
                g[node + U(a), 0] += w[p, 0, 1, U(a)] * stress + w[p, 0, row, U(a)] * ring
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def interpolate(base, w, nodal, frame, out, kt, c0, c1):
    """Nodal vectors at the points."""
    n = out.shape[1]
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        node = U(base[p, 0] - frame[0, 0])
        total = 0.0
        for a in range(len(kt)):
            total += w[p, 0, 0, U(a)] * nodal[node + U(a), 0]
        out[0, p] = total


@njit(**INLINE)
def move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    """New velocities and positions of a tile; its displacement gradient too if there is room for it."""
    work, row = 0.0, plain(w)
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        node = U(base[p, 0] - frame[0, 0])
        moving = gained = slope = ring = 0.0
        for a in range(len(kt)):
            i, value = node + U(a), w[p, 0, 0, U(a)]
            moving += value * nodal[i, 0]
            gained += value * nodal[i, 1]
            if len(hoop):
                ring += w[p, 0, row, U(a)] * nodal[i, 0]
            slope += w[p, 0, 1, U(a)] * nodal[i, 0]
        v[0, p] = flip * (v[0, p] + gained) + (1 - flip) * moving
        ahead[0, p] = x[0, p] + dt * (ring if len(hoop) else moving)
        work += m[p] * (moving - gained / 2)
        if len(grad):
            grad[0, at] = dt * slope
            if len(hoop):
                grad[1, at] = dt * ring / x[0, p]
    limits[1] = work
    measure(x, ahead, v, limits, p0, p1)


@njit(**OPTIONS)
def g2p(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, limits, kt, c0, c1):
    """Move points with the grid."""
    n, none = len(m), np.empty((0, 0))
    for t in range(cut(n, c0), cut(n, c1), TILE):
        move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, none, 0, limits[t // TILE], kt, t,
             min(t + TILE, n))


@njit(**INLINE)
def slopes(base, w, nodal, frame, x, dt, hoop, grad, first, kt, p0, p1):
    """Displacement gradient of a tile over a step."""
    row = plain(w)
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        node = U(base[p, 0] - frame[0, 0])
        here = slope = 0.0
        for a in range(len(kt)):
            here += w[p, 0, row, U(a)] * nodal[node + U(a), 0]
            slope += w[p, 0, 1, U(a)] * nodal[node + U(a), 0]
        grad[0, at] = dt * slope
        if len(hoop):
            grad[1, at] = dt * here / x[0, p]


@njit(**OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, c0, c1):
    """Displacement gradient of all points over a step."""
    n = x.shape[1]
    slopes(base, w, nodal, frame, x, dt, hoop, grad, 0, kt, cut(n, c0), cut(n, c1))
