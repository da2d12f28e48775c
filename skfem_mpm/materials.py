"""Laws: stress and tangent from a strain, as pure functions over component rows.

``components`` and ``places`` are pairs ``(i, j)`` of the 3 x 3 tensor: which component each row of an array is.  What a
law remembers of the past is its history, ``(k, n)``, one row for each name in ``Law.history``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy import ndarray

Places = Sequence[tuple[int, int]]
PLANE = ((0, 0), (1, 1), (2, 2), (0, 1))                        # components of plane strain and axial symmetry
SPACE = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


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
    >>> law = LinearElastic(E=1.0, nu=0.0)
    >>> law.update(np.array([[0.5]]), np.array([[0.25]]), np.zeros((0, 1)), [(0, 0)])[0].tolist()
    [[0.75]]
    """

    E: float
    nu: float

    kirchhoff = False                   # which stress is linear in logarithmic strain
    history: ClassVar[tuple[str, ...]] = ()

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

    def trial(self, strain: ndarray, stress: ndarray, components: Places) -> ndarray:
        """Stress after an elastic strain increment, ``(ncomp, n)``; shear rows are tensor components."""
        trace = sum(row for row, (i, j) in zip(strain, components) if i == j)
        rows = [2 * self.G * row + (self.lam * trace if i == j else 0.0) for row, (i, j) in zip(strain, components)]
        return stress + np.stack(rows)

    def update(self, strain: ndarray, stress: ndarray, history: ndarray,
               components: Places) -> tuple[ndarray, ndarray]:
        """Stress and history after a strain increment, ``(ncomp, n)`` and ``(k, n)``."""
        return self.trial(strain, stress, components), history

    def tangent(self, strain: ndarray, stress: ndarray, history: ndarray, places: Places) -> ndarray:
        """Derivative of the updated stress at ``places`` by (unsymmetric) strain there.

        ``(m, m, n)``, or ``(m, m, 1)`` where it is the same for all points; arguments as they were given to
        :meth:`update`.
        """
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


@dataclass(frozen=True)
class VonMises(LinearElastic):
    r"""Von Mises soil with linear softening: :math:`\sqrt{J_2} \le c` with :math:`c` falling from a peak to a residual.

    :math:`c = \max(c_r, c_p + H \bar\varepsilon^p)` with the accumulated plastic strain
    :math:`\bar\varepsilon^p = \sum \sqrt{\tfrac23 \Delta e^p : \Delta e^p}` and :math:`H \le 0`.  In plane strain
    :math:`c` is the undrained shear strength.  The return to the yield surface has a closed form: with
    :math:`q = \sqrt{3 J_2}`

    .. math:: \Delta\bar\varepsilon^p = \max\left(0, \min\left(\frac{q - \sqrt3 c}{3G + \sqrt3 H},
              \frac{q - \sqrt3 c_r}{3G}\right)\right)

    Parameters
    ----------
    E, nu
        Elastic constants.
    peak, residual
        Cohesion at first yield and after softening; equal ones make it perfectly plastic.
    softening
        ``H``, change of cohesion with plastic strain, zero or negative.

    Raises
    ------
    ValueError
        If a parameter makes no sense, the residual is above the peak, or softening is too steep for the return
        (:math:`3G + \sqrt3 H \le 0`).

    References
    ----------
    Softening law and numbers of section 4 of Gonzalez Acosta et al. (2017); that :math:`c` bounds :math:`\sqrt{J_2}`
    (and not half the triaxial strength) is our reading.

    Examples
    --------
    >>> law = VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3)
    >>> plane = [(0, 0), (1, 1), (2, 2), (0, 1)]
    >>> shear = np.array([[0.0], [0.0], [0.0], [0.5]])
    >>> stress, history = law.update(shear, np.zeros((4, 1)), np.zeros((1, 1)), plane)
    >>> round(float(stress[3, 0]), 6), round(float(history[0, 0]), 3)
    (1000.0, 0.573)
    """

    peak: float = np.inf
    residual: float = np.inf
    softening: float = 0.0

    history: ClassVar[tuple[str, ...]] = ("eps_p",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0 < self.residual <= self.peak):
            raise ValueError(f"residual: got {self.residual} with peak {self.peak}, expected 0 < residual <= peak.")
        if not self.softening <= 0:
            raise ValueError(f"softening: got {self.softening}, expected zero or a negative modulus.")
        if not 3 * self.G + np.sqrt(3) * self.softening > 0:
            raise ValueError(f"softening: got {self.softening}, steeper than the return mapping can follow; expected "
                             f"more than {-np.sqrt(3) * self.G:g} (-sqrt(3) G).")

    def update(self, strain: ndarray, stress: ndarray, history: ndarray,
               components: Places) -> tuple[ndarray, ndarray]:
        """Stress and accumulated plastic strain after a strain increment, by radial return."""
        if len(stress) < 4:
            raise ValueError(f"stress: got {len(stress)} component(s), expected 4 or 6; von Mises plasticity needs the "
                             "stress across, so use plane_strain, axisymmetric or solid.")
        stress = self.trial(strain, stress, components)
        deviator, q = self._deviator(stress, components)
        slip = self._slip(q, history[0])
        scale = 3 * self.G * slip / np.where(q > 0, q, 1.0)
        return stress - scale * deviator, history + slip

    def tangent(self, strain: ndarray, stress: ndarray, history: ndarray, places: Places) -> ndarray:
        """Consistent tangent of the radial return, ``(m, m, n)``; arguments as they were given to :meth:`update`."""
        components = PLANE if len(stress) == 4 else SPACE
        deviator, q = self._deviator(self.trial(strain, stress, components), components)
        slip = self._slip(q, history[0])
        size = np.where(q > 0, q, 1.0)
        softens = self.peak + self.softening * (history[0] + slip) > self.residual
        hardening = np.where(softens, np.sqrt(3) * self.softening, 0.0)
        along = np.where(slip > 0, 9 * self.G ** 2 * (slip / size - 1 / (3 * self.G + hardening)) / size ** 2, 0.0)
        shrink = 3 * self.G * slip / size
        rows = [deviator[components.index((min(place), max(place)))] for place in places]
        delta = np.eye(3)
        moduli = super().tangent(strain, stress, history, places) * np.ones(len(q))
        for a, (i, j) in enumerate(places):
            for b, (k, m) in enumerate(places):
                unit = (delta[i, k] * delta[j, m] + delta[i, m] * delta[j, k]) / 2 - delta[i, j] * delta[k, m] / 3
                moduli[a, b] += along * rows[a] * rows[b] - 2 * self.G * shrink * unit
        return moduli

    def dissipation(self, before: ndarray, after: ndarray) -> ndarray:
        """Energy per volume that plastic flow takes between two histories, ``(n,)``."""
        cohesion = np.maximum(self.residual, self.peak + self.softening * after[0])
        return np.sqrt(3) * cohesion * (after[0] - before[0])

    @staticmethod
    def _deviator(stress: ndarray, components: Places) -> tuple[ndarray, ndarray]:
        """Deviatoric stress, and its size q, the square root of 3 J_2."""
        mean = stress[:3].sum(axis=0) / 3
        deviator = stress - np.stack([mean if i == j else 0 * mean for i, j in components])
        square = sum(row * row * (1 if i == j else 2) for row, (i, j) in zip(deviator, components))
        return deviator, np.sqrt(1.5 * square)

    def _slip(self, q: ndarray, eps_p: ndarray) -> ndarray:
        """Plastic strain increment that brings ``q`` back to the yield surface."""
        root = np.sqrt(3)
        cohesion = np.maximum(self.residual, self.peak + self.softening * eps_p)
        softening = (q - root * cohesion) / (3 * self.G + root * self.softening)
        return np.maximum(0.0, np.minimum(softening, (q - root * self.residual) / (3 * self.G)))
