"""What a run warns of: answers that would be far off and look like any other."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.ndimage import label
from skfem import Mesh

from .grid import Grid
from .kinematics import Kinematics
from .kinematics.laws import memory, moduli
from .particles import Particles

LOCKS = 0.45           # Poisson's ratio from which points that each see a dilation of their own lock
CONTRAST = 100.0       # of the stiffness of points in a cell, beyond which the stiffest alone says how stiff that is


def caution(mesh: Mesh, particles: Particles, material: Any, remedy: str, stacklevel: int = 3) -> None:
    """Warn of a law that locks, and of cells that cannot tell their points apart.

    Parameters
    ----------
    mesh, particles, material, remedy
        Of the run.
    stacklevel
        How many frames up the warning points.
    """
    zero = np.zeros((particles.kinematics.ncomp, particles.n))
    history = memory(material, particles.history, particles.n)
    elastic = moduli(material, zero, zero, history, particles.kinematics.rows(particles.dim))
    words = []
    if remedy == "none":
        words += _of_locking(elastic, particles.kinematics, particles.dim)
    if elastic.shape[2] > 1:
        words += _of_contrast(elastic[0, 0], Grid.from_mesh(mesh), particles)
    for word in words:
        warnings.warn(word, UserWarning, stacklevel=stacklevel + 1)


def caution_at_axis(particles: Particles, method: Any, stacklevel: int = 3) -> None:
    """Warn of domains that reach over the axis of rings, where a method that recovers strain alone cuts them off."""
    length, lone = particles.length, method.strain.reads_domains and method.strain is not method.mass
    if not (lone and particles.kinematics.hoop and length is not None):
        return
    over = particles.x[0] < (1 - 1e-9) * length[0] / 2
    if over.any():
        point = int(np.flatnonzero(over)[0])
        warnings.warn(f"length: the domain of point {point} at r = {particles.x[0, point]:g} reaches over the axis, "
                      "where it is cut off, and hoop strain is wrong; use method='gimp', or domains that end there.",
                      UserWarning, stacklevel=stacklevel + 1)


def _of_locking(elastic: ndarray, kinematics: Kinematics, dim: int) -> list[str]:
    places = kinematics.rows(dim)
    normal = [row for row, (i, j) in enumerate(places) if i == j]
    if len(normal) < 2:
        return []
    lam, both = elastic[normal[0], normal[1]], elastic[normal[0], normal[0]]
    sums = lam + both                                                       # 2 (lam + G)
    nu = float(np.divide(lam, sums, out=np.zeros_like(lam), where=sums > 0).max())
    if not nu > LOCKS:
        return []
    return [f"material: Poisson's ratio is {nu:g}, above {LOCKS:g}, where points lock: stiffness and pressures come "
            "out too large, far so near 0.5; use remedy='bbar'."]


def _of_contrast(stiffness: ndarray, grid: Grid, particles: Particles) -> list[str]:
    cell = np.ravel_multi_index(tuple(grid.locate(particles.x)), grid.cells.shape)
    _, cell = np.unique(cell, return_inverse=True)
    low, high = np.full(cell.max() + 1, np.inf), np.zeros(cell.max() + 1)
    np.minimum.at(low, cell, stiffness)
    np.maximum.at(high, cell, stiffness)
    far = high > CONTRAST * low
    if not far.any():
        return []
    point = int(np.flatnonzero(far[cell])[0])
    place = ", ".join(f"{value:g}" for value in particles.x[:, point])
    return [f"material: stiffness differs more than {CONTRAST:g} times between points of a cell, first that of point "
            f"{point} at ({place}), and such a cell is nearly as stiff as its stiffest point; use a grid with a line "
            "where the law changes."]


class Pieces:
    """Watches into how many pieces a body falls; empty cells all across it part them, and no stress crosses those.

    Examples
    --------
    >>> Pieces().count(np.array([[0, 1, 3, 4, 9]]))
    3
    """

    def __init__(self) -> None:
        self.least: int | None = None
        self.told = False

    def count(self, index: ndarray) -> int:
        """Into how many pieces points in these cells ``(dim, n)`` are parted."""
        place = index - index.min(axis=1, keepdims=True)
        occupied = np.zeros(place.max(axis=1) + 1, dtype=bool)
        occupied[tuple(place)] = True
        return int(label(occupied, np.ones((3,) * len(place)))[1])

    def look(self, index: ndarray, step: int, stacklevel: int = 2) -> None:
        """Warn if there are more pieces than there ever were; once."""
        if self.told:
            return
        count = self.count(index)
        if self.least is not None and count > self.least:
            self.told = True
            warnings.warn(f"step {step}: the body has come apart: empty cells part {count} pieces, and there were "
                          f"{self.least}.  If it should not break there, points are too far from each other; use "
                          "larger cells, or more points in a cell.", UserWarning, stacklevel=stacklevel + 1)
        self.least = count if self.least is None else min(count, self.least)
