r"""The operators :math:`G` (gradient) and :math:`L` (force) of a step, and what is made of them.

Internal force is :math:`f = L\,\Pi(G u)` with the stress relative to the start of the step, its tangent
:math:`L\,\mathbb A\,G`; there is no other geometric term.  Nodal arrays are ``(dim, nnodes)``, nodes numbered as in the
stencil.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy import ndarray
from scipy.sparse import csc_array

from ..grid import Stencil, chunks, scatter_add
from ..kinematics import Kinematics


class Functions(Protocol):
    """What points see of a grid: nodes, and tables of a number for each.

    Attributes
    ----------
    base
        ``(dim, n)``; first node of each point along each axis.
    width
        Nodes per axis, ``K``.
    shape
        Number of nodes of the grid along each axis.
    """

    base: ndarray
    width: int
    shape: tuple[int, ...]

    def nodes(self, part: slice) -> ndarray:
        """Nodes seen by some of the points, ``(K**dim, n)``."""

    def tables(self, part: slice) -> list[ndarray]:
        """Slopes along the axes, then in axial symmetry value over radius, ``(K**dim, n)`` each."""


class OfStencil:
    """Functions as a stencil has them.

    Parameters
    ----------
    radius
        ``(n,)``; the first coordinate in axial symmetry, else ``None``.
    """

    def __init__(self, stencil: Stencil, radius: ndarray | None):
        self.stencil, self.radius = stencil, radius
        self.base, self.width, self.shape = stencil.base, stencil.w.shape[2], stencil.shape
        self.nodes = stencil.nodes

    def tables(self, part: slice) -> list[ndarray]:
        """Slopes along the axes, then in axial symmetry value over radius."""
        tables = list(self.stencil.gradient(part))
        return tables if self.radius is None else tables + [self.stencil.value(part, plain=True) / self.radius[part]]


class OfTable:
    """Functions with a number of their own for each node of a point; they need not be products over the axes.

    Parameters
    ----------
    table
        ``(dim, K**dim, n)``, in axial symmetry ``(dim + 1, K**dim, n)``.
    """

    def __init__(self, base: ndarray, table: ndarray, shape: tuple[int, ...]):
        self.base, self.table, self.shape = base, table, shape
        self.width = round(table.shape[1] ** (1 / len(shape)))

    def nodes(self, part: slice) -> ndarray:
        """Nodes seen by some of the points, ``(K**dim, n)``; those off the grid repeat one on it."""
        dim = len(self.shape)
        place = self.base[:, None, part] + np.indices((self.width,) * dim).reshape(dim, -1)[:, :, None]
        return np.ravel_multi_index(tuple(place), self.shape, mode="clip")

    def tables(self, part: slice) -> list[ndarray]:
        """Slopes along the axes, then in axial symmetry value over radius."""
        return list(self.table[:, :, part])


class Pair:
    """The operators of a step: functions that carry force and functions that recover strain.

    Parameters
    ----------
    kinematics
        Which gradient rows there are.
    force, strain
        The functions; the same object for conjugate pairs.
    volume
        ``(n,)``; what stress is multiplied with, weighted volumes at the start of the step.
    """

    def __init__(self, kinematics: Kinematics, force: Functions, strain: Functions, volume: ndarray):
        self.force_functions, self.strain_functions, self.volume = force, strain, volume
        self.dim = len(force.shape)
        self.rows = kinematics.rows(self.dim)
        # Row q of the gradient takes component i of a vector through table l: slopes along the axes, then value / r.
        place = [(0, self.dim) if kinematics.hoop and q == self.dim ** 2 else ij for q, ij in enumerate(self.rows)]
        self.terms = [[(q, l) for q, (component, l) in enumerate(place) if component == i] for i in range(self.dim)]

    @property
    def width(self) -> int:
        """Nodes per axis of the wider functions."""
        return max(self.force_functions.width, self.strain_functions.width)

    def gradient(self, u: ndarray) -> ndarray:
        """:math:`G u`: displacement gradient at the points, ``(m, n)``."""
        out = np.empty((len(self.rows), self.volume.size))
        for part in chunks(out.shape[1]):
            nodes, tables = self.strain_functions.nodes(part), self.strain_functions.tables(part)
            for i, terms in enumerate(self.terms):
                local = u[i][nodes]
                for q, l in terms:
                    out[q, part] = np.einsum("kn,kn->n", tables[l], local)
        return out

    def force(self, piola: ndarray) -> ndarray:
        r""":math:`L \Pi`: internal force, ``(dim, nnodes)``, from point stress ``(m, n)``."""
        out = np.zeros((self.dim, int(np.prod(self.force_functions.shape))))
        for part in chunks(piola.shape[1]):
            nodes, tables = self.force_functions.nodes(part), self.force_functions.tables(part)
            stress = piola[:, part] * self.volume[part]
            for i, terms in enumerate(self.terms):
                scatter_add(out[i], nodes, sum(tables[l] * stress[q] for q, l in terms))
        return out

    def tangent(self, moduli: ndarray, number: ndarray, size: int) -> csc_array:
        r""":math:`L\,\mathbb A\,G` as a sparse matrix.

        Parameters
        ----------
        moduli
            ``(m, m, n)`` or ``(m, m, 1)``; derivative of point stress by the gradient.
        number
            ``(dim, nnodes)``; row and column of each unknown, ascending with node and component; -1 for none.
        size
            Number of unknowns.

        Notes
        -----
        On a tensor grid a node couples to neighbours within a fixed reach, so each pair of nodes has a place in a dense
        table *column node x offset of the row node*: sums need no search and no sorting.
        """
        reach, dim = self._reach(), self.dim
        known, compact = self._known(number)
        table = np.zeros((dim, dim, (len(known) + 1) * (2 * reach + 1) ** dim))
        for part in self._pieces():
            slot = self._slots(part, reach, compact)
            for k, i, values in self._pairs(moduli, part):
                scatter_add(table[k, i], slot, values)
        return self._to_csc(table.reshape(dim, dim, len(known) + 1, -1)[:, :, :-1], reach, known, number, size)

    def _known(self, number: ndarray) -> tuple[ndarray, ndarray]:
        """Nodes with unknowns, and the column of each node in the table; all others share the last, dropped after."""
        known = np.flatnonzero((number >= 0).any(axis=0))
        compact = np.full(number.shape[1], len(known))
        compact[known] = np.arange(len(known))
        return known, compact

    def _pairs(self, moduli: ndarray, part: slice) -> Iterator[tuple[int, int, ndarray]]:
        """Contributions ``(nodes of force, nodes of strain, points)`` to column component k and row component i."""
        of_force = self.force_functions.tables(part)
        of_strain = of_force if self.strain_functions is self.force_functions else self.strain_functions.tables(part)
        scaled = (moduli if moduli.shape[2] == 1 else moduli[:, :, part]) * self.volume[part]
        for k, columns in enumerate(self.terms):
            stress = [sum(scaled[q, r] * of_strain[l] for r, l in columns) for q in range(len(self.rows))]
            for i, rows in enumerate(self.terms):
                yield k, i, sum(of_force[l][:, None] * stress[q] for q, l in rows)

    def _pieces(self) -> Iterator[slice]:
        """Smaller pieces for wider stencils, so that the pairs of a piece stay in the cache."""
        width = self.force_functions.width * self.strain_functions.width
        size = max(64, 4 ** self.dim * 16384 // width ** self.dim)
        return (slice(start, start + size) for start in range(0, self.volume.size, size))

    def _reach(self) -> int:
        shift = self.force_functions.base - self.strain_functions.base
        return int(max(shift.max() + self.force_functions.width, self.strain_functions.width - shift.min())) - 1

    def _slots(self, part: slice, reach: int, compact: ndarray) -> ndarray:
        """Place of each pair in the table, ``(nodes of force, nodes of strain, points)``."""
        force, strain, span = self.force_functions, self.strain_functions, 2 * reach + 1
        shift = force.base[:, part] - strain.base[:, part] + reach
        rows = np.indices((force.width,) * self.dim).reshape(self.dim, -1)
        columns = np.indices((strain.width,) * self.dim).reshape(self.dim, -1)
        power = span ** np.arange(self.dim)[::-1]
        start = compact[strain.nodes(part)] * span ** self.dim - (power @ columns)[:, None]
        return (power @ rows)[:, None, None] + (start + power @ shift)

    def _to_csc(self, table: ndarray, reach: int, known: ndarray, number: ndarray, size: int) -> csc_array:
        """The table ``(component k, component i, column node, offset)`` without its zeros, as a sparse matrix."""
        dim, span = self.dim, 2 * reach + 1
        value = table.transpose(2, 0, 3, 1).ravel()                                  # node, k, offset, i
        kept = np.flatnonzero(value)
        column, rest = np.divmod(kept, span ** dim * dim)
        offset, i = np.divmod(rest, dim)
        node, k = np.divmod(column, dim)
        stride = np.cumprod([1, *self.force_functions.shape[:0:-1]])[::-1]
        step = (np.indices((span,) * dim).reshape(dim, -1) - reach).T @ stride
        row, column = number[i, known[node] + step[offset]], number[k, known[node]]
        wanted = (row >= 0) & (column >= 0)
        count = np.bincount(column[wanted], minlength=size)
        return csc_array((value[kept[wanted]], row[wanted].astype(np.int32),
                          np.concatenate([[0], np.cumsum(count)]).astype(np.int32)), shape=(size, size))


def on_points(kinematics: Kinematics, force: Stencil, strain: Stencil, volume: ndarray, radius: ndarray) -> Pair:
    """The pair whose quadrature are the points, :math:`L = V G` where force and strain have one stencil.

    Parameters
    ----------
    force, strain
        Stencils that carry force and recover strain; the same one for conjugate pairs.
    volume
        ``(n,)``; weighted volumes at the start of the step.
    radius
        ``(n,)``; the first coordinate, for the hoop row.
    """
    r = radius if kinematics.hoop else None
    of_force = OfStencil(force, r)
    return Pair(kinematics, of_force, of_force if strain is force else OfStencil(strain, r), volume)
