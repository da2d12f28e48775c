"""Which runs nobody beats in both error and cost."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray


def pareto(cost: Any, error: Any) -> ndarray:
    """Indices of the Pareto set: entries for which no other is at most as dear *and* at most as wrong.

    Parameters
    ----------
    cost, error
        ``(n,)``; entries that are not finite are left out.

    Raises
    ------
    ValueError
        If the two are not of one length.

    Returns
    -------
    ndarray
        In order of ascending cost, and so of descending error; of equal entries the first.

    Examples
    --------
    >>> pareto([1.0, 2.0, 3.0, 4.0], [0.3, 0.1, 0.2, 0.01])
    array([0, 1, 3])
    """
    cost, error = np.asarray(cost, dtype=float), np.asarray(error, dtype=float)
    if cost.ndim != 1 or cost.shape != error.shape:
        raise ValueError(f"error: got shape {error.shape} with cost {cost.shape}, expected one number each for n runs.")
    order = np.lexsort((error, cost))
    order = order[np.isfinite(cost[order]) & np.isfinite(error[order])]
    best = np.minimum.accumulate(np.concatenate([[np.inf], error[order]]))
    return order[error[order] < best[:-1]]
