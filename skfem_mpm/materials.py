"""Laws: stress and tangent from a strain, as pure functions over component rows.

``components`` and ``places`` are pairs ``(i, j)`` of the 3 x 3 tensor: which component each row of an array is.  What a
law remembers of the past is its history, ``(k, n)``, one row for each name in ``Law.history``.

A law has ``kirchhoff``, ``history``, ``update`` and ``tangent`` (:func:`numerical_tangent` can stand in for it); it may
have ``elastic_strain``, ``energy_density``, ``dissipation`` and ``excess``.  ``docs/how-to.md`` says who asks for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray

Places = Sequence[tuple[int, int]]
PLANE = ((0, 0), (1, 1), (2, 2), (0, 1))                        # components of plane strain and axial symmetry
SPACE = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu"


def numerical_tangent(law: Any, strain: ndarray, stress: ndarray, history: ndarray, places: Places,
                      step: float = 1e-7) -> ndarray:
    """Tangent of any law by central differences of its ``update``, ``(m, m, n)``: two updates per component.

    Good to about 1e-8 of the modulus where the law is smooth, a mean of both sides at a kink.  As a member it is a
    law's own tangent: ``tangent = numerical_tangent`` in the body of its class.

    Parameters
    ----------
    law
        The law.
    strain, stress, history
        As they were given to ``update``.
    places
        Which components to take the derivative of, and by which.
    step
        Half the difference of strain.

    Examples
    --------
    >>> import numpy as np
    >>> law, places = LinearElastic(E=2.0, nu=0.25), [(0, 0), (0, 1), (1, 0), (1, 1)]
    >>> none = np.zeros((4, 1))
    >>> found = numerical_tangent(law, none, none, np.zeros((0, 1)), places)
    >>> bool(np.allclose(found, law.tangent(none, none, np.zeros((0, 1)), places), atol=1e-8))
    True
    """
    components = {1: SPACE[:1], 4: PLANE, 6: SPACE}[len(strain)]
    rows = [components.index((min(i, j), max(i, j))) for i, j in places]
    columns = {}
    for row in set(rows):
        i, j = components[row]
        shift = np.zeros_like(strain)
        shift[row] = step if i == j else step / 2                   # the places (i, j) and (j, i) share a shear
        above, below = (law.update(strain + sign * shift, stress, history, components)[0] for sign in (1, -1))
        columns[row] = (above - below)[rows] / (2 * step)
    return np.stack([columns[row] for row in rows], axis=1)

ROUNDING = 1e-6     # share of the shear modulus below which a strength is compared with rounding


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
        if not (_is_number(self.E) and 0 < self.E < np.inf):
            raise ValueError(f"E: got {self.E}, expected a modulus above zero.")
        if not (_is_number(self.nu) and -1 < self.nu < 0.5):
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
        part = self.lam * sum(row for row, (i, j) in zip(strain, components) if i == j)
        after = 2 * self.G * strain
        for row, (i, j) in zip(after, components):
            if i == j:
                row += part
        after += stress
        return after

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

    def energy_density(self, sigma: ndarray, epsilon: ndarray | None, components: Places) -> ndarray:
        r"""Elastic energy per current volume, ``(n,)``: :math:`\frac12 \sigma : \varepsilon`.

        At small strain this is the stored energy.  At large strain Cauchy stress linear in strain has none: what it
        gives back depends on the way by a share of the order of the volume strain.

        Parameters
        ----------
        sigma
            Packed Cauchy stress ``(ncomp, n)``.
        epsilon
            Packed elastic logarithmic strain ``(ncomp, n)``; ``None`` where none is kept, at small strain: then that of
            :meth:`elastic_strain`.

        Examples
        --------
        >>> import numpy as np
        >>> LinearElastic(E=2.0, nu=0.0).energy_density(np.array([[3.0]]), None, [(0, 0)]).tolist()
        [2.25]
        """
        if epsilon is None:
            epsilon = self.elastic_strain(sigma, components)
        return sum((0.5 if i == j else 1.0) * s * e for s, e, (i, j) in zip(sigma, epsilon, components))


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

    def energy_density(self, sigma: ndarray, epsilon: ndarray | None, components: Places) -> ndarray:
        r"""Stored energy per current volume, ``(n,)``.

        :math:`\frac12 \varepsilon : D : \varepsilon` is stored per volume of the unstressed body, where
        :math:`D : \varepsilon = J \sigma`; divided by :math:`J` it is :math:`\frac12 \sigma : \varepsilon`.  That is
        exact at any strain.

        Parameters
        ----------
        sigma
            Packed Cauchy stress ``(ncomp, n)``.
        epsilon
            Packed elastic logarithmic strain ``(ncomp, n)``; ``None`` for an unstressed body only.

        Raises
        ------
        ValueError
            If there is stress without strain: it would need a logarithm of the volume that the law is not given.

        Examples
        --------
        >>> import numpy as np
        >>> law, J = Hencky(E=2.0, nu=0.0), np.e            # a bar stretched e times: Kirchhoff stress 2
        >>> bool(law.energy_density(np.array([[2 / J]]), np.array([[1.0]]), [(0, 0)])[0] * J == 1.0)
        True
        """
        if epsilon is None and sigma.any():
            raise ValueError("epsilon: got None with stress, expected the elastic logarithmic strain that goes with "
                             "it; Hencky's law runs with strain='logarithmic'.")
        return super().energy_density(sigma, epsilon, components)


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
        for name in ("peak", "residual", "softening"):
            if not _is_number(getattr(self, name)):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected one number for the whole body.")
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
        after = self.trial(strain, stress, components)
        mean, q = self._mean_and_size(after, components)
        slip = self._slip(q, history[0])
        if not slip.any():
            return after, history
        scale = 3 * self.G * slip / np.where(q > 0, q, 1.0)
        for row, (i, j) in zip(after, components):
            row -= scale * (row - mean if i == j else row)
        return after, history + slip

    def tangent(self, strain: ndarray, stress: ndarray, history: ndarray, places: Places) -> ndarray:
        """Consistent tangent of the radial return, ``(m, m, n)``; arguments as they were given to :meth:`update`."""
        components = PLANE if len(stress) == 4 else SPACE
        trial = self.trial(strain, stress, components)
        mean, q = self._mean_and_size(trial, components)
        slip = self._slip(q, history[0])
        slip[slip < 1e-10 * q / (3 * self.G)] = 0       # on the yield surface, left to rounding: elastic for all points
        size = np.where(q > 0, q, 1.0)
        softens = self.peak + self.softening * (history[0] + slip) > self.residual
        hardening = np.where(softens, np.sqrt(3) * self.softening, 0.0)
        along = np.where(slip > 0, 9 * self.G ** 2 * (slip / size - 1 / (3 * self.G + hardening)) / size ** 2, 0.0)
        shrink = 3 * self.G * slip / size
        rows = [trial[components.index((min(i, j), max(i, j)))] - (mean if i == j else 0.0) for i, j in places]
        delta = np.eye(3)
        moduli = super().tangent(strain, stress, history, places) * np.ones(len(q))
        for a, (i, j) in enumerate(places):
            for b, (k, m) in enumerate(places):
                unit = (delta[i, k] * delta[j, m] + delta[i, m] * delta[j, k]) / 2 - delta[i, j] * delta[k, m] / 3
                moduli[a, b] += along * rows[a] * rows[b] - 2 * self.G * shrink * unit
        return moduli

    def dissipation(self, before: ndarray, after: ndarray) -> ndarray:
        r"""Energy per volume that plastic flow takes between two histories, ``(n,)``.

        It is :math:`\sqrt3 \bar c \Delta\bar\varepsilon^p` with :math:`\bar c` the mean of the cohesions before and
        after.  That is the integral of :math:`\sqrt3 c\, d\bar\varepsilon^p`, in any number of steps, but for the one
        step in which softening ends.  Where a step is plastic throughout and flow keeps its direction, it is exactly
        the work of the mean stress on the strain increment less what is stored; on bent paths, to second order.
        """
        slip = after[0] - before[0]
        mean = (self._cohesion(before[0]) + self._cohesion(after[0])) / 2
        return np.sqrt(3) * np.where(slip > 0, mean, 0.0) * slip        # a cohesion without bound times no slip is none

    def excess(self, stress: ndarray, history: ndarray) -> ndarray:
        r"""How far stress is beyond yield as a share of the strength, :math:`(\sqrt{J_2} - c) / c`, ``(n,)``.

        Not above zero but for rounding after a return; runs watch it.  A millionth of :math:`G` is added to the
        strength that it is a share of: where less is left, rounding of what was there before says more than the return.

        >>> law = VonMises(E=1.0, nu=0.0, peak=0.5, residual=0.5)
        >>> law.excess(np.array([[0.0], [0.0], [0.0], [1.0]]), np.zeros((1, 1))).round(5).tolist()
        [1.0]
        """
        _, q = self._mean_and_size(stress, PLANE if len(stress) == 4 else SPACE)
        cohesion = self._cohesion(history[0])
        return (q / np.sqrt(3) - cohesion) / (cohesion + ROUNDING * self.G)

    @staticmethod
    def _mean_and_size(stress: ndarray, components: Places) -> tuple[ndarray, ndarray]:
        """Mean stress, and q, the square root of 3 J_2."""
        if len(stress) < 4:
            raise ValueError(f"stress: got {len(stress)} component(s), expected 4 or 6; von Mises plasticity needs the "
                             "stress across, so use plane_strain, axisymmetric or solid.")
        mean = (stress[0] + stress[1] + stress[2]) / 3
        square: Any = 0.0
        for row, (i, j) in zip(stress, components):
            if i == j:
                row = row - mean
                square = square + row * row
            else:
                square = square + 2 * (row * row)
        return mean, np.sqrt(1.5 * square)

    def _cohesion(self, eps_p: ndarray) -> ndarray:
        return np.maximum(self.residual, self.peak + self.softening * eps_p)

    def _slip(self, q: ndarray, eps_p: ndarray) -> ndarray:
        """Plastic strain increment that brings ``q`` back to the yield surface."""
        root = np.sqrt(3)
        softening = (q - root * self._cohesion(eps_p)) / (3 * self.G + root * self.softening)
        return np.maximum(0.0, np.minimum(softening, (q - root * self.residual) / (3 * self.G)))
