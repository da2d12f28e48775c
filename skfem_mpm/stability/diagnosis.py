"""A look at a set-up before it runs: points and cells, cuts, light nodes, steps, growth and energies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.ndimage import binary_fill_holes
from skfem import Mesh

from ..explicit import ExplicitState, run_before_its_start
from ..explicit.nodes import Nodes
from ..explicit.run import Run
from ..particles import Particles
from .edge import Growth, StepLimit, growth_of, limit_of, spectrum_of
from .layout import Layout


@dataclass(frozen=True)
class Diagnosis:
    """What there is to know of a set-up before it runs; ``str()`` is a short table.

    Attributes
    ----------
    points, cells
        Number of points, and of cells that hold some.
    per_cell
        Smallest, median and largest number of points in a cell that holds some.
    holes
        Empty cells that the body surrounds on all sides.
    cover
        Smallest share of a cell, of those that hold points, that the volumes of its points fill.
    mass
        Smallest mass of an active node, as a share of the median.
    light
        Nodes that points may read and that have too little mass to move by themselves.
    step
        Stable steps.
    dt
        What a run would take at its start.
    growth
        Growth of waves with that step; ``None`` if there are too many unknowns to look for it.
    energy
        Kinetic and elastic energy of the points; the latter is not a number if the law does not say.
    damping
        Local damping, which steps and growth leave out.
    """

    points: int
    cells: int
    per_cell: tuple[int, float, int]
    holes: int
    cover: float
    mass: float
    light: int
    step: StepLimit
    dt: float
    growth: Growth | None
    energy: Mapping[str, float]
    damping: float

    def __str__(self) -> str:
        least, median, most = self.per_cell
        rows = [("points", f"{self.points} in {self.cells} cells, {least} to {most} in each, median {median:g}"),
                ("empty cells inside", f"{self.holes}"), ("smallest cut", f"{self.cover:.3g} of a cell by volume"),
                ("lightest node", f"{self.mass:.3g} of the median mass, {self.light} too light to move"),
                ("step", str(self.step)), ("step of a run", f"{self.dt:.4g}"),
                ("waves", "growth not looked for" if self.growth is None else str(self.growth)),
                ("energy", ", ".join(f"{name} {value:.4g}" for name, value in self.energy.items()))]
        if self.damping:
            rows.append(("damping", f"{self.damping:g}, left out of steps and growth"))
        return "\n".join(f"{name:<20}{text}" for name, text in rows)


def diagnose(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: Sequence[Any] | None = None,
             **choices: Any) -> Diagnosis:
    """What there is to know of the set-up of an explicit run before it starts.

    Parameters
    ----------
    mesh, start, material, boundary, choices
        As in :func:`skfem_mpm.explicit_steps`.

    Raises
    ------
    ValueError, TypeError
        As :func:`skfem_mpm.explicit_steps`.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, uniaxial
    >>> from skfem_mpm.stability import diagnose
    >>> bar = Particles.fill(MeshLine(np.arange(11.0)), uniaxial)
    >>> print(diagnose(MeshLine(np.arange(-2.0, 14)), bar, LinearElastic(E=1.0, nu=0.0)))
    points              20 in 10 cells, 2 to 2 in each, median 2
    empty cells inside  0
    smallest cut        1 of a cell by volume
    lightest node       0.5 of the median mass, 0 too light to move
    step                stable up to 1.6... for sure, exact limit 1.732; 11 unknowns
    step of a run       0.4993
    waves               growth with a step of 0.4993 (limit 1.732): none
    energy              kinetic 0, elastic 0
    """
    run = run_before_its_start(mesh, start, material, boundary, **choices)
    layout = Layout(run)
    nodes, spectrum = layout.nodes, spectrum_of(layout)
    count, cover = _cells(run, nodes)
    heavy = nodes.mass[nodes.active]
    return Diagnosis(
        points=run.x.shape[1], cells=len(count), holes=_holes(nodes), cover=float(cover.min()),
        per_cell=(int(count.min()), float(np.median(count)), int(count.max())),
        mass=float(heavy.min() / np.median(heavy)), light=len(nodes.light),
        step=limit_of(layout, spectrum), dt=layout.first_step,
        growth=None if spectrum is None else growth_of(spectrum, layout.first_step),
        energy=run._stored(), damping=run.choices.damping)


def _cells(run: Run, nodes: Nodes) -> tuple[ndarray, ndarray]:
    """Of cells that hold points, their number and the share of the cell that their volumes fill."""
    grid = nodes.grid
    number = np.ravel_multi_index(tuple(nodes.index), grid.cells.shape)
    first, *others = grid.steps
    if run.kinematics.hoop:
        first = first * (grid.axes[0][1:] + grid.axes[0][:-1]) / 2                # the ring, per radian
    size = reduce(np.multiply.outer, others, first)
    count, volume = np.bincount(number), np.bincount(number, weights=run.volume)
    held = np.flatnonzero(count)
    return count[held], volume[held] / size.ravel()[held]


def _holes(nodes: Nodes) -> int:
    """Empty cells that the body surrounds."""
    return int((binary_fill_holes(nodes.occupied) & ~nodes.occupied).sum())
