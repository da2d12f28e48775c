"""Stress of all points in three dimensions: gradient and law tile by tile, so gradients stay in the cache.

``moved_`` kernels move points with the grid too, for where one stencil serves both; ``mapped_`` ones only take the
gradient of nodal velocities; ``given_`` ones are given it.  ``limits`` and ``bad`` hold a row for each tile.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .chunks import cut
from .options import OPTIONS, TILE
from .stress import elastic3, total, turn3, von_mises
from .transfer3 import move, slopes


@njit(**OPTIONS)
def moved_elastic(base, w, nodal, frame, m, x, ahead, v, flip, dt, limits, kt, sigma, volume, hoop, lam, twice, bad,
                  c0, c1):
    """Move points, then linear elasticity."""
    n, grad = len(m), np.empty((9, TILE))
    for t in range(cut(n, c0), cut(n, c1), TILE):
        tile, end = t // TILE, min(t + TILE, n)
        move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, grad, t, limits[tile], kt, t, end)
        elastic3(sigma, grad, t, volume, hoop, bad[tile], lam, twice, t, end)


@njit(**OPTIONS)
def mapped_elastic(base, w, nodal, frame, x, dt, kt, sigma, volume, hoop, lam, twice, bad, c0, c1):
    """Linear elasticity with the gradient of nodal velocities."""
    n, grad = len(volume), np.empty((9, TILE))
    for t in range(cut(n, c0), cut(n, c1), TILE):
        end = min(t + TILE, n)
        slopes(base, w, nodal, frame, x, dt, hoop, grad, t, kt, t, end)
        elastic3(sigma, grad, t, volume, hoop, bad[t // TILE], lam, twice, t, end)


@njit(**OPTIONS)
def given_elastic(grad, sigma, volume, hoop, lam, twice, bad, c0, c1):
    """Linear elasticity with given displacement gradients."""
    n = len(volume)
    for t in range(cut(n, c0), cut(n, c1), TILE):
        elastic3(sigma, grad, 0, volume, hoop, bad[t // TILE], lam, twice, t, min(t + TILE, n))


@njit(**OPTIONS)
def moved_von_mises(base, w, nodal, frame, m, x, ahead, v, flip, dt, limits, kt, sigma, volume, hoop, eps_p, constants,
                    work, rows, bad, c0, c1):
    """Move points, then von Mises plasticity; ``work (tiles,)`` takes the energy that plastic flow takes."""
    n, grad = len(m), np.empty((9, TILE))
    for t in range(cut(n, c0), cut(n, c1), TILE):
        tile, end = t // TILE, min(t + TILE, n)
        move(base, w, nodal, frame, m, x, ahead, v, flip, dt, hoop, grad, t, limits[tile], kt, t, end)
        turn3(sigma, grad, t, volume, hoop, bad[tile], t, end)
        von_mises(grad, t, sigma, eps_p, volume, constants, bad[tile], rows, t, end)
        work[tile] = total(grad[0], 0, end - t)


@njit(**OPTIONS)
def mapped_von_mises(base, w, nodal, frame, x, dt, kt, sigma, volume, hoop, eps_p, constants, work, rows, bad, c0, c1):
    """Von Mises plasticity with the gradient of nodal velocities."""
    n, grad = len(volume), np.empty((9, TILE))
    for t in range(cut(n, c0), cut(n, c1), TILE):
        tile, end = t // TILE, min(t + TILE, n)
        slopes(base, w, nodal, frame, x, dt, hoop, grad, t, kt, t, end)
        turn3(sigma, grad, t, volume, hoop, bad[tile], t, end)
        von_mises(grad, t, sigma, eps_p, volume, constants, bad[tile], rows, t, end)
        work[tile] = total(grad[0], 0, end - t)


@njit(**OPTIONS)
def given_von_mises(grad, sigma, volume, hoop, eps_p, constants, work, rows, bad, c0, c1):
    """Von Mises plasticity with given displacement gradients, which it uses up."""
    n = len(volume)
    for t in range(cut(n, c0), cut(n, c1), TILE):
        tile, end = t // TILE, min(t + TILE, n)
        turn3(sigma, grad, 0, volume, hoop, bad[tile], t, end)
        von_mises(grad, 0, sigma, eps_p, volume, constants, bad[tile], rows, t, end)
        work[tile] = total(grad[0], t, end)
