"""Masks over the cells and nodes of a grid, with one index per axis."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from skfem import Mesh


def cell_mask(mesh: Mesh, cells: Any) -> ndarray:
    """Mask over the cells of a mesh from a mask or anything that ``mesh.normalize_elements`` takes."""
    chosen = np.asarray(cells)
    if chosen.dtype != bool:
        chosen = mesh.normalize_elements(cells)
    is_mask, size = chosen.dtype == bool, mesh.nelements
    if not (len(chosen) == size if is_mask else ((chosen >= 0) & (chosen < size)).all()):
        raise ValueError(f"occupied: got cells or a mask that do not fit {size} cells; give cell numbers from 0 to "
                         f"{size - 1}, or a mask of that length.")
    mask = np.zeros(mesh.nelements, dtype=bool)
    mask[chosen] = True
    return mask


def whole_cells(nodes: ndarray) -> ndarray:
    """Mask over the cells whose nodes are all marked; ``nodes`` is a mask with one index per axis, as the result."""
    whole = np.ones([size - 1 for size in nodes.shape], dtype=bool)
    for corner in itertools.product((0, 1), repeat=nodes.ndim):
        whole &= nodes[tuple(slice(c, c + size) for c, size in zip(corner, whole.shape))]
    return whole


def touched_cells(nodes: ndarray) -> ndarray:
    """Mask over the cells with a marked node; ``nodes`` is a mask with one index per axis, as the result."""
    return ~whole_cells(~nodes)


def wider(mask: ndarray) -> ndarray:
    """A mask and all that is next to it, diagonally too; one index per axis."""
    for axis, size in enumerate(mask.shape):
        padded = np.pad(mask, [(int(k == axis),) * 2 for k in range(mask.ndim)])
        mask = mask | np.take(padded, range(size), axis) | np.take(padded, range(2, size + 2), axis)
    return mask


def corner_nodes(cells: ndarray) -> ndarray:
    """Mask over the nodes that belong to a marked cell, one index per axis; ``cells`` is a mask too."""
    nodes = np.zeros([size + 1 for size in cells.shape], dtype=bool)
    for corner in itertools.product((0, 1), repeat=cells.ndim):
        nodes[tuple(slice(c, c + size) for c, size in zip(corner, cells.shape))] |= cells
    return nodes


def available_sides(occupied: ndarray, active: ndarray | None = None) -> ndarray:
    """Which neighbours a patch may reach into: ``(2, dim, *cells)``, side 0 towards smaller coordinates.

    A side is available if its cell is occupied and all nodes of that cell are active.  Where an edge or corner cell of
    the patch is missing, all sides involved are dropped, judged at once on the initial masks: so the answer does not
    depend on an order of axes, and the patch stays a product of intervals.

    Parameters
    ----------
    occupied
        Cells that hold points, one index per axis.
    active
        Nodes that carry mass, one index per axis; all of them if not given.
    """
    dim = occupied.ndim
    usable = occupied.copy()
    if active is not None:
        usable &= whole_cells(active)
    padded = np.pad(usable, 1)

    def shifted(offset: Sequence[int]) -> ndarray:
        return padded[tuple(slice(1 + o, 1 + o + size) for o, size in zip(offset, usable.shape))]

    unit = np.eye(dim, dtype=int)
    first = np.stack([np.stack([shifted(sign * unit[k]) for k in range(dim)]) for sign in (-1, 1)])
    sides = first.copy()
    for offset in itertools.product((-1, 0, 1), repeat=dim):
        involved = [((1 + o) // 2, k) for k, o in enumerate(offset) if o]
        if len(involved) > 1:
            missing = np.logical_and.reduce([first[side] for side in involved]) & ~shifted(offset)
            for side in involved:
                sides[side] &= ~missing
    return sides
