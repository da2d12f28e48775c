"""Moving points and updating their stress in one go, three dimensions: gradients stay in the cache."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, OPTIONS, TILE
from .stress import _elastic, _total, _turn3, _von_mises
from .transfer3 import _g2p


@njit(**OPTIONS)
def _elastic_chunk(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, lam, twice, rows,
                   t0, t1):
    grad = np.empty((9, TILE))
    for tile in range(t0, t1):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(m))
        _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, p0, limits[tile], kt, p0, p1)
        bad[tile, 0] = _turn3(sigma, grad, p0, volume, hoop, p0, p1)
        bad[tile, 1] = _elastic(grad, p0, sigma, lam, twice, rows, p0, p1)


@njit(parallel=True, **OPTIONS)
def elastic(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, lam, twice, rows):
    """Move points, then linear elasticity; ``limits`` and ``bad`` hold a row for each tile."""
    n = len(bad)
    for c in prange(CHUNKS):
        _elastic_chunk(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, lam, twice,
                       rows, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _von_mises_chunk(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, eps_p, constants,
                     work, rows, t0, t1):
    grad = np.empty((9, TILE))
    for tile in range(t0, t1):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(m))
        _g2p(base, w, nodal, frame, m, x, v, flip, dt, hoop, grad, p0, limits[tile], kt, p0, p1)
        bad[tile, 0] = _turn3(sigma, grad, p0, volume, hoop, p0, p1)
        bad[tile, 1] = _von_mises(grad, p0, sigma, eps_p, volume, constants, rows, p0, p1)
        work[tile] = _total(grad, p1 - p0)


@njit(parallel=True, **OPTIONS)
def von_mises(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, eps_p, constants, work,
              rows):
    """Move points, then von Mises plasticity."""
    n = len(bad)
    for c in prange(CHUNKS):
        _von_mises_chunk(base, w, nodal, frame, m, x, v, flip, dt, hoop, limits, bad, kt, sigma, volume, eps_p,
                         constants, work, rows, n * c // CHUNKS, n * (c + 1) // CHUNKS)
