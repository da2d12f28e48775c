"""A load that is scaled such that a place of the body moves as it is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..boundary import Wall
from ..support import Support, stack_rows


@dataclass(frozen=True, eq=False)
class Control:
    r"""Gravity times an unknown factor, such that a place of the body moves by a given amount per load step.

    With gravity's nodal force :math:`f` and the displacement functions :math:`c` of the place, a step solves

    .. math:: f_{\mathrm{int}}(u) = \lambda f, \qquad c^T u = \Delta

    for :math:`u` and :math:`\lambda`.  So a run passes a peak of the load, where there is no equilibrium for any higher
    one, and follows the falling branch.  Choose a place that keeps moving on: the toe or the crest of a slope that
    fails.  The place moves with the body; like the points of a wall it uses linear functions.

    Parameters
    ----------
    x
        ``(dim,)``; the place, in the body or at most a cell away from it.
    direction
        ``(dim,)``; in which the displacement counts, of any length above zero.
    increment
        Displacement per load step in this direction.

    Raises
    ------
    ValueError
        If the numbers make no sense; and in a run, if there is no load, the place is not near the body, or walls and
        planes do not let it move in this direction.

    Notes
    -----
    Displacement control of Batoz and Dhatt (1979), with the bordered system solved as it stands, so that the stiffness
    may be singular.

    Examples
    --------
    >>> Control((1.0, 0.5), direction=(0.0, -2.0), increment=1e-3).direction.tolist()
    [0.0, -1.0]
    """

    x: Any
    direction: Any
    increment: float

    def __post_init__(self) -> None:
        x, direction = (_vector(name, getattr(self, name)) for name in ("x", "direction"))
        if x.shape != direction.shape:
            raise ValueError(f"direction: got {len(direction)} number(s) for a place x of {len(x)}; give both one per "
                             "axis.")
        size = np.linalg.norm(direction)
        if not size > 0:
            raise ValueError(f"direction: got {direction.tolist()}, expected a vector of a length above zero.")
        if not (np.ndim(self.increment) == 0 and np.isfinite(self.increment) and self.increment != 0):
            raise ValueError(f"increment: got {self.increment!r}, expected a displacement per step other than zero.")
        for name, array in (("x", x), ("direction", direction / size)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def row(self, support: Support) -> csr_array:
        """Displacement of the place in its direction, as a row over the solved components."""
        return csr_array(self.direction[None] @ self._rows(support))

    def advanced(self, support: Support, unknowns: ndarray) -> Control:
        """The control after a step with these displacements."""
        return replace(self, x=self.x + self._rows(support) @ unknowns)

    def _rows(self, support: Support) -> csr_array:
        """Displacement of the place, a row per component."""
        if len(self.x) != support.grid.dim:
            raise ValueError(f"control: got a place of {len(self.x)} coordinate(s) on a mesh in {support.grid.dim} "
                             "dimension(s); give one per axis.")
        rows, _, _, _ = Wall(self.x[:, None], [0.0] * len(self.x), name="control").rows(support, 1.0)
        return stack_rows(rows, support.transfer.shape[1])


def _vector(name: str, value: Sequence[float]) -> ndarray:
    """A copy of numbers, one per axis."""
    array = np.array(value, dtype=float)
    if array.ndim != 1 or not 1 <= len(array) <= 3 or not np.isfinite(array).all():
        raise ValueError(f"{name}: got {value!r}, expected finite numbers, one per axis.")
    return array
