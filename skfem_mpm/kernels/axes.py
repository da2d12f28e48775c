"""What the stencil kernels read of the axes of a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy import ndarray
from numpy.polynomial import polynomial


def axes_arrays(axes: Sequence[ndarray]) -> tuple[ndarray, ndarray, ndarray]:
    """Knots, inverse widths and sizes, see :mod:`skfem_mpm.kernels.stencil`."""
    longest = max(len(axis) for axis in axes)
    knots, inverse = np.zeros((len(axes), longest + 2)), np.ones((len(axes), longest + 1))
    sizes = np.zeros((len(axes), 2), dtype=np.int64)
    for k, axis in enumerate(axes):
        full = np.concatenate([[2 * axis[0] - axis[1]], axis, [2 * axis[-1] - axis[-2]]])
        width = np.diff(axis)
        knots[k, :len(full)], inverse[k, :len(full) - 1] = full, 1 / np.diff(full)
        sizes[k] = len(width), np.ptp(width) <= 1e-9 * width[0]
    return knots, inverse, sizes


def cmpm_table(axes: Sequence[ndarray]) -> ndarray:
    """Coefficients of the Lagrange polynomials of CMPM in local coordinates of the host.

    ``(dim, cells, kind, power, node)``; only one cell where all are equal.  The kind has bit 0 if the left neighbour is
    there and bit 1 if the right one is.
    """
    knots, _, sizes = axes_arrays(axes)
    rows = max(1 if equal else count for count, equal in sizes)
    table = np.zeros((len(axes), rows, 4, 4, 4))
    for k, (count, equal) in enumerate(sizes):
        for c in range(1 if equal else count):
            around = np.arange(-1.0, 3.0) if equal else (knots[k, c:c + 4] - knots[k, c + 1]) / np.diff(knots[k])[c + 1]
            for kind in range(4):
                chosen = [j for j in range(4) if j in (1, 2) or kind >> (j == 3) & 1]
                for j in chosen:
                    roots = [around[m] for m in chosen if m != j]
                    poly = polynomial.polyfromroots(roots) / np.prod(around[j] - roots)
                    table[k, c, kind, :len(poly), j] = poly
    return table
