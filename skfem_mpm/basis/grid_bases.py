"""The bases that exist on axis-aligned grids only: GIMP and CMPM."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Dofs, Mesh
from skfem.element import Element

from ..checks import check_choice
from ..grid import EDGES, Edges, Grid, Stencil, available_sides, cell_mask
from ..particles import Particles
from .particle import ParticleBasis, is_linear


class _OnGrid(ParticleBasis):
    """A basis that exists on axis-aligned grids with linear elements only."""

    def _place(self, cells: ndarray | None) -> tuple[ndarray, Stencil | None]:
        if not is_linear(self.elem):
            raise ValueError(f"elem: got {type(self.elem).__name__}, expected ElementLineP1, ElementQuad1 or "
                             f"ElementHex1, or a vector or composite of it, for {type(self).__name__}.")
        return self._place_on_grid()


class GIMPBasis(_OnGrid):
    """Points of finite size: functions averaged over a domain, Eq. (6) of Gonzalez Acosta et al. (2017).

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh; cells may have different widths.
    elem
        The linear element, or a vector or composite of it.
    particles
        Need a ``length (dim, n)``, the edges of their domains.
    edges
        What happens at the edge of the grid: ``ghost`` wants a spare layer of cells, ``truncate`` drops the nodes that
        do not exist as the paper did (functions then no longer sum to one), ``clip`` cuts domains off and renormalises.

    Raises
    ------
    OutsideGridError
        If a point has left the grid, or a domain has and ``edges`` is ``ghost``.
    ValueError
        If the mesh is not axis-aligned, the element not linear, a length is missing, or a domain reaches beyond the
        neighbours of its cell.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import ElementLineP1, MeshLine
    >>> from skfem_mpm import Particles, uniaxial
    >>> points = Particles(np.array([[0.5]]), np.array([0.1]), np.array([1.0]), uniaxial, length=np.array([[0.1]]))
    >>> GIMPBasis(MeshLine().refined(2), ElementLineP1(), points).value.T.round(12).tolist()
    [[0.05, 0.9, 0.05]]
    """

    reads_domains = True

    def __init__(self, mesh: Mesh, elem: Element, particles: Particles, edges: Edges = "ghost",
                 dofs: Dofs | None = None):
        check_choice("edges", edges, EDGES)
        self.edges = edges
        super().__init__(mesh, elem, particles, dofs=dofs)

    def _choices(self, grid: Grid, cells: ndarray) -> dict[str, Any]:
        return {"length": self.particles.length, "edges": self.edges}

    @classmethod
    def stencil_of(cls, grid: Grid, x: ndarray, index: ndarray, length: ndarray | None = None, edges: Edges = "ghost",
                   sides: ndarray | None = None, ring: bool = False) -> Stencil:
        """Stencil of GIMP; ``sides`` clips the domains to available cells, ``ring`` puts the radius into the mean."""
        if length is None:
            raise ValueError("length: the points have none, but GIMP averages over domains; give Particles a length "
                             "(dim, n).")
        return grid.gimp(x, index, length, edges, sides, ring)

    def _options(self) -> dict[str, Any]:
        return {"edges": self.edges}


class CMPMBasis(_OnGrid):
    """Points that recover fields through the nodes of their cell and its neighbours: CMPM, Eqs. (7) and (8).

    Its functions take negative values: use them for strains, never for mass.

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh; cells may have different widths.
    elem
        The linear element, or a vector or composite of it.
    particles
        The points.
    occupied
        Cells that hold material, a mask or anything that ``mesh.normalize_elements`` takes; the cells of the points if
        not given.  Patches reach into occupied neighbours only, for values elsewhere mean nothing.

    Raises
    ------
    OutsideGridError
        If a point has left the grid.
    ValueError
        If the mesh is not axis-aligned or the element not linear.

    Examples
    --------
    >>> from skfem import ElementLineP1, MeshLine
    >>> from skfem_mpm import Particles, uniaxial
    >>> mesh = MeshLine().refined(3)
    >>> basis = CMPMBasis(mesh, ElementLineP1(), Particles.fill(mesh, uniaxial))
    >>> x = basis.global_coordinates()
    >>> bool(abs(basis.interpolate(mesh.p[0] ** 2).grad[0] - 2 * x[0]).max() < 1e-13)
    True
    """

    def __init__(self, mesh: Mesh, elem: Element, particles: Particles, occupied: Any = None, dofs: Dofs | None = None):
        self.occupied = occupied
        super().__init__(mesh, elem, particles, dofs=dofs)

    def _choices(self, grid: Grid, cells: ndarray) -> dict[str, Any]:
        if self.occupied is None:
            self.occupied = np.unique(cells)
        return {"sides": available_sides(cell_mask(self.mesh, self.occupied)[grid.cells])}

    @classmethod
    def stencil_of(cls, grid: Grid, x: ndarray, index: ndarray, length: ndarray | None = None, edges: Edges = "ghost",
                   sides: ndarray | None = None, ring: bool = False) -> Stencil:
        """Stencil of CMPM; ``sides`` tells which neighbours its patches reach into (by occupied cells if not given)."""
        return grid.cmpm(x, index, available_sides(grid.occupied(index)) if sides is None else sides)

    def _options(self) -> dict[str, Any]:
        return {"occupied": self.occupied}


class CubicBasis(CMPMBasis):
    """CMPM whose patches keep four nodes per axis at edges too: cubic wherever the body is three cells wide.

    At an edge the patch takes the node beyond the neighbour it has, so recovered strains are third order there too;
    CMPM's are second order.  (Ours.)  The parameters are those of :class:`CMPMBasis`.

    Examples
    --------
    >>> from skfem import ElementLineP1, MeshLine
    >>> from skfem_mpm import Particles, uniaxial
    >>> mesh = MeshLine().refined(3)
    >>> basis = CubicBasis(mesh, ElementLineP1(), Particles.fill(mesh, uniaxial))
    >>> x = basis.global_coordinates()
    >>> bool(abs(basis.interpolate(mesh.p[0] ** 3).grad[0] - 3 * x[0] ** 2).max() < 1e-13)
    True
    """

    @classmethod
    def stencil_of(cls, grid: Grid, x: ndarray, index: ndarray, length: ndarray | None = None, edges: Edges = "ghost",
                   sides: ndarray | None = None, ring: bool = False) -> Stencil:
        """Stencil of CMPM with cubic patches; see :meth:`CMPMBasis.stencil_of`."""
        return grid.cubic(x, index, available_sides(grid.occupied(index)) if sides is None else sides)
