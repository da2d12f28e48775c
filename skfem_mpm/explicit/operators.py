"""The operators of a step as sparse matrices, read from a stencil."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..grid import Stencil, chunks, outer
from ..kinematics import Kinematics


class Operators:
    r"""Value :math:`N` and slopes :math:`\partial_l N` of the functions that points see, each made when first needed.

    Sparse twin of :class:`~skfem_mpm.integration.Pair`; nodal arrays are ``(k, nnodes)``.

    Parameters
    ----------
    kinematics
        Which gradient rows there are.
    stencil
        The functions.
    radius
        ``(n,)``; the first coordinate, for the hoop row.
    """

    def __init__(self, kinematics: Kinematics, stencil: Stencil, radius: ndarray):
        self.stencil, self.radius = stencil, radius
        self.base, self.width, self.shape = stencil.base, stencil.w.shape[2], stencil.shape
        self._take_rows(kinematics)

    def _take_rows(self, kinematics: Kinematics) -> None:
        self.dim = len(self.shape)
        self.rows = kinematics.rows(self.dim)
        self.hoop = kinematics.hoop

    @cached_property
    def places(self) -> ndarray:
        """Nodes of each point, ``(n, K**dim)``."""
        out = np.empty((self.stencil.n, self.width ** self.dim), dtype=np.int32)
        for part in chunks(self.stencil.n):
            self.stencil.nodes(part, out=out[part].T)
        return out

    @cached_property
    def _starts(self) -> ndarray:
        return np.arange(0, self.places.size + 1, self.places.shape[1], dtype=np.int32)

    def _matrix(self, table: ndarray) -> csr_array:
        """A table ``(n, K**dim)`` as a matrix ``(n, nnodes)``."""
        shape = len(self.places), int(np.prod(self.shape))
        return csr_array((table.ravel(), self.places.ravel(), self._starts), shape=shape)

    def _matrices(self, slopes: Iterable[int], row: int = 0) -> list[csr_array]:
        """Slopes along these axes at the points, from nodal numbers, ``(n, nnodes)``; values for the axis -1."""
        w, dim = self.stencil.w, self.dim
        tables = {axis: np.empty(self.places.shape) for axis in slopes}
        for part in chunks(self.stencil.n):
            for axis, table in tables.items():
                outer([w[k, 1 if k == axis else row, :, part] for k in range(dim)], out=table[part].T)
        return [self._matrix(table) for table in tables.values()]

    @cached_property
    def value(self) -> csr_array:
        """:math:`N`."""
        return self._matrices([-1])[0]

    @cached_property
    def plain(self) -> csr_array:
        """The same as plain means over domains: on rings :math:`N` is weighted by the radius."""
        return self._matrices([-1], self.stencil.plain)[0] if self.stencil.plain else self.value

    @cached_property
    def slopes(self) -> list[csr_array]:
        r""":math:`\partial_l N` for each axis."""
        return self._matrices(range(self.dim))

    @cached_property
    def matrices(self) -> list[csr_array]:
        """What a gradient is made of, ``(n, nnodes)`` each: slopes along the axes, then value over radius if needed."""
        if not self.hoop:
            return self.slopes
        return self.slopes + [self._matrix(self.plain.data.reshape(self.places.shape) / self.radius[:, None])]

    @cached_property
    def tables(self) -> list[ndarray]:
        """The same as tables ``(n, K**dim)``."""
        return [matrix.data.reshape(self.places.shape) for matrix in self.matrices]

    @property
    def terms(self) -> list[list[tuple[int, int]]]:
        """For each component the gradient rows it takes part in, and through which table."""
        place = [(0, self.dim) if self.hoop and q == self.dim ** 2 else ij for q, ij in enumerate(self.rows)]
        return [[(q, l) for q, (component, l) in enumerate(place) if component == i] for i in range(self.dim)]

    def to_nodes(self, amounts: ndarray) -> ndarray:
        """Share point amounts ``(k, n)`` among the nodes."""
        return np.stack([self.value.T @ row for row in amounts])

    def to_points(self, nodal: ndarray) -> ndarray:
        """Interpolate nodal vectors ``(k, nnodes)`` to the points."""
        return np.stack([self.value @ row for row in nodal])

    def to_middles(self, nodal: ndarray) -> ndarray:
        """Interpolate nodal vectors ``(k, nnodes)`` to the middles of domains: on rings, the mass is not around it."""
        return np.stack([self.plain @ row for row in nodal])

    def gradient(self, nodal: ndarray) -> ndarray:
        r""":math:`G u`: one row per gradient row."""
        out = np.empty((len(self.rows), len(self.places)))
        for row, terms in zip(nodal, self.terms):
            for q, l in terms:
                out[q] = self.matrices[l] @ row
        return out

    def force(self, stress: ndarray) -> ndarray:
        r""":math:`L (V \sigma)`: nodal force from stress times volume, one row per gradient row."""
        return np.stack([sum(self.matrices[l].T @ stress[q] for q, l in terms) for terms in self.terms])
