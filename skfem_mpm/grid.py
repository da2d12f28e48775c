"""The axis-aligned view of a scikit-fem mesh: where points are, which cells they occupy, and the stencil table."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy import ndarray
from skfem import Mesh, MeshHex1, MeshLine1, MeshQuad1

from . import shapes
from .checks import OutsideGridError, check_choice

Edges = Literal["ghost", "truncate", "clip"]
EDGES = ("ghost", "truncate", "clip")
CHUNK = 8192    # points handled at once: what they need then stays in the cache, and cost per point does not grow


def chunks(n: int) -> Iterator[slice]:
    """Cut ``n`` points into pieces that fit the cache."""
    return (slice(start, min(start + CHUNK, n)) for start in range(0, n, CHUNK))


def scatter_add(out: ndarray, index: ndarray, values: ndarray) -> None:
    """Add ``values`` to ``out`` at ``index``, repeated entries included; touches only the range that occurs."""
    low = index.min()
    sums = np.bincount((index - low).ravel(), weights=values.ravel())
    out[low:low + len(sums)] += sums


@dataclass(frozen=True, eq=False)
class Stencil:
    """For each point the nodes it sees, with value and slope, as one factor per axis.

    Nodes are numbered along the axes of the grid, the last axis fastest.

    Attributes
    ----------
    base
        ``(dim, n)``; first node of each point along each axis.
    w
        ``(dim, 2, K, n)``; value (0) and slope (1) of its ``K`` nodes along each axis.
    shape
        Number of nodes along each axis.
    """

    base: ndarray
    w: ndarray
    shape: tuple[int, ...]

    @property
    def n(self) -> int:
        """Number of points."""
        return self.base.shape[1]

    def nodes(self, part: slice = slice(None)) -> ndarray:
        """Nodes seen by the points, ``(K**dim, n)``; nodes off the grid have zero weight and repeat one on it."""
        width = self.w.shape[2]
        per_axis = [np.clip(self.base[k, part] + np.arange(width)[:, None], 0, self.shape[k] - 1)
                    for k in range(len(self.shape))]
        index = per_axis[0]
        for k in range(1, len(self.shape)):
            index = (index[:, None] * self.shape[k] + per_axis[k]).reshape(-1, index.shape[1])
        return index

    def value(self, part: slice = slice(None)) -> ndarray:
        """Shape functions, ``(K**dim, n)``."""
        return _outer([self.w[k, 0, :, part] for k in range(len(self.shape))])

    def gradient(self, part: slice = slice(None)) -> ndarray:
        """Their gradients, ``(dim, K**dim, n)``."""
        dim = len(self.shape)
        return np.stack([_outer([self.w[k, int(k == axis), :, part] for k in range(dim)]) for axis in range(dim)])

    def to_nodes(self, amount: ndarray) -> ndarray:
        """Share point amounts ``(n,)`` among the nodes by their functions, ``(nnodes,)``: lumped mass from mass."""
        out = np.zeros(int(np.prod(self.shape)))
        for part in chunks(self.n):
            scatter_add(out, self.nodes(part), self.value(part) * amount[part])
        return out

    def to_points(self, nodal: ndarray) -> ndarray:
        """Interpolate nodal vectors ``(dim, nnodes)`` to the points, ``(dim, n)``."""
        out = np.empty((len(nodal), self.n))
        for part in chunks(self.n):
            nodes, value = self.nodes(part), self.value(part)
            for i, row in enumerate(nodal):
                out[i, part] = np.einsum("kn,kn->n", value, row[nodes])
        return out


def _outer(factors: Sequence[ndarray]) -> ndarray:
    product = factors[0]
    for factor in factors[1:]:
        product = (product[:, None] * factor).reshape(-1, product.shape[1])
    return product


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
            found = _GRIDS[id(mesh)] = _view(mesh)
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
    def _knots(self) -> tuple[ndarray, ...]:
        """The axes with one more node at either end, mirrored: what Eq. (6) sees where nodes do not exist."""
        return tuple(np.concatenate([[2 * axis[0] - axis[1]], axis, [2 * axis[-1] - axis[-2]]]) for axis in self.axes)

    def knots(self, k: int, cell: ndarray) -> ndarray:
        """The four nodes around cells along axis ``k``, ``(4, n)``: their own two and one of each neighbour."""
        return self._knots[k][cell + np.arange(4)[:, None]]

    def locate(self, x: ndarray) -> ndarray:
        """Cell of each point, ``(dim, n)``: cells hold their first faces, the last ones also their last.

        Raises
        ------
        OutsideGridError
            If a point is outside; the message names the first one.
        """
        index = np.empty(x.shape, dtype=np.int64)
        for part in chunks(x.shape[1]):
            for k, (axis, step) in enumerate(zip(self.axes, self.steps)):
                index[k, part] = _find(axis, step, x[k, part])
        if (index < 0).any():
            point = int(np.flatnonzero((index < 0).any(axis=0))[0])
            raise OutsideGridError(f"point {point} is at {_position(x[:, point])}, outside the grid {self.extent}; "
                                   "use a larger mesh or smaller steps.")
        return index

    def outside(self, x: ndarray, length: ndarray | None = None) -> ndarray:
        """Which points ``(dim, n)`` are outside, or do not have their whole domain inside."""
        half = 0.0 if length is None else length * (0.5 - 1e-12)      # a domain that ends on the edge may round over it
        low, high = (np.array([[axis[end]] for axis in self.axes]) for end in (0, -1))
        return ~((x - half >= low) & (x + half <= high)).all(axis=0)

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

    def gimp(self, x: ndarray, index: ndarray, length: ndarray, edges: Edges = "ghost",
             sides: ndarray | None = None) -> Stencil:
        """GIMP stencil of points with domains of edges ``length (dim, n)``.

        Parameters
        ----------
        edges
            What happens to a domain that leaves the grid: ``ghost`` refuses (give the grid a spare layer of cells),
            ``truncate`` drops nodes that do not exist from Eq. (6), ``clip`` cuts the domain off and renormalises.
        sides
            From :func:`available_sides`, to clip domains to the available cells as well.

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

        def fill(k: int, part: slice, knots: ndarray) -> tuple[ndarray, ndarray]:
            left, right = (True, True) if sides is None else (sides[side, k][tuple(index[:, part])] for side in (0, 1))
            return shapes.gimp(x[k, part], length[k, part] / 2, knots, left, right)

        return _compact(self._stencil(x, index, 4, fill))

    def _stencil(self, x: ndarray, index: ndarray, width: int, fill) -> Stencil:
        base = index - (width == 4)
        w = np.empty((self.dim, 2, width, x.shape[1]))
        for part in chunks(x.shape[1]):
            for k in range(self.dim):
                w[k, 0, :, part], w[k, 1, :, part] = fill(k, part, self.knots(k, index[k, part]))
        for k, size in enumerate(self.vertices.shape if width == 4 else ()):    # nodes that do not exist carry nothing
            for j in range(width):
                missing = (base[k] + j < 0) | (base[k] + j >= size)
                if missing.any():
                    w[k, :, j, missing] = 0
        return Stencil(base, w, self.vertices.shape)

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


def cell_mask(mesh: Mesh, cells: Any) -> ndarray:
    """Mask over the cells of a mesh from a mask or anything that ``mesh.normalize_elements`` takes."""
    chosen = np.asarray(cells)
    if chosen.dtype != bool:
        chosen = mesh.normalize_elements(cells)
    is_mask, size = chosen.dtype == bool, mesh.nelements
    if not (len(chosen) == size if is_mask else ((chosen >= 0) & (chosen < size)).all()):
        raise ValueError(f"occupied: got cells or a mask that do not fit {size} cells; give cell numbers from 0 to "
                         f"{size - 1}, or a mask of that length.")
    mask = np.zeros(mesh.nelements, dtype=bool)
    mask[chosen] = True
    return mask


def whole_cells(nodes: ndarray) -> ndarray:
    """Mask over the cells whose nodes are all marked; ``nodes`` is a mask with one index per axis, as the result."""
    whole = np.ones([size - 1 for size in nodes.shape], dtype=bool)
    for corner in itertools.product((0, 1), repeat=nodes.ndim):
        whole &= nodes[tuple(slice(c, c + size) for c, size in zip(corner, whole.shape))]
    return whole


def wider(mask: ndarray) -> ndarray:
    """A mask and all that is next to it, diagonally too; one index per axis."""
    for axis, size in enumerate(mask.shape):
        padded = np.pad(mask, [(int(k == axis),) * 2 for k in range(mask.ndim)])
        mask = mask | np.take(padded, range(size), axis) | np.take(padded, range(2, size + 2), axis)
    return mask


def corner_nodes(cells: ndarray) -> ndarray:
    """Mask over the nodes that belong to a marked cell, one index per axis; ``cells`` is a mask too."""
    nodes = np.zeros([size + 1 for size in cells.shape], dtype=bool)
    for corner in itertools.product((0, 1), repeat=cells.ndim):
        nodes[tuple(slice(c, c + size) for c, size in zip(corner, cells.shape))] |= cells
    return nodes


def available_sides(occupied: ndarray, active: ndarray | None = None) -> ndarray:
    """Which neighbours a patch may reach into: ``(2, dim, *cells)``, side 0 towards smaller coordinates.

    A side is available if its cell is occupied and all nodes of that cell are active.  Where an edge or corner cell of
    the patch is missing, all sides involved are dropped, judged at once on the initial masks: so the answer does not
    depend on an order of axes, and the patch stays a product of intervals.

    Parameters
    ----------
    occupied
        Cells that hold points, one index per axis.
    active
        Nodes that carry mass, one index per axis; all of them if not given.
    """
    dim = occupied.ndim
    usable = occupied.copy()
    if active is not None:
        usable &= whole_cells(active)
    padded = np.pad(usable, 1)

    def shifted(offset: Sequence[int]) -> ndarray:
        return padded[tuple(slice(1 + o, 1 + o + size) for o, size in zip(offset, usable.shape))]

    unit = np.eye(dim, dtype=int)
    first = np.stack([np.stack([shifted(sign * unit[k]) for k in range(dim)]) for sign in (-1, 1)])
    sides = first.copy()
    for offset in itertools.product((-1, 0, 1), repeat=dim):
        involved = [((1 + o) // 2, k) for k, o in enumerate(offset) if o]
        if len(involved) > 1:
            missing = np.logical_and.reduce([first[side] for side in involved]) & ~shifted(offset)
            for side in involved:
                sides[side] &= ~missing
    return sides


_GRIDS: dict[int, Grid] = {}


def _view(mesh: Mesh) -> Grid:
    if not isinstance(mesh, (MeshLine1, MeshQuad1, MeshHex1)) or mesh.p.shape[1] != len(np.unique(mesh.t)):
        raise ValueError(f"mesh: got {type(mesh).__name__}, expected an axis-aligned MeshLine1, MeshQuad1 or MeshHex1 "
                         "without unused vertices; other meshes work with ParticleBasis only.")
    index, axes = zip(*(_axis(coordinate) for coordinate in mesh.p))
    shape = tuple(len(axis) for axis in axes)
    low = np.stack([i[mesh.t].min(axis=0) for i in index])
    high = np.stack([i[mesh.t].max(axis=0) for i in index])
    number = np.ravel_multi_index(tuple(low), shape)
    if (np.prod(shape) != mesh.p.shape[1] or (high - low != 1).any()
            or len(np.unique(number)) != np.prod([size - 1 for size in shape])):
        raise ValueError(f"mesh: got a {type(mesh).__name__} with {mesh.nelements} cells that do not make a full box "
                         "of axis-aligned cells; use init_tensor or a refined unit mesh (empty cells cost next to "
                         "nothing).")
    vertices = np.empty(shape, dtype=np.int64)
    vertices[index] = np.arange(mesh.p.shape[1])
    cells = np.empty(tuple(size - 1 for size in shape), dtype=np.int64)
    cells[tuple(low)] = np.arange(mesh.nelements)
    return Grid(axes, vertices, cells)


def _axis(coordinate: ndarray) -> tuple[ndarray, ndarray]:
    """Index of each node along an axis, and the axis: coordinates equal up to rounding are one node."""
    values, inverse = np.unique(coordinate, return_inverse=True)
    fresh = np.diff(values, prepend=-np.inf) > 1e-10 * (values[-1] - values[0])
    return (np.cumsum(fresh) - 1)[inverse], values[fresh]


def _find(axis: ndarray, step: ndarray, x: ndarray) -> ndarray:
    """Host cell along one axis, -1 outside: by arithmetic where cells are equal, corrected against the true faces."""
    last = len(step) - 1
    inside = (x >= axis[0]) & (x <= axis[-1])             # false for NaN too
    if np.ptp(step) <= 1e-9 * step[0]:
        with np.errstate(invalid="ignore"):
            cell = np.clip(np.where(inside, (x - axis[0]) / step[0], 0).astype(np.int64), 0, last)
        cell -= (x < axis[cell]) & (cell > 0)
        cell += (x >= axis[cell + 1]) & (cell < last)
    else:
        cell = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, last)
    cell[~inside] = -1
    return cell


def _compact(stencil: Stencil) -> Stencil:
    """Three nodes per axis are enough unless a domain reaches into both neighbours."""
    if (stencil.w[:, 1, 0].astype(bool) & stencil.w[:, 1, 3].astype(bool)).any():
        return stencil
    shift = stencil.w[:, 1, 0] == 0
    w = np.where(shift[:, None, None], stencil.w[:, :, 1:], stencil.w[:, :, :3])
    return Stencil(stencil.base + shift, w, stencil.shape)


def _position(x: ndarray) -> str:
    return "(" + ", ".join(repr(float(value)) for value in x) + ")"    # every digit: it may be just outside
