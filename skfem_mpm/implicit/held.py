"""Whether planes and walls hold every part of a body; what only the soft floor or rounding would hold has no answer."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import block_array, csr_array, vstack
from scipy.sparse.csgraph import connected_components

from ..checks import NotConvergedError, position, whereabouts
from ..kinematics.blocks import volume_ratio
from ..particles import Particles
from ..support import Support

MOST = 0.8      # share of a cell that a point may come to fill
LOOSE = 1e-9    # a rigid motion is free if this share of the best held one is all that boundaries see of it


class Parts:
    """The parts of a body that nothing on the grid links.

    Points of two parts have no node in common from which both take their strain, or none on which both push.

    Attributes
    ----------
    found
        For strain and force, or for both if they use the same functions: the number of its part for each point, and for
        each solved node.
    """

    def __init__(self, support: Support):
        cells = support.occupied
        if hasattr(support, "cover"):
            cells = cells | support.cover.covered
        one = np.zeros(support.particles.n, dtype=int), np.zeros(len(support.solved_nodes), dtype=int)
        self.found = [one]
        if not _is_box(cells) and _linked(_of_cells(support, cells), 0)[1].any():   # wider functions may yet link them
            bases = dict.fromkeys((support.method.strain, support.method.force))
            self.found = [_linked(_links(support, cells, basis), len(one[0])) for basis in bases]

    def check_held(self, support: Support, rows: csr_array) -> None:
        """Refuse a part that may move without strain although planes, and constraint rows, hold the body.

        Raises
        ------
        NotConvergedError
            Naming a point of the part and how it can move.
        """
        for of_points, of_nodes in self.found:
            for part in np.unique(of_points):
                _check_part(support, rows, of_nodes == part, int(np.flatnonzero(of_points == part)[0]))

    def warn_if_apart(self, before: Parts | None, support: Support, step: int) -> None:
        """Warn of points that were in one part before and are in two now."""
        x = support.particles.x
        for (old, _), (new, _) in zip(2 * before.found if before else (), self.found):
            for part in np.unique(old):
                points = np.flatnonzero(old == part)
                other = points[new[points] != new[points[0]]]
                if len(other):
                    one, two = (f"{point} at {position(x, point)}" for point in (points[0], other[0]))
                    warnings.warn(
                        f"step {step}: the body comes apart: points {one} and {two} have no cell left that links them, "
                        "and no longer pull at each other.  If the material is not meant to break there, use more "
                        "points, a coarser grid, or a method with domains that stretch.", UserWarning, stacklevel=3)
                    return


def warn_of_idle(support: Support) -> None:
    """Warn of planes that hold no node of the body."""
    for plane in support.planes:
        if not plane.fixes(support.grid)[:, support.solved_nodes].any():
            warnings.warn(f"plane {plane.name!r}: no node of the body is on the plane at {plane.at:g} along axis "
                          f"{plane.axis}, so it holds nothing yet; if it should, put it on a grid line that the body "
                          "reaches.", UserWarning, stacklevel=5)


def warn_of_bare_cells(support: Support) -> None:
    """Warn of cells with one point each, which has no say in some modes of a quad or hex, unless domains reach on."""
    cells = int(support.occupied.sum())
    if support.grid.dim > 1 and support.particles.n == cells and not support.method.force.reads_domains:
        warnings.warn("particles: each cell holds one point, and nothing but the soft floor some modes of its nodes; "
                      "stress may be of no use.  Take more points, a method with domains such as 'gimp', or ghost=0.1.",
                      UserWarning, stacklevel=5)


def warn_of_folds(support: Support, u: ndarray, step: int) -> None:
    """Warn of cells that hold points and that displacements ``u (dim, nnodes)`` turn inside out, though no point."""
    grid, index = support.grid, np.stack(np.nonzero(support.occupied))
    middle = np.stack([(axis[i] + axis[i + 1]) / 2 for axis, i in zip(grid.axes, index)])
    stencil = grid.linear(middle, index)
    gradient = np.einsum("ikn,jkn->ijn", u[:, stencil.nodes()], stencil.gradient()).reshape(grid.dim ** 2, -1)
    folded = np.flatnonzero(~(volume_ratio(gradient, grid.dim) > 0))
    if len(folded):
        warnings.warn(f"step {step}: the cell around {position(middle, folded[0])} is turned inside out, and the "
                      "points in it do not feel that; what they say is of no use there.  Try ghost=0.1, smaller steps, "
                      "or more points.", UserWarning, stacklevel=5)


def warn_of_too_few(support: Support, old: Particles, volume: ndarray, step: int) -> None:
    """Warn where points have come to stand for most of a cell each: stress between them is then lost bit by bit."""
    grid = support.grid
    cell = np.prod([size[i] for size, i in zip(grid.steps, support.index)], axis=0)
    cell = cell * old.x[0] if old.kinematics.hoop else cell
    share = volume / cell
    if (old.volume / cell).max() <= MOST < share.max():
        point = int(share.argmax())
        warnings.warn(f"step {step}: {whereabouts(old.x, point)} has been stretched to "
                      f"{share[point]:.2g} of its cell, more than {MOST:g}; points are getting too few to fill their "
                      "cells, and stress is lost.  Use more points, a coarser grid, or domains='stretched' with a "
                      "method that has domains.", UserWarning, stacklevel=5)


def _check_part(support: Support, rows: csr_array, nodes: ndarray, point: int) -> None:
    """Refuse free motion of some of the solved nodes."""
    motions, names = _rigid(support, nodes)
    if not names:
        return
    seen = np.concatenate([motions[~support.free], rows @ motions, np.zeros((len(names),) * 2)])
    _, size, ways = np.linalg.svd(seen, full_matrices=False)
    free = size <= LOOSE * max(size[0], 1 / np.sqrt(nodes.sum()))
    if free.any():
        way = "" if free.all() else " " + names[int(abs(ways[-1]).argmax())]
        raise NotConvergedError(
            f"boundary: got a part of the body, with {whereabouts(support.particles.x, point)}, that nothing "
            f"holds{way}; expected planes and walls that hold every part.  Add a FixedPlane or a Wall there, or "
            "give dt: with inertia a body may be free.")


def _linked(links: csr_array, points: int) -> tuple[ndarray, ndarray]:
    """Parts of the points, which the first rows are of, and of the nodes, a column each; numbered from 0."""
    _, found = connected_components(block_array([[None, links], [links.T, None]]), directed=False)
    return found[:points], found[links.shape[0]:]


def _is_box(cells: ndarray) -> bool:
    """Whether marked cells fill a box: a quick look that spares most bodies the search for parts."""
    return bool(cells.sum() == np.prod([np.ptp(along) + 1 for along in np.nonzero(cells)]))


def _links(support: Support, cells: ndarray, basis: Any) -> csr_array:
    """Which solved nodes points read by a basis, then those that cells have; a row for each."""
    stencil = support.stencil(basis)
    felt = (stencil.value() != 0) | (stencil.gradient() != 0).any(axis=0)
    return csr_array(vstack([_incidence(stencil.nodes(), felt, support), _of_cells(support, cells)]))


def _of_cells(support: Support, cells: ndarray) -> csr_array:
    """Which solved nodes cells have, themselves or by nodes that follow; a row for each cell."""
    corners = np.indices((2,) * cells.ndim).reshape(cells.ndim, -1, 1)
    nodes = np.ravel_multi_index(tuple(np.stack(np.nonzero(cells))[:, None] + corners), support.grid.vertices.shape)
    return _incidence(nodes, np.ones(nodes.shape, dtype=bool), support)


def _incidence(nodes: ndarray, felt: ndarray, support: Support) -> csr_array:
    """Rows over the solved nodes, of those among ``nodes (K, n)`` that are felt, or that these follow."""
    dim = support.grid.dim
    place = support.number[0, nodes] // dim
    felt = felt & support.known[nodes]
    row = np.broadcast_to(np.arange(nodes.shape[1]), nodes.shape)
    shape = (nodes.shape[1], support.transfer.shape[0] // dim)
    known = csr_array((np.ones(felt.sum()), (row[felt], place[felt])), shape=shape)
    return csr_array(known @ abs(support.transfer[::dim, ::dim])) if support.slaved else known


def _rigid(support: Support, nodes: ndarray) -> tuple[ndarray, list[str]]:
    """Motions without strain of some solved nodes, as columns over the solved components, and how they are called."""
    dim, hoop = support.grid.dim, support.particles.kinematics.hoop
    index = np.unravel_index(support.solved_nodes, support.grid.vertices.shape)
    x = np.stack([axis[i] for axis, i in zip(support.grid.axes, index)])
    away = np.where(nodes, x - x[:, nodes].mean(axis=1, keepdims=True), 0.0)
    motions, names = [], []
    for k in range(int(hoop), dim):
        motions.append(np.outer(np.eye(dim)[k], nodes))
        names.append(f"along axis {k}")
    for i in range(dim if not hoop else 0):
        for j in range(i + 1, dim):
            turn = np.zeros(x.shape)
            turn[i], turn[j] = -away[j], away[i]
            motions.append(turn)
            names.append("against rotation" if dim == 2 else f"against rotation in the plane of axes {i} and {j}")
    columns = [motion.T.ravel() / np.linalg.norm(motion) for motion in motions]
    return np.stack(columns, axis=1) if columns else np.zeros((nodes.size * dim, 0)), names
