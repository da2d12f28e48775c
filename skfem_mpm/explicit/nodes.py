"""The grid of one explicit step: operators, lumped masses, and what planes and light nodes do to nodal sums."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..basis import Method, ParticleBasis
from ..grid import Edges, Grid, Stencil, available_sides, corner_nodes, wider
from ..kinematics import Kinematics
from .operators import Operators

CUTOFF = 1e-8    # a node is active if its lumped mass exceeds this share of the largest, on the grid or around it
MARGIN = 2       # how many cells wider than the body the window of the grid is


class Nodes:
    """What an explicit step knows of its grid, made anew in every step around the body.

    Sums at nodes behind a fixed plane fold onto their mirror images, and those at light nodes go to the active nodes
    around them; velocities come back the same way.  Both maps are transposes of each other, so momentum is kept.

    A node is light if points may read it and it is not active, even without any mass: a point on a face sees the far
    nodes by their slopes alone.

    Parameters
    ----------
    ring
        Whether the radius is part of the means over domains.

    Attributes
    ----------
    grid
        The part of the mesh around the body.
    mass
        ``(nnodes,)``; lumped mass of active nodes, zero elsewhere.
    lumped
        ``(nnodes,)``; lumped mass as points share it, before planes and light nodes hand theirs on.
    active
        ``(nnodes,)``; which nodes have an equation of motion.
    fixed
        ``(dim, nnodes)``; which components stand still.
    mapping, strain, force
        Operators of the three bases of the method.
    """

    def __init__(self, full: Grid, kinematics: Kinematics, x: ndarray, mass: ndarray, length: ndarray | None,
                 method: Method, edges: Edges, planes: Sequence[Any], ring: bool = False):
        index = full.locate(x)
        self.grid = grid = full.window(index, MARGIN)
        self.index = index - np.maximum(index.min(axis=1, keepdims=True) - MARGIN, 0)
        self.kinematics, self.x, self.length, self.edges, self.ring = kinematics, x, length, edges, ring
        self.mapping = self._operators(method.mass, None)
        self.mirrors = mirrors(grid, planes)
        self.fixed = np.any([plane.fixes(grid) for plane in planes] or [np.zeros((grid.dim, grid.nnodes))], axis=0)
        self.lumped = self.mapping.to_nodes(mass[None])[0]
        total = self.fold(self.lumped[None].copy(), signed=False)[0]
        self.active = self._carries(total)
        self._lighten(method.mass.reads_domains)
        self.mass = self.collect(total[None])[0]
        found = {method.mass: self.mapping}
        others = {method.strain, method.force} - {method.mass}
        if others:
            sides = available_sides(self.occupied, self.active.reshape(grid.vertices.shape))
            found |= {basis: self._operators(basis, sides) for basis in others}
        self.strain, self.force = found[method.strain], found[method.force]

    def _operators(self, basis: type[ParticleBasis], sides: ndarray | None) -> Operators:
        stencil: Stencil = basis.stencil_of(self.grid, self.x, self.index, self.length, self.edges, sides,
                                            ring=self.ring)
        return Operators(self.kinematics, stencil, self.x[0])

    def integrated(self, volume: ndarray) -> ndarray:
        """What stress is multiplied with to make it force: the volumes of the points."""
        return volume

    # -- which nodes carry, and which follow -------------------------------------------------------------------------

    def _around(self, nodes: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Pairs of these nodes and those around them, themselves included, and along how many axes they differ."""
        shape = np.array(self.grid.vertices.shape)[:, None]
        place = np.reshape(np.unravel_index(nodes, self.grid.vertices.shape), (len(shape), -1))
        pairs = []
        for offset in itertools.product((-1, 0, 1), repeat=self.grid.dim):
            other = place + np.array(offset)[:, None]
            inside = ((other >= 0) & (other < shape)).all(axis=0)
            pairs.append((nodes[inside], np.ravel_multi_index(tuple(other[:, inside]), self.grid.vertices.shape),
                          np.full(inside.sum(), np.count_nonzero(offset))))
        source, target, away = zip(*pairs)
        return np.concatenate(source), np.concatenate(target), np.concatenate(away)

    def _carries(self, total: ndarray) -> ndarray:
        """Active nodes; one that is light on the whole grid may be heavy where it is, in a body of its own."""
        active = total > CUTOFF * total.max()
        doubtful = np.flatnonzero((total > 0) & ~active)
        source, target, _ = self._around(doubtful)
        largest = np.zeros(len(total))
        np.maximum.at(largest, source, total[target])
        active[doubtful] = total[doubtful] > CUTOFF * largest[doubtful]
        return active

    def _lighten(self, reads_domains: bool) -> None:
        """Light nodes, and the equal shares that active nodes around them take: those across a cell's face, if any.

        Those across edges and corners are further away, and an uneven number of them would shear what is stretched.
        """
        self.occupied = self.grid.occupied(self.index)
        read = corner_nodes(wider(self.occupied) if reads_domains else self.occupied).ravel()
        for inside, outside, _ in self.mirrors:                         # who reads an image reads what it shows
            read[inside] |= read[outside]
            read[outside] = False
        pairs = self._around(np.flatnonzero(read & ~self.active))
        source, target, away = (each[self.active[pairs[1]]] for each in pairs)
        nearest = np.full(len(self.active), self.grid.dim)
        np.minimum.at(nearest, source, away)
        source, target = source[away == nearest[source]], target[away == nearest[source]]
        self.light, row, count = np.unique(source, return_inverse=True, return_counts=True)
        self.share = csr_array((1 / count[row], (row, target)), shape=(len(self.light), self.grid.nnodes))

    def levers(self) -> list[csr_array]:
        r"""For each axis :math:`N_I (x_I - x_p)`, ``(n, nnodes)``.

        Positions are taken from the middle of the point's mass, :math:`\sum_I N_I x_I / \sum_I N_I`, so that sums keep
        momentum: on rings and where a domain is cut that is not the point.
        """
        value, dim, shape = self.mapping.value, self.grid.dim, self.grid.vertices.shape
        width, out = len(value.data) // len(self.x[0]), []
        for j, axis in enumerate(self.grid.axes):
            place = np.broadcast_to(axis.reshape([-1 if k == j else 1 for k in range(dim)]), shape).ravel()
            lever = place[value.indices] - np.repeat(self._middle(j), width)
            out.append(csr_array((value.data * lever, value.indices, value.indptr), shape=value.shape))
        return out

    @cached_property
    def fitted(self) -> Operators:
        r"""Mapping whose slopes are those of the affine field that comes nearest to what a point sees.

        :math:`\sum_I N_I (x_I - x_p)_l\, u_I / \sum_I N_I (x_I - x_p)_l^2`, least squares with the weights
        :math:`N_I`.  What points hand back with :meth:`tilted` is then a projection: none is more than there was.  With
        two nodes along an axis a line goes through both, and these are the slopes of the functions.
        """
        stencil = self.mapping.stencil
        if stencil.w.shape[2] == 2:
            return self.mapping
        w, moments = stencil.w.copy(), self.moments()
        for j, moment in enumerate(moments):
            value = w[j, 0]
            part = value * (self._seen(j) - self._middle(j))
            part -= value * (part.sum(axis=0) / value.sum(axis=0))       # the middle is rounded: what is common stays
            w[j, 1] = np.divide(part, moment, out=np.zeros_like(part), where=moment > 0)
        return Operators(self.kinematics, replace(stencil, w=w), self.x[0])

    def moments(self) -> ndarray:
        r""":math:`\sum_I N_I (x_I - x_p)_l^2` along each axis, ``(dim, n)``."""
        w = self.mapping.stencil.w
        return np.stack([(w[j, 0] * (self._seen(j) - self._middle(j)) ** 2).sum(axis=0) for j in range(len(w))])

    def tilted(self, amounts: ndarray) -> ndarray:
        r"""Nodal sums :math:`\sum_p N_I a_p (x_I - x_p)` of point gradients ``(dim * dim, n)``."""
        levers, dim = self.levers(), self.grid.dim
        return np.stack([sum(lever.T @ amounts[i * dim + j] for j, lever in enumerate(levers)) for i in range(dim)])

    def _middle(self, j: int) -> ndarray:
        """Coordinate of the middle of the points' masses along an axis, as their functions share them."""
        value = self.mapping.stencil.w[j, 0]
        return self.x[j] + (value * (self._seen(j) - self.x[j])).sum(axis=0) / value.sum(axis=0)

    def _seen(self, j: int) -> ndarray:
        """Coordinates along an axis of the nodes that points see, ``(K, n)``."""
        stencil, axis = self.mapping.stencil, self.grid.axes[j]
        return axis[np.clip(stencil.base[j] + np.arange(stencil.w.shape[2])[:, None], 0, len(axis) - 1)]

    # -- sums and velocities -----------------------------------------------------------------------------------------

    def fold(self, nodal: ndarray, signed: bool = True) -> ndarray:
        """Take nodal sums ``(k, nnodes)`` behind planes to their mirror images, in place."""
        for inside, outside, signs in self.mirrors:
            nodal[:, inside] += (signs if signed else 1.0) * nodal[:, outside]
            nodal[:, outside] = 0
        return nodal

    def collect(self, nodal: ndarray) -> ndarray:
        """Take nodal sums ``(k, nnodes)`` of light nodes to active ones, in place."""
        if len(self.light):
            for row in nodal:
                row += self.share.T @ row[self.light]
                row[self.light] = 0
        return nodal

    def gather(self, nodal: ndarray, signed: bool = True) -> ndarray:
        """Take nodal sums to the active nodes, in place."""
        return self.collect(self.fold(nodal, signed))

    def spread(self, nodal: ndarray, signed: bool = True) -> ndarray:
        """Nodal numbers wherever points may read, from those of active nodes, in place; transpose of the sums."""
        if len(self.light):
            for row in nodal:
                row[self.light] = self.share @ row
        for inside, outside, signs in self.mirrors[::-1]:
            nodal[:, outside] = (signs if signed else 1.0) * nodal[:, inside]
        return nodal

    def velocity(self, momentum: ndarray) -> ndarray:
        """Momentum over mass with fixed components standing still, everywhere points may read."""
        out = np.divide(momentum, self.mass, out=np.zeros_like(momentum), where=self.active)
        out[self.fixed] = 0
        return self.spread(out)


def mirrored(grid: Grid, planes: Sequence[Any]) -> Grid:
    """The grid with each cell right behind a plane as wide as the one in front: its nodes then are where images are."""
    axes = list(grid.axes)
    for plane in planes:
        axis, beside = axes[plane.axis].copy(), _beside(axes[plane.axis], plane)
        if beside:
            inside, on, outside = beside
            image = 2 * axis[on] - axis[inside]
            if abs(axis[outside] - image) > 1e-9 * np.diff(axis).min():         # equal cells keep their bits
                axis[outside::plane.side] += image - axis[outside]
                axes[plane.axis] = axis
    return Grid(tuple(axes), grid.vertices, grid.cells)


def mirrors(grid: Grid, planes: Sequence[Any]) -> list[tuple[ndarray, ndarray, ndarray]]:
    """Nodes next to planes, their images right behind, and the sign each component takes.

    Planes at one place are one plane, which fixes the components of all.
    """
    fixed: dict[tuple[int, int, int], set[int]] = {}
    for plane in planes:
        beside = _beside(grid.axes[plane.axis], plane)
        if beside:
            fixed.setdefault((plane.axis, beside[0], beside[2]), set()).update(plane.components)
    numbers = np.arange(grid.nnodes).reshape(grid.vertices.shape)
    return [(np.take(numbers, inside, axis).ravel(), np.take(numbers, outside, axis).ravel(),
             np.array([[-1.0 if i in components else 1.0] for i in range(grid.dim)]))
            for (axis, inside, outside), components in fixed.items()]


def _beside(axis: ndarray, plane: Any) -> tuple[int, int, int] | None:
    """The lines of an axis in front of a plane, on it and behind it; none if one of them is not there."""
    on = int(np.abs(axis - plane.at).argmin())
    inside, outside = on - plane.side, on + plane.side
    there = abs(axis[on] - plane.at) <= 1e-9 * np.diff(axis).min()
    return (inside, on, outside) if there and 0 <= min(inside, outside) and max(inside, outside) < len(axis) else None
