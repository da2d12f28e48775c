"""Explicit dynamics in time steps, as a generator of snapshots."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any

import numpy as np
from skfem import Mesh

from ..basis import Method, find_method
from ..checks import ENGINES, check_array, check_choice
from ..grid import EDGES, Edges
from ..integration import Points, Twin, find_integration
from ..kinematics import DOMAINS, RADII, RATES
from ..particles import Particles
from .engine import make_run
from .run import Run
from .state import LEDGER, Choices, ExplicitState, remaps
from .twin import conjugate

__all__ = ["ExplicitState", "explicit_steps"]

INTEGRATORS = ("musl", "usl", "usf")
REMEDIES = ("none", "bbar")
LEAVING = ("error", "remove")
WHOLE: Any = Integral          # of types that mypy takes for any: it does not know that these can be compared
NUMBER: Any = Real


def explicit_steps(mesh: Mesh, start: Particles | ExplicitState, material: Any,
                   boundary: Sequence[Any] | None = None, *, steps: int, every: int = 1,
                   every_seconds: float | None = None, method: str | Method = "mpm", strain: str = "small",
                   integrator: str = "musl", edges: Edges = "ghost", domains: str | None = None,
                   radius: str = "point", integration: Any = "points", flip: float = 1.0, xpic: int = 0,
                   tpic: bool = False, remedy: str = "none", damping: float = 0.0, gravity: Any = None,
                   ramp: float = 0.0, dt: float | None = None, safety: float = 0.5, refresh: int | None = None,
                   leaving: str = "error", engine: str = "auto", threads: int = 1) -> Iterator[ExplicitState]:
    """Move a body in time; yields an :class:`ExplicitState` every ``every`` steps and after the last one.

    Parameters
    ----------
    mesh
        An axis-aligned line, quad or hex mesh.
    start
        The points (at rest if they have no velocity), or a state to go on from.
    material
        A law such as ``LinearElastic`` or ``VonMises``.
    boundary
        Fixed planes, see :mod:`skfem_mpm.boundary`; those of the state if not given.
    steps, every
        Number of time steps to do, and after how many to yield.
    every_seconds
        Yield whenever another such span of simulated time has passed, instead of ``every`` so many steps.
    method
        A name of ``METHODS`` or a ``Method``.
    strain
        ``small`` (increments of the Jaumann rate) or ``logarithmic``.
    integrator
        When stress is updated: ``musl`` (last, from velocities mapped anew), ``usl`` (last), ``usf`` (first).
    edges
        What GIMP does at the edge of the grid: ``ghost``, ``truncate``, ``clip``.
    domains
        Boxes that GIMP averages over: ``fixed`` (edges stay as they are) or ``stretched`` (they follow the stretch
        along the axes and the points' volume; one that outgrows the neighbours of its cell is seen cut off there).
        If not given, ``stretched`` with the twin, for which they say what cells at the surface hold, else ``fixed``.
    radius
        In axial symmetry, what GIMP takes as the radius: that of the ``point``, or the one under the integral over its
        ``domain``.
    integration
        How stress becomes force: ``points`` (they are the quadrature), or ``twin``, ``twin2`` or a ``Twin`` (stress is
        a field fitted to the points and integrated over cells, strain the conjugate one; the method then only maps).
    flip
        Share of FLIP in the velocity update, the rest is PIC.
    xpic
        Order of XPIC, which filters what the grid does not see; 0 is none, 1 is PIC.
    tpic
        Points hand their velocity gradient on to the nodes too (TPIC, after Taylor); with ``flip=0`` it conserves
        what plain PIC smears.
    remedy
        Against volumetric locking: ``none``, or ``bbar``, dilation and mean stress as means over cells.
    damping
        Local damping: nodal forces lose this share of their size against the velocity.
    gravity
        Body force per mass, ``(dim,)``.
    ramp
        Time over which gravity grows linearly from zero; 0 applies it at once.
    dt
        Time step; found from the highest frequency of the layout, times ``safety``, and refreshed, if not given.
    safety
        Share of the stable step to take, above 0 and at most 1.  Errors of energy fall with it.
    refresh
        After how many steps the stable step is found again; 50 if not given, but 1 with ``usl`` or ``tpic``, whose
        stable step collapses for a while when a point enters an empty cell.
    leaving
        What to do when a point leaves the mesh: ``error``, or ``remove`` it and go on.
    engine
        ``numpy``, ``numba`` (compiled, needs the extra ``fast``), or ``auto``: numba if there are points enough for it
        to pay and it is installed.  A state says which one made it, and a run that goes on keeps it.
    threads
        Threads of the numba engine; results do not depend on it.

    Raises
    ------
    ValueError, TypeError
        If an argument is unknown or does not fit.
    OutsideGridError
        If a point or a domain leaves the grid, and ``leaving`` is ``error``.
    UnstableError
        If a velocity or a stress is no longer finite, a point turns inside out or moves further than a cell in one
        step, or the body has ten times the energy it was given; ``.state`` is the last one that was yielded.

    Warns
    -----
    UserWarning
        Once, if the method's strain is not conjugate to its forces (elastic waves then grow), or if the given
        time step is above the stable one.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, uniaxial
    >>> from skfem_mpm.boundary import FixedPlane
    >>> bar = Particles.fill(MeshLine(np.linspace(0, 1, 11)), uniaxial, density=1.0)
    >>> base = [FixedPlane(axis=0, at=0.0, side=-1)]
    >>> run = explicit_steps(MeshLine(np.linspace(0, 2, 21)), bar, LinearElastic(E=1e2, nu=0.0), base, steps=20,
    ...                      every=20, gravity=(-1.0,))
    >>> bool(abs(next(run).particles.velocity).max() < 1.0)
    True
    """
    method, integration = _integration(find_method(method), integration)
    domains = domains or ("stretched" if integration.covers else "fixed")
    for name, value, names in [("strain", strain, RATES), ("integrator", integrator, INTEGRATORS),
                               ("edges", edges, EDGES), ("domains", domains, DOMAINS), ("radius", radius, RADII),
                               ("remedy", remedy, REMEDIES), ("leaving", leaving, LEAVING),
                               ("engine", engine, ENGINES)]:
        check_choice(name, value, names)
    refresh = refresh if refresh is not None else 50 if remaps(integrator, tpic) else 1
    _check_numbers({"steps": (steps, 1), "every": (every, 1), "refresh": (refresh, 1), "xpic": (xpic, 0),
                    "threads": (threads, 1)}, {"flip": flip, "damping": damping, "safety": safety},
                   {"dt": dt, "every_seconds": every_seconds})
    if not isinstance(tpic, (bool, np.bool_)):
        raise TypeError(f"tpic: got {tpic!r}, expected True or False.")
    if not isinstance(start, (Particles, ExplicitState)):
        raise TypeError(f"start: got a {type(start).__name__}, expected Particles or a state of an explicit run; of an "
                        "implicit state give its particles.")
    if not isinstance(boundary, (list, tuple, type(None))):
        raise TypeError(f"boundary: got a {type(boundary).__name__}, expected a list of fixed planes.")
    if remedy == "bbar" and edges == "truncate":
        raise ValueError("remedy: got 'bbar' with edges='truncate', where nodes are missing that say how much of a "
                         "domain is in which cell; use edges='ghost' or 'clip'.")
    load = _load(gravity, ramp, start.particles.dim if isinstance(start, ExplicitState) else start.dim)
    if not method.conjugate:
        warnings.warn("the strain of this method is not conjugate to its forces: elastic waves grow, at any time step; "
                      "with 'cmpm-c' and 'gimp' they do not.", UserWarning, stacklevel=2)
    choices = Choices(method, strain, integrator, edges, flip, xpic, bool(tpic), damping, load, dt, safety,
                      int(refresh), remedy, leaving, domains, radius, integration)
    run = make_run(engine, int(threads), mesh, _start(start, boundary, int(refresh)), material, choices)
    return _yield(run, int(steps), int(every), every_seconds)


def _integration(method: Method, integration: Any) -> tuple[Method, Any]:
    """How stress becomes force, and the method whose bases a step then reads."""
    found = find_integration(integration)
    if type(found) not in (Points, Twin):
        raise ValueError(f"integration: got {integration!r}, which is for implicit steps; expected 'points', 'twin', "
                         "'twin2', 'dual' or a Twin, whose strain is conjugate to their forces.")
    if method.motion is not None:
        raise ValueError(f"method: got one that moves points by {method.motion.__name__}, which is for implicit steps; "
                         "expected motion=None, the functions that map mass.")
    return (conjugate(method) if found.covers else method), found


def _check_numbers(counts: dict[str, tuple[Any, int]], shares: dict[str, Any], spans: dict[str, Any]) -> None:
    """Refuse whole numbers that are too small, shares beyond 0 and 1, and spans of time that are none."""
    for name, (count, least) in counts.items():
        if not (isinstance(count, WHOLE) and count >= least):
            raise ValueError(f"{name}: got {count}, expected a whole number of at least {least}.")
    for name, number in shares.items():
        above = ", above 0" * (name == "safety")
        if not (isinstance(number, NUMBER) and 0 <= number <= 1 and (number > 0 or not above)):
            raise ValueError(f"{name}: got {number!r}, expected a share from 0 to 1{above}.")
    for name, span in spans.items():
        if span is not None and not (isinstance(span, NUMBER) and np.isfinite(span) and span > 0):
            raise ValueError(f"{name}: got {span!r}, expected a time span above zero, or None.")


def _load(gravity: Any, ramp: float, dim: int) -> Callable[[float], Any]:
    """Body force per mass over time."""
    if not (isinstance(ramp, NUMBER) and np.isfinite(ramp) and ramp >= 0):
        raise ValueError(f"ramp: got {ramp!r}, expected a time of zero or more.")
    if gravity is None:
        return lambda time: None
    try:
        numbers = np.asarray(gravity, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"gravity: got {gravity!r}, expected {dim} number(s), the body force per mass.") from None
    full = check_array("gravity", numbers, (dim,))
    if not ramp:
        return lambda time: full
    return lambda time: full * min(time / ramp, 1.0)


def _start(start: Particles | ExplicitState, boundary: Sequence[Any] | None, refresh: int) -> ExplicitState:
    """The state to start from; its time step is found at once."""
    if isinstance(start, Particles):
        return ExplicitState(0, 0.0, 0.0, -refresh, start, tuple(boundary or ()), dict.fromkeys(LEDGER, 0.0))
    return start if boundary is None else replace(start, boundary=tuple(boundary))


def _yield(run: Run, steps: int, every: int, seconds: float | None) -> Iterator[ExplicitState]:
    for count in range(1, steps + 1):
        before = run.time
        run.advance()
        due = count % every == 0 if seconds is None else run.time // seconds > before // seconds
        if due or count == steps:
            yield run.snapshot()
