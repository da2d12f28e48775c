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

    Nodes behind it, which GIMP domains may touch, follow the body: u_g = 2 u_0 - u_1.

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
        If ``side`` is neither +1 nor -1; and in a run, if the plane is not on a grid line of the mesh, has an axis or
        components that the mesh has not, or has points of the body behind it.

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

    def check(self, grid: Grid, x: ndarray) -> None:
        """Refuse a plane that does not fit the grid of a mesh, or has points ``x (dim, n)`` behind it."""
        if not all(0 <= k < grid.dim for k in (self.axis, *self.components)):
            raise ValueError(f"plane {self.name!r}: got axis {self.axis} and components {self.components} on a mesh in "
                             f"{grid.dim} dimension(s), expected numbers from 0 to {grid.dim - 1}.")
        lines = grid.axes[self.axis]
        if not np.isfinite(self.at) or (lines[0] < self.at < lines[-1] and not (self._distance(lines) == 0).any()):
            raise ValueError(f"at: got a fixed plane {self.name!r} at {self.at}, which is no grid line of axis "
                             f"{self.axis}; move the grid so that one lies there.")
        behind = self.side * (x[self.axis] - self.at) > 1e-9 * np.diff(lines).min()
        if behind.any():
            point = int(np.flatnonzero(behind)[0])
            raise ValueError(f"plane {self.name!r}: got point {point} at {x[self.axis, point]:g} along axis "
                             f"{self.axis}, behind the plane at {self.at:g}; expected all points on one side.  Check "
                             f"side={self.side} (+1: the body is below the plane), or take smaller steps.")

    def _distance(self, lines: ndarray) -> ndarray:
        """How far each grid line of its axis lies behind the plane, in cells; zero on it."""
        distance = self.side * (lines - self.at) / np.diff(lines).min()
        distance[np.abs(distance) < 1e-9] = 0
        return distance

    def _spread(self, mask: ndarray, grid: Grid) -> ndarray:
        """A mask over the lines of its axis as one over all nodes."""
        shape = [1] * grid.dim
        shape[self.axis] = -1
        return np.broadcast_to(mask.reshape(shape), grid.vertices.shape).ravel()

    def fixes(self, grid: Grid) -> ndarray:
        """Which components of which nodes are zero, ``(dim, nnodes)``."""
        on = self._spread(self._distance(grid.axes[self.axis]) == 0, grid)
        return np.stack([on & (i in self.components) for i in range(grid.dim)])

    def behind(self, grid: Grid) -> ndarray:
        """Which nodes lie behind it, ``(nnodes,)``."""
        return self._spread(self._distance(grid.axes[self.axis]) > 0, grid)

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
        if not all(step is None or np.isfinite(step) for step in self.increment):
            raise ValueError(f"increment: got {self.increment} for wall {self.name!r}, expected finite numbers, or "
                             "None for components that are free.")
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
        low, high = ([axis[end] for axis in grid.axes] for end in (0, -1))
        cell = grid.locate(np.clip(self.x, np.reshape(low, (-1, 1)), np.reshape(high, (-1, 1))))
        lost, sound = np.flatnonzero(~support.holds(cell)), np.stack(np.nonzero(support.sound))
        middle = np.stack([((grid.axes[k][1:] + grid.axes[k][:-1]) / 2)[sound[k]] for k in range(grid.dim)])
        for p in lost:
            cell[:, p] = sound[:, np.argmin(((middle - self.x[:, p, None]) ** 2).sum(axis=0))]
        self._check_near(grid, cell)
        return cell

    def _check_near(self, grid: Grid, cell: ndarray) -> None:
        """Refuse a wall that does not touch the body."""
        low = np.stack([grid.axes[k][cell[k]] for k in range(grid.dim)])
        step = np.stack([grid.steps[k][cell[k]] for k in range(grid.dim)])
        far = ((self.x < low - step) | (self.x > low + 2 * step)).any(axis=0)
        if far.any():
            point = int(np.flatnonzero(far)[0])
            place = ", ".join(f"{value:g}" for value in self.x[:, point])
            raise ValueError(f"wall {self.name!r}: got point {point} at ({place}), more than a cell away from the "
                             "body; expected a wall that touches the body.")
