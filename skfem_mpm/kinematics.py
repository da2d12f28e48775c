"""1-D, plane strain, axisymmetric and 3-D motion: which strains there are, how they are stored, what a volume is.

A *gradient row* is one component of the displacement gradient that the kinematics keeps.  Its place is a pair
``(i, j)`` of the 3 x 3 tensor; ``(2, 2)`` in axial symmetry is the hoop stretch :math:`u_r / r`.  Stress and strain are
stored packed, ``(ncomp, n)``, shear as the tensor component.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from skfem.helpers import sym_grad

PLANE = ((0, 0), (1, 1), (2, 2), (0, 1))
SPACE = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class Kinematics:
    """How a body may move; use the four instances ``uniaxial``, ``plane_strain``, ``axisymmetric`` and ``solid``.

    Attributes
    ----------
    name
        What it is called in messages and files.
    dims
        Dimensions of the meshes it lives on; ``axisymmetric`` takes quads (r, z) and lines (r only).
    components
        Places ``(i, j)`` of the packed components; their number is ``ncomp``.

    Examples
    --------
    >>> from skfem_mpm import axisymmetric
    >>> axisymmetric.ncomp, axisymmetric.rows(2)
    (4, ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2)))
    """

    name: str
    dims: tuple[int, ...]
    components: tuple[tuple[int, int], ...]

    @property
    def ncomp(self) -> int:
        """Number of packed components."""
        return len(self.components)

    @property
    def hoop(self) -> bool:
        """Whether there is a hoop strain, and volumes are ring volumes per radian."""
        return self.name == "axisymmetric"

    def check_dim(self, dim: int) -> None:
        """Refuse a mesh of a dimension that this kinematics does not live on."""
        if dim not in self.dims:
            raise ValueError(
                f"kinematics: got {self.name} in {dim} dimension(s), expected {' or '.join(map(str, self.dims))}; "
                "uniaxial is for lines, plane_strain for quads, axisymmetric for lines and quads, solid for hexes.")

    def rows(self, dim: int) -> tuple[tuple[int, int], ...]:
        """Places of the gradient rows on a mesh of dimension ``dim``, the hoop row last."""
        self.check_dim(dim)
        return tuple((i, j) for i in range(dim) for j in range(dim)) + (((2, 2),) if self.hoop else ())

    def packed_index(self, place: tuple[int, int]) -> int:
        """Which packed component stands at ``place`` (of the symmetric tensor)."""
        return self.components.index((min(place), max(place)))

    def tensor(self, packed: ndarray) -> ndarray:
        """The ``(3, 3, ...)`` view of packed components ``(ncomp, ...)``.

        >>> from skfem_mpm import uniaxial
        >>> import numpy as np
        >>> uniaxial.tensor(np.array([[5.0]]))[:, :, 0].tolist()
        [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
        """
        full = np.zeros((3, 3) + packed.shape[1:])
        for value, (i, j) in zip(packed, self.components):
            full[i, j] = full[j, i] = value
        return full

    def strain(self, u: Any, w: Any) -> ndarray:
        """Small strain of the field ``u`` in a form, ``(3, 3, ...)``; ``w.x[0]`` is the radius in axial symmetry.

        ``ddot(w.stress, kinematics.strain(v, w))`` is the internal virtual work in every kinematics.
        """
        if np.shape(u.grad)[0] != np.shape(u.grad)[1] or np.ndim(u.grad) != 4:
            raise ValueError(f"u: got a field with a gradient of shape {np.shape(u.grad)}, expected a vector field; "
                             "use ElementVector(...).")
        small = sym_grad(u)
        dim = small.shape[0]
        full = np.zeros((3, 3) + small.shape[2:])
        full[:dim, :dim] = small
        if self.hoop:
            full[2, 2] = np.asarray(u)[0] / np.asarray(w.x)[0]
        return full


uniaxial = Kinematics("uniaxial", (1,), ((0, 0),))
plane_strain = Kinematics("plane strain", (2,), PLANE)
axisymmetric = Kinematics("axisymmetric", (1, 2), PLANE)
solid = Kinematics("solid", (3,), SPACE)


@dataclass(frozen=True)
class Response:
    """What points answer to a displacement gradient over a step.

    Attributes
    ----------
    piola
        ``(m, n)``; first Piola stress relative to the start of the step, one row per gradient row.
    sigma, epsilon
        ``(ncomp, n)``; Cauchy stress and (logarithmic only) elastic logarithmic strain at its end.
    history
        ``(k, n)``; what the law remembers at its end.
    ratio
        ``(n,)``; volume at the end over volume at the start.
    tangent
        Makes the derivative of ``piola`` by the gradient, ``(m, m, n)`` or ``(m, m, 1)``.
    """

    piola: ndarray
    sigma: ndarray
    epsilon: ndarray | None
    history: ndarray
    ratio: ndarray
    tangent: Callable[[], ndarray]


class Small:
    """Small-strain increments on updated positions, as in the paper: stress and start of step are one configuration."""

    name = "small"

    def __init__(self, kinematics: Kinematics, dim: int, law: Any, sigma: ndarray, epsilon: ndarray | None,
                 history: ndarray | None = None):
        if law.kirchhoff:
            raise ValueError(f"strain: got 'small' with {type(law).__name__}, which needs strain='logarithmic'; use "
                             "LinearElastic for small strain.")
        self.kinematics, self.dim, self.law, self.sigma = kinematics, dim, law, sigma
        self.history = np.zeros((len(law.history), sigma.shape[1])) if history is None else history
        self.places = kinematics.rows(dim)
        self.symmetric = [kinematics.packed_index(place) for place in self.places]

    def stretch(self, gradient: ndarray) -> ndarray:
        """Volume ratio over the step, ``(n,)``; not positive where a point turns inside out."""
        return _ratio(_deformation(gradient, self.dim), gradient, self.dim)

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        strain = np.zeros_like(self.sigma)
        for row, (i, j), packed in zip(gradient, self.places, self.symmetric):
            strain[packed] += row if i == j else row / 2
        before = self._carried(gradient)
        sigma, history = self.law.update(strain, before, self.history, self.kinematics.components)
        return Response(sigma[self.symmetric], sigma, None, history, self.stretch(gradient),
                        lambda: self.law.tangent(strain, before, self.history, self.places))

    def _carried(self, gradient: ndarray) -> ndarray:
        """Stress at the start of the step as the increment sees it."""
        return self.sigma


class Objective(Small):
    """Small-strain increments of the Jaumann rate: stress turns with the spin of the step, by Hughes and Winget."""

    def _carried(self, gradient: ndarray) -> ndarray:
        dim = self.dim
        if dim == 1:
            return self.sigma
        half = gradient[:dim * dim].reshape(dim, dim, -1)
        half = (half - half.transpose(1, 0, 2)) / 4
        unit = np.eye(dim)[:, :, None]
        turn = _product(_inverse(unit - half), unit + half)
        packed = self.symmetric[:dim * dim]
        block = self.sigma[packed].reshape(dim, dim, -1)
        turned = self.sigma.copy()
        turned[packed] = _product(_product(turn, block), turn.transpose(1, 0, 2)).reshape(dim * dim, -1)
        return turned


class Logarithmic(Small):
    r"""Finite strain: the law sees the elastic logarithmic strain :math:`\frac12 \ln b`.

    Here :math:`b = F^\Delta b_n F^{\Delta T}`.  The stress handed on is :math:`\Pi = J^\Delta \sigma F^{\Delta -T}`, so
    geometry stays that of the start of the step and the tangent needs no further geometric term.
    """

    name = "logarithmic"

    def __init__(self, kinematics: Kinematics, dim: int, law: Any, sigma: ndarray, epsilon: ndarray | None,
                 history: ndarray | None = None):
        self.history = np.zeros((len(law.history), sigma.shape[1])) if history is None else history
        self.kinematics, self.dim, self.law = kinematics, dim, law
        self.places = kinematics.rows(dim)
        self.symmetric = [kinematics.packed_index(place) for place in self.places]
        self.start = self._elastic_strain(sigma) if epsilon is None else epsilon
        block = self.start[self.symmetric[:dim * dim]].reshape(dim, dim, -1)
        value, vector = _eigen(block)
        self.excess = _compose(np.expm1(2 * value), vector)      # b_n less the unit tensor: keeps small strains exact
        self.dilation = np.exp(self._trace(self.start))

    def _elastic_strain(self, sigma: ndarray) -> ndarray:
        """The strain that a stress given without one stands for."""
        if not sigma.any():
            return np.zeros_like(sigma)
        if self.law.kirchhoff:
            raise ValueError(f"epsilon: got stress without strain for {type(self.law).__name__}; give the particles "
                             "the elastic logarithmic strain that goes with it.")
        return self.law.elastic_strain(sigma, self.kinematics.components)

    def _trace(self, packed: ndarray) -> ndarray:
        return sum(row for row, (i, j) in zip(packed, self.kinematics.components) if i == j)

    def respond(self, gradient: ndarray) -> Response:
        """Stress after the increment ``gradient (m, n)``."""
        dim, components = self.dim, self.kinematics.components
        F = _deformation(gradient, dim)
        ratio = _ratio(F, gradient, dim)
        value, vector = _eigen(self._excess(gradient))
        value = np.log1p(value) / 2
        epsilon = self.start.copy()
        epsilon[self.symmetric[:dim * dim]] = _compose(value, vector).reshape(dim * dim, -1)
        if self.kinematics.hoop:
            epsilon[2] += np.log1p(gradient[-1])
        trial = epsilon
        stress, history = self.law.update(trial, np.zeros_like(trial), self.history, components)
        if self.law.history:
            epsilon = self.law.elastic_strain(stress, components)    # plastic flow has taken the rest
        scale = 1 / self.dilation if self.law.kirchhoff else ratio
        sigma = stress / np.exp(self._trace(epsilon)) if self.law.kirchhoff else stress
        inverse = _inverse(F)
        piola = np.empty_like(gradient)
        block = stress[self.symmetric[:dim * dim]].reshape(dim, dim, -1)
        piola[:dim * dim] = (scale * _product(block, inverse.transpose(1, 0, 2))).reshape(dim * dim, -1)
        if self.kinematics.hoop:
            piola[-1] = scale * stress[2] / (1 + gradient[-1])

        def tangent() -> ndarray:
            spatial = self._spatial(trial, stress, value, vector)
            return _pull_back(scale * spatial, inverse, 1 / (1 + gradient[-1]) if self.kinematics.hoop else None)

        return Response(piola, sigma, epsilon, history, ratio, tangent)

    def _excess(self, gradient: ndarray) -> ndarray:
        """The left Cauchy-Green tensor at the end of the step, less the unit tensor, ``(dim, dim, n)``."""
        block = gradient[:self.dim ** 2].reshape(self.dim, self.dim, -1)
        turned = block + _product(block, self.excess)
        return self.excess + turned + turned.transpose(1, 0, 2) + _product(turned, block.transpose(1, 0, 2))

    def _spatial(self, epsilon: ndarray, stress: ndarray, value: ndarray, vector: ndarray) -> ndarray:
        """Change of stress with the velocity gradient :math:`dL = dF F^{-1}`, less the part that F's inverse brings."""
        m, dim = len(self.places), self.dim
        rate = np.zeros((m, m, epsilon.shape[1]))
        rate[:dim * dim, :dim * dim] = _strain_rate(value, vector)
        if self.kinematics.hoop:
            rate[-1, -1] = 1
        law = self.law.tangent(epsilon, np.zeros_like(epsilon), self.history, self.places)
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


def _deformation(gradient: ndarray, dim: int) -> ndarray:
    """In-plane block of the deformation gradient over the step, ``(dim, dim, n)``."""
    return np.eye(dim)[:, :, None] + gradient[:dim * dim].reshape(dim, dim, -1)


def _ratio(F: ndarray, gradient: ndarray, dim: int) -> ndarray:
    """Volume ratio; a negative sign marks any inverted stretch, even an inverted pair."""
    in_plane = _determinant(F)
    if len(gradient) == dim * dim:
        return in_plane
    hoop = 1 + gradient[-1]
    return np.where(hoop > 0, hoop * in_plane, -np.abs(hoop * in_plane))


def _determinant(F: ndarray) -> ndarray:
    if len(F) == 1:
        return F[0, 0]
    if len(F) == 2:
        return F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
    return np.einsum("in,in->n", F[0], np.cross(F[1], F[2], axis=0))


def _inverse(F: ndarray) -> ndarray:
    if len(F) == 1:
        return 1 / F
    if len(F) == 2:
        return np.array([[F[1, 1], -F[0, 1]], [-F[1, 0], F[0, 0]]]) / _determinant(F)
    return np.linalg.inv(F.transpose(2, 0, 1)).transpose(1, 2, 0)


def _eigen(a: ndarray) -> tuple[ndarray, ndarray]:
    """Eigenvalues ``(d, n)`` and vectors ``(d, d, n)`` (second index: which) of symmetric blocks ``(d, d, n)``."""
    if len(a) == 1:
        return a[0], np.ones_like(a)
    if len(a) == 2:
        middle, half = (a[0, 0] + a[1, 1]) / 2, (a[0, 0] - a[1, 1]) / 2
        radius = np.hypot(half, a[0, 1])
        angle = np.arctan2(a[0, 1], half) / 2
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([middle + radius, middle - radius]), np.array([[c, -s], [s, c]])
    value, vector = np.linalg.eigh(a.transpose(2, 0, 1))
    return value.T, vector.transpose(1, 2, 0)


def _compose(value: ndarray, vector: ndarray) -> ndarray:
    return _product(value * vector, vector.transpose(1, 0, 2))


def _product(a: ndarray, b: ndarray) -> ndarray:
    """Matrix product of blocks ``(d, d, n)``; faster over many points than a general one."""
    return sum(a[:, k, None] * b[None, k] for k in range(len(a)))


def _strain_rate(value: ndarray, vector: ndarray) -> ndarray:
    r"""Derivative of logarithmic strain by the velocity gradient, ``(d*d, d*d, n)``, from principal strains.

    In principal axes :math:`d\varepsilon_{aa} = dL_{aa}` and
    :math:`d\varepsilon_{ab} = \frac{\varepsilon_a-\varepsilon_b}{b_a-b_b} (b_b dL_{ab} + b_a dL_{ba})`.
    """
    d = len(value)

    def dyad(a: int, b: int) -> ndarray:
        return (vector[:, None, a] * vector[None, :, b]).reshape(d * d, -1)

    total = sum(dyad(a, a)[:, None] * dyad(a, a) for a in range(d))
    for a in range(d):
        for b in range(a + 1, d):
            x = 2 * (value[a] - value[b])
            near = np.abs(x) < 1e-12
            forward = np.where(near, 1.0, x / np.expm1(np.where(near, 1.0, x))) / 2
            backward = forward + x / 2
            total += (dyad(a, b) + dyad(b, a))[:, None] * (forward * dyad(a, b) + backward * dyad(b, a))
    return total


def _pull_back(spatial: ndarray, inverse: ndarray, hoop: ndarray | None) -> ndarray:
    """Take both legs of a spatial tangent ``(m, m, n)`` back to the start of the step."""
    dim = len(inverse)
    for leg in range(2):
        turned = spatial.copy()
        for i in range(dim):
            for j in range(dim):
                turned[i * dim + j] = sum(inverse[j, p] * spatial[i * dim + p] for p in range(dim))
        if hoop is not None:
            turned[-1] = hoop * spatial[-1]
        spatial = turned.transpose(1, 0, 2)
    return spatial
