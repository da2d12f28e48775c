"""Quasi-static load steps to equilibrium, as a generator of snapshots."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any

import numpy as np
from skfem import Mesh

from ..basis import Method, find_method
from ..cautions import caution, caution_at_axis
from ..checks import NotConvergedError, OutsideGridError, check_choice, check_guards, warn_of_relaxed
from ..grid import EDGES, Edges
from ..integration import find_integration
from ..kinematics import DOMAINS, RADII, STRAINS
from ..particles import Particles
from ..weights import WEIGHTS
from .control import Control
from .engine import engine_of
from .solve import solve_cg, solve_direct
from .state import Options, Solver, State
from .step import Retry, Step

__all__ = ["Control", "State", "implicit_steps", "solve_cg", "solve_direct"]

SCHEMES = ("equilibrated", "incremental")
TANGENTS = ("exact", "conjugate")
REMEDIES = ("none", "bbar")
# What each guard can do, first what it does if nothing is said.
GUARDS = {"converged": ("stop", "warn"), "yield": ("stop", "warn", "off")}
NUMBER: Any = Real             # of a type that mypy takes for any: it does not know that these can be compared


def implicit_steps(mesh: Mesh | Callable[[State], Mesh], start: Particles | State, material: Any,
                   boundary: Sequence[Any] | None = None, *, steps: int, method: str | Method = "mpm",
                   strain: str = "logarithmic", scheme: str = "equilibrated", weights: str = "one",
                   integration: Any = "points", edges: Edges = "ghost", domains: str = "fixed", radius: str = "point",
                   tangent: str | None = None, gravity: Any = None, solver: Solver | None = None, floor: float = 1e-6,
                   ghost: float = 0.0, tolerance: float = 1e-11, max_cuts: int = 6, control: Control | None = None,
                   dt: float | None = None, numerical_damping: float = 0.0, engine: str = "auto",
                   remedy: str = "none", guards: Mapping[str, str] | None = None) -> Iterator[State]:
    r"""Bring a body to equilibrium load step by load step, or move it in time; yields a :class:`State` after each.

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh; or a function of the state that gives the mesh of the next step.
    start
        The points, or a state to go on from.
    material
        A law such as ``LinearElastic`` or ``Hencky``.
    boundary
        Fixed planes and walls, see :mod:`skfem_mpm.boundary`; those of the state if not given.  In dynamics a body may
        be free.
    steps
        Number of load steps (or time steps) to do.
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
        How point stress becomes nodal force, and moduli the stiffness: ``points``; ``field``, ``field2``, ``cubic``,
        ``twin``, ``twin2`` or ``dual``, which fit stress and integrate over cells; double mapping (a reconstruction)
        ``dm`` and ``dm-g`` of the stiffness alone, ``dm-stress`` and ``dm-g-stress`` of the stress too; or an object
        like those in ``INTEGRATIONS``, see :mod:`skfem_mpm.integration`.
    edges
        What GIMP does at the edge of the grid: ``ghost``, ``truncate``, ``clip``.
    domains
        Boxes that GIMP averages over: ``fixed`` (edges stay as they are, as in the paper) or ``stretched`` (they follow
        the stretch along the axes and the points' volume; one that outgrows the neighbours of its cell is seen cut off
        there).
    radius
        In axial symmetry, what GIMP takes as the radius: that of the ``point`` (as in the paper), or the one under the
        integral over its ``domain``.
    tangent
        ``exact`` derivative of the residual (default of ``equilibrated``), or ``conjugate``: the functions that carry
        force on both sides, as in the paper (default of ``incremental``).  ``dm`` and ``dm-g`` have a stiffness of
        their own in both cases.
    gravity
        Body force per mass ``(dim,)``, or a function of the (possibly fractional) step that gives it.  In a step that
        is cut a constant one grows from what acted before; with ``dt`` it acts from the start.
    solver
        Any scikit-fem style ``solver(A, b)``, such as :func:`solve_direct` or :func:`solve_cg`.  If not given, large
        systems are factorised once per step, by SuperLU, and GMRES makes up for what has changed since.  With walls the
        matrix is symmetric indefinite (multipliers), and unsymmetric for methods whose strain is not conjugate to
        force.
    floor
        Soft elastic stiffness on all cells around the body, as a share of the mean modulus; of the smallest one in a
        cell (or around it), where moduli differ from point to point.
    ghost
        Ghost penalty on jumps of the displacement's normal gradient at cut cells, as a share of Young's modulus; 0 for
        none, 0.1 is a good value in 2-D and 3-D; see :mod:`skfem_mpm.ghost`.
    tolerance
        Largest residual of a step, relative to the forces in it.
    max_cuts
        How often a step that does not converge is cut in two before the run stops.
    control
        Scales gravity by an unknown factor such that a place of the body moves by a given amount per step: a run passes
        the peak of its load.  ``state.factor`` is what came out; to go on from a state give ``state.control``.
    dt
        Time step; without one there is no inertia.  With one, steps are Newmark's with lumped mass.  Points start from
        their velocity (at rest if they have none) and from the acceleration that the forces at the start give them; it
        is carried in the state from then on.
    numerical_damping
        ``alpha`` of Newmark's method, :math:`\gamma = \frac12 + \alpha` and
        :math:`\beta = \frac14 (\frac12 + \gamma)^2`: 0 is the trapezoidal rule, of second order; more damps the highest
        frequencies most, to first order in ``dt``.
    engine
        ``numpy``, ``numba`` (the extra ``fast``), or ``auto``: numba for many points.  Both agree to rounding.
    remedy
        Against volumetric locking: ``none``, or ``bbar``, where points answer to the mean dilation of their cells:
        B-bar with ``strain="small"``, F-bar in a symmetric form with ``"logarithmic"``; see
        :mod:`skfem_mpm.implicit.fbar`.  Not in one dimension without hoop strain.
    guards
        What to do where a limit is passed, by name: ``stop`` (if nothing is said), ``warn`` or ``off``.  They are
        ``converged`` (a step that does not converge after all cuts; with ``warn`` the best iterate is taken, which is
        not in equilibrium, and what it lacks is part of the next step) and ``yield`` (stress beyond the yield surface
        of a law that offers ``excess``, by more than 1e-6 of its strength; it warns in every such step); only the
        latter can be ``off``.

    Raises
    ------
    ValueError, TypeError
        If an argument is unknown or does not fit.
    ImportError
        If ``engine`` is ``numba`` and numba is not installed.
    OutsideGridError
        If a point, a domain or a wall leaves the grid.
    NotConvergedError
        If a step finds no equilibrium, the solver fails, a part of the body is held by nothing, a number is no longer
        finite or stress is beyond yield; ``.state`` is the last good state.

    Warns
    -----
    UserWarning
        If a guard is off, and where one that should ``warn`` has something to say; if the law is nearly incompressible
        and there is no remedy, points of a cell differ far in stiffness, a plane holds nothing, each cell holds one
        point, domains reach over the axis, a cell turns inside out between its points, points are stretched to most
        of a cell, or the body comes apart, be it only because its points are too far from each other.

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
    options = _check(method, strain, scheme, weights, integration, edges, tangent, floor, ghost, tolerance, solver)
    _check_extras(control, gravity, dt, numerical_damping, scheme)
    for name, value, choices in [("domains", domains, DOMAINS), ("radius", radius, RADII),
                                 ("remedy", remedy, REMEDIES)]:
        check_choice(name, value, choices)
    options = replace(options, domains=domains, radius=radius, dt=float(dt or 0.0),
                      numerical_damping=float(numerical_damping), remedy=remedy)
    for name, count, least in [("steps", steps, 1), ("max_cuts", max_cuts, 0)]:
        if not (isinstance(count, Integral) and count >= least):
            raise ValueError(f"{name}: got {count!r}, expected a whole number of at least {least}.")
    if not (hasattr(material, "update") and hasattr(material, "tangent")):
        raise TypeError(f"material: got {type(material).__name__}, expected a law such as LinearElastic.")
    if material.kirchhoff and scheme == "incremental":
        raise ValueError(f"scheme: got 'incremental' with {type(material).__name__}; expected a law whose Cauchy "
                         "stress follows small strains, such as LinearElastic.")
    state = replace(_initial(start, boundary, free=dt is not None), control=control)
    _check_remedy(options, state.particles)
    options = replace(options, engine=engine_of(engine, state, options.method))
    held = check_guards(guards, GUARDS)
    warn_of_relaxed(held)
    options = replace(options, yields=held["yield"])
    return _run(mesh, state, material, options, int(steps), gravity, max_cuts, held["converged"] == "warn")


def _check(method: str | Method, strain: str, scheme: str, weights: str, integration: Any, edges: Edges,
           tangent: str | None, floor: float, ghost: float, tolerance: float, solver: Solver | None) -> Options:
    method = find_method(method)
    for name, value, choices in [("strain", strain, STRAINS), ("scheme", scheme, SCHEMES),
                                 ("weights", weights, WEIGHTS), ("edges", edges, EDGES)]:
        check_choice(name, value, choices)
    tangent = tangent or ("exact" if scheme == "equilibrated" else "conjugate")
    check_choice("tangent", tangent, TANGENTS)
    for name, number in [("floor", floor), ("tolerance", tolerance)]:
        if not (isinstance(number, Real) and 0 <= number < 1):
            raise ValueError(f"{name}: got {number!r}, expected a number from 0 to below 1.")
    if not (isinstance(ghost, Real) and 0 <= ghost < np.inf):
        raise ValueError(f"ghost: got {ghost!r}, expected a finite number of at least 0; 0.1 is a usual one.")
    if solver is not None and not callable(solver):
        raise TypeError(f"solver: got {type(solver).__name__}, expected a function solver(A, b) that returns x.")
    integration = find_integration(integration)
    return Options(integration.method(method), strain, scheme, weights, integration, edges, tangent, floor, ghost,
                   tolerance, solver)


def _check_extras(control: Any, gravity: Any, dt: Any, numerical_damping: Any, scheme: str) -> None:
    """Refuse what makes a step more than a load step and does not fit."""
    if control is not None and not isinstance(control, Control):
        raise TypeError(f"control: got {type(control).__name__}, expected a Control.")
    if control is not None and gravity is None:
        raise ValueError("control: got no gravity to scale; give the load as gravity.")
    if dt is not None and not (isinstance(dt, NUMBER) and np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt: got {dt!r}, expected a time span above zero, or None for steps without inertia.")
    if not (isinstance(numerical_damping, NUMBER) and 0 <= numerical_damping <= 1):
        raise ValueError(f"numerical_damping: got {numerical_damping!r}, expected a number from 0 to 1; 0 is none.")
    if numerical_damping and dt is None:
        raise ValueError("numerical_damping: got some without a time step; give dt too, or leave it out.")
    if control is not None and dt is not None:
        raise ValueError("control: got one with dt; a load is controlled without inertia, so leave one of them out.")
    if scheme == "incremental" and not (control is None and dt is None):
        raise ValueError(f"scheme: got 'incremental' with {'dt' if control is None else 'control'}; expected "
                         "'equilibrated'.")


def _check_remedy(options: Options, particles: Particles) -> None:
    """Refuse means over cells where there are none, or where they would take all strain."""
    if options.remedy == "none":
        return
    if len(particles.kinematics.rows(particles.dim)) == 1:
        raise ValueError(f"remedy: got {options.remedy!r} with {particles.kinematics.name} points, which have no "
                         "strain but dilation and do not lock; use 'none'.")
    if options.edges == "truncate":
        raise ValueError(f"remedy: got {options.remedy!r} with edges='truncate', where nodes are missing that say how "
                         "much of a domain is in which cell; use edges='ghost'.")


def _initial(start: Any, boundary: Any, free: bool) -> State:
    if not isinstance(start, (Particles, State)):
        raise TypeError(f"start: got {type(start).__name__}, expected Particles, or a State to go on from.")
    if boundary is None and isinstance(start, State):
        return start
    if boundary is None and free:
        boundary = ()
    items = tuple(boundary) if isinstance(boundary, Sequence) else (boundary,)
    for item in items:
        if not (hasattr(item, "advanced") and (hasattr(item, "fixes") or hasattr(item, "rows"))):
            raise TypeError(f"boundary: got {type(item).__name__}, expected FixedPlane and Wall objects in a list.")
    if not items and not free:
        raise ValueError("boundary: got nothing that holds the body; give a FixedPlane or a Wall.")
    if isinstance(start, State):
        return replace(start, boundary=items)
    return State(0, start, items, np.zeros((start.dim, 0)), {})


def _run(mesh: Any, state: State, material: Any, options: Options, steps: int, gravity: Any, max_cuts: int,
         lenient: bool) -> Iterator[State]:
    caution(mesh(state) if callable(mesh) else mesh, state.particles, material, options.strain, options.remedy)
    caution_at_axis(state.particles, options.method)
    start, parts = state, None
    for _ in range(steps):
        good, done, share, cuts, worst = state, 0.0, 1.0, 0, 0.0
        load = _load(gravity, good, options)
        while done < 1:
            here = mesh(state) if callable(mesh) else mesh
            try:
                step = Step(here, state, material, replace(options, lenient=lenient and cuts == max_cuts))
                step.parts.warn_if_apart(parts, step.support, good.step + 1)
                parts = step.parts
                state = step.advance(share, load, good.step + done)
            except Retry as failure:
                share, cuts = share / 2, cuts + 1
                if cuts > max_cuts:
                    raise NotConvergedError(
                        f"step {good.step + 1}: {failure} even after cutting it {max_cuts} times; the last good state "
                        "is in .state. Use smaller steps, or look for what fails there.", good) from None
            except NotConvergedError as failure:
                raise NotConvergedError(f"step {good.step + 1}: {failure}", good) from failure
            except OutsideGridError as failure:
                raise OutsideGridError(f"step {good.step + 1}: {failure}") from failure
            except ValueError as failure:
                if state is start:                      # what was given does not fit
                    raise
                raise NotConvergedError(f"step {good.step + 1}: {failure}", good) from failure
            else:
                done += share
                worst = max(worst, *state.residuals[-1:], 0.0)
        if worst > options.tolerance:
            warnings.warn(f"step {good.step + 1}: taken with a residual of {worst:.1e}, above the tolerance of "
                          f"{options.tolerance:g}; it is not in equilibrium.  Use smaller steps.", UserWarning,
                          stacklevel=2)
        state = replace(state, step=good.step + 1, cuts=cuts)
        yield state


def _load(gravity: Any, good: State, options: Options) -> Callable[[float], Any]:
    """Gravity at any time of a step; in one that is cut a constant one grows in parts, from what acted before."""
    if callable(gravity):
        return gravity
    given = good.gravity is None and good.particles.sigma is not None and good.particles.sigma.any()
    if gravity is None or options.dt or good.control is not None or given:      # stress that is given stands for a load
        return lambda step: gravity
    before = 0.0 if good.gravity is None else np.asarray(good.gravity, dtype=float)

    def load(step: float) -> Any:
        share = step - good.step
        return gravity if share >= 1 else (1 - share) * before + share * np.asarray(gravity, dtype=float)
    return load
