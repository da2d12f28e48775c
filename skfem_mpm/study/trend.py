"""How error and cost of one way to compute go with the number of cells, from a few runs of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

STALLED = 0.1              # an order of convergence that is none


@dataclass(frozen=True, eq=False)
class Trend:
    """Runs of one way to compute at a few numbers of cells, in any order.

    Between them error and cost are powers of the number of cells; beyond the finest one the powers go on, that of the
    error by the smaller one of its last two.

    Attributes
    ----------
    cells, error, cost
        ``(m,)``, of the runs; at least one, each with cells of its own.

    Raises
    ------
    ValueError
        If they are not of one length, or an error or a cost is negative or not finite.

    Examples
    --------
    >>> trend = Trend([10, 20, 40], [0.4, 0.1, 0.025], [1.0, 2.0, 4.0])
    >>> trend.orders.round(6), trend.asymptotic, trend.needed(0.01), round(trend.error_at(80), 6)
    (array([2., 2.]), True, 67, 0.00625)
    """

    cells: Any
    error: Any
    cost: Any

    def __post_init__(self) -> None:
        order, n = np.argsort(self.cells), np.size(self.cells)
        for name in ("cells", "error", "cost"):
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape != (n,) or not n or not (np.isfinite(values) & (values >= 0)).all():
                raise ValueError(f"{name}: got {values}, expected a finite number of at least 0 for each of one run or "
                                 "more.")
            object.__setattr__(self, name, values[order])
        if self.cells[0] == 0 or not np.diff(self.cells).all():
            raise ValueError(f"cells: got {self.cells}, expected different numbers above zero.")

    @property
    def orders(self) -> ndarray:
        """``(m - 1,)``; order of convergence from each number of cells to the next."""
        return -np.diff(np.log(np.maximum(self.error, 1e-300))) / np.diff(np.log(self.cells))

    @property
    def asymptotic(self) -> bool:
        """Whether the last two orders agree within a half, so that the error can be trusted to go on like that."""
        last = self.orders[-2:]
        return len(last) == 2 and bool(last.min() > STALLED and np.ptp(last) <= 0.5)

    def error_at(self, cells: float) -> float:
        """Error at a number of cells."""
        slope = -min(self.orders[-2:], default=0.0)
        return _power(cells, self.cells, self.error, slope)

    def cost_at(self, cells: float) -> float:
        """Cost at a number of cells."""
        pair = np.diff(np.log(np.maximum(self.cost[-2:], 1e-9))) / np.diff(np.log(self.cells[-2:]))
        return _power(cells, self.cells, self.cost, max(float(pair[0]), 0.0) if len(pair) else 0.0)

    def needed(self, tolerance: float, margin: float = 0.9) -> int | None:
        """The least number of cells from which on the error is within a tolerance, or ``None`` if it stalls above.

        Runs count as they are; between and beyond them the error must be within ``margin`` times the tolerance.
        """
        good = np.logical_and.accumulate((self.error <= tolerance)[::-1])[::-1]
        if good.any():
            first = int(good.argmax())
            return int(self.cells[0]) if first == 0 else self._between(first, margin * tolerance)
        order = min(self.orders[-2:], default=0.0)
        if order <= STALLED:
            return None
        growth = np.log(self.error[-1] / (margin * tolerance)) / order
        finest = self.cells[-1] * np.exp(min(growth, 99.0))             # beyond all machines
        return int(np.ceil(max(finest, self.cells[-1] + 1) - 1e-9))

    def _between(self, first: int, limit: float) -> int:
        """Where the error passes a limit between the last run that is too coarse and the first that will do."""
        low, high = (np.log(self.cells[first - 1]), np.log(self.cells[first]))
        above, below = (np.log(max(self.error[i], 1e-300) / limit) for i in (first - 1, first))
        if below >= 0:
            return int(self.cells[first])
        guess = np.ceil(np.exp(low + (high - low) * above / (above - below)) - 1e-9)
        return int(min(max(guess, self.cells[first - 1] + 1), self.cells[first]))


def _power(at: float, cells: ndarray, values: ndarray, slope: float) -> float:
    """Powers through values at numbers of cells, and with a slope of its own beyond the finest."""
    logs = np.log(np.maximum(values, 1e-300))
    inside = np.interp(np.log(at), np.log(cells), logs)
    return float(np.exp(inside + slope * max(np.log(at / cells[-1]), 0.0)))
