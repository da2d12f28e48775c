"""The operators of a step as sparse matrices, read from a stencil."""

from __future__ import annotations

from functools import cached_property, reduce

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..grid import Stencil
from ..kinematics import Kinematics


class Operators:
    r"""Value :math:`N` and slopes :math:`\partial_l N` of the functions that points see, each made when first needed.

    Sparse twin of :class:`~skfem_mpm.integration.PointIntegration`; nodal arrays are ``(k, nnodes)``.

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
        self.dim = len(stencil.shape)
        self.rows = kinematics.rows(self.dim)
        self.hoop = kinematics.hoop

    @cached_property
    def _places(self) -> tuple[ndarray, ndarray]:
        """Nodes of all points, one point after the other, and where each point starts."""
        nodes = self.stencil.nodes()
        return (np.ascontiguousarray(nodes.T, dtype=np.int32).ravel(),
                np.arange(0, nodes.size + 1, len(nodes), dtype=np.int32))

    def matrix(self, slope: int = -1) -> csr_array:
        """Values at the points of nodal numbers, or their slopes along an axis, ``(n, nnodes)``."""
        factors = [self.stencil.w[k, int(k == slope)].T for k in range(self.dim)]
        table = reduce(lambda a, b: (a[:, :, None] * b[:, None]).reshape(len(a), -1), factors)
        nodes, starts = self._places
        return csr_array((np.ascontiguousarray(table).ravel(), nodes, starts),
                         shape=(self.stencil.n, int(np.prod(self.stencil.shape))))

    @cached_property
    def value(self) -> csr_array:
        """:math:`N`."""
        return self.matrix()

    @cached_property
    def slopes(self) -> list[csr_array]:
        r""":math:`\partial_l N` for each axis."""
        return [self.matrix(k) for k in range(self.dim)]

    def to_nodes(self, amounts: ndarray) -> ndarray:
        """Share point amounts ``(k, n)`` among the nodes."""
        return np.stack([self.value.T @ row for row in amounts])

    def to_points(self, nodal: ndarray) -> ndarray:
        """Interpolate nodal vectors ``(k, nnodes)`` to the points."""
        return np.stack([self.value @ row for row in nodal])

    def gradient(self, nodal: ndarray) -> ndarray:
        r""":math:`G u`: one row per gradient row."""
        rows = [self.slopes[j] @ nodal[i] for i, j in self.rows[:self.dim ** 2]]
        return np.stack(rows + [self.value @ nodal[0] / self.radius] * self.hoop)

    def force(self, stress: ndarray) -> ndarray:
        r""":math:`L (V \sigma)`: nodal force from stress times volume, one row per gradient row."""
        out = np.zeros((self.dim, int(np.prod(self.stencil.shape))))
        for row, (i, j) in zip(stress, self.rows[:self.dim ** 2]):
            out[i] += self.slopes[j].T @ row
        if self.hoop:
            out[0] += self.value.T @ (stress[-1] / self.radius)
        return out
