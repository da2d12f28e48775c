r"""Means over cells against volumetric locking, and what they add to the operators of a step.

The mean of point quantities over cells is :math:`A = O W^{-1} O^T V` with the shares :math:`O_{pe}` that points have in
cells (the host cell alone for linear functions, overlaps for GIMP domains), volumes :math:`V` and
:math:`W_e = \sum_p O_{pe} V_p`.  It is its own transpose with respect to volumes, :math:`V A = A^T V`, so what takes
the mean of the dilation takes the same mean of the pressure, and operators stay symmetric.  Constants stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csc_array, csr_array, diags_array

from ..grid import Grid, Stencil
from .pair import Functions, Pair

PIECE = 65536    # points whose gradients are sparse rows at once


def shares_of(grid: Grid, stencil: Stencil) -> csr_array:
    """Shares of the domains of points in the cells of a grid, ``(n, cells)``, from what their functions are.

    Parameters
    ----------
    grid
        The cells, numbered along the axes, the last one fastest.
    stencil
        Linear functions, or those of GIMP, of the points.
    """
    shape = grid.cells.shape
    cells = [np.clip(stencil.base[k] + np.arange(stencil.w.shape[2] - 1)[:, None], 0, size - 1)
             for k, size in enumerate(shape)]
    # Along an axis the table holds means of hat functions over the domain: slopes are differences of share / width.
    # Rounding must leave no share below zero: means would no longer be between what they are means of.
    share = [np.maximum(-np.cumsum(stencil.w[k, 1, :-1], axis=0), 0) * grid.steps[k][cells[k]] for k in range(grid.dim)]
    cell, part = cells[0].T, share[0].T
    for k in range(1, grid.dim):
        cell = (cell[:, :, None] * shape[k] + cells[k].T[:, None]).reshape(len(cell), -1)
        part = (part[:, :, None] * share[k].T[:, None]).reshape(len(part), -1)
    start = np.arange(0, cell.size + 1, cell.shape[1])
    return csr_array((part.ravel(), cell.ravel(), start), shape=(len(cell), int(np.prod(shape))))


class Means:
    """Means over cells of point quantities; made anew in every step.

    Parameters
    ----------
    shares
        ``(n, cells)``; of the points in the cells, see :func:`shares_of`.
    volume
        ``(n,)``; weights of the points.
    """

    def __init__(self, shares: csr_array, volume: ndarray):
        self.shares, self.volume = shares, volume
        self.held = shares.T @ volume

    def of_cells(self, values: ndarray) -> ndarray:
        """Mean of ``values (n,)`` in each cell, ``(cells,)``; zero where there are no points."""
        sums = self.shares.T @ (self.volume * values)
        return np.divide(sums, self.held, out=np.zeros_like(sums), where=self.held > 0)

    def lack(self, values: ndarray) -> ndarray:
        """What ``values (n,)`` lack of their means, :math:`(A - 1) v`."""
        return self.shares @ self.of_cells(values) - values


@dataclass(frozen=True, eq=False)
class Spread:
    r"""Derivative of point stress by the gradients :math:`a` of all points that share a cell.

    .. math:: d\Pi = D a + l\, A (g \cdot a) + g\, A (r \cdot a) + g\, A (c\, A (g \cdot a))

    Attributes
    ----------
    local
        :math:`D`, ``(m, m, n)`` or ``(m, m, 1)``.
    left, right, normal
        :math:`l`, :math:`r` and :math:`g`, ``(m, n)`` or ``(m, 1)``.
    bulk
        :math:`c`, ``(n,)`` or ``(1,)``.
    """

    local: ndarray
    left: ndarray
    right: ndarray
    normal: ndarray
    bulk: ndarray


class AveragedPair:
    """A pair of operators whose points answer to the mean dilation of their cells.

    Parameters
    ----------
    pair
        The operators.
    means
        The means, weighted with the volumes of the pair.
    """

    def __init__(self, pair: Pair, means: Means):
        self.pair, self.means = pair, means
        self.gradient, self.force, self.width, self.volume = pair.gradient, pair.force, pair.width, pair.volume

    def tangent(self, moduli: Spread, number: ndarray, size: int) -> csc_array:
        r""":math:`L\, \frac{d\Pi}{da}\, G` as a sparse matrix, see :meth:`Pair.tangent`."""
        return self.pair.tangent(moduli.local, number, size) + self._coupling(moduli, number, size)

    def _coupling(self, moduli: Spread, number: ndarray, size: int) -> csc_array:
        """What points of a cell have to do with each other: products of sums over cells."""
        def sums(functions: Functions, rows: ndarray) -> csr_array:
            return self._sums(functions, rows, number, size)

        means, force, strain = self.means, self.pair.force_functions, self.pair.strain_functions
        share = diags_array(np.divide(1.0, means.held, out=np.zeros_like(means.held), where=means.held > 0))
        bulk = means.shares.T @ diags_array(means.volume * moduli.bulk) @ means.shares
        dilation = share @ sums(strain, moduli.normal)
        pressure = share @ (sums(strain, moduli.right) + bulk @ dilation)
        of_left, of_normal = (sums(force, rows).T for rows in (moduli.left, moduli.normal))
        return csc_array(of_left @ dilation + of_normal @ pressure)

    def _sums(self, functions: Functions, rows: ndarray, number: ndarray, size: int) -> csr_array:
        """Sums over cells of volume times ``rows . gradient``, from the unknowns, ``(cells, size)``."""
        means: Any = self.means
        rows = np.broadcast_to(rows, (len(rows), means.volume.size))
        total = csr_array((means.shares.shape[1], size))
        for start in range(0, means.volume.size, PIECE):
            part = slice(start, start + PIECE)
            weighted = self._contracted(functions, means.volume[part] * rows[:, part], part, number, size)
            total = total + means.shares[part].T @ weighted
        return total

    def _contracted(self, functions: Functions, rows: ndarray, part: slice, number: ndarray, size: int) -> csr_array:
        """``rows . gradient`` of some of the points from the unknowns, ``(points, size)``."""
        nodes, tables = functions.nodes(part), functions.tables(part)
        value = np.concatenate([sum(tables[l] * rows[q] for q, l in terms) for terms in self.pair.terms]).T
        column = np.concatenate([number[i][nodes] for i in range(self.pair.dim)]).T
        start = np.arange(0, value.size + 1, value.shape[1])
        value, column = np.where(column < 0, 0.0, value), np.maximum(column, 0)
        return csr_array((value.ravel(), column.ravel(), start), shape=(len(value), size))
