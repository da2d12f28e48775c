"""Sums over points of products of functions at pairs of nodes: what a stiffness is made of."""

from __future__ import annotations

import itertools

import numpy as np
from numpy import ndarray
from scipy.sparse import dia_array

from ..grid import scatter_add
from .operators import Operators

ROOM = 2 ** 17      # numbers that are summed at once
MOST = 16           # points in a group, lest one crowded cell fill up the rows of all others


class Couplings:
    r"""The sums :math:`\sum_p w_p\, a_I(x_p)\, b_J(x_p)` for nodes :math:`I` of one stencil and :math:`J` of another.

    Points that see the same nodes form groups, and sums over a group are a product of small dense matrices.  As nodes
    only meet others within a fixed reach, the sums have their places in a table *node J x offset of node I*.

    Parameters
    ----------
    force, strain
        Operators of the two stencils.
    """

    def __init__(self, force: Operators, strain: Operators):
        self.force, self.strain = force, strain
        ours, theirs, shape = force, strain, force.shape
        self.nnodes, dim = int(np.prod(shape)), len(shape)
        self.stride = np.cumprod((1, *shape[:0:-1]))[::-1]
        key = self.stride @ ours.base * self.nnodes + self.stride @ theirs.base
        self.order = np.argsort(key, kind="stable")
        key = key[self.order]
        fresh, number = np.append(True, key[1:] != key[:-1]), np.arange(len(key))
        number -= np.maximum.accumulate(np.where(fresh, number, 0))
        self.begin = np.flatnonzero(number % MOST == 0)
        self.count = np.diff(self.begin, append=len(key))
        first = self.order[self.begin]
        shift = (ours.base - theirs.base)[:, first]
        self.reach = int(max(shift.max() + ours.width, theirs.width - shift.min())) - 1
        self.span = 2 * self.reach + 1
        power = self.span ** np.arange(dim)[::-1]
        rows, columns = (power @ np.indices((table.width,) * dim).reshape(dim, -1) for table in (ours, theirs))
        self.pair = rows[:, None] - columns
        self.start = strain.places[first].astype(np.int64) * self.span ** dim + (power @ (shift + self.reach))[:, None]

    @property
    def size(self) -> int:
        """Number of places in the table."""
        return self.nnodes * self.span ** len(self.stride)

    def sums(self, weight: ndarray, ours: list[ndarray], theirs: list[ndarray]) -> ndarray:
        """Sums for each of our tables ``(n, K**dim)`` with each of theirs, ``(len(ours), len(theirs), size)``."""
        out = np.zeros((len(ours), len(theirs), self.size))
        right = np.hstack(theirs)
        left = right if ours is theirs else np.hstack(ours)
        size = max(1, ROOM // (self.pair.size * len(ours) * len(theirs)))
        for groups in (slice(start, start + size) for start in range(0, len(self.begin), size)):
            points, there = self._members(groups)
            second = right[points]
            first = second if left is right else left[points]
            product = (first * (weight[points] * there)[:, :, None]).transpose(0, 2, 1) @ second
            product = product.reshape(len(points), len(ours), len(self.pair), len(theirs), -1)
            place = self.start[groups, None] + self.pair
            for a, b in itertools.product(range(len(ours)), range(len(theirs))):
                scatter_add(out[a, b], place, product[:, a, :, b])
        return out

    def _members(self, groups: slice) -> tuple[ndarray, ndarray]:
        """Points of some groups, ``(groups, most)``, and which are there; others fill up the rows of small groups."""
        count = self.count[groups, None]
        number = np.arange(count.max())
        return self.order[np.minimum(self.begin[groups, None] + number, len(self.order) - 1)], number < count

    def matrix(self, table: ndarray) -> dia_array:
        """A table as a matrix, ``(nnodes, nnodes)``."""
        dim = len(self.stride)
        step = self.stride @ (self.reach - np.indices((self.span,) * dim).reshape(dim, -1))
        offsets, inverse = np.unique(step, return_inverse=True)     # on few nodes, one may be that of several offsets
        diagonals = np.zeros((len(offsets), self.nnodes))
        for row, values in zip(inverse, table.reshape(self.nnodes, -1).T):
            diagonals[row] += values
        return dia_array((diagonals, offsets), shape=(self.nnodes, self.nnodes))

