"""The numba engine: the same time steps as :class:`~skfem_mpm.explicit.run.Run`, on sorted points and compiled."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..basis import CMPMBasis, GIMPBasis, ParticleBasis
from ..kernels import bound, stress
from ..kernels import nodes as at_nodes
from ..kernels import stencil as stencils
from ..kernels.axes import axes_arrays, cmpm_table
from ..kernels.options import CHUNKS, TILE
from ..materials import LinearElastic, VonMises
from .bound import power_bound
from .nodes import CUTOFF, Nodes
from .run import Run
from .state import Choices, ExplicitState
from .window import Window

SORT_EVERY = 100
POINT_ARRAYS = ("x", "volume", "mass", "velocity", "sigma", "epsilon", "history", "length")
NONE = np.zeros((0, 0))


class Table:
    """Stencil of one basis: first nodes and factors of the points, filled anew in every step."""

    def __init__(self, width: int, n: int, dim: int, base: ndarray | None = None):
        self.base = np.empty((n, dim), dtype=np.int32) if base is None else base
        self.w = np.empty((n, dim, 2, width))
        self.kt = (0,) * width


class CompiledRun(Run):
    """A body in motion; points are kept in the order of cells, snapshots are in the user's."""

    def __init__(self, mesh: Mesh, start: ExplicitState, material: Any, choices: Choices, load: Callable[[float], Any],
                 threads: int = 1):
        super().__init__(mesh, start, material, choices, load)
        self.threads = min(threads, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        n, dim = self.x.shape[1], self.dim
        self.transfer = importlib.import_module(f"..kernels.transfer{dim}", __package__)
        self.knots, self.inverse, self.sizes = axes_arrays(self.grid.axes)
        self.order = np.arange(n) if start.order is None else start.order
        self.sorted = start.order is not None
        self._arrange(self.order)
        self.hoop = self.kinematics.hoop
        self.rows = (0,) * self.kinematics.ncomp
        self.grad = np.empty((max(len(self.kinematics.rows(dim)), len(self.rows)), n))
        self.cell = np.empty((n, dim), dtype=np.int32)
        self.bands = np.zeros((CHUNKS, 2), dtype=np.int64)
        tiles = -(-n // TILE)
        self.limits, self.bad = np.empty((tiles, 1 + 3 * dim)), np.zeros((tiles, 2), dtype=np.int64)
        self.lost, self.taken = np.zeros(CHUNKS), np.zeros(tiles)
        self.box = self.x.min(axis=1), self.x.max(axis=1)
        self.window: Any = None                          # a Window from the first step on
        self._buffers: dict[str, ndarray] = {}
        self._choose_stencils()
        self._choose_law()

    # -- order of the points -----------------------------------------------------------------------------------------

    def _arrange(self, order: ndarray) -> None:
        """Take points in another order."""
        for name in POINT_ARRAYS:
            array = getattr(self, name)
            if array is not None:
                setattr(self, name, np.ascontiguousarray(array[..., order]))

    def _in_users_order(self) -> None:
        """Give all arrays back in the user's order; the engine's own are left alone."""
        for name in POINT_ARRAYS:
            array = getattr(self, name)
            if array is not None:
                back = np.empty_like(array)
                back[..., self.order] = array
                setattr(self, name, back)

    def _sort(self) -> None:
        """Sort points by cell: then a chunk of them touches few nodes, and they share them in the cache."""
        cell = self.grid.locate(self.x)
        number = cell[0]
        for k in range(1, self.dim):
            number = number * self.grid.cells.shape[k] + cell[k]
        order = np.argsort(number, kind="stable")
        self._arrange(order)
        self.order = self.order[order]
        self.sorted = True

    # -- window and stencils -----------------------------------------------------------------------------------------

    def _choose_stencils(self) -> None:
        """One table for each basis that the method uses."""
        method, n, dim = self.choices.method, self.x.shape[1], self.dim
        bases = {method.mass, method.strain, method.force}
        width = np.array([step.min() for step in self.grid.steps])
        self.longest = np.zeros(dim) if self.length is None else self.length.max(axis=1)
        wide = bool((self.longest > width * (1 + 1e-9)).any())
        self.check_domains = wide or (self.choices.edges == "ghost" and method.mass is GIMPBasis)
        equal = bool(self.sizes[:, 1].all())
        self.narrow = method.mass is GIMPBasis and self.choices.edges == "ghost" and equal and not wide
        self.quick = method.mass is ParticleBasis and equal
        self.same = self.length is not None and bool((self.length == self.length[:, :1]).all())
        self.reach = int(bases != {ParticleBasis})
        self.others = tuple(bases - {method.mass})
        if CMPMBasis in bases:
            self.cmpm_table = cmpm_table(self.grid.axes)
        widths = {ParticleBasis: 2, CMPMBasis: 4, GIMPBasis: 3 if self.narrow else 4}
        self.tables = {basis: Table(widths[basis], n, dim, self.cell if basis is ParticleBasis else None)
                       for basis in bases}
        self.together = method.force is method.mass and self.choices.integrator != "usf"
        self.fill = {ParticleBasis: self._fill_linear, GIMPBasis: self._fill_gimp, CMPMBasis: self._fill_cmpm}

    def _enter(self) -> None:
        """Window around the points, their cells, and the stencil that maps mass."""
        axes = self.grid.axes
        if not all(axis[0] <= a and b <= axis[-1] for axis, a, b in zip(axes, *self.box)):
            self._in_users_order()
            self.grid.locate(self.x)
        low, high = (np.array([min(np.searchsorted(axis, value, side="right"), len(axis) - 1) - 1
                               for axis, value in zip(axes, corner)]) for corner in self.box)
        if self.window is None or (low != self.window.low).any() or (high != self.window.high).any():
            self.window = Window(self.grid, low, high, self.planes, self.choices.edges)
        if self.check_domains:
            self._check_domains()
        occupied = self._buffer("occupied", self.window.nnodes if self.others else 0, dtype=np.uint8)
        occupied[:] = 0
        mapping = self.tables[self.choices.method.mass]
        if self.narrow:
            length = self.length[:, :1].copy() if self.same else self.length
            stencils.place_gimp(self.x, length, self.knots, self.inverse, self.window.frame, mapping.base, self.bands,
                                mapping.w)
            if not self.others:
                return
        elif self.quick:
            stencils.place_linear(self.x, self.knots, self.inverse, self.sizes, self.window.frame, self.cell,
                                  self.bands, occupied, mapping.w)
            self._widen()
            return
        stencils.locate(self.x, self.knots, self.inverse, self.sizes, self.window.frame, self.reach, self.cell,
                        self.bands, occupied)
        if not self.narrow:
            self.fill[self.choices.method.mass](mapping, self.window.sides)

    def _widen(self) -> None:
        """Bands of the linear stencil, wide enough for the other ones of the method."""
        if self.reach:
            used = self.bands[:, 1] > self.bands[:, 0]
            self.bands[used] += self.window.frame[1, 0] * np.array([-1, 1])

    def _check_domains(self) -> None:
        """Look at each domain if some may leave the grid or reach too far."""
        wide = (self.longest > [step.min() for step in self.grid.steps]).any()
        near = any(a - size < axis[0] or b + size > axis[-1]
                   for axis, a, b, size in zip(self.grid.axes, *self.box, self.longest / 2))
        if wide or near:
            mass = self.choices.method.mass is GIMPBasis
            x, length, back = self.x, self.length, np.argsort(self.order)
            self.grid.check_reach(x[:, back], self.grid.locate(x[:, back]), length[:, back],
                                  self.choices.edges if mass else "clip")

    def _fill_linear(self, table: Table, sides: ndarray) -> None:
        stencils.fill_linear(self.x, self.knots, self.inverse, self.cell, table.w)

    def _fill_gimp(self, table: Table, sides: ndarray) -> None:
        stencils.fill_gimp_masked(self.x, self.length, self.knots, self.inverse, self.sizes, self.cell,
                                  self.window.frame, sides, table.base, table.w)

    def _fill_cmpm(self, table: Table, sides: ndarray) -> None:
        stencils.fill_cmpm(self.x, self.knots, self.inverse, self.sizes, self.cell, self.window.frame, sides,
                           self.cmpm_table, table.base, table.w)

    def _fill_others(self) -> None:
        """Stencils that reach into occupied cells with active nodes only."""
        if not self.others:
            return
        window, size = self.window, self.window.nnodes
        sides, usable = (self._buffer(name, size, dtype=np.uint8) for name in ("sides", "usable"))
        at_nodes.available_sides(self._buffer("occupied", size, dtype=np.uint8), self.active | window.mirrored,
                                 window.corners, window.faces, window.diagonals, usable, sides)
        for basis in self.others:
            self.fill[basis](self.tables[basis], sides)

    def _buffer(self, name: str, *shape: int, dtype: Any = float) -> ndarray:
        """Room for nodal values, kept from step to step and only ever growing."""
        size = math.prod(shape)
        found = self._buffers.get(name)
        if found is None or len(found) < size:
            found = self._buffers[name] = np.empty(size + size // 8, dtype=dtype)
        return found[:size].reshape(shape)

    # -- one step ----------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Take one time step."""
        before = numba.get_num_threads()
        numba.set_num_threads(self.threads)
        try:
            with np.errstate(invalid="ignore", over="ignore"):
                self._advance()
        finally:
            numba.set_num_threads(before)

    def _advance(self) -> None:
        choices = self.choices
        if self.step % SORT_EVERY == 0 or not self.sorted:
            self._sort()
        self._enter()
        if self.step - self.refreshed >= choices.refresh:
            self._find_step()
        force, column = self._to_nodes()
        moved = self._accelerate(force, column)
        if choices.xpic:
            self._filter()
        mapping, strain = self.tables[choices.method.mass], self.tables[choices.method.strain]
        if choices.integrator == "usl" and strain is mapping and self.law != "python":
            self._move_points(moved, self._fused)
            self._look_at_points()
        else:
            self._move_points(moved, self._unfused)
            if choices.integrator == "musl":
                moved = self._mapped_velocity(self.velocity)
            if choices.integrator != "usf":
                self._update(strain, moved)
        self.step, self.time = self.step + 1, self.time + self.dt
        if not np.isfinite(self.limits[:, 0]).all():
            self._in_users_order()
            self._guard()

    def _find_step(self) -> None:
        """Find the stable time step of this layout."""
        choices, method = self.choices, self.choices.method
        if self.dim == 1 or self.hoop or type(self.material) not in (LinearElastic, VonMises):
            nodes = Nodes(self.grid, self.x, self.mass, self.length, method, choices.edges, self.planes)
            return self._refresh(nodes)
        self._map_points(np.zeros(0))
        self._classify()
        self._fill_others()
        self._take_step(2 / self._highest_frequency(self.tables[method.force], self.tables[method.strain]))

    def _highest_frequency(self, force: Table, strain: Table) -> float:
        """As :func:`skfem_mpm.explicit.bound.highest_frequency`, from norms of blocks without a matrix."""
        window, law, same = self.window, self.material, force is strain
        widest, both = max(len(force.kt), len(strain.kt)), len(force.kt) + len(strain.kt)
        reach = widest - 1 if same else 2 if both < 7 else 3
        norms = np.zeros((window.nnodes, (2 * reach + 1) ** self.dim))
        kernel = getattr(bound, f"norms{self.dim}")
        kernel(force.base, force.w, strain.base, strain.w, self.volume, law.lam, law.G, window.frame, self.bands, reach,
               same, norms, force.kt, strain.kt)
        steps = (np.indices((2 * reach + 1,) * self.dim).reshape(self.dim, -1).T - reach) @ window.frame[1]
        pad, middle = int(steps.max()), reach * (2 * reach + 1) ** (self.dim - 1)
        active = self.active.astype(bool)
        scale = np.zeros(window.nnodes)
        scale[active] = 1 / np.sqrt(self.nodal[active, 0])

        def multiply(x: ndarray) -> ndarray:
            y = np.zeros(window.nnodes)
            bound.multiply(norms, steps, same, middle, self.active, scale, np.pad(scale * x, pad), pad, y)
            return y

        return power_bound(multiply, active)

    def _to_nodes(self) -> tuple[ndarray, int]:
        """Mass and momentum of the nodes, and their force: an array and the column where it starts."""
        dim, window, method = self.dim, self.window, self.choices.method
        gravity = self.load(self.time + self.dt / 2)
        self._map_points(np.zeros(0) if gravity is None else gravity)
        weight = None if self.together or gravity is None else self.nodal[:, :1] * gravity
        self._classify()
        self._fill_others()
        if self.together:
            return self.nodal, 1 + dim
        if self.choices.integrator == "usf":
            self._update(self.tables[method.strain], self._plain(self.nodal))
        force = self._map(self.transfer.p2g_force, "force", dim, self.tables[method.force], self.volume, self.sigma,
                          self.x, self.hoop)
        if weight is not None:
            force += weight
        signs = np.ascontiguousarray(window.signs[:, 1:1 + dim])
        at_nodes.gather(force, window.inside, window.outside, signs, window.around, self.active, self.lights,
                        self.light)
        return force, 0

    def _map_points(self, gravity: ndarray) -> None:
        """Mass and momentum of the nodes, and their force too if it has the same stencil and is known."""
        dim, mapping = self.dim, self.tables[self.choices.method.mass]
        if self.together:
            self.nodal = self._map(self.transfer.p2g, "all", 1 + 2 * dim, mapping, self.mass, self.velocity,
                                   self.volume, self.sigma, self.x, self.hoop, gravity=gravity)
        else:
            self.nodal = self._map(self.transfer.p2g_momentum, "momentum", 1 + dim, mapping, self.mass, self.velocity)

    def _classify(self) -> None:
        """Active and light nodes; sums go to the active ones."""
        window = self.window
        self.active = self._buffer("active", window.nnodes, dtype=np.uint8)
        self.lights = self._buffer("lights", window.nnodes, dtype=np.int64)
        self.light = at_nodes.gather_first(self.nodal, CUTOFF, window.inside, window.outside, window.signs,
                                           window.around, self.active, self.lights)

    def _map(self, kernel: Any, name: str, columns: int, table: Table, *amounts: Any,
             gravity: ndarray = np.zeros(0)) -> ndarray:
        """Sums at the nodes, ``(nnodes, columns)``."""
        copies = self._buffer(name + " copies", CHUNKS, self.window.nnodes, columns)
        out = self._buffer(name, self.window.nnodes, columns)
        kernel(table.base, table.w, *amounts, self.window.frame, copies, self.bands, table.kt)
        at_nodes.sum_bands(copies, self.bands, out, gravity)
        return out

    def _accelerate(self, force: ndarray, column: int) -> ndarray:
        """Velocity of the nodes after the step, and its change."""
        window, damping = self.window, float(self.choices.damping)
        out = self._buffer("velocities", window.nnodes, 2 * self.dim)
        at_nodes.velocities(self.nodal, force, column, window.fixed, self.active, self.dt, damping, out, self.lost,
                            (0,) * self.dim)
        if damping:
            self.work["damped"] += float(self.lost.sum() * self.dt)
        return self._spread(out)

    def _plain(self, sums: ndarray) -> ndarray:
        """Velocity of the nodes from mass and momentum."""
        out = self._buffer("plain velocities", self.window.nnodes, 2 * self.dim)
        at_nodes.plain_velocities(sums, self.window.fixed, self.active, out)
        return self._spread(out)

    def _spread(self, velocity: ndarray) -> ndarray:
        window = self.window
        at_nodes.spread(velocity, window.inside, window.outside, window.signs, window.around, self.active, self.lights,
                        self.light)
        return velocity

    def _mapped_velocity(self, velocity: ndarray) -> ndarray:
        """Velocity of the nodes from that of the points."""
        window, mapping = self.window, self.tables[self.choices.method.mass]
        sums = self._map(self.transfer.p2g_momentum, "again", 1 + self.dim, mapping, self.mass, velocity)
        at_nodes.gather(sums, window.inside, window.outside, window.signs, window.around, self.active, self.lights,
                        self.light)
        return self._plain(sums)

    def _filter(self) -> None:
        """Take off the part of the points' velocities that the grid does not see."""
        mapping, unseen = self.tables[self.choices.method.mass], self.velocity.copy()
        seen = np.empty_like(unseen)
        for _ in range(self.choices.xpic):
            self.transfer.interpolate(mapping.base, mapping.w, self._mapped_velocity(unseen), self.window.frame, seen,
                                      mapping.kt)
            unseen -= seen
        self.velocity -= unseen

    def _move_points(self, nodal: ndarray, how: Callable[..., None]) -> None:
        """Points move with the grid's velocity and take on its change."""
        dim, mapping = self.dim, self.tables[self.choices.method.mass]
        how(mapping.base, mapping.w, nodal, self.window.frame, self.mass, self.x, self.velocity,
            float(self.choices.flip), self.dt, self.hoop, mapping.kt)
        self.box = self.limits[:, 1 + dim:1 + 2 * dim].min(axis=0), self.limits[:, 1 + 2 * dim:].max(axis=0)
        gravity = self.load(self.time + self.dt / 2)
        if gravity is not None:
            self.work["external"] += float(gravity @ self.limits[:, 1:1 + dim].sum(axis=0) * self.dt)

    def _unfused(self, *arguments: Any) -> None:
        """Move only."""
        self.transfer.g2p(*arguments[:-1], NONE, self.limits, arguments[-1])

    def _fused(self, *arguments: Any) -> None:
        """Move and update stress, for the same stencil and velocity serve both."""
        arguments = (*arguments[:-1], self.limits, self.bad, arguments[-1], self.sigma, self.volume)
        if self.law == "elastic":
            self.fused.elastic(*arguments, *self.constants[:2], self.rows)
        else:
            self.fused.von_mises(*arguments, self.history, self.constants, self.taken, self.rows)
            self.work["plastic"] += float(self.taken.sum())

    # -- stress ------------------------------------------------------------------------------------------------------

    def _choose_law(self) -> None:
        """Which kernel the law has, if any; other laws run as they are."""
        law, small = self.material, self.choices.strain == "small"
        self.law = "python"
        self.constants: tuple[float, ...] = ()
        if small and type(law) is LinearElastic:
            self.law, self.constants = "elastic", (law.lam, 2 * law.G)
        elif small and type(law) is VonMises and len(self.rows) > 1:
            self.law = "von_mises"
            self.constants = (law.lam, law.G, float(law.peak), float(law.residual), float(law.softening))
        self.fused = importlib.import_module(f"..kernels.fused{self.dim}", __package__)
        self.stress: Any = getattr(stress, f"{self.law}{self.dim}", None)

    def _update(self, table: Table, nodal: ndarray) -> None:
        """Stress after the step, by the gradient of nodal velocities."""
        self.transfer.gradient(table.base, table.w, nodal, self.window.frame, self.x, self.dt, self.hoop, self.grad,
                               table.kt)
        if self.law == "elastic":
            self.stress(self.grad, self.sigma, self.volume, self.hoop, *self.constants, self.bad, self.rows)
        elif self.law == "von_mises":
            self.stress(self.grad, self.sigma, self.history, self.volume, self.hoop, self.constants, self.bad,
                        self.taken, self.rows)
            self.work["plastic"] += float(self.taken.sum())
        else:
            self._respond(self.grad[:len(self.kinematics.rows(self.dim))])
            self.bad[:] = 0
            self.bad[0, 1] = not np.isfinite(self.sigma).all()
        self._look_at_points()

    def _look_at_points(self) -> None:
        if self.bad.any():
            self._in_users_order()
            if self.bad[:, 0].any():
                point = int(np.flatnonzero(~(self.volume > 0))[0])
                self._stop(f"point {point} at {self.x[:, point]} turned inside out")
            self._guard()

    # -- snapshots ---------------------------------------------------------------------------------------------------

    def snapshot(self) -> ExplicitState:
        """The state now, frozen, in the user's order."""
        held = {name: getattr(self, name) for name in POINT_ARRAYS}
        self._in_users_order()
        try:
            state = super().snapshot()
        finally:
            vars(self).update(held)
        order = self.order.copy()
        order.flags.writeable = False
        self.last = replace(state, engine="numba", order=order)
        return self.last
