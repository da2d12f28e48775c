r"""An elastic bar that vibrates: held at one end, or free and in flight across the grid; with a closed form.

Along the bar :math:`\rho_0 \ddot u = \partial P / \partial X`.  In one dimension nominal and Cauchy stress are the
same, :math:`P = E \ln(1 + u')` of the law here and :math:`E u'` for small amplitudes, whose waves have the speed
:math:`c = \sqrt{E / \rho}` and stand if the stress of their shape vanishes at free ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import ElementLineP1, ElementVector, Mesh, MeshLine

from ..boundary import FixedPlane
from ..checks import check_choice, check_counts, check_positive
from ..explicit import ExplicitState, explicit_steps
from ..implicit import State, implicit_steps
from ..kinematics import uniaxial
from ..materials import LinearElastic
from ..particles import Particles
from .errors import normal_stress

ENDS = ("free", "fixed")
SOLVERS = ("explicit", "implicit")
SNAPSHOTS = 32          # states in a period, if nothing else is said
IMPLICIT = 64           # steps of the implicit solver in a period, if nothing else is said
SPARE = 2               # cells of the grid beyond wherever the bar gets


@dataclass(frozen=True, eq=False)
class Bar:
    r"""The scene as plain data; make it with :func:`bar`.

    Attributes
    ----------
    mesh, elem, particles, material, boundary
        What the solvers take.
    ends
        ``free``, or ``fixed`` at the first one.
    wave_number, wave_speed
        :math:`b` of the mode, and :math:`c = \sqrt{E / \rho}`.
    speed, drift
        Amplitude of the vibration's velocity, and the constant velocity of the bar as a whole.
    period
        Of the mode, :math:`2 \pi / (b c)`.
    end
        Time at which a run ends.
    """

    mesh: Mesh
    elem: Any
    particles: Particles
    material: LinearElastic
    boundary: tuple[FixedPlane, ...]
    ends: str
    wave_number: float
    wave_speed: float
    speed: float
    drift: float
    period: float
    end: float

    def run(self, method: str = "mpm", steps: int | None = None, start: Any = None, solver: str = "explicit",
            **choices: Any) -> Iterator[Any]:
        """Yield states until the scene's :attr:`end`, or of ``steps`` time steps, whatever time these take.

        Calls :func:`skfem_mpm.explicit_steps` with this scene and ``choices``.  Whatever these are, a run without
        ``steps`` covers the same span of time: it ends with the first state that is yielded at the end or after it.
        If neither ``every`` nor ``every_seconds`` is given, states are yielded at (the steps next after) equal
        distances of time, 32 in a period.  With ``solver="implicit"`` :func:`skfem_mpm.implicit_steps` does it, at
        small strain, in equal steps of ``dt`` or a little less; in 64 of them a period if none is given.
        """
        check_choice("solver", solver, SOLVERS)
        if solver == "implicit":
            return self._implicit(method, steps, start, choices)
        if not {"every", "every_seconds"} & set(choices):
            choices["every_seconds"] = self.end / np.ceil(SNAPSHOTS * self.end / self.period - 1e-9)
        run = explicit_steps(self.mesh, start or self.particles, self.material, self.boundary, method=method,
                             steps=10 ** 9 if steps is None else steps, **choices)
        return run if steps is not None else self._to_the_end(run, getattr(start, "time", 0.0))

    def _implicit(self, method: str, steps: int | None, start: Any, choices: dict[str, Any]) -> Iterator[State]:
        longest = choices.pop("dt", None) or self.period / IMPLICIT
        left = self.end - getattr(start, "time", 0.0)
        count = int(np.ceil(left / longest - 1e-9))
        return implicit_steps(self.mesh, start or self.particles, self.material,
                              None if isinstance(start, State) else self.boundary, method=method, dt=left / count,
                              steps=count if steps is None else steps, **{"strain": "small", **choices})

    def _to_the_end(self, run: Iterator[ExplicitState], time: float) -> Iterator[ExplicitState]:
        end = self.end * (1 - 1e-9)                     # sums of time steps are rounded
        while time < end:
            state = next(run)
            time = state.time
            yield state

    def exact(self, time: float) -> tuple[ndarray, ndarray, ndarray]:
        """Where the points are at a time, ``(1, n)``, their velocity, ``(1, n)``, and their stress, ``(3, 3, n)``."""
        X, b, c = self.particles.x, self.wave_number, self.wave_speed
        shape, slope = (np.cos(b * X), -np.sin(b * X)) if self.ends == "free" else (np.sin(b * X), np.cos(b * X))
        x = X + self.drift * time + self.amplitude * shape * np.sin(b * c * time)
        velocity = self.drift + self.speed * shape * np.cos(b * c * time)
        return x, velocity, normal_stress(self._scale * slope[0] * np.sin(b * c * time), [[1.0]])

    @property
    def amplitude(self) -> float:
        """Amplitude of the displacement, :math:`v_0 / (b c)`."""
        return self.speed / (self.wave_number * self.wave_speed)

    @property
    def _scale(self) -> float:
        """Amplitude of the stress."""
        return self.material.E * self.speed / self.wave_speed

    def errors(self, state: ExplicitState) -> dict[str, float]:
        """Errors of one state against the closed form.

        Returns
        -------
        dict
            ``velocity``, ``stress`` and ``position``: rms errors over the points, relative to the amplitudes of
            velocity, stress and displacement.

        Raises
        ------
        ValueError
            If the points carry no velocity or stress, or are not those of the scene.
        """
        points = state.particles
        if points.velocity is None or points.sigma is None:
            raise ValueError("state: got one without velocity or stress; take a state that run() has yielded.")
        if points.n != self.particles.n:
            raise ValueError(f"state: got {points.n} points, expected the {self.particles.n} of this scene.")
        x, velocity, stress = self.exact(state.time)
        return {"velocity": _rms(points.velocity - velocity) / self.speed,
                "stress": _rms((points.stress - stress)[0, 0]) / self._scale,
                "position": _rms(points.x - x) / self.amplitude}

    def energy(self, state: ExplicitState) -> float:
        """Mechanical energy of the vibration: elastic, and kinetic as seen from the moving bar."""
        return self._kinetic(state.particles) + state.energy["elastic"]

    def _kinetic(self, particles: Any) -> float:
        return float(particles.mass @ (particles.velocity[0] - self.drift) ** 2 / 2)

    def measure(self, states: Iterable[ExplicitState]) -> dict[str, float]:
        """Errors of a run; ``velocity`` is what a user sees, ``stress`` what tells methods apart.

        A state has the velocity of half a step before its time (half a step after it with ``usf``, of its time with
        ``usavg``), and so has ``energy`` its kinetic part: both fall with the time step to first order, however fine
        the grid.  ``stress`` and (but with ``usf``) ``position`` are of the state's time; they say more of the grid.

        Parameters
        ----------
        states
            Of one run, at equal distances of time.

        Returns
        -------
        dict
            ``velocity``, ``stress`` and ``position``: rms over points and states of the errors of :meth:`errors`;
            ``energy``: the largest change of the energy of the vibration, relative to the energy at the start.

        Raises
        ------
        ValueError
            If there are no states.

        Examples
        --------
        >>> scene = bar(cells=16, drift=0.0)
        >>> found = scene.measure(scene.run("gimp"))
        >>> list(found), found["velocity"] < 0.05
        (['velocity', 'stress', 'position', 'energy'], True)
        """
        found = [(self.errors(state), self.energy(state)) for state in states]
        if not found:
            raise ValueError("states: got none, expected those of a run; one that has come to its end yields no more.")
        energies, before = np.array([energy for _, energy in found]), self._kinetic(self.particles)
        errors = {name: _rms(np.array([errors[name] for errors, _ in found])) for name in found[0][0]}
        return {**errors, "energy": float(np.abs(energies / before - 1).max())}


def bar(cells: int = 16, *, per_cell: int = 2, mode: int = 1, ends: str = "free", speed: float = 1e-4,
        drift: float | None = None, periods: float = 1.0, length: float = 25.0, E: float = 100.0,
        density: float = 1.0) -> Bar:
    r"""An elastic bar that vibrates in one mode; any consistent units.

    With ``ends="free"`` it flies across the grid meanwhile, so that points cross cells:

    .. math:: v = v_d + v_0 \cos(b X) \cos(b c t), \qquad b = n \pi / L .

    With ``ends="fixed"`` it is held at :math:`X = 0`, the problem of the tutorials of Marble.jl (``speed=0.1`` there):

    .. math:: v = v_0 \sin(b X) \cos(b c t), \qquad b = (2 n - 1) \pi / (2 L) .

    The closed form is that of small amplitudes.  In the first mode its own error is :math:`0.16 v_0 / c` in velocity
    and :math:`0.20 v_0 / c` in stress (rms, relative to amplitudes; against a fine solution with :math:`P = E
    \ln(1 + u')`), over one period as over four; in the third mode it is up to :math:`0.5 v_0 / c`.  With the default
    ``speed`` that is 2e-6.

    Parameters
    ----------
    cells
        Along the bar.
    per_cell
        Points in a cell.
    mode
        Number :math:`n` of the mode, from 1.
    ends
        ``free``, or ``fixed`` (the first one is).
    speed
        Amplitude :math:`v_0` of the vibration's velocity.
    drift
        Constant velocity :math:`v_d` of a free bar.  If not given, :math:`c / 8`: in a period of the first mode the bar
        flies over a quarter of its length, 4 of 16 cells.
    periods
        How many of the mode a run lasts.
    length, E, density
        Of the bar.

    Raises
    ------
    ValueError, TypeError
        If numbers do not fit, or a bar that is fixed is to drift.

    Examples
    --------
    >>> scene = bar()
    >>> scene.drift * scene.end / (25 / 16)
    4.0
    >>> *_, state = scene.run("gimp")
    >>> scene.errors(state)["stress"] < 0.05
    True
    """
    _check(ends, {"cells": cells, "mode": mode},
           {"speed": speed, "periods": periods, "length": length, "E": E, "density": density})
    c, h = float(np.sqrt(E / density)), length / cells
    if speed >= c:
        raise ValueError(f"speed: got {speed}, expected less than the wave speed {c:g}, far less for small amplitudes.")
    drift = _drift(drift, ends, c)
    b = (mode if ends == "free" else mode - 0.5) * np.pi / length
    period = 2 * np.pi / (b * c)
    room, flight = SPARE + int(np.ceil(speed / (b * c * h))), drift * periods * period / h
    first, last = (int(np.floor(min(flight, 0.0) + 1e-9)) - room, int(np.ceil(max(flight, 0.0) - 1e-9)) + room)
    lines = h * np.arange(first, cells + last + 1)
    body = Particles.fill(MeshLine(lines[-first:cells + 1 - first]), uniaxial, density=density, per_cell=per_cell)
    shape = np.cos(b * body.x) if ends == "free" else np.sin(b * body.x)
    return Bar(mesh=MeshLine(lines), elem=ElementVector(ElementLineP1()),
               particles=replace(body, velocity=drift + speed * shape), material=LinearElastic(E=E, nu=0.0),
               boundary=(FixedPlane(0, 0.0, -1, name="end"),) if ends == "fixed" else (), ends=ends, wave_number=b,
               wave_speed=c, speed=speed, drift=drift, period=period, end=periods * period)


def _check(ends: str, counts: dict[str, Any], sizes: dict[str, Any]) -> None:
    """Refuse what makes no scene."""
    check_choice("ends", ends, ENDS)
    check_counts({name: (count, 1) for name, count in counts.items()})
    for name, size in sizes.items():
        check_positive(name, size)


def _drift(drift: float | None, ends: str, wave_speed: float) -> float:
    """The velocity of the bar as a whole."""
    if drift is None:
        return wave_speed / 8 if ends == "free" else 0.0
    if not np.isfinite(drift):
        raise ValueError(f"drift: got {drift}, expected a velocity.")
    if drift and ends == "fixed":
        raise ValueError(f"drift: got {drift} with ends='fixed', which holds the bar where it is; expected 0, or "
                         "ends='free'.")
    return float(drift)


def _rms(values: ndarray) -> float:
    return float(np.sqrt((values ** 2).mean()))
