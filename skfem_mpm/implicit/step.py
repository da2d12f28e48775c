"""One load step: the system on the grid as it is at its start, Newton's method, and what it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array, hstack
from skfem import Mesh

from ..checks import check_array
from ..cover import spans_of
from ..grid import Grid
from ..integration import on_points
from ..integration.dilation import AveragedPair, Means, shares_of
from ..kinematics import STRAINS, carried, moduli_at_rest, stretched
from ..particles import Particles
from ..support import Support, stack_rows
from ..weights import weights
from .engine import made_for
from .fbar import averaged, cell_shares
from .guards import check_yield, respond
from .held import Parts, warn_of_bare_cells, warn_of_folds, warn_of_idle, warn_of_too_few
from .inertia import Inertia
from .recovery import Recovery
from .soft import soft_stiffness
from .solve import Factors, bordered, independent_rows, solve_constrained, solve_direct
from .state import Options, State

MAX_PASSES = 25
MAX_INEXACT = 500    # with a tangent that is not the derivative of the residual; it must halve every MAX_PASSES
SHARES = tuple(0.5 ** k for k in range(8))    # at the kinks of plastic flow only short ways along the tangent go down


class Retry(Exception):
    """The step did not converge and may do so in smaller parts."""


@dataclass(frozen=True)
class Walls:
    """Constraints by walls over the solved components: how they move, how they push, how far, and whose each is."""

    rows: csr_array
    columns: csr_array
    values: ndarray
    owner: list[tuple[str, int]]


@dataclass(frozen=True)
class _Problem:
    """What Newton's method has to meet, and by what it measures how far it is from that."""

    external: ndarray
    rows: csr_array                  # of the walls, and of the control
    values: ndarray
    columns: csr_array               # what multipliers bring in: forces of the walls, and the load that is scaled
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
    trouble: str = ""                # what is wrong where the residual is infinite


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
        self.parts = Parts(self.support)
        self.operator, self.tangent_operator = self._operators()
        self.motion = self._motion(particles)
        self.soft = soft_stiffness(mesh, self.support, particles.kinematics, self._elastic(), self.motion.places,
                                   options)
        self.inertia: Inertia | None = None      # of a time step
        self.factors = Factors()

    def _motion(self, particles: Particles) -> Any:
        kinematics = particles.kinematics
        sigma = particles.sigma
        if sigma is None:
            sigma = np.zeros((kinematics.ncomp, particles.n))
        motion = STRAINS[self.options.strain](kinematics, particles.dim, self.material, sigma, particles.epsilon,
                                              particles.history)
        return motion if self.options.remedy == "none" else averaged(motion, self.operator.means)

    def _operators(self) -> tuple[Any, Any]:
        """Operators of the residual and of its tangent; one object if that is exact."""
        support, points, options = self.support, self.support.particles, self.options
        factor = weights(options.weights, support.grid, support.index, points.x, points.volume,
                         points.kinematics.hoop, points.length)
        method, integration = options.method, options.integration
        pair = integration.pair(support, method.force, method.strain, factor)
        if options.tangent == "conjugate":
            tangent = integration.conjugate(support, method.force, factor)
        else:
            tangent = integration.stiffness(support, method.force, method.strain, factor, pair)
        operator = self._averaged(made_for(options.engine, pair))
        return operator, operator if tangent is pair else self._averaged(made_for(options.engine, tangent))

    def _averaged(self, pair: Any) -> Any:
        """Operators that take means of dilation over cells, if that is wanted."""
        if self.options.remedy == "none":
            return pair
        if not hasattr(pair, "volume"):
            raise ValueError("remedy: got 'bbar' with moduli that are mapped to Gauss points, which have no cell "
                             "means; expected another integration, such as 'points', 'dm-stress' or 'dual'.")
        points, support, options = self.support.particles, self.support, self.options
        shares = cell_shares(support.grid, options.method.force, points.x, support.index, points.length, options.edges,
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

    def _elastic(self) -> ndarray:
        """Moduli of the unstressed material, ``(m, m, 1)`` or ``(m, m, n)``."""
        return moduli_at_rest(self.material, self.motion.history, self.particles.kinematics.ncomp, self.particles.n,
                              self.motion.places)

    # -- a step ------------------------------------------------------------------------------------------------------

    def advance(self, share: float, load: Callable[[float], Any], done: float) -> State:
        """The state after ``share`` of a load step that starts ``done`` steps into the run."""
        walls = self._constraints(share)
        self._check_held(walls)
        gravity = load(done + share)
        external = self._weight(gravity)
        if self.options.scheme == "incremental":
            before = self._weight(self.state.gravity)
            unknowns, force, residuals = self._solve_once(external - before, walls)
        elif self.state.control is not None:
            return self._controlled(share, gravity, external, walls)
        elif self.options.dt:
            return self._dynamic(share, gravity, external, walls, load(done))
        else:
            unknowns, force, residuals = self._newton(_Problem(external, walls.rows, walls.values, walls.columns))
        reactions = self._reactions(force, walls)
        return self._finish(self.support.spread(unknowns), share, residuals, reactions, gravity)

    def _controlled(self, share: float, gravity: Any, load: ndarray, walls: Walls) -> State:
        """The state where the place of the control has moved on by a share of its increment, and with what load."""
        rows, values, owner = walls.rows, walls.values, walls.owner
        control, free = self.state.control, self.support.free
        size = np.abs(load[free]).max(initial=0.0)
        if not size > 0:
            raise ValueError("control: got no load to scale; give gravity that acts on nodes which are not fixed.")
        bordered = stack_rows([rows, control.row(self.support)], len(free))
        owners = [*owner, None]
        if len(independent_rows(bordered[:, np.flatnonzero(free)], np.zeros(len(owners)), owners)[0]) == len(values):
            raise ValueError(f"control: got the place {control.x.tolist()}, which walls and planes do not let move "
                             f"along {control.direction.tolist()}; choose another place or direction.")
        columns = hstack([walls.columns, csr_array(-load[:, None] / size)], format="csr")
        problem = _Problem(np.zeros_like(load), bordered, np.append(values, share * control.increment), columns)
        unknowns, force, residuals = self._newton(problem)
        factor = force[-1] / size
        force = np.concatenate([force[:len(load)] - factor * load, force[len(load):-1]])
        reactions = self._reactions(force, walls)
        state = self._finish(self.support.spread(unknowns), share, residuals, reactions, factor * np.asarray(gravity))
        return replace(state, factor=float(factor), control=control.advanced(self.support, unknowns))

    def _dynamic(self, share: float, gravity: Any, external: ndarray, walls: Walls, before: Any) -> State:
        """The state a share of the time step later."""
        options, old = self.options, self.state.acceleration
        dt = share * options.dt
        problem = _Problem(external, walls.rows, walls.values, walls.columns)
        inertia = Inertia(self.support, dt, options.numerical_damping, options.solver or solve_direct)
        if old is None:
            start = self._iterate(problem, 0 * external, 0 * walls.values)
            if start.trouble:
                raise Retry(start.trouble)
            old = inertia.at_rest(self._weight(before) - start.force, walls.rows, walls.columns)
        velocity = self.particles.velocity
        inertia.start(velocity, old)
        self.inertia = inertia
        unknowns, force, residuals = self._newton(problem)
        reactions = self._reactions(force, walls)
        state = self._finish(self.support.spread(unknowns), share, residuals, reactions, gravity)
        new = inertia.to_points(inertia.acceleration(unknowns))
        particles = replace(state.particles, velocity=inertia.velocity(velocity, old, new))
        return replace(state, particles=particles, acceleration=new, time=self.state.time + dt)

    def _check_held(self, walls: Walls) -> None:
        """Without inertia, boundaries and the control have to leave no part of the body free."""
        if self.options.dt:
            return
        if self.state._recovery is None:
            warn_of_idle(self.support)
            warn_of_bare_cells(self.support)
        control = self.state.control
        rows = [walls.rows] if control is None else [walls.rows, control.row(self.support)]
        self.parts.check_held(self.support, stack_rows(rows, len(self.support.free)))

    def _constraints(self, share: float) -> Walls:
        """Independent constraints by walls."""
        moving, pushing = [], []
        values: list[float] = []
        owner: list[tuple[str, int]] = []
        for wall in self.state.boundary:
            if hasattr(wall, "rows"):
                rows, columns, wanted, components = wall.rows(self.support, share)
                moving += rows
                pushing += columns
                values += wanted
                owner += [(wall.name, component) for component in components]
        if not values and self.support.free.all() and not self.options.dt:
            raise ValueError("boundary: nothing is fixed and no wall holds the body; add a FixedPlane or a Wall where "
                             "it is.")
        size, free = self.support.transfer.shape[1], np.flatnonzero(self.support.free)
        stacked, targets = stack_rows(moving, size), np.array(values)
        if not values:
            return Walls(stacked, stacked.T, targets, owner)
        columns = stack_rows(pushing, size)
        kept, targets = independent_rows(stacked[:, free], targets, owner)
        if self.options.method.motion is not None:       # what pushes may depend where what moves does not
            more, _ = independent_rows(columns[kept][:, free], np.zeros(len(kept)), kept.tolist())
            kept, targets = kept[more], targets[more]
        return Walls(stacked[kept], columns[kept].T, targets, [owner[row] for row in kept])

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

    def _solve_once(self, external: ndarray, walls: Walls) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        moduli = self._elastic()
        stiffness = self._stiffness(moduli if self.options.remedy == "none" else self.motion.at_rest(moduli))
        unknowns, multipliers = self._linear_solve(stiffness, external, walls.rows, walls.values, walls.columns)
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
        return full if self.inertia is None else full + self.inertia.stiffness

    def _newton(self, problem: _Problem) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        at = self._iterate(problem, np.zeros(problem.rows.shape[1]), np.zeros(len(problem.values)))
        if at.trouble:
            raise Retry(at.trouble)
        problem = replace(problem, before=float(np.linalg.norm(at.force)))
        residuals: list[float] = []
        tolerance, lenient = self.options.tolerance, self.options.lenient
        passes = MAX_PASSES if self.tangent_operator is self.operator else MAX_INEXACT
        for _ in range(passes):
            try:
                at = self._pass(problem, at, first=not residuals)
            except Retry:
                if lenient and residuals:
                    break
                raise
            residuals.append(at.residual)
            stalled = len(residuals) > MAX_PASSES and residuals[-1] > residuals[-1 - MAX_PASSES] / 2
            if at.residual <= tolerance or stalled:
                break
        if at.residual <= tolerance or lenient:
            return at.unknowns, np.concatenate([at.force - problem.external, at.multipliers]), tuple(residuals)
        raise Retry(f"the residual stayed at {residuals[-1]:.1e}, above the tolerance of {tolerance:g}, after "
                    f"{len(residuals)} Newton passes")

    def _pass(self, problem: _Problem, at: _Iterate, first: bool) -> _Iterate:
        """One pass of Newton's method."""
        stiffness = self._stiffness(at.response.tangent())
        if not np.isfinite(stiffness.data).all():
            raise Retry("the stiffness is not finite; look at the tangent of the law")
        problem = replace(problem, diagonal=stiffness.diagonal())
        change, target = self._linear_solve(stiffness, problem.external - at.force, problem.rows,
                                            problem.values - problem.rows @ at.unknowns, problem.columns)
        return self._line_search(problem, at, change, target, first)

    def _line_search(self, problem: _Problem, at: _Iterate, change: ndarray, target: ndarray, first: bool) -> _Iterate:
        """Take the largest of a few shares of the change that lowers the residual; in the first pass the whole."""
        for scale in SHARES[:1] if first else SHARES:
            multipliers = at.multipliers + scale * (target - at.multipliers)
            trial = self._iterate(problem, at.unknowns + scale * change, multipliers)
            if np.isfinite(trial.residual) and (first or trial.residual < max(at.residual, self.options.tolerance)):
                return trial
        if first:
            raise Retry(f"after the first Newton pass {trial.trouble}")
        raise Retry(f"the residual did not fall below {at.residual:.1e}")

    def _iterate(self, problem: _Problem, unknowns: ndarray, multipliers: ndarray) -> _Iterate:
        """Response, force and residual at a trial displacement; the residual is infinite where something is wrong."""
        support = self.support
        gradient = self.operator.gradient(support.spread(unknowns))
        response, trouble = respond(self.motion, gradient, self.particles.x)
        if trouble:
            return _Iterate(unknowns, multipliers, None, unknowns, np.inf, trouble)
        soft = support.transfer.T @ (self.soft @ (support.transfer @ unknowns))
        force = support.gather(self.operator.force(response.piola)) + soft
        if self.inertia is not None:
            force = force + self.inertia.force(unknowns)
        wall = problem.columns @ multipliers
        unbalanced = np.linalg.norm((force - problem.external + wall)[support.free])
        size = problem.before + sum(np.linalg.norm(part) for part in (force, problem.external, wall))
        if not np.isfinite(size):
            return _Iterate(unknowns, multipliers, None, unknowns, np.inf, "the forces are not finite")
        noise = 1e-14 * np.linalg.norm(problem.diagonal * unknowns)    # all there is where nothing resists
        residual = 0.0 if unbalanced <= noise else float(unbalanced / size)
        return _Iterate(unknowns, multipliers, response, force, residual)

    def _linear_solve(self, stiffness: csr_array, force: ndarray, rows: csr_array, values: ndarray,
                      columns: csr_array) -> tuple[ndarray, ndarray]:
        solver, free = self.options.solver, self.support.free
        if solver is None:
            near = self.near
            solver = self.factors.solver(lambda: bordered(near() if near else stiffness, rows, free, columns)[0])
        return solve_constrained(solver, stiffness, force, rows, values, free, columns)

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _reactions(self, force: ndarray, walls: Walls) -> dict[str, ndarray]:
        """Force of walls and planes on the body; ``force`` ends with the multipliers."""
        support, dim = self.support, self.particles.dim
        unbalanced, multipliers = np.split(force, [walls.rows.shape[1]])
        unbalanced = (unbalanced + walls.columns @ multipliers).reshape(-1, dim).T
        grows = self.options.scheme == "incremental"            # there each step only knows what it adds
        reactions = {name: grows * before for name, before in self.state.reactions.items()}
        for (name, component), multiplier in zip(walls.owner, multipliers):
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
        response, trouble = respond(self.motion, gradient, self.particles.x)
        if trouble:
            raise Retry(trouble)
        check_yield(self.material, response, old.x, self.state.step + 1, self.options.yields)
        volume = old.volume * response.ratio            # by the dilation that the stress knows of
        warn_of_folds(support, u, self.state.step + 1)
        if self.options.domains == "fixed" and not self.options.integration.covers:
            warn_of_too_few(support, old, volume, self.state.step + 1)
        particles = replace(old, x=old.x + support.motion.to_points(u, plain=True), volume=volume,
                            sigma=response.sigma, epsilon=response.epsilon,
                            history=response.history if self.material.history else None)
        particles = self._with_domains(particles, gradient)
        displacement = np.zeros((old.dim, self.mesh.nvertices))
        displacement[:, support.grid.vertices.ravel()] = u
        boundary = tuple(item.advanced(share) for item in self.state.boundary)
        basis = self.options.method.strain
        recovery = Recovery(support.grid, basis, self.options.edges, support.sides_of(basis), support.occupied, u,
                            STRAINS[self.options.strain], old.kinematics, self.material, self.ring,
                            self.options.method.force, self._dilation(gradient),
                            self.options.integration.recovers)
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


def _needed(particles: Particles, options: Options) -> Particles:
    """Only what the scene requires: velocity with inertia, boxes if anything reads them; given parallelograms stay."""
    method = options.method
    readers = (method.mass, method.strain, method.force, options.integration)
    uses_boxes = any(each.reads_domains for each in readers)
    return replace(particles, velocity=particles.velocity if options.dt else None,
                   length=particles.length if uses_boxes or options.weights == "overlap" else None,
                   spans=spans_of(particles) if options.integration.covers else particles.spans)


def _seen(mesh: Mesh, particles: Particles, options: Options) -> Particles:
    """The points as functions see them: stretched boxes that outgrow the neighbours of their cell are cut off."""
    if options.domains == "fixed" or particles.length is None:
        return particles
    grid = Grid.from_mesh(mesh)
    grid.check_dim(particles.dim)
    return replace(particles, length=grid.fitting(particles.x, grid.locate(particles.x), particles.length))
