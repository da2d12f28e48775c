r"""Double mapping: what points carry goes to the nodes of a cell, and from there to its Gauss points.

After the idea of Gonzalez Acosta, Vardon, Remmerswaal and Hicks, *An investigation of stress inaccuracies and proposed
solution in the material point method*, Computational Mechanics 65 (2020), doi 10.1007/s00466-019-01783-3.  **A
reconstruction**: the formulas below are ours, and were not compared with the text of that paper.

With the functions :math:`S^e_{Jp}` of point :math:`p` in cell :math:`e` and :math:`v^e_J = \int_e N_J\,dV`, anything
that points carry takes at a Gauss point :math:`g` of the cell the value

.. math:: D_g = \sum_p M_{gp} D_p, \qquad M_{gp} = \sum_J N_J(x_g)\, S^e_{Jp} V_p / v^e_J .

Cells are integrated in full, whatever their fill: a cell that is half empty has moduli that fall across it, and
:math:`\sum_g w_g D_g = \sum_p V_p D_p` always.  All that is a product over the axes, and is kept as such.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array, csc_array, csr_array

from .. import shapes
from ..basis import GIMPBasis
from ..checks import check_choice
from ..grid import PLACES, Grid, Stencil, available_sides, gauss_points
from .field import check_unweighted
from .pair import OfStencil, Pair, on_points
from .points import Integration, Points

VALUE = np.stack([1 - PLACES, PLACES])                  # of a cell's two nodes at its two Gauss points


def local_linear(support: Any) -> list[ndarray]:
    """The functions of the host cell at the points, for each axis ``(1, 2, n)``."""
    grid, x, index = support.grid, support.particles.x, support.index
    return [shapes.linear(x[k], grid.knots(k, index[k]))[0][None] for k in range(grid.dim)]


def local_gimp(support: Any) -> list[ndarray]:
    """Local GIMP, for each axis ``(3, 2, n)``; of domains as GIMP sees them, without nodes off the grid.

    Raises
    ------
    ValueError
        If the points have no domains, or one reaches beyond the neighbours of its cell.
    OutsideGridError
        If a domain leaves the grid and its edge is ``ghost``.
    """
    grid, x, index, length = support.grid, support.particles.x, support.index, support.particles.length
    if length is None:
        raise ValueError("length: the points have none, but double mapping by local GIMP needs their domains; give "
                         "Particles a length (dim, n), or take local='fe'.")
    sides = support.sides_of(GIMPBasis)
    grid.check_reach(x, index, length, support.edges if sides is None else "clip")
    if sides is None:
        sides = available_sides(np.ones(grid.cells.shape, dtype=bool))
    local = []
    for k in range(grid.dim):
        make = shapes.ring_cell_shares if support.ring and k == 0 else shapes.cell_shares
        left, right = (sides[side, k][tuple(index)] for side in (0, 1))
        share, second = make(x[k], length[k] / 2, grid.knots(k, index[k]), left, right)
        local.append(np.stack([share - second, second], axis=1))
    return local


LOCAL = {"fe": local_linear, "gimp": local_gimp}


@dataclass(frozen=True)
class DoubleMapping(Integration):
    r"""Moduli, and perhaps stress, by double mapping: ``dm``, ``dm-g``, ``dm-stress``, ``dm-g-stress``.

    A reconstruction of the published idea (Gonzalez Acosta et al. 2020, doi 10.1007/s00466-019-01783-3), not its text.
    Implicit steps only.  It goes with any method: the published DM-C is ``dm`` with ``cmpm``, DM-GC ``dm-g`` with
    ``gc``.

    Parameters
    ----------
    local
        Functions that map from points to the nodes of a cell.  ``fe``: those of the host cell,
        :math:`S^e_{Ip} = N_I(x_p)`.  ``gimp``: local GIMP,
        :math:`S^e_{Ip} = \frac1{V_p} \int_{\Omega_p \cap \Omega_e} N_I\,dV`, whose sum over the cells is GIMP; moduli
        then move from cell to cell gradually.  It needs domains, and sees them as GIMP would with this method: clipped
        to cells that hold points where the method does not map mass by GIMP, and to the grid unless ``edges`` is
        ``ghost``.
    stress
        ``False``: only the stiffness is mapped, :math:`K_e = \sum_g w_g B_g^T D_g B_g`, as published.  The residual is
        that of the points, so what a step converges to does not change; Newton's method is inexact and converges
        linearly, or stops with ``NotConvergedError`` where points give a cell much less stiffness than the mapping
        does, as in cells that are cut obliquely (``ghost=0.1`` then helps).  ``True``: stress is mapped too,
        :math:`f_I = \sum_g w_g \nabla N_I(x_g)\,\sigma_g`, so force and tangent are consistent and Newton's method is
        quadratic.  (Ours.)

    Raises
    ------
    ValueError, TypeError
        If a choice is unknown.

    Examples
    --------
    >>> from skfem_mpm.scenes import cylinder
    >>> for name in ("points", "dm", "dm-stress"):
    ...     state = next(cylinder(dim=1).run("gc", steps=1, integration=name))
    ...     print(len(state.residuals), round(float(state.reactions["inner"][0]) / 1e3, 3))
    3 417.416
    7 417.416
    3 417.274
    """

    local: str = "fe"
    stress: bool = False

    def __post_init__(self) -> None:
        check_choice("local", self.local, LOCAL)
        if not isinstance(self.stress, bool):
            raise TypeError(f"stress: got {self.stress!r}, expected True to map stress too, or False.")

    @property
    def reads_domains(self) -> bool:
        """Whether the points need a length."""
        return LOCAL[self.local] is local_gimp

    def pair(self, support: Any, force: type, strain: type, weight: ndarray) -> Pair:
        """The operators of a step; with mapped stress force is carried at the Gauss points, not by ``force``."""
        check_unweighted(weight)
        if not self.stress:
            return Points().pair(support, force, strain, weight)
        points = support.particles
        radius = points.x[0] if points.kinematics.hoop else None
        of_force = OfStencil(self._mapped(support).force(radius), radius)
        return Pair(points.kinematics, of_force, OfStencil(support.stencil(strain), radius), points.volume)

    def stiffness(self, support: Any, force: type, strain: type, weight: ndarray, pair: Pair) -> Any:
        """Operators of the tangent: exact with mapped stress, else those of :meth:`conjugate`."""
        return pair if self.stress else self.conjugate(support, force, weight)

    def conjugate(self, support: Any, force: type, weight: ndarray) -> MappedModuli:
        """Operators of the double-mapped stiffness: finite element functions on both sides, symmetric as moduli are."""
        check_unweighted(weight)
        points, mapped = support.particles, self._mapped(support)
        matrix, cells = mapped.to_gauss(points.volume)
        index, x, area = gauss_points(support.grid, cells)
        stencil = support.grid.linear(x, index)
        volume = area * x[0] if points.kinematics.hoop else area
        return MappedModuli(on_points(points.kinematics, stencil, stencil, volume, x[0]), matrix)

    def _mapped(self, support: Any) -> Mapped:
        return Mapped(support.grid, support.index, LOCAL[self.local](support), support.particles.kinematics.hoop)


@dataclass(frozen=True, eq=False)
class MappedModuli:
    """Operators of a tangent whose moduli are mapped from points to the Gauss points of ``pair``.

    Attributes
    ----------
    pair
        Operators at the Gauss points.
    matrix
        ``(Gauss points, points)``.
    """

    pair: Pair
    matrix: csr_array

    @property
    def width(self) -> int:
        """Nodes per axis of the functions."""
        return self.pair.width

    def tangent(self, moduli: ndarray, number: ndarray, size: int) -> csc_array:
        """The stiffness from moduli of the points, see :meth:`Pair.tangent`."""
        m = len(moduli)
        everywhere = np.broadcast_to(moduli, (m, m, self.matrix.shape[1]))
        mapped = self.matrix @ everywhere.reshape(m * m, -1).T
        return self.pair.tangent(np.ascontiguousarray(mapped.T).reshape(m, m, -1), number, size)


class Mapped:
    """The mapping of a step, one factor per axis.

    Parameters
    ----------
    grid
        The part of the mesh around the body.
    index
        ``(dim, n)``; host cells.
    local
        For each axis :math:`S^e`, ``(cells, 2, n)``: in the host alone, or in the left neighbour, the host and the
        right one.
    ring
        Whether the first coordinate is a radius, and part of all integrals.
    """

    def __init__(self, grid: Grid, index: ndarray, local: list[ndarray], ring: bool):
        self.grid, self.local, self.ring = grid, local, ring
        self.reach = len(local[0]) // 2
        around = np.arange(-self.reach, self.reach + 1)[:, None]
        sizes = grid.cells.shape
        # Nothing is mapped to cells off the grid; any other stands for them.
        self.cells = [np.clip(index[k] + around, 0, size - 1) for k, size in enumerate(sizes)]
        self.base = index - self.reach

    def _gauss(self, k: int) -> tuple[ndarray, ndarray]:
        """Positions and weights of the Gauss points along an axis, ``(cells, 2, n)``."""
        step, start = self.grid.steps[k][self.cells[k]], self.grid.axes[k][self.cells[k]]
        x = start[:, None] + step[:, None] * PLACES[:, None]
        weight = np.broadcast_to(step[:, None] / 2, x.shape)
        return x, weight * x if self.ring and k == 0 else weight

    def factor(self, k: int) -> ndarray:
        """What of :math:`M_{gp} / V_p` comes from an axis, ``(cells, 2, n)``."""
        _, weight = self._gauss(k)
        measure = np.einsum("jg,cgn->cjn", VALUE, weight)
        return np.einsum("jg,cjn->cgn", VALUE, self.local[k] / measure)

    def force(self, radius: ndarray | None) -> Stencil:
        r"""Functions that carry force, :math:`\sum_g w_g N_I(x_g) M_{gp} / V_p` and slopes alike, as a stencil.

        With a ``radius (n,)`` plain values are such that they have :math:`N_I / r_g` when divided by it.
        """
        tables = []
        for k in range(self.grid.dim):
            x, weight = self._gauss(k)
            taken = weight * self.factor(k)
            slope = np.stack([-1.0, 1.0])[:, None] * (taken.sum(axis=1) / self.grid.steps[k][self.cells[k]])[:, None]
            rows = [np.einsum("jg,cgn->cjn", VALUE, taken), slope]
            if radius is not None:
                rows.append(np.einsum("jg,cgn->cjn", VALUE, taken / x * radius) if k == 0 else rows[0])
            tables.append(np.stack([_joined(row) for row in rows]))
        return Stencil(self.base, np.stack(tables), self.grid.vertices.shape)

    def to_gauss(self, volume: ndarray) -> tuple[csr_array, ndarray]:
        """The matrix :math:`M` to the Gauss points of the cells that something is mapped to, and these cells."""
        dim, n = self.grid.dim, len(volume)
        factors = [self.factor(k) for k in range(dim)]
        held = [np.asarray(local.any(axis=1)) for local in self.local]
        cell, gauss, point, value = [], [], [], []
        for piece in itertools.product(range(2 * self.reach + 1), repeat=dim):
            here = np.flatnonzero(np.all([mask[c] for mask, c in zip(held, piece)], axis=0))
            number = np.ravel_multi_index([self.cells[k][c][here] for k, c in enumerate(piece)], self.grid.cells.shape)
            for g, place in enumerate(itertools.product(range(2), repeat=dim)):
                cell.append(number)
                gauss.append(np.full(len(here), g))
                point.append(here)
                value.append(volume[here] * np.prod([factors[k][c, place[k]][here] for k, c in enumerate(piece)],
                                                    axis=0))
        cells, which = np.unique(np.concatenate(cell), return_inverse=True)
        row = which * 2 ** dim + np.concatenate(gauss)
        matrix = coo_array((np.concatenate(value), (row, np.concatenate(point))), shape=(len(cells) * 2 ** dim, n))
        return csr_array(matrix), np.stack(np.unravel_index(cells, self.grid.cells.shape))


def _joined(local: ndarray) -> ndarray:
    """Functions of the nodes of neighbouring cells ``(cells, 2, n)``, added up where nodes are shared."""
    out = np.zeros((len(local) + 1, local.shape[2]))
    out[:-1] += local[:, 0]
    out[1:] += local[:, 1]
    return out
