"""The vertical cut in softening soil of section 4 of Gonzalez Acosta, Vardon and Hicks (2017)."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import ElementHex1, ElementQuad1, ElementVector, Mesh, MeshHex, MeshQuad

from ..boundary import FixedPlane
from ..checks import check_choice, check_positive
from ..explicit import ExplicitState, explicit_steps
from ..implicit import implicit_steps
from ..kinematics import plane_strain, solid
from ..materials import LinearElastic, VonMises
from ..particles import Particles
from .roughness import roughness
from .vertical_cut_reference import FAILED, CutHistory, Moment, cut_reference

UNTIL = {"sudden": 0.3, "ramped": 0.8}      # onset, failure, and the toe some 40 cm out [s]
APART = 0.01                                # time between states of a run over the whole span [s]


@dataclass(frozen=True, eq=False)
class VerticalCut:
    """The scene as plain data; make it with :func:`vertical_cut`.

    Attributes
    ----------
    mesh, elem, particles, material, boundary
        What :func:`skfem_mpm.explicit_steps` takes.
    gravity, ramp
        Body force per mass, and the time over which it grows from zero.
    weight
        Unit weight times height, the scale of stress.
    toe
        Index of the point nearest to the toe.
    until
        Time that a run spans.
    """

    mesh: Mesh
    elem: Any
    particles: Particles
    material: Any
    boundary: tuple[FixedPlane, ...]
    gravity: tuple[float, ...]
    ramp: float
    weight: float
    toe: int
    until: float

    def run(self, method: str = "mpm", steps: int | None = None, start: ExplicitState | None = None,
            material: Any = None, **choices: Any) -> Iterator[ExplicitState]:
        """Yield states of ``steps`` time steps, or if not given, of as many as reach the time ``until``.

        Calls :func:`skfem_mpm.explicit_steps` with this scene and ``choices``.  A run up to ``until`` is the same
        physical work whatever the cells; it yields states every hundredth of a second unless ``every`` or
        ``every_seconds`` says otherwise, and ends with the first state at or beyond that time.  Another ``material``
        shows what the scene would do without softening, say, or without yielding at all.
        """
        if steps is None and not {"every", "every_seconds"} & set(choices):
            choices["every_seconds"] = APART
        states = explicit_steps(self.mesh, start or self.particles, material or self.material, self.boundary,
                                method=method, steps=sys.maxsize if steps is None else steps,
                                **{"gravity": self.gravity, "ramp": self.ramp, **choices})
        return states if steps is not None else _up_to(self.until, states)

    def measure(self, states: Iterable[ExplicitState]) -> dict[str, float]:
        """Errors of a run against the stored reference, and two numbers that need none; smaller is better.

        Parameters
        ----------
        states
            Those of one run from rest to ``until``; between them values are read off straight lines.

        Returns
        -------
        dict
            ``toe``: rms over time of the error of the toe's displacement, relative to the final displacement;
            ``run_out`` and ``dissipation`` (plastic) at the end, and ``failure_time``, when the toe has moved 10 cm:
            relative errors; a cut that still stands at the end is taken to fail then, which is the least that the
            error can be.  ``roughness``: that of the first state with the toe beyond 10 cm, the paper's instant, or
            of the last one if there is none.  ``balance``: size of the energy balance of the last state.

            The first four are not a number if the run ended before ``until``, or if the cut is not that of the
            reference: :func:`vertical_cut` with other numbers than its own (cells, points and room may differ).
            The reference has errors of its own, ``cut_reference(loading).uncertainty()``; runs whose errors are smaller
            than those cannot be told apart by it.

        Raises
        ------
        ValueError
            If there is no state.

        Examples
        --------
        >>> scene = vertical_cut(h=0.25)
        >>> errors = scene.measure(scene.run("gimp"))
        >>> print(0.1 < errors["toe"] < 0.3, errors["balance"] < 0.1)
        True True
        """
        moments, rough, state = [], None, None
        for state in states:
            moments.append(self._moment(state))
            if rough is None and moments[-1].toe >= FAILED:
                rough = self.roughness(state)
        if state is None:
            raise ValueError("states: got none, expected those of a run; call measure(scene.run(...)).")
        return {**self._errors(CutHistory.of(moments)), "roughness": self.roughness(state) if rough is None else rough,
                "balance": abs(self.energy_balance(state))}

    def history(self, states: Iterable[ExplicitState]) -> CutHistory:
        """Displacement of toe and foremost point, and plastic dissipation, over the time of a run from rest."""
        return CutHistory.of(map(self._moment, states))

    def _moment(self, state: ExplicitState) -> Moment:
        return Moment(state.time, self.toe_displacement(state), self.run_out(state), state.energy["plastic"])

    def _errors(self, history: CutHistory) -> dict[str, float]:
        """Against the reference of this loading; not a number if it is that of another cut."""
        loading = "ramped" if self.ramp else "sudden"
        errors = cut_reference(loading).errors(history)
        return errors if _same_cut(self, vertical_cut(1.0, loading=loading)) else dict.fromkeys(errors, np.nan)

    def toe_displacement(self, state: ExplicitState) -> float:
        """How far the toe has moved outwards; not a number if it has left the grid (``leaving="remove"``)."""
        place = [self.toe] if state.kept is None else np.flatnonzero(state.kept == self.toe)
        return float(state.particles.x[0, place[0]] - self.particles.x[0, self.toe]) if len(place) else np.nan

    def run_out(self, state: ExplicitState) -> float:
        """How far the foremost point is beyond the initial face."""
        return float(state.particles.x[0].max() - self.particles.x[0].max())

    def roughness(self, state: ExplicitState) -> float:
        """Oscillation of the horizontal stress.

        The rms of what is left of it after taking off its least-squares plane over the 16 nearest points, relative to
        unit weight times height.
        """
        return roughness(state.particles, state.particles.stress[0, 0]) / self.weight

    def energy_balance(self, state: ExplicitState) -> float:
        """Work of gravity that no energy accounts for, as a share of that work.

        Elastic energy that a geostatic start brings along counts as work.  The law is a rate law: it has no stored
        energy of its own, and what is called elastic, ``volume * stress : strain / 2``, changes with the volume at
        constant stress without work; with the time step the balance therefore falls to some tenths of a percent and
        not to zero.
        """
        energy = state.energy
        given = energy["external"] + self._stored()
        spent = sum(energy[name] for name in ("kinetic", "elastic", "plastic", "damped", "removed"))
        return (given - spent) / given

    def _stored(self) -> float:
        """Elastic energy of the initial stress."""
        sigma, kinematics = self.particles.sigma, self.particles.kinematics
        if sigma is None:
            return 0.0
        strain = self.material.elastic_strain(sigma, kinematics.components)
        twice = np.array([[1.0 if i == j else 2.0] for i, j in kinematics.components])
        return float((twice * sigma * strain).sum(axis=0) @ self.particles.volume / 2)


def vertical_cut(h: float = 0.05, *, dim: int = 2, per_cell: int = 2, base: str = "smooth", loading: str = "sudden",
                 initial: str = "zero", material: Any = None, density: float = 2000.0, acceleration: float = 10.0,
                 height: float = 1.0, width: float = 2.0, room: float = 3.0,
                 until: float | None = None) -> VerticalCut:
    """A vertical cut that fails under its own weight; SI units.

    From the paper: 1 m by 2 m, E = 400 kPa, nu = 0.35, cohesion 6 kPa falling to 1 kPa with a softening modulus of
    -25 kPa, left face without horizontal displacement, smooth base.  Ours, for the paper does not print them: density,
    gravity, cell size, points per cell, loading, initial stress, and that cohesion bounds sqrt(J2).

    Parameters
    ----------
    h
        Cell size; sides of cells are the nearest ones that divide height and width.
    dim
        2 (plane strain) or 3 (one cell deep, rollers on both sides).
    per_cell
        Points per direction and cell.
    base
        ``smooth``: only the vertical displacement is zero, as printed; ``rough``: all of it.
    loading
        ``sudden`` gravity, or ``ramped`` over 0.5 s.
    initial
        Stress at the start: ``zero``, or ``geostatic``, where the cut, being elastic, carries its weight, and
        displacements count from there.  Points balance their weight with the forces of linear functions, which where
        points start are those of all methods but ``cmpm-c``.  Stress beyond the yield surface comes back in the first
        step.
    material
        A law; the paper's ``VonMises`` if not given.
    density, acceleration
        Mass per volume, and gravity.
    height, width
        Of the cut.
    room
        Free grid in front of the face.
    until
        Time that a run spans; if not given, 0.3 s with sudden and 0.8 s with ramped gravity, when the toe of the
        paper's cut is some 40 cm out.

    Raises
    ------
    ValueError
        If numbers or names do not fit.

    Examples
    --------
    >>> scene = vertical_cut(h=0.25)
    >>> scene.particles.n, round(scene.weight)
    (128, 20000)
    """
    for name, choice, names in [("base", base, ("smooth", "rough")), ("loading", loading, ("sudden", "ramped")),
                                ("initial", initial, ("zero", "geostatic"))]:
        check_choice(name, choice, names)
    until = UNTIL[loading] if until is None else until
    for name, value in [("h", h), ("density", density), ("acceleration", acceleration), ("height", height),
                        ("width", width), ("room", room), ("until", until)]:
        check_positive(name, value)
    if dim not in (2, 3):
        raise ValueError(f"dim: got {dim}, expected 2 or 3.")
    if initial == "geostatic" and loading == "ramped":
        raise ValueError("initial: got 'geostatic' with loading='ramped', which would take away the weight that the "
                         "stress carries; expected loading='sudden', where gravity acts in full from the start.")
    grid, body = _meshes(h, dim, height, width, room)
    held = tuple(range(dim)) if base == "rough" else (1,)
    boundary = [FixedPlane(1, 0.0, -1, held, name="base"), FixedPlane(0, 0.0, -1, name="left")]
    boundary += [FixedPlane(2, 0.0, -1, name="back"), FixedPlane(2, h, 1, name="front")][:2 * (dim - 2)]
    particles = Particles.fill(body, {2: plane_strain, 3: solid}[dim], density=density, per_cell=per_cell)
    corner = np.array([width, 0.0, *[h / 2] * (dim - 2)])
    scene = VerticalCut(
        mesh=grid, elem=ElementVector({2: ElementQuad1, 3: ElementHex1}[dim]()), particles=particles,
        material=material or VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3),
        boundary=tuple(boundary), gravity=(0.0, -acceleration, 0.0)[:dim], ramp=0.5 if loading == "ramped" else 0.0,
        weight=density * acceleration * height, until=until,
        toe=int(((particles.x - corner[:, None]) ** 2).sum(axis=0).argmin()))
    return replace(scene, particles=_loaded(scene)) if initial == "geostatic" else scene


def _up_to(time: float, states: Iterator[ExplicitState]) -> Iterator[ExplicitState]:
    """States up to the first one at or beyond a time."""
    for state in states:
        yield state
        if state.time >= time:
            return


def _same_cut(one: VerticalCut, other: VerticalCut) -> bool:
    """Whether soil, body, supports and load are the same, whatever the grids."""
    def facts(scene: VerticalCut) -> tuple[Any, ...]:
        return scene.boundary, scene.gravity, scene.ramp, scene.until, scene.particles.kinematics

    def sizes(scene: VerticalCut) -> ndarray:
        points = scene.particles
        half = 0.0 if points.length is None else points.length / 2
        return np.array([*(points.x - half).min(axis=1), *(points.x + half).max(axis=1), points.mass.sum()])

    fresh = all(part is None for part in (one.particles.sigma, one.particles.velocity, one.particles.history))
    return (fresh and facts(one) == facts(other) and _same_law(one.material, other.material)
            and np.allclose(sizes(one), sizes(other), rtol=1e-9, atol=1e-9))


def _same_law(one: Any, other: Any) -> bool:
    """Whether two laws are of one kind with the same numbers; fields of numbers over the points are not one number."""
    return type(one) is type(other) and all(map(np.array_equal, astuple(one), astuple(other)))


def _meshes(h: float, dim: int, height: float, width: float, room: float) -> tuple[Mesh, Mesh]:
    """The grid, and that part of it that the cut fills."""
    columns, rows = (max(round(size / h), 1) for size in (width, height))
    across, up = width / columns, height / rows
    deep = [np.array([0.0, h])] * (dim - 2)
    make = {2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[dim]
    x, y = across * np.arange(-1, columns + round(room / across) + 1), up * np.arange(-1, rows + 3)
    return make(x, y, *deep), make(x[1:columns + 2], y[1:rows + 2], *deep)


def _loaded(scene: VerticalCut) -> Particles:
    """The points with the stress that carries their weight, at the places where they are."""
    if not (hasattr(scene.material, "E") and hasattr(scene.material, "nu")):
        raise ValueError(f"initial: got 'geostatic' with {type(scene.material).__name__}, expected a law with elastic "
                         "constants E and nu; or give the particles a stress of your own.")
    law = LinearElastic(scene.material.E, scene.material.nu)
    state = next(implicit_steps(scene.mesh, scene.particles, law, scene.boundary, steps=1, strain="small", floor=0.0,
                                gravity=scene.gravity))
    return replace(scene.particles, sigma=state.particles.sigma)
