r"""Bounds of the stable step from norms of blocks, mostly sharper than the one that a run takes.

No eigenvalue of a matrix exceeds the spectral radius of the norms of its blocks, whatever the blocks, nor that
:math:`\max_I (B x)_I / x_I` for any :math:`x > 0` (Collatz and Wielandt).  A run takes the product of the norms of
:math:`C` and of those of :math:`K`; here it is the norms of the product, :math:`B_{IJ} = \lVert (C K)_{IJ} \rVert`,
where signs have cancelled; and the root of that of :math:`(C K)^2`, where more have.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from ..explicit.bound import power_bound
from .layout import Layout

ROUNDING = 1e6      # times the step of a run: beyond, what is left of the product is rounding
TINY = np.finfo(float).tiny
FULL = 1_000_000    # entries up to which a matrix is multiplied: products have many more


def safe_step(layout: Layout) -> float:
    r"""The best of some steps that are stable for sure; with TPIC and a share of FLIP that of a run, which is not.

    As :math:`c \le F`, the share :math:`c / (1 + F)` is at most 1/2, and at most :math:`c / (1 + \alpha)` without XPIC;
    so :math:`K` alone gives one bound, and its product with :math:`C` another.  With TPIC and ``flip=0``,
    :math:`C + H` is in the place of :math:`C`.
    """
    usual, choices = layout.usual_step, layout.choices
    if choices.tpic and choices.flip:
        return usual
    flip, last = choices.flip == 1 and not choices.xpic, choices.integrator == "usl"
    steps = [np.sqrt((2 if last else 4) / _norm(layout.stiffness, layout.dim))]
    if layout.stiffness.nnz <= FULL and (flip or layout.symmetric and not last):
        product = layout.inertia @ layout.stiffness
        share = 1.0 if choices.xpic else 1 + choices.flip
        operator = layout.stiffness - product / 2 if last else product / share
        steps.append(np.sqrt(2 / _tightened(operator, layout.dim)))
    elif flip:
        steps.append(usual)
    return float(min(max(steps), ROUNDING * usual))


def _norms(matrix: csr_array, dim: int) -> csr_array:
    """Norms of the blocks between nodes."""
    blocks = matrix.tobsr((dim, dim))
    size = matrix.shape[0] // dim
    return csr_array((np.linalg.norm(blocks.data, ord=2, axis=(1, 2)), blocks.indices, blocks.indptr), (size, size))


def _norm(matrix: csr_array, dim: int) -> float:
    """Bound of the largest singular value."""
    norms = _norms(matrix, dim)
    return float(np.sqrt(_radius(csr_array(norms.T) @ norms)))


def _radius(norms: csr_array) -> float:
    """Bound of the spectral radius of a matrix without negative entries; not zero."""
    if not norms.nnz or norms.max() <= 0:
        return TINY
    return max(power_bound(norms.__matmul__, np.ones(norms.shape[0], dtype=bool)) ** 2, TINY)


def _tightened(matrix: csr_array, dim: int) -> float:
    """Bound of the spectral radius from the norms of a matrix, and of its powers while they are not too full."""
    best = first = _radius(_norms(matrix, dim))
    for power in (2, 4) if first > TINY else ():
        if matrix.nnz > FULL:
            break
        matrix = csr_array(matrix @ matrix) / (first ** 2 if power == 2 else 1)
        best = min(best, first * _radius(_norms(matrix, dim)) ** (1 / power))
    return max(best, TINY)
