"""Quasi-static load steps to equilibrium, as a generator of snapshots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import block_array, csc_array, csr_array, issparse
from scipy.sparse.linalg import splu
from skfem import Mesh

from .basis import METHODS, Method
from .checks import NotConvergedError, check_choice
from .grid import EDGES, Edges
from .integration import INTEGRATIONS
from .kinematics import STRAINS, Response
from .particles import Particles
from .support import Support, stack_rows
from .weights import WEIGHTS, weights

SCHEMES = ("equilibrated", "incremental")
TANGENTS = ("exact", "conjugate")
Solver = Callable[[Any, ndarray], ndarray]


@dataclass(frozen=True, eq=False)
class State:
    """A snapshot: everything a run needs to go on, and what the last step found.

    Attributes
    ----------
    step
        Load steps done.
    particles
        The points.
    boundary
        Walls and planes where they are now.
    displacement
        ``(dim, nvertices)``; nodal displacement of the last step (of its last part if it was cut), on the mesh.
    reactions
        Force of each named wall and plane on the body, ``(dim,)``; per radian in axial symmetry.
    residuals
        Relative residual after each Newton pass of the last step; empty for the incremental scheme.
    cuts
        How often the step had to be cut in two.
    scheme
        How the step was made.
    """

    step: int
    particles: Particles
    boundary: tuple[Any, ...]
    displacement: ndarray
    reactions: dict[str, ndarray]
    residuals: tuple[float, ...] = ()
    cuts: int = 0
    scheme: str = ""
    _recovery: Any = field(default=None, repr=False)

    def recover(self, x: ndarray, length: ndarray | None = None) -> ndarray:
        """Stress increment of the last step at any positions in the body, ``(ncomp, n)``.

        Recovered as the method recovers strain at its points, from the grid as it was at the start of the step; after the
        first step from zero stress this is the stress.

        Parameters
        ----------
        x
            ``(dim, n)``; positions at the start of the step.
        length
            ``(dim, n)``; domains, for methods that recover strain with GIMP.

        Raises
        ------
        ValueError
            If there is no step to recover from.
        """
        if self._recovery is None:
            raise ValueError("state: got one without a step behind it; take a state that implicit_steps has yielded.")
        return self._recovery(x, length)


@dataclass(frozen=True)
class _Options:
    """The choices of a run, checked."""

    method: Method
    strain: str
    scheme: str
    weights: str
    integration: str
    edges: Edges
    tangent: str
    floor: float
    tolerance: float
    solver: Solver


def implicit_steps(mesh: Mesh | Callable[[State], Mesh], start: Particles | State, material: Any, boundary: Sequence[Any] = (),
                   *, steps: int, method: str | Method = "mpm", strain: str = "logarithmic", scheme: str = "equilibrated",
                   weights: str = "one", integration: str = "points", edges: Edges = "ghost", tangent: str | None = None,
                   gravity: Any = None, solver: Solver | None = None, floor: float = 1e-6, tolerance: float = 1e-10,
                   max_cuts: int = 6) -> Iterator[State]:
    """Bring a body to equilibrium load step by load step; yields a :class:`State` after each.

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh; or a function of the state that gives the mesh of the next step.
    start
        The points, or a state to go on from (its own boundary is then used).
    material
        A law such as ``LinearElastic`` or ``Hencky``.
    boundary
        Fixed planes and walls, see :mod:`skfem_mpm.boundary`.
    steps
        Number of load steps to do.
    method
        A name of ``METHODS`` or a ``Method``.
    strain
        ``logarithmic`` (finite strain) or ``small`` (small-strain increments on updated positions, as in the paper).
    scheme
        ``equilibrated`` (Newton on the residual, the geometry being that of the start of the step) or ``incremental``
        (one linear solve from the elastic stiffness; stress is never fed back).
    weights
        Integration weights: ``one``, ``eq10``, ``interior``, ``overlap``; see :mod:`skfem_mpm.weights`.
    integration
        How point stress becomes nodal force: ``points``.
    edges
        What GIMP does at the edge of the grid: ``ghost``, ``truncate``, ``clip``.
    tangent
        ``exact`` derivative of the residual (default of ``equilibrated``), or ``conjugate``: the functions that carry
        force on both sides, as in the paper (default of ``incremental``).
    gravity
        Body force per mass ``(dim,)``, or a function of the (possibly fractional) step that gives it.
    solver
        Any scikit-fem style ``solver(A, b)``; SuperLU with minimum-degree ordering if not given.  With walls the matrix is
        symmetric indefinite (multipliers), and unsymmetric for methods whose strain is not conjugate to force.
    floor
        Soft elastic stiffness as a share of the mean modulus, on all cells around the body.
    tolerance
        Largest residual of a step, relative to the forces in it.
    max_cuts
        How often a step that does not converge is cut in two before the run stops.

    Raises
    ------
    ValueError, TypeError
        If an argument is unknown or does not fit.
    OutsideGridError
        If a point, a domain or a wall leaves the grid.
    NotConvergedError
        If a step finds no equilibrium or the solver fails; ``.state`` is the last good state.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, uniaxial
    >>> from skfem_mpm.boundary import FixedPlane
    >>> mesh = MeshLine(np.linspace(0, 1, 11))
    >>> bar = Particles.fill(mesh, uniaxial, density=1.0)
    >>> fixed = [FixedPlane(axis=0, at=0.0, side=-1, name="base")]
    >>> for state in implicit_steps(mesh, bar, LinearElastic(E=1e3, nu=0.0), fixed, steps=1, gravity=(-1e-3,)):
    ...     print(state.step, round(float(state.reactions["base"][0]), 9))
    1 0.001
    """
    options = _check(method, strain, scheme, weights, integration, edges, tangent, floor, tolerance, solver)
    if int(steps) != steps or steps < 1:
        raise ValueError(f"steps: got {steps}, expected a whole number of at least 1.")
    state = start if isinstance(start, State) else _initial(start, tuple(boundary))
    load = gravity if callable(gravity) else lambda step: gravity
    return _run(mesh, state, material, options, int(steps), load, max_cuts)


def _check(method: str | Method, strain: str, scheme: str, weights: str, integration: str, edges: Edges, tangent: str | None,
           floor: float, tolerance: float, solver: Solver | None) -> _Options:
    if not isinstance(method, Method):
        check_choice("method", method, METHODS)
        method = METHODS[method]
    for name, value, choices in [("strain", strain, STRAINS), ("scheme", scheme, SCHEMES), ("weights", weights, WEIGHTS),
                                 ("integration", integration, INTEGRATIONS), ("edges", edges, EDGES)]:
        check_choice(name, value, choices)
    tangent = tangent or ("exact" if scheme == "equilibrated" else "conjugate")
    check_choice("tangent", tangent, TANGENTS)
    for name, number in [("floor", floor), ("tolerance", tolerance)]:
        if not (0 <= number < 1):
            raise ValueError(f"{name}: got {number}, expected a number from 0 to below 1.")
    return _Options(method, strain, scheme, weights, integration, edges, tangent, floor, tolerance, solver or solve_direct)


def _initial(particles: Particles, boundary: tuple[Any, ...]) -> State:
    if not boundary:
        raise ValueError("boundary: got nothing that holds the body; give a FixedPlane or a Wall.")
    return State(0, particles, boundary, np.zeros((particles.dim, 0)), {})


def _run(mesh: Any, state: State, material: Any, options: _Options, steps: int, load: Callable[[float], Any],
         max_cuts: int) -> Iterator[State]:
    for _ in range(steps):
        good, done, share, cuts = state, 0.0, 1.0, 0
        while done < 1:
            here = mesh(state) if callable(mesh) else mesh
            try:
                state = _Step(here, state, material, options).advance(share, load, good.step + done)
            except _Retry as failure:
                share, cuts = share / 2, cuts + 1
                if cuts > max_cuts:
                    raise NotConvergedError(
                        f"step {good.step + 1}: {failure} even after cutting it {max_cuts} times; the last good state is in "
                        ".state. Use smaller steps, or look for what fails there.", good) from None
            except NotConvergedError as failure:
                raise NotConvergedError(f"step {good.step + 1}: {failure}", good) from None
            else:
                done += share
        state = replace(state, step=good.step + 1, cuts=cuts)
        yield state


class _Retry(Exception):
    """The step did not converge and may do so in smaller parts."""


class _Step:
    """One load step (or a part of it) on the grid as it is at its start."""

    def __init__(self, mesh: Mesh, state: State, material: Any, options: _Options):
        self.mesh, self.state, self.material, self.options = mesh, state, material, options
        particles, method = _needed(state.particles, options), options.method
        self.particles = particles
        self.support = Support(mesh, particles, method, options.edges, state.boundary)
        self.motion = self._motion(particles)
        self.operator = self._operator(method.force, method.strain)
        self.floor = self._floor_stiffness()

    def _motion(self, particles: Particles) -> Any:
        kinematics = particles.kinematics
        sigma = np.zeros((kinematics.ncomp, particles.n)) if particles.sigma is None else particles.sigma
        return STRAINS[self.options.strain](kinematics, particles.dim, self.material, sigma, particles.epsilon)

    def _operator(self, force: type, strain: type) -> Any:
        support, points = self.support, self.particles
        factor = weights(self.options.weights, support.grid, support.index, points.x, points.volume, points.kinematics.hoop,
                         points.length)
        return INTEGRATIONS[self.options.integration](points.kinematics, support.stencil(force), support.stencil(strain),
                                                      factor * points.volume, points.x[0])

    def _floor_stiffness(self) -> csc_array:
        """Soft stiffness of whole cells, with two Gauss points per axis; ordinary finite elements."""
        support, kinematics = self.support, self.particles.kinematics
        size = support.transfer.shape[0]
        cells = support.sound_cells()
        if not self.options.floor or not cells.size:
            return csc_array((size, size))
        grid, dim = support.grid, support.grid.dim
        offset = (np.indices((2,) * dim).reshape(dim, -1) * 2 - 1) / np.sqrt(12) + 0.5
        index = np.repeat(cells, 2 ** dim, axis=1)
        place = np.tile(offset, cells.shape[1])
        step = np.stack([grid.steps[k][index[k]] for k in range(dim)])
        x = np.stack([grid.axes[k][index[k]] for k in range(dim)]) + place * step
        volume = step.prod(axis=0) / 2 ** dim * (x[0] if kinematics.hoop else 1.0)
        stencil = grid.linear(x, index)
        moduli = self._elastic().mean(axis=2, keepdims=True)
        floor = INTEGRATIONS["points"](kinematics, stencil, stencil, volume, x[0])
        return floor.tangent(self.options.floor * moduli, support.number, size)

    def _elastic(self) -> ndarray:
        """Moduli of the unstressed material, ``(m, m, 1)`` or ``(m, m, n)``."""
        zero = np.zeros((self.particles.kinematics.ncomp, self.particles.n))
        return self.material.tangent(zero, zero, self.motion.places)

    # -- a step ------------------------------------------------------------------------------------------------------

    def advance(self, share: float, load: Callable[[float], Any], done: float) -> State:
        """The state after ``share`` of a load step that starts ``done`` steps into the run."""
        rows, values, owner = self._constraints(share)
        external = self._weight(load(done + share))
        if self.options.scheme == "incremental":
            unknowns, force, residuals = self._solve_once(external - self._weight(load(done) if done else None), rows, values)
        else:
            unknowns, force, residuals = self._newton(external, rows, values)
        return self._finish(self.support.spread(unknowns), share, residuals, self._reactions(force, rows, owner))

    def _constraints(self, share: float) -> tuple[csr_array, ndarray, list[tuple[str, int]]]:
        """Wall rows over the solved components, scaled like the stiffness, and whose they are."""
        rows, values, owner = [], [], []
        for wall in self.state.boundary:
            if hasattr(wall, "rows"):
                new, targets, components = wall.rows(self.support, share)
                rows, values = rows + new, values + targets
                owner += [(wall.name, component) for component in components]
        if not rows and self.support.free.all():
            raise ValueError("boundary: nothing is fixed and no wall holds the body; add a FixedPlane or a Wall where it is.")
        return stack_rows(rows, self.support.transfer.shape[1]), np.array(values), owner

    def _weight(self, gravity: Any) -> ndarray:
        """Body force on the solved components."""
        if gravity is None:
            return np.zeros(self.support.transfer.shape[1])
        gravity = np.asarray(gravity, dtype=float)
        if gravity.shape != (self.particles.dim,):
            raise ValueError(f"gravity: got shape {gravity.shape}, expected ({self.particles.dim},), one entry per axis.")
        return self.support.gather(gravity[:, None] * self.support.mass)

    def _solve_once(self, external: ndarray, rows: csr_array, values: ndarray) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        moduli = self._elastic()
        stiffness = self._stiffness(moduli)
        unknowns, multipliers = self._linear_solve(stiffness, external, rows, values)
        return unknowns, np.concatenate([stiffness @ unknowns - external, multipliers]), ()

    def _stiffness(self, moduli: ndarray) -> csr_array:
        operator = self.operator
        if self.options.tangent == "conjugate":
            operator = self._operator(self.options.method.force, self.options.method.force)
        support = self.support
        full = operator.tangent(moduli, support.number, support.transfer.shape[0]) + self.floor
        return support.transfer.T @ full @ support.transfer if support.slaved else full

    def _newton(self, external: ndarray, rows: csr_array, values: ndarray) -> tuple[ndarray, ndarray, tuple[float, ...]]:
        unknowns, multipliers = np.zeros(rows.shape[1]), np.zeros(len(values))
        response, force = self._internal(unknowns)
        residuals: list[float] = []
        for _ in range(MAX_PASSES):
            stiffness = self._stiffness(response.tangent())
            change, target = self._linear_solve(stiffness, external - force, rows, values - rows @ unknowns)
            unknowns, multipliers, response, force, residual = self._line_search(
                unknowns, change, multipliers, target, external, rows, residuals)
            residuals.append(residual)
            if residual <= self.options.tolerance:
                return unknowns, np.concatenate([force - external, multipliers]), tuple(residuals)
        raise _Retry(f"the residual stayed at {residuals[-1]:.1e} after {MAX_PASSES} Newton passes")

    def _line_search(self, unknowns: ndarray, change: ndarray, multipliers: ndarray, target: ndarray, external: ndarray,
                     rows: csr_array, residuals: list[float]) -> tuple[ndarray, ndarray, Response, ndarray, float]:
        """Take the largest of a few shares of the Newton change that lowers the residual (the first pass: the whole)."""
        for scale in (1.0, 0.5, 0.25, 0.125):
            trial, forces = unknowns + scale * change, multipliers + scale * (target - multipliers)
            if self.motion.stretch(self.operator.gradient(self.support.spread(trial))).min() > 0:
                response, force = self._internal(trial)
                residual = self._relative(force, external, rows, forces)
                if not residuals or residual < max(residuals[-1], self.options.tolerance):
                    return trial, forces, response, force, residual
            elif not residuals:
                break
        raise _Retry("a Newton pass turned a point inside out" if not residuals else
                     f"the residual did not fall below {residuals[-1]:.1e}")

    def _internal(self, unknowns: ndarray) -> tuple[Response, ndarray]:
        support = self.support
        response = self.motion.respond(self.operator.gradient(support.spread(unknowns)))
        soft = support.transfer.T @ (self.floor @ (support.transfer @ unknowns))
        return response, support.gather(self.operator.force(response.piola)) + soft

    def _relative(self, force: ndarray, external: ndarray, rows: csr_array, multipliers: ndarray) -> float:
        """Residual of the free components, relative to the forces in the step."""
        wall, free = rows.T @ multipliers, self.support.free
        size = np.linalg.norm(force) + np.linalg.norm(external) + np.linalg.norm(wall)
        residual = np.linalg.norm((force - external + wall)[free])
        if not np.isfinite(residual):
            return np.inf
        return float(residual / size) if size > 0 else 0.0

    def _linear_solve(self, stiffness: csr_array, force: ndarray, rows: csr_array, values: ndarray) -> tuple[ndarray, ndarray]:
        """Displacements and multipliers of one linear system; fixed components stay zero."""
        free = np.flatnonzero(self.support.free)
        matrix = csc_array(stiffness) if len(free) == stiffness.shape[0] else csc_array(stiffness)[:, free][free]
        scale = abs(matrix.diagonal()).mean() if len(values) else 1.0
        rows = rows[:, free]
        system = block_array([[matrix, scale * rows.T], [scale * rows, None]], format="csc") if len(values) else matrix
        rhs = np.concatenate([force[free], scale * values])
        solution = np.asarray(self.options.solver(system, rhs))
        error = np.linalg.norm(system @ solution - rhs) if solution.shape == rhs.shape else np.inf
        if not error <= 1e-6 * np.linalg.norm(rhs):
            raise NotConvergedError(f"solver: got a linear residual of {error:.1e}, expected at most 1e-6 of "
                                    f"{np.linalg.norm(rhs):.1e}; look for parts that nothing holds, or use another solver.")
        unknowns = np.zeros(stiffness.shape[0])
        unknowns[free] = solution[:len(free)]
        return unknowns, scale * solution[len(free):]

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _reactions(self, force: ndarray, rows: csr_array, owner: list[tuple[str, int]]) -> dict[str, ndarray]:
        """Force of walls and planes on the body; ``force`` ends with the multipliers."""
        support, dim = self.support, self.particles.dim
        unbalanced, multipliers = np.split(force, [rows.shape[1]])
        unbalanced = (unbalanced + rows.T @ multipliers).reshape(-1, dim).T
        reactions: dict[str, ndarray] = {}
        for (name, component), multiplier in zip(owner, multipliers):
            reactions.setdefault(name, np.zeros(dim))[component] -= multiplier
        for plane in self.state.boundary:
            if hasattr(plane, "fixes"):
                on = plane.fixes(support.grid)[:, support.solved_nodes]
                reactions.setdefault(plane.name, np.zeros(dim))[:] += (unbalanced * on).sum(axis=1)
        return reactions

    def _finish(self, u: ndarray, share: float, residuals: tuple[float, ...], reactions: dict[str, ndarray]) -> State:
        support, old = self.support, self.particles
        gradient = self.operator.gradient(u)
        ratio = self.motion.stretch(gradient)
        if not ratio.min() > 0:
            raise _Retry("a point turned inside out")
        response = self.motion.respond(gradient)
        particles = replace(old, x=old.x + support.mapping.to_points(u), volume=old.volume * ratio, sigma=response.sigma,
                            epsilon=response.epsilon)
        displacement = np.zeros((old.dim, self.mesh.nvertices))
        displacement[:, support.grid.vertices.ravel()] = u
        displacement.flags.writeable = False
        return State(self.state.step, particles, tuple(item.advanced(share) for item in self.state.boundary), displacement,
                     reactions, residuals, scheme=self.options.scheme, _recovery=_Recovery(support, u, self.material, self.options, old.kinematics))


MAX_PASSES = 25


@dataclass(frozen=True, eq=False)
class _Recovery:
    """Recovers the stress increment of a step at any positions."""

    support: Support
    u: ndarray
    material: Any
    options: _Options
    kinematics: Any

    def __call__(self, x: ndarray, length: ndarray | None) -> ndarray:
        stencil = self.support.stencil(self.options.method.strain, x, length)
        gradient = INTEGRATIONS["points"](self.kinematics, stencil, stencil, np.ones(x.shape[1]), x[0]).gradient(self.u)
        zero = np.zeros((self.kinematics.ncomp, x.shape[1]))
        motion = STRAINS[self.options.strain](self.kinematics, len(x), self.material, zero, None)
        return motion.respond(gradient).sigma


def _needed(particles: Particles, options: _Options) -> Particles:
    """Only what the scene requires: domains are carried along if a basis or the weights read them."""
    method = options.method
    uses_domains = any(basis.reads_domains for basis in (method.mass, method.strain, method.force))
    return particles if uses_domains or options.weights == "overlap" else replace(particles, length=None)


def solve_direct(matrix: Any, rhs: ndarray) -> ndarray:
    """SuperLU with minimum-degree ordering of the symmetric pattern.

    Raises
    ------
    NotConvergedError
        If the matrix is singular.
    """
    matrix = csc_array(matrix) if not issparse(matrix) or matrix.format != "csc" else matrix
    try:
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise NotConvergedError(f"solver: {error}; some part of the body is held by nothing: add a FixedPlane or a Wall, or "
                                "keep the soft floor above zero.") from None
    return factor.solve(rhs)
