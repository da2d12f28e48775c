"""The numba engine: the same time steps as :class:`~skfem_mpm.explicit.run.Run`, on sorted points and compiled."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..basis import ParticleBasis
from ..kernels import chunks, dilation, domains, energy
from ..kernels.crew import Crew
from ..kernels.options import TILE
from ..kinematics import YIELD
from ..materials import Hencky, LinearElastic, VonMises
from .fields import Fields
from .pairs import stable_step
from .run import POINT_ARRAYS, Run
from .state import Choices, ExplicitState, remaps
from .sums import NONE, NOTHING, Sums
from .tables import Tables

SORT_EVERY = 100
ARRAYS = (*POINT_ARRAYS, "ahead")
OWN = (LinearElastic, Hencky, VonMises)      # laws that are the same for all points; others may hold numbers for each
FATAL = chunks.NOT_FINITE | chunks.FAR | chunks.TURNED


class CompiledRun(Run):
    """A body in motion; points are kept in the order of cells, snapshots are in the user's."""

    engine = "numba"
    law = "python"                      # which kernel the law has, if any

    def __init__(self, mesh: Mesh, start: ExplicitState, material: Any, choices: Choices, threads: int = 1):
        super().__init__(mesh, start, material, choices)
        dim, method = self.dim, choices.method
        self.crew = Crew(threads)
        self.transfer = importlib.import_module(f"..kernels.transfer{dim}", __package__)
        self.hoop = (0,) * self.kinematics.hoop            # its length tells kernels when they are compiled
        self.flip, self.damping = float(choices.flip), float(choices.damping)
        self.rows = (0,) * self.kinematics.ncomp
        self.diagonal = [row for row, (i, j) in enumerate(self.kinematics.rows(dim)) if i == j]
        self.smooth = choices.remedy == "bbar"
        self.together = (method.force is method.mass and not choices.first and not choices.tpic
                         and not (self.smooth or self.covers))
        self._choose_law()
        self.fused = (method.strain is method.mass and choices.integrator == "usl" and self.law != "python"
                      and not (self.smooth or self.stretches or self.covers))
        self.sorts = type(material) in OWN
        self.sorted = start.order is not None
        self.order = start.order if self.sorts and start.order is not None else np.arange(self.x.shape[1])
        self.ahead = self.x
        self._arrange(self.order)
        self._make_room()

    # -- order of the points -----------------------------------------------------------------------------------------

    def _arrange(self, order: ndarray) -> None:
        """Take points in another order."""
        for name in ARRAYS:
            array = getattr(self, name)
            if array is not None:
                setattr(self, name, np.take(array, order, axis=-1))

    def _in_users_order(self) -> None:
        """Give all arrays back in the user's order; the engine's own are left alone."""
        for name in ARRAYS:
            array = getattr(self, name)
            if array is not None:
                back = np.empty_like(array)
                back[..., self.order] = array
                setattr(self, name, back)
        self.order = np.arange(len(self.order))

    def _make_room(self) -> None:
        """Arrays for these points, which may have become fewer."""
        n = self.x.shape[1]
        gradients = max(len(self.kinematics.rows(self.dim)), len(self.rows))
        kept = self.law == "python" or self.smooth or self.stretches or self.covers
        self.grad = np.empty((gradients if kept else 0, n))
        self.taken = np.zeros(-(-n // TILE))
        self.tables = Tables(self.grid, self.choices, self.planes, self.length, n, self.crew, self.ring)
        self.sums = Sums(self.tables, self.crew)
        if self.covers:
            self.fields = Fields(self.sums, self.kinematics, self.choices.integration)
        self.tables.widths = self.farthest
        self.tables.measure(self.x, self.velocity)

    def _sort(self) -> None:
        """Sort points by cell: then a chunk of them touches few nodes, and they share them in the cache.

        Where the law is one of the user's own, they stay in the user's order, which is what it may count on.
        """
        if not self.sorts:
            self.sorted = True
            return
        cell = self.grid.locate(self.x)
        number = cell[0]
        for k in range(1, self.dim):
            number = number * self.grid.cells.shape[k] + cell[k]
        self.sorted = True
        if (number[1:] >= number[:-1]).all():
            return
        order = np.argsort(number, kind="stable")
        self._arrange(order)
        self.order = self.order[order]
        if self.length is not None:
            self.tables.length = self.length
        self.tables.measure(self.x, self.velocity)

    # -- one step ----------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        choices = self.choices
        if self.step % SORT_EVERY == 0 or not self.sorted:
            self._sort()
        self._check_domains()
        sums = self.sums
        self._place()
        if self.step - self.refreshed >= choices.refresh:
            self._find_step()
        gravity = self._gravity()
        if self.smooth:
            self.weights = (self.fields.volume if self.covers else self.volume).copy()   # as the step starts
        force, column = self._to_nodes(NONE if gravity is None else gravity)
        moved, lost = sums.accelerate(force, column, self.dt, self.damping)
        self.work["damped"] += lost * self.dt
        if choices.xpic:
            self._filter()
        self._move_points(moved)
        if choices.integrator != "usl" and choices.first < 1:
            self._update(sums.velocity(self._mapped(), 0), 1 - choices.first)
        elif choices.integrator == "usl" and not self.fused:
            self._update(moved)
        self._look(gravity)

    def _place(self) -> None:
        """Find the cells of the points and what they see of the grid."""
        tables, sums = self.tables, self.sums
        wanted = self.covers or tables.others
        occupied = sums.buffer("occupied", sums.window.nnodes, dtype=np.uint8) if wanted else NOTHING
        tables.place(self.x, occupied)
        if self.covers:
            self.fields.place(self.x, self.length, self.volume, occupied)

    def _look(self, gravity: ndarray | None) -> None:
        """Whether points are where and what they should be after the step."""
        tables = self.tables
        found = tables.survey()
        if gravity is not None:
            self.work["external"] += float(gravity @ tables.work * self.dt)
        if found & FATAL:
            self._fail()
            tables.widths = self.farthest
            found = tables.survey()
        self.x, self.ahead = self.ahead, self.x
        if found & chunks.OUTSIDE or (self.ghost and tables.near_the_edge):
            self._leave()

    def _fail(self) -> None:
        """Say what is wrong with which point, in the order of a step's parts; comes back if it is no reason to stop."""
        parts: list[Callable[[], None]] = [partial(self._check_finite, "velocity"),
                                           partial(self._check_volume, self.volume), self._check_stress]
        for part in parts[1:] + parts[:1] if self.choices.first else parts:
            part()
        if not self._check_moved(self.ahead - self.x):
            size = np.abs(self.sigma).max(axis=0)
            point = self._first(size == size.max())
            self._stop(point, f"has a sigma that is too large to go on with: {size[point]:.3g}")

    def _leave(self) -> None:
        """Stop at points that leave the grid, or go on without them."""
        order = self.order
        self._in_users_order()
        before = len(order)
        super()._leave()
        if self.x.shape[1] == before:
            self._arrange(order)
            self.order = order

    def _keep(self, mask: ndarray) -> None:
        """Go on with some of the points, which come in the user's order."""
        super()._keep(mask)
        self.ahead = self.x.copy()
        self.order = np.arange(self.x.shape[1])
        self._make_room()
        self._sort()

    def _check_domains(self) -> None:
        """Look at each domain if some may reach too far."""
        choices = self.choices
        if self.tables.wide != self.tables.overlong:
            self._make_room()                           # for more nodes, or fewer
        tables = self.tables
        tables.length = self.length
        if tables.wide and not (self.covers and choices.method.mass is ParticleBasis):
            tables.length = self._seen()
            x, length, back = self.x, tables.length, np.argsort(self.order)
            edges = choices.edges if choices.method.mass.reads_domains else "clip"
            self.grid.check_reach(x[:, back], self.grid.locate(x[:, back]), length[:, back], edges)

    def _find_step(self) -> None:
        """Find the stable time step of this layout."""
        choices, last = self.choices, self.choices.integrator == "usl"
        if self.dim == 1 or self.hoop or type(self.material) not in (LinearElastic, VonMises):
            return self._refresh(self._nodes())
        self._map_points(NONE)
        self._take_step(stable_step(self.sums, self.material, self.volume, self.mass,
                                    remaps(choices.integrator, choices.tpic), last,
                                    self.fields if self.covers else None))

    # -- to the nodes and back ---------------------------------------------------------------------------------------

    def _map_points(self, gravity: ndarray) -> ndarray:
        """Mass and momentum of the nodes, and force if it has the same stencil and is known; then other stencils."""
        sums, tables, transfer = self.sums, self.tables, self.transfer
        if self.together:
            nodal = sums.map(transfer.p2g, "all", 1 + 2 * self.dim, tables.mapping, self.mass, self.velocity,
                             self.volume, self.sigma, self.x, self.hoop)
        else:
            nodal = sums.map(transfer.p2g_mass, "all", 1 + self.dim, tables.mapping, self.mass, self.velocity)
            if self.slope is not None:
                nodal[:, 1:] += self._tilt()
            if len(gravity):
                self.weight = nodal[:, :1] * gravity
            gravity = NONE
        sums.classify(nodal, gravity)
        if tables.others:
            tables.place_others(self.x, sums.sides())
        return nodal

    def _to_nodes(self, gravity: ndarray) -> tuple[ndarray, int]:
        """Mass, momentum and force of the nodes: force is an array, and the column where it starts."""
        sums = self.sums
        nodal = self._map_points(gravity)
        if self.together:
            return nodal, 1 + self.dim
        first = self.choices.first
        if first:
            self._update(sums.velocity(nodal, 1), first)
        force = self._internal()
        if len(gravity):
            force += self.weight
        return sums.gather(force), 0

    def _internal(self) -> ndarray:
        """Internal force at the nodes."""
        stress = self._bearing()
        if self.covers:
            return self.fields.force(stress)
        return self.sums.map(self.transfer.p2g_force, "force", self.dim, self.tables.force, self.volume, stress, self.x,
                             self.hoop)

    def _bearing(self) -> ndarray:
        """The stress that bears the body: with mean stresses of cells if so chosen."""
        if not self.smooth:
            return self.sigma
        packed, sigma = [self.symmetric[row] for row in self.diagonal], self.sigma.copy()
        sigma[packed] += self._excess(sigma[packed])
        return sigma

    def _excess(self, rows: ndarray) -> ndarray:
        """What the mean of rows lacks of its mean over cells."""
        mapping, frame, mean = self.tables.mapping, self.sums.window.frame, rows.mean(axis=0)
        cells = self.sums.map(dilation.to_cells, "cells", 2, mapping, self.weights, mean, self.tables.knots)
        out = np.empty_like(mean)
        self.crew(dilation.excess, mapping.base, mapping.w, mean, self.tables.knots, frame, cells, out, mapping.kt)
        return out

    def _tilt(self) -> ndarray:
        """Momentum of the velocity gradients that points carry."""
        return self.sums.map(self.transfer.p2g_tilt, "tilt", self.dim, self.tables.mapping, self.mass, self.slope,
                             self.x, self.tables.knots)

    def _mapped(self, velocity: ndarray | None = None) -> ndarray:
        """Momentum of the active nodes from that of the points, or from other velocities of points."""
        own = velocity is None
        nodal = self.sums.map(self.transfer.p2g_momentum, "momentum", self.dim, self.tables.mapping, self.mass,
                              self.velocity if own else velocity)
        if own and self.slope is not None:
            nodal += self._tilt()
        return self.sums.gather(nodal)

    def _filter(self) -> None:
        """Take off the part of the points' velocities that the grid does not see."""
        mapping, unseen = self.tables.mapping, self.velocity.copy()
        seen = np.empty_like(unseen)
        for _ in range(self.choices.xpic):
            self.crew(self.transfer.interpolate, mapping.base, mapping.w,
                      self.sums.velocity(self._mapped(unseen), 0), self.sums.window.frame, seen, mapping.kt)
            unseen -= seen
        self.velocity -= unseen

    def _move_points(self, nodal: ndarray) -> None:
        """Points move with the grid's velocity and take on its change; stress too if one stencil serves both."""
        tables, mapping, frame, limits = self.tables, self.tables.mapping, self.sums.window.frame, self.tables.limits
        moving = (mapping.base, mapping.w, nodal, frame, self.mass, self.x, self.ahead, self.velocity, self.flip,
                  self.dt)
        if self.fused:
            self._apply_law("moved", *moving, limits, mapping.kt, self.sigma, self.volume, self.hoop)
        else:
            self.crew(self.transfer.g2p, *moving, self.hoop, limits, mapping.kt)
        if self.choices.integrator == "usavg":
            self._centre(nodal)
        if self.slope is not None:
            self.crew(self.transfer.gradient, mapping.base, tables.fitted(self.x), nodal, frame, self.x, 1.0, (),
                      self.slope, mapping.kt)

    def _centre(self, nodal: ndarray) -> None:
        """Take points back by half of what the change of velocity moved them: they move with the mean of the step."""
        tables, still = self.tables, np.zeros_like(self.x)
        mapping, way = tables.mapping, np.empty_like(self.x)
        change = np.hstack([nodal[:, self.dim:], np.zeros((len(nodal), self.dim))])
        self.crew(self.transfer.g2p, mapping.base, mapping.w, change, self.sums.window.frame, self.mass, still, way,
                  still.copy(), 0.0, self.dt / 2, self.hoop, np.zeros_like(tables.limits), mapping.kt)
        self.ahead -= way
        chunks.measure_all(self.x, self.ahead, self.velocity, tables.limits)

    # -- stress ------------------------------------------------------------------------------------------------------

    def _choose_law(self) -> None:
        """Which kernel the law has, if any; other laws run as they are."""
        law, small = self.material, self.choices.strain == "small"
        self.constants: tuple[float, ...] = ()
        if small and type(law) is LinearElastic:
            self.law, self.constants = "elastic", (law.lam, 2 * law.G)
        elif small and type(law) is VonMises and len(self.rows) > 1:
            self.law = "von_mises"
            self.constants = (law.lam, law.G, float(law.peak), float(law.residual), float(law.softening))
        self.laws = importlib.import_module(f"..kernels.fused{self.dim}", __package__)

    def _apply_law(self, how: str, *arguments: Any) -> None:
        """Stress after the step."""
        kernel = getattr(self.laws, f"{how}_{self.law}")
        if self.law == "elastic":
            self.crew(kernel, *arguments, *self.constants, self.tables.bad)
        else:
            self.crew(kernel, *arguments, self.history, self.constants, self.taken, self.rows, self.tables.bad)
            self.work["plastic"] += float(self.taken.sum())

    def _update(self, nodal: ndarray, share: float = 1.0) -> None:
        """Stress after a share of the step, by the gradient of nodal velocities."""
        dt = share * self.dt
        strain, frame, grad = self.tables.strain, self.sums.window.frame, self.grad
        if not len(grad):
            return self._apply_law("mapped", strain.base, strain.w, nodal, frame, self.x, dt, strain.kt,
                                   self.sigma, self.volume, self.hoop)
        if self.covers:
            self.fields.gradient(nodal, dt, grad)
        else:
            self.crew(self.transfer.gradient, strain.base, strain.w, nodal, frame, self.x, dt, self.hoop, grad,
                      strain.kt)
        if self.smooth:
            grad[self.diagonal] += self._excess(grad[self.diagonal])
        if self.law == "python":
            if not self.choices.first:
                self._check_finite("velocity")
            return self._respond(grad[:len(self.kinematics.rows(self.dim))])
        if self.stretches:
            self._stretch(grad)
        self._apply_law("given", grad, self.sigma, self.volume, self.hoop)

    def _stretch(self, gradient: ndarray) -> None:
        """Domains after the displacement gradient of a step."""
        self.crew(domains.stretch, gradient, self.length)
        self.tables.measure_domains(self.length)

    # -- guards ------------------------------------------------------------------------------------------------------

    def _inner(self, mean: ndarray) -> float:
        """Elastic energy and motion about a mean velocity."""
        if self.law == "python":
            return super()._inner(mean)
        law = self.material
        return energy.inner(self.mass, self.velocity, mean, self.sigma, self.volume, law.lam, law.G)

    def _excess_of_yield(self) -> ndarray | None:
        """How far stress is beyond yield; nothing if all points are within."""
        if self.law == "von_mises" and not energy.beyond_yield(self.sigma, self.history, self.constants, YIELD):
            return None
        return super()._excess_of_yield()

    # -- snapshots ---------------------------------------------------------------------------------------------------

    def _first(self, mask: ndarray) -> int:
        """Where the first of some points is kept, the first in the user's order."""
        found = np.flatnonzero(mask)
        return int(found[self.order[found].argmin()])

    def _numbers(self) -> ndarray:
        """What the user calls the points, in the order in which they are kept."""
        return super()._numbers()[self.order]

    def _number(self, point: int) -> int:
        """What the user calls a point: its number at the start."""
        return super()._number(int(self.order[point]))

    def snapshot(self) -> ExplicitState:
        """The state now, frozen, in the user's order."""
        held = {name: getattr(self, name) for name in (*ARRAYS, "order")}
        self._in_users_order()
        try:
            state = super().snapshot()
        finally:
            vars(self).update(held)
        self.last = replace(state, engine="numba", order=self.order.copy())
        return self.last
