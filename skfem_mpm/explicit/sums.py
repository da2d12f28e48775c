"""Sums at the nodes and velocities of the nodes, compiled: twin of :class:`~skfem_mpm.explicit.nodes.Nodes`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy import ndarray

from ..kernels import chunks
from ..kernels import nodes as at_nodes
from ..kernels.crew import Crew
from ..kernels.options import CHUNKS
from .nodes import CUTOFF
from .tables import Table, Tables
from .window import Window

NONE = np.zeros(0)
NOTHING = np.zeros(0, dtype=np.uint8)


class Sums:
    """What the nodes of the window get from points.

    Attributes
    ----------
    mass
        ``(nnodes, columns)``; the first column is the lumped mass of active nodes.
    active, lights, light
        Mask of active nodes; numbers of light ones and how many there are.
    """

    def __init__(self, tables: Tables, crew: Crew):
        self.tables, self.crew, self.dim = tables, crew, tables.grid.dim
        self.dims = (0,) * self.dim
        self.buffers: dict[str, ndarray] = {}
        self.mass: Any = None
        self.active: Any = None
        self.lights: Any = None
        self.light = 0

    @property
    def window(self) -> Window:
        """The nodes around the points."""
        return self.tables.window

    def buffer(self, name: str, *shape: int, dtype: Any = float) -> ndarray:
        """Room kept from step to step, only ever growing."""
        size = math.prod(shape)
        found = self.buffers.get(name)
        if found is None or len(found) < size:
            found = self.buffers[name] = np.empty(size + size // 8, dtype=dtype)
        return found[:size].reshape(shape)

    def map(self, kernel: Any, name: str, columns: int, table: Table, *amounts: Any) -> ndarray:
        """Sums at the nodes, ``(nnodes, columns)``; zero where no point is."""
        return self.map_with(kernel, name, columns, (table.base, table.w, *amounts, self.window.frame), (table.kt,))

    def map_with(self, kernel: Any, name: str, columns: int, before: tuple[Any, ...],
                 after: tuple[Any, ...]) -> ndarray:
        """The same of kernels that read more than a table: arguments ``before`` and ``after`` those of the sums."""
        window, rows, crew = self.window, self.tables.rows, self.crew
        out = self.buffer(name, window.nnodes, columns)
        if crew.threads == 1:            # one chunk after the other; the copy keeps what two share
            widest = int((rows[:, 1] - rows[:, 0]).max() * window.frame[1, 0])
            copies = self.buffer(f"copies {columns}", 1, widest, columns)
        else:
            copies = self.buffer(f"copies {columns}", CHUNKS, window.nnodes, columns)
        crew(kernel, *before, out, copies, rows, *after)
        if crew.threads > 1:
            crew(chunks.sum_bands, window.frame, copies, rows, out)
        return out

    def classify(self, sums: ndarray, gravity: ndarray = NONE) -> None:
        """Tell active and light nodes by sums of mass and more; takes all of it to the active ones."""
        window, n = self.window, self.window.nnodes
        self.mass, self.active = sums, self.buffer("active", n, dtype=np.uint8)
        self.lights = self.buffer("lights", n, dtype=np.int64)
        at_nodes.fold(sums, gravity, window.inside, window.outside, window.all_signs)
        self.light = at_nodes.classify(sums, CUTOFF, window.around, self.active, self.lights)
        if self.light:
            at_nodes.collect(sums, self.active, self.lights, self.light, window.around)

    def sides(self) -> ndarray:
        """Which neighbours of occupied cells are available."""
        window, n = self.window, self.window.nnodes
        usable, dropped, sides = (self.buffer(name, n, dtype=np.uint8) for name in ("usable", "dropped", "sides"))
        at_nodes.available_sides(self.buffer("occupied", n, dtype=np.uint8), self.active, window.corners, window.faces,
                                 window.diagonals, usable, dropped, sides)
        return sides

    def gather(self, sums: ndarray, signed: bool = True) -> ndarray:
        """Take momentum, forces or (``signed`` or not) other sums to the active nodes, in place."""
        window = self.window
        at_nodes.gather(sums, window.inside, window.outside, window.signs if signed else window.no_signs, window.around,
                        self.active, self.lights, self.light)
        return sums

    def spread(self, nodal: ndarray, signed: bool = True) -> ndarray:
        """Numbers wherever points may read, from those of active nodes, in place."""
        window = self.window
        at_nodes.spread(nodal, window.inside, window.outside, window.signs if signed else window.no_signs,
                        window.around, self.active, self.lights, self.light)
        return nodal

    def accelerate(self, force: ndarray, column: int, dt: float, damping: float) -> tuple[ndarray, float]:
        """Velocity of the nodes after the step and its change, side by side; and the work that damping takes."""
        window = self.window
        out = self.buffer("velocities", window.nnodes, 2 * self.dim)
        lost = at_nodes.velocities(self.mass, force, column, window.fixed, self.active, dt, damping, out, self.dims,
                                   window.inside, window.outside, window.signs, window.around, self.lights, self.light)
        return out, lost

    def velocity(self, momentum: ndarray, column: int) -> ndarray:
        """Velocity of the nodes from momentum at the active ones."""
        window = self.window
        out = self.buffer("plain velocities", window.nnodes, self.dim)
        at_nodes.plain_velocities(self.mass, momentum, column, window.fixed, self.active, out, self.dims, window.inside,
                                  window.outside, window.signs, window.around, self.lights, self.light)
        return out
