"""The stencils of the compiled engine, and where its points are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from ..basis import CMPMBasis, GIMPBasis, ParticleBasis
from ..grid import Grid
from ..kernels import chunks, domains
from ..kernels import stencil as stencils
from ..kernels.axes import axes_arrays, cmpm_table
from ..kernels.crew import Crew
from ..kernels.options import CHUNKS, TILE
from .state import Choices
from .window import Window


class Table:
    """Stencil of one basis: first nodes and factors of the points, filled anew in every step."""

    def __init__(self, width: int, n: int, dim: int, base: ndarray | None = None, rows: int = 2):
        self.base = np.empty((n, dim), dtype=np.int32) if base is None else base
        self.w = np.empty((n, dim, rows, width))
        self.kt = (0,) * width


class Tables:
    """One table for each basis of a method, for ``n`` points.

    Attributes
    ----------
    mapping, strain, force
        The tables by what they are for.
    window
        The nodes around the points.
    limits, bad
        ``(tiles, 1 + 4 * dim)`` and ``(tiles, 2)``; what kernels say of each tile of points, see
        :mod:`skfem_mpm.kernels.chunks`.
    rows
        ``(CHUNKS, 2)``; nodes along the first axis that each chunk of points may touch.
    """

    def __init__(self, grid: Grid, choices: Choices, planes: Sequence[Any], length: ndarray | None, n: int, crew: Crew,
                 ring: bool = False):
        self.grid, self.choices, self.planes, self.crew, self.length = grid, choices, planes, crew, length
        self.knots, self.inverse, self.sizes = axes_arrays(grid.axes)
        dim, method = grid.dim, choices.method
        bases = {method.mass, method.strain, method.force}
        self.smallest = np.array([step.min() for step in grid.steps])
        self.widths = self.smallest              # how far points may move in one step
        self.ring = ring
        self.measure_domains(length)
        self.wide = self.overlong
        equal = bool(self.sizes[:, 1].all())
        self.narrow = method.mass is GIMPBasis and choices.edges == "ghost" and equal and not (self.wide or ring)
        self.quick = method.mass is ParticleBasis and equal
        changing = choices.domains == "stretched"
        self.alike = length is not None and not changing and bool((length == length[:, :1]).all())
        self.reach = int(choices.integration.covers or bases != {ParticleBasis})
        self.others = tuple(sorted(bases - {method.mass}, key=lambda basis: basis.__name__))
        if CMPMBasis in bases:
            self.cmpm_table = cmpm_table(grid.axes)
        self.cell = np.empty((n, dim), dtype=np.int32)
        widths = {ParticleBasis: 2, CMPMBasis: 4, GIMPBasis: 3 if self.narrow else 4}
        tables = {basis: Table(widths[basis], n, dim, self.cell if basis is ParticleBasis else None,
                               3 if ring and basis is GIMPBasis else 2) for basis in bases}
        self.by_basis = tables
        self.mapping, self.strain, self.force = tables[method.mass], tables[method.strain], tables[method.force]
        tiles = -(-n // TILE)
        self.limits, self.bad = np.zeros((tiles, 1 + 4 * dim)), np.zeros((tiles, 2), dtype=np.int64)
        self.rows, self.box = np.zeros((CHUNKS, 2), dtype=np.int64), np.full((2, dim), -1, dtype=np.int64)
        self.work = np.zeros(dim)
        self.fill = {ParticleBasis: self._fill_linear, GIMPBasis: self._fill_gimp, CMPMBasis: self._fill_cmpm}
        self.window: Any = None
        self.slopes: Any = None

    def measure(self, x: ndarray, velocity: ndarray) -> None:
        """Find out where points are, after their arrays have changed."""
        self.bad[:] = 0
        self.limits[:] = 0
        chunks.measure_all(x, x, velocity, self.limits)
        self.survey()

    def survey(self) -> int:
        """Sum up what kernels said of the tiles; what was found, see :mod:`skfem_mpm.kernels.chunks`."""
        found = chunks.survey(self.limits, self.bad, self.knots, self.sizes, self.widths, self.reach, self.box,
                              self.rows, self.work)
        if found & chunks.ELSEWHERE:
            self.window = Window(self.grid, self.box[0].copy(), self.box[1].copy(), self.planes,
                                 self.choices.edges)
        return found

    def measure_domains(self, length: ndarray | None) -> None:
        """Find the longest edges along the axes, after the domains have changed."""
        self.longest = np.zeros(self.grid.dim) if length is None else length.max(axis=1)

    @property
    def overlong(self) -> bool:
        """Whether some domain is longer than a cell; it may then reach into both neighbours, and has four nodes."""
        return bool((self.longest > self.smallest * (1 + 1e-9)).any())

    @property
    def near_the_edge(self) -> bool:
        """Whether some domain may leave the grid."""
        dim, margin = self.grid.dim, self.longest / 2
        low, high = self.limits[:, 1 + dim:1 + 2 * dim].min(axis=0), self.limits[:, 1 + 2 * dim:1 + 3 * dim].max(axis=0)
        return any(a - size < axis[0] or b + size > axis[-1]
                   for axis, a, b, size in zip(self.grid.axes, low, high, margin))

    def place(self, x: ndarray, occupied: ndarray) -> None:
        """Cells of the points, and the stencil that maps mass; marks ``occupied`` cells if there is room."""
        mapping, crew = self.mapping, self.crew
        if self.narrow:
            crew(stencils.place_gimp, x, self.length, 1 - self.alike, self.knots, self.inverse, mapping.base, mapping.w)
        elif self.quick:
            crew(stencils.place_linear, x, self.knots, self.inverse, self.sizes, self.cell, mapping.w)
        if not self.quick and (not self.narrow or len(occupied)):
            crew(stencils.locate, x, self.knots, self.inverse, self.sizes, self.cell)
        if not self.quick and not self.narrow:
            self.fill[self.choices.method.mass](x, mapping, self.window.sides)
        if len(occupied):
            occupied[:] = 0
            crew(stencils.mark, self.cell, self.window.frame, occupied)

    def place_others(self, x: ndarray, sides: ndarray) -> None:
        """The other stencils, which reach into available ``sides`` only."""
        for basis in self.others:
            self.fill[basis](x, self.by_basis[basis], sides)

    def fitted(self, x: ndarray) -> ndarray:
        """Factors of the mapping with the slopes of :attr:`skfem_mpm.explicit.nodes.Nodes.fitted`."""
        mapping = self.mapping
        if len(mapping.kt) == 2:
            return mapping.w
        if self.slopes is None:
            self.slopes = np.empty_like(mapping.w)
        self.crew(domains.fit_slopes, mapping.base, mapping.w, self.knots, x, self.slopes, mapping.kt)
        return self.slopes

    def _fill_linear(self, x: ndarray, table: Table, sides: ndarray) -> None:
        self.crew(stencils.fill_linear, x, self.knots, self.inverse, self.cell, table.w)

    def _fill_gimp(self, x: ndarray, table: Table, sides: ndarray) -> None:
        self.crew(stencils.fill_gimp_masked, x, self.length, self.knots, self.inverse, self.sizes, self.cell,
                  self.window.frame, sides, table.base, table.w)
        if self.ring:
            self.crew(domains.weigh_rings, x, self.length, self.knots, self.inverse, self.cell, self.window.frame,
                      sides, table.w)

    def _fill_cmpm(self, x: ndarray, table: Table, sides: ndarray) -> None:
        self.crew(stencils.fill_cmpm, x, self.knots, self.inverse, self.sizes, self.cell, self.window.frame, sides,
                  self.cmpm_table, table.base, table.w)
