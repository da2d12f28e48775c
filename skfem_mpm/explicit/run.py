"""The numpy engine: one time step after the other, on arrays of its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..checks import OutsideGridError, check_positive
from ..grid import Grid
from ..kinematics import RATES, check_law, stretched
from .bound import chosen_step, share_of_flip, stable_step
from .boxes import Boxes
from .dilation import CellMeans
from .guards import LOOK_EVERY, Guarded
from .nodes import Nodes, mirrored
from .state import LEDGER, Choices, ExplicitState, remaps
from .twin import TwinNodes

STORED = ("kinetic", "elastic")
POINT_ARRAYS = ("x", "volume", "mass", "length", "velocity", "sigma", "epsilon", "history", "slope", "tense")


class Run(Guarded):
    """A body in motion; :meth:`advance` takes one time step, :meth:`snapshot` freezes the state."""

    engine = "numpy"

    def __init__(self, mesh: Mesh, start: ExplicitState, material: Any, choices: Choices):
        self.grid, self.material, self.choices = Grid.from_mesh(mesh), material, choices
        check_law(material)
        self.particles = particles = replace(start.particles, spans=None)       # what does not change of them
        self.kinematics, self.dim = particles.kinematics, particles.dim
        self.covers = choices.integration.covers
        self._check(start)
        self.grid, self.planes, self.last = mirrored(self.grid, start.boundary), start.boundary, start
        self.step, self.time, self.dt, self.refreshed = start.step, start.time, start.dt, start.refreshed
        self.doing, self.kept = start.step + 1, start.kept
        self.work = {name: start.energy.get(name, 0.0) for name in LEDGER}
        method = choices.method
        bases = (method.mass, method.strain, method.force)
        reads_domains = self.covers or any(basis.reads_domains for basis in bases)
        n, ncomp = particles.n, self.kinematics.ncomp
        finite = choices.strain == "logarithmic"
        self.x, self.volume, self.mass = particles.x.copy(), particles.volume.copy(), particles.mass
        self.length: Any = particles.length if reads_domains else None
        self.stretches = choices.domains == "stretched" and self.length is not None
        self.ring = choices.radius == "domain" and self.kinematics.hoop
        self._check_reach()
        self.velocity = np.zeros((self.dim, n)) if particles.velocity is None else particles.velocity.copy()
        self.sigma = np.zeros((ncomp, n)) if particles.sigma is None else particles.sigma.copy()
        self.epsilon: Any = particles.epsilon if finite else None
        self.history = np.zeros((len(material.history), n)) if particles.history is None else particles.history.copy()
        self.slope: Any = None
        if choices.tpic:
            self.slope = np.zeros((self.dim ** 2, n)) if start.slope is None else start.slope
        self.symmetric = [self.kinematics.packed_index(place) for place in self.kinematics.rows(self.dim)]
        motion = self._motion()
        held = motion.respond(np.zeros((len(self.symmetric), n)))       # a law that does not fit says so now
        if finite:                                                      # each stands for the other if given without
            self.epsilon, self.sigma = motion.start.copy(), held.sigma if particles.sigma is None else self.sigma
        self._begin_watch(start)
        self._count_given(start)
        self.rests_on = material, start.boundary, replace(choices, load=None, guards={})
        if start.rests_on != self.rests_on:
            self.refreshed = self.step - choices.refresh   # what the step was found for has changed

    def _count_given(self, start: ExplicitState) -> None:
        """Note energy that is new: at the start, or by hand since the last snapshot."""
        given = np.nansum(list(self._stored().values())) - np.nansum([start.energy.get(name, 0.0) for name in STORED])
        if given:
            self.work["start"] += float(given)
            self.work["peak"] = max(self.work["peak"], self._balance()[0])
        if not start.step and self.sigma.any() and not hasattr(self.material, "energy_density"):
            self.work["peak"] = np.nan                     # nobody knows what this stress has stored

    def _check(self, start: ExplicitState) -> None:
        """Refuse what does not fit together."""
        particles, grid = start.particles, self.grid
        grid.check_dim(particles.dim)
        check_positive("mass", particles.mass)
        if self.covers and particles.length is None:
            raise ValueError("length: the points have none, but field integration needs their domains; give Particles "
                             "a length (dim, n).")
        rows, wanted = 0 if particles.history is None else len(particles.history), len(self.material.history)
        if rows not in (0, wanted):
            raise ValueError(f"history: got {rows} row(s), expected {wanted} for {type(self.material).__name__} "
                             f"({', '.join(self.material.history) or 'none'}); give the particles the history of this "
                             "law, or none.")
        for plane in start.boundary:
            if not hasattr(plane, "fixes"):
                raise TypeError(f"boundary: got a {type(plane).__name__}, expected fixed planes; walls with imposed "
                                "displacements are for implicit steps.")
            plane.check(grid, particles.x)
        grid.locate(particles.x)

    @property
    def ghost(self) -> bool:
        """Whether domains, too, have to stay on the grid."""
        return self.choices.edges == "ghost" and self.choices.method.mass.reads_domains

    def _check_reach(self) -> None:
        """Refuse domains that are off the grid before the first step."""
        if self.ghost and self.length is not None:
            self.grid.check_reach(self.x, self.grid.locate(self.x), self._seen(), self.choices.edges)

    # -- one step ----------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Take one time step."""
        self.doing = self.step + 1
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            self._check_start()
            self._advance()
            self.work["most"] = max(self.work["most"], self.work["external"])
            if self.doing % LOOK_EVERY == 0:
                self._watch()
            self._feel_tension()
        self.step, self.time = self.doing, self.time + self.dt

    def _advance(self) -> None:
        choices = self.choices
        nodes = self._nodes()
        if self.step - self.refreshed >= choices.refresh:
            self._refresh(nodes)
        means = None
        if choices.remedy == "bbar":
            means = CellMeans(nodes.grid, nodes.mapping, nodes.integrated(self.volume))
        momentum = self._momentum(nodes)
        before = nodes.velocity(momentum)
        if choices.first:
            self._update_stress(nodes, means, before, choices.first)
        force, lost = self._force(nodes, means, before)
        after = nodes.velocity(momentum + self.dt * force)
        self.work["damped"] += float((lost * (before + after)).sum() * self.dt / 2)
        moved = self._move(nodes, before, after)
        if choices.integrator == "usl":
            self._update_stress(nodes, means, after)
        elif choices.first < 1:
            self._update_stress(nodes, means, nodes.velocity(self._momentum(nodes)), 1 - choices.first)
        self._check_moved(moved)
        self.x = self.x + moved
        self._leave()

    def _nodes(self) -> Nodes:
        seen, choices = self._seen(), self.choices
        known = (self.grid, self.kinematics, self.x, self.mass, seen, choices.method, choices.edges, self.planes,
                 self.ring)
        if not self.covers:
            return Nodes(*known)
        return TwinNodes(*known, Boxes(self.x, seen, self.volume, self.kinematics), choices.integration)

    def _seen(self) -> Any:
        """Domains as functions see them: stretched ones that outgrow the neighbours of their cell are cut off."""
        if not self.stretches:
            return self.length
        inside = ~self.grid.outside(self.x)
        seen = self.length.copy()
        seen[:, inside] = self.grid.fitting(self.x[:, inside], self.grid.locate(self.x[:, inside]), seen[:, inside])
        return seen

    def _momentum(self, nodes: Nodes) -> ndarray:
        """Momentum of the active nodes; with ``tpic`` points hand on their velocity gradient too."""
        nodal = nodes.mapping.to_nodes(self.mass * self.velocity)
        if self.slope is not None:
            nodal += nodes.tilted(self.mass * self.slope)
        return nodes.gather(nodal)

    def _force(self, nodes: Nodes, means: CellMeans | None, velocity: ndarray) -> tuple[ndarray, ndarray]:
        """Nodal force, internal and gravity less damping, and what damping takes of it."""
        stress = self.sigma[self.symmetric]
        if means:
            stress = means.smooth(stress)
        force = -nodes.force.force(nodes.integrated(self.volume) * stress)
        gravity = self._gravity()
        if gravity is not None:
            force += gravity[:, None] * nodes.lumped
        force = nodes.gather(force)
        force[nodes.fixed] = 0
        lost = self.choices.damping * np.abs(force) * np.sign(velocity) * nodes.active
        return force - lost, lost

    def _gravity(self) -> ndarray | None:
        return self.choices.load(self.time + self.dt / 2) if self.choices.load else None

    def _move(self, nodes: Nodes, before: ndarray, after: ndarray) -> ndarray:
        """Points take on the change of the grid's velocity; how far they move with it, ``(dim, n)``."""
        mapping, choices = nodes.mapping, self.choices
        moving = mapping.to_middles((before + after) / 2 if choices.integrator == "usavg" else after)
        gravity = self._gravity()
        if gravity is not None:
            self.work["external"] += float(gravity @ (before + after) @ nodes.lumped * self.dt / 2)
        own = self.velocity
        if choices.xpic:
            unseen = own
            for _ in range(choices.xpic):
                unseen = unseen - mapping.to_points(nodes.velocity(nodes.gather(mapping.to_nodes(self.mass * unseen))))
            own = own - unseen
        self.velocity = choices.flip * own + mapping.to_points(after - choices.flip * before)
        if self.slope is not None:
            self.slope = nodes.fitted.gradient(after)[:self.dim ** 2]
        self._check_finite("velocity")
        return self.dt * moving

    def _update_stress(self, nodes: Nodes, means: CellMeans | None, velocity: ndarray, share: float = 1.0) -> None:
        """Stress after a share of the step with these velocities."""
        gradient = nodes.strain.gradient(share * self.dt * velocity)
        self._respond(means.smooth(gradient) if means else gradient)

    def _motion(self) -> Any:
        return RATES[self.choices.strain](self.kinematics, self.dim, self.material, self.sigma, self.epsilon,
                                          self.history)

    def _respond(self, gradient: ndarray) -> None:
        """Stress, volume and history after the displacement gradient of a step."""
        motion = self._motion()
        volume = self.volume * motion.stretch(gradient)
        self._check_volume(volume)
        response = motion.respond(gradient)
        self.volume = volume
        if self.stretches:
            self._stretch(gradient)
        if self.material.history:
            self.work["plastic"] += self._dissipated(response.history)
        self.sigma, self.epsilon, self.history = response.sigma, response.epsilon, response.history
        self._check_stress()

    def _stretch(self, gradient: ndarray) -> None:
        """Domains after the displacement gradient of a step."""
        self.length = stretched(self.length, gradient)

    def _dissipated(self, history: ndarray) -> float:
        """Energy that plastic flow takes on the way to a new history; not a number if the law does not say."""
        if not hasattr(self.material, "dissipation"):
            return np.nan
        return float(self.material.dissipation(self.history, history) @ self.volume)

    # -- time step ---------------------------------------------------------------------------------------------------

    def _refresh(self, nodes: Nodes) -> None:
        """Find the stable time step of this layout."""
        moduli = self.moduli_at_rest()
        volume = nodes.integrated(self.volume)
        if self.material.kirchhoff:           # what is linear in strain is Cauchy stress times the volume ratio
            volume = volume * np.exp(-self.epsilon[:3].sum(axis=0))
        integrator, tpic = self.choices.integrator, self.choices.tpic
        self._take_step(stable_step(nodes, moduli, volume, self.mass, remaps(integrator, tpic), integrator == "usl"))

    def _take_step(self, stable: float) -> None:
        """Choose the time step, knowing the one that is stable with FLIP."""
        self.refreshed = self.step
        dt = self.choices.dt
        if not stable > 0 or (dt is None and stable == np.inf):
            self._check_volume(self.volume)
            self._check_stress()
            raise ValueError(f"dt: found a stable step of {stable}, which is none: the tangent of the law has no "
                             "stiffness or is not finite, or units are beyond what numbers hold; look at the tangent, "
                             "or give dt.")
        self._check_step(stable * share_of_flip(self.choices))
        self.dt = chosen_step(stable, self.choices)

    # -- points that leave -------------------------------------------------------------------------------------------

    def _leave(self) -> None:
        """Stop at points that leave the grid, or go on without them."""
        outside = self.grid.outside(self.x, self._seen() if self.ghost else None)
        if not outside.any():
            return
        if outside.all() and self.choices.leaving == "remove":
            raise OutsideGridError(f"step {self.doing}: the whole body has left the grid {self.grid.extent}; use a "
                                   "larger mesh, or fewer steps.")
        if self.choices.leaving == "error":
            raise OutsideGridError(f"{self._whereabouts(int(np.flatnonzero(outside)[0]))} leaves the grid "
                                   f"{self.grid.extent}{' with its domain' * self.ghost}; use a larger mesh, or "
                                   "leaving='remove' to go on without such points.")
        self._keep(~outside)

    def _keep(self, mask: ndarray) -> None:
        """Go on with some of the points."""
        before = sum(self._stored().values())
        self.kept = (np.arange(len(mask)) if self.kept is None else self.kept)[mask]
        self.particles = self.particles.where(mask)
        for name in POINT_ARRAYS:
            array = getattr(self, name)
            if array is not None:
                setattr(self, name, array[..., mask])
        self.work["removed"] += before - sum(self._stored().values())

    # -- snapshots ---------------------------------------------------------------------------------------------------

    def _stored(self) -> dict[str, float]:
        """Energy in motion and in elastic strain; the latter is not a number if the law does not say."""
        kinetic = float((self.mass * (self.velocity ** 2).sum(axis=0)).sum() / 2)
        return {"kinetic": kinetic, "elastic": self._elastic()}

    def snapshot(self) -> ExplicitState:
        """The state now, frozen."""
        with np.errstate(invalid="ignore", over="ignore"):
            self._check_snapshot()
        particles = replace(self.particles, x=self.x, volume=self.volume, velocity=self.velocity, sigma=self.sigma,
                            epsilon=self.epsilon,
                            history=self.history if self.material.history else None,
                            length=self.length if self.stretches else self.particles.length)
        energy = {**self._stored(), **self.work}
        self.last = ExplicitState(self.step, self.time, self.dt, self.refreshed, particles, self.planes, energy,
                                  kept=self.kept, slope=self.slope, rests_on=self.rests_on)
        return self.last
