"""The points of the cells of a mesh: where in a cell they are, and what each of them integrates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import permutations, product
from numbers import Integral
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.polynomial.legendre import leggauss
from skfem import ElementHex1, ElementLineP1, ElementQuad1, ElementTetP1, ElementTriP1, Mesh
from skfem.element import Element
from skfem.quadrature import get_quadrature

from ..checks import check_array, check_choice, check_positive
from ..kinematics import Kinematics
from ..kinematics.blocks import determinant
from .inputs import check_kinematics

TENSOR = (ElementLineP1, ElementQuad1, ElementHex1)
SIMPLEX = (ElementTriP1, ElementTetP1)
RULES = ("quarter", "gauss")

Rule = tuple[ndarray, list[tuple[ndarray, ndarray]]]


def points_of_cells(mesh: Mesh, kinematics: Kinematics, density: float | ndarray, per_cell: int, rule: str,
                    where: Callable[[ndarray], ndarray] | None) -> dict[str, Any]:
    """Positions, volumes, masses and domains (``length`` and ``spans``) as ``Particles.fill`` promises."""
    _check_mesh(mesh, kinematics)
    points, parts = _rule(mesh.elem, per_cell, rule)
    corners = mesh.p[:, mesh.t]
    x = _positions(mesh.elem, corners, points)
    keep = _keep(where, x)
    cells = np.flatnonzero(keep.any(axis=1))
    x, keep, corners = x[:, keep], keep[cells], corners[:, :, cells]
    area, volume = _measure(mesh.elem, corners, parts, kinematics.hoop, cells)
    length, spans = _length(corners, area, per_cell)[:, keep], _spans(mesh.elem, corners, points, area, keep)
    volume = volume[keep]
    mass = _density(density, len(volume)) * volume
    return {"x": x, "volume": volume, "mass": mass, "length": length, "spans": spans}


def _check_mesh(mesh: Any, kinematics: Any) -> None:
    check_kinematics(kinematics)
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: got {type(mesh).__name__}, expected a scikit-fem mesh; "
                        "meshio bodies go through Particles.from_meshio.")
    if mesh.elem not in TENSOR + SIMPLEX:
        raise ValueError(f"mesh: got {type(mesh).__name__}, expected MeshLine1, MeshTri1, MeshQuad1, MeshTet1 or "
                         "MeshHex1; straighten a mesh of higher order with e.g. MeshTri1.from_mesh(mesh).")
    kinematics.check_dim(mesh.dim())


def _density(density: Any, n: int) -> ndarray:
    density = np.asarray(density)
    if density.ndim == 0 and density.dtype.kind in "iu":
        density = density.astype(float)
    density = check_array("density", density, (n,) if density.ndim else ())
    check_positive("density", density)
    return density


def _keep(where: Any, x: ndarray) -> ndarray:
    """Which points, ``(cells, points of a cell)``, the predicate keeps."""
    if where is None:
        keep = np.ones(x[0].size, dtype=bool)
    elif not callable(where):
        raise TypeError(f"where: got {type(where).__name__}, expected a function such as lambda x: x[0] < 1.")
    else:
        keep = np.asarray(where(x.reshape(len(x), -1)))
    if keep.dtype != bool or keep.shape != (x[0].size,):
        raise ValueError(f"where: got {keep.dtype} of shape {keep.shape} from the function, "
                         f"expected bool of shape ({x[0].size},); it is called once, with all positions.")
    if not keep.any():
        raise ValueError(f"where: keeps no points of {keep.size}; look at the function and at the extent of the mesh.")
    return keep.reshape(x[0].shape)


# Where the points of a cell are, in its reference coordinates, and what each of them integrates.

def _rule(elem: type[Element], per_cell: Any, rule: Any) -> Rule:
    """Points ``(dim, q)`` of the reference cell, and a list of (points, weights) that sum up each one's part of it."""
    check_choice("rule", rule, RULES)
    if not isinstance(per_cell, Integral) or isinstance(per_cell, bool):
        raise TypeError(f"per_cell: got {per_cell!r}, expected an integer, the points per direction in a cell.")
    if per_cell < 1:
        raise ValueError(f"per_cell: got {per_cell}, expected at least 1, the points per direction in a cell.")
    dim, n = elem.refdom.dim(), int(per_cell)
    if elem in TENSOR:
        return _tensor_rule(dim, *_line_rule(n, rule))
    points, weights = _simplex_centroids(dim, n) if rule == "quarter" else _simplex_gauss(elem, n)
    return points, [(points, weights)]


def _line_rule(n: int, rule: str) -> tuple[ndarray, ndarray, ndarray]:
    """Points ``(n,)`` of [0, 1], with points and weights ``(s, n)`` that sum up each one's part."""
    # A single Gauss point is the middle, but its own weight is not exact for what distorted cells integrate.
    if rule == "gauss" and n > 1:
        xi, weights = leggauss(n)
        points = (1 + xi) / 2
        return points, points[None], weights[None] / 2
    points = (np.arange(n) + 0.5) / n
    offset = np.array([[-1.0], [1.0]]) / (2 * n * np.sqrt(3))
    return points, points + offset, np.full((2, n), 0.5 / n)


def _tensor_rule(dim: int, points: ndarray, parts: ndarray, weights: ndarray) -> Rule:
    return _grid([points] * dim), [
        (_grid(parts[list(k)]), _grid(weights[list(k)]).prod(axis=0)) for k in product(range(len(parts)), repeat=dim)]


def _grid(axes: Iterable[ndarray]) -> ndarray:
    """All points ``(dim, q)`` whose coordinates are taken from the axes."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"))
    return grid.reshape(len(grid), -1)


def _simplex_centroids(dim: int, n: int) -> tuple[ndarray, ndarray]:
    """Middles of the ``n**dim`` equal parts of the reference simplex, which are Kuhn simplices.

    In the coordinates ``1 > y_1 > ... > y_dim > 0`` the simplex is itself a Kuhn simplex of the unit cube, so those of
    the ``n**dim`` small cubes, one per order of the coordinates, either lie in it or outside.
    """
    orders = np.array(list(permutations(range(1, dim + 1)))).T / (dim + 1)
    y = (_grid([np.arange(n)] * dim)[:, :, None] + orders[:, None]).reshape(dim, -1) / n
    y = y[:, (np.diff(y, axis=0) < 0).all(axis=0)]
    points = -np.diff(y, axis=0, append=0)
    return points, _share_out(np.ones(n**dim), dim)


def _simplex_gauss(elem: type[Element], n: int) -> tuple[ndarray, ndarray]:
    """scikit-fem's first rule of order ``2 n - 1`` or more that gives every point a positive volume."""
    try:
        for order in range(2 * n - 1, 2 * n + 2):
            points, weights = get_quadrature(elem.refdom, order)
            if weights.min() > 0:
                return points, _share_out(weights, elem.refdom.dim())
    except NotImplementedError:
        pass
    raise ValueError(f"per_cell: got {n}, but scikit-fem has no Gauss rule of order {2 * n - 1} with positive weights "
                     f"for this cell ({elem.refdom.name}); use rule='quarter' or fewer points.")


def _share_out(weights: ndarray, dim: int) -> ndarray:
    """``weights`` scaled to the volume of the reference simplex."""
    return weights / weights.sum() / np.prod(np.arange(1, dim + 1))


# From the reference cell to the cells of a mesh; ``corners`` is (dim, corners of a cell, cells).

def _positions(elem: type[Element], corners: ndarray, points: ndarray) -> ndarray:
    """Positions ``(dim, cells, q)`` of reference points."""
    first = corners[:, 0, :, None]
    value = np.array([elem().lbasis(points, i)[0] for i in range(corners.shape[1])])
    return first + np.einsum("ivc,vq->icq", corners - corners[:, :1], value)


def _jacobian(elem: type[Element], corners: ndarray, points: ndarray) -> ndarray:
    """Jacobians ``(cells, q, dim, dim)`` at reference points."""
    slope = np.array([elem().lbasis(points, i)[1] for i in range(corners.shape[1])])
    return np.einsum("ivc,vjq->cqij", corners - corners[:, :1], slope)


def _determinant(elem: type[Element], corners: ndarray, points: ndarray) -> ndarray:
    """Jacobian determinants ``(cells, q)`` at reference points."""
    return determinant(np.moveaxis(_jacobian(elem, corners, points), (2, 3), (0, 1)))


def _measure(elem: type[Element], corners: ndarray, parts: list[tuple[ndarray, ndarray]], hoop: bool,
             cells: ndarray) -> tuple[ndarray, ndarray]:
    """Geometric area and volume ``(cells, q)`` of every point; they differ in axial symmetry."""
    if hoop:
        _check_axis(corners[0], cells)
    area = ring = np.zeros(1)
    sign = np.sign(_determinant(elem, corners, parts[0][0])[:, :1])
    for points, weights in parts:
        part = sign * _determinant(elem, corners, points) * weights
        if (part <= 0).any():
            cell = cells[np.flatnonzero((part <= 0).any(axis=1))[0]]
            raise ValueError(f"mesh: cell {cell} is folded or has no volume; expected valid cells, repair the mesh.")
        area = area + part
        if hoop:
            ring = ring + part * _positions(elem, corners, points)[0]
    return area, ring if hoop else area


def _check_axis(radius: ndarray, cells: ndarray) -> None:
    low = radius.min(axis=0)
    beyond = low < -1e-9 * np.ptp(radius, axis=0)
    if beyond.any():
        cell = np.flatnonzero(beyond)[0]
        raise ValueError(f"mesh: cell {cells[cell]} reaches to the radius {low[cell]}, expected none below zero; "
                         "end the mesh at the axis, or leave such cells out with where=.")


def _boxes(corners: ndarray, area: ndarray) -> ndarray:
    """Which cells are boxes along the axes."""
    return np.isclose(area.sum(axis=1), np.ptp(corners, axis=1).prod(axis=0), rtol=1e-8, atol=0)


def _length(corners: ndarray, area: ndarray, per_cell: int) -> ndarray:
    """Edges ``(dim, cells, q)`` of the points' domains."""
    dim = len(corners)
    box = _boxes(corners, area)
    return np.where(box[:, None], np.ptp(corners, axis=1)[:, :, None] / per_cell, area ** (1 / dim))


def _spans(elem: type[Element], corners: ndarray, points: ndarray, area: ndarray, keep: ndarray) -> ndarray | None:
    """Edges ``(dim, dim, n)`` of parallelograms of the points' areas, along the cells; None where boxes are enough."""
    if elem not in TENSOR or _boxes(corners, area).all():
        return None
    spans = _jacobian(elem, corners, points)[keep].transpose(1, 2, 0)
    measure = determinant(spans)
    spans = spans * (area[keep] / np.abs(measure)) ** (1 / len(corners))
    spans[:, 0] *= np.sign(measure)                          # an edge may point either way
    return spans
