"""Energies and momenta of a run over its states, and how many points changed cell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..explicit import ExplicitState
from ..grid import Grid

BOOKED = ("kinetic", "elastic", "external", "plastic", "damped", "removed")


@dataclass(frozen=True)
class Crossings:
    """How many points changed cell between two states.

    Attributes
    ----------
    number
        Points that are in another cell than before.
    share
        Share of all points that changed cell, per step.
    """

    number: int
    share: float


def crossings(before: ExplicitState, after: ExplicitState, mesh: Mesh) -> Crossings:
    """How many points changed cell between two states of a run.

    Points that left the mesh between them are left out.  A point that came back is not seen, so take states that
    are few steps apart.

    Raises
    ------
    ValueError
        If the second state is not a later one, or has points that the first has not.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import replace
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, explicit_steps, uniaxial
    >>> from skfem_mpm.stability import crossings
    >>> bar, mesh = Particles.fill(MeshLine(np.arange(3.0)), uniaxial), MeshLine(np.arange(-2.0, 9))
    >>> bar = replace(bar, velocity=np.ones((1, 4)))
    >>> first, last = explicit_steps(mesh, bar, LinearElastic(E=1.0, nu=0.0), steps=10, every=5, dt=0.1)
    >>> crossings(first, last, mesh)
    Crossings(number=2, share=0.1)
    """
    steps = after.step - before.step
    if steps < 1:
        raise ValueError(f"after: got step {after.step}, expected one after step {before.step} of the first state; "
                         "give the earlier state first.")
    grid, numbers = Grid.from_mesh(mesh), [_numbers(state) for state in (before, after)]
    if not np.isin(numbers[1], numbers[0]).all():
        raise ValueError("after: got points that the state before does not have; give two states of one run.")
    kept = np.isin(numbers[0], numbers[1])
    cells = grid.locate(before.particles.x[:, kept]), grid.locate(after.particles.x)
    number = int((cells[0] != cells[1]).any(axis=0).sum())
    return Crossings(number, number / after.particles.n / steps)


def _numbers(state: ExplicitState) -> ndarray:
    """What the points are called: their numbers at the start."""
    return np.arange(state.particles.n) if state.kept is None else state.kept


@dataclass(frozen=True, eq=False)
class Ledger:
    """Energies and momenta over the states of a run; every array has one entry for each state.

    Attributes
    ----------
    step, time
        When.
    kinetic, elastic
        Energy of the points; ``elastic`` is not a number if the law does not say.
    external, plastic, damped, removed
        Work since the start, as in the energies of an explicit state; not a number for implicit ones.
    balance
        Energy that nothing accounts for since the first state: kinetic and elastic energy with what was lost, less the
        work of gravity.
    linear
        ``(dim, states)``; momentum.
    angular
        ``(states,)`` in the plane, ``(3, states)`` in space, about the origin; ``None`` in one dimension and in rings.
    """

    step: ndarray
    time: ndarray
    kinetic: ndarray
    elastic: ndarray
    external: ndarray
    plastic: ndarray
    damped: ndarray
    removed: ndarray
    balance: ndarray
    linear: ndarray
    angular: ndarray | None


def ledger(states: Iterable[Any]) -> Ledger:
    """Energies and momenta of a run over its states.

    Parameters
    ----------
    states
        Those of an explicit run, in their order, or of implicit dynamics, whose work is not known.

    Raises
    ------
    ValueError
        If there is no state.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, explicit_steps, uniaxial
    >>> from skfem_mpm.stability import ledger
    >>> bar, mesh = Particles.fill(MeshLine(np.arange(3.0)), uniaxial), MeshLine(np.arange(-9.0, 9))
    >>> book = ledger(explicit_steps(mesh, bar, LinearElastic(E=1.0, nu=0.0), steps=10, gravity=(-1.0,), dt=0.1))
    >>> print(book.linear[0, -1].round(12), abs(book.balance).max() < 1e-12)
    -2.0 True
    """
    found = [(state.step, state.time, state.energy, *_momenta(state.particles)) for state in states]
    if not found:
        raise ValueError("states: got none, expected those of one run; call ledger(explicit_steps(...)).")
    step, time, energies, linear, angular = zip(*found)
    books = {name: np.array([float(energy.get(name, np.nan)) for energy in energies]) for name in BOOKED}
    out = books["plastic"] + books["damped"] + books["removed"]
    gained = books["kinetic"] + books["elastic"] + out - books["external"]
    return Ledger(np.array(step), np.array(time), **books, balance=gained - gained[0], linear=np.stack(linear, axis=1),
                  angular=None if angular[0] is None else np.stack(angular, axis=-1))


def _momenta(points: Any) -> tuple[ndarray, Any]:
    """Linear and angular momentum."""
    velocity = np.zeros_like(points.x) if points.velocity is None else points.velocity
    carried = points.mass * velocity
    if points.dim == 1 or points.kinematics.hoop:
        return carried.sum(axis=1), None
    if points.dim == 2:
        return carried.sum(axis=1), (points.x[0] * carried[1] - points.x[1] * carried[0]).sum()
    return carried.sum(axis=1), np.cross(points.x, carried, axis=0).sum(axis=1)
