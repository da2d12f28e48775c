"""Gauss points of whole cells: the quadrature of ordinary finite elements."""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from .grid import Grid

PLACES = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12)      # two in a cell from 0 to 1; each has half of it


def gauss_rule(dim: int, order: int) -> tuple[ndarray, ndarray]:
    """Places ``(dim, q)`` in the unit cell and shares ``(q,)`` of it that integrate an order, the last axis fastest."""
    xi, weight = np.polynomial.legendre.leggauss(order // 2 + 1)
    place = np.stack(np.meshgrid(*[(1 + xi) / 2] * dim, indexing="ij")).reshape(dim, -1)
    return place, np.prod(np.meshgrid(*[weight / 2] * dim, indexing="ij"), axis=0).ravel()


def gauss_points(grid: Grid, cells: ndarray, order: int = 3) -> tuple[ndarray, ndarray, ndarray]:
    """Gauss points of the cells ``(dim, m)``, two per axis for order 3: cell by cell, the last axis fastest.

    Returns
    -------
    index, x
        ``(dim, m * q)``; cells and positions.
    area
        ``(m * q,)``; weights, without a radius in axial symmetry.
    """
    place, share = gauss_rule(grid.dim, order)
    index = np.repeat(cells, len(share), axis=1)
    step = np.stack([grid.steps[k][index[k]] for k in range(grid.dim)])
    first = np.stack([grid.axes[k][index[k]] for k in range(grid.dim)])
    count = cells.shape[1]
    return index, first + np.tile(place, count) * step, step.prod(axis=0) * np.tile(share, count)
