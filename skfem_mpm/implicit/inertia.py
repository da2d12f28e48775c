"""Newmark's method: what inertia adds to a step, and what it leaves at the points."""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array, diags_array

from ..support import Support, stack_rows
from .solve import solve_constrained
from .state import Solver


class Inertia:
    r"""Lumped mass of a step, and the acceleration that goes with its displacement.

    .. math:: a = \frac{u - \Delta t\, v_n - \Delta t^2 (\tfrac12 - \beta)\, a_n}{\beta \Delta t^2}, \qquad
              \gamma = \tfrac12 + \alpha, \quad \beta = \tfrac14 (\tfrac12 + \gamma)^2

    Velocity and acceleration at the start of the step come from the points, weighted by mass: they solve
    :math:`T^T M T\, v_n = T^T N^T m\, v_p` where :math:`T` makes slaved nodes follow the solved ones.  So no momentum
    is lost where nodes are slaved, and without slaved nodes it is the quotient of momentum and mass.

    Attributes
    ----------
    matrix
        :math:`T^T M T` over the solved components.
    stiffness
        Derivative of the force of inertia by the displacement.
    """

    def __init__(self, support: Support, dt: float, numerical_damping: float, solver: Solver):
        self.support, self.dt, self.solver = support, dt, solver
        self.gamma = 0.5 + numerical_damping
        self.beta = (0.5 + self.gamma) ** 2 / 4
        mass = np.repeat(support.mass[support.known], support.grid.dim)
        self.matrix = csr_array(support.transfer.T @ diags_array(mass) @ support.transfer)
        self.stiffness = self.matrix / (self.beta * dt ** 2)
        self.ahead = np.zeros(len(support.free))

    def start(self, velocity: ndarray | None, acceleration: ndarray) -> None:
        """Take velocity and acceleration of the points to the nodes."""
        moved = self.dt ** 2 * (0.5 - self.beta) * acceleration
        if velocity is not None:
            moved = moved + self.dt * velocity
        self.ahead = self._to_nodes(moved)

    def _to_nodes(self, vectors: ndarray) -> ndarray:
        """Vectors ``(dim, n)`` of the points on the solved components, weighted by mass."""
        support = self.support
        mass = support.particles.mass
        amount = np.stack([support.mapping.to_nodes(mass * row) for row in vectors])
        none = stack_rows([], len(support.free))
        return self._solve(support.gather(amount), none, none.T)

    def _solve(self, force: ndarray, rows: csr_array, columns: csr_array) -> ndarray:
        none = np.zeros(rows.shape[0])
        return solve_constrained(self.solver, self.matrix, force, rows, none, self.support.free, columns)[0]

    def at_rest(self, force: ndarray, rows: csr_array, columns: csr_array) -> ndarray:
        """Acceleration of the points by a force, walls keeping to their velocity; they move and push by these."""
        return self.to_points(self._solve(force, rows, columns))

    def acceleration(self, unknowns: ndarray) -> ndarray:
        """Acceleration of the solved components at the end of a step with these displacements."""
        return (unknowns - self.ahead) / (self.beta * self.dt ** 2)

    def force(self, unknowns: ndarray) -> ndarray:
        """Force of inertia, :math:`M a`."""
        return self.matrix @ self.acceleration(unknowns)

    def to_points(self, unknowns: ndarray) -> ndarray:
        """Components of the solved nodes as vectors at the points."""
        return self.support.mapping.to_points(self.support.spread(unknowns))

    def velocity(self, before: ndarray | None, old: ndarray, new: ndarray) -> ndarray:
        r"""Velocity of the points after the step, :math:`v_p + \Delta t ((1 - \gamma) a_p + \gamma a_p')`."""
        change = self.dt * ((1 - self.gamma) * old + self.gamma * new)
        return change if before is None else before + change
