"""Mapping to the grid and back in two dimensions.

``base (n, dim)`` and ``w (n, dim, 2, K)`` are stencils, ``kt`` a tuple of length K, ``frame`` first node and stride of
the window of nodes per axis.  Grid columns are mass, momentum, force; ``copies`` and ``bands`` hold one grid and the
nodes it may touch for each chunk.  ``nodal`` holds the velocity of nodes after the step and its change.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, INLINE, OPTIONS, TILE
from .transfer1 import _clear

U = np.uint64


@njit(**INLINE)
def _node(base, frame, p):
    return U((base[p, 0] - frame[0, 0]) * frame[1, 0] + base[p, 1] - frame[0, 1])


@njit(**OPTIONS)
def _p2g(base, w, m, v, volume, sigma, x, hoop, frame, g, band, kt, p0, p1):
    _clear(g, band)
    stride = U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        mass, size = m[p], -volume[p]
        mx, my = mass * v[0, p], mass * v[1, p]
        sxx, syy, sxy = size * sigma[0, p], size * sigma[1, p], size * sigma[3, p]
        ring = size * sigma[2, p] / x[0, p] if hoop else 0.0
        node = _node(base, frame, p)
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            c0, c1, c2, c3, c4 = wx * mass, wx * mx, wx * my, dx * sxx + wx * ring, dx * sxy
            c5, c6 = wx * sxy, wx * syy
            for b in range(len(kt)):
                i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                g[i, 0] += wy * c0
                g[i, 1] += wy * c1
                g[i, 2] += wy * c2
                g[i, 3] += wy * c3 + dy * c5
                g[i, 4] += wy * c4 + dy * c6
            node += stride


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
    stride = U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        mass = m[p]
        mx, my = mass * v[0, p], mass * v[1, p]
        node = _node(base, frame, p)
        for a in range(len(kt)):
            wx = w[p, 0, 0, U(a)]
            c0, c1, c2 = wx * mass, wx * mx, wx * my
            for b in range(len(kt)):
                i, wy = node + U(b), w[p, 1, 0, U(b)]
                g[i, 0] += wy * c0
                g[i, 1] += wy * c1
                g[i, 2] += wy * c2
            node += stride


@njit(parallel=True, **OPTIONS)
def p2g_momentum(base, w, m, v, frame, copies, bands, kt):
    """Mass and momentum."""
    n = len(m)
    for c in prange(CHUNKS):
        _p2g_momentum(base, w, m, v, frame, copies[c], bands[c], kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _p2g_force(base, w, volume, sigma, x, hoop, frame, g, band, kt, p0, p1):
    _clear(g, band)
    stride = U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        size = -volume[p]
        sxx, syy, sxy = size * sigma[0, p], size * sigma[1, p], size * sigma[3, p]
        ring = size * sigma[2, p] / x[0, p] if hoop else 0.0
        node = _node(base, frame, p)
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            c3, c4, c5, c6 = dx * sxx + wx * ring, dx * sxy, wx * sxy, wx * syy
            for b in range(len(kt)):
                i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                g[i, 0] += wy * c3 + dy * c5
                g[i, 1] += wy * c4 + dy * c6
            node += stride


@njit(parallel=True, **OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, copies, bands, kt):
    """Internal force."""
    n = len(volume)
    for c in prange(CHUNKS):
        _p2g_force(base, w, volume, sigma, x, hoop, frame, copies[c], bands[c], kt, n * c // CHUNKS,
                   n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _interpolate(base, w, nodal, frame, out, kt, p0, p1):
    stride = U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        node = _node(base, frame, p)
        vx = vy = 0.0
        for a in range(len(kt)):
            wx = w[p, 0, 0, U(a)]
            for b in range(len(kt)):
                value = wx * w[p, 1, 0, U(b)]
                vx += value * nodal[node + U(b), 0]
                vy += value * nodal[node + U(b), 1]
            node += stride
        out[0, p], out[1, p] = vx, vy


@njit(parallel=True, **OPTIONS)
def interpolate(base, w, nodal, frame, out, kt):
    """Nodal vectors at the points."""
    n = out.shape[1]
    for c in prange(CHUNKS):
        _interpolate(base, w, nodal, frame, out, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**INLINE)
def _rates(base, w, nodal, frame, kt, p):
    """Velocity, its change and its gradient at a point."""
    stride, node = U(frame[1, 0]), _node(base, frame, p)
    vx = vy = gx = gy = xx = xy = yx = yy = 0.0
    for a in range(len(kt)):
        wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
        rx = ry = hx = hy = sx = sy = 0.0
        for b in range(len(kt)):
            i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
            nx, ny = nodal[i, 0], nodal[i, 1]
            rx += wy * nx
            ry += wy * ny
            hx += wy * nodal[i, 2]
            hy += wy * nodal[i, 3]
            sx += dy * nx
            sy += dy * ny
        vx += wx * rx
        vy += wx * ry
        gx += wx * hx
        gy += wx * hy
        xx += dx * rx
        yx += dx * ry
        xy += wx * sx
        yy += wx * sy
        node += stride
    return vx, vy, gx, gy, xx, xy, yx, yy


@njit(**OPTIONS)
def _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    lowx = highx = x[0, p0]
    lowy = highy = x[1, p0]
    workx = worky = bad = 0.0
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        vx, vy, gx, gy, xx, xy, yx, yy = _rates(base, w, nodal, frame, kt, p)
        newx, newy = flip * (v[0, p] + gx) + (1 - flip) * vx, flip * (v[1, p] + gy) + (1 - flip) * vy
        v[0, p], v[1, p] = newx, newy
        atx, aty = x[0, p] + dt * vx, x[1, p] + dt * vy
        x[0, p], x[1, p] = atx, aty
        workx += m[p] * (vx - gx / 2)
        worky += m[p] * (vy - gy / 2)
        bad += newx * 0.0 + newy * 0.0
        lowx, highx = atx if atx < lowx else lowx, atx if atx > highx else highx
        lowy, highy = aty if aty < lowy else lowy, aty if aty > highy else highy
        if len(grad):
            grad[0, at], grad[1, at], grad[2, at], grad[3, at] = dt * xx, dt * xy, dt * yx, dt * yy
            if hoop:
                grad[4, at] = dt * vx / atx
    limits[0], limits[1], limits[2] = bad, workx, worky
    limits[3], limits[4], limits[5], limits[6] = lowx, lowy, highx, highy


@njit(parallel=True, **OPTIONS)
def g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, limits, kt):
    """Move points with the grid; displacement gradient too if there is room for it.

    ``limits (tiles, 1 + 3 * dim)`` takes zero or NaN for finite velocities or not, the mass times mean velocity, lowest
    and highest positions.
    """
    for tile in prange(len(limits)):
        _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, 0, limits[tile], kt, tile * TILE,
             min((tile + 1) * TILE, len(m)))


@njit(**OPTIONS)
def _gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, p0, p1):
    for q in range(p0, p1):
        p = U(q)
        vx, _, _, _, xx, xy, yx, yy = _rates(base, w, nodal, frame, kt, p)
        grad[0, p], grad[1, p], grad[2, p], grad[3, p] = dt * xx, dt * xy, dt * yx, dt * yy
        if hoop:
            grad[4, p] = dt * vx / x[0, p]


@njit(parallel=True, **OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt):
    """Displacement gradient over a step."""
    n = x.shape[1]
    for c in prange(CHUNKS):
        _gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)
