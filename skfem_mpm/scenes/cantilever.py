"""A soft cantilever that falls under its own weight and swings: large rotations, small strains, in time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import ElementQuad1, ElementVector, Mesh, MeshQuad

from ..boundary import FixedPlane
from ..checks import check_array, check_positive
from ..explicit import ExplicitState, explicit_steps
from ..kinematics import plane_strain
from ..materials import Hencky
from ..particles import Particles

# Vertical displacement of the lower corner of the free end, at a few times.  PRINTED: a finite element solution (which
# that of the Neo-Hookean law meets to 0.04 m) read off a figure.  HENCKY: ours, 64 x 16 bilinear elements, explicit.
TIMES = (0.66, 1.045, 1.40, 1.68, 2.60)
PRINTED = (-2.34, -3.28, -2.97, -3.17, 0.0)
HENCKY = (-2.37, -3.39, -3.07, -3.21, -0.18)


@dataclass(frozen=True, eq=False)
class Cantilever:
    """The scene as plain data; make it with :func:`cantilever`.

    Attributes
    ----------
    mesh, elem, particles, material, boundary
        What the solvers take.
    gravity
        Body force per mass, applied at once.
    end, share
        Points round the lower corner of the free end, and shares that extrapolate from them to it.
    times, references
        When and how far the tip has moved: ``fe``, of a finite element solution with Hencky's law, and ``printed``, the
        solution that the sources print, read off their figure.
    """

    mesh: Mesh
    elem: Any
    particles: Particles
    material: Any
    boundary: tuple[FixedPlane, ...]
    gravity: tuple[float, ...]
    end: ndarray
    share: ndarray
    times: ndarray
    references: Mapping[str, ndarray]

    def run(self, method: str = "gimp", seconds: float = 3.0, every_seconds: float = 0.02,
            start: ExplicitState | None = None, **choices: Any) -> Iterator[ExplicitState]:
        """Yield states until ``seconds`` have passed.

        Calls :func:`skfem_mpm.explicit_steps` with this scene, logarithmic strain and ``choices``.
        """
        check_positive("seconds", seconds)
        given = {"steps": 10 ** 9, "gravity": self.gravity, "strain": "logarithmic", **choices}
        run = explicit_steps(self.mesh, start or self.particles, self.material, self.boundary, method=method,
                             every_seconds=every_seconds, **given)
        for state in run:
            yield state
            if state.time >= seconds:
                return

    def tip(self, state: Any) -> float:
        """Vertical displacement of the lower corner of the free end, in a state of any solver."""
        return float((state.particles.x - self.particles.x)[1, self.end] @ self.share)

    def errors(self, times: ndarray, tip: ndarray) -> dict[str, float]:
        """Errors of a history of the tip.

        Parameters
        ----------
        times, tip
            ``(n,)``; when, in ascending order, and displacement of the tip then.

        Returns
        -------
        dict
            For each reference the largest difference at those of its times that the history covers, relative to the
            largest sag; not a number if it covers none.

        Raises
        ------
        ValueError, TypeError
            If the two are no arrays of one shape, or times do not ascend.
        """
        times = check_array("times", times, (None,))
        tip = check_array("tip", tip, times.shape)
        if not (np.diff(times) > 0).all():
            raise ValueError("times: got some that do not ascend; expected a history in order.")
        covered = (self.times >= times[0]) & (self.times <= times[-1])
        found = np.interp(self.times, times, tip)
        return {name: float(np.abs(found - sag)[covered].max() / np.abs(sag).max()) if covered.any() else np.nan
                for name, sag in self.references.items()}


def cantilever(h: float = 0.25, *, per_cell: int = 3, acceleration: float = 10.0, material: Any = None) -> Cantilever:
    """A cantilever, 4 m long and 1 m high, clamped at its left end, onto which gravity falls at once; SI units.

    From the sources of fMPMM and MaterialPointSolver.jl: E = 1 MPa, nu = 0.3, 1050 kg/m3, 3 by 3 points per cell of
    0.25 m; the tip is the lower corner of the free end.

    Parameters
    ----------
    h
        Cell size; must divide the height.
    per_cell
        Points per direction and cell.
    acceleration
        Gravity.
    material
        A law; ``Hencky(E=1e6, nu=0.3)`` if not given.

    Raises
    ------
    ValueError
        If numbers do not fit.

    Examples
    --------
    >>> scene = cantilever()
    >>> scene.particles.n, scene.gravity
    (576, (0.0, -10.0))
    """
    for name, value in [("h", h), ("acceleration", acceleration)]:
        check_positive(name, value)
    rows = round(1 / h)
    if rows < 1 or not np.isclose(rows * h, 1):
        raise ValueError(f"h: got {h}, expected a cell size that divides the height of 1 m, such as 0.25.")
    x, y = (np.arange(low * rows, high * rows + 1) / rows for low, high in [(0, 4), (0, 1)])
    body = Particles.fill(MeshQuad.init_tensor(x, y), plane_strain, density=1050.0, per_cell=per_cell)
    grid = MeshQuad.init_tensor(np.arange(-1, 5 * rows + 1) / rows, np.arange(-5 * rows, 3 * rows + 1) / rows)
    step = 1 / (rows * per_cell)
    corner = np.array([[4 - step / 2], [step / 2]]) + step * np.array([[0, -1, 0], [0, 0, 1]])
    end = ((body.x[:, :, None] - corner[:, None]) ** 2).sum(axis=0).argmin(axis=0)
    return Cantilever(mesh=grid, elem=ElementVector(ElementQuad1()), particles=body,
                      material=material or Hencky(E=1e6, nu=0.3),
                      boundary=(FixedPlane(0, 0.0, -1, (0, 1), name="clamp"),), gravity=(0.0, -acceleration),
                      end=end, share=np.array([2.0, -0.5, -0.5]), times=np.array(TIMES),
                      references={"fe": np.array(HENCKY), "printed": np.array(PRINTED)})
