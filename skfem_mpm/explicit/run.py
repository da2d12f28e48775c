"""The numpy engine: one time step after the other, on arrays of its own."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..checks import UnstableError
from ..grid import Grid, Stencil
from ..integration import PointIntegration
from ..kinematics import RATES
from .bound import highest_frequency
from .nodes import Nodes
from .state import Choices, ExplicitState


class Run:
    """A body in motion; :meth:`advance` takes one time step, :meth:`snapshot` freezes the state."""

    def __init__(self, mesh: Mesh, start: ExplicitState, material: Any, choices: Choices, load: Callable[[float], Any]):
        self.grid, self.material, self.choices, self.load = Grid.from_mesh(mesh), material, choices, load
        self.planes = [item for item in start.boundary if hasattr(item, "fixes")]
        self.last = start
        self.step, self.time, self.dt, self.refreshed = start.step, start.time, start.dt, start.refreshed
        self.work = {name: start.energy[name] for name in ("plastic", "damped", "external")}
        particles = start.particles
        self.kinematics, self.dim = particles.kinematics, particles.dim
        self.x, self.volume, self.mass = particles.x.copy(), particles.volume.copy(), particles.mass
        method = choices.method
        reads_domains = any(basis.reads_domains for basis in (method.mass, method.strain, method.force))
        self.length: Any = particles.length if reads_domains else None
        n, ncomp = particles.n, self.kinematics.ncomp
        self.velocity = np.zeros((self.dim, n)) if particles.velocity is None else particles.velocity.copy()
        self.sigma = np.zeros((ncomp, n)) if particles.sigma is None else particles.sigma.copy()
        finite = choices.strain == "logarithmic"
        self.epsilon = particles.epsilon if particles.epsilon is not None or not finite else np.zeros((ncomp, n))
        self.history = np.zeros((len(material.history), n)) if particles.history is None else particles.history.copy()
        self.symmetric = [self.kinematics.packed_index(place) for place in self.kinematics.rows(self.dim)]

    # -- one step ----------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Take one time step."""
        with np.errstate(invalid="ignore", over="ignore"):
            choices = self.choices
            nodes = Nodes(self.grid, self.x, self.mass, self.length, choices.method, choices.edges, self.planes)
            if self.step - self.refreshed >= self.choices.refresh:
                self._refresh(nodes)
            momentum = nodes.to_nodes(self.mass * self.velocity)
            if self.choices.integrator == "usf":
                self._update_stress(nodes, nodes.velocity(momentum))
            force = self._force(nodes, nodes.velocity(momentum))
            before = nodes.velocity(momentum)
            after = nodes.velocity(momentum + self.dt * force)
            self._move(nodes, before, after)
            if self.choices.integrator == "musl":
                self._update_stress(nodes, nodes.velocity(nodes.to_nodes(self.mass * self.velocity)))
            elif self.choices.integrator == "usl":
                self._update_stress(nodes, after)
        self.step, self.time = self.step + 1, self.time + self.dt
        self._guard()

    def _force(self, nodes: Nodes, velocity: ndarray) -> ndarray:
        """Nodal force: internal, gravity, damping."""
        operator = self._operator(nodes, nodes.force)
        force = -operator.force(self.sigma[self.symmetric])
        gravity = self.load(self.time + self.dt / 2)
        if gravity is not None:
            weight = gravity[:, None] * nodes.mapping.to_nodes(self.mass)
            force += weight
        force = nodes.collect(force)
        force[nodes.fixed] = 0
        if self.choices.damping:
            lost = self.choices.damping * np.abs(force) * np.sign(velocity)
            self.work["damped"] += float((lost * velocity).sum() * self.dt)
            force -= lost
        return force

    def _move(self, nodes: Nodes, before: ndarray, after: ndarray) -> None:
        """Points move with the grid's velocity and take on its change."""
        mapping, choices = nodes.mapping, self.choices
        moving = mapping.to_points(after)
        gained = moving - mapping.to_points(before)
        gravity = self.load(self.time + self.dt / 2)
        if gravity is not None:
            self.work["external"] += float(gravity @ (moving - gained / 2) @ self.mass * self.dt)
        own = self.velocity
        if choices.xpic:
            unseen = own
            for _ in range(choices.xpic):
                unseen = unseen - mapping.to_points(nodes.velocity(nodes.to_nodes(self.mass * unseen)))
            own = own - unseen
        self.velocity = choices.flip * (own + gained) + (1 - choices.flip) * moving
        self.x = self.x + self.dt * moving

    def _update_stress(self, nodes: Nodes, velocity: ndarray) -> None:
        self._respond(self.dt * self._operator(nodes, nodes.strain).gradient(velocity))

    def _respond(self, gradient: ndarray) -> None:
        """Stress, volume and history after the displacement gradient of a step."""
        motion = RATES[self.choices.strain](self.kinematics, self.dim, self.material, self.sigma, self.epsilon,
                                            self.history)
        ratio = motion.stretch(gradient)
        if not (ratio > 0).all():
            point = int(np.flatnonzero(~(ratio > 0))[0])
            self._stop(f"point {point} at {self.x[:, point]} turned inside out")
        response = motion.respond(gradient)
        self.volume = self.volume * ratio
        if self.material.history:
            self.work["plastic"] += float((self.material.dissipation(self.history, response.history)
                                           * self.volume).sum())
        self.sigma, self.epsilon, self.history = response.sigma, response.epsilon, response.history

    def _operator(self, nodes: Nodes, stencil: Stencil) -> PointIntegration:
        return PointIntegration(self.kinematics, stencil, stencil, self.volume, self.x[0])

    # -- time step and guards ----------------------------------------------------------------------------------------

    def _refresh(self, nodes: Nodes) -> None:
        """Find the stable time step of this layout."""
        known = nodes.active
        number = np.full((self.dim, nodes.grid.nnodes), -1)
        number[:, known] = np.arange(self.dim * known.sum()).reshape(-1, self.dim).T
        operator = PointIntegration(self.kinematics, nodes.force, nodes.strain, self.volume, self.x[0])
        zero = np.zeros_like(self.sigma)
        moduli = self.material.tangent(zero, zero, self.history, self.kinematics.rows(self.dim))
        stiffness = operator.tangent(moduli, number, self.dim * int(known.sum()))
        self._take_step(2 / highest_frequency(stiffness, nodes.mass[known], self.dim))

    def _take_step(self, stable: float) -> None:
        """Choose the time step, knowing the stable one."""
        self.refreshed = self.step
        if self.choices.dt is None:
            self.dt = self.choices.safety * stable
            return
        if self.choices.dt > stable and self.dt == 0:
            warnings.warn(f"dt: got {self.choices.dt:g}, above the step {stable:g} that is surely stable here; the run "
                          "may become unstable.", UserWarning, stacklevel=4)
        self.dt = self.choices.dt

    def _guard(self) -> None:
        for name in ("velocity", "sigma"):
            array = getattr(self, name)
            if not np.isfinite(array).all():
                point = int(np.flatnonzero(~np.isfinite(array).all(axis=0))[0])
                self._stop(f"the {name} of point {point} at {self.x[:, point]} is no longer finite")

    def _stop(self, what: str) -> None:
        raise UnstableError(f"step {self.step}: {what}; the last good state is in .state. A shorter time step (it was "
                            f"{self.dt:g}) is the likely cure.", self.last)

    # -- snapshots ---------------------------------------------------------------------------------------------------

    def snapshot(self) -> ExplicitState:
        """The state now, frozen."""
        particles = replace(self.last.particles, x=self.x, volume=self.volume, velocity=self.velocity, sigma=self.sigma,
                            epsilon=self.epsilon, length=self.length,
                            history=self.history if self.material.history else None)
        elastic = self.material.elastic_strain(self.sigma, self.kinematics.components)
        double = np.array([1.0 if i == j else 2.0 for i, j in self.kinematics.components])
        energy = {"kinetic": float((self.mass * (self.velocity ** 2).sum(axis=0)).sum() / 2),
                  "elastic": float((double[:, None] * self.sigma * elastic).sum(axis=0) @ self.volume / 2), **self.work}
        self.last = ExplicitState(self.step, self.time, self.dt, self.refreshed, particles, self.last.boundary,
                                  MappingProxyType(energy))
        return self.last
