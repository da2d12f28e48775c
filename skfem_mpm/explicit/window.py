"""The window of nodes around the body that the compiled engine works on."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from ..grid import Edges, Grid
from .nodes import MARGIN, mirrors


class Window:
    """Nodes around the cells ``low`` to ``high``, ``MARGIN`` cells wider.

    It may reach beyond the grid, where nodes stay empty.

    Attributes
    ----------
    frame
        ``(2, dim)``; first node and stride along each axis.
    fixed
        ``(nnodes, dim)``; which components stand still.
    around
        ``(dim, k)``; steps to the nodes across faces of the cells around a node, across edges, across corners, filled
        up with zeros.
    inside, outside, signs
        Pairs of nodes mirrored at planes, and the sign of each column of momentum and force, or of ``all_signs`` with
        mass before them.
    """

    def __init__(self, grid: Grid, low: ndarray, high: ndarray, planes: Sequence[Any], edges: Edges):
        dim = grid.dim
        first, shape = low - MARGIN, high - low + 2 + 2 * MARGIN
        stride = np.cumprod(np.concatenate([[1], shape[:0:-1]]))[::-1]
        self.frame = np.stack([first, stride]).astype(np.int64)
        self.nnodes = int(np.prod(shape))
        part = grid.window(np.stack([low, high], axis=1), MARGIN)
        clipped = tuple(slice(max(-f, 0), max(-f, 0) + size) for f, size in zip(first, part.vertices.shape))
        number = np.arange(self.nnodes).reshape(shape)[clipped].ravel()
        self.fixed = np.zeros((self.nnodes, dim))
        self.fixed[number] = np.any([plane.fixes(part) for plane in planes] or [np.zeros((dim, part.nnodes))], axis=0).T
        found = mirrors(part, planes)
        self.inside = np.concatenate([number[:0]] + [number[i] for i, _, _ in found])
        self.outside = np.concatenate([number[:0]] + [number[o] for _, o, _ in found])
        self.signs = np.concatenate([np.ones((0, 2 * dim))] + [np.tile(signs[:, 0], (len(i), 2))
                                                               for i, _, signs in found])
        self.all_signs = np.concatenate([np.ones((len(self.inside), 1)), self.signs], axis=1)
        self.no_signs = np.ones((len(self.inside), 1))
        self._neighbours(stride)
        self.sides = self._edge_sides(grid, first, shape, edges == "clip")

    def _neighbours(self, stride: ndarray) -> None:
        """Steps to the nodes around a node, the corners, faces and diagonals of a cell."""
        dim = len(stride)
        around = [np.array(offset) for offset in itertools.product((-1, 0, 1), repeat=dim)]
        rows = [[offset @ stride for offset in around if np.count_nonzero(offset) == away]
                for away in range(1, dim + 1)]
        widest = max(len(row) for row in rows)
        self.around = np.array([row + [0] * (widest - len(row)) for row in rows])
        self.corners = np.array([np.array(offset) @ stride for offset in itertools.product((0, 1), repeat=dim)])
        self.faces = np.array([sign * stride[k] for k in range(dim) for sign in (-1, 1)])
        self.diagonals = np.array([(offset @ stride, sum(1 << (2 * k + (o > 0)) for k, o in enumerate(offset) if o))
                                   for offset in around if np.count_nonzero(offset) > 1], dtype=np.int64).reshape(-1, 2)

    def _edge_sides(self, grid: Grid, first: ndarray, shape: ndarray, clip: bool) -> ndarray:
        """Sides of cells that are there, but for those at the edge of the grid if domains are clipped."""
        code = np.full(shape, 4 ** len(shape) - 1, dtype=np.uint8)
        for k, cells in enumerate(grid.cells.shape if clip else ()):
            cell = first[k] + np.arange(shape[k])
            bits = np.where(cell <= 0, 1 << 2 * k, 0) | np.where(cell >= cells - 1, 2 << 2 * k, 0)
            code &= ~bits.astype(np.uint8).reshape([-1 if j == k else 1 for j in range(len(shape))])
        return code.ravel()
