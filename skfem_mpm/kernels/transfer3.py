"""Mapping to the grid and back in three dimensions; see :mod:`skfem_mpm.kernels.transfer2` for what functions do."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, INLINE, OPTIONS, TILE
from .transfer1 import _clear

U = np.uint64


@njit(**INLINE)
def _node(base, frame, p):
    return U((base[p, 0] - frame[0, 0]) * frame[1, 0] + (base[p, 1] - frame[0, 1]) * frame[1, 1]
             + base[p, 2] - frame[0, 2])


@njit(**INLINE)
def _stress(volume, sigma, p):
    size = -volume[p]
    return (size * sigma[0, p], size * sigma[1, p], size * sigma[2, p], size * sigma[3, p], size * sigma[4, p],
            size * sigma[5, p])


@njit(**OPTIONS)
def _p2g(base, w, m, v, volume, sigma, frame, g, band, kt, p0, p1):
    _clear(g, band)
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        mass = m[p]
        mx, my, mz = mass * v[0, p], mass * v[1, p], mass * v[2, p]
        sxx, syy, szz, sxy, syz, sxz = _stress(volume, sigma, p)
        start = _node(base, frame, p)
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            node = start
            for b in range(len(kt)):
                wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                value, slopex, slopey = wx * wy, dx * wy, wx * dy
                c0, c1, c2, c3 = value * mass, value * mx, value * my, value * mz
                f1, s1 = slopex * sxx + slopey * sxy, value * sxz
                f2, s2 = slopex * sxy + slopey * syy, value * syz
                f3, s3 = slopex * sxz + slopey * syz, value * szz
                for c in range(len(kt)):
                    i, wz, dz = node + U(c), w[p, 2, 0, U(c)], w[p, 2, 1, U(c)]
                    g[i, 0] += wz * c0
                    g[i, 1] += wz * c1
                    g[i, 2] += wz * c2
                    g[i, 3] += wz * c3
                    g[i, 4] += wz * f1 + dz * s1
                    g[i, 5] += wz * f2 + dz * s2
                    g[i, 6] += wz * f3 + dz * s3
                node += row
            start += layer


@njit(parallel=True, **OPTIONS)
def p2g(base, w, m, v, volume, sigma, x, hoop, frame, copies, bands, kt):
    """Mass, momentum and internal force."""
    n = len(m)
    for c in prange(CHUNKS):
        _p2g(base, w, m, v, volume, sigma, frame, copies[c], bands[c], kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _p2g_momentum(base, w, m, v, frame, g, band, kt, p0, p1):
    _clear(g, band)
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        mass = m[p]
        mx, my, mz = mass * v[0, p], mass * v[1, p], mass * v[2, p]
        start = _node(base, frame, p)
        for a in range(len(kt)):
            node = start
            for b in range(len(kt)):
                value = w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)]
                c0, c1, c2, c3 = value * mass, value * mx, value * my, value * mz
                for c in range(len(kt)):
                    i, wz = node + U(c), w[p, 2, 0, U(c)]
                    g[i, 0] += wz * c0
                    g[i, 1] += wz * c1
                    g[i, 2] += wz * c2
                    g[i, 3] += wz * c3
                node += row
            start += layer


@njit(parallel=True, **OPTIONS)
def p2g_momentum(base, w, m, v, frame, copies, bands, kt):
    """Mass and momentum."""
    n = len(m)
    for c in prange(CHUNKS):
        _p2g_momentum(base, w, m, v, frame, copies[c], bands[c], kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _p2g_force(base, w, volume, sigma, frame, g, band, kt, p0, p1):
    _clear(g, band)
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        sxx, syy, szz, sxy, syz, sxz = _stress(volume, sigma, p)
        start = _node(base, frame, p)
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            node = start
            for b in range(len(kt)):
                wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                value, slopex, slopey = wx * wy, dx * wy, wx * dy
                f1, s1 = slopex * sxx + slopey * sxy, value * sxz
                f2, s2 = slopex * sxy + slopey * syy, value * syz
                f3, s3 = slopex * sxz + slopey * syz, value * szz
                for c in range(len(kt)):
                    i, wz, dz = node + U(c), w[p, 2, 0, U(c)], w[p, 2, 1, U(c)]
                    g[i, 0] += wz * f1 + dz * s1
                    g[i, 1] += wz * f2 + dz * s2
                    g[i, 2] += wz * f3 + dz * s3
                node += row
            start += layer


@njit(parallel=True, **OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, copies, bands, kt):
    """Internal force."""
    n = len(volume)
    for c in prange(CHUNKS):
        _p2g_force(base, w, volume, sigma, frame, copies[c], bands[c], kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _interpolate(base, w, nodal, frame, out, kt, p0, p1):
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        start = _node(base, frame, p)
        vx = vy = vz = 0.0
        for a in range(len(kt)):
            node = start
            for b in range(len(kt)):
                plane = w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)]
                for c in range(len(kt)):
                    value = plane * w[p, 2, 0, U(c)]
                    vx += value * nodal[node + U(c), 0]
                    vy += value * nodal[node + U(c), 1]
                    vz += value * nodal[node + U(c), 2]
                node += row
            start += layer
        out[0, p], out[1, p], out[2, p] = vx, vy, vz


@njit(parallel=True, **OPTIONS)
def interpolate(base, w, nodal, frame, out, kt):
    """Nodal vectors at the points."""
    n = out.shape[1]
    for c in prange(CHUNKS):
        _interpolate(base, w, nodal, frame, out, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**INLINE)
def _line(w, nodal, kt, p, node):
    """Sums along the last axis: velocity, its slope, and its change."""
    rx = ry = rz = sx = sy = sz = hx = hy = hz = 0.0
    for c in range(len(kt)):
        i, wz, dz = node + U(c), w[p, 2, 0, U(c)], w[p, 2, 1, U(c)]
        nx, ny, nz = nodal[i, 0], nodal[i, 1], nodal[i, 2]
        rx += wz * nx
        ry += wz * ny
        rz += wz * nz
        sx += dz * nx
        sy += dz * ny
        sz += dz * nz
        hx += wz * nodal[i, 3]
        hy += wz * nodal[i, 4]
        hz += wz * nodal[i, 5]
    return rx, ry, rz, sx, sy, sz, hx, hy, hz


@njit(**INLINE)
def _rates(base, w, nodal, frame, kt, p):
    """Velocity, its change and its gradient at a point."""
    row, layer, start = U(frame[1, 1]), U(frame[1, 0]), _node(base, frame, p)
    vx = vy = vz = gx = gy = gz = xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    for a in range(len(kt)):
        wx, dx, node = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)], start
        for b in range(len(kt)):
            wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
            value, slopex, slopey = wx * wy, dx * wy, wx * dy
            rx, ry, rz, sx, sy, sz, hx, hy, hz = _line(w, nodal, kt, p, node)
            vx += value * rx
            vy += value * ry
            vz += value * rz
            gx += value * hx
            gy += value * hy
            gz += value * hz
            xx += slopex * rx
            yx += slopex * ry
            zx += slopex * rz
            xy += slopey * rx
            yy += slopey * ry
            zy += slopey * rz
            xz += value * sx
            yz += value * sy
            zz += value * sz
            node += row
        start += layer
    return vx, vy, vz, gx, gy, gz, xx, xy, xz, yx, yy, yz, zx, zy, zz


@njit(**INLINE)
def _write(grad, p, dt, xx, xy, xz, yx, yy, yz, zx, zy, zz):
    grad[0, p], grad[1, p], grad[2, p] = dt * xx, dt * xy, dt * xz
    grad[3, p], grad[4, p], grad[5, p] = dt * yx, dt * yy, dt * yz
    grad[6, p], grad[7, p], grad[8, p] = dt * zx, dt * zy, dt * zz


@njit(**OPTIONS)
def _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    lowx, lowy, lowz = x[0, p0], x[1, p0], x[2, p0]
    highx, highy, highz = lowx, lowy, lowz
    workx = worky = workz = bad = 0.0
    rest = 1 - flip
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        vx, vy, vz, gx, gy, gz, xx, xy, xz, yx, yy, yz, zx, zy, zz = _rates(base, w, nodal, frame, kt, p)
        newx, newy = flip * (v[0, p] + gx) + rest * vx, flip * (v[1, p] + gy) + rest * vy
        newz = flip * (v[2, p] + gz) + rest * vz
        v[0, p], v[1, p], v[2, p] = newx, newy, newz
        atx, aty, atz = x[0, p] + dt * vx, x[1, p] + dt * vy, x[2, p] + dt * vz
        x[0, p], x[1, p], x[2, p] = atx, aty, atz
        workx += m[p] * (vx - gx / 2)
        worky += m[p] * (vy - gy / 2)
        workz += m[p] * (vz - gz / 2)
        bad += newx * 0.0 + newy * 0.0 + newz * 0.0
        lowx, highx = atx if atx < lowx else lowx, atx if atx > highx else highx
        lowy, highy = aty if aty < lowy else lowy, aty if aty > highy else highy
        lowz, highz = atz if atz < lowz else lowz, atz if atz > highz else highz
        if len(grad):
            _write(grad, at, dt, xx, xy, xz, yx, yy, yz, zx, zy, zz)
    limits[0], limits[1], limits[2], limits[3] = bad, workx, worky, workz
    limits[4], limits[5], limits[6], limits[7], limits[8], limits[9] = lowx, lowy, lowz, highx, highy, highz


@njit(parallel=True, **OPTIONS)
def g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, limits, kt):
    """Move points with the grid; displacement gradient too if there is room for it."""
    for tile in prange(len(limits)):
        _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, 0, limits[tile], kt, tile * TILE,
             min((tile + 1) * TILE, len(m)))


@njit(**OPTIONS)
def _gradient(base, w, nodal, frame, dt, grad, kt, p0, p1):
    for q in range(p0, p1):
        p = U(q)
        vx, vy, vz, gx, gy, gz, xx, xy, xz, yx, yy, yz, zx, zy, zz = _rates(base, w, nodal, frame, kt, p)
        _write(grad, p, dt, xx, xy, xz, yx, yy, yz, zx, zy, zz)


@njit(parallel=True, **OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt):
    """Displacement gradient over a step."""
    n = x.shape[1]
    for c in prange(CHUNKS):
        _gradient(base, w, nodal, frame, dt, grad, kt, n * c // CHUNKS, n * (c + 1) // CHUNKS)
