"""One load step: the system on the grid as it is at its start, Newton's method, and what it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csc_array, csr_array, hstack
from skfem import Mesh

from ..basis import ParticleBasis
from ..checks import check_array
from ..cover import spans_of
from ..ghost import ghost_stiffness, young
from ..grid import Edges, Grid
from ..integration import on_points
from ..integration.dilation import AveragedPair, Means, shares_of
from ..kinematics import STRAINS, Kinematics, carried, stretched
from ..materials import LinearElastic
from ..particles import Particles
from ..support import Support, stack_rows
from ..weights import weights
from .engine import made_for
from .fbar import Known, averaged, cell_shares
from .inertia import Inertia
from .solve import Factors, bordered, independent_rows, solve_constrained, solve_direct
from .state import Options, State

MAX_PASSES = 25
SHARES = tuple(0.5 ** k for k in range(8))    # at the kinks of plastic flow only short ways along the tangent go down
Walls = tuple[csr_array, ndarray, list[tuple[str, int]]]     # rows, their right-hand sides, and whose they are


class Retry(Exception):
    """The step did not converge and may do so in smaller parts."""


@dataclass(frozen=True)
class _Problem:
    """What Newton's method has to meet, and by what it measures how far it is from that."""

    external: ndarray
    rows: csr_array                  # of the walls, and of the control
    values: ndarray
    columns: csr_array               # what multipliers bring in: forces of the walls, and the load that is scaled
    inertia: Inertia | None = None
    before: float = 0.0              # size of the internal force at the start of the step
    diagonal: ndarray | float = 0.0  # of the last stiffness


@dataclass(frozen=True)
class _Iterate:
    """Where Newton's method is: unknowns and multipliers, what points answer, and how far from equilibrium that is."""

    unknowns: ndarray
    multipliers: ndarray
    response: Any
    force: ndarray
    residual: float


class Step:
    """One load step (or a part of it) on the grid as it is at its start."""

    def __init__(self, mesh: Mesh, state: State, material: Any, options: Options):
        self.mesh, self.state, self.material, self.options = mesh, state, material, options
        particles = _needed(state.particles, options)
        method = options.method
        self.particles = particles
        self.ring = options.radius == "domain" and particles.kinematics.hoop
        self.support = Support(mesh, _seen(mesh, particles, options), method, options.edges, state.boundary, self.ring,
                               options.integration.covers)
        self.operator = self._operator(method.force, method.strain)
        self.motion = self._motion(particles)
        self.tangent_operator = self.operator
        if options.tangent == "conjugate":
            self.tangent_operator = self._operator(method.force, method.force)
        self.soft = self._floor_stiffness() + self._ghost_stiffness()
        self.inertial: Any = None
        self.factors = Factors()

    def _motion(self, particles: Particles) -> Any:
        kinematics = particles.kinematics
        sigma = particles.sigma
        if sigma is None:
            sigma = np.zeros((kinematics.ncomp, particles.n))
        motion = STRAINS[self.options.strain](kinematics, particles.dim, self.material, sigma, particles.epsilon,
                                              particles.history)
        return motion if self.options.remedy == "none" else averaged(motion, self.operator.means)

    def _operator(self, force: type, strain: type) -> Any:
        support, points = self.support, self.support.particles
        factor = weights(self.options.weights, support.grid, support.index, points.x, points.volume,
                         points.kinematics.hoop, points.length)
        pair = made_for(self.options.engine, self.options.integration.pair(support, force, strain, factor))
        if self.options.remedy == "none":
            return pair
        shares = cell_shares(support.grid, force, points.x, support.index, points.length, self.options.edges,
                             self.ring)
        return AveragedPair(pair, Means(shares, pair.volume))

    @cached_property
    def _narrow(self) -> Any:
        """Operators of linear functions in the points' own cells, if those of the tangent are wider."""
        if self.tangent_operator.width <= 2:
            return None
        support, points = self.support, self.particles
        stencil = support.grid.linear(points.x, support.index)
        pair = made_for(self.options.engine, on_points(points.kinematics, stencil, stencil, points.volume, points.x[0]))
        if self.options.remedy == "none":
            return pair
        return AveragedPair(pair, Means(shares_of(support.grid, stencil), pair.volume))

    def _floor_stiffness(self) -> csc_array:
        """Soft stiffness of whole cells, with two Gauss points per axis; ordinary finite elements."""
        support, kinematics = self.support, self.particles.kinematics
        size = support.transfer.shape[0]
        cells = np.stack(np.nonzero(support.sound))
        if not self.options.floor or not cells.size:
            return csc_array((size, size))
        grid, dim = support.grid, support.grid.dim
        signs = np.indices((2,) * dim).reshape(dim, -1) * 2 - 1
        offset = signs / np.sqrt(12) + 0.5
        index = np.repeat(cells, 2 ** dim, axis=1)
        place = np.tile(offset, cells.shape[1])
        step = np.stack([grid.steps[k][index[k]] for k in range(dim)])
        x = np.stack([grid.axes[k][index[k]] for k in range(dim)]) + place * step
        radius = x[0] if kinematics.hoop else 1.0
        volume = step.prod(axis=0) / 2 ** dim * radius
        stencil = grid.linear(x, index)
        moduli = self._floor_moduli()
        floor = on_points(kinematics, stencil, stencil, volume, x[0])
        return made_for(self.options.engine, floor).tangent(self.options.floor * moduli, support.number, size)

    def _floor_moduli(self) -> ndarray:
        """Mean moduli of the unstressed material; where dilation is averaged, without lateral contraction.

        Nearly incompressible moduli would lock in the floor.
        """
        moduli = self._elastic().mean(axis=2, keepdims=True)
        if self.options.remedy == "none":
            return moduli
        zero = np.zeros((self.particles.kinematics.ncomp, 1))
        law = LinearElastic(E=young(moduli[:, :, 0], self.motion.places), nu=0.0)
        return law.tangent(zero, zero, zero[:0], self.motion.places)

    def _ghost_stiffness(self) -> csc_array:
        """Penalty on jumps of the normal gradient at cut cells."""
        support, size = self.support, self.support.transfer.shape[0]
        if not self.options.ghost:
            return csc_array((size, size))
        in_play = support.occupied | getattr(support, "covered", False)
        modulus = young(self._elastic().mean(axis=2), self.motion.places)
        return ghost_stiffness(self.mesh, support, in_play, self.options.ghost * modulus)

    def _elastic(self) -> ndarray:
        """Moduli of the unstressed material, ``(m, m, 1)`` or ``(m, m, n)``."""
        zero = np.zeros((self.particles.kinematics.ncomp, self.particles.n))
        return self.material.tangent(zero, zero, self.motion.history, self.motion.places)

    # -- a step ------------------------------------------------------------------------------------------------------

    def advance(self, share: float, load: Callable[[float], Any], done: float) -> State:
        """The state after ``share`` of a load step that starts ``done`` steps into the run."""
        rows, values, owner = self._constraints(share)
        gravity = load(done + share)
        external = self._weight(gravity)
        if self.options.scheme == "incremental":
            before = self._weight(self.state.gravity)
            unknowns, force, residuals = self._solve_once(external - before, rows, values)
        elif self.state.control is not None:
            return self._controlled(share, gravity, external, (rows, values, owner))
        elif self.options.dt:
            return self._dynamic(share, gravity, external, (rows, values, owner), load(done))
        else:
            unknowns, force, residuals = self._newton(_Problem(external, rows, values, rows.T))
        reactions = self._reactions(force, rows, owner)
        return self._finish(self.support.spread(unknowns), share, residuals, reactions, gravity)

    def _controlled(self, share: float, gravity: Any, load: ndarray, walls: Walls) -> State:
        """The state where the place of the control has moved on by a share of its increment, and with what load."""
        rows, values, owner = walls
        control, free = self.state.control, self.support.free
        size = np.abs(load[free]).max(initial=0.0)
        if not size > 0:
            raise ValueError("control: got no load to scale; give gravity that acts on nodes which are not fixed.")
        bordered = stack_rows([rows, control.row(self.support)], len(free))
        owners = [*owner, None]
        if len(independent_rows(bordered[:, np.flatnonzero(free)], np.zeros(len(owners)), owners)[0]) == len(values):
            raise ValueError(f"control: got the place {control.x.tolist()}, which walls and planes do not let move "
                             f"along {control.direction.tolist()}; choose another place or direction.")
        columns = hstack([rows.T, csr_array(-load[:, None] / size)], format="csr")
        problem = _Problem(np.zeros_like(load), bordered, np.append(values, share * control.increment), columns)
        unknowns, force, residuals = self._newton(problem)
        factor = force[-1] / size
        force = np.concatenate([force[:len(load)] - factor * load, force[len(load):-1]])
        reactions = self._reactions(force, rows, owner)
        state = self._finish(self.support.spread(unknowns), share, residuals, reactions, factor * np.asarray(gravity))
        return replace(state, factor=float(factor), control=control.advanced(self.support, unknowns))

    def _dynamic(self, share: float, gravity: Any, external: ndarray, walls: Walls, before: Any) -> State:
        """The state a share of the time step later."""
        rows, values, owner = walls
        options, old = self.options, self.state.acceleration
        dt = share * options.dt
        inertia = Inertia(self.support, dt, options.numerical_damping, options.solver or solve_direct)
        if old is None:
            internal = self._iterate(_Problem(external, rows, values, rows.T), 0 * external, 0 * values).force
            old = inertia.at_rest(self._weight(before) - internal, rows)
        velocity = self.particles.velocity
        inertia.start(velocity, old)
        self.inertial = inertia.stiffness
        unknowns, force, residuals = self._newton(_Problem(external, rows, values, rows.T, inertia))
        reactions = self._reactions(force, rows, owner)
        state = self._finish(self.support.spread(unknowns), share, residuals, reactions, gravity)
        new = inertia.to_points(inertia.acceleration(unknowns))
        particles = replace(state.particles, velocity=inertia.velocity(velocity, old, new))
        return replace(state, particles=particles, acceleration=new, time=self.state.time + dt)

    def _constraints(self, share: float) -> tuple[csr_array, ndarray, list[tuple[str, int]]]:
        """Independent wall rows over the solved components, their right-hand sides, and whose they are."""
        rows: list[csr_array] = []
        values: list[float] = []
        owner: list[tuple[str, int]] = []
        for wall in self.state.boundary:
            if hasattr(wall, "rows"):
                new, wanted, components = wall.rows(self.support, share)
                rows += new
                values += wanted
                owner += [(wall.name, component) for component in components]
        if not rows and self.support.free.all() and not self.options.dt:
            raise ValueError("boundary: nothing is fixed and no wall holds the body; add a FixedPlane or a Wall where "
                             "it is.")
        stacked, targets = stack_rows(rows, self.support.transfer.shape[1]), np.array(values)
        if not rows:
            return stacked, targets, owner
        kept, targets = independent_rows(stacked[:, np.flatnonzero(self.support.free)], targets, owner)
        return stacked[kept], targets, [owner[row] for row in kept]

    def _weight(self, gravity: Any) -> ndarray:
        """Body force on the solved components."""
        if gravity is None:
            return np.zeros(self.support.transfer.shape[1])
        try:
            gravity = np.asarray(gravity, dtype=float)
        except (TypeError, ValueError):
            raise TypeError(f"gravity: got {gravity!r}, expected {self.particles.dim} number(s), one per "
                            "axis.") from None
        if gravity.shape != (self.particles.dim,):
            raise ValueError(f"gravity: got shape {gravity.shape}, expected ({self.particles.dim},), one entry per "
                             "axis.")
        gravity = check_array("gravity", gravity, gravity.shape)
        return self.support.gather(gravity[:, None] * self.support.mass)

    def _solve_once(self, external: ndarray, rows: csr_array,
                    values: ndarray) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        moduli = self._elastic()
        stiffness = self._stiffness(moduli if self.options.remedy == "none" else self.motion.at_rest(moduli))
        unknowns, multipliers = self._linear_solve(stiffness, external, rows, values)
        unbalanced = stiffness @ unknowns - external
        return unknowns, np.concatenate([unbalanced, multipliers]), ()

    def _stiffness(self, moduli: Any) -> csr_array:
        operator, narrow = self.tangent_operator, self._narrow
        self.near = partial(self._assembled, narrow, moduli) if narrow else None
        return self._assembled(operator, moduli)

    def _assembled(self, operator: Any, moduli: Any) -> csr_array:
        support = self.support
        full = operator.tangent(moduli, support.number, support.transfer.shape[0]) + self.soft
        if support.slaved:
            full = support.transfer.T @ full @ support.transfer
        return full if self.inertial is None else full + self.inertial

    def _newton(self, problem: _Problem) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        at = self._iterate(problem, np.zeros(problem.rows.shape[1]), np.zeros(len(problem.values)))
        problem = replace(problem, before=float(np.linalg.norm(at.force)))
        residuals: list[float] = []
        for _ in range(MAX_PASSES):
            stiffness = self._stiffness(at.response.tangent())
            problem = replace(problem, diagonal=stiffness.diagonal())
            change, target = self._linear_solve(stiffness, problem.external - at.force, problem.rows,
                                                problem.values - problem.rows @ at.unknowns, problem.columns)
            at = self._line_search(problem, at, change, target, first=not residuals)
            residuals.append(at.residual)
            if at.residual <= self.options.tolerance:
                return at.unknowns, np.concatenate([at.force - problem.external, at.multipliers]), tuple(residuals)
        raise Retry(f"the residual stayed at {residuals[-1]:.1e} after {MAX_PASSES} Newton passes")

    def _line_search(self, problem: _Problem, at: _Iterate, change: ndarray, target: ndarray, first: bool) -> _Iterate:
        """Take the largest of a few shares of the change that lowers the residual; in the first pass the whole."""
        for scale in SHARES[:1] if first else SHARES:
            multipliers = at.multipliers + scale * (target - at.multipliers)
            trial = self._iterate(problem, at.unknowns + scale * change, multipliers)
            if np.isfinite(trial.residual) and (first or trial.residual < max(at.residual, self.options.tolerance)):
                return trial
        if first:
            raise Retry("the first Newton pass turned a point inside out")
        raise Retry(f"the residual did not fall below {at.residual:.1e}")

    def _iterate(self, problem: _Problem, unknowns: ndarray, multipliers: ndarray) -> _Iterate:
        """Response, force and residual at a trial displacement; the residual is infinite where a point inverts."""
        support = self.support
        gradient = self.operator.gradient(support.spread(unknowns))
        if not self.motion.stretch(gradient).min() > 0:
            return _Iterate(unknowns, multipliers, None, unknowns, np.inf)
        response = self.motion.respond(gradient)
        soft = support.transfer.T @ (self.soft @ (support.transfer @ unknowns))
        force = support.gather(self.operator.force(response.piola)) + soft
        if problem.inertia is not None:
            force = force + problem.inertia.force(unknowns)
        wall = problem.columns @ multipliers
        unbalanced = np.linalg.norm((force - problem.external + wall)[support.free])
        size = problem.before + sum(np.linalg.norm(part) for part in (force, problem.external, wall))
        noise = 1e-14 * np.linalg.norm(problem.diagonal * unknowns)    # all there is where nothing resists
        residual = 0.0 if unbalanced <= noise else float(unbalanced / size)
        return _Iterate(unknowns, multipliers, response, force, residual)

    def _linear_solve(self, stiffness: csr_array, force: ndarray, rows: csr_array, values: ndarray,
                      columns: csr_array | None = None) -> tuple[ndarray, ndarray]:
        solver, free = self.options.solver, self.support.free
        if solver is None:
            near = self.near
            solver = self.factors.solver(lambda: bordered(near() if near else stiffness, rows, free, columns)[0])
        return solve_constrained(solver, stiffness, force, rows, values, free, columns)

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _reactions(self, force: ndarray, rows: csr_array, owner: list[tuple[str, int]]) -> dict[str, ndarray]:
        """Force of walls and planes on the body; ``force`` ends with the multipliers."""
        support, dim = self.support, self.particles.dim
        unbalanced, multipliers = np.split(force, [rows.shape[1]])
        unbalanced = (unbalanced + rows.T @ multipliers).reshape(-1, dim).T
        grows = self.options.scheme == "incremental"            # there each step only knows what it adds
        reactions = {name: grows * before for name, before in self.state.reactions.items()}
        for (name, component), multiplier in zip(owner, multipliers):
            reactions.setdefault(name, np.zeros(dim))[component] -= multiplier
        for plane in self.state.boundary:
            if hasattr(plane, "fixes"):
                on = plane.fixes(support.grid)[:, support.solved_nodes]
                reactions.setdefault(plane.name, np.zeros(dim))[:] += (unbalanced * on).sum(axis=1)
                unbalanced = np.where(on, 0, unbalanced)    # where planes meet, the first one takes the force
        return reactions

    def _finish(self, u: ndarray, share: float, residuals: tuple[float, ...],
                reactions: dict[str, ndarray], gravity: Any) -> State:
        support, old = self.support, self.particles
        gradient = self.operator.gradient(u)
        if not self.motion.stretch(gradient).min() > 0:
            raise Retry("a point turned inside out")
        response = self.motion.respond(gradient)
        volume = old.volume * response.ratio            # by the dilation that the stress knows of
        particles = replace(old, x=old.x + support.motion.to_points(u, plain=True), volume=volume,
                            sigma=response.sigma, epsilon=response.epsilon,
                            history=response.history if self.material.history else None)
        particles = self._with_domains(particles, gradient)
        displacement = np.zeros((old.dim, self.mesh.nvertices))
        displacement[:, support.grid.vertices.ravel()] = u
        boundary = tuple(item.advanced(share) for item in self.state.boundary)
        basis = self.options.method.strain
        recovery = _Recovery(support.grid, basis, self.options.edges, support.sides_of(basis), support.occupied, u,
                             STRAINS[self.options.strain], old.kinematics, self.material, self.ring,
                             self.options.method.force, self._dilation(gradient))
        return State(self.state.step, particles, boundary, displacement, reactions, residuals,
                     scheme=self.options.scheme, gravity=gravity, time=self.state.time, engine=self.options.engine,
                     _recovery=recovery)

    def _dilation(self, gradient: ndarray) -> ndarray | None:
        """Mean dilation of the cells, if that is what points see."""
        return None if self.options.remedy == "none" else self.operator.means.of_cells(self.motion.dilation(gradient))

    def _with_domains(self, particles: Particles, gradient: ndarray) -> Particles:
        """The points with what the step makes of the domains that they carry."""
        length, spans = particles.length, particles.spans
        if length is not None and self.options.domains == "stretched":
            length = stretched(length, gradient)
        if spans is not None:
            spans = carried(spans, gradient)
        return replace(particles, length=length, spans=spans)


@dataclass(frozen=True, eq=False)
class _Recovery:
    """Recovers the stress increment of a step at any positions; keeps the grid, not the points."""

    grid: Grid
    basis: type[ParticleBasis]
    edges: Edges
    sides: ndarray | None
    occupied: ndarray
    u: ndarray
    strain: type
    kinematics: Kinematics
    material: Any
    ring: bool
    force: type[ParticleBasis]
    dilation: ndarray | None     # of cells, if points see that instead of their own

    def __call__(self, x: ndarray, length: ndarray | None) -> ndarray:
        x = check_array("x", x, (len(self.u), None))
        index = self.grid.locate(x)
        empty = np.flatnonzero(~self.occupied[tuple(index)])
        if len(empty):
            raise ValueError(f"x: got point {empty[0]} at {x[:, empty[0]]}, in a cell that held no points in this "
                             "step; expected positions in the body.")
        stencil = self.basis.stencil_of(self.grid, x, index, length, self.edges, self.sides, ring=self.ring)
        operator = on_points(self.kinematics, stencil, stencil, np.ones(x.shape[1]), x[0])
        zero = np.zeros((self.kinematics.ncomp, x.shape[1]))
        motion = self.strain(self.kinematics, len(x), self.material, zero, None)
        if self.dilation is not None:
            shares = cell_shares(self.grid, self.force, x, index, length, self.edges, self.ring)
            motion = averaged(motion, Known(shares @ self.dilation))
        return motion.respond(operator.gradient(self.u)).sigma


def _needed(particles: Particles, options: Options) -> Particles:
    """Only what the scene requires: velocity with inertia, domains if a basis, weights or the integration read them."""
    method = options.method
    uses_boxes = any(basis.reads_domains for basis in (method.mass, method.strain, method.force))
    return replace(particles, velocity=particles.velocity if options.dt else None,
                   length=particles.length if uses_boxes or options.weights == "overlap" else None,
                   spans=spans_of(particles) if options.integration.covers else None)


def _seen(mesh: Mesh, particles: Particles, options: Options) -> Particles:
    """The points as functions see them: stretched boxes that outgrow the neighbours of their cell are cut off."""
    if options.domains == "fixed" or particles.length is None:
        return particles
    grid = Grid.from_mesh(mesh)
    grid.check_dim(particles.dim)
    return replace(particles, length=grid.fitting(particles.x, grid.locate(particles.x), particles.length))
