"""Laws: stress and tangent from a strain, as pure functions over component rows.

``components`` and ``places`` are pairs ``(i, j)`` of the 3 x 3 tensor: which component each row of an array is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

Places = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class LinearElastic:
    """Isotropic linear elasticity: Cauchy stress linear in strain.

    With ``strain="small"`` stress increments follow small-strain increments, as in the paper; with
    ``strain="logarithmic"`` Cauchy stress is linear in the logarithmic strain.

    Parameters
    ----------
    E
        Young's modulus; any consistent unit of stress.
    nu
        Poisson's ratio, above -1 and below 0.5.

    Raises
    ------
    ValueError
        If ``E <= 0`` or ``nu`` is outside (-1, 0.5).

    Examples
    --------
    >>> import numpy as np
    >>> LinearElastic(E=1.0, nu=0.0).update(np.array([[0.5]]), np.array([[0.25]]), [(0, 0)]).tolist()
    [[0.75]]
    """

    E: float
    nu: float

    kirchhoff = False   # which stress is linear in logarithmic strain

    def __post_init__(self) -> None:
        if not (np.ndim(self.E) == 0 and self.E > 0 and np.isfinite(self.E)):
            raise ValueError(f"E: got {self.E}, expected a modulus above zero.")
        if not (np.ndim(self.nu) == 0 and -1 < self.nu < 0.5):
            raise ValueError(f"nu: got {self.nu}, expected a ratio between -1 and 0.5; near 0.5 use 0.49 or less.")

    @property
    def lam(self) -> float:
        """Lame's first parameter."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    @property
    def G(self) -> float:
        """Shear modulus."""
        return self.E / (2 * (1 + self.nu))

    def update(self, strain: ndarray, stress: ndarray, components: Places) -> ndarray:
        """Stress after a strain increment, ``(ncomp, n)``; shear rows are tensor components."""
        trace = sum(row for row, (i, j) in zip(strain, components) if i == j)
        rows = [2 * self.G * row + (self.lam * trace if i == j else 0.0) for row, (i, j) in zip(strain, components)]
        return stress + np.stack(rows)

    def tangent(self, strain: ndarray, stress: ndarray, places: Places) -> ndarray:
        """Derivative of stress at ``places`` by (unsymmetric) strain there, ``(m, m, 1)``: the same for all points."""
        delta = np.eye(3)
        return np.array([[[self.lam * delta[i, j] * delta[k, m]
                           + self.G * (delta[i, k] * delta[j, m] + delta[i, m] * delta[j, k])]
                          for k, m in places] for i, j in places])

    def elastic_strain(self, stress: ndarray, components: Places) -> ndarray:
        """The strain that a stress takes, ``(ncomp, n)``; one component alone is uniaxial strain."""
        if len(stress) == 1:
            return stress / (self.lam + 2 * self.G)
        spherical = self.lam / (3 * self.lam + 2 * self.G) * stress[:3].sum(axis=0)
        rows = [row - (spherical if i == j else 0.0) for row, (i, j) in zip(stress, components)]
        return np.stack(rows) / (2 * self.G)


@dataclass(frozen=True)
class Hencky(LinearElastic):
    """Hencky's law: Kirchhoff stress linear in logarithmic strain, from a stored energy.

    Parameters
    ----------
    E
        Young's modulus at small strain; any consistent unit of stress.
    nu
        Poisson's ratio at small strain.

    Raises
    ------
    ValueError
        If ``E <= 0`` or ``nu`` is outside (-1, 0.5).

    Examples
    --------
    >>> Hencky(E=25e6, nu=0.3).kirchhoff
    True
    """

    kirchhoff = True
