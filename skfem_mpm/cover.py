r"""Which part of the grid a body covers, and a quadrature of that part: what field integration integrates over.

Cells well inside the body are covered in full and have Gauss points.  Around them the domains of the points say what
is covered: parallelograms with edges :math:`E_p`, which the displacement carries along, :math:`E_p \leftarrow F_p E_p`.
They are cut into simplices and these at the grid lines, so each piece lies in one cell and polynomials are integrated
exactly over it.  Nothing needs to be known of the surface of the body; cells that hold no point are covered too where
a domain reaches into them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from skfem.quadrature import get_quadrature
from skfem.refdom import RefLine, RefTet, RefTri

from .checks import OutsideGridError
from .grid import Grid, gauss_points, touched_cells
from .kinematics.blocks import determinant
from .particles import Particles

SIMPLEX = {1: RefLine, 2: RefTri, 3: RefTet}
SLIVER = 1e-9        # grid lines closer to a piece's end than this, in cells, do not cut it
LOST = 1e-6          # share of a domain that may be outside the grid: rounding


class Cover:
    """Quadrature of what a body covers.

    Parts of the body, which have ``body`` numbers of their own or lie apart by a cell, cover cells for themselves: a
    *unit* is a cell as one part covers it.

    Parameters
    ----------
    grid
        The part of the mesh around the body.
    index
        ``(dim, n)``; host cells.
    particles
        The points; domains are their ``spans``, or boxes of edges ``length``.
    planes
        Fixed planes; what reaches behind one is mirrored.

    Attributes
    ----------
    part
        ``(n,)``; which part of the body each point belongs to.
    keys
        ``(units,)``; cell number times number of parts plus part, ascending.
    """

    def __init__(self, grid: Grid, index: ndarray, particles: Particles, planes: Sequence[Any] = ()):
        self.grid, self.index, self.particles, self.planes = grid, index, particles, planes
        self.cell = np.ravel_multi_index(tuple(index), grid.cells.shape)
        self.part = parts(grid, index, particles.fields.get("body"))
        self.nparts = int(self.part.max()) + 1
        self.key = self.cell * self.nparts + self.part
        occupied = np.unique(self.key)
        self.full = occupied[self._surrounded(occupied)]
        self.pieces, owner = self._pieces()
        middle = self.pieces.mean(axis=1)
        piece_cell = np.ravel_multi_index(tuple(grid.locate(middle)), grid.cells.shape)
        piece_key = piece_cell * self.nparts + self.part[owner]
        outer = ~np.isin(piece_key, self.full)
        self.pieces, self.owner, self.piece_key = self.pieces[:, :, outer], owner[outer], piece_key[outer]
        self.keys = np.union1d(self.full, self.piece_key)

    @property
    def cells(self) -> ndarray:
        """Cell of each unit, ``(units,)``."""
        return self.keys // self.nparts

    @property
    def covered(self) -> ndarray:
        """Mask over the cells, one index per axis."""
        mask = np.zeros(self.grid.cells.shape, dtype=bool)
        mask.ravel()[self.cells] = True
        return mask

    def find(self, keys: ndarray) -> ndarray:
        """Number of the unit with each key, -1 for none."""
        place = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[place] == keys, place, -1)

    def neighbours(self, reach: int) -> list[tuple[tuple[int, ...], ndarray]]:
        """For each offset to a cell within reach of the host the unit there of the same part, ``(n,)``; -1 for none."""
        shape = np.array(self.grid.cells.shape)[:, None]
        found = []
        for offset in itertools.product(range(-reach, reach + 1), repeat=self.grid.dim):
            place = self.index + np.array(offset)[:, None]
            inside = ((place >= 0) & (place < shape)).all(axis=0)
            cell = np.ravel_multi_index(tuple(place), self.grid.cells.shape, mode="clip")
            found.append((offset, np.where(inside, self.find(cell * self.nparts + self.part), -1)))
        return found

    def _surrounded(self, keys: ndarray) -> ndarray:
        """Which of some units have all cells around them among these, or behind a plane."""
        shape = self.grid.cells.shape
        behind, closed = np.zeros(shape, dtype=bool), self._closed()
        for plane in self.planes:
            behind |= touched_cells(plane.behind(self.grid).reshape(self.grid.vertices.shape))
        cell, part = np.divmod(keys, self.nparts)
        place = np.stack(np.unravel_index(cell, shape))
        full = np.ones(len(keys), dtype=bool)
        for offset in itertools.product((-1, 0, 1), repeat=self.grid.dim):
            other = place + np.array(offset)[:, None]
            beyond = np.stack([other < 0, other >= np.array(shape)[:, None]])
            number = np.ravel_multi_index(tuple(other), shape, mode="clip")
            known = behind.ravel()[number] | np.isin(number * self.nparts + part, keys)
            full &= np.where(beyond.any(axis=(0, 1)), (beyond & closed[:, :, None]).any(axis=(0, 1)), known)
        return full

    def _closed(self) -> ndarray:
        """Whether a plane stands where each axis starts and ends, ``(2, dim)``."""
        closed = np.zeros((2, self.grid.dim), dtype=bool)
        for plane in self.planes:
            axis = self.grid.axes[plane.axis]
            closed[:, plane.axis] |= np.abs(axis[[0, -1]] - plane.at) <= 1e-9 * np.diff(axis).min()
        return closed

    # -- pieces of domains -------------------------------------------------------------------------------------------

    def _pieces(self) -> tuple[ndarray, ndarray]:
        """Simplices ``(dim, dim + 1, m)`` of the domains near cut cells, each in one cell; and whose they are."""
        grid, points, dim = self.grid, self.particles, self.grid.dim
        edges = spans_of(points)
        reach = np.abs(edges).sum(axis=1) / 2
        deep = self.full                    # units that have only full ones within reach
        for _ in range(reach_in_cells(grid, points)):
            deep = deep[self._surrounded(deep)] if len(deep) else deep
        chosen = np.flatnonzero(~np.isin(self.key, deep))
        low, high = points.x[:, chosen] - reach[:, chosen], points.x[:, chosen] + reach[:, chosen]
        self._check_inside(chosen, low, high)
        pieces, owner = simplices(points.x[:, chosen], edges[:, :, chosen])
        owner = chosen[owner]
        for k in range(dim):
            pieces, owner = cut(pieces, owner, k, grid.axes[k])
        for plane in self.planes:
            beyond = plane.side * (pieces.mean(axis=1)[plane.axis] - plane.at) > 0
            pieces[plane.axis, :, beyond] = 2 * plane.at - pieces[plane.axis, :, beyond]
            pieces, owner = cut(pieces, owner, plane.axis, grid.axes[plane.axis])
        inside = ~grid.outside(pieces.mean(axis=1))
        return pieces[:, :, inside], owner[inside]

    def _check_inside(self, chosen: ndarray, low: ndarray, high: ndarray) -> None:
        """Refuse domains that leave the grid, but for rounding and at planes."""
        for k, axis in enumerate(self.grid.axes):
            slack = LOST * (high[k] - low[k])
            for beyond, closed in zip((low[k] < axis[0] - slack, high[k] > axis[-1] + slack), self._closed()[:, k]):
                if beyond.any() and not closed:
                    point = int(chosen[np.flatnonzero(beyond)[0]])
                    place = ", ".join(repr(float(value)) for value in self.particles.x[:, point])
                    raise OutsideGridError(f"the domain of point {point} at ({place}) leaves the grid "
                                           f"{self.grid.extent}; give the grid a spare layer of cells.")

    # -- quadrature --------------------------------------------------------------------------------------------------

    def quadrature(self, order: int) -> tuple[ndarray, ndarray, ndarray]:
        """Unit ``(g,)``, position ``(dim, g)`` and area weight ``(g,)`` of points that integrate a polynomial order.

        In axial symmetry the ring measure is the weight times the radius.  The pieces of a point add up to its volume.
        """
        inner, outer = self._of_full(order), self._of_pieces(order)
        return tuple(np.concatenate([a, b], axis=-1) for a, b in zip(inner, outer))    # type: ignore[return-value]

    def _of_full(self, order: int) -> tuple[ndarray, ndarray, ndarray]:
        cells = np.stack(np.unravel_index(self.full // self.nparts, self.grid.cells.shape))
        _, x, area = gauss_points(self.grid, cells, order)
        return np.repeat(self.find(self.full), area.size // max(1, self.full.size)), x, area

    def _of_pieces(self, order: int) -> tuple[ndarray, ndarray, ndarray]:
        points, dim = self.particles, self.grid.dim
        local, share = get_quadrature(SIMPLEX[dim], order)
        edges = self.pieces[:, 1:] - self.pieces[:, :1]
        area = np.abs(determinant(edges))
        x = self.pieces[:, 0, :, None] + np.einsum("ijm,jg->img", edges, local)
        owned = determinant(spans_of(points))
        if points.kinematics.hoop:
            owned = owned * points.x[0]
        scale = (points.volume / owned)[self.owner]
        unit = np.repeat(self.find(self.piece_key), len(share))
        return unit, x.reshape(dim, -1), ((area * scale)[:, None] * share).ravel()


def spans_of(points: Particles) -> ndarray:
    """Edges of the domains ``(dim, dim, n)``.

    Raises
    ------
    ValueError
        If the points have neither ``spans`` nor ``length``.
    """
    if points.spans is not None:
        return points.spans
    if points.length is None:
        raise ValueError("length: the points have none, but field integration needs their domains; give Particles a "
                         "length (dim, n) or spans (dim, dim, n).")
    return np.einsum("ij,jn->ijn", np.eye(points.dim), points.length)


def reach_in_cells(grid: Grid, points: Particles) -> int:
    """How many cells beyond the host's a domain may reach at most."""
    width = np.array([step.min() for step in grid.steps])[:, None]
    return max(1, math.ceil(float((np.abs(spans_of(points)).sum(axis=1) / 2 / width).max())))


def parts(grid: Grid, index: ndarray, body: ndarray | None) -> ndarray:
    """Part of the body each point belongs to, ``(n,)``: by its ``body`` number, then by cells that hang together."""
    from scipy.ndimage import label  # only what a run needs is loaded

    if body is not None and np.shape(body) != index.shape[1:]:
        raise ValueError(f"fields['body']: got shape {np.shape(body)}, expected {index.shape[1:]}, one number "
                         "per point that says which body it belongs to.")
    numbers = np.zeros(index.shape[1]) if body is None else body
    bodies, which = np.unique(numbers, return_inverse=True)
    found, count = np.empty(len(numbers), dtype=np.int64), 0
    for number in range(len(bodies)):
        own = index[:, which == number]
        pieces, many = label(grid.occupied(own), structure=np.ones((3,) * grid.dim))
        found[which == number] = pieces[tuple(own)] - 1 + count
        count += many
    return found


def simplices(x: ndarray, edges: ndarray) -> tuple[ndarray, ndarray]:
    """Simplices ``(dim, dim + 1, m)`` of parallelepipeds around ``x``, and which each is of."""
    dim, n = x.shape
    corner = x - edges.sum(axis=1) / 2
    found = [np.stack([corner + edges[:, list(order[:k])].sum(axis=1) for k in range(dim + 1)], axis=1)
             for order in itertools.permutations(range(dim))]
    return np.concatenate(found, axis=2), np.tile(np.arange(n), len(found))


def cut(pieces: ndarray, owner: ndarray, axis: int, lines: ndarray) -> tuple[ndarray, ndarray]:
    """Cut simplices at the grid lines of an axis.

    An edge with its ends on both sides of a line is split where they meet, which splits the simplex in two; that is
    repeated until no edge crosses.
    """
    done, whose = [pieces[:, :, :0]], [owner[:0]]
    slack = SLIVER * np.diff(lines).min()
    while pieces.shape[2]:
        along = pieces[axis]
        line = lines[np.minimum(np.searchsorted(lines, along.min(axis=0) + slack, side="right"), len(lines) - 1)]
        crossed = (along.min(axis=0) < line - slack) & (along.max(axis=0) > line + slack)
        done.append(pieces[:, :, ~crossed])
        whose.append(owner[~crossed])
        pieces, owner, along, line = pieces[:, :, crossed], owner[crossed], along[:, crossed], line[crossed]
        each = np.arange(len(owner))
        low, high = along.argmin(axis=0), along.argmax(axis=0)
        a, b = pieces[:, low, each], pieces[:, high, each]
        t = (line - a[axis]) / (b[axis] - a[axis])
        middle = a + t * (b - a)
        middle[axis] = line
        below, above = pieces.copy(), pieces.copy()
        below[:, high, each], above[:, low, each] = middle, middle
        pieces, owner = np.concatenate([below, above], axis=2), np.tile(owner, 2)
    return np.concatenate(done, axis=2), np.concatenate(whose)
