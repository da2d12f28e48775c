"""What a sequence of ever finer grids tends to, how fast, and how sure that is."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from scipy.optimize import brentq

ORDERS = (0.3, 3.0)             # outside, three grids are not where an error is one power of the cell size


class Extrapolated(NamedTuple):
    """What :func:`richardson` finds.

    Attributes
    ----------
    value
        The limit; that of the finest grid if there is no ``order``.
    error
        Estimate of the error of ``value``, zero or more, in its unit and of its shape.
    order
        Observed order of convergence; not a number if three grids do not show one.
    """

    value: Any
    error: Any
    order: float

    def beside(self, other: Extrapolated) -> Extrapolated:
        """The same value, no surer than it agrees with that of another sequence, which should have the same limit.

        Examples
        --------
        >>> Extrapolated(3.0, 0.1, 1.0).beside(Extrapolated(3.25, 0.1, 1.0))
        Extrapolated(value=3.0, error=0.25, order=1.0)
        """
        error = np.maximum(self.error, np.abs(np.subtract(self.value, other.value)))
        return self._replace(error=error if error.ndim else float(error))


def richardson(values: Any, sizes: Any) -> Extrapolated:
    r"""Extrapolate to cells of size zero, with an estimate of the error.

    The three finest grids are taken to follow :math:`f(h) = f_0 + C h^p`, so that

    .. math:: \frac{f_1 - f_2}{f_2 - f_3} = \frac{h_1^p - h_2^p}{h_2^p - h_3^p}, \qquad
              f_0 = f_3 + \frac{f_3 - f_2}{(h_2 / h_3)^p - 1} .

    The error is the whole step from the finest grid to the limit; but no less than the last change from grid to grid,
    which a lucky order would hide, nor than what the value has moved since it was found with one grid less.  Where
    values swing, or :math:`p` is not between 0.3 and 3, nothing is extrapolated: the value is that of the finest grid,
    its error the spread of the three, and again no less than what the value has moved.

    A history (values with more than one axis) has one order, found from norms of the two differences; it swings if
    they point against each other.

    Parameters
    ----------
    values
        ``(grids, ...)``; coarsest grid first, three at least.
    sizes
        ``(grids,)``; their cell sizes.

    Returns
    -------
    Extrapolated
        ``value``, ``error``, ``order``.

    Raises
    ------
    ValueError
        If there are fewer than three grids, values and sizes are not equally many, sizes do not fall, or a number is
        not finite.

    References
    ----------
    Roache (1994): perspective: a method for uniform reporting of grid refinement studies.

    Examples
    --------
    >>> found = richardson([3.4, 3.2, 3.1], [0.4, 0.2, 0.1])
    >>> print(f"{found.value:.3f} {found.error:.3f} {found.order:.3f}")
    3.000 0.100 1.000
    """
    f, h = _checked(values, sizes)
    found = _last_three(f[-3:], h[-3:])
    return found if len(h) == 3 else found.beside(_last_three(f[-4:-1], h[-4:-1]))


def _checked(values: Any, sizes: Any) -> tuple[ndarray, ndarray]:
    f, h = (np.asarray(given, dtype=float) for given in (values, sizes))
    if h.ndim != 1 or len(h) < 3:
        raise ValueError(f"sizes: got shape {h.shape}, expected (grids,) with three grids or more; run a finer one.")
    if f.ndim == 0 or len(f) != len(h):
        raise ValueError(f"values: got shape {f.shape}, expected ({len(h)}, ...), one entry per size, coarsest first.")
    if not (np.isfinite(h).all() and (h > 0).all() and (np.diff(h) < 0).all()):
        raise ValueError(f"sizes: got {h}, expected numbers above zero that fall; put the coarsest grid first.")
    if not np.isfinite(f).all():
        raise ValueError("values: got some that are not finite; leave out the grids whose runs failed.")
    return f, h


def _last_three(f: ndarray, h: ndarray) -> Extrapolated:
    order = _order(f, h)
    if np.isnan(order):
        return Extrapolated(f[-1], np.ptp(f, axis=0), order)
    limit = f[2] + (f[2] - f[1]) / ((h[1] / h[2]) ** order - 1)
    return Extrapolated(limit, np.maximum(abs(limit - f[2]), abs(f[2] - f[1])), order)


def _order(f: ndarray, h: ndarray) -> float:
    """The power of the cell size that three grids show; not a number if they show none between the bounds."""
    one, other = (f[1] - f[0]).ravel(), (f[2] - f[1]).ravel()
    if not one @ other > 0:
        return np.nan
    ratio = np.linalg.norm(one) / np.linalg.norm(other)

    def miss(p: float) -> float:
        return (h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - ratio

    low, high = ORDERS
    return float(brentq(miss, low, high, xtol=1e-13)) if miss(low) <= 0 <= miss(high) else np.nan
