r"""What a body covers in an explicit step: cells that hold points, seen through boxes.

Nodes without mass cannot take force, so only cells that hold points count.  Those with points in all cells around them
(or a fixed plane, or the end of the grid) are covered in full and have Gauss points.  What the others hold is made of
the boxes of the points, cut at the cell faces: a piece is a product of intervals.  Pieces in cells without points are
dropped, and the point's others grow until they have its whole volume.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from ..cover import Cover
from ..grid import Grid, gauss_rule
from ..kinematics import Kinematics
from ..shapes import pieces


class Boxes(NamedTuple):
    """Points and their boxes along the axes.

    Attributes
    ----------
    x, length
        ``(dim, n)``; middles and edges.
    volume
        ``(n,)``.
    kinematics
        Whether volumes are those of rings.
    """

    x: ndarray
    length: ndarray
    volume: ndarray
    kinematics: Kinematics

    @property
    def n(self) -> int:
        """Number of points."""
        return self.x.shape[1]


class BoxCover(Cover):
    """Quadrature of the cells that hold points; a body is one, whatever its parts.

    Parameters
    ----------
    grid
        The part of the mesh around the body.
    index
        ``(dim, n)``; host cells.
    points
        The points; a box that reaches beyond the neighbours of its cell is cut off there, at both ends alike.
    planes
        Fixed planes; a cell behind one counts as held.
    """

    def __init__(self, grid: Grid, index: ndarray, points: Any, planes: Sequence[Any] = ()):
        self.grid, self.index, self.particles, self.planes = grid, index, points, planes
        self.part, self.nparts = np.zeros(points.n, dtype=np.int64), 1
        self.keys = np.unique(np.ravel_multi_index(tuple(index), grid.cells.shape))
        self.full = self.keys[self._surrounded(self.keys)]

    def _of_pieces(self, order: int) -> tuple[ndarray, ndarray, ndarray]:
        owner, unit, middle, edges = self._cut_boxes()
        size = edges.prod(axis=0)
        whole = size * middle[0] if self.particles.kinematics.hoop else size
        held = np.bincount(owner, weights=whole, minlength=self.particles.n)
        outer = ~np.isin(self.keys[unit], self.full)
        owner, unit, middle, edges, size = owner[outer], unit[outer], middle[:, outer], edges[:, outer], size[outer]
        scale = (self.particles.volume / held)[owner]
        place, share = gauss_rule(self.grid.dim, order)
        x = middle[:, :, None] + edges[:, :, None] * (place - 0.5)[:, None]
        return np.repeat(unit, len(share)), x.reshape(len(x), -1), ((size * scale)[:, None] * share).ravel()

    def _cut_boxes(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Pieces of boxes in cells that hold points: whose, in which unit, middle and edges ``(dim, m)``."""
        grid, points = self.grid, self.particles
        length = grid.fitting(points.x, self.index, np.asarray(points.length))
        edge, middle = np.empty((2, grid.dim, 3, points.n))
        for k in range(grid.dim):
            knots = grid.knots(k, self.index[k])
            share, local = pieces(points.x[k], length[k] / 2, knots)
            edge[k], middle[k] = share * length[k], knots[:-1] + local * np.diff(knots, axis=0)
        found = []
        for (_, unit), place in zip(self.neighbours(1), itertools.product(range(3), repeat=grid.dim)):
            size = np.stack([edge[k, j] for k, j in enumerate(place)])
            owner = np.flatnonzero((unit >= 0) & (size > 0).all(axis=0))
            found.append((owner, unit[owner], np.stack([middle[k, j] for k, j in enumerate(place)])[:, owner],
                          size[:, owner]))
        return tuple(np.concatenate(rows, axis=-1) for rows in zip(*found))    # type: ignore[return-value]
