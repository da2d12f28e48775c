"""The axis-aligned view of a scikit-fem mesh: where points are, and the stencils that they see."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy import ndarray
from skfem import Mesh

from .. import shapes
from ..checks import OutsideGridError, check_choice
from .masks import available_sides
from .stencil import Stencil, chunks
from .view import view

Edges = Literal["ghost", "truncate", "clip"]
EDGES = ("ghost", "truncate", "clip")
Fill = Callable[[int, slice, ndarray], tuple[ndarray, ...]]


@dataclass(frozen=True, eq=False)
class Grid:
    """A tensor grid: the axes, and where its nodes and cells stand in the mesh.

    Attributes
    ----------
    axes
        Node coordinates along each axis, ascending.
    vertices
        Mesh vertex of each node, one index per axis.
    cells
        Mesh cell of each cell, one index per axis.

    Examples
    --------
    >>> from skfem import MeshQuad
    >>> grid = Grid.from_mesh(MeshQuad().refined(2))
    >>> grid.cells.shape, grid.locate(np.array([[0.3], [1.0]])).T.tolist()
    ((4, 4), [[1, 3]])
    """

    axes: tuple[ndarray, ...]
    vertices: ndarray
    cells: ndarray

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> Grid:
        """View an axis-aligned line, quad or hex mesh as a tensor grid, whatever its numbering.

        Raises
        ------
        ValueError
            If the mesh is of another kind, not axis-aligned, or not a full box.
        """
        found = _GRIDS.get(id(mesh))
        if found is None:
            found = _GRIDS[id(mesh)] = cls(*view(mesh))
            weakref.finalize(mesh, _GRIDS.pop, id(mesh), None)
        return found

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def nnodes(self) -> int:
        """Number of nodes."""
        return self.vertices.size

    @cached_property
    def steps(self) -> tuple[ndarray, ...]:
        """Cell widths along each axis."""
        return tuple(np.diff(axis) for axis in self.axes)

    @cached_property
    def _even(self) -> tuple[tuple[float, float] | None, ...]:
        """For axes with equal cells their width, and how far a face may be from where that puts it, in widths."""
        return tuple(_evenness(axis, step) for axis, step in zip(self.axes, self.steps))

    @cached_property
    def _knots(self) -> tuple[ndarray, ...]:
        """The axes with one more node at either end, mirrored: what Eq. (6) sees where nodes do not exist."""
        return tuple(np.concatenate([[2 * axis[0] - axis[1]], axis, [2 * axis[-1] - axis[-2]]]) for axis in self.axes)

    def knots(self, k: int, cell: ndarray) -> ndarray:
        """The four nodes around cells along axis ``k``, ``(4, n)``: their own two and one of each neighbour."""
        knots = self._knots[k]
        return np.stack([knots[j:].take(cell) for j in range(4)])

    def locate(self, x: ndarray) -> ndarray:
        """Cell of each point, ``(dim, n)``: cells hold their first faces, the last ones also their last.

        Raises
        ------
        OutsideGridError
            If a point is outside; the message names the first one.
        """
        index = np.empty(x.shape, dtype=np.int64)
        for part in chunks(x.shape[1]):
            for k, axis in enumerate(self.axes):
                index[k, part] = _find(axis, self._even[k], x[k, part])
        if (index < 0).any():
            point = int(np.flatnonzero((index < 0).any(axis=0))[0])
            raise OutsideGridError(f"point {point} is at {_position(x[:, point])}, outside the grid {self.extent}; "
                                   "use a larger mesh or smaller steps.")
        return index

    def check_dim(self, dim: int) -> None:
        """Refuse points in another dimension."""
        if dim != self.dim:
            raise ValueError(f"particles: got points in {dim} dimension(s) on a mesh in {self.dim}; make both of the "
                             "same dimension.")

    def outside(self, x: ndarray, length: ndarray | None = None) -> ndarray:
        """Which points ``(dim, n)`` are outside, or do not have their whole domain inside."""
        half = 0.0 if length is None else length * (0.5 - 1e-12)      # a domain that ends on the edge may round over it
        low, high = (np.array([[axis[end]] for axis in self.axes]) for end in (0, -1))
        return np.logical_not(((x - half >= low) & (x + half <= high)).all(axis=0))

    @property
    def extent(self) -> str:
        """The box it covers, in words."""
        return " x ".join(f"[{axis[0]:g}, {axis[-1]:g}]" for axis in self.axes)

    def occupied(self, index: ndarray) -> ndarray:
        """Which cells hold a point, one index per axis; ``index`` comes from :meth:`locate`."""
        mask = np.zeros(self.cells.shape, dtype=bool)
        mask[tuple(index)] = True
        return mask

    def window(self, index: ndarray, margin: int = 2) -> Grid:
        """The part of the grid around the cells ``index``, ``margin`` cells wider; all that a body there can feel."""
        low = np.maximum(index.min(axis=1) - margin, 0)
        high = np.minimum(index.max(axis=1) + margin + 1, self.cells.shape)
        nodes = tuple(slice(a, b + 1) for a, b in zip(low, high))
        cells = tuple(slice(a, b) for a, b in zip(low, high))
        return Grid(tuple(axis[s] for axis, s in zip(self.axes, nodes)), self.vertices[nodes], self.cells[cells])

    def linear(self, x: ndarray, index: ndarray) -> Stencil:
        """Finite element stencil of points in the cells ``index``."""
        return self._stencil(x, index, 2, lambda k, part, knots: shapes.linear(x[k, part], knots))

    def cmpm(self, x: ndarray, index: ndarray, sides: ndarray) -> Stencil:
        """CMPM stencil; ``sides`` from :func:`available_sides`."""
        def fill(k: int, part: slice, knots: ndarray) -> tuple[ndarray, ndarray]:
            left, right = (sides[side, k][tuple(index[:, part])] for side in (0, 1))
            return shapes.cmpm(x[k, part], knots, left, right)

        return self._stencil(x, index, 4, fill)

    def cubic(self, x: ndarray, index: ndarray, sides: ndarray) -> Stencil:
        """CMPM stencil whose patches keep four nodes per axis at edges too where the body is three cells wide.

        Along an axis with one neighbour, its other neighbour joins in if ``sides`` make both available to all cells of
        the patch.
        """
        shift = self._inwards(index, sides)
        w = np.empty((self.dim, 2, 4, x.shape[1]))
        for k, size in enumerate(self.cells.shape):
            left, right = (sides[side, k][tuple(index)] | (shift[k] != 0) for side in (0, 1))
            w[k] = shapes.cmpm(x[k], self.knots(k, index[k] + shift[k]), left, right)
            for j, missing in ((0, index[k] + shift[k] == 0), (3, index[k] + shift[k] == size - 1)):
                w[k, :, j, missing] = 0
        return Stencil(index - 1 + shift, w, self.vertices.shape)

    def _inwards(self, index: ndarray, sides: ndarray) -> ndarray:
        """How far along each axis the patch of each cell moves inwards, -1, 0 or 1, ``(dim, n)``."""
        shift = np.zeros_like(index)
        for k, size in enumerate(self.cells.shape):
            left, right = sides[:, k]
            for sign, open_side, other in ((1, right & ~left, 1), (-1, left & ~right, 0)):
                beyond = np.roll(sides[other, k], -sign, axis=k)           # never taken from across the grid's edge
                same = [np.roll(sides[side, j], -sign, axis=k) >= sides[side, j]
                        for j in range(self.dim) if j != k for side in (0, 1)]
                possible = open_side & beyond & np.logical_and.reduce([np.ones_like(beyond), *same])
                shift[k] += sign * possible[tuple(index)]
        middle, host = sides[(..., *(index + shift))], sides[(..., *index)]
        return shift * (middle >= (host | (shift != 0))).all(axis=(0, 1))      # where axes meet, all of the patch

    def gimp(self, x: ndarray, index: ndarray, length: ndarray, edges: Edges = "ghost",
             sides: ndarray | None = None, ring: bool = False) -> Stencil:
        """GIMP stencil of points with domains of edges ``length (dim, n)``.

        Parameters
        ----------
        edges
            What happens to a domain that leaves the grid: ``ghost`` refuses (give the grid a spare layer of cells),
            ``truncate`` drops nodes that do not exist from Eq. (6), ``clip`` cuts the domain off and renormalises.
        sides
            From :func:`available_sides`, to clip domains to the available cells as well.
        ring
            Whether domains are rings, the first coordinate being a radius that is part of the mean; see
            :func:`skfem_mpm.shapes.ring_gimp`.

        Raises
        ------
        ValueError
            If a domain reaches beyond the neighbours of its cell.
        OutsideGridError
            If a domain leaves the grid and ``edges`` is ``ghost``.
        """
        check_choice("edges", edges, EDGES)
        self.check_reach(x, index, length, edges if sides is None else "clip")
        if sides is None and edges == "clip":
            sides = available_sides(np.ones(self.cells.shape, dtype=bool))

        def fill(k: int, part: slice, knots: ndarray) -> tuple[ndarray, ...]:
            left, right = (True, True) if sides is None else (sides[side, k][tuple(index[:, part])] for side in (0, 1))
            domain = (x[k, part], length[k, part] / 2, knots, left, right)
            if ring and k == 0:
                return shapes.ring_gimp(*domain)
            value, slope = shapes.gimp(*domain)
            return (value, slope, value) if ring else (value, slope)

        return self._stencil(x, index, 3, fill)

    def _stencil(self, x: ndarray, index: ndarray, width: int, fill: Fill) -> Stencil:
        """Table of the functions that ``fill`` makes: the host's two, all four, or three of the four.

        Three leave out the first or the last; if a domain reaches into both neighbours, it is four for all points.
        """
        base = index - (width > 2)
        w: ndarray = np.empty(0)
        for part in chunks(x.shape[1]):
            for k, size in enumerate(self.cells.shape):
                cell = index[k, part]
                tables = fill(k, part, self.knots(k, cell))
                if width > 2:
                    for j, missing in ((0, cell == 0), (3, cell == size - 1)):      # nodes that do not exist
                        for table in tables:
                            table[j][missing] = 0
                if width == 3:
                    slope = tables[1]
                    shift = slope[0] == 0
                    if not (shift | (slope[3] == 0)).all():
                        return self._stencil(x, index, 4, fill)
                    base[k, part] += shift
                    tables = tuple(np.where(shift, table[1:], table[:3]) for table in tables)
                if not w.size:
                    w = np.empty((self.dim, len(tables), width, x.shape[1]))
                for row, table in enumerate(tables):
                    w[k, row, :, part] = table
        return Stencil(base, w, self.vertices.shape)

    def fitting(self, x: ndarray, index: ndarray, length: ndarray) -> ndarray:
        """Domains cut off, at both ends alike, to what lies within the neighbours of their cells, ``(dim, n)``."""
        near = [np.minimum(x[k] - knots[index[k]], knots[index[k] + 3] - x[k]) for k, knots in enumerate(self._knots)]
        return np.minimum(length, 2 * np.stack(near))

    def check_reach(self, x: ndarray, index: ndarray, length: ndarray, edges: str) -> None:
        """Refuse domains that reach beyond the neighbours of their cell, or off the grid with ``ghost`` edges."""
        for k, knots in enumerate(self._knots):
            low, high = x[k] - length[k] / 2, x[k] + length[k] / 2
            slack = 1e-12 * length[k]                     # a domain that ends on a face may round to either side
            far = (low < knots[index[k]] - slack) | (high > knots[index[k] + 3] + slack)
            if far.any():
                point = int(np.flatnonzero(far)[0])
                raise ValueError(
                    f"length: the domain of point {point} at {_position(x[:, point])} is {length[k, point]:g} long "
                    f"along axis {k} and reaches beyond the neighbours of its cell, which GIMP's four nodes per axis "
                    "do not allow; use smaller domains or larger cells.")
        out = self.outside(x, length) if edges == "ghost" else np.zeros(0)
        if out.any():
            point = int(np.flatnonzero(out)[0])
            raise OutsideGridError(
                f"the domain of point {point} at {_position(x[:, point])} leaves the grid {self.extent}; give the "
                "grid a spare layer of cells, or choose edges='clip' or edges='truncate'.")


_GRIDS: dict[int, Grid] = {}


def _evenness(axis: ndarray, step: ndarray) -> tuple[float, float] | None:
    """Width of equal cells, and how far a face may be from where that puts it, in widths; None if they differ."""
    width = (axis[-1] - axis[0]) / len(step)
    away = np.abs((axis - axis[0]) / width - np.arange(len(axis))).max() + 1e-9
    return (width, 2 * away) if away < 0.1 else None


def _find(axis: ndarray, even: tuple[float, float] | None, x: ndarray) -> ndarray:
    """Host cell along one axis, -1 outside: by arithmetic where cells are equal, by true faces close to them."""
    inside = (x >= axis[0]) & (x <= axis[-1])             # false for NaN too
    if even is None:
        cell = np.searchsorted(axis, x, side="right") - 1
    else:
        width, away = even
        place = np.where(inside, (x - axis[0]) / width, 0.0)
        cell = place.astype(np.int64)
        near = np.flatnonzero(np.abs(place - np.rint(place)) < away)
        cell[near] = np.searchsorted(axis, x[near], side="right") - 1
    cell = np.minimum(cell, len(axis) - 2, out=cell)      # the last cell holds its last face
    cell[~inside] = -1
    return cell


def _position(x: ndarray) -> str:
    return "(" + ", ".join(repr(float(value)) for value in x) + ")"    # every digit: it may be just outside
