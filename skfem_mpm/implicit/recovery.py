"""Stress between the points, recovered from the displacement of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from ..basis import ParticleBasis
from ..checks import check_array
from ..grid import Edges, Grid
from ..integration import on_points
from ..kinematics import Kinematics
from .fbar import Known, averaged, cell_shares


@dataclass(frozen=True, eq=False)
class Recovery:
    """Recovers the stress increment of a step at any positions; keeps the grid, not the points."""

    grid: Grid
    basis: type[ParticleBasis]
    edges: Edges
    sides: ndarray | None
    occupied: ndarray
    u: ndarray
    strain: type
    kinematics: Kinematics
    material: Any
    ring: bool
    force: type[ParticleBasis]
    dilation: ndarray | None     # of cells, if points see that instead of their own
    between: bool = True         # whether strain is known between the points

    def __call__(self, x: ndarray, length: ndarray | None) -> ndarray:
        """Stress increment ``(ncomp, n)`` at positions ``(dim, n)``."""
        if not self.between:
            raise ValueError("recover: got a state of a twin of field integration, which knows strain at its points "
                             "only; read the points' own stress, or run with integration='field' or 'points'.")
        x = check_array("x", x, (len(self.u), None))
        index = self.grid.locate(x)
        empty = np.flatnonzero(~self.occupied[tuple(index)])
        if len(empty):
            raise ValueError(f"x: got point {empty[0]} at {x[:, empty[0]]}, in a cell that held no points in this "
                             "step; expected positions in the body.")
        stencil = self.basis.stencil_of(self.grid, x, index, length, self.edges, self.sides, ring=self.ring)
        operator = on_points(self.kinematics, stencil, stencil, np.ones(x.shape[1]), x[0])
        zero = np.zeros((self.kinematics.ncomp, x.shape[1]))
        motion = self.strain(self.kinematics, len(x), self.material, zero, None)
        if self.dilation is not None:
            shares = cell_shares(self.grid, self.force, x, index, length, self.edges, self.ring)
            motion = averaged(motion, Known(shares @ self.dilation))
        return motion.respond(operator.gradient(self.u)).sigma
