"""Domains of points: stretched boxes, twin of :mod:`skfem_mpm.kinematics.domains`, and means over rings."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..kinematics.domains import LEAST
from .chunks import cut
from .options import INLINE, OPTIONS
from .stencil import number

U = np.uint64


@njit(**OPTIONS)
def stretch(grad, length, c0, c1):
    """Edges of boxes after the displacement gradient of a step."""
    dim, n = length.shape
    for q in range(cut(n, c0), cut(n, c1)):
        p = U(q)
        whole, product = 1 + grad[0, p], 1.0
        if dim == 2:
            whole = (1 + grad[0, p]) * (1 + grad[3, p]) - grad[1, p] * grad[2, p]
        elif dim == 3:
            xx, xy, xz, yx, yy, yz = grad[0, p], grad[1, p], grad[2, p], grad[3, p], grad[4, p], grad[5, p]
            zx, zy, zz = grad[6, p], grad[7, p], grad[8, p]
            whole = ((1 + xx) * ((1 + yy) * (1 + zz) - yz * zy) - xy * (yx * (1 + zz) - yz * zx)
                     + xz * (yx * zy - (1 + yy) * zx))
        for k in range(dim):
            product *= max(1 + grad[k * (dim + 1), p], LEAST)
        alike = (whole / product) ** (1 / dim)
        for k in range(dim):
            length[k, p] *= max(1 + grad[k * (dim + 1), p], LEAST) * alike


@njit(**OPTIONS)
def weigh_rings(x, length, knots, inverse, cell, frame, sides, w, c0, c1):
    """Put the radius into the means of GIMP along the first axis; row 2 of ``w`` takes the plain means of the value.

    Twin of :func:`skfem_mpm.shapes.ring_gimp`, after :func:`~skfem_mpm.kernels.stencil.fill_gimp_masked`.
    """
    n = x.shape[1]
    for p in range(cut(n, c0), cut(n, c1)):
        code, c = sides[number(cell, frame, p)], cell[p, 0]
        first, second, half = knots[0, c + 1], knots[0, c + 2], length[0, p] / 2
        start, end = x[0, p] - first - half, x[0, p] - second + half
        low, high = start if code & 1 else max(start, 0.0), end if code & 2 else min(end, 0.0)
        low, high = first + low, second + high                        # the domain that counts
        whole = (high - low) * (high + low) / 2
        inner0, inner1 = max(low, first), min(high, second)
        for j in range(4):
            w[p, 0, 2, j] = w[p, 0, 0, j]
        for j in range(4):
            w[p, 0, 0, j] = w[p, 0, 1, j] = 0.0
        _add_ring(w, p, 0, low, min(high, first), knots[0, c], first, inverse[0, c], whole)
        _add_ring(w, p, 1, inner0, inner1, first, second, inverse[0, c + 1], whole)
        _add_ring(w, p, 2, max(low, second), high, second, knots[0, c + 3], inverse[0, c + 2], whole)
        for j in range(4):
            if w[p, 0, 2, j] == 0:                                    # nodes that do not exist carry nothing
                w[p, 0, 0, j] = w[p, 0, 1, j] = 0.0


@njit(**INLINE)
def _add_ring(w, p, j, low, high, first, second, inverse, whole):
    """Add a piece from ``low`` to ``high`` of the cell between the nodes ``j`` and ``j + 1``."""
    size = high - low
    if size > 0:
        radius, share = (low + high) / 2, size / whole
        moment = share * size * size / 12 * inverse
        w[p, 0, 0, j] += share * radius * (second - radius) * inverse - moment
        w[p, 0, 0, j + 1] += share * radius * (radius - first) * inverse + moment
        w[p, 0, 1, j] -= share * radius * inverse
        w[p, 0, 1, j + 1] += share * radius * inverse


@njit(**INLINE)
def plain(w):
    """Which row of the first axis holds plain means of the value: that of the value, but on rings."""
    return U(2 * (w.shape[2] - 2))


@njit(**INLINE)
def centre(base, w, knots, x, kt, p, k):
    """Coordinate of the middle of a point's mass along axis ``k``: not its own on rings, nor where a domain is cut."""
    whole = shift = 0.0
    for a in range(len(kt)):
        shift += w[p, k, 0, a] * (knots[k, base[p, k] + a + 1] - x[k, p])
    if len(kt) > 2:                                                   # linear functions sum to one
        for a in range(len(kt)):
            whole += w[p, k, 0, a]
        shift /= whole
    return x[k, p] + shift


@njit(**OPTIONS)
def fit_slopes(base, w, knots, x, out, kt, c0, c1):
    """Copy ``w`` with the slopes of the affine field that comes nearest to what a point sees.

    Twin of :attr:`skfem_mpm.explicit.nodes.Nodes.fitted`.
    """
    n, dim = x.shape[1], len(x)
    for p in range(cut(n, c0), cut(n, c1)):
        for k in range(dim):
            middle, whole, moment, total = centre(base, w, knots, x, kt, p, k), 0.0, 0.0, 0.0
            for a in range(len(kt)):
                lever = knots[k, base[p, k] + a + 1] - middle
                part = w[p, k, 0, a] * lever
                whole += w[p, k, 0, a]
                moment += part * lever
                total += part
                out[p, k, 1, a] = part
            for a in range(len(kt)):
                value = w[p, k, 0, a]
                out[p, k, 0, a] = value
                out[p, k, 1, a] = (out[p, k, 1, a] - value * total / whole) / moment if moment > 0 else 0.0
                for row in range(2, w.shape[2]):
                    out[p, k, row, a] = w[p, k, row, a]
