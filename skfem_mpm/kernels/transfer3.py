"""Mapping to the grid and back in three dimensions; see :mod:`skfem_mpm.kernels.transfer2` for what functions do."""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import band, closed, cut, finish, measure, opened
from .domains import centre
from .options import INLINE, OPTIONS, TILE

U = np.uint64


@njit(**INLINE)
def _node(base, frame, p):
    return ((base[p, 0] - frame[0, 0]) * frame[1, 0] + (base[p, 1] - frame[0, 1]) * frame[1, 1]
            + base[p, 2] - frame[0, 2])


@njit(**INLINE)
def _stress(volume, sigma, p):
    size = -volume[p]
    return (size * sigma[0, p], size * sigma[1, p], size * sigma[2, p], size * sigma[3, p], size * sigma[4, p],
            size * sigma[5, p])


@njit(**OPTIONS)
def p2g(base, w, m, v, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Mass, momentum and internal force."""
    n, start, end = len(m), 0, 0
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mass = m[p]
            mx, my, mz = mass * v[0, p], mass * v[1, p], mass * v[2, p]
            sxx, syy, szz, sxy, syz, sxz = _stress(volume, sigma, p)
            first = U(_node(base, frame, p))
            for a in range(len(kt)):
                wx, dx, node = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)], first
                for b in range(len(kt)):
                    wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                    value, slopex, slopey = wx * wy, dx * wy, wx * dy
                    mw, ux, uy, uz = value * mass, value * mx, value * my, value * mz
                    f1, s1 = slopex * sxx + slopey * sxy, value * sxz
                    f2, s2 = slopex * sxy + slopey * syy, value * syz
                    f3, s3 = slopex * sxz + slopey * syz, value * szz
                    for d in range(len(kt)):
                        i, wz, dz = node + U(d), w[p, 2, 0, U(d)], w[p, 2, 1, U(d)]
                        g[i, 0] += wz * mw
                        g[i, 1] += wz * ux
                        g[i, 2] += wz * uy
                        g[i, 3] += wz * uz
                        g[i, 4] += wz * f1 + dz * s1
                        g[i, 5] += wz * f2 + dz * s2
                        g[i, 6] += wz * f3 + dz * s3
                    node += row
                first += layer
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_mass(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Mass and momentum."""
    n, start, end = len(m), 0, 0
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mass, first = m[p], U(_node(base, frame, p))
            mx, my, mz = mass * v[0, p], mass * v[1, p], mass * v[2, p]
            for a in range(len(kt)):
                node = first
                for b in range(len(kt)):
                    value = w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)]
                    mw, ux, uy, uz = value * mass, value * mx, value * my, value * mz
                    for d in range(len(kt)):
                        i, wz = node + U(d), w[p, 2, 0, U(d)]
                        g[i, 0] += wz * mw
                        g[i, 1] += wz * ux
                        g[i, 2] += wz * uy
                        g[i, 3] += wz * uz
                    node += row
                first += layer
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_momentum(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Momentum alone."""
    n, start, end = len(m), 0, 0
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mx, my, mz, first = m[p] * v[0, p], m[p] * v[1, p], m[p] * v[2, p], U(_node(base, frame, p))
            for a in range(len(kt)):
                node = first
                for b in range(len(kt)):
                    value = w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)]
                    ux, uy, uz = value * mx, value * my, value * mz
                    for d in range(len(kt)):
                        i, wz = node + U(d), w[p, 2, 0, U(d)]
                        g[i, 0] += wz * ux
                        g[i, 1] += wz * uy
                        g[i, 2] += wz * uz
                    node += row
                first += layer
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_tilt(base, w, m, slope, x, knots, frame, out, copies, rows, kt, c0, c1):
    """Momentum of velocity gradients."""
    n, start, end = len(m), 0, 0
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            first = U(_node(base, frame, p))
            cx, cy = centre(base, w, knots, x, kt, p, 0), centre(base, w, knots, x, kt, p, 1)
            cz = centre(base, w, knots, x, kt, p, 2)
            for a in range(len(kt)):
                node, rx = first, knots[0, base[p, 0] + a + 1] - cx
                for b in range(len(kt)):
                    value, ry = m[p] * w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)], knots[1, base[p, 1] + b + 1] - cy
                    for d in range(len(kt)):
                        i, size, rz = node + U(d), value * w[p, 2, 0, U(d)], knots[2, base[p, 2] + d + 1] - cz
                        g[i, 0] += size * (slope[0, p] * rx + slope[1, p] * ry + slope[2, p] * rz)
                        g[i, 1] += size * (slope[3, p] * rx + slope[4, p] * ry + slope[5, p] * rz)
                        g[i, 2] += size * (slope[6, p] * rx + slope[7, p] * ry + slope[8, p] * rz)
                    node += row
                first += layer
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Internal force."""
    n, start, end = len(volume), 0, 0
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            sxx, syy, szz, sxy, syz, sxz = _stress(volume, sigma, p)
            first = U(_node(base, frame, p))
            for a in range(len(kt)):
                wx, dx, node = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)], first
                for b in range(len(kt)):
                    wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                    value, slopex, slopey = wx * wy, dx * wy, wx * dy
                    f1, s1 = slopex * sxx + slopey * sxy, value * sxz
                    f2, s2 = slopex * sxy + slopey * syy, value * syz
                    f3, s3 = slopex * sxz + slopey * syz, value * szz
                    for d in range(len(kt)):
                        i, wz, dz = node + U(d), w[p, 2, 0, U(d)], w[p, 2, 1, U(d)]
                        g[i, 0] += wz * f1 + dz * s1
                        g[i, 1] += wz * f2 + dz * s2
                        g[i, 2] += wz * f3 + dz * s3
                    node += row
                first += layer
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def interpolate(base, w, nodal, frame, out, kt, c0, c1):
    """Nodal vectors at the points."""
    n, row, layer = out.shape[1], U(frame[1, 1]), U(frame[1, 0])
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        first = U(_node(base, frame, p))
        vx = vy = vz = 0.0
        for a in range(len(kt)):
            node = first
            for b in range(len(kt)):
                plane = w[p, 0, 0, U(a)] * w[p, 1, 0, U(b)]
                for d in range(len(kt)):
                    value = plane * w[p, 2, 0, U(d)]
                    vx += value * nodal[node + U(d), 0]
                    vy += value * nodal[node + U(d), 1]
                    vz += value * nodal[node + U(d), 2]
                node += row
            first += layer
        out[0, p], out[1, p], out[2, p] = vx, vy, vz


@njit(**INLINE)
def _write(grad, p, dt, xx, xy, xz, yx, yy, yz, zx, zy, zz):
    grad[0, p], grad[1, p], grad[2, p] = dt * xx, dt * xy, dt * xz
    grad[3, p], grad[4, p], grad[5, p] = dt * yx, dt * yy, dt * yz
    grad[6, p], grad[7, p], grad[8, p] = dt * zx, dt * zy, dt * zz


@njit(**INLINE)
def _line(w, nodal, kt, p, node):
    """Sums along the last axis: velocity, its slope, and its change."""
    rx = ry = rz = sx = sy = sz = hx = hy = hz = 0.0
    for d in range(len(kt)):
        i, wz, dz = node + U(d), w[p, 2, 0, U(d)], w[p, 2, 1, U(d)]
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
    row, layer, first = U(frame[1, 1]), U(frame[1, 0]), U(_node(base, frame, p))
    vx = vy = vz = gx = gy = gz = xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    for a in range(len(kt)):
        wx, dx, node = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)], first
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
        first += layer
    return vx, vy, vz, gx, gy, gz, xx, xy, xz, yx, yy, yz, zx, zy, zz


@njit(**INLINE)
def move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    """New velocities and positions of a tile; its displacement gradient too if there is room for it."""
    workx = worky = workz = 0.0
    rest = 1 - flip
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        vx, vy, vz, gx, gy, gz, xx, xy, xz, yx, yy, yz, zx, zy, zz = _rates(base, w, nodal, frame, kt, p)
        v[0, p], v[1, p] = flip * (v[0, p] + gx) + rest * vx, flip * (v[1, p] + gy) + rest * vy
        v[2, p] = flip * (v[2, p] + gz) + rest * vz
        ahead[0, p], ahead[1, p], ahead[2, p] = x[0, p] + dt * vx, x[1, p] + dt * vy, x[2, p] + dt * vz
        workx += m[p] * (vx - gx / 2)
        worky += m[p] * (vy - gy / 2)
        workz += m[p] * (vz - gz / 2)
        if len(grad):
            _write(grad, at, dt, xx, xy, xz, yx, yy, yz, zx, zy, zz)
    limits[1], limits[2], limits[3] = workx, worky, workz
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
    row, layer = U(frame[1, 1]), U(frame[1, 0])
    for q in range(p0, p1):
        p = U(q)
        start = U(_node(base, frame, p))
        xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
        for a in range(len(kt)):
            wx, dx, node = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)], start
            for b in range(len(kt)):
                wy, dy = w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                value, slopex, slopey = wx * wy, dx * wy, wx * dy
                rx = ry = rz = sx = sy = sz = 0.0
                for d in range(len(kt)):
                    i, wz, dz = node + U(d), w[p, 2, 0, U(d)], w[p, 2, 1, U(d)]
                    nx, ny, nz = nodal[i, 0], nodal[i, 1], nodal[i, 2]
                    rx += wz * nx
                    ry += wz * ny
                    rz += wz * nz
                    sx += dz * nx
                    sy += dz * ny
                    sz += dz * nz
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
        _write(grad, U(q - first), dt, xx, xy, xz, yx, yy, yz, zx, zy, zz)


@njit(**OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, c0, c1):
    """Displacement gradient of all points over a step."""
    n = x.shape[1]
    slopes(base, w, nodal, frame, x, dt, hoop, grad, 0, kt, cut(n, c0), cut(n, c1))
