"""The function spaces of GIMP and CMPM as scikit-fem user elements, for a stock ``CellBasis``.

Each cell has ``4**dim`` functions per unknown: those of its own nodes, in scikit-fem's order, come last, those of the
nodes around it first.  Where a neighbour is missing the functions are zero and stand at a node of the cell itself.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Dofs, Mesh
from skfem.element import DiscreteField, Element, ElementH1, ElementVector
from skfem.refdom import RefHex, RefLine, RefQuad

from . import shapes
from .grid import Grid, available_sides, cell_mask


class _Patch:
    """Which nodes the cells of a mesh see, where they stand in the stencil, and which sides are available."""

    def __init__(self, mesh: Mesh, occupied: ndarray | None):
        self.mesh, self.grid = mesh, Grid.from_mesh(mesh)
        grid, dim = self.grid, self.grid.dim
        self.cell = np.stack(np.unravel_index(np.argsort(grid.cells, axis=None), grid.cells.shape))
        mask = np.ones(grid.cells.shape, dtype=bool)
        if occupied is not None:
            mask = cell_mask(mesh, occupied)[grid.cells]
        self.clipped = occupied is not None
        everywhere = (slice(None), slice(None)) + tuple(self.cell)
        self.sides = available_sides(mask)[everywhere]                                  # (2, dim, ncells)

        around = [a for a in itertools.product(range(4), repeat=dim) if not set(a) <= {1, 2}]
        node = np.stack(np.unravel_index(np.argsort(grid.vertices, axis=None), grid.vertices.shape))
        own = node[:, mesh.t] - self.cell[:, None] + 1
        self.place = np.concatenate([np.broadcast_to(np.array(around).reshape(-1, dim).T[:, :, None],
                                                     (dim, len(around), mesh.nelements)), own], axis=1)
        index = self.cell[:, None] + self.place - 1
        size = np.array(grid.vertices.shape)[:, None, None]
        exists = ((index >= 0) & (index < size)).all(axis=0)
        self.nodes = np.where(exists, grid.vertices[tuple(np.clip(index, 0, size - 1))], mesh.t[0])


class _PatchElement(ElementH1):
    nodal_dofs = 1
    maxdeg = 3
    dofnames = ["u"]
    _patch: _Patch | None = None

    @property
    def doflocs(self) -> ndarray:
        """Local places of the nodes; scikit-fem keeps the last one written for a node, and a cell's own come last."""
        around = [a for a in itertools.product((-1, 0, 1, 2), repeat=self.dim) if not set(a) <= {0, 1}]
        return np.concatenate([np.array(around, dtype=float).reshape(-1, self.dim), self.refdom.p.T])

    def _bfun_counts(self) -> ndarray:
        return np.array([4 ** self.dim, 0, 0, 0])

    def bind(self, mesh: Mesh, occupied: Any = None) -> _Patch:
        """Learn which cells of ``mesh`` are occupied; :func:`patch_dofs` calls this."""
        self._patch = _Patch(mesh, occupied)
        return self._patch

    def gbasis(self, mapping: Any, X: ndarray, i: int, tind: ndarray | None = None) -> tuple[DiscreteField, ...]:
        """Value and gradient of function ``i`` at local points ``X``, as scikit-fem asks for them."""
        patch = self._patch
        if patch is None or patch.mesh is not mapping.mesh:
            raise ValueError(f"{type(self).__name__}: it does not know this mesh yet; pass "
                             "dofs=patch_dofs(mesh, elem) to the basis.")
        cells = np.arange(patch.mesh.nelements) if tind is None else np.asarray(tind)
        x = mapping.F(X, tind)
        at = np.repeat(cells, x.shape[2])
        factors = []
        for k in range(self.dim):
            table = self._functions(patch, k, x[k].ravel(), at)
            factors.append([rows[patch.place[k, i, at], np.arange(at.size)] for rows in table])
        value = np.prod([factor[0] for factor in factors], axis=0)
        grad = [np.prod([factor[int(k == axis)] for k, factor in enumerate(factors)], axis=0)
                for axis in range(self.dim)]
        return (DiscreteField(value.reshape(x.shape[1:]), np.stack(grad).reshape(x.shape)),)

    def _functions(self, patch: _Patch, k: int, x: ndarray, at: ndarray) -> tuple[ndarray, ndarray]:
        raise NotImplementedError


class _CMPM(_PatchElement):
    """The CMPM elements, see :class:`ElementQuadCMPM`."""

    def _functions(self, patch: _Patch, k: int, x: ndarray, at: ndarray) -> tuple[ndarray, ndarray]:
        return shapes.cmpm(x, patch.grid.knots(k, patch.cell[k, at]), patch.sides[0, k, at], patch.sides[1, k, at])


class _GIMP(_PatchElement):
    """The GIMP elements, see :class:`ElementQuadGIMP`."""

    def __init__(self, length: Any = None):
        if length is not None and not (np.size(length) == self.dim and np.all(np.asarray(length) > 0)):
            raise ValueError(f"length: got {length}, expected {self.dim} edge length(s) above zero, one per axis.")
        self.length = None if length is None else np.reshape(np.asarray(length, dtype=float), -1)

    def bind(self, mesh: Mesh, occupied: Any = None) -> _Patch:
        """Learn which cells of ``mesh`` are occupied, and refuse domains that reach beyond a cell's neighbours."""
        patch = _Patch(mesh, occupied)
        for k, width in enumerate(patch.grid.steps):
            self._check_reach(k, width)
        self._patch = patch
        return patch

    def _check_reach(self, k: int, width: ndarray) -> None:
        slack = 1 + 1e-9    # widths of equal cells differ by rounding
        if self.length is None:
            ratio = max((width[1:] / width[:-1]).max(initial=1), (width[:-1] / width[1:]).max(initial=1))
            if ratio > 4 * slack:
                raise ValueError(f"mesh: got neighbours along axis {k} of which one is {ratio:g} times as wide as the "
                                 "other, expected at most 4 for domains of half a cell; give a length or grade the "
                                 "mesh less.")
        elif self.length[k] > 2 * width.min() * slack:
            raise ValueError(f"length: got {self.length[k]:g} along axis {k}, expected at most {2 * width.min():g}, "
                             "twice the narrowest cell, for a domain must not reach beyond the neighbours of its cell; "
                             "use a smaller length or wider cells.")

    def _functions(self, patch: _Patch, k: int, x: ndarray, at: ndarray) -> tuple[ndarray, ndarray]:
        knots = patch.grid.knots(k, patch.cell[k, at])
        half = (knots[2] - knots[1]) / 4 if self.length is None else np.full(len(x), self.length[k] / 2)
        sides = (patch.sides[0, k, at], patch.sides[1, k, at]) if patch.clipped else (True, True)
        value, slope = shapes.gimp(x, half, knots, *sides)
        missing = patch.cell[k, at] + np.arange(-1, 3)[:, None]
        missing = (missing < 0) | (missing >= patch.grid.vertices.shape[k])
        return np.where(missing, 0, value), np.where(missing, 0, slope)


class ElementLineCMPM(_CMPM):
    """CMPM on lines; see :class:`ElementQuadCMPM`."""

    refdom = RefLine


class ElementQuadCMPM(_CMPM):
    """CMPM on quads: cubic through the nodes of a cell and its neighbours, of lower order where these are missing.

    Along each axis Eq. (8) of Gonzalez Acosta et al. (2017) with both neighbours, its quadratic Eq. (7) with one, and
    linear functions without, as :func:`skfem_mpm.shapes.cmpm`; the functions of a cell are products of these.

    Examples
    --------
    >>> from skfem import CellBasis, MeshQuad
    >>> mesh, elem = MeshQuad().refined(2), ElementQuadCMPM()
    >>> basis = CellBasis(mesh, elem, dofs=patch_dofs(mesh, elem))
    >>> x = basis.doflocs
    >>> gradient = basis.interpolate(x[0] ** 2 * x[1]).grad
    >>> bool(abs(gradient[0] - 2 * basis.global_coordinates()[0] * basis.global_coordinates()[1]).max() < 1e-13)
    True
    """

    refdom = RefQuad


class ElementHexCMPM(_CMPM):
    """CMPM on hexes; see :class:`ElementQuadCMPM`."""

    refdom = RefHex


class ElementLineGIMP(_GIMP):
    """GIMP on lines; see :class:`ElementQuadGIMP`."""

    refdom = RefLine


class ElementQuadGIMP(_GIMP):
    """GIMP on quads: the mean of the linear functions over a domain around each point.

    Eq. (6) of Gonzalez Acosta et al. (2017) as :func:`skfem_mpm.shapes.gimp`, along each axis.  At the edge of the mesh
    nodes that do not exist are dropped, and the functions no longer sum to one.  With ``occupied`` cells given to
    :func:`patch_dofs`, domains are clipped to these instead.

    Parameters
    ----------
    length
        Edges of the domain along each axis; half a cell, as in the paper, if not given.  A domain must not reach beyond
        the neighbours of its cell: :func:`patch_dofs` refuses one longer than two of the narrowest cells.

    Raises
    ------
    ValueError
        If ``length`` is not one number above zero for each axis.

    Examples
    --------
    Half of the domain is in each of the two cells that meet at a node, so the mean of its function there is 7/8:

    >>> from skfem import CellBasis, MeshQuad
    >>> mesh, elem = MeshQuad().refined(2), ElementQuadGIMP()
    >>> basis = CellBasis(mesh, elem, dofs=patch_dofs(mesh, elem), quadrature=(np.zeros((2, 1)), np.ones(1)))
    >>> float(max(f[0][0, 0] for f in basis.basis)) == (7 / 8) ** 2
    True
    """

    refdom = RefQuad


class ElementHexGIMP(_GIMP):
    """GIMP on hexes; see :class:`ElementQuadGIMP`."""

    refdom = RefHex


class _PatchDofs(Dofs):
    """The numbering of the linear element with the wider connectivity of a patch."""

    def __init__(self, mesh: Mesh, elem: Element, patch: _Patch):
        super().__init__(mesh, elem)
        self.element_dofs = self.nodal_dofs[:, patch.nodes].transpose(1, 0, 2).reshape(-1, mesh.nelements)


def patch_dofs(mesh: Mesh, elem: Element, occupied: Any = None) -> Dofs:
    """Degrees of freedom of a GIMP or CMPM element, to be passed to ``CellBasis(mesh, elem, dofs=...)``.

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh.
    elem
        One of the GIMP or CMPM elements, or an ``ElementVector`` of it.  It is bound to the mesh by this call.
    occupied
        Cells that hold material, anything that ``mesh.normalize_elements`` takes or a mask; all if not given.  Patches
        reach into occupied neighbours only.

    Returns
    -------
    Dofs
        Numbered as those of the linear element, so vectors fit both.

    Raises
    ------
    ValueError
        If the element is of another kind, the mesh is not axis-aligned, or a domain of GIMP could reach beyond the
        neighbours of its cell.
    """
    leaf = elem.elem if isinstance(elem, ElementVector) else elem
    if not isinstance(leaf, _PatchElement):
        raise ValueError(f"elem: got {type(leaf).__name__}, expected a GIMP or CMPM element or an ElementVector of "
                         "one.")
    if mesh.refdom is not leaf.refdom:
        raise ValueError(f"elem: got {type(leaf).__name__} for a {type(mesh).__name__}; take the one for that cell.")
    return _PatchDofs(mesh, elem, leaf.bind(mesh, occupied))
