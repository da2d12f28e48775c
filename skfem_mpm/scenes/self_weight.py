r"""Bodies that shorten under their own weight: a column, and a block at any angle to the grid that slides meanwhile.

Hencky's law with :math:`\nu = 0` makes both one-dimensional whatever their sides do: along the height the nominal
stress is :math:`P = \tau / \lambda = E \ln\lambda / \lambda`, and equilibrium wants :math:`P = -\rho_0 g (H - Y)`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.special import lambertw
from skfem import ElementHex1, ElementLineP1, ElementQuad1, ElementVector, Mesh, MeshHex, MeshLine, MeshQuad

from ..boundary import FixedPlane, Wall
from ..checks import check_array, check_positive
from ..implicit import State, implicit_steps
from ..kinematics import plane_strain, solid, uniaxial
from ..materials import Hencky
from ..particles import Particles
from .errors import normal_stress, point_errors

ELEMENTS = {1: ElementLineP1, 2: ElementQuad1, 3: ElementHex1}
MOTION = {1: uniaxial, 2: plane_strain, 3: solid}


def self_weight(Y: ndarray, height: float, load: float) -> tuple[ndarray, ndarray]:
    r"""Current height and stretch of a column under its own weight, for Hencky's law with :math:`\nu = 0`.

    With :math:`s = \frac{\rho_0 g H}{E} (1 - Y / H)` equilibrium reads :math:`-\ln\lambda / \lambda = s`, so
    :math:`\lambda = e^{-w}` with Lambert's :math:`w e^w = s`, and :math:`y = \int_0^Y \lambda \, dY` is
    :math:`\frac{H}{s_0} [w + w^2 / 2]` between the place and the base.

    Parameters
    ----------
    Y : (n,)
        Initial heights, from 0 to ``height``.
    height
        Initial height H of the column.
    load
        :math:`s_0 = \rho_0 g H / E`.

    Returns
    -------
    y : (n,)
        Current heights.
    stretch : (n,)
        :math:`\lambda = dy / dY`.

    Examples
    --------
    >>> y, stretch = self_weight(np.array([0.0, 0.8]), height=0.8, load=2 * np.log(2))
    >>> print(abs(y).round(4), stretch.round(4))
    [0.     0.5386] [0.5 1. ]
    """
    w, base = (lambertw(load * share).real for share in (1 - Y / height, 1.0))
    return height / load * (base + base ** 2 / 2 - w - w ** 2 / 2), np.exp(-w)


@dataclass(frozen=True, eq=False)
class SelfWeight:
    """The scene as plain data; make it with :func:`block` or :func:`column`.

    Attributes
    ----------
    mesh, elem, particles, material, boundary
        What :func:`skfem_mpm.implicit_steps` takes.
    gravity
        Body force per mass in the end, which grows in proportion to the steps.
    steps
        Load steps to the end.
    base, up, height
        A point of the base, the unit vector from base to top, and the initial height.
    slide
        How far the base has moved in the end.
    inner
        ``(n,)``; points that start more than two cells from every surface.
    """

    mesh: Mesh
    elem: Any
    particles: Particles
    material: Hencky
    boundary: tuple[Any, ...]
    gravity: ndarray
    steps: int
    base: ndarray
    up: ndarray
    height: float
    slide: ndarray
    inner: ndarray

    def run(self, method: str = "mpm", steps: int | None = None, start: State | None = None,
            **choices: Any) -> Iterator[State]:
        """Yield the states of ``steps`` load steps, of all of them if not given.

        Calls :func:`skfem_mpm.implicit_steps` with this scene, logarithmic strain and ``choices``.
        """
        boundary = self.boundary if start is None else None
        return implicit_steps(self.mesh, start or self.particles, self.material, boundary, method=method,
                              steps=self.steps if steps is None else steps,
                              **{"gravity": lambda step: step / self.steps * self.gravity, **choices})

    def exact(self, step: int) -> tuple[ndarray, ndarray]:
        """Where the points are after a number of load steps, ``(dim, n)``, and their Cauchy stress, ``(3, 3, n)``."""
        share, law, x = step / self.steps, self.material, self.particles.x
        Y = self.up @ (x - self.base[:, None])
        weight = self.particles.mass.sum() / self.particles.volume.sum() * np.linalg.norm(self.gravity)
        y, stretch = self_weight(Y, self.height, share * weight * self.height / law.E)
        stress = law.E * np.log(stretch) / stretch
        return x + share * self.slide[:, None] + np.outer(self.up, y - Y), normal_stress(stress, self.up[:, None])

    def errors(self, state: State) -> dict[str, float]:
        """Errors against the exact solution.

        Returns
        -------
        dict
            ``all`` and ``inner``: rms error of stress (Frobenius norm) over all and over inner points, relative to
            the largest stress; ``position``: rms error of position, relative to the height.
        """
        return point_errors(state.particles, *self.exact(state.step), self.inner, self.height)

    def error(self, state: State) -> float:
        """Relative rms error of stress over all points."""
        return self.errors(state)["all"]


def column(h: float = 0.05, *, dim: int = 1, steps: int = 50, height: float = 0.8, stretch: float = 0.5,
           density: float = 50.0, acceleration: float = 9.81, per_cell: int = 2) -> SelfWeight:
    r"""A column on a fixed base that shortens under its own weight to about two thirds; SI units.

    From the AMPSSIE tutorial: 0.8 m, 50 kg/m3, 50 steps, a Young's modulus of 283 Pa, so that the base stretch is 0.5.

    Parameters
    ----------
    h
        Cell size; sides of cells are the nearest ones that divide the height.
    dim
        1 (uniaxial strain), 2 (plane strain) or 3; rollers on all sides, and one cell wide.
    steps
        In which gravity grows.
    height, density, acceleration
        Of the column; gravity in the end.
    stretch
        Of the base in the end, which gives Young's modulus.
    per_cell
        Points per direction and cell.

    Raises
    ------
    ValueError
        If numbers do not fit.

    Examples
    --------
    >>> scene = column()
    >>> round(float(scene.material.E), 1)
    283.1
    """
    cells = _check(dim, (1, 2, 3), height / h, steps, stretch, density, per_cell)
    check_positive("acceleration", acceleration)
    size, axis = height / cells, min(dim, 2) - 1
    lines = [size * np.arange(2)] * dim
    lines[axis] = size * np.arange(-1, cells + 2)
    inside = [*lines]
    inside[axis] = lines[axis][1:-1]
    up = np.eye(dim)[axis]
    planes = [FixedPlane(axis, 0.0, -1, name="base")]
    planes += [FixedPlane(k, size * (side > 0), side, name=f"side {k} {side:+d}")
               for k in range(dim) if k != axis for side in (-1, 1)]
    body = Particles.fill(_mesh(inside), MOTION[dim], density=density, per_cell=per_cell)
    depth = np.minimum(body.x[axis], height - body.x[axis])
    return SelfWeight(
        mesh=_mesh(lines), elem=ElementVector(ELEMENTS[dim]()), particles=body,
        material=Hencky(E=density * acceleration * height / _load(stretch), nu=0.0), boundary=tuple(planes),
        gravity=-acceleration * up, steps=steps, base=np.zeros(dim), up=up, height=height, slide=np.zeros(dim),
        inner=depth > 2 * size)


def block(h: float = 0.1, *, dim: int = 2, rotation: float | ndarray = 20.0, steps: int = 20, slide: float = 0.5,
          stretch: float = 0.62, E: float = 1e6, density: float = 1000.0, per_cell: int = 2,
          offset: float = 0.0, segment: float = 0.5) -> SelfWeight:
    """A block of unit edges at an angle to the grid that shortens under its own weight while its base slides; SI units.

    Points start on the lattice of the block's own cells, gravity acts along the block's own height, and its sides and
    top are free: a two- or three-dimensional run with a one-dimensional solution, in which points cross cells and cells
    are cut in every way.

    Parameters
    ----------
    h
        Cell size of the grid; the block has the nearest whole number of cells along each edge.
    dim
        2 (plane strain) or 3.
    rotation
        Degrees from the first axis towards the second; or a rotation matrix ``(dim, dim)``, whose columns are the
        edges of the block, the second one upwards.
    steps
        In which gravity and slide grow.
    slide
        How far the base moves along the block's first edge.
    stretch
        Of the base in the end, which gives the size of gravity.
    E, density
        Of the block.
    per_cell
        Points per direction and cell.
    offset
        Where a corner of the block starts in its cell of the grid, from 0 to below 1 along each axis.
    segment
        Size of the segments of the base on which the mean displacement is imposed, in cells.

    Raises
    ------
    ValueError, TypeError
        If numbers do not fit.

    Examples
    --------
    >>> scene = block()
    >>> state = next(scene.run("gimp"))
    >>> scene.errors(state)["inner"] < 0.03
    True
    """
    count = _check(dim, (2, 3), 1 / h, steps, stretch, density, per_cell)
    for name, value in [("E", E), ("segment", segment)]:
        check_positive(name, value)
    if not (np.isfinite(slide) and 0 <= offset < 1):
        raise ValueError(f"block: got slide={slide}, offset={offset}, expected a finite slide and an offset from 0 to "
                         "below 1.")
    turn, corner = _turn(rotation, dim), np.full(dim, offset * h)
    up, moved = turn[:, 1], slide * turn[:, 0]
    own = _mesh([np.linspace(0, 1, count + 1)] * dim)
    lattice = Particles.fill(own, MOTION[dim], per_cell=per_cell).x
    body = Particles.fill(type(own)(corner[:, None] + turn @ own.p, own.t), MOTION[dim], density=density,
                          per_cell=per_cell)
    ends = corner[:, None] + turn @ np.indices((2,) * dim).reshape(dim, -1)
    ends = np.concatenate([ends, ends + moved[:, None]], axis=1)
    lines = [h * np.arange(np.floor(row.min() / h + 1e-9) - 2, np.ceil(row.max() / h - 1e-9) + 3) for row in ends]
    place, segments = _base(dim, max(round(1 / (segment * h)), 1))
    wall = Wall(corner[:, None] + turn @ place, tuple(moved / steps), name="base", segments=segments)
    return SelfWeight(
        mesh=_mesh(lines), elem=ElementVector(ELEMENTS[dim]()), particles=body, material=Hencky(E=E, nu=0.0),
        boundary=(wall,), gravity=-_load(stretch) * E / density * up, steps=steps, base=corner, up=up, height=1.0,
        slide=moved, inner=np.minimum(lattice, 1 - lattice).min(axis=0) > 2 * h)


def _check(dim: int, dims: tuple[int, ...], cells: float, steps: int, stretch: float, density: float,
           per_cell: int) -> int:
    """Refuse what makes no scene; the whole number of cells along its height."""
    check_positive("density", density)
    if dim not in dims or steps != int(steps) or steps < 1:
        raise ValueError(f"got dim={dim}, steps={steps}, expected dim {' or '.join(map(str, dims))} and a whole number "
                         "of steps of at least 1.")
    if not 1 / np.e < stretch < 1:
        raise ValueError(f"stretch: got {stretch}, expected a number from 1/e to 1.")
    if not (np.isfinite(cells) and cells >= 1):
        raise ValueError(f"h: got {cells:g} cells along the height, expected at least one; use a smaller h.")
    return round(cells)


def _load(stretch: float) -> float:
    """The load that gives the base this stretch."""
    return float(-np.log(stretch) / stretch)


def _mesh(lines: list[ndarray]) -> Mesh:
    return {1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[len(lines)](*lines)


def _turn(rotation: Any, dim: int) -> ndarray:
    """The rotation matrix."""
    if np.ndim(rotation):
        turn = check_array("rotation", rotation, (dim, dim))
        if not (np.allclose(turn.T @ turn, np.eye(dim), rtol=0, atol=1e-9) and np.linalg.det(turn) > 0):
            raise ValueError(f"rotation: got {turn.tolist()}, expected degrees or a matrix whose columns are unit "
                             "vectors at right angles, without reflection.")
        return turn
    if not np.isfinite(rotation):
        raise ValueError(f"rotation: got {rotation}, expected degrees.")
    turn = np.eye(dim)
    c, s = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    turn[:2, :2] = [[c, -s], [s, c]]
    return turn


def _base(dim: int, count: int, samples: int = 4) -> tuple[ndarray, ndarray]:
    """Points of the base ``(dim, n)`` in coordinates of the unit block, and in which of its segments they are."""
    index = np.indices((count * samples,) * (dim - 1)).reshape(dim - 1, -1)
    place = np.insert((index + 0.5) / (count * samples), 1, 0.0, axis=0)
    labels = np.arange(count ** (dim - 1)).reshape((count,) * (dim - 1))
    return place, labels[tuple(index // samples)]
