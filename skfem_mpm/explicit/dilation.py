r"""B-bar: dilation and mean stress of the points as means over cells, against volumetric locking.

With the mean :math:`A` of :mod:`skfem_mpm.integration.dilation` and
:math:`\bar B = B + \frac1d I (A - 1) \operatorname{tr} B` the force :math:`\sum V \bar B^T \sigma` takes the same mean
of the mean stress, and the operator stays symmetric.
"""

from __future__ import annotations

from numpy import ndarray

from ..grid import Grid
from ..integration.dilation import Means, shares_of
from .operators import Operators


class CellMeans(Means):
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
        super().__init__(shares_of(grid, mapping.stencil), volume)
        self.rows = [row for row, (i, j) in enumerate(mapping.rows) if i == j]

    def excess(self, rows: ndarray) -> ndarray:
        """What the diagonal of gradients or stresses ``(m, n)``, one row per gradient row, lacks of its cell mean."""
        return self.lack(rows[self.rows].mean(axis=0))

    def smooth(self, rows: ndarray) -> ndarray:
        """Gradients or stresses with the cell means of their diagonals."""
        rows = rows.copy()
        rows[self.rows] += self.excess(rows)
        return rows
