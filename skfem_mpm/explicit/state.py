"""A snapshot of an explicit run, and the choices it was made with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from numpy import ndarray

from ..basis import Method
from ..grid import Edges
from ..particles import Particles

LEDGER = ("start", "peak", "external", "plastic", "damped")


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
        ``damped``; the largest size of the external work so far, ``peak``.
    engine
        What computed it, ``numpy`` or ``numba``.
    order
        ``(n,)``; in which order the engine keeps the points (``None`` for the order they have here).
    kept
        ``(n,)``; which points of the start these are (``None`` for all).
    slope
        ``(dim * dim, n)``; velocity gradient that the points carry with ``tpic``.
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
    load: Callable[[float], ndarray | None]    # body force per mass at a time
    dt: float | None
    safety: float
    refresh: int
    remedy: str
    leaving: str
