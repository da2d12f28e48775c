"""Explicit dynamics in time steps, as a generator of snapshots."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from numbers import Integral
from typing import Any

import numpy as np
from skfem import Mesh

from ..basis import METHODS, Method
from ..checks import check_choice
from ..grid import EDGES, Edges
from ..kinematics import RATES
from ..particles import Particles
from .engine import ENGINES, make_run
from .state import Choices, ExplicitState

__all__ = ["ExplicitState", "explicit_steps"]

INTEGRATORS = ("musl", "usl", "usf")


def explicit_steps(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: Sequence[Any] = (), *,
                   steps: int, every: int = 1, method: str | Method = "mpm", strain: str = "small",
                   integrator: str = "musl", edges: Edges = "ghost", flip: float = 1.0, xpic: int = 0,
                   damping: float = 0.0, gravity: Any = None, ramp: float = 0.0, dt: float | None = None,
                   safety: float = 0.8, refresh: int = 50, engine: str = "auto",
                   threads: int = 1) -> Iterator[ExplicitState]:
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
        Fixed planes, see :mod:`skfem_mpm.boundary`.
    steps, every
        Number of time steps to do, and after how many to yield.
    method
        A name of ``METHODS`` or a ``Method``.
    strain
        ``small`` (increments of the Jaumann rate) or ``logarithmic``.
    integrator
        When stress is updated: ``musl`` (last, from velocities mapped anew), ``usl`` (last), ``usf`` (first).
    edges
        What GIMP does at the edge of the grid: ``ghost``, ``truncate``, ``clip``.
    flip
        Share of FLIP in the velocity update, the rest is PIC.
    xpic
        Order of XPIC, which filters what the grid does not see; 0 is none, 1 is PIC.
    damping
        Local damping: nodal forces lose this share of their size against the velocity.
    gravity
        Body force per mass, ``(dim,)``.
    ramp
        Time over which gravity grows linearly from zero; 0 applies it at once.
    dt
        Time step; found from the highest frequency of the layout, times ``safety``, and refreshed, if not given.
    safety
        Share of the stable step to take.
    refresh
        After how many steps the stable step is found again.
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
        If a point or a domain leaves the grid.
    UnstableError
        If a velocity or a stress is no longer finite, or a point turns inside out; ``.state`` is the last good state.

    Warns
    -----
    UserWarning
        Once, if the method's strain is not conjugate to its forces (elastic waves then grow slowly), or if the given
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
    if not isinstance(method, Method):
        check_choice("method", method, METHODS)
        method = METHODS[method]
    for name, value, names in [("strain", strain, RATES), ("integrator", integrator, INTEGRATORS),
                               ("edges", edges, EDGES), ("engine", engine, ENGINES)]:
        check_choice(name, value, names)
    for name, count, least in [("steps", steps, 1), ("every", every, 1), ("refresh", refresh, 1), ("xpic", xpic, 0),
                               ("threads", threads, 1)]:
        if not (isinstance(count, Integral) and count >= least):
            raise ValueError(f"{name}: got {count}, expected a whole number of at least {least}.")
    for name, number in [("flip", flip), ("damping", damping), ("safety", safety)]:
        if not 0 <= number <= 1:
            raise ValueError(f"{name}: got {number}, expected a share from 0 to 1.")
    if dt is not None and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt: got {dt}, expected a time step above zero, or None to have it found.")
    if not (np.isfinite(ramp) and ramp >= 0):
        raise ValueError(f"ramp: got {ramp}, expected a time of zero or more.")
    choices = Choices(method, strain, integrator, edges, flip, xpic, damping, dt, safety, refresh)
    if method.strain is not method.force:
        warnings.warn("the strain of this method is not conjugate to its forces: elastic waves grow slowly, at any "
                      "time step; 'cmpm-c' and 'gimp' do not.", UserWarning, stacklevel=2)
    return _run(mesh, start, material, tuple(boundary), choices, int(steps), int(every), _load(gravity, ramp),
                engine, int(threads))


def _load(gravity: Any, ramp: float) -> Callable[[float], Any]:
    full = None if gravity is None else np.asarray(gravity, dtype=float)
    if full is None or not ramp:
        return lambda time: full
    return lambda time: full * min(time / ramp, 1.0)


def _run(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: tuple[Any, ...], choices: Choices,
         steps: int, every: int, load: Callable[[float], Any], engine: str, threads: int) -> Iterator[ExplicitState]:
    if isinstance(start, Particles):
        ledger = dict.fromkeys(("plastic", "damped", "external"), 0.0)
        start = ExplicitState(0, 0.0, 0.0, -choices.refresh, start, boundary, ledger)
    run = make_run(engine, threads, mesh, start, material, choices, load)
    for count in range(1, steps + 1):
        run.advance()
        if count % every == 0 or count == steps:
            yield run.snapshot()
