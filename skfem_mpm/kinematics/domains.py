r"""How the domains of points follow a step.

An edge of a box along axis :math:`k` follows the normal stretch, :math:`l_k \leftarrow l_k\,(1 + G_{kk})`; then all
edges of a point are scaled alike, so that their product follows its length, area or volume ratio, in axial symmetry
without the hoop.  Neighbouring boxes stay next to each other in any stretch along the axes; rotation and simple shear
leave a box as it is.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from .blocks import deformation, in_plane_ratio, product

DOMAINS = ("fixed", "stretched")
RADII = ("point", "domain")      # whether a ring is taken to be all at its point, or the radius is part of its means
LEAST = 0.1      # smallest stretch of an edge in one step before scaling: there are none in turns by a right angle


def stretched(length: ndarray, gradient: ndarray) -> ndarray:
    """Edges ``(dim, n)`` of boxes after the displacement gradient ``(m, n)`` of a step, rows as in ``kinematics.rows``.

    Examples
    --------
    >>> import numpy as np
    >>> stretched(np.array([[1.0], [1.0]]), np.array([[1.0], [0.0], [0.0], [-0.5]])).T.tolist()
    [[2.0, 0.5]]
    """
    dim = len(length)
    along = np.maximum(1 + gradient[:dim * dim:dim + 1], LEAST)
    whole = in_plane_ratio(gradient, dim)
    return length * along * (whole / along.prod(axis=0)) ** (1 / dim)


def carried(spans: ndarray, gradient: ndarray) -> ndarray:
    """Edge vectors ``(dim, dim, n)`` of parallelograms after a step: they follow it, turns and shear included."""
    return product(deformation(gradient, len(spans)), spans)
