r"""Stress as a field: fitted to the points, integrated over what the body covers.

With the fit :math:`R` of :mod:`.fit` and the quadrature of :mod:`skfem_mpm.cover`

.. math:: L_{Ip} = \sum_g w_g \nabla N_I(x_g) R_{gp}, \qquad V^*_p = \sum_g w_g R_{gp}

``field`` pairs that force with the strain of the method, which is more accurate, but not symmetric.  ``twin`` takes the
strain that is conjugate to it, :math:`G = L / V^*`: symmetric, with a potential, exact for constant gradients and for
linear stress.  :math:`V^*` are then weights of points whose moments are shared between neighbouring cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from ..basis import Method, ParticleBasis
from ..checks import check_positive
from .fit import Fit
from .pair import OfStencil, OfTable, Pair
from .points import Integration

LEAST = 0.2          # share of what constants would give a point that the fit must leave it
ROUNDS = 20          # of finding out which units give a point too little


@dataclass(frozen=True)
class Field(Integration):
    r"""Force from the fitted field, strain from the method: ``integration="field"``; implicit only.

    Parameters
    ----------
    order
        Degree of the fit, 1 or 2; 2 wants at least two points per direction in a cell.
    kappa
        How fast its weights fall with distance, above zero: :math:`e^{-\kappa |\xi|^2}` at :math:`\xi` cells.
    reach
        To how many cells on each side of its own a point lends its stress; 2 for single points in cells.
    recover
        Basis that recovers strain, moves points and holds walls instead of the method's; ``CubicBasis`` makes the most
        of a smooth solution.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    """

    order: int = 1
    kappa: float = 1.5
    reach: int = 1
    recover: type[ParticleBasis] | None = None

    covers = True

    def __post_init__(self) -> None:
        for name in ("order", "reach"):
            if getattr(self, name) not in (1, 2):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected 1 or 2.")
        check_positive("kappa", self.kappa)

    def method(self, method: Method) -> Method:
        """The method whose bases the operators read: force comes from finite element functions."""
        if self.recover is None:
            return replace(method, force=ParticleBasis)
        return Method(method.mass, self.recover, ParticleBasis, motion=self.recover)

    def pair(self, support: Any, force: type, strain: type, weight: ndarray) -> Pair:
        """The operators of a step."""
        check_unweighted(weight)
        points = support.particles
        table, _ = field_table(Fit(support.cover, self.order, self.kappa, self.reach))
        of_force = OfTable(support.index - self.reach, table / points.volume, support.grid.vertices.shape)
        of_strain = OfStencil(support.stencil(strain), points.x[0] if points.kinematics.hoop else None)
        return Pair(points.kinematics, of_force, of_strain, points.volume)


@dataclass(frozen=True)
class Twin(Integration):
    r"""The symmetric twin of field integration, with the strain conjugate to its force: ``integration="twin"``.

    Parameters
    ----------
    order
        Degree of the fit, 1 or 2; 2 wants at least two points per direction in a cell.
    kappa
        How fast its weights fall with distance, above zero: :math:`e^{-\kappa |\xi|^2}` at :math:`\xi` cells; above 4
        points may lose all of their volume.  ``None`` for the weights of linear interpolation between the middles of
        cells: inside a body the strain is then exact for quadratic displacements too.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    """

    order: int = 1
    kappa: float | None = 4.0

    covers = True
    recovers = False

    def __post_init__(self) -> None:
        if self.order not in (1, 2):
            raise ValueError(f"order: got {self.order!r}, expected 1 or 2.")
        if self.kappa is not None:
            check_positive("kappa", self.kappa)

    def method(self, method: Method) -> Method:
        """The method whose bases the operators read: force and strain see what finite elements see."""
        return replace(method, strain=ParticleBasis, force=ParticleBasis)

    def pair(self, support: Any, force: type, strain: type, weight: ndarray) -> Pair:
        """The operators of a step."""
        check_unweighted(weight)
        points = support.particles
        fit = Fit(support.cover, self.order, self.kappa)
        keep_positive(fit)
        table, volume = field_table(fit)
        functions = OfTable(support.index - 1, table / volume, support.grid.vertices.shape)
        return Pair(points.kinematics, functions, functions, volume)


def check_unweighted(weight: ndarray) -> None:
    """Refuse weights of points, which an integration over cells does not have."""
    if not (weight == 1).all():
        raise ValueError("weights: got weights of points with an integration over cells, such as 'field' or 'dm'; "
                         "expected weights='one'.")


def keep_positive(fit: Fit) -> None:
    """Blend in constants where the fit would leave a point too little volume.

    As in flux correction: only in the units that need it and only as much as it takes, so constants are kept, the
    operator stays symmetric and it depends continuously on the points.
    """
    amount, _ = fit.moments
    own, n = fit.Q.copy(), fit.cover.particles.n
    share = np.zeros(len(own))
    positive = np.divide(amount[:, 0], fit.weight, out=np.zeros_like(fit.weight), where=fit.weight > 0)
    for _ in range(ROUNDS):
        fit.Q = own.copy()
        fit.blend(share)
        weights = np.einsum("ub,ubc->uc", amount, fit.Q)
        sure, found = np.zeros(n), np.zeros(n)
        for _, points, unit, weighted in fit.pairs():
            sure[points] += positive[unit] * weighted[0]
            found[points] += np.einsum("nb,bn->n", weights[unit], weighted)
        lack = found < LEAST * sure * (1 - 1e-9)
        if not lack.any():
            return
        wanted = (LEAST * sure - found)[lack] / (sure - found)[lack]
        for _, unit in fit.around:
            near, most = unit[lack], np.zeros(len(share))
            np.maximum.at(most, near[near >= 0], wanted[near >= 0])
            share += (1 - share) * most
    fit.Q = own
    fit.blend(np.where(share > 0, 1.0, 0.0))


def field_table(fit: Fit) -> tuple[ndarray, ndarray]:
    """Force per point stress ``(tables, 4**dim, n)`` at the nodes around, and V*.

    The first node is ``reach`` cells before the host's.
    """
    dim, n = fit.cover.grid.dim, fit.cover.particles.n
    amount, corner = fit.moments
    volumes = np.einsum("ub,ubc->uc", amount, fit.Q)
    weights = np.einsum("utkb,ubc->utkc", corner, fit.Q)
    width = 2 * fit.reach + 2
    table, volume = np.zeros((corner.shape[1], width ** dim, n)), np.zeros(n)
    corners = np.indices((2,) * dim).reshape(dim, -1)
    for offset, points, unit, weighted in fit.pairs():
        place = np.ravel_multi_index(tuple(corners + np.array(offset)[:, None] + fit.reach), (width,) * dim)
        table[:, place[:, None], points] += np.einsum("ntkb,bn->tkn", weights[unit], weighted)
        volume[points] += np.einsum("nb,bn->n", volumes[unit], weighted)
    return table, volume
