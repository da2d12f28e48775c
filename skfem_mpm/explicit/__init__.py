"""Explicit dynamics in time steps, as a generator of snapshots."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from skfem import Mesh

from ..basis import Method
from ..cautions import caution
from ..checks import check_counts, check_spans, warn_of_relaxed
from ..grid import Edges
from ..particles import Particles
from .prepare import prepare
from .run import Run
from .state import ExplicitState

__all__ = ["ExplicitState", "explicit_steps", "run_before_its_start"]


def explicit_steps(mesh: Mesh, start: Particles | ExplicitState, material: Any,
                   boundary: Sequence[Any] | None = None, *, steps: int, every: int = 1,
                   every_seconds: float | None = None, method: str | Method = "mpm", strain: str = "small",
                   integrator: str = "musl", edges: Edges = "ghost", domains: str | None = None,
                   radius: str = "point", integration: Any = "points", flip: float = 1.0, xpic: int = 0,
                   tpic: bool = False, remedy: str = "none", damping: float = 0.0, gravity: Any = None,
                   ramp: float = 0.0, dt: float | None = None, safety: float = 0.5, refresh: int | None = None,
                   leaving: str = "error", engine: str = "auto", threads: int = 1,
                   guards: Mapping[str, str] | None = None) -> Iterator[ExplicitState]:
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
        When stress is updated: ``musl`` (last, from velocities mapped anew), ``usl`` (last), ``usf`` (first), or
        ``usavg`` (half first, half last, both from velocities mapped anew): symmetric in time, so that velocity and
        stress are of one time, and energy stays where points cross cells; a step takes longer by the second update.
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
        what plain PIC smears.  With a share of FLIP waves may grow at any step, by up to 0.6 % a step in random clouds.
        The gradient is that of the affine field nearest to what a point sees of the nodes, with the weights
        :math:`N_I` (those of its functions' slopes, if they are linear).
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
        Share of the stable step of FLIP to take, above 0 and at most 1 (a share of PIC, or XPIC, bear up to 1.4 times
        less, and never get more).  Errors of energy fall with it.
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
    guards
        What to do where a limit is passed, by name: ``stop``, ``warn`` (once) or ``off``.  They are ``step`` (a given
        ``dt`` above the step that is surely stable; it warns if nothing is said, the others stop), ``moved`` (a point
        moves further than a cell in one step), ``energy`` (elastic energy and motion about the centre of mass exceed
        tenfold what was there for them; twice as much warns) and ``yield`` (stress beyond the yield surface of a law
        that offers ``excess``, by more than 1e-6 of its strength).  Not all may be off.

    Raises
    ------
    ValueError, TypeError
        If an argument is unknown or does not fit.
    OutsideGridError
        If a point or a domain leaves the grid, and ``leaving`` is ``error``.
    UnstableError
        If a number is no longer finite, a point turns inside out, or one of the ``guards`` stops the run; the message
        names step, point, value, limit and the likely cure, ``.state`` is the last one that was yielded.

    Warns
    -----
    UserWarning
        Once each, if the method's strain is not conjugate to its forces (elastic waves then grow), ``tpic`` goes with a
        share of FLIP (they may), the given time step is above the stable one, the body has twice the energy that was
        there for it, a guard is off, the law is nearly incompressible and there is no remedy, points of a cell differ
        far in stiffness, stay in tension where strain lags behind them, or the body comes apart, be it only because its
        points are too far from each other.

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
    check_counts({"steps": (steps, 1), "every": (every, 1)})
    check_spans({"every_seconds": every_seconds})
    run = prepare(mesh, start, material, boundary, method=method, strain=strain, integrator=integrator, edges=edges,
                  domains=domains, radius=radius, integration=integration, flip=flip, xpic=xpic, tpic=tpic,
                  remedy=remedy, damping=damping, gravity=gravity, ramp=ramp, dt=dt, safety=safety, refresh=refresh,
                  leaving=leaving, engine=engine, threads=threads, guards=guards)
    warn_of_relaxed(run.choices.guards)
    caution(mesh, run.last.particles, material, strain, remedy)
    if not run.choices.method.conjugate:
        warnings.warn("the strain of this method is not conjugate to its forces: elastic waves grow, at any time step; "
                      "with 'cmpm-c' and 'gimp' they do not.", UserWarning, stacklevel=2)
    if tpic and flip:
        warnings.warn(f"flip: got {flip} with tpic=True: points that keep a share of their velocity and hand on "
                      "gradients too may let waves grow, at any time step; take flip=0, with which they do not.",
                      UserWarning, stacklevel=2)
    return _yield(run, int(steps), int(every), every_seconds)


def run_before_its_start(mesh: Mesh, start: Particles | ExplicitState, material: Any,
                         boundary: Sequence[Any] | None = None, **choices: Any) -> Run:
    """The run that :func:`explicit_steps` would begin with these choices, in numpy.

    Raises
    ------
    TypeError
        If a choice has a name that :func:`explicit_steps` does not know, or that is not one of the motion.
    """
    known = {name: each.default for name, each in inspect.signature(explicit_steps).parameters.items()
             if each.kind is each.KEYWORD_ONLY and name not in ("steps", "every", "every_seconds")}
    for name in choices:
        if name not in known:
            raise TypeError(f"{name}: not a choice of explicit_steps that changes a step; expected some of "
                            f"{', '.join(known)}.")
    return prepare(mesh, start, material, boundary, **{**known, **choices, "engine": "numpy", "threads": 1})


def _yield(run: Run, steps: int, every: int, seconds: float | None) -> Iterator[ExplicitState]:
    for count in range(1, steps + 1):
        before = run.time
        run.advance()
        due = count % every == 0 if seconds is None else run.time // seconds > before // seconds
        if due or count == steps:
            yield run.snapshot()
