"""What every way to integrate has in common, and the plainest one: the points are the quadrature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy import ndarray

from ..basis import Method
from .pair import Pair, on_points


class Integration:
    """What a way to integrate answers if it does not say otherwise; it has to make :meth:`pair` itself."""

    covers = False          # whether cells are integrated that hold no points
    recovers = True         # whether strain is known between the points
    reads_domains: Any = False      # whether the points need a length

    def method(self, method: Method) -> Method:
        """The method whose bases the operators read."""
        return method

    def pair(self, support: Any, force: type, strain: type, weight: ndarray) -> Pair:
        """The operators of a step.

        Parameters
        ----------
        support
            What the step knows of its grid: ``particles``, ``stencil(basis)`` and more.
        force, strain
            Bases that carry force and recover strain.
        weight
            ``(n,)``; weights of the points.
        """
        raise NotImplementedError

    def stiffness(self, support: Any, force: type, strain: type, weight: ndarray, pair: Pair) -> Any:
        """Operators of the tangent, if they are not those of force and strain."""
        return pair

    def conjugate(self, support: Any, force: type, weight: ndarray) -> Any:
        """Operators of the tangent with the functions that carry force on both sides."""
        return self.pair(support, force, force, weight)


@dataclass(frozen=True)
class Points(Integration):
    r"""Points are the quadrature, :math:`L_{Ip} = W_p V_p \nabla N_I(x_p)`: ``integration="points"``."""

    def pair(self, support: Any, force: type, strain: type, weight: ndarray) -> Pair:
        """The operators of a step, see :meth:`Integration.pair`."""
        points = support.particles
        return on_points(points.kinematics, support.stencil(force), support.stencil(strain), weight * points.volume,
                         points.x[0])
