"""Means over cells for B-bar: compiled twin of :mod:`skfem_mpm.explicit.dilation`, in any dimension."""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import band, closed, cut, finish, opened
from .options import INLINE, OPTIONS

U = np.uint64


@njit(**INLINE)
def _shares(base, w, knots, kt, p, share):
    """Share of a point in each of the K - 1 cells along each axis: slopes of hat functions are share over width."""
    for k in range(base.shape[1]):
        total = 0.0
        for j in range(len(kt) - 1):
            total -= w[p, k, 1, j]
            cell = base[p, k] + j
            share[k, j] = max(total, 0.0) * (knots[k, cell + 2] - knots[k, cell + 1])


@njit(**INLINE)
def _piece(base, frame, kt, p, share, piece):
    """Number in the window of one of the cells that a point may be in, and its share there."""
    size, node, pieces = 1.0, 0, len(kt) - 1
    for k in range(base.shape[1]):
        j = piece % pieces
        piece //= pieces
        size *= share[k, j]
        node += (base[p, k] + j - frame[0, k]) * frame[1, k]
    return node, size


@njit(**OPTIONS)
def to_cells(base, w, volume, amount, knots, frame, out, copies, rows, kt, c0, c1):
    """Volumes, and volumes times an amount, shared among cells that are numbered by their first nodes."""
    n, start, end, share = len(volume), 0, 0, np.empty((base.shape[1], len(kt)))
    for c in range(c0, c1):
        low, high = band(rows, frame, c)
        g = opened(out, copies, c, low, high, start, end)
        for p in range(cut(n, c), cut(n, c + 1)):
            _shares(base, w, knots, kt, p, share)
            for piece in range((len(kt) - 1) ** base.shape[1]):
                node, size = _piece(base, frame, kt, p, share, piece)
                g[node, 0] += size * volume[p]
                g[node, 1] += size * volume[p] * amount[p]
        start, end = closed(out, copies, low, high, start, end)
    finish(out, copies, start, end)


@njit(**OPTIONS)
def excess(base, w, amount, knots, frame, cells, out, kt, c0, c1):
    """What an amount at the points lacks of its mean over cells."""
    n, share = len(amount), np.empty((base.shape[1], len(kt)))
    for p in range(cut(n, c0), cut(n, c1)):
        _shares(base, w, knots, kt, p, share)
        total = 0.0
        for piece in range((len(kt) - 1) ** base.shape[1]):
            node, size = _piece(base, frame, kt, p, share, piece)
            if cells[node, 0] > 0:
                total += size * cells[node, 1] / cells[node, 0]
        out[p] = total - amount[p]
