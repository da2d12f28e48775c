"""The stable time step of the compiled engine: twin of :mod:`skfem_mpm.explicit.bound`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray

from ..kernels import bound
from .bound import power_bound, root_scale
from .fields import REACH, Fields
from .sums import Sums
from .tables import Table


class Pairs:
    """A table of numbers of pairs of nodes, with a slot for each node within ``reach`` along each axis.

    If ``mirrored`` it is its own transpose, and half of it is empty.
    """

    def __init__(self, sums: Sums, reach: int, mirrored: bool):
        self.sums, self.reach, span, dim = sums, reach, 2 * reach + 1, sums.dim
        self.table = np.zeros((sums.window.nnodes, span ** dim))
        self.steps = (np.indices((span,) * dim).reshape(dim, -1).T - reach) @ sums.window.frame[1]
        self.pad, self.own = int(self.steps.max()), span ** (dim - 1) * mirrored

    def times(self, x: ndarray) -> ndarray:
        """Product with numbers at active nodes, which light nodes and mirror images share."""
        n, pad = len(x), self.pad
        z, y = np.zeros(n + 2 * pad), np.zeros(n + 2 * pad)
        z[pad:pad + n] = x
        self.sums.spread(z[pad:pad + n, None], signed=False)
        bound.multiply(self.table, self.steps, self.own, z, y, pad)
        return self.sums.gather(y[pad:pad + n, None], signed=False)[:, 0]


def stable_step(sums: Sums, law: Any, volume: ndarray, mass: ndarray, remaps: bool, last: bool,
                fields: Fields | None = None) -> float:
    """A time step that is stable for sure on a frozen layout of an isotropic body; perhaps with stress as a field."""
    tables = sums.tables
    rows = np.empty((len(tables.limits), 2), dtype=np.int64)
    bound.rows_of_tiles(tables.limits, tables.knots, tables.sizes, sums.window.frame, tables.reach, rows)
    stiffness = _of_fields(sums, law, fields, rows) if fields else _stiffness(sums, law, volume, rows)
    inertia = _inertia(sums, mass, rows) if remaps else None
    active = sums.active.astype(bool)
    scale, unit = root_scale(sums.mass[:, 0], active)

    def multiply(x: ndarray) -> ndarray:
        if inertia:
            x = scale / unit * inertia.times(scale * x)
        return scale / unit * stiffness.times(scale * x)

    return np.sqrt(2.0 if last else 4.0) / power_bound(multiply, active)


def _stiffness(sums: Sums, law: Any, volume: ndarray, rows: ndarray) -> Pairs:
    force, strain = sums.tables.force, sums.tables.strain
    same, both = force is strain, len(force.kt) + len(strain.kt)
    pairs = Pairs(sums, len(force.kt) - 1 if same else 2 if both < 7 else 3, same)
    kernel = getattr(bound, f"norms{sums.dim}")
    sums.crew(kernel, force.base, force.w, strain.base, strain.w, volume, law.lam, law.G, sums.window.frame, rows,
              pairs.reach, same, pairs.table,
              force.kt, strain.kt)
    return pairs


def _of_fields(sums: Sums, law: Any, fields: Fields, rows: ndarray) -> Pairs:
    pairs = Pairs(sums, REACH, True)
    fields.norms(law.lam, law.G, rows, pairs.table)
    return pairs


def _inertia(sums: Sums, mass: ndarray, rows: ndarray) -> Pairs:
    mapping: Table = sums.tables.mapping
    pairs = Pairs(sums, len(mapping.kt) - 1, True)
    kernel = getattr(bound, f"masses{sums.dim}")
    sums.crew(kernel, mapping.base, mapping.w, mass, sums.window.frame, rows, len(mapping.kt) - 1, pairs.table,
              mapping.kt)
    return pairs
