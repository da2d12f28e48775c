"""A snapshot of an explicit run, and the choices it was made with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from numpy import ndarray

from ..basis import Method
from ..checks import check_guards, check_own
from ..grid import Edges
from ..integration import Points
from ..particles import Particles

# What each guard of a run can do, first what it does if nothing is said.
GUARDS = {"step": ("warn", "stop", "off"), "moved": ("stop", "warn", "off"), "energy": ("stop", "warn", "off"),
          "yield": ("stop", "warn", "off")}
LEDGER = ("start", "peak", "most", "external", "plastic", "damped", "removed")



@dataclass(frozen=True, eq=False)
class ExplicitState:
    """A snapshot: everything a run needs to go on, and its energies so far.

    Attributes
    ----------
    step
        Time steps done.
    time
        Time passed.
    dt
        Time step in use; it was found at step ``refreshed``.
    particles
        The points, with velocity, stress and history.
    boundary
        What holds them.
    energy
        ``kinetic`` and ``elastic`` now; their sum at the ``start``; work since then, ``external``, ``plastic`` and
        ``damped``; what points took along that left the mesh, ``removed``; and ``peak``, the most that was ever there
        to become elastic energy and motion about the centre of mass: what was given less what is in the motion of the
        centre of mass (as of the guards' last look; not a number if nothing is known of it); ``most``, the largest
        external work since that look.
    engine
        What computed it, ``numpy`` or ``numba``.
    order
        ``(n,)``; in which order the engine keeps the points (``None`` for the order they have here).
    kept
        ``(n,)``; which points of the start these are (``None`` for all).
    slope
        ``(dim * dim, n)``; velocity gradient that the points carry with ``tpic``.
    rests_on
        Law, planes and choices for which the time step was found; a run that goes on with others finds it anew.
    """

    step: int
    time: float
    dt: float
    refreshed: int
    particles: Particles
    boundary: tuple[Any, ...]
    energy: Mapping[str, float]
    engine: str = "numpy"
    order: ndarray | None = None
    kept: ndarray | None = None
    slope: ndarray | None = None
    rests_on: Any = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "energy", MappingProxyType(dict(self.energy)))
        for name in ("order", "kept", "slope"):
            if (array := getattr(self, name)) is not None:
                check_own(name, array, self.particles.n)
                array.flags.writeable = False

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled, and unpickled arrays are writable unless they go through __post_init__.
        held = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self), tuple({**held, "energy": dict(self.energy)}.values())


@dataclass(frozen=True)
class Choices:
    """The choices of an explicit run, checked; see :func:`skfem_mpm.explicit_steps`."""

    method: Method
    strain: str
    integrator: str
    edges: Edges
    flip: float
    xpic: int
    tpic: bool
    damping: float
    load: Callable[[float], ndarray | None] | None     # body force per mass at a time
    dt: float | None
    safety: float
    refresh: int
    remedy: str
    leaving: str
    domains: str = "fixed"
    radius: str = "point"
    integration: Any = Points()
    guards: Mapping[str, str] = field(default_factory=lambda: check_guards(None, GUARDS))

    @property
    def first(self) -> float:
        """Share of a step's strain that stress follows before the force; the rest comes after."""
        return {"usf": 1.0, "usavg": 0.5}.get(self.integrator, 0.0)


def remaps(integrator: str, tpic: bool) -> bool:
    """Whether strain comes from velocities that were mapped to the points and back, and are smoother for it."""
    return integrator != "usl" and not tpic
