"""Local coordinates that refuse to be mixed with those of other points.

This rests on scikit-fem's inside: before it assembles, a bilinear form compares ``X.shape[-1]`` of its two bases.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray


def check_same_points(one: ndarray, other: ndarray) -> None:
    """Refuse to mix points at the positions ``one`` and ``other``, ``(dim, n)`` each, in one form."""
    if one is not other and (one.shape != other.shape or (one != other).any()):
        raise ValueError(f"bases: got one with {one.shape[1]} and one with {other.shape[1]} points at different "
                         "positions in one form, expected the same points; make both bases from one Particles object.")


class LocalPoints(ndarray):
    """Local coordinates that know their points.

    Before it assembles, scikit-fem compares ``X.shape[-1]`` of the two bases of a form: the place to see that both look
    at the same points, without which a form would be silently wrong.
    """

    points: ndarray

    @classmethod
    def of(cls, local: ndarray, points: ndarray) -> LocalPoints:
        """Local coordinates ``(dim, n, 1)`` of points at the positions ``points (dim, n)``."""
        view = np.ascontiguousarray(local).view(cls)
        view.points = points
        return view

    @property    # type: ignore[misc]  # numpy's shape can be set too, but nobody sets this one
    def shape(self) -> Any:
        """Shape, the last entry of which compares points."""
        shape = super().shape
        return shape[:-1] + (_PointCount(shape[-1]).of(self.points),) if hasattr(self, "points") else shape


class _PointCount(int):
    points: ndarray

    def of(self, points: ndarray) -> _PointCount:
        self.points = points
        return self

    def __ne__(self, other: object) -> bool:
        if isinstance(other, _PointCount):
            check_same_points(self.points, other.points)
        return int.__ne__(self, other)

    def __eq__(self, other: object) -> bool:
        return not self != other

    __hash__ = int.__hash__
