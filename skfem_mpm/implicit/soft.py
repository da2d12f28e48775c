"""What a load step adds to the stiffness of the points: the soft floor, and the ghost penalty at cut cells."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csc_array
from skfem import Mesh

from ..ghost import ghost_stiffness, young
from ..grid import gauss_points
from ..integration import on_points
from ..kinematics import Kinematics
from ..materials import LinearElastic
from ..support import Support
from .engine import made_for
from .state import Options


def soft_stiffness(mesh: Mesh, support: Support, kinematics: Kinematics, elastic: ndarray,
                   places: Sequence[tuple[int, int]], options: Options) -> csc_array:
    """Soft floor and ghost penalty, over the displacements of the grid.

    Parameters
    ----------
    elastic
        ``(m, m, 1)`` or ``(m, m, n)``; moduli of the unstressed material.
    places
        Rows and columns of the gradient that moduli are for.
    """
    size = support.transfer.shape[0]
    out = csc_array((size, size))
    if options.floor and support.sound.any():
        out = out + _floor(support, kinematics, elastic, places, options)
    if options.ghost:
        modulus = young(elastic[:, :, elastic[0, 0].argmin()], places)      # of the softest point
        out = out + ghost_stiffness(mesh, support, support.occupied, options.ghost * modulus)
    return out


def _floor(support: Support, kinematics: Kinematics, elastic: ndarray, places: Sequence[tuple[int, int]],
           options: Options) -> csc_array:
    """Soft stiffness of whole cells, with two Gauss points per axis; ordinary finite elements."""
    index, x, area = gauss_points(support.grid, np.stack(np.nonzero(support.sound)))
    moduli = options.floor * _floor_moduli(support, elastic, places, options, index)
    volume = area * x[0] if kinematics.hoop else area
    stencil = support.grid.linear(x, index)
    floor = on_points(kinematics, stencil, stencil, volume, x[0])
    return made_for(options.engine, floor).tangent(moduli, support.number, support.transfer.shape[0])


def _floor_moduli(support: Support, elastic: ndarray, places: Sequence[tuple[int, int]], options: Options,
                  cells: ndarray) -> ndarray:
    """Moduli of the unstressed material in these cells; where dilation is averaged, without lateral contraction.

    They are the mean ones of the body, scaled to the softest points around where these differ.  Nearly incompressible
    moduli would lock in the floor.
    """
    moduli, stiffness = elastic.mean(axis=2, keepdims=True), elastic[0, 0]
    share: Any = 1.0
    if (stiffness != stiffness[0]).any():
        share = softest_around(support.occupied, support.index, stiffness, cells) / moduli[0, 0]
    if options.remedy != "none":
        zero = np.zeros((len(support.particles.kinematics.components), 1))
        moduli = LinearElastic(E=young(moduli[:, :, 0], places), nu=0.0).tangent(zero, zero, zero[:0], places)
    return moduli * share


def softest_around(occupied: ndarray, index: ndarray, stiffness: ndarray, cells: ndarray) -> ndarray:
    """The smallest stiffness of the points in a cell, or in the cells around it where it is empty.

    A mean over the body would be that of its stiffest part, and a small share of it can be more than a soft one has.

    Parameters
    ----------
    occupied
        Mask over the cells, one index per axis.
    index
        ``(dim, n)``; cell of each point.
    stiffness
        ``(n,)``; of each point.
    cells
        ``(dim, m)``; which cells are asked for.

    Examples
    --------
    >>> occupied, index = np.array([True, True, False, False]), np.array([[0, 0, 1]])
    >>> softest_around(occupied, index, np.array([1e8, 2.0, 1e8]), np.array([[0, 1, 2, 3]])).tolist()
    [2.0, 100000000.0, 100000000.0, 2.0]
    """
    least = np.full(np.add(occupied.shape, 2), np.inf)           # with an empty cell all around
    np.minimum.at(least, tuple(index + 1), stiffness)
    around = np.min([least[tuple(cells + 1 + np.array(offset)[:, None])]
                     for offset in itertools.product((-1, 0, 1), repeat=len(cells))], axis=0)
    found = np.where(occupied[tuple(cells)], least[tuple(cells + 1)], around)
    return np.where(np.isfinite(found), found, stiffness.min())
