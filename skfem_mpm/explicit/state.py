"""A snapshot of an explicit run, and the choices it was made with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy import ndarray

from ..basis import Method
from ..grid import Edges
from ..particles import Particles


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
    energy
        Work and energies since the start: ``kinetic``, ``elastic`` (now), ``plastic``, ``damped``, ``external``.
    engine
        What computed it, ``numpy`` or ``numba``.
    order
        ``(n,)``; in which order the engine keeps the points (``None`` for the order they have here).
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


@dataclass(frozen=True)
class Choices:
    """The choices of an explicit run, checked."""

    method: Method
    strain: str
    integrator: str
    edges: Edges
    flip: float
    xpic: int
    damping: float
    dt: float | None
    safety: float
    refresh: int
