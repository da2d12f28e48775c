"""Points seen through finite element functions, and what scikit-fem's forms read of any basis on points.

This rests on scikit-fem's inside: forms read ``mesh``, ``elem``, ``dofs``, ``nelems``, ``Nbfun``, ``element_dofs``,
``basis``, ``X``, ``W``, ``dx`` and ``default_parameters()`` of a basis, and the methods of ``CellBasis`` also
``mapping``, ``tind`` and ``doflocs``.  Here each is set by hand or made when first asked for, so ``CellBasis.__init__``
is never called.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import CellBasis, Dofs, ElementHex1, ElementLineP1, ElementQuad1, Mesh, condense, solve
from skfem.element import DiscreteField, Element, ElementComposite, ElementVector
from skfem.mapping import MappingAffine, MappingIsoparametric

from ..checks import check_array
from ..grid import Edges, Grid, Stencil
from ..locator import CellLocator, local_coordinates
from ..particles import Particles
from ..weights import weights
from .points import LocalPoints, check_same_points

LINEAR = (ElementLineP1, ElementQuad1, ElementHex1)


class ParticleBasis(CellBasis):
    """Points seen through finite element functions: the basis of the classic material point method.

    Any unmodified scikit-fem form assembles on it.  The fields of the points are in ``w`` by name, shaped for forms:
    ``w.x``, ``w.volume``, ``w.mass``, ``w.stress`` (3, 3) and the points' own fields.  The measure is the volume of the
    points; in axial symmetry it is the ring volume per radian, so forms carry no factor r.

    Parameters
    ----------
    mesh
        Any linear mesh: lines, triangles, quads, tets, hexes.
    elem
        Any element of that mesh; a vector or composite one too.
    particles
        The points; ``x (dim, n)`` and ``volume (n,)`` are read.
    cells
        Cells the points were in before; the search on unstructured meshes starts there.
    dofs
        Degrees of freedom made before for the same mesh and element, to save time.

    Raises
    ------
    OutsideGridError
        If a point is outside the mesh; the message names the first one and where it is.
    ValueError
        If mesh, element and particles do not fit.

    Examples
    --------
    >>> from skfem import ElementQuad1, MeshQuad, asm
    >>> from skfem.models.poisson import mass
    >>> from skfem_mpm import Particles, ParticleBasis, plane_strain
    >>> mesh = MeshQuad().refined(2)
    >>> basis = ParticleBasis(mesh, ElementQuad1(), Particles.fill(mesh, plane_strain))
    >>> round(float(asm(mass, basis).sum()), 12)
    1.0
    """

    reads_domains = False    # whether the points need a length

    def __init__(self, mesh: Mesh, elem: Element, particles: Particles, cells: ndarray | None = None,
                 dofs: Dofs | None = None):
        if mesh.refdom is not elem.refdom:
            raise ValueError(f"elem: got {type(elem).__name__} for a {type(mesh).__name__}, expected an element of "
                             "that cell.")
        if particles.dim != mesh.dim():
            raise ValueError(f"particles: got points in {particles.dim} dimension(s) for a mesh in {mesh.dim()}; "
                             "make both of the same dimension.")
        self.mesh, self.elem, self.particles = mesh, elem, particles
        self.dofs = Dofs(mesh, elem) if dofs is None else dofs
        self.nelems, self.W = particles.n, np.ones(1)
        self.dx = particles.volume[:, None]
        self.tind, self.stencil = self._place(cells)

    # -- where the points are and what they see ----------------------------------------------------------------------

    def _place(self, cells: ndarray | None) -> tuple[ndarray, Stencil | None]:
        """Host cells, and the stencil where there is one."""
        if not is_linear(self.elem) or not _is_grid(self.mesh):
            found, self._local = CellLocator(self.mesh).find(self.particles.x, start=cells)
            return found, None
        return self._place_on_grid()

    def _place_on_grid(self) -> tuple[ndarray, Stencil]:
        grid, x = Grid.from_mesh(self.mesh), self.particles.x
        index = grid.locate(x)
        cells = grid.cells[tuple(index)]
        return cells, self.stencil_of(grid, x, index, **self._choices(grid, cells))

    def _choices(self, grid: Grid, cells: ndarray) -> dict[str, Any]:
        """What :meth:`stencil_of` needs besides positions, for points in these mesh cells."""
        return {}

    @classmethod
    def stencil_of(cls, grid: Grid, x: ndarray, index: ndarray, length: ndarray | None = None, edges: Edges = "ghost",
                   sides: ndarray | None = None, ring: bool = False) -> Stencil:
        """Stencil of this basis for points ``x`` in the cells ``index`` of a grid: all that a solver needs of it."""
        return grid.linear(x, index)

    @cached_property
    def nodes(self) -> ndarray:
        """Mesh vertices seen by the points, ``(K**dim, n)``."""
        stencil = self._need_stencil()
        return Grid.from_mesh(self.mesh).vertices.ravel()[stencil.nodes()]

    @property
    def value(self) -> ndarray:
        """Shape functions of these vertices at the points, ``(K**dim, n)``."""
        return self._need_stencil().value()

    @property
    def gradient(self) -> ndarray:
        """Gradients of these functions, ``(dim, K**dim, n)``."""
        return self._need_stencil().gradient()

    def _need_stencil(self) -> Stencil:
        if self.stencil is None:
            raise ValueError("stencil: there is none for this mesh or element; take an axis-aligned mesh and a linear "
                             "element, or use forms.")
        return self.stencil

    # -- what scikit-fem's forms read of a basis ---------------------------------------------------------------------

    @cached_property
    def basis(self) -> list[tuple[DiscreteField, ...]]:
        """The basis functions at the points, one field each (made when first asked for)."""
        if self.stencil is None:
            local = self._local[:, :, None]
            return [self.elem.gbasis(self.mapping, local, i, tind=self.tind) for i in range(self.Nbfun)]
        value, gradient = self.value[..., None], self.gradient[..., None]
        return [fields for k in range(len(value)) for fields in _nodal_fields(self.elem, value[k], gradient[:, k])]

    @cached_property
    def element_dofs(self) -> ndarray:
        """Degrees of freedom seen by each point, ``(Nbfun, n)``."""
        if self.stencil is None:
            return self.dofs.element_dofs[:, self.tind]
        return self.nodal_dofs[:, self.nodes].transpose(1, 0, 2).reshape(-1, self.nelems)

    @property
    def Nbfun(self) -> int:
        """Number of functions that a point sees."""
        return len(self.element_dofs)

    @cached_property
    def X(self) -> ndarray:
        """Local coordinates of the points in their cells, ``(dim, n, 1)``."""
        local = self._local if self.stencil is None else local_coordinates(self.mesh, self.tind, self.particles.x)
        return LocalPoints.of(local[:, :, None], self.particles.x)

    @cached_property
    def mapping(self) -> Any:
        """A mapping of our own: the mesh's one would keep what it computes for these points for ever."""
        if self.mesh.affine:
            return MappingAffine(self.mesh)
        return MappingIsoparametric(self.mesh, self.mesh.elem(), self.mesh.bndelem)

    @cached_property
    def doflocs(self) -> ndarray:
        """Locations of the degrees of freedom."""
        return self.plain.doflocs

    @cached_property
    def plain(self) -> CellBasis:
        """The ordinary basis of the mesh and element, without points."""
        return CellBasis(self.mesh, self.elem)

    @cached_property
    def _parameters(self) -> dict[str, DiscreteField]:
        h = np.abs(self.mapping.detDF(np.asarray(self.X), tind=self.tind)) ** (1 / self.mesh.dim())
        fields = {name: array for name, array in self.particles.arrays().items() if name not in ("sigma", "epsilon")}
        fields["stress"] = self.particles.stress
        if self.particles.epsilon is not None:
            fields["strain"] = self.particles.strain
        return {"h": DiscreteField(h)} | {name: DiscreteField(array[..., None]) for name, array in fields.items()}

    def default_parameters(self) -> dict[str, DiscreteField]:
        """What forms find in ``w``: positions, cell sizes and every field of the points, by name."""
        return dict(self._parameters)

    def global_coordinates(self) -> DiscreteField:
        """Positions of the points, as they were given."""
        return self._parameters["x"]

    def mesh_parameters(self) -> DiscreteField:
        """Size of the host cells."""
        return self._parameters["h"]

    def field(self, array: ndarray) -> DiscreteField:
        """Make an array ``(..., n)`` over the points a field for forms, ``(..., n, 1)``.

        Raises
        ------
        ValueError, TypeError
            If the last axis is not the points', or entries are not finite floats.
        """
        shape = np.shape(array)[:-1] + (self.nelems,)
        return DiscreteField(check_array("field", array, shape)[..., None])

    # -- similar bases -----------------------------------------------------------------------------------------------

    def with_weights(self, name: str) -> ParticleBasis:
        """A similar basis with integration weights: ``one``, ``eq10``, ``interior`` or ``overlap``.

        For stiffness and internal force only: mass and body force keep the basis without weights.

        Raises
        ------
        ValueError
            If the name is unknown, the mesh is not axis-aligned, or domains are needed and missing.
        """
        grid, points = Grid.from_mesh(self.mesh), self.particles
        factor = weights(name, grid, grid.locate(points.x), points.x, points.volume, points.kinematics.hoop,
                         points.length)
        other = copy.copy(self)
        other.dx = (factor * points.volume)[:, None]
        return other

    def with_element(self, elem: Element) -> ParticleBasis:
        """A similar basis with another element."""
        other = type(self)(self.mesh, elem, self.particles, **self._options())
        other.dx = self.dx
        return other

    def with_elements(self, elements: Any = None) -> ParticleBasis:
        """A similar basis on some of the points (indices or mask; all if not given): a point is an element."""
        if elements is None:
            return self
        other = type(self)(self.mesh, self.elem, self.particles.where(elements), dofs=self.dofs, **self._options())
        other.dx = self.dx[elements]
        return other

    def __mul__(self, other: Any) -> Any:
        """Combine two bases into a composite one; both must be on the same points."""
        if isinstance(other, ParticleBasis):
            check_same_points(self.particles.x, other.particles.x)
        return super().__mul__(other)

    def __matmul__(self, other: Any) -> Any:
        """Combine two bases of equal size into a composite one on the same degrees of freedom and points."""
        if isinstance(other, ParticleBasis):
            check_same_points(self.particles.x, other.particles.x)
        return super().__matmul__(other)

    def split_bases(self) -> list[Any]:
        """A basis for each component of a vector or composite element."""
        if isinstance(self.elem, ElementComposite):
            return [self.with_element(elem) for elem in self.elem.elems]
        if isinstance(self.elem, ElementVector):
            return [self.with_element(self.elem.elem)] * self.elem.dim
        return [self]

    def _options(self) -> dict[str, Any]:
        return {}

    # -- what works on cells, not on points --------------------------------------------------------------------------

    def project(self, interp: Any, elements: Any = None, dtype: Any = None) -> ndarray:
        """L2 projection with the points as quadrature; degrees of freedom that no point sees stay zero.

        Raises
        ------
        ValueError
            If ``elements`` is given: choose points with :meth:`with_elements` instead.
        """
        if elements is not None:
            raise ValueError("elements: got a choice of cells, but a point basis has points; use "
                             "with_elements(points).")
        mass, rhs = self._projection(interp, dtype=dtype)
        return solve(*condense(mass, rhs, I=np.flatnonzero(mass.diagonal() > 1e-12 * mass.diagonal().max())))

    def probes(self, x: ndarray) -> Any:
        """Matrix that evaluates a vector's finite element function at ``x``, as the plain basis does."""
        return self.plain.probes(x)

    def refinterp(self, *args: Any, **kwargs: Any) -> Any:
        """Refine and interpolate for plots, as the plain basis does."""
        return self.plain.refinterp(*args, **kwargs)

    def boundary(self, *args: Any, **kwargs: Any) -> Any:
        """Facet basis of the plain basis."""
        return self.plain.boundary(*args, **kwargs)

    def __repr__(self) -> str:
        return (f"<skfem_mpm {type(self).__name__}({type(self.mesh).__name__}, {type(self.elem).__name__}) object>\n"
                f"  Number of points: {self.nelems}\n  Number of DOFs: {self.N}\n  Functions per point: {self.Nbfun}")


def _leaves(elem: Element) -> list[Element]:
    if isinstance(elem, ElementComposite):
        return [leaf for part in elem.elems for leaf in _leaves(part)]
    return _leaves(elem.elem) if isinstance(elem, ElementVector) else [elem]


def is_linear(elem: Element) -> bool:
    """Whether an element, or every part of a vector or composite one, has the linear functions of a grid."""
    return all(type(leaf) in LINEAR for leaf in _leaves(elem))


def _is_grid(mesh: Mesh) -> bool:
    try:
        Grid.from_mesh(mesh)
    except ValueError:
        return False
    return True


def _nodal_fields(elem: Element, value: ndarray, gradient: ndarray) -> list[tuple[DiscreteField, ...]]:
    """Fields of all unknowns of one node, from its scalar function ``(n, 1)`` and gradient ``(dim, n, 1)``."""
    if isinstance(elem, ElementComposite):
        parts = [_nodal_fields(part, value, gradient) for part in elem.elems]
        empty = [fields[0][0].zeros() for fields in parts]
        return [tuple(empty[:k]) + field + tuple(empty[k + 1:]) for k, fields in enumerate(parts) for field in fields]
    if isinstance(elem, ElementVector):
        return [(DiscreteField(_component(value, i, elem.dim), _component(gradient, i, elem.dim)),)
                for i in range(elem.dim)]
    return [(DiscreteField(value, gradient),)]


def _component(array: ndarray, i: int, dim: int) -> ndarray:
    full = np.zeros((dim,) + array.shape)
    full[i] = array
    return full
