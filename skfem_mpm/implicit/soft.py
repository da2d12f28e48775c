"""How stiff the body is around each cell: what the soft floor is a share of."""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from scipy.ndimage import minimum_filter


def softest_around(occupied: ndarray, index: ndarray, stiffness: ndarray, cells: ndarray) -> ndarray:
    """The smallest stiffness of the points in a cell, or in the cells around it where it is empty.

    A mean over the body would be that of its stiffest part, and a small share of it can be more than a soft one has.

    Parameters
    ----------
    occupied
        Mask over the cells, one index per axis.
    index
        ``(dim, n)``; cell of each point.
    stiffness
        ``(n,)``; of each point.
    cells
        ``(dim, m)``; which cells are asked for.

    Examples
    --------
    >>> occupied, index = np.array([True, True, False, False]), np.array([[0, 0, 1]])
    >>> softest_around(occupied, index, np.array([1e8, 2.0, 1e8]), np.array([[0, 1, 2, 3]])).tolist()
    [2.0, 100000000.0, 100000000.0, 2.0]
    """
    least = np.full(occupied.shape, np.inf)
    np.minimum.at(least, tuple(index), stiffness)
    around = minimum_filter(least, size=3, mode="constant", cval=np.inf)
    found = np.where(occupied, least, around)[tuple(cells)]
    return np.where(np.isfinite(found), found, stiffness.min())
