"""Mapping to the grid and back in two dimensions.

``base (n, dim)`` and ``w (n, dim, 2, K)`` are stencils, on rings ``w (n, dim, 3, K)``, see
:class:`~skfem_mpm.grid.Stencil`; ``kt`` is a tuple of length K, ``frame`` first node and stride of the window of nodes
per axis.  ``rows`` holds the nodes along the first axis that each chunk may touch.  Points are added to ``copies``: a
grid for each chunk, to be summed after; or if there is only one, as is best for one thread, to ``out`` at once, one
chunk after the other.  ``nodal`` holds the velocity of nodes after the step and its change.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import band, closed, cut, finish, measure, opened
from .domains import centre, plain
from .options import APART, INLINE, OPTIONS, TILE

U = np.uint64


@njit(**INLINE)
def _steps(frame):
    """Nodes from one row to the next, and from the first node of all to that of the window."""
    return frame[1, 0], frame[0, 0] * frame[1, 0] + frame[0, 1]


@njit(**INLINE)
def _node(base, row, origin, p):
    return base[p, 0] * row + base[p, 1] - origin


@njit(**APART)
def _add(base, w, m, v, volume, sigma, x, hoop, row, origin, g, kt, p0, p1):
    """Mass, momentum and internal force of a range of points."""
    stride, mean = U(row), plain(w)
    for q in range(p0, p1):
        p = U(q)
        mass, size = m[p], -volume[p]
        mx, my = mass * v[0, p], mass * v[1, p]
        sxx, syy, sxy = size * sigma[0, p], size * sigma[1, p], size * sigma[3, p]
        node = U(_node(base, row, origin, p))
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            mw, ux, uy = wx * mass, wx * mx, wx * my
            c3, c4, c5, c6 = dx * sxx, dx * sxy, wx * sxy, wx * syy
            if len(hoop):
                c3 += w[p, 0, mean, U(a)] * (size * sigma[2, p] / x[0, p])
            for b in range(len(kt)):
                i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                g[i, 0] += wy * mw
                g[i, 1] += wy * ux
                g[i, 2] += wy * uy
                g[i, 3] += wy * c3 + dy * c5
                g[i, 4] += wy * c4 + dy * c6
            node += stride


@njit(**OPTIONS)
def p2g(base, w, m, v, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Mass, momentum and internal force."""
    n, start, end = len(m), 0, 0
    row, origin = _steps(frame)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        _add(base, w, m, v, volume, sigma, x, hoop, row, origin, g, kt, cut(n, c), cut(n, c + 1))
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_mass(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Mass and momentum."""
    n, start, end = len(m), 0, 0
    row, origin = _steps(frame)
    stride = U(row)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mass, node = m[p], U(_node(base, row, origin, p))
            mx, my = mass * v[0, p], mass * v[1, p]
            for a in range(len(kt)):
                wx = w[p, 0, 0, U(a)]
                mw, ux, uy = wx * mass, wx * mx, wx * my
                for b in range(len(kt)):
                    i, wy = node + U(b), w[p, 1, 0, U(b)]
                    g[i, 0] += wy * mw
                    g[i, 1] += wy * ux
                    g[i, 2] += wy * uy
                node += stride
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_momentum(base, w, m, v, frame, out, copies, rows, kt, c0, c1):
    """Momentum alone."""
    n, start, end = len(m), 0, 0
    row, origin = _steps(frame)
    stride = U(row)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            mx, my, node = m[p] * v[0, p], m[p] * v[1, p], U(_node(base, row, origin, p))
            for a in range(len(kt)):
                ux, uy = w[p, 0, 0, U(a)] * mx, w[p, 0, 0, U(a)] * my
                for b in range(len(kt)):
                    i, wy = node + U(b), w[p, 1, 0, U(b)]
                    g[i, 0] += wy * ux
                    g[i, 1] += wy * uy
                node += stride
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_tilt(base, w, m, slope, x, knots, frame, out, copies, rows, kt, c0, c1):
    """Momentum of velocity gradients ``slope (dim * dim, n)``."""
    n, start, end = len(m), 0, 0
    row, origin = _steps(frame)
    stride = U(row)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p, mass = U(q), m[q]
            xx, xy, yx, yy = mass * slope[0, p], mass * slope[1, p], mass * slope[2, p], mass * slope[3, p]
            node = U(_node(base, row, origin, p))
            cx, cy = centre(base, w, knots, x, kt, p, 0), centre(base, w, knots, x, kt, p, 1)
            for a in range(len(kt)):
                wx, rx = w[p, 0, 0, U(a)], knots[0, base[p, 0] + a + 1] - cx
                for b in range(len(kt)):
                    i, value, ry = node + U(b), wx * w[p, 1, 0, U(b)], knots[1, base[p, 1] + b + 1] - cy
                    g[i, 0] += value * (xx * rx + xy * ry)
                    g[i, 1] += value * (yx * rx + yy * ry)
                node += stride
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def p2g_force(base, w, volume, sigma, x, hoop, frame, out, copies, rows, kt, c0, c1):
    """Internal force."""
    n, start, end = len(volume), 0, 0
    row, origin = _steps(frame)
    stride, mean = U(row), plain(w)
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for q in range(cut(n, c), cut(n, c + 1)):
            p = U(q)
            size = -volume[p]
            sxx, syy, sxy = size * sigma[0, p], size * sigma[1, p], size * sigma[3, p]
            node = U(_node(base, row, origin, p))
            for a in range(len(kt)):
                wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
                c3, c4, c5, c6 = dx * sxx, dx * sxy, wx * sxy, wx * syy
                if len(hoop):
                    c3 += w[p, 0, mean, U(a)] * (size * sigma[2, p] / x[0, p])
                for b in range(len(kt)):
                    i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                    g[i, 0] += wy * c3 + dy * c5
                    g[i, 1] += wy * c4 + dy * c6
                node += stride
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def interpolate(base, w, nodal, frame, out, kt, c0, c1):
    """Nodal vectors at the points."""
    n = out.shape[1]
    row, origin = _steps(frame)
    stride = U(row)
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        node = U(_node(base, row, origin, p))
        vx = vy = 0.0
        for a in range(len(kt)):
            wx = w[p, 0, 0, U(a)]
            for b in range(len(kt)):
                value = wx * w[p, 1, 0, U(b)]
                vx += value * nodal[node + U(b), 0]
                vy += value * nodal[node + U(b), 1]
            node += stride
        out[0, p], out[1, p] = vx, vy


@njit(**INLINE)
def move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, grad, first, limits, kt, p0, p1):
    """New velocities and positions of a tile; its displacement gradient too if there is room for it.

    ``limits`` takes mass times mean velocity and what :func:`~skfem_mpm.kernels.chunks.measure` finds.
    """
    row, origin = _steps(frame)
    stride, mean, workx, worky = U(row), plain(w), 0.0, 0.0
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        node = U(_node(base, row, origin, p))
        vx = vy = mx = my = gx = gy = xx = xy = yx = yy = 0.0
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
            if len(hoop):
                mx, my = mx + w[p, 0, mean, U(a)] * rx, my + w[p, 0, mean, U(a)] * ry
            vx, vy = vx + wx * rx, vy + wx * ry
            gx, gy = gx + wx * hx, gy + wx * hy
            xx, xy = xx + dx * rx, xy + wx * sx
            yx, yy = yx + dx * ry, yy + wx * sy
            node += stride
        v[0, p], v[1, p] = flip * (v[0, p] + gx) + (1 - flip) * vx, flip * (v[1, p] + gy) + (1 - flip) * vy
        if not len(hoop):
            mx, my = vx, vy
        ahead[0, p], ahead[1, p] = x[0, p] + dt * mx, x[1, p] + dt * my
        workx += m[p] * (vx - gx / 2)
        worky += m[p] * (vy - gy / 2)
        if len(grad):
            grad[0, at], grad[1, at], grad[2, at], grad[3, at] = dt * xx, dt * xy, dt * yx, dt * yy
            if len(hoop):
                grad[4, at] = dt * mx / x[0, p]
    limits[1], limits[2] = workx, worky
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
    row, origin = _steps(frame)
    stride, mean = U(row), plain(w)
    for q in range(p0, p1):
        p, at = U(q), U(q - first)
        node = U(_node(base, row, origin, p))
        vx = xx = xy = yx = yy = 0.0
        for a in range(len(kt)):
            wx, dx = w[p, 0, 0, U(a)], w[p, 0, 1, U(a)]
            rx = ry = sx = sy = 0.0
            for b in range(len(kt)):
                i, wy, dy = node + U(b), w[p, 1, 0, U(b)], w[p, 1, 1, U(b)]
                nx, ny = nodal[i, 0], nodal[i, 1]
                rx += wy * nx
                ry += wy * ny
                sx += dy * nx
                sy += dy * ny
            vx += w[p, 0, mean, U(a)] * rx
            xx += dx * rx
            yx += dx * ry
            xy += wx * sx
            yy += wx * sy
            node += stride
        grad[0, at], grad[1, at], grad[2, at], grad[3, at] = dt * xx, dt * xy, dt * yx, dt * yy
        if len(hoop):
            grad[4, at] = dt * vx / x[0, p]


@njit(**OPTIONS)
def gradient(base, w, nodal, frame, x, dt, hoop, grad, kt, c0, c1):
    """Displacement gradient of all points over a step."""
    n = x.shape[1]
    slopes(base, w, nodal, frame, x, dt, hoop, grad, 0, kt, cut(n, c0), cut(n, c1))
