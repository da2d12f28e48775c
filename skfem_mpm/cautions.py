"""What a run warns of: answers that would be far off and look like any other."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skfem import Mesh

from .checks import whereabouts
from .grid import Grid
from .kinematics import STRAINS, Kinematics, moduli_at_rest
from .particles import Particles

LOCKS = 0.45           # Poisson's ratio from which points that each see a dilation of their own lock
MISMATCH = 1e-6        # share of stress, and of that share of stiffness, that is not told from rounding
CONTRAST = 100.0       # of the stiffness of points in a cell, beyond which the stiffest alone says how stiff that is


def caution(mesh: Mesh, particles: Particles, material: Any, strain: str, remedy: str, stacklevel: int = 3) -> None:
    """Warn of strain without its stress, a law that locks, and cells that cannot tell their points apart.

    Parameters
    ----------
    mesh, particles, material, strain, remedy
        Of the run.
    stacklevel
        How many frames up the warning points.
    """
    kinematics = particles.kinematics
    elastic = moduli_at_rest(material, particles.history, kinematics.ncomp, particles.n, kinematics.rows(particles.dim))
    if not np.isfinite(elastic).all():              # refused where it is needed
        return
    words = _of_start(particles, material, strain, abs(elastic).max())
    if remedy == "none":
        words += _of_locking(elastic, kinematics, particles.dim)
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


def _of_start(particles: Particles, material: Any, strain: str, modulus: float) -> list[str]:
    """What is said of strain that is not read, or that is not the one of the stress."""
    sigma, epsilon = particles.sigma, particles.epsilon
    if epsilon is None or sigma is None or strain == "small":
        unread = epsilon is not None and epsilon.any() and sigma is None and strain == "small"
        return ["epsilon: got strain without stress, which strain='small' does not read; give sigma."] * bool(unread)
    motion = STRAINS[strain](particles.kinematics, particles.dim, material, sigma, epsilon, particles.history)
    with np.errstate(over="ignore", invalid="ignore"):
        found = motion.respond(np.zeros((len(motion.places), particles.n))).sigma
    off = abs(found - sigma).max(axis=0)
    if off.max() <= MISMATCH * max(abs(sigma).max(), abs(found).max(), MISMATCH * modulus):
        return []
    point = int(off.argmax())
    return [f"epsilon: got strain that goes with the stress {found[:, point]} at {whereabouts(particles.x, point)}, "
            f"not with the sigma {sigma[:, point]} given there; with strain={strain!r} the strain counts: leave one of "
            "them out."]


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
    return [f"material: stiffness differs more than {CONTRAST:g} times between points of a cell, first that of "
            f"{whereabouts(particles.x, point)}, and such a cell is nearly as stiff as its stiffest point; use a grid "
            "with a line where the law changes."]


class Pieces:
    """Watches whether a body falls into pieces: points that were in one at the start and are in two now.

    Empty cells all across a body part it, and no stress crosses those; functions of domains reach over one.

    Parameters
    ----------
    index
        ``(dim, n)``; cells of the points at the start.
    reach
        How many cells away a neighbour may be.

    Examples
    --------
    >>> Pieces(np.array([[0, 1, 3, 4, 9]]), reach=1).first.tolist()
    [0, 0, 1, 1, 2]
    """

    def __init__(self, index: ndarray, reach: int) -> None:
        self.reach, self.told = reach, False
        self.first = self.of(index)

    def of(self, index: ndarray) -> ndarray:
        """In which piece each of some points is, in these cells ``(dim, n)``."""
        place = index - index.min(axis=1, keepdims=True) + self.reach
        shape = place.max(axis=1) + 1 + self.reach                  # empty cells all around
        stride = np.cumprod((1, *shape[:0:-1]))[::-1]
        cells, cell = np.unique(stride @ place, return_inverse=True)
        around = np.array(list(itertools.product(range(-self.reach, self.reach + 1), repeat=len(index)))) @ stride
        near = cells + around[around > 0][:, None]
        found = np.minimum(np.searchsorted(cells, near), len(cells) - 1)
        there = cells[found] == near
        here = np.broadcast_to(np.arange(len(cells)), near.shape)[there]
        links = coo_array((np.ones(len(here)), (here, found[there])), shape=(len(cells),) * 2)
        return connected_components(links, directed=False)[1][cell]

    def look(self, index: ndarray, numbers: ndarray, step: int) -> None:
        """Warn, once, if points of one piece are in two; ``numbers (n,)`` says which of the start they are."""
        if self.told:
            return
        now, before = self.of(index), self.first[numbers]
        count = len(np.unique(before * (now.max() + 1) + now))
        if count > len(np.unique(before)):
            self.told = True
            warnings.warn(f"step {step}: the body has come apart: empty cells part {count} pieces, which were "
                          f"{len(np.unique(before))}.  If it should not break there, points are too far from each "
                          "other; use larger cells, or more points in a cell.", UserWarning, stacklevel=3)
