"""What holds and moves a body: fixed planes on grid lines, and walls anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from .checks import OutsideGridError, check_array
from .grid import Grid


@dataclass(frozen=True)
class FixedPlane:
    """A plane on a grid line where displacement components are zero.

    Nodes behind it, which GIMP domains may touch, are mirrored: they follow the body.

    Parameters
    ----------
    axis
        Axis it is normal to.
    at
        Coordinate of the plane; must be a grid line.
    side
        +1 if the body lies below it (towards smaller coordinates), -1 if above.
    components
        Displacement components that are zero; only the normal one, as rollers do, if not given.
    name
        Under which name its reaction is reported.

    Raises
    ------
    ValueError
        If the plane is not on a grid line of the mesh.

    Examples
    --------
    >>> FixedPlane(axis=0, at=3.0, side=1).components
    (0,)
    """

    axis: int
    at: float
    side: int
    components: tuple[int, ...] = ()
    name: str = "fixed"

    def __post_init__(self) -> None:
        if self.side not in (-1, 1):
            raise ValueError(f"side: got {self.side}, expected +1 (body below the plane) or -1 (body above it).")
        if not self.components:
            object.__setattr__(self, "components", (self.axis,))

    def _distance(self, grid: Grid) -> ndarray:
        """How far each node lies behind the plane, in cells of its own axis; zero on it."""
        axis = grid.axes[self.axis]
        distance = self.side * (axis - self.at) / np.diff(axis).min()
        distance[np.abs(distance) < 1e-9] = 0
        if axis[0] < self.at < axis[-1] and not (distance == 0).any():
            raise ValueError(f"at: got a fixed plane {self.name!r} at {self.at}, which is no grid line of axis "
                             f"{self.axis}; move the grid so that one lies there.")
        shape = [1] * grid.dim
        shape[self.axis] = -1
        return np.broadcast_to(distance.reshape(shape), grid.vertices.shape).ravel()

    def fixes(self, grid: Grid) -> ndarray:
        """Which components of which nodes are zero, ``(dim, nnodes)``."""
        on = self._distance(grid) == 0
        return np.stack([on & (i in self.components) for i in range(grid.dim)])

    def behind(self, grid: Grid) -> ndarray:
        """Which nodes lie behind it, ``(nnodes,)``."""
        return self._distance(grid) > 0

    def advanced(self, share: float) -> FixedPlane:
        """The plane after a share of a load step: itself."""
        return self


@dataclass(frozen=True, eq=False)
class Wall:
    """A displacement imposed where the wall truly is, on nodes or between them, by one multiplier per wall point.

    Wall points use linear functions whatever the method: those of their own cell where all its nodes are in play, else
    those of the nearest such cell, extrapolated.

    Parameters
    ----------
    x
        ``(dim, n)``; wall points.
    increment
        Displacement per load step, one number per component; ``None`` leaves a component free.
    name
        Under which name its reaction is reported.

    Raises
    ------
    OutsideGridError
        If a wall point leaves the grid.

    Examples
    --------
    >>> wall = Wall(np.array([[1.0]]), increment=(0.015,))
    >>> wall.advanced(1.0).x.tolist()
    [[1.015]]
    """

    x: ndarray
    increment: Sequence[float | None]
    name: str = "wall"

    def __post_init__(self) -> None:
        x = check_array("wall", self.x, (len(self.increment), None)).copy()
        x.flags.writeable = False
        object.__setattr__(self, "x", x)

    def advanced(self, share: float) -> Wall:
        """The wall after a share of a load step."""
        return replace(self, x=self.x + share * np.array([[step or 0.0] for step in self.increment]))

    def rows(self, support: Any, share: float) -> tuple[list[Any], list[float], list[int]]:
        """Constraint rows over the solved components, their right-hand sides, and the component of each."""
        grid = support.grid
        cell = self._cells(support)
        corners = np.indices((2,) * grid.dim).reshape(grid.dim, -1)
        rows, values, components = [], [], []
        for p in range(self.x.shape[1]):
            low = np.array([grid.axes[k][cell[k, p]] for k in range(grid.dim)])
            step = np.array([grid.steps[k][cell[k, p]] for k in range(grid.dim)])
            t = (self.x[:, p] - low) / step
            value = np.prod(np.where(corners, t[:, None], 1 - t[:, None]), axis=0)
            nodes = np.ravel_multi_index(tuple(cell[:, p, None] + corners), grid.vertices.shape)
            for component, wanted in enumerate(self.increment):
                if wanted is not None:
                    rows.append(support.row(nodes, value, component))
                    values.append(share * wanted)
                    components.append(component)
        return rows, values, components

    def _cells(self, support: Any) -> ndarray:
        """The cell whose functions each wall point uses."""
        grid = support.grid
        try:
            support.full.locate(self.x)
        except OutsideGridError as error:
            raise OutsideGridError(f"wall {self.name!r}: {error}") from None
        try:
            cell = grid.locate(self.x)
        except OutsideGridError:
            raise ValueError(f"wall {self.name!r}: got points more than two cells away from the body, which is within "
                             f"{grid.extent}; expected a wall that touches it.") from None
        lost = np.flatnonzero(~support.holds(cell))
        if len(lost):
            sound = support.sound_cells()
            middle = np.stack([((grid.axes[k][1:] + grid.axes[k][:-1]) / 2)[sound[k]] for k in range(grid.dim)])
            for p in lost:
                cell[:, p] = sound[:, np.argmin(((middle - self.x[:, p, None]) ** 2).sum(axis=0))]
        return cell
