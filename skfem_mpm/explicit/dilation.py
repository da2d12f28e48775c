r"""B-bar: dilation and mean stress of the points as means over cells, against volumetric locking.

The mean over cells is :math:`A = O W^{-1} O^T V` with the shares :math:`O_{pe}` that points have in cells (the host
cell alone for linear functions, overlaps for GIMP domains), volumes :math:`V` and :math:`W_e = \sum_p O_{pe} V_p`.  It
is its own transpose with respect to volumes, so with :math:`\bar B = B + \frac1d I (A - 1) \operatorname{tr} B` the
force :math:`\sum V \bar B^T \sigma` takes the same mean of the mean stress, and the operator stays symmetric.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..grid import Grid
from .operators import Operators


class CellMeans:
    """Means over cells of point quantities; made anew in every step.

    Parameters
    ----------
    grid
        The part of the mesh around the body.
    mapping
        Operators of the basis that maps mass: its slopes say how much of a domain is in which cell.
    volume
        ``(n,)``; of the points.
    """

    def __init__(self, grid: Grid, mapping: Operators, volume: ndarray):
        stencil, shape = mapping.stencil, grid.cells.shape
        cells = [np.clip(stencil.base[k] + np.arange(stencil.w.shape[2] - 1)[:, None], 0, size - 1)
                 for k, size in enumerate(shape)]
        # Along an axis the table holds means of hat functions over the domain: slopes are differences of share / width.
        share = [-np.cumsum(stencil.w[k, 1, :-1], axis=0) * grid.steps[k][cells[k]] for k in range(grid.dim)]
        cell, part = cells[0].T, share[0].T
        for k in range(1, grid.dim):
            cell = (cell[:, :, None] * shape[k] + cells[k].T[:, None]).reshape(len(cell), -1)
            part = (part[:, :, None] * share[k].T[:, None]).reshape(len(part), -1)
        start = np.arange(0, cell.size + 1, cell.shape[1])
        self.shares = csr_array((part.ravel(), cell.ravel(), start), shape=(len(cell), int(np.prod(shape))))
        self.volume = volume
        self.held = self.shares.T @ volume
        self.rows = [row for row, (i, j) in enumerate(mapping.rows) if i == j]

    def excess(self, rows: ndarray) -> ndarray:
        """What the diagonal of gradients or stresses ``(m, n)``, one row per gradient row, lacks of its cell mean."""
        mean = rows[self.rows].mean(axis=0)
        sums = self.shares.T @ (self.volume * mean)
        return self.shares @ np.divide(sums, self.held, out=sums, where=self.held > 0) - mean

    def smooth(self, rows: ndarray) -> ndarray:
        """Gradients or stresses with the cell means of their diagonals."""
        rows = rows.copy()
        rows[self.rows] += self.excess(rows)
        return rows
