"""Two Gauss points per axis in whole cells: the quadrature of ordinary finite elements."""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from .grid import Grid

PLACES = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12)      # in a cell from 0 to 1; each has half of it


def gauss_points(grid: Grid, cells: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Gauss points of the cells ``(dim, m)``, those of a cell together, the last axis fastest.

    Returns
    -------
    index, x
        ``(dim, m * 2**dim)``; cells and positions.
    area
        ``(m * 2**dim,)``; weights, without a radius in axial symmetry.
    """
    dim = grid.dim
    index = np.repeat(cells, 2 ** dim, axis=1)
    place = np.tile(PLACES[np.indices((2,) * dim).reshape(dim, -1)], cells.shape[1])
    step = np.stack([grid.steps[k][index[k]] for k in range(dim)])
    first = np.stack([grid.axes[k][index[k]] for k in range(dim)])
    return index, first + place * step, step.prod(axis=0) / 2 ** dim
