"""Small, objective and logarithmic strain: what points answer to a displacement gradient over a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy import ndarray

from .blocks import (
    compose,
    deformation,
    eigen,
    inverse,
    product,
    pull_back,
    strain_rate,
    turned_in_plane,
    turned_in_space,
    volume_ratio,
)
from .laws import answer, check_law, memory, moduli
from .motion import Kinematics


@dataclass(frozen=True, eq=False)
class Response:
    """What points answer to a displacement gradient over a step.

    Attributes
    ----------
    sigma, epsilon
        ``(ncomp, n)``; Cauchy stress and (logarithmic only) elastic logarithmic strain at its end.
    history
        ``(k, n)``; what the law remembers at its end.
    make_piola, make_ratio
        Make ``piola`` and ``ratio`` when they are first asked for.
    tangent
        Makes the derivative of ``piola`` by the gradient, ``(m, m, n)`` or ``(m, m, 1)``.
    """

    sigma: ndarray
    epsilon: ndarray | None
    history: ndarray
    make_piola: Callable[[], ndarray]
    make_ratio: Callable[[], ndarray]
    tangent: Callable[[], ndarray]

    @cached_property
    def piola(self) -> ndarray:
        """First Piola stress relative to the start of the step, one row per gradient row, ``(m, n)``."""
        return self.make_piola()

    @cached_property
    def ratio(self) -> ndarray:
        """Volume at the end over volume at the start, ``(n,)``."""
        return self.make_ratio()


class Small:
    """Small-strain increments on updated positions, as in the paper: stress and start of step are one configuration."""

    name = "small"

    def __init__(self, kinematics: Kinematics, dim: int, law: Any, sigma: ndarray, epsilon: ndarray | None,
                 history: ndarray | None = None):
        check_law(law)
        if law.kirchhoff and self.name == "small":
            raise ValueError(f"strain: got 'small' with {type(law).__name__}, which needs strain='logarithmic'; use "
                             "LinearElastic for small strain.")
        self.kinematics, self.dim, self.law, self.sigma = kinematics, dim, law, sigma
        self.history = memory(law, history, sigma.shape[1])
        self.places = kinematics.rows(dim)
        self.symmetric = [kinematics.packed_index(place) for place in self.places]

    def stretch(self, gradient: ndarray) -> ndarray:
        """Volume ratio over the step, ``(n,)``; not positive where a point turns inside out."""
        return volume_ratio(gradient, self.dim)

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        strain = np.zeros_like(self.sigma)
        for row, (i, j), packed in zip(gradient, self.places, self.symmetric):
            strain[packed] += row if i == j else row / 2
        before = self._carried(gradient)
        sigma, history = answer(self.law, strain, before, self.history, self.kinematics.components)
        return Response(sigma, None, history, lambda: sigma[self.symmetric], lambda: self.stretch(gradient),
                        lambda: moduli(self.law, strain, before, self.history, self.places))

    def _carried(self, gradient: ndarray) -> ndarray:
        """Stress at the start of the step as the increment sees it."""
        return self.sigma


class Objective(Small):
    r"""Small-strain increments of the Jaumann rate: stress turns with the spin of the step, by Hughes and Winget.

    The turn is Cayley's rotation of the spin, so it is a rotation however large the step: in two dimensions by
    :math:`2 \arctan \frac\omega2` for a spin of :math:`\omega`.
    """

    def _carried(self, gradient: ndarray) -> ndarray:
        if self.dim == 1:
            return self.sigma
        return (turned_in_plane if self.dim == 2 else turned_in_space)(self.sigma, gradient)


class Logarithmic(Small):
    r"""Finite strain: the law sees the elastic logarithmic strain :math:`\frac12 \ln b`.

    Here :math:`b = F^\Delta b_n F^{\Delta T}`.  The stress handed on is :math:`\Pi = J^\Delta \sigma F^{\Delta -T}`, so
    geometry stays that of the start of the step and the tangent needs no further geometric term.
    """

    name = "logarithmic"

    def __init__(self, kinematics: Kinematics, dim: int, law: Any, sigma: ndarray, epsilon: ndarray | None,
                 history: ndarray | None = None):
        super().__init__(kinematics, dim, law, sigma, epsilon, history)
        if law.history:
            check_law(law, "elastic_strain")
        self.start = self._elastic_strain(sigma) if epsilon is None else epsilon
        block = self.start[self.symmetric[:dim * dim]].reshape(dim, dim, -1)
        value, vector = eigen(block)
        self.excess = compose(np.expm1(2 * value), vector)      # b_n less the unit tensor: keeps small strains exact
        self.dilation = np.exp(self._trace(self.start))

    def _elastic_strain(self, sigma: ndarray) -> ndarray:
        """The strain that a stress given without one stands for."""
        if not sigma.any():
            return np.zeros_like(sigma)
        if self.law.kirchhoff:
            raise ValueError(f"epsilon: got stress without strain for {type(self.law).__name__}; give the particles "
                             "the elastic logarithmic strain that goes with it.")
        check_law(self.law, "elastic_strain")
        return self.law.elastic_strain(sigma, self.kinematics.components)

    def _trace(self, packed: ndarray) -> ndarray:
        return sum(row for row, (i, j) in zip(packed, self.kinematics.components) if i == j)

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        dim, components = self.dim, self.kinematics.components
        value, vector = eigen(self._excess(gradient))
        value = np.log1p(value) / 2
        epsilon = self.start.copy()
        epsilon[self.symmetric[:dim * dim]] = compose(value, vector).reshape(dim * dim, -1)
        if self.kinematics.hoop:
            epsilon[2] += np.log1p(gradient[-1])
        trial = epsilon
        stress, history = answer(self.law, trial, np.zeros_like(trial), self.history, components)
        if self.law.history:
            epsilon = self.law.elastic_strain(stress, components)    # plastic flow has taken the rest
        ratio = cache(partial(self.stretch, gradient))
        back = cache(lambda: inverse(deformation(gradient, dim)))
        sigma = stress / np.exp(self._trace(epsilon)) if self.law.kirchhoff else stress

        def scale() -> ndarray:
            return 1 / self.dilation if self.law.kirchhoff else ratio()

        def piola() -> ndarray:
            rows = np.empty_like(gradient)
            block = stress[self.symmetric[:dim * dim]].reshape(dim, dim, -1)
            rows[:dim * dim] = (scale() * product(block, back().transpose(1, 0, 2))).reshape(dim * dim, -1)
            if self.kinematics.hoop:
                rows[-1] = scale() * stress[2] / (1 + gradient[-1])
            return rows

        def tangent() -> ndarray:
            spatial = self._spatial(trial, stress, value, vector)
            return pull_back(scale() * spatial, back(), 1 / (1 + gradient[-1]) if self.kinematics.hoop else None)

        return Response(sigma, epsilon, history, piola, ratio, tangent)

    def _excess(self, gradient: ndarray) -> ndarray:
        """The left Cauchy-Green tensor at the end of the step, less the unit tensor, ``(dim, dim, n)``."""
        block = gradient[:self.dim ** 2].reshape(self.dim, self.dim, -1)
        turned = block + product(block, self.excess)
        return self.excess + turned + turned.transpose(1, 0, 2) + product(turned, block.transpose(1, 0, 2))

    def _spatial(self, epsilon: ndarray, stress: ndarray, value: ndarray, vector: ndarray) -> ndarray:
        """Change of stress with the velocity gradient :math:`dL = dF F^{-1}`, less the part that F's inverse brings."""
        m, dim = len(self.places), self.dim
        rate = np.zeros((m, m, epsilon.shape[1]))
        rate[:dim * dim, :dim * dim] = strain_rate(value, vector)
        if self.kinematics.hoop:
            rate[-1, -1] = 1
        law = moduli(self.law, epsilon, np.zeros_like(epsilon), self.history, self.places)
        if law.shape[2] == 1:
            spatial = (law[:, :, 0] @ rate.reshape(m, -1)).reshape(rate.shape)
        else:
            spatial = np.einsum("ijn,jkn->ikn", law, rate)
        for p, (i, j) in enumerate(self.places):
            for q, (k, l) in enumerate(self.places):
                if k == j:                       # - sigma dL^T
                    spatial[p, q] -= stress[self.kinematics.packed_index((i, l))] if (i, l) in self.places else 0
                if k == l and not self.law.kirchhoff:    # + sigma tr dL, for Cauchy stress goes with the volume
                    spatial[p, q] += stress[self.symmetric[p]]
        return spatial


STRAINS = {"small": Small, "logarithmic": Logarithmic}          # of the implicit solver
RATES = {"small": Objective, "logarithmic": Logarithmic}        # of the explicit one, where bodies turn
