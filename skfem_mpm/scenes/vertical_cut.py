"""The vertical cut in softening soil of section 4 of Gonzalez Acosta, Vardon and Hicks (2017)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from skfem import ElementHex1, ElementQuad1, ElementVector, Mesh, MeshHex, MeshQuad

from ..boundary import FixedPlane
from ..checks import check_choice, check_positive
from ..explicit import ExplicitState, explicit_steps
from ..kinematics import plane_strain, solid
from ..materials import VonMises
from ..particles import Particles


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

    def run(self, method: str = "mpm", steps: int = 100, start: ExplicitState | None = None,
            **choices: Any) -> Iterator[ExplicitState]:
        """Yield states of time steps; calls :func:`skfem_mpm.explicit_steps` with this scene and ``choices``."""
        return explicit_steps(self.mesh, start or self.particles, self.material, self.boundary, method=method,
                              steps=steps, gravity=self.gravity, ramp=self.ramp, **choices)

    def toe_displacement(self, state: ExplicitState) -> float:
        """How far the toe has moved outwards."""
        return float(state.particles.x[0, self.toe] - self.particles.x[0, self.toe])

    def run_out(self, state: ExplicitState) -> float:
        """How far the foremost point is beyond the initial face."""
        return float(state.particles.x[0].max() - self.particles.x[0].max())

    def roughness(self, state: ExplicitState) -> float:
        """Oscillation of the horizontal stress.

        The rms of what is left of it after taking off its least-squares plane over the 16 nearest points, relative to
        unit weight times height.
        """
        x, stress = state.particles.x, state.particles.stress[0, 0]
        _, near = cKDTree(x.T).query(x.T, k=16)
        offset = x[:, near] - x[:, :, None]
        basis = np.concatenate([np.ones((1, *near.shape)), offset]).transpose(1, 2, 0)
        plane = np.einsum("nij,nj->ni", np.linalg.pinv(basis), stress[near])[:, 0]
        return float(np.sqrt(((stress - plane) ** 2).mean()) / self.weight)


def vertical_cut(h: float = 0.05, *, dim: int = 2, per_cell: int = 2, base: str = "smooth", loading: str = "sudden",
                 material: Any = None, density: float = 2000.0, acceleration: float = 10.0, height: float = 1.0,
                 width: float = 2.0, room: float = 3.0) -> VerticalCut:
    """A vertical cut that fails under its own weight; SI units.

    From the paper: 1 m by 2 m, E = 400 kPa, nu = 0.35, cohesion 6 kPa falling to 1 kPa with a softening modulus of
    -25 kPa, left face without horizontal displacement, smooth base.  Ours, for the paper does not print them: density,
    gravity, cell size, points per cell, loading, and that cohesion bounds sqrt(J2).

    Parameters
    ----------
    h
        Cell size.
    dim
        2 (plane strain) or 3 (one cell deep, rollers on both sides).
    per_cell
        Points per direction and cell.
    base
        ``smooth``: only the vertical displacement is zero, as printed; ``rough``: all of it.
    loading
        ``sudden`` gravity, or ``ramped`` over 0.5 s.
    material
        A law; the paper's ``VonMises`` if not given.
    room
        Free grid in front of the face.

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
    check_choice("base", base, ("smooth", "rough"))
    check_choice("loading", loading, ("sudden", "ramped"))
    for name, value in [("h", h), ("density", density), ("height", height), ("width", width), ("room", room)]:
        check_positive(name, value)
    if dim not in (2, 3):
        raise ValueError(f"dim: got {dim}, expected 2 or 3.")
    material = material or VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3)
    columns, rows, free = (round(size / h) for size in (width, height, room))
    body = [width * np.arange(columns + 1) / columns, height * np.arange(rows + 1) / rows]
    box = [h * np.arange(-1, columns + free + 1), h * np.arange(-1, rows + 3)]
    deep = [np.array([0.0, h])] * (dim - 2)
    make = {2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[dim]
    particles = Particles.fill(make(*body, *deep), {2: plane_strain, 3: solid}[dim], density=density, per_cell=per_cell)
    held = tuple(range(dim)) if base == "rough" else (1,)
    planes = [FixedPlane(1, 0.0, -1, held, name="base"), FixedPlane(0, 0.0, -1, name="left")]
    sides = [FixedPlane(2, 0.0, -1, name="back"), FixedPlane(2, h, 1, name="front")] if dim == 3 else []
    corner = np.array([width, 0.0, *[h / 2] * (dim - 2)])
    return VerticalCut(
        mesh=make(*box, *deep), elem=ElementVector({2: ElementQuad1, 3: ElementHex1}[dim]()), particles=particles,
        material=material, boundary=(*planes, *sides), gravity=(0.0, -acceleration, 0.0)[:dim],
        ramp=0.5 if loading == "ramped" else 0.0, weight=density * acceleration * height,
        toe=int(((particles.x - corner[:, None]) ** 2).sum(axis=0).argmin()))

