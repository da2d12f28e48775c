"""The grid of one explicit step: stencils, lumped masses, and what planes and light nodes do to nodal sums."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from ..basis import Method, ParticleBasis
from ..grid import Edges, Grid, Stencil, available_sides

CUTOFF = 1e-8    # a node is active if its lumped mass exceeds this share of the largest


class Nodes:
    """What an explicit step knows of its grid, made anew in every step around the body.

    Sums at nodes behind a fixed plane fold onto their mirror images, and those at light nodes go to the active nodes
    around them; velocities come back the same way.  Both maps are transposes of each other, so momentum is kept.

    Attributes
    ----------
    grid
        The part of the mesh around the body.
    mass
        ``(nnodes,)``; lumped mass of active nodes, zero elsewhere.
    active
        ``(nnodes,)``; which nodes have an equation of motion.
    fixed
        ``(dim, nnodes)``; which components stand still.
    """

    def __init__(self, full: Grid, x: ndarray, mass: ndarray, length: ndarray | None, method: Method, edges: Edges,
                 planes: Sequence[Any]):
        index = full.locate(x)
        self.grid = grid = full.window(index)
        self.index = grid.locate(x)
        self.mapping = self._stencil(method.mass, x, length, edges, None)
        self.mirrors = [mirror for plane in planes for mirror in mirrors(grid, plane)]
        self.fixed = np.any([plane.fixes(grid) for plane in planes] or [np.zeros((grid.dim, grid.nnodes))], axis=0)
        total = self.mapping.to_nodes(mass)
        for inside, outside, _ in self.mirrors:
            total[inside] += total[outside]
            total[outside] = 0
        self.active = total > CUTOFF * total.max()
        self.light = self._light(total)
        self.mass = self._collect(total[None], mirror=False)[0]
        stencils = {method.mass: self.mapping}
        others = {method.strain, method.force} - {method.mass}
        if others:
            active = self.active | self._mirrored()
            sides = available_sides(grid.occupied(self.index), active.reshape(grid.vertices.shape))
            stencils |= {basis: self._stencil(basis, x, length, edges, sides) for basis in others}
        self.strain, self.force = stencils[method.strain], stencils[method.force]

    def _stencil(self, basis: type[ParticleBasis], x: ndarray, length: ndarray | None, edges: Edges,
                 sides: ndarray | None) -> Stencil:
        return basis.stencil_of(self.grid, x, self.index, length, edges, sides)

    def _mirrored(self) -> ndarray:
        mask = np.zeros(self.grid.nnodes, dtype=bool)
        for _, outside, _ in self.mirrors:
            mask[outside] = True
        return mask

    def _light(self, total: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Light nodes, the active nodes around them, and the equal shares these take."""
        nodes = np.flatnonzero((total > 0) & ~self.active)
        shape = np.array(self.grid.vertices.shape)[:, None]
        around = np.reshape(np.unravel_index(nodes, self.grid.vertices.shape), (len(shape), -1))
        pairs = []
        for offset in itertools.product((-1, 0, 1), repeat=self.grid.dim):
            other = around + np.array(offset)[:, None]
            inside = ((other >= 0) & (other < shape)).all(axis=0)
            target = np.ravel_multi_index(tuple(np.clip(other, 0, shape - 1).astype(int)), self.grid.vertices.shape)
            take = inside & self.active[target]
            pairs.append(np.stack([nodes[take], target[take]]))
        source, target = np.concatenate(pairs, axis=1)
        count = np.bincount(source, minlength=self.grid.nnodes)
        return source, target, 1 / count[source]

    def _collect(self, nodal: ndarray, mirror: bool = True) -> ndarray:
        """Fold nodal sums ``(k, nnodes)`` onto active nodes, in place."""
        if mirror:
            for inside, outside, signs in self.mirrors:
                nodal[:, inside] += signs * nodal[:, outside]
                nodal[:, outside] = 0
        source, target, share = self.light
        for row in nodal:
            np.add.at(row, target, share * row[source])
        nodal[:, source] = 0
        return nodal

    def to_nodes(self, amount: ndarray) -> ndarray:
        """Share point vectors ``(dim, n)`` among the active nodes."""
        return self._collect(np.stack([self.mapping.to_nodes(row) for row in amount]))

    def collect(self, force: ndarray) -> ndarray:
        """Forces on the active nodes, from nodal sums ``(dim, nnodes)``."""
        return self._collect(force)

    def velocity(self, momentum: ndarray) -> ndarray:
        """Momentum over mass with fixed components standing still, everywhere points may read."""
        out = np.divide(momentum, self.mass, out=np.zeros_like(momentum), where=self.active)
        out[self.fixed] = 0
        source, target, share = self.light
        for row in out:
            np.add.at(row, source, share * row[target])
        for inside, outside, signs in self.mirrors[::-1]:
            out[:, outside] = signs * out[:, inside]
        return out


def mirrors(grid: Grid, plane: Any) -> list[tuple[ndarray, ndarray, ndarray]]:
    """Nodes next to a plane, their images right behind it, and the sign each component takes."""
    axis = grid.axes[plane.axis]
    on = int(np.abs(axis - plane.at).argmin())
    inside, outside = on - plane.side, on + plane.side
    if abs(axis[on] - plane.at) > 1e-9 * np.diff(axis).min() or not (0 <= min(inside, outside)
                                                                     and max(inside, outside) < len(axis)):
        return []
    numbers = np.arange(grid.nnodes).reshape(grid.vertices.shape)
    signs = np.array([[-1.0 if i in plane.components else 1.0] for i in range(grid.dim)])
    return [(np.take(numbers, inside, plane.axis).ravel(), np.take(numbers, outside, plane.axis).ravel(), signs)]
