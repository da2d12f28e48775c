r"""Polynomials fitted to what points carry, cell by cell: stress as a field.

In a unit (a cell as one part of the body covers it) a field takes the value
:math:`s(x) = \sum_p R_p(x)\, s_p` with :math:`R_p(x) = \phi(x)^T Q\, \phi_p\, \omega_p`.  Here :math:`\phi` are
monomials in :math:`\xi = (x - x_c) / h`, :math:`\omega_p = e^{-\kappa |\xi_p|^2}`, and the sum is over the points of
the cells around.  Without a :math:`\kappa` the weights are :math:`\omega_p = \prod_k \max(0, 1 - |\xi_{pk}|)`, those of
linear interpolation between the middles of equal cells, :math:`\sum_c \omega_{cp} x_c = x_p`.  With
:math:`Q = A^{-1}`, :math:`A = \sum_p \omega_p \phi_p \phi_p^T`, that is the weighted least-squares fit.

As it is, :math:`Q` is built degree by degree, and directions in which the points do not tell a slope (or a curvature)
apart are left out: the fit is constant along a row of single points, linear across it.  So it needs no fall-back by
layout, always reproduces constants, and depends continuously on the points.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy import ndarray

from ..cover import Cover
from ..grid import chunks

FLAT = (0.0, 0.004, 4e-4)       # of each degree: eigenvalues of A below this share of its weight are damped
FAR = 300.0                     # exponents of weights end here: next to much smaller cells none of them is zero


def monomials(xi: ndarray, order: int) -> ndarray:
    """Monomials of at most ``order`` (1 or 2) in local coordinates ``(dim, n)``, constants first, ``(nb, n)``."""
    rows = [np.ones(xi.shape[1]), *xi]
    if order == 2:
        rows += [xi[i] * xi[j] for i, j in itertools.combinations_with_replacement(range(len(xi)), 2)]
    return np.stack(rows)


class Fit:
    """Fits in all units of a cover.

    Parameters
    ----------
    cover
        What is covered.
    order
        Degree of the polynomials, 1 or 2.
    kappa
        How fast weights fall with distance from the middle of a cell; ``None`` for those of linear interpolation.
    reach
        How many cells away, along each axis, points still count.

    Attributes
    ----------
    Q
        ``(units, nb, nb)``.
    weight
        ``(units,)``; sum of the weights of the points, zero where there are none.
    """

    def __init__(self, cover: Cover, order: int, kappa: float | None, reach: int = 1):
        self.cover, self.order, self.kappa, self.reach = cover, order, kappa, reach
        grid = cover.grid
        index = np.unravel_index(cover.cells, grid.cells.shape)
        self.width = np.stack([grid.steps[k][index[k]] for k in range(grid.dim)])
        self.middle = np.stack([grid.axes[k][index[k]] for k in range(grid.dim)]) + self.width / 2
        self.around = cover.neighbours(reach)
        degrees = monomial_degrees(grid.dim, order)
        gram = self._gram(len(degrees))
        self.weight = gram[:, 0, 0]
        self.Q = filtered_inverse(gram, degrees)

    def local(self, unit: ndarray, x: ndarray) -> ndarray:
        """Positions in local coordinates of units."""
        return (x - self.middle[:, unit]) / self.width[:, unit]

    def pairs(self) -> Iterator[tuple[tuple[int, ...], ndarray, ndarray, ndarray]]:
        """Points and units near them, some at a time: offset of the unit's cell, points, units, weighted monomials."""
        x = self.cover.particles.x
        for offset, unit in self.around:
            near = np.flatnonzero(unit >= 0)
            for part in chunks(len(near)):
                xi = self.local(unit[near[part]], x[:, near[part]])
                weight, points = self._weights(xi), near[part]
                felt = weight > 0
                if not felt.all():
                    weight, points, xi = weight[felt], points[felt], xi[:, felt]
                if len(points):
                    yield offset, points, unit[points], monomials(xi, self.order) * weight

    def _weights(self, xi: ndarray) -> ndarray:
        """Weights of points at local coordinates ``(dim, n)``."""
        if self.kappa is None:
            return np.maximum(1 - np.abs(xi), 0).prod(axis=0)
        return np.exp(-np.minimum(self.kappa * (xi ** 2).sum(axis=0), FAR))

    def _gram(self, nb: int) -> ndarray:
        units = len(self.cover.keys)
        gram = np.zeros((units, nb, nb))
        for _, points, unit, weighted in self.pairs():
            phi = weighted / weighted[0]
            for i in range(nb):
                for j in range(i, nb):
                    gram[:, i, j] += np.bincount(unit, weights=weighted[i] * phi[j], minlength=units)
        upper, right = np.triu_indices(nb)
        gram[:, right, upper] = gram[:, upper, right]
        return gram

    @cached_property
    def moments(self) -> tuple[ndarray, ndarray]:
        """Integrals over units: of the monomials, and of these times what corner nodes have in a gradient.

        The first are ``(units, nb)``, the others ``(units, tables, corners, nb)``: slopes along the axes, then in axial
        symmetry values over radius.
        """
        grid, cover, ring = self.cover.grid, self.cover, self.cover.particles.kinematics.hoop
        unit, x, area = cover.quadrature(self.order + max(grid.dim - 1 + ring, 2 * ring))
        phi, units = monomials(self.local(unit, x), self.order), len(cover.keys)
        measure = area * x[0] if ring else area

        def sums(weight: ndarray) -> ndarray:
            return np.stack([np.bincount(unit, weights=weight * row, minlength=units) for row in phi], axis=1)

        stencil = grid.linear(x, np.stack(np.unravel_index(cover.cells[unit], grid.cells.shape)))
        tables = [row * measure for row in stencil.gradient()] + ([stencil.value() * area] if ring else [])
        corner = np.stack([np.stack([sums(row) for row in table], axis=1) for table in tables], axis=1)
        return sums(measure), corner

    def blend(self, share: ndarray) -> None:
        """Take ``share (units,)`` of the fit by constants instead, whose weights are never negative."""
        constant = np.zeros_like(self.Q)
        held = self.weight > 0
        constant[held, 0, 0] = 1 / self.weight[held]
        self.Q += share[:, None, None] * (constant - self.Q)


def monomial_degrees(dim: int, order: int) -> ndarray:
    """Degree of each monomial, ``(nb,)``."""
    return np.repeat(np.arange(order + 1), [1, dim, dim * (dim + 1) // 2][:order + 1])


def filtered_inverse(gram: ndarray, degrees: ndarray) -> ndarray:
    r"""Inverses of Gram matrices ``(units, nb, nb)``, degree by degree.

    What a degree adds is orthogonal to those below, and its Schur complement is inverted eigenvalue by eigenvalue:
    :math:`1/\lambda`, or :math:`\lambda/\tau^2` below the threshold :math:`\tau`.
    """
    units, nb, _ = gram.shape
    inverse = np.zeros_like(gram)
    weight = np.where(gram[:, 0, 0] > 0, gram[:, 0, 0], 1.0)
    inverse[:, 0, 0] = np.where(gram[:, 0, 0] > 0, 1 / weight, 0.0)
    for degree in range(1, degrees.max() + 1):
        below, own = np.flatnonzero(degrees < degree), np.flatnonzero(degrees == degree)
        across = gram[:, below][:, :, own]
        slope = inverse[:, below][:, :, below] @ across                      # regression on the lower degrees
        schur = gram[:, own][:, :, own] - across.transpose(0, 2, 1) @ slope
        value, vector = np.linalg.eigh(schur / weight[:, None, None])
        flat = FLAT[degree]
        factor = np.where(value > flat, 1 / np.where(value > flat, value, 1.0), np.maximum(value, 0) / flat ** 2)
        block = (vector * (factor / weight[:, None])[:, None]) @ vector.transpose(0, 2, 1)
        full = np.zeros((units, nb, len(own)))
        full[:, below], full[:, own] = -slope, np.eye(len(own))
        inverse += full @ block @ full.transpose(0, 2, 1)
    return inverse
