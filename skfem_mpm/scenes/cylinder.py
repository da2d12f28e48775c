"""The thick-walled cylinder of section 3 of Gonzalez Acosta, Vardon and Hicks (2017), driven by its inner wall."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import ElementLineP1, ElementQuad1, ElementVector, Mesh, MeshLine, MeshQuad

from ..boundary import FixedPlane, Wall
from ..checks import check_choice, check_positive
from ..grid import EDGES, Edges
from ..implicit import State, implicit_steps
from ..kinematics import axisymmetric
from ..materials import LinearElastic
from ..particles import Particles
from .cylinder_reference import CylinderState, deviatoric, finite_history, incremental, lame

REFERENCES = ("lame", "incremental", "cauchy", "kirchhoff")


@dataclass(frozen=True, eq=False)
class Cylinder:
    """The scene as plain data; make it with :func:`cylinder`.

    Attributes
    ----------
    mesh
        The background grid, or a function of the state that gives it where the grid follows the wall.
    elem
        The linear element of the grid.
    particles, material, boundary
        What :func:`skfem_mpm.implicit_steps` takes.
    edges
        What GIMP does at the edge of the grid.
    inner, outer, increment
        Radii, and displacement of the inner wall per step.
    followed
        Index of the point whose deviatoric stress is followed.
    """

    mesh: Mesh | Callable[[State], Mesh]
    elem: Any
    particles: Particles
    material: Any
    boundary: tuple[Any, ...]
    edges: Edges
    inner: float
    outer: float
    increment: float
    followed: int
    _known: dict[tuple[str, int], CylinderState] = field(default_factory=dict, repr=False)

    def run(self, method: str = "mpm", steps: int = 50, start: State | None = None, **choices: Any) -> Iterator[State]:
        """Yield the states of ``steps`` load steps.

        Calls :func:`skfem_mpm.implicit_steps` with this scene and ``choices``.
        """
        boundary = self.boundary if start is None else None
        return implicit_steps(self.mesh, start or self.particles, self.material, boundary, method=method, steps=steps,
                              **{"edges": self.edges, **choices})

    def reference(self, name: str, steps: int) -> CylinderState:
        """Positions and stresses of the points after each of ``steps`` steps by a reference solution.

        Parameters
        ----------
        name
            ``lame`` (linear, initial geometry), ``incremental`` (Lame's increments, updated geometry), ``cauchy`` or
            ``kirchhoff`` (finite deformation in equilibrium, that stress linear in logarithmic strain).
        """
        check_choice("reference", name, REFERENCES)
        if (name, steps) not in self._known:
            law, radius = self.material, self.particles.x[0]
            given = (law.E, law.nu, self.inner, self.outer)
            if name == "lame":
                displacement, stress = lame(radius, *given, self.increment)
                count = np.arange(1, steps + 1)
                found = CylinderState(radius + count[:, None] * displacement, stress[:, None] * count[:, None],
                                      -count * np.nan, -count * np.nan)
            elif name == "incremental":
                found = incremental(radius, *given, self.increment, steps)
            else:
                found = finite_history(radius, *given, self.increment * np.arange(1, steps + 1), measure=name)
            self._known[name, steps] = found
        return self._known[name, steps]

    def reference_of(self, state: State) -> str:
        """Name of the reference a run is measured against: the one that solves the same equations."""
        if state.scheme == "incremental":
            return "incremental"
        return "kirchhoff" if self.material.kirchhoff else "cauchy"

    def errors(self, state: State, reference: str | None = None) -> dict[str, float]:
        """Errors of the deviatoric stress q, relative to the reference's largest q of that step.

        Returns
        -------
        dict
            ``point``: of the followed point; ``all``: rms over all points; ``inner``: rms over all but two points at
            each end.
        """
        name = reference or self.reference_of(state)
        feasible = int(np.ceil((self.outer - self.inner) / self.increment)) - 1
        known = max(state.step, min(50, feasible))              # one solution serves a whole run
        exact = deviatoric(self.reference(name, known).stress[:, state.step - 1])
        stress = state.particles.sigma
        if stress is None:
            raise ValueError("state: got one without stress; take a state that run() has yielded.")
        error = np.abs(deviatoric(stress) - exact) / exact.max()
        layer = np.unique(np.round(self.particles.x[0], 12), return_inverse=True)[1]
        middle = (layer >= 2) & (layer < layer.max() - 1)
        return {"point": float(error[self.followed]), "all": float(np.sqrt((error ** 2).mean())),
                "inner": float(np.sqrt((error[middle] ** 2).mean()))}

    def error(self, state: State, reference: str | None = None) -> float:
        """Relative rms error of the deviatoric stress over all points against the named reference."""
        return self.errors(state, reference)["all"]


def cylinder(cells: int = 20, *, dim: int = 2, per_cell: int = 2, rule: str = "quarter", inner: float = 1.0,
             outer: float = 3.0, increment: float = 0.015, material: Any = None, followed: float | None = None,
             edges: Edges = "ghost", offset: float = 0.0, follow: bool = False) -> Cylinder:
    """Thick-walled cylinder, plane strain along its axis, whose inner wall is pushed outwards; SI units.

    From the paper: E = 25 MPa, nu = 0.3, steps of 1.5 cm, 50 of them, 4-node quads, outer face fixed.  Ours, for the
    paper does not print them: the radii, the cell size, two points per direction on quarter points, the point that is
    followed, and how the wall is imposed once it leaves the nodes.

    Parameters
    ----------
    cells
        Cells across the wall.
    dim
        2: one row of axisymmetric quads with rollers; 1: the same scene on a line, radius only.
    per_cell, rule
        Points per direction, and where they are; see :meth:`skfem_mpm.Particles.fill`.
    inner, outer
        Radii.
    increment
        Displacement of the inner wall per step, outwards.
    material
        A law; ``LinearElastic(E=25e6, nu=0.3)`` if not given.
    followed
        Initial radius of the point to follow, of which the nearest is taken; 1.525 in the default cylinder, and as far
        through the wall in others, if not given.
    edges
        ``ghost`` gives the grid a spare layer of cells inside and outside; ``truncate`` and ``clip`` end it at the
        body.
    offset
        Where the wall starts in its cell, from 0 (on a grid line) to below 1; cells get slightly larger for it.
    follow
        Let the grid follow the wall, which then stays on a grid line.

    Raises
    ------
    ValueError
        If numbers do not fit.

    Examples
    --------
    >>> scene = cylinder(cells=10, dim=1)
    >>> for state in scene.run(method="cmpm", steps=1):
    ...     print(round(scene.error(state, "lame"), 3))
    0.004
    """
    check_choice("edges", edges, EDGES)
    for name, value in [("inner", inner), ("increment", increment), ("outer - inner", outer - inner)]:
        check_positive(name, value)
    if dim not in (1, 2) or int(cells) != cells or cells < 1 or not 0 <= offset < 1:
        raise ValueError(f"cylinder: got dim={dim}, cells={cells}, offset={offset}, expected dim 1 or 2, at least one "
                         "cell, and an offset from 0 to below 1.")
    if follow and offset:
        raise ValueError(f"offset: got {offset} with follow=True, expected 0; a grid that follows the wall has a line "
                         "on it.")
    if followed is None:
        followed = inner + 0.2625 * (outer - inner)
    if not inner <= followed <= outer:
        raise ValueError(f"followed: got {followed}, expected a radius from {inner} to {outer}.")
    width = (outer - inner) / (cells - offset)
    if edges == "ghost" and inner - width * (1 + offset) < 0:
        raise ValueError(f"inner: got {inner}, expected at least the width of a spare cell, {width:g}; take more cells "
                         "or edges='clip'.")
    spare = 1 if edges == "ghost" else 0
    body = _mesh(np.linspace(inner, outer, cells + 1), width, dim)
    particles = Particles.fill(body, axisymmetric, density=1.0, per_cell=per_cell, rule=rule)

    def grid(wall: float) -> Mesh:
        return _mesh(_axis(wall, outer, cells, spare), width, dim)

    wall = np.array([[inner], [width / 2]])[:dim]
    planes = [FixedPlane(0, outer, 1, name="outer"), FixedPlane(1, 0.0, -1, name="bottom"),
              FixedPlane(1, width, 1, name="top")]
    boundary = (Wall(wall, (increment, None)[:dim], name="inner"), *planes[:2 * dim - 1])
    first = outer - cells * width if offset else inner
    return Cylinder(
        mesh=(lambda state: grid(state.boundary[0].x[0, 0])) if follow else grid(first),
        elem=ElementVector({1: ElementLineP1, 2: ElementQuad1}[dim]()), particles=particles,
        material=material or LinearElastic(E=25e6, nu=0.3), boundary=boundary, edges=edges, inner=inner, outer=outer,
        increment=increment, followed=int(np.abs(particles.x[0] - followed).argmin()))


def _axis(start: float, outer: float, cells: int, spare: int) -> ndarray:
    """Grid lines from ``start`` to ``outer``, both exactly, with spare cells beyond."""
    lines = np.linspace(start, outer, cells + 1)
    step = (outer - start) / cells
    beyond = step * np.arange(1, spare + 1)
    return np.concatenate([lines[0] - beyond[::-1], lines, lines[-1] + beyond])


def _mesh(radial: ndarray, height: float, dim: int) -> Mesh:
    return MeshLine(radial) if dim == 1 else MeshQuad.init_tensor(radial, np.array([0.0, height]))
