"""Find the axes of an axis-aligned mesh, whatever its numbering."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy import ndarray
from skfem import Mesh, MeshHex1, MeshLine1, MeshQuad1

from .stencil import chunks

SAME = 1e-10    # nodes whose coordinates differ by less, as a share of the mesh, are on one line


def view(mesh: Mesh) -> tuple[tuple[ndarray, ...], ndarray, ndarray]:
    """Axes of a mesh, and where its vertices and cells stand, ``(axes, vertices, cells)``.

    Raises
    ------
    ValueError
        If the mesh is of another kind, not axis-aligned, or not a full box.
    """
    if not isinstance(mesh, (MeshLine1, MeshQuad1, MeshHex1)) or not _all_used(mesh):
        raise ValueError(f"mesh: got {type(mesh).__name__}, expected an axis-aligned MeshLine1, MeshQuad1 or MeshHex1 "
                         "without unused vertices; other meshes work with ParticleBasis only.")
    axes = _axes(mesh.p)
    shape = [len(axis) for axis in axes]
    full = min(shape) > 1 and (np.prod(shape), np.prod(np.subtract(shape, 1))) == (mesh.nvertices, mesh.nelements)
    tables = _tables(mesh, axes) if full else None
    if tables is None:
        raise ValueError(f"mesh: got a {type(mesh).__name__} with {mesh.nelements} cells that do not make a full box "
                         "of axis-aligned cells; use init_tensor or a refined unit mesh (empty cells cost next to "
                         "nothing).")
    return axes, *tables


def _all_used(mesh: Mesh) -> bool:
    """Whether every vertex belongs to a cell."""
    used = np.zeros(mesh.p.shape[1], dtype=bool)
    used[mesh.t] = True
    return bool(used.all())


def _tables(mesh: Mesh, axes: Sequence[ndarray]) -> tuple[ndarray, ndarray] | None:
    """Where the vertices and the cells of a mesh stand; None if there are others."""
    shape = [len(axis) for axis in axes]
    vertices, cells = np.full(shape, -1, dtype=np.int32), np.full(np.subtract(shape, 1), -1, dtype=np.int32)
    index = np.empty(mesh.p.shape, dtype=np.int32)
    for part in chunks(mesh.nvertices):
        for axis, row, place in zip(axes, mesh.p[:, part], index[:, part]):
            place[:] = np.searchsorted((axis[1:] + axis[:-1]) / 2, row)
            if (np.abs(axis[place] - row) > SAME * (axis[-1] - axis[0])).any():
                return None
        vertices[tuple(index[:, part])] = np.arange(part.start, part.stop)
    for part in chunks(mesh.nelements):
        corners = index[:, mesh.t[:, part]]
        low = corners.min(axis=1)
        if (corners.max(axis=1) != low + 1).any():
            return None
        cells[tuple(low)] = np.arange(part.start, part.stop)
    return (vertices, cells) if min(vertices.min(), cells.min()) >= 0 else None


def _axes(p: ndarray) -> tuple[ndarray, ...]:
    """Coordinates of the nodes along the edges that leave the lowest corner; equal up to rounding are one node."""
    low = p.min(axis=1)
    tolerance = SAME * (p.max(axis=1) - low)
    first = [row <= start + slack for row, start, slack in zip(p, low, tolerance)]
    axes = []
    for k, row in enumerate(p):
        values = np.unique(row[np.logical_and.reduce([on for j, on in enumerate(first) if j != k])])
        axes.append(values[np.diff(values, prepend=-np.inf) > tolerance[k]])
    return tuple(axes)
