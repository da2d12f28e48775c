r"""The longest stable time step of a layout of points.

With lumped masses the largest eigenvalue of :math:`M^{-1}K` is that of the symmetric matrix
:math:`M^{-1/2} K M^{-1/2}`, and no larger than the spectral radius of the non-negative matrix
:math:`B_{IJ} = \lVert K_{IJ} \rVert / \sqrt{m_I m_J}`, hence than :math:`\max_I (B x)_I / x_I` for any positive
:math:`x` (Collatz and Wielandt).  A few power iterations make that tight; the time step is :math:`2 / \omega`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray
from scipy.sparse import bsr_array, csr_array

ITERATIONS = 10


def highest_frequency(stiffness: csr_array, mass: ndarray, dim: int) -> float:
    """Upper bound of the highest angular frequency.

    Parameters
    ----------
    stiffness
        Over the components of the nodes, components inner.
    mass
        ``(nnodes,)``; lumped masses of these nodes, above zero.
    """
    blocks = bsr_array(stiffness, blocksize=(dim, dim))
    norms = np.linalg.norm(blocks.data, axis=(1, 2)) if dim > 1 else np.abs(blocks.data[:, 0, 0])
    scale = 1 / np.sqrt(mass)
    matrix = csr_array((norms, blocks.indices, blocks.indptr), shape=(len(mass), len(mass)))
    return power_bound(lambda x: scale * (matrix @ (scale * x)), np.ones(len(mass), dtype=bool))


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
