"""What holds and moves a body: fixed planes on grid lines, and walls anywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from .checks import OutsideGridError, check_array, check_positive
from .grid import Grid
from .particles.inputs import frozen


@dataclass(frozen=True)
class FixedPlane:
    """A plane on a grid line where displacement components are zero.

    Nodes behind it, which GIMP domains may touch, follow the body: along a straight line in implicit steps, as mirror
    images in explicit ones.  How wide the cells behind it are does not matter.

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
        if not (self._distance(lines) == 0).any():
            raise ValueError(f"at: got a fixed plane {self.name!r} at {self.at}, which is no grid line of axis "
                             f"{self.axis} (from {lines[0]:g} to {lines[-1]:g}); move the grid so that one lies there.")
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
    r"""A displacement imposed where the wall truly is, on nodes or between them, by Lagrange multipliers.

    Each wall point has a multiplier per component; or each segment has one, which holds the mean over its points:
    :math:`\frac1n \sum_w \sum_I N_I(x_w) u_I = \frac1n \sum_w \bar u_w`.  Where a wall bends
    in the step, linear functions cannot follow it from point to point, and points that are close make stress of that:
    there segments want to be about half a cell to a cell long.  A wall that moves as one may have any.

    Wall points push with linear functions whatever the method: those of their own cell where all its nodes are in play,
    else those of the nearest such cell, extrapolated.  They move with them too, unless the points of the body move by
    other functions: then with these, from the nearest cell that holds points.

    Parameters
    ----------
    x
        ``(dim, n)``; wall points.
    increment
        Displacement per load step.  One entry per component: a number, an array ``(n,)`` with one number per wall
        point, or ``None``, which leaves the component free.
    name
        Under which name its reaction is reported.
    segments
        ``(n,)``; a whole number for each wall point.  Points with the same one form a segment.  Each point stands for
        itself if not given.

    Raises
    ------
    OutsideGridError
        If a wall point leaves the grid.
    TypeError, ValueError
        If an argument is of the wrong type or shape, or not finite.

    Examples
    --------
    >>> wall = Wall(np.array([[1.0]]), increment=(0.015,))
    >>> wall.advanced(1.0).x.tolist()
    [[1.015]]
    """

    x: ndarray
    increment: Sequence[float | ndarray | None]
    name: str = "wall"
    segments: ndarray | None = None

    def __post_init__(self) -> None:
        if not all(step is None or _varies(step) or np.isfinite(step) for step in self.increment):
            raise ValueError(f"increment: got {self.increment} for wall {self.name!r}, expected finite numbers, or "
                             "None for components that are free.")
        x = frozen(check_array("wall", self.x, (len(self.increment), None)))
        label = f"increment of wall {self.name!r}"
        increment = tuple(frozen(check_array(label, step, x.shape[1:])) if _varies(step) else step
                          for step in self.increment)
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "increment", increment)
        if self.segments is not None:
            object.__setattr__(self, "segments", self._labels(np.array(self.segments)))

    def _labels(self, labels: ndarray) -> ndarray:
        """The labels of segments, checked and read-only."""
        if labels.dtype.kind not in "iu":
            raise TypeError(f"segments: got an array of {labels.dtype} for wall {self.name!r}, expected integers, one "
                            "for each wall point.")
        if labels.shape != self.x.shape[1:]:
            raise ValueError(f"segments: got shape {labels.shape} for wall {self.name!r}, expected "
                             f"{self.x.shape[1:]}, one label for each wall point.")
        labels.flags.writeable = False
        return labels

    @classmethod
    def along(cls, curve: ndarray, increment: Sequence[float | None] | Callable[[ndarray], Any], size: float,
              name: str = "wall", samples: int = 8) -> Wall:
        """A wall along a curve in the plane, held by the means over equal segments.

        Parameters
        ----------
        curve
            ``(2, m)``; corners of a polyline.
        increment
            As for a wall; or a function of the wall points ``(2, n)`` that gives an array ``(n,)`` or ``None`` for
            each component.
        size
            About how long a segment is; half the size of a cell is a good one.
        name
            Under which name its reaction is reported.
        samples
            Wall points per segment.

        Raises
        ------
        TypeError, ValueError
            If an argument is of the wrong type or shape, not finite, or not above zero, or the curve has no length.

        Examples
        --------
        >>> wall = Wall.along(np.array([[0.0, 1.0], [0.0, 0.0]]), (None, -0.01), size=0.25, samples=2)
        >>> wall.x[0].tolist(), wall.segments.tolist()
        ([0.0625, 0.1875, 0.3125, 0.4375, 0.5625, 0.6875, 0.8125, 0.9375], [0, 0, 1, 1, 2, 2, 3, 3])
        """
        curve = check_array("curve", curve, (2, None))
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(curve))))
        for label, value in [("size", size), ("samples", samples), ("curve (its length)", way[-1])]:
            check_positive(label, value)
        labels = np.repeat(np.arange(max(round(way[-1] / size), 1)), samples)
        place = way[-1] * (np.arange(len(labels)) + 0.5) / len(labels)
        x = np.stack([np.interp(place, way, row) for row in curve])
        return cls(x, increment(x) if callable(increment) else increment, name, labels)

    def advanced(self, share: float) -> Wall:
        """The wall after a share of a load step."""
        moved = [row if step is None else row + share * step for row, step in zip(self.x, self.increment)]
        return replace(self, x=np.stack(moved))

    def rows(self, support: Any, share: float) -> tuple[list[Any], list[Any], list[float], list[int]]:
        """Rows over the solved components, one per constraint.

        Returns
        -------
        moving, pushing
            How far the wall moves with the grid, and how its force acts on it; the same list if by the same functions.
        values, components
            How far it has to move, and along which axis.
        """
        groups = [(points, component, step) for points in self._groups()
                  for component, step in enumerate(self.increment) if step is not None]

        def means(functions: tuple[ndarray, ndarray]) -> list[Any]:
            nodes, value = functions
            return [support.row(nodes[:, points].ravel(), value[:, points].ravel() / len(points), component)
                    for points, component, _ in groups]

        pushing = means(self._functions(support))
        moving = pushing if support.method.motion is None else means(self._recovered(support))
        values = [share * (step[points].mean() if isinstance(step, ndarray) else step) for points, _, step in groups]
        return moving, pushing, values, [component for _, component, _ in groups]

    def _groups(self) -> list[ndarray]:
        """The points of each segment."""
        points = np.arange(self.x.shape[1])
        if self.segments is None:
            return list(points[:, None])
        return [points[self.segments == label] for label in np.unique(self.segments)]

    def _functions(self, support: Any) -> tuple[ndarray, ndarray]:
        """Nodes that wall points read and the linear functions there, both ``(2**dim, n)``."""
        grid, cell = support.grid, self._cells(support)
        corners = np.indices((2,) * grid.dim).reshape(grid.dim, -1, 1)
        low = np.stack([grid.axes[k][cell[k]] for k in range(grid.dim)])
        step = np.stack([grid.steps[k][cell[k]] for k in range(grid.dim)])
        t = ((self.x - low) / step)[:, None]
        nodes = np.ravel_multi_index(tuple(cell[:, None] + corners), grid.vertices.shape)
        return nodes, np.prod(np.where(corners, t, 1 - t), axis=0)

    def _recovered(self, support: Any) -> tuple[ndarray, ndarray]:
        """Nodes and values of the functions that move the points, ``(K**dim, n)``; nodes off the body have none."""
        grid, basis = support.grid, support.method.motion
        cell = self._nearest(grid, self._cells(support), support.occupied)
        stencil = basis.stencil_of(grid, self.x, cell, None, support.edges, support.sides_of(basis))
        return stencil.nodes(), stencil.value()

    def _cells(self, support: Any) -> ndarray:
        """The cell whose linear functions each wall point uses."""
        grid = support.grid
        try:
            support.full.locate(self.x)
        except OutsideGridError as error:
            raise OutsideGridError(f"wall {self.name!r}: {error}") from None
        low, high = ([axis[end] for axis in grid.axes] for end in (0, -1))
        cell = grid.locate(np.clip(self.x, np.reshape(low, (-1, 1)), np.reshape(high, (-1, 1))))
        cell = self._nearest(grid, cell, support.sound)
        self._check_near(grid, cell)
        return cell

    def _nearest(self, grid: Grid, cell: ndarray, usable: ndarray) -> ndarray:
        """These cells ``(dim, n)``, or the nearest ones to the wall points that are usable."""
        cell, found = cell.copy(), np.stack(np.nonzero(usable))
        middle = np.stack([((grid.axes[k][1:] + grid.axes[k][:-1]) / 2)[found[k]] for k in range(grid.dim)])
        for p in np.flatnonzero(~usable[tuple(cell)]):
            cell[:, p] = found[:, np.argmin(((middle - self.x[:, p, None]) ** 2).sum(axis=0))]
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


def _varies(step: Any) -> bool:
    """Whether an increment differs from wall point to wall point."""
    return step is not None and np.ndim(step) > 0
