r"""Ghost penalty: the stiffness that small cuts lack, borrowed from the cells beside them.

A cell that the body only just reaches gives its outer nodes next to no stiffness.  Between it and its neighbours jumps
of the normal gradient are penalised, with the displacement of the step,

.. math:: j(u, w) = \gamma E h \int_\Gamma [\![\partial_n u]\!] \cdot [\![\partial_n w]\!] \, d\Gamma ,

on the faces :math:`\Gamma` between two cells in play of which one is a cut cell.  Affine fields have no jump.
E. Burman, "Ghost penalty", C. R. Math. 348 (2010); for material points W. M. Coombs, IJNME (2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array, csc_array, kron
from skfem import BilinearForm, Dofs, ElementHex1, ElementLineP1, ElementQuad1, InteriorFacetBasis, Mesh, asm
from skfem.helpers import dot, grad, jump

from .grid import Grid, touched_cells, wider

ELEMENTS = {1: ElementLineP1, 2: ElementQuad1, 3: ElementHex1}


@BilinearForm
def _jumps(u: Any, v: Any, w: Any) -> Any:
    """One component; ``w.measure`` is the radius in axial symmetry."""
    du, dv = jump(w, dot(grad(u), w.n), dot(grad(v), w.n))
    return w.width * w.measure * du * dv


def ghost_stiffness(mesh: Mesh, support: Any, in_play: ndarray, factor: float) -> csc_array:
    r"""The matrix of the ghost penalty over the components of solved and slaved nodes.

    It takes what lies beside the cut cells out of the mesh, so empty cells cost nothing.

    Parameters
    ----------
    support
        What a step knows of its grid: ``grid``, ``planes``, ``sound``, ``number`` and more.
    in_play
        Mask over the cells of the grid that carry the body, one index per axis.  Faces of cells with nodes that are
        neither solved nor slaved are left out.
    factor
        :math:`\gamma E`.

    Returns
    -------
    csc_array
        Symmetric, positive semi-definite, without effect on affine fields.

    Examples
    --------
    A bar over three cells: each cell is cut or has a cut neighbour, so both faces count.

    >>> from skfem import MeshLine
    >>> from skfem_mpm import METHODS, Particles, uniaxial
    >>> from skfem_mpm.support import Support
    >>> mesh = MeshLine([0.0, 1.0, 2.0, 3.0])
    >>> support = Support(mesh, Particles.fill(mesh, uniaxial), METHODS["mpm"], "ghost", [])
    >>> ghost_stiffness(mesh, support, support.occupied, 1.0).toarray().round(12).tolist()
    [[1.0, -2.0, 1.0, 0.0], [-2.0, 5.0, -4.0, 1.0], [1.0, -4.0, 5.0, -2.0], [0.0, 1.0, -2.0, 1.0]]
    """
    grid, size = support.grid, support.transfer.shape[0]
    cut = cut_cells(grid, in_play, support.planes)
    sound = in_play & support.sound
    strip = sound & wider(cut & sound)
    if not strip.any():
        return csc_array((size, size))
    part, vertices = mesh.restrict(grid.cells[strip], return_mapping=True, skip_boundaries=True, skip_subdomains=True)
    inner = (part.f2t[1] >= 0) & cut[strip][part.f2t].any(axis=0)
    if not inner.any():
        return csc_array((size, size))
    matrix = _assemble(part, np.flatnonzero(inner), support.particles.kinematics.hoop)
    known = grid.vertices.ravel()
    order = np.argsort(known)
    nodes = order[np.searchsorted(known, vertices, sorter=order)]
    return _placed(factor * matrix, support.number[:, nodes], size)


def young(moduli: ndarray, places: Sequence[tuple[int, int]]) -> float:
    r"""Young's modulus that fits the normal moduli best, from moduli ``(m, m)`` over gradient rows.

    :math:`E = (M - \lambda)(M + 2\lambda) / (M + \lambda)`, the same in all kinematics and bounded for incompressible
    bodies.  On a line without hoop strain there is :math:`M` alone, and that is taken.
    """
    normal = [row for row, (i, j) in enumerate(places) if i == j]
    block = moduli[np.ix_(normal, normal)]
    m, count = block.diagonal().mean(), len(normal)
    lam = (block.sum() - count * m) / max(count * (count - 1), 1)
    return float((m - lam) * (m + 2 * lam) / (m + lam)) if m > 0 else 0.0


def cut_cells(grid: Grid, in_play: ndarray, planes: Sequence[Any]) -> ndarray:
    """Which cells in play are cut: some neighbour, diagonal ones too, is neither in play nor behind a fixed plane."""
    beyond = Grid(tuple(np.concatenate([[2 * axis[0] - axis[1]], axis, [2 * axis[-1] - axis[-2]]])
                        for axis in grid.axes), np.pad(grid.vertices, 1), np.pad(grid.cells, 1))
    filled = np.pad(in_play, 1)
    for plane in planes:
        filled |= touched_cells(plane.behind(beyond).reshape(beyond.vertices.shape))
    return in_play & wider(~filled)[(slice(1, -1),) * grid.dim]


def _assemble(mesh: Mesh, faces: ndarray, hoop: bool) -> coo_array:
    """The form on some faces of a mesh, for one component and a unit factor."""
    origin, elem = mesh.p.min(axis=1, keepdims=True), ELEMENTS[mesh.dim()]()
    mesh = type(mesh)(mesh.p - origin, mesh.t)            # scikit-fem's inverse maps want coordinates of a cell's size
    dofs = Dofs(mesh, elem)
    sides = [InteriorFacetBasis(mesh, elem, facets=faces, side=side, intorder=3, dofs=dofs, disable_doflocs=True)
             for side in (0, 1)]
    middle = mesh.p[:, mesh.t].mean(axis=1)[:, mesh.f2t[:, faces]]
    width = np.linalg.norm(middle[:, 1] - middle[:, 0], axis=0)      # from middle to middle: mean of both widths
    measure = origin[0] + np.asarray(sides[0].global_coordinates())[0] if hoop else np.ones((1, 1))
    return coo_array(asm(_jumps, sides, sides, width=width[:, None], measure=measure))


def _placed(scalar: coo_array, number: ndarray, size: int) -> csc_array:
    """The same matrix for each component, at the places ``number (dim, n)`` of its rows."""
    dim = len(number)
    entries = coo_array(kron(scalar, np.eye(dim), format="coo"))
    place = number.T.ravel()
    row, column = (place[index] for index in entries.coords)
    return csc_array((entries.data, (row, column)), shape=(size, size))
