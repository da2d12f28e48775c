r"""Integration weights :math:`W_p` of the points in stiffness and internal force; mass and body force never get them.

``one``
    Eq. (9) of Gonzalez Acosta et al. (2017), :math:`W_p = 1`.
``eq10``
    Eq. (10) to the letter, :math:`W_p = V_e / \sum_{q \in e} V_q`: every cell counts in full, cut ones too.
``interior``
    Eq. (10) only in interior cells, those whose face neighbours all hold points (a face on the edge of the grid misses
    none); 1 elsewhere.  (Ours.)
``overlap``
    The same by overlap of domains and cells, :math:`W_p = \sum_e W_e V_{pe} / V_p` with
    :math:`W_e = V_e / \sum_q V_{qe}` in interior cells: continuous when a point crosses a face.  (Ours.)
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy import ndarray

from . import shapes
from .checks import check_choice
from .grid import Grid

WEIGHTS = ("one", "eq10", "interior", "overlap")


def weights(name: str, grid: Grid, index: ndarray, x: ndarray, volume: ndarray, ring: bool,
            length: ndarray | None = None) -> ndarray:
    """Weights ``(n,)`` of points in the cells ``index (dim, n)``.

    Parameters
    ----------
    name
        One of ``one``, ``eq10``, ``interior``, ``overlap``.
    ring
        Whether volumes are ring volumes per radian.
    length
        Edges of the domains, ``(dim, n)``; only ``overlap`` needs them.

    Raises
    ------
    ValueError
        If the name is unknown, or ``overlap`` has no domains.
    """
    check_choice("weights", name, WEIGHTS)
    if name == "one":
        return np.ones(len(volume))
    if name == "overlap":
        return _by_overlap(grid, index, x, volume, ring, length)
    cell = np.ravel_multi_index(tuple(index), grid.cells.shape)
    ratio = cell_volumes(grid, ring).ravel()[cell] / np.bincount(cell, weights=volume)[cell]
    return np.where((name == "eq10") | interior(grid.occupied(index)).ravel()[cell], ratio, 1.0)


def cell_volumes(grid: Grid, ring: bool) -> ndarray:
    """Volume of every cell, one index per axis; per radian if ``ring``."""
    steps = list(grid.steps)
    if ring:
        steps[0] = steps[0] * (grid.axes[0][1:] + grid.axes[0][:-1]) / 2
    return np.prod(np.meshgrid(*steps, indexing="ij"), axis=0)


def interior(occupied: ndarray) -> ndarray:
    """Occupied cells whose face neighbours are all occupied; beyond the grid there is nothing to miss."""
    inside = occupied.copy()
    for axis, size in enumerate(occupied.shape):
        padded = np.pad(occupied, [(int(k == axis),) * 2 for k in range(occupied.ndim)], constant_values=True)
        inside &= np.take(padded, range(size), axis) & np.take(padded, range(2, size + 2), axis)
    return inside


def _by_overlap(grid: Grid, index: ndarray, x: ndarray, volume: ndarray, ring: bool, length: ndarray | None) -> ndarray:
    if length is None:
        raise ValueError("weights: 'overlap' needs the domains of the points; give the particles a length (dim, n).")
    grid.check_reach(x, index, length, "clip")
    share, cell = zip(*(_shares(grid, k, index[k], x[k], length[k]) for k in range(grid.dim)))
    inside = interior(grid.occupied(index)).ravel()
    held = np.zeros(grid.cells.size)
    combined = []
    for piece in itertools.product(range(3), repeat=grid.dim):
        host = np.ravel_multi_index([cell[k][j] for k, j in enumerate(piece)], grid.cells.shape)
        part = np.prod([share[k][j] for k, j in enumerate(piece)], axis=0)
        combined.append((host, part))
        held += np.bincount(host, weights=part * volume, minlength=held.size)
    factor = np.ones(held.size)
    factor[inside] = cell_volumes(grid, ring).ravel()[inside] / held[inside]
    return np.sum([part * factor[host] for host, part in combined], axis=0)


def _shares(grid: Grid, k: int, cell: ndarray, x: ndarray, length: ndarray) -> tuple[ndarray, ndarray]:
    """Share of each domain in three cells along one axis, and these cells (beyond the grid: the last one)."""
    share, _ = shapes.pieces(x, length / 2, grid.knots(k, cell))
    return share, np.clip(cell + np.arange(-1, 2)[:, None], 0, len(grid.steps[k]) - 1)
