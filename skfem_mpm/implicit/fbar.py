r"""Variational F-bar and B-bar: points answer to the mean dilation of their cells.

With the mean :math:`A` over cells, :math:`d` normal components and the deformation gradient :math:`F` of a step,

.. math:: \ln \bar J = A \ln J, \qquad \bar F = s F, \quad s = e^{(\ln\bar J - \ln J)/d}, \qquad
          E = \sum_p V_p W(\bar F_p).

The stress that goes with this potential is, with :math:`\bar P = P(\bar F)` and :math:`p = \bar P : \bar F / d`,

.. math:: \Pi = s \bar P + (A p - p)\, F^{-T},

so its tangent is symmetric wherever that of :math:`P` is and force is conjugate to strain.  Small strain takes the mean
of the trace of the increment instead: :math:`s = 1` and :math:`F = 1` in these formulas.

de Souza Neto et al. (1996), and Coombs et al. (2018) for material points, integrate the Cauchy stress at
:math:`\bar F` with the gradients of :math:`F`: without potential, and with an unsymmetric tangent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..basis import ParticleBasis
from ..grid import Edges, Grid
from ..integration.dilation import Means, Spread, shares_of
from ..kinematics import Response
from ..kinematics.blocks import deformation, determinant, inverse


class Linear:
    """Small strain: B-bar.

    Parameters
    ----------
    motion
        What points answer to a gradient of their own.
    means
        Means over cells, or what is known of them.
    """

    def __init__(self, motion: Any, means: Any):
        self.motion, self.means = motion, means
        self.places, self.history = motion.places, motion.history
        self.normal = [row for row, (i, j) in enumerate(self.places) if i == j]
        self.unit = np.array([[float(i == j)] for i, j in self.places])

    def stretch(self, gradient: ndarray) -> ndarray:
        """Volume ratio over the step, ``(n,)``; not positive where a point turns inside out."""
        return self.motion.stretch(self._seen(gradient))

    def dilation(self, gradient: ndarray) -> ndarray:
        """What is averaged, ``(n,)``: the trace of the gradient."""
        return gradient[self.normal].sum(axis=0)

    def at_rest(self, moduli: ndarray) -> Any:
        """Tangent of undeformed and unstressed points, a :class:`Spread`."""
        return _spread(moduli, np.zeros_like(self.unit), self.unit, self.unit, 1.0, len(self.normal))

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        inner = self.motion.respond(self._seen(gradient))

        def piola() -> ndarray:
            return inner.piola + self.unit * self._pressure(inner.piola, self.unit)

        return Response(inner.sigma, inner.epsilon, inner.history, piola, lambda: inner.ratio,
                        lambda: self.at_rest(inner.tangent()))

    def _seen(self, gradient: ndarray) -> ndarray:
        """The gradient with the mean of its trace."""
        return gradient + self.unit * self.means.lack(self.dilation(gradient)) / len(self.normal)

    def _pressure(self, piola: ndarray, seen: ndarray) -> ndarray:
        """What the mean stress of the points lacks of its mean."""
        return self.means.lack((piola * seen).sum(axis=0) / len(self.normal))


class Finite(Linear):
    """Finite strain: variational F-bar."""

    def stretch(self, gradient: ndarray) -> ndarray:
        """Volume ratio over the step by the points' own gradients; not positive where a point turns inside out."""
        return self.motion.stretch(gradient)

    def dilation(self, gradient: ndarray) -> ndarray:
        """What is averaged, ``(n,)``: the logarithm of the volume ratio."""
        dim = self.motion.dim
        logarithm = np.log1p(_growth(gradient[:dim * dim].reshape(dim, dim, -1)))
        return logarithm + np.log1p(gradient[-1]) if self.motion.kinematics.hoop else logarithm

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        lack = self.means.lack(self.dilation(gradient)) / len(self.normal)
        scale, own = np.exp(lack), gradient + self.unit
        seen = scale * own
        inner = self.motion.respond(gradient + np.expm1(lack) * own)      # keeps small strains exact

        def piola() -> ndarray:
            return scale * inner.piola + self._pressure(inner.piola, seen) * self._cofactor(gradient)

        def tangent() -> Any:
            normal = self._cofactor(gradient)
            spread = _spread(inner.tangent(), inner.piola, seen, normal, scale, len(self.normal))
            spread.local[:] -= self._pressure(inner.piola, seen) * self._turned(normal)
            return spread

        return Response(inner.sigma, inner.epsilon, inner.history, piola, lambda: inner.ratio, tangent)

    def _cofactor(self, gradient: ndarray) -> ndarray:
        """:math:`F^{-T}`, the derivative of the logarithm of the volume ratio, ``(m, n)``."""
        dim, rows = self.motion.dim, np.empty_like(gradient)
        rows[:dim * dim] = inverse(deformation(gradient, dim)).transpose(1, 0, 2).reshape(dim * dim, -1)
        if self.motion.kinematics.hoop:
            rows[-1] = 1 / (1 + gradient[-1])
        return rows

    def _turned(self, normal: ndarray) -> ndarray:
        """:math:`F^{-T} a^T F^{-T}` from :math:`a`, ``(m, m, n)``: less the derivative of :math:`F^{-T}`."""
        row = {place: values for place, values in zip(self.places, normal)}
        none = np.zeros(normal.shape[1])
        return np.stack([np.stack([row.get((i, l), none) * row.get((k, j), none) for k, l in self.places])
                         for i, j in self.places])


AVERAGED = {"small": Linear, "logarithmic": Finite}


class Known:
    """Means that are known, ``(n,)``."""

    def __init__(self, mean: ndarray):
        self.mean = mean

    def lack(self, values: ndarray) -> ndarray:
        """What ``values (n,)`` lack of their means."""
        return self.mean - values


def averaged(motion: Any, means: Means | Known) -> Linear:
    """The motion with means over cells that go with its measure of strain."""
    return AVERAGED[motion.name](motion, means)


def cell_shares(grid: Grid, force: type[ParticleBasis], x: ndarray, index: ndarray, length: ndarray | None,
                edges: Edges, ring: bool) -> csr_array:
    """Shares of points in cells: of domains if there are some and force knows of them, else in the host cell alone."""
    if length is None or not force.reads_domains:
        return shares_of(grid, grid.linear(x, index))
    return shares_of(grid, force.stencil_of(grid, x, index, length, edges, None, ring=ring))


def _growth(block: ndarray) -> ndarray:
    """Determinants of unit tensors plus blocks ``(d, d, n)``, less one: keeps small strains exact."""
    if len(block) == 1:
        return block[0, 0]
    if len(block) == 2:
        return block[0, 0] + block[1, 1] + block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0]
    trace, square = np.einsum("iin->n", block), np.einsum("ijn,jin->n", block, block)
    return trace + (trace ** 2 - square) / 2 + determinant(block)


def _spread(moduli: ndarray, piola: ndarray, seen: ndarray, normal: ndarray, scale: Any, d: int) -> Spread:
    r"""Derivative of :math:`s \bar P + (A p - p) g`, with the change of :math:`g` left out.

    Parameters
    ----------
    moduli, piola
        :math:`\bar{\mathbb A}` and :math:`\bar P`; nothing of the latter at small strain.
    seen, normal
        :math:`\bar F` and :math:`g = F^{-T}`.
    """
    flow, work = (moduli * seen).sum(axis=1), (moduli * seen[:, None]).sum(axis=0)
    left, right = (scale * (rows + piola) / d for rows in (flow, work))
    bulk = (seen * (flow + piola)).sum(axis=0) / d ** 2
    local = scale ** 2 * moduli - left[:, None] * normal - normal[:, None] * right + bulk * normal[:, None] * normal
    return Spread(local, left - bulk * normal, right - bulk * normal, normal, bulk)
