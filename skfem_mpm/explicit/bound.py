r"""The longest stable time step of a layout of points.

On a frozen layout, displacements of nodes move by :math:`\ddot u = -M^{-1} K u` with lumped masses.  The largest
eigenvalue is no larger than the spectral radius of the non-negative matrix :math:`B_{IJ} = \lVert K_{IJ} \rVert /
\sqrt{m_I m_J}`, hence than :math:`\max_I (B x)_I / x_I` for any positive :math:`x` (Collatz and Wielandt).  A few power
iterations make that tight.

``musl`` and ``usf`` take strain from velocities that were mapped to the points and back.  That makes the operator
:math:`M^{-1} C M^{-1} K` with the consistent mass :math:`C_{IJ} = \sum_p m_p N_I N_J`, and the bound that of the
product of two non-negative matrices.  It does not collapse when a point has just entered an empty cell, for a light far
node then has as little say in :math:`C` as it has mass.  The step is :math:`2 / \omega`.

``usl`` uses velocities straight from the nodes: with a node of which the points keep the share :math:`r` it is stable
to :math:`2 / (\omega \sqrt{2 - r})`, at worst :math:`\sqrt 2 / \omega`, and the step does collapse.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray
from scipy.sparse import bsr_array, csr_array

from ..integration import PointIntegration
from .nodes import Nodes

ITERATIONS = 10


def stable_step(nodes: Nodes, moduli: ndarray, volume: ndarray, mass: ndarray, remaps: bool, last: bool) -> float:
    """A time step that is stable for sure on a frozen layout.

    Parameters
    ----------
    moduli
        ``(m, m, n)`` or ``(m, m, 1)``; derivative of stress by the gradient, of the stiffest state.
    volume, mass
        ``(n,)``; of the points.
    remaps
        Whether strain comes from velocities that were mapped to the points and back.
    last
        Whether stress follows the velocities of the step's end without that.
    """
    stiffness = block_norms(nodes, moduli, volume)
    scale = np.divide(1.0, np.sqrt(nodes.mass), out=np.zeros_like(nodes.mass), where=nodes.active)

    def over_nodes(x: ndarray, matrix: Callable[[ndarray], ndarray]) -> ndarray:
        full = nodes.spread((scale * x)[None], signed=False)[0]
        return scale * nodes.gather(matrix(full)[None], signed=False)[0]

    def multiply(x: ndarray) -> ndarray:
        if remaps:
            value = nodes.mapping.value
            x = over_nodes(x, lambda full: value.T @ (mass * (value @ full)))
        return over_nodes(x, lambda full: stiffness @ full)

    return np.sqrt(2.0 if last else 4.0) / power_bound(multiply, nodes.active)


def block_norms(nodes: Nodes, moduli: ndarray, volume: ndarray) -> csr_array:
    """Norms of the blocks of the stiffness, ``(nnodes, nnodes)``."""
    dim, size = nodes.grid.dim, nodes.grid.nnodes
    operator = PointIntegration(nodes.kinematics, nodes.force.stencil, nodes.strain.stencil, volume, nodes.x[0])
    number = np.arange(dim * size).reshape(size, dim).T
    blocks = bsr_array(operator.tangent(moduli, number, dim * size), blocksize=(dim, dim))
    return csr_array((np.sqrt((blocks.data ** 2).sum(axis=(1, 2))), blocks.indices, blocks.indptr), shape=(size, size))


def power_bound(multiply: Callable[[ndarray], ndarray], active: ndarray) -> float:
    """Root of an upper bound of the spectral radius of a non-negative matrix, from its products with a vector.

    Parameters
    ----------
    multiply
        Product of the matrix with a vector; zero where not ``active``.
    active
        ``(n,)``; which rows and columns count.
    """
    x, best = active.astype(float), np.inf
    for _ in range(ITERATIONS):
        y = multiply(x)
        best = min(best, float((y[active] / x[active]).max()))
        x = np.where(active, np.maximum(y / y.max(), 1e-3), 0.0)   # stays positive, so each pass is a bound by itself
    return float(np.sqrt(best))
