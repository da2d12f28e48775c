"""Which cell of an unstructured linear mesh each point is in, and where in that cell.

A walk from a known or a near cell, always across the facet that the point is farthest behind; all points at once.  The
*depth* of a point behind a facet is the sum of the linear functions of the vertices that are not on the facet: 0 on
the facet, 1 on the far side of the cell, negative outside.  Barycentric coordinates are the depths in a simplex.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Element, ElementHex1, ElementLineP1, ElementQuad1, ElementTetP1, ElementTriP1, Mesh
from skfem.helpers import det, inv

from .checks import OutsideGridError, check_array

ELEMENTS = (ElementLineP1, ElementTriP1, ElementQuad1, ElementTetP1, ElementHex1)
TOLERANCE = 1e-12  # depth up to which a point outside a cell still counts as on its facet
MARGIN = 1e3  # neighbours differ in size, so a point this many tolerances from a facet is compared with them
WARM_STEPS, COLD_STEPS, BOWED_STEPS = 12, 100, 8
NEAREST = (8, 64)
CHUNK = 1024
NEWTON_STEPS = 50


def local_coordinates(mesh: Mesh, cells: ndarray, x: ndarray) -> ndarray:
    """Coordinates of points in the reference cell of the given cells, which need not contain them.

    Parameters
    ----------
    mesh
        A linear mesh of lines, triangles, quads, tets or hexes.
    cells
        One cell for each point, ``(n,)``.
    x
        The points, ``(dim, n)``.

    Returns
    -------
    ndarray
        ``(dim, n)``; inside the cell they are in scikit-fem's reference cell, outside they go on beyond it.

    Raises
    ------
    ValueError
        If a shape or a cell is wrong, or if the map of a distorted cell does not reach the point.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshTri
    >>> local_coordinates(MeshTri(), np.array([0, 0]), np.array([[0.25, 2.0], [0.25, 0.0]])).tolist()
    [[0.25, 2.0], [0.25, 0.0]]
    """
    _check_elements(mesh)
    x = check_array("x", x, (mesh.dim(), None))
    cells = _check_cells("cells", cells, x.shape[1], mesh.nelements)
    X = _invert(mesh, cells, x)
    bad = np.flatnonzero(np.isnan(X).any(axis=0))
    if bad.size:
        raise ValueError(f"local_coordinates: point {bad[0]} at {_at(x[:, bad[0]])} is not reached by the map of cell "
                         f"{cells[bad[0]]}, expected a point in or near its cell; use a nearer or less distorted cell.")
    return X


class CellLocator:
    """Finds the cells that points are in.

    A point on a facet, edge or vertex belongs to the lowest-numbered cell that contains it, so the answer depends
    neither on the other points of a call nor on ``start``.  (Cells count as neighbours if they share a vertex: along a
    crack with doubled vertices the answer may depend on the side that the walk comes from.)

    Parameters
    ----------
    mesh
        A linear mesh of lines, triangles, quads, tets or hexes; cells must be convex, hexes may have bowed facets.

    Raises
    ------
    ValueError
        If the mesh is of another type, or a cell is flat or not convex.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshTri
    >>> cells, X = CellLocator(MeshTri()).find(np.array([[0.25, 0.75], [0.25, 0.75]]))
    >>> cells.tolist(), X.shape
    ([0, 1], (2, 2))
    """

    def __init__(self, mesh: Mesh):
        _check_elements(mesh)
        _check_convex(mesh)
        self.mesh = mesh
        self._slope, self._constant = _reference_depth(mesh.elem())
        self._plane_slope, self._plane_constant = self._planes()
        # The two cells of a facet, less the cell itself; -1 stands for none.
        self._across = mesh.f2t[:, mesh.t2f].sum(axis=0) - np.arange(mesh.nelements)
        steepest = np.sqrt((self._plane_slope**2).sum(axis=1).max(axis=0))
        self._tolerance = TOLERANCE + 4 * np.finfo(float).eps * abs(mesh.p).max() * steepest

    def __repr__(self) -> str:
        return f"<skfem_mpm CellLocator({type(self.mesh).__name__}), {self.mesh.nelements} cells>"

    def find(self, x: ndarray, start: ndarray | None = None) -> tuple[ndarray, ndarray]:
        """Cells that contain the points, and the local coordinates there.

        Parameters
        ----------
        x
            The points, ``(dim, n)``.
        start
            Cells where the walk begins, ``(n,)``, such as those of the last step; the nearest ones if not given.

        Returns
        -------
        tuple of ndarray
            The cells ``(n,)`` and the coordinates ``(dim, n)`` in scikit-fem's reference cell.

        Raises
        ------
        OutsideGridError
            If a point is in no cell; the message names the first one.
        ValueError, TypeError
            If ``x`` or ``start`` has a wrong shape, type or value.
        """
        x = check_array("x", x, (self.mesh.dim(), None))
        cells = self._walk_over_planes(x, start)
        X = _invert(self.mesh, cells, x)
        lost = np.flatnonzero(~self._inside(cells, X))
        for part in _chunks(lost):
            cells[part] = self._recover(x[:, part], cells[part], part)
            X[:, part] = _invert(self.mesh, cells[part], x[:, part])
        near = np.flatnonzero(self._depth(X).min(axis=0) < MARGIN * self._tolerance[cells])
        for part in _chunks(near):
            cells[part] = self._lowest_neighbour(x[:, part], cells[part], X[:, part])
            X[:, part] = _invert(self.mesh, cells[part], x[:, part])
        return cells, X

    def _walk_over_planes(self, x: ndarray, start: ndarray | None) -> ndarray:
        """Cells by the tangent planes of the facets: right for all but bowed facets and lost walks."""
        lost = np.arange(x.shape[1])
        cells = np.empty(x.shape[1], dtype=int)
        if start is not None:
            cells[:] = _check_cells("start", start, x.shape[1], self.mesh.nelements)
            lost = self._walk(x, cells, self._plane_depth, WARM_STEPS)
        if lost.size:
            nearest = self._nearest(x[:, lost], 1)[:, 0]
            self._walk(x[:, lost], nearest, self._plane_depth, COLD_STEPS)
            cells[lost] = nearest
        return cells

    def _walk(self, x: ndarray, cells: ndarray, depth: Callable[..., ndarray], steps: int) -> ndarray:
        """Move ``cells`` towards the points, in place; return the points that hit a boundary or were still walking."""
        walking, blocked = np.arange(len(cells)), []
        for _ in range(steps):
            depths = depth(cells[walking], x[:, walking])
            outside = ~(depths.min(axis=0) >= -self._tolerance[cells[walking]])
            walking, facet = walking[outside], depths[:, outside].argmin(axis=0)
            beyond = self._across[facet, cells[walking]]
            blocked.append(walking[beyond < 0])
            walking = walking[beyond >= 0]
            if not walking.size:
                break
            cells[walking] = beyond[beyond >= 0]
        return np.concatenate([*blocked, walking])

    def _recover(self, x: ndarray, cells: ndarray, numbers: ndarray) -> ndarray:
        """Cells of points that the planes lost: across bowed facets, then among more and more cells."""
        lost = self._walk(x, cells, lambda cells, x: self._depth(_invert(self.mesh, cells, x)), BOWED_STEPS)
        cells[lost] = self.mesh.nelements
        for count in NEAREST:
            nearest = self._nearest(x[:, lost], count)
            self._lower(x, cells, np.repeat(lost, nearest.shape[1]), nearest.ravel())
            lost = lost[cells[lost] == self.mesh.nelements]
        for point in np.sort(lost):
            candidates = self._cells_around(x[:, point])
            self._lower(x, cells, np.full(len(candidates), point), candidates)
            if cells[point] == self.mesh.nelements:
                raise self._outside_error(x[:, point], numbers[point])
        return cells

    def _lower(self, x: ndarray, cells: ndarray, points: ndarray, candidates: ndarray) -> None:
        """Lower ``cells`` of the points, in place, to the lowest of their candidates that contains them."""
        inside = self._inside(candidates, _invert(self.mesh, candidates, x[:, points]))
        np.minimum.at(cells, points[inside], candidates[inside])

    def _lowest_neighbour(self, x: ndarray, cells: ndarray, X: ndarray) -> ndarray:
        """Lowest cells that contain points near a facet.

        The vertex whose function is largest at the point is on every facet, edge or vertex that the point is on, so
        all cells that contain the point are round it.
        """
        functions = np.array([self.mesh.elem().lbasis(X, i)[0] for i in range(len(self.mesh.t))])
        vertices = self.mesh.t[functions.argmax(axis=0), cells]
        begin, around = self._around_vertex
        counts = begin[vertices + 1] - begin[vertices]
        points = np.repeat(np.arange(len(cells)), counts)
        first = np.repeat(begin[vertices] - np.cumsum(counts) + counts, counts)
        candidates = around[first + np.arange(len(points))]
        lower = candidates < cells[points]
        self._lower(x, cells := cells.copy(), points[lower], candidates[lower])
        return cells

    def _inside(self, cells: ndarray, X: ndarray) -> ndarray:
        """Whether the cells contain the points with these local coordinates."""
        return self._depth(X).min(axis=0) >= -self._tolerance[cells]

    def _depth(self, X: ndarray) -> ndarray:
        """Depth behind the facets of the reference cell, ``(nfacets, n)``."""
        return self._constant[:, None] + sum(slope[:, None] * row for slope, row in zip(self._slope.T, X))

    def _plane_depth(self, cells: ndarray, x: ndarray) -> ndarray:
        """Depth behind the tangent planes of the facets, ``(nfacets, n)``."""
        depth = self._plane_constant[:, cells]
        for slope, row, origin in zip(self._plane_slope.transpose(1, 0, 2), x, self.mesh.p[:, self.mesh.t[0, cells]]):
            depth += slope[:, cells] * (row - origin)
        return depth

    def _planes(self) -> tuple[ndarray, ndarray]:
        """Slope ``(nfacets, dim, ncells)`` and value at the first vertex of the depth behind each tangent plane."""
        cells, slopes, constants = np.arange(self.mesh.nelements), [], []
        for facet, reference_slope in zip(self.mesh.refdom.facets, self._slope):
            middle = self.mesh.elem.doflocs[facet].mean(axis=0)[:, None]
            position, jacobian = _map(self.mesh, cells, middle)
            slope = (reference_slope[:, None, None] * _inverse(jacobian)).sum(axis=0)
            slopes.append(slope)
            constants.append(-(slope * position).sum(axis=0))
        return np.array(slopes), np.array(constants)

    def _nearest(self, x: ndarray, count: int) -> ndarray:
        """Cells with the nearest centroids, ``(n, count)``."""
        return self._tree.query(x.T, k=np.arange(1, min(count, self.mesh.nelements) + 1))[1]

    def _cells_around(self, x: ndarray) -> ndarray:
        """Cells whose bounding box, with some margin, contains the single point."""
        low, high = self._boxes
        margin = 0.01 * (high - low)
        return np.flatnonzero(((low - margin <= x[:, None]) & (x[:, None] <= high + margin)).all(axis=0))

    def _outside_error(self, x: ndarray, number: int) -> OutsideGridError:
        """Make the error that names the point."""
        low, high = self.mesh.p.min(axis=1), self.mesh.p.max(axis=1)
        box = " x ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high))
        return OutsideGridError(f"point {number} is at {_at(x)}, outside the mesh with the bounding box {box}; "
                                "use a larger mesh or a smaller step.")

    @cached_property
    def _tree(self) -> Any:
        """The centroids, for the nearest ones."""
        from scipy.spatial import cKDTree  # slow to import, and only needed on unstructured meshes

        return cKDTree(self.mesh.p[:, self.mesh.t].mean(axis=1).T)

    @cached_property
    def _boxes(self) -> tuple[ndarray, ndarray]:
        """Lower and upper corner of each cell's bounding box, ``(dim, ncells)``."""
        corners = self.mesh.p[:, self.mesh.t]
        return corners.min(axis=1), corners.max(axis=1)

    @cached_property
    def _around_vertex(self) -> tuple[ndarray, ndarray]:
        """Cells round each vertex: those of vertex i are ``around[begin[i]:begin[i + 1]]``."""
        begin = np.append(0, np.cumsum(np.bincount(self.mesh.t.ravel(), minlength=self.mesh.nvertices)))
        return begin, np.argsort(self.mesh.t.ravel(), kind="stable") % self.mesh.nelements


def _reference_depth(elem: Element) -> tuple[ndarray, ndarray]:
    """Slope ``(nfacets, dim)`` and value at the origin ``(nfacets,)`` of the depth behind each reference facet."""
    origin = np.zeros((elem.refdom.dim(), 1))
    functions = [elem.lbasis(origin, i) for i in range(elem.refdom.nnodes)]
    opposite = [[function for i, function in enumerate(functions) if i not in facet] for facet in elem.refdom.facets]
    slope = [sum(gradient[:, 0] for _, gradient in group) for group in opposite]
    return np.array(slope), np.array([sum(value[0] for value, _ in group) for group in opposite])


def _map(mesh: Mesh, cells: ndarray, X: ndarray) -> tuple[ndarray, ndarray]:
    """Position relative to the cell's first vertex, ``(dim, n)``, and Jacobian, ``(dim, dim, n)``.

    Relative, because far from the origin the digits of the absolute position are lost on the offset.
    """
    elem, origin = mesh.elem(), mesh.p[:, mesh.t[0, cells]]
    position, jacobian = np.zeros_like(origin), np.zeros((len(origin), *origin.shape))
    for i in range(1, len(mesh.t)):
        edge = mesh.p[:, mesh.t[i, cells]] - origin
        value, gradient = elem.lbasis(X, i)
        position += value * edge
        jacobian += edge[:, None] * gradient
    return position, jacobian


def _invert(mesh: Mesh, cells: ndarray, x: ndarray) -> ndarray:
    """Local coordinates by Newton's method from the centre, whose first step is the affine guess; NaN for none."""
    X = np.repeat(mesh.elem.doflocs.mean(axis=0)[:, None], x.shape[1], axis=1)
    target = x - mesh.p[:, mesh.t[0, cells]]
    active = np.arange(x.shape[1])
    for _ in range(NEWTON_STEPS):
        position, jacobian = _map(mesh, cells[active], X[:, active])
        step = _apply(_inverse(jacobian), target[:, active] - position)
        X[:, active] += step
        # Quadratic convergence: the error left is about the square of the step.
        active = active[(abs(step) > 1e-8 * (1 + abs(X[:, active]))).any(axis=0)]
        if mesh.elem.maxdeg == 1 or not active.size:
            return X
    X[:, active] = np.nan
    return X


def _apply(matrix: ndarray, vector: ndarray) -> ndarray:
    """Product of ``(dim, dim, n)`` and ``(dim, n)``, summed in a fixed order so that it is the same in any batch."""
    return sum(matrix[:, k] * vector[k] for k in range(len(vector)))


def _inverse(jacobian: ndarray) -> ndarray:
    """Inverse of ``(dim, dim, n)``; not finite where singular."""
    with np.errstate(all="ignore"):
        return inv(jacobian) if len(jacobian) > 1 else 1 / jacobian


def _check_elements(mesh: Mesh) -> None:
    """Refuse meshes that are not linear."""
    if mesh.elem not in ELEMENTS:
        raise ValueError(f"mesh: got {type(mesh).__name__}, expected a linear mesh: MeshLine1, MeshTri1, MeshQuad1, "
                         "MeshTet1 or MeshHex1; quadratic and discontinuous meshes are not walked.")


def _check_convex(mesh: Mesh) -> None:
    """Refuse cells whose Jacobian vanishes or changes sign from vertex to vertex."""
    determinants = []
    for vertex in mesh.elem.doflocs:
        _, jacobian = _map(mesh, np.arange(mesh.nelements), vertex[:, None])
        determinants.append(det(jacobian) if len(jacobian) > 1 else jacobian[0, 0])
    bad = np.flatnonzero(~((np.min(determinants, axis=0) > 0) | (np.max(determinants, axis=0) < 0)))
    if bad.size:
        raise ValueError(f"mesh: got cell {bad[0]} that is flat or not convex ({bad.size} such cells), expected convex "
                         f"cells; look at its vertices {mesh.t[:, bad[0]].tolist()}.")


def _check_cells(name: str, cells: Any, count: int, ncells: int) -> ndarray:
    """Return cell numbers as an integer array of ``count`` existing cells, or say what is wrong."""
    cells = np.asarray(cells)
    if cells.dtype.kind not in "iu":
        raise TypeError(f"{name}: got an array of {cells.dtype}, expected integers, one cell for each point.")
    if cells.shape != (count,):
        raise ValueError(f"{name}: got shape {cells.shape}, expected ({count},), one cell for each point.")
    bad = np.flatnonzero((cells < 0) | (cells >= ncells))
    if bad.size:
        raise ValueError(f"{name}: got cell {cells[bad[0]]} at point {bad[0]}, expected 0 to {ncells - 1}; "
                         "is it of another mesh?")
    return cells


def _chunks(points: ndarray) -> list[ndarray]:
    """Cut the points into pieces whose candidate cells fit in little memory."""
    return [points[i:i + CHUNK] for i in range(0, len(points), CHUNK)]


def _at(x: ndarray) -> str:
    """Format a position for messages."""
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"
