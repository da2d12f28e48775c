"""A quarter of a ring whose inner wall is pushed outwards while its outer face is free: circles on a square grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import ElementQuad1, ElementVector, Mesh, MeshQuad

from ..boundary import FixedPlane, Wall
from ..checks import check_choice, check_positive
from ..implicit import State, implicit_steps
from ..kinematics import plane_strain
from ..materials import Hencky
from ..particles import Particles
from .cylinder_reference import CylinderState, finite, finite_free
from .errors import normal_stress, point_errors

FACES = {"free": finite_free, "fixed": finite}


@dataclass(frozen=True, eq=False)
class Ring:
    """The scene as plain data; make it with :func:`ring`.

    Attributes
    ----------
    mesh, elem, particles, material, boundary
        What :func:`skfem_mpm.implicit_steps` takes.
    inner_radius, outer_radius
        Of the ring before it is pushed.
    push
        How far the inner wall has moved in the end.
    steps
        Load steps to the end.
    face
        The outer one: ``free`` or ``fixed``.
    inner
        ``(n,)``; points that start more than two cells from inner and outer face.
    """

    mesh: Mesh
    elem: Any
    particles: Particles
    material: Hencky
    boundary: tuple[Any, ...]
    inner_radius: float
    outer_radius: float
    push: float
    steps: int
    face: str
    inner: ndarray
    _known: dict[int, CylinderState] = field(default_factory=dict, repr=False)

    def run(self, method: str = "mpm", steps: int | None = None, start: State | None = None,
            **choices: Any) -> Iterator[State]:
        """Yield the states of ``steps`` load steps, of all of them if not given.

        Calls :func:`skfem_mpm.implicit_steps` with this scene, logarithmic strain and ``choices``.
        """
        boundary = self.boundary if start is None else None
        return implicit_steps(self.mesh, start or self.particles, self.material, boundary, method=method,
                              steps=self.steps if steps is None else steps, **choices)

    def reference(self, step: int) -> CylinderState:
        """Radii and stresses (rr, zz, hoop, rz) of the points after a number of load steps; exact to ten digits."""
        if step not in self._known:
            law, radius = self.material, np.hypot(*self.particles.x)
            self._known[step] = FACES[self.face](radius, law.E, law.nu, self.inner_radius, self.outer_radius,
                                                 self.push * step / self.steps, measure="kirchhoff")
        return self._known[step]

    def exact(self, step: int) -> tuple[ndarray, ndarray]:
        """Where the points are after a number of load steps, ``(dim, n)``, and their Cauchy stress, ``(3, 3, n)``."""
        found = self.reference(step)
        outwards = self.particles.x / np.hypot(*self.particles.x)
        around = np.stack([-outwards[1], outwards[0]])
        radial, along, hoop, _ = found.stress
        stress = normal_stress(radial, outwards) + normal_stress(hoop, around)
        stress[2, 2] = along
        return found.position * outwards, stress

    def errors(self, state: State) -> dict[str, float]:
        """Errors against the exact solution.

        Returns
        -------
        dict
            ``all`` and ``inner``: rms error of stress (Frobenius norm) over all and over inner points, relative to
            the largest stress; ``position``: rms error of position, relative to the inner radius.
        """
        return point_errors(state.particles, *self.exact(state.step), self.inner, self.inner_radius)

    def error(self, state: State) -> float:
        """Relative rms error of stress over all points."""
        return self.errors(state)["all"]


def ring(h: float = 0.1, *, inner: float = 1.0, outer: float = 2.0, push: float = 0.5, steps: int = 20,
         face: str = "free", E: float = 1e6, nu: float = 0.3, per_cell: int = 2, segment: float = 1.0) -> Ring:
    """A quarter of a ring, plane strain, whose inner wall is pushed outwards; SI units.

    Points stand on circles, about ``per_cell`` per direction and cell size, so that their domains fit the ring and not
    the grid.  The law is Hencky's.

    Parameters
    ----------
    h
        Cell size of the grid.
    inner, outer
        Radii.
    push
        How far the inner wall moves.
    steps
        In which it moves.
    face
        The outer one: ``free``, or ``fixed``.
    E, nu
        Young's modulus and Poisson's ratio at small strain.
    per_cell
        Circles of points per cell size, and points per cell size on them.
    segment
        Length of the segments of a wall on which the mean displacement is imposed, in cells.

    Raises
    ------
    ValueError
        If numbers do not fit.

    Examples
    --------
    >>> scene = ring(h=0.25, push=0.01, steps=1)
    >>> state = next(scene.run("gimp"))
    >>> scene.errors(state)["all"] < 0.1
    True
    """
    check_choice("face", face, FACES)
    for name, value in [("h", h), ("inner", inner), ("outer - inner", outer - inner), ("push", push),
                        ("segment", segment)]:
        check_positive(name, value)
    if any(count != int(count) or count < 1 for count in (steps, per_cell)):
        raise ValueError(f"ring: got steps={steps}, per_cell={per_cell}, expected whole numbers of at least 1.")
    law = Hencky(E=E, nu=nu)
    particles = _points(inner, outer, max(round((outer - inner) / h * per_cell), 1))
    end = FACES[face](np.array([float(outer)]), E, nu, inner, outer, push, measure="kirchhoff").position[0]
    lines = h * np.arange(-1, np.ceil(end / h) + 3)
    walls = [Wall.along(_arc(inner), lambda x: push / steps * x / np.hypot(*x), size=segment * h, name="inner")]
    if face == "fixed":
        walls.append(Wall.along(_arc(outer), (0.0, 0.0), size=segment * h, name="outer"))
    planes = [FixedPlane(0, 0.0, -1, name="left"), FixedPlane(1, 0.0, -1, name="bottom")]
    radius = np.hypot(*particles.x)
    return Ring(mesh=MeshQuad.init_tensor(lines, lines), elem=ElementVector(ElementQuad1()), particles=particles,
                material=law, boundary=(*walls, *planes), inner_radius=inner, outer_radius=outer, push=push,
                steps=steps, face=face, inner=(radius > inner + 2 * h) & (radius < outer - 2 * h))


def _points(inner: float, outer: float, circles: int) -> Particles:
    """Points on circles, about as far apart along them as these are; each stands for a piece of a circular strip."""
    thick = (outer - inner) / circles
    radii = inner + thick * (np.arange(circles) + 0.5)
    counts = np.round(np.pi / 2 * radii / thick).astype(int)
    radius, wide = np.repeat(radii, counts), np.repeat(np.pi / 2 / counts, counts)
    angle = np.concatenate([np.pi / 2 / count * (np.arange(count) + 0.5) for count in counts])
    outwards = np.stack([np.cos(angle), np.sin(angle)])
    around = np.stack([-outwards[1], outwards[0]])
    area = thick * radius * wide
    return Particles(radius * outwards, area, area.copy(), plane_strain, length=np.tile(np.sqrt(area), (2, 1)),
                     spans=np.stack([thick * outwards, radius * wide * around], axis=1))


def _arc(radius: float) -> ndarray:
    """Corners of a quarter circle about the origin, so many that it is round to six digits."""
    angle = np.linspace(0, np.pi / 2, 1000)
    return radius * np.stack([np.cos(angle), np.sin(angle)])
