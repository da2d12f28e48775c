"""The symmetric twin of field integration in the compiled engine: twin of :mod:`skfem_mpm.explicit.twin`."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy import ndarray

from ..grid import touched_cells
from ..integration import Twin
from ..integration.field import LEAST, ROUNDS
from ..integration.fit import FLAT, monomial_degrees
from ..kernels import cells, field
from ..kinematics import Kinematics
from .sums import Sums
from .window import Window

REACH = 3        # how far two nodes of a point are apart along an axis


class Fields:
    """Stress as a field: what the cells of the window know of it, made anew in every step.

    Parameters
    ----------
    sums
        Sums at the nodes; cells are numbered by their first nodes.
    kinematics
        Which gradient rows there are.
    twin
        Which fit.

    Attributes
    ----------
    volume
        ``(n,)``; :math:`V^*`.
    """

    def __init__(self, sums: Sums, kinematics: Kinematics, twin: Twin):
        self.sums, self.tables, self.crew = sums, sums.tables, sums.crew
        self.kappa, self.order, self.dim = -1.0 if twin.kappa is None else float(twin.kappa), twin.order, sums.dim
        dim, n = self.dim, len(self.tables.cell)
        self.exps = _exponents(dim, 2 * twin.order)
        nb = len(monomial_degrees(dim, twin.order))
        self.monos, self.sums_of, self.dims = (0,) * nb, (0,) * len(self.exps), (0,) * dim
        self.powers, self.hoop = (0,) * (2 * twin.order + 1), (0,) * kinematics.hoop
        numbers = {tuple(row): m for m, row in enumerate(self.exps.tolist())}
        self.pair = np.array([[numbers[tuple(a + b)] for b in self.exps[:nb]] for a in self.exps[:nb]])
        self.flat = np.array(FLAT[:twin.order + 1])
        self.offsets = np.indices((3,) * dim).reshape(dim, -1).T.copy()
        axis = np.arange(dim) * len(self.powers) * 3
        self.at = axis + 3 * self.exps[None, :, :] + self.offsets[:, None, :]
        wide = twin.order + 2 + kinematics.hoop                  # powers of a coordinate in integrals, from zero
        self.strides = wide ** np.arange(dim)[::-1]
        self.size = wide ** dim
        self.rows = kinematics.rows(dim)
        self.ntables = dim + kinematics.hoop
        self.packed = np.array([[kinematics.packed_index((i, t) if t < dim else (2, 2)) for t in range(self.ntables)]
                                for i in range(dim)])
        self.comps = (0,) * kinematics.ncomp
        self.w = np.empty((n, dim * len(self.powers) * 3))
        self.volume, self.sure = np.empty(n), np.empty(n)
        self.window: Any = None

    def place(self, x: ndarray, length: ndarray, volume: ndarray, occupied: ndarray) -> None:
        """Fit and cover of points in the cells that the tables have found for them."""
        if self.window is not self.sums.window:
            self._enter(self.sums.window)
        tables, crew, frame = self.tables, self.crew, self.window.frame
        crew(field.place, x, tables.knots, tables.inverse, tables.cell, self.kappa, self.powers, self.w)
        cells.classify(occupied, self.beyond, self.steps, self.state)
        self.moments = self._map(field.moments, "moments", len(self.exps), (self.w, self.at, self.steps, tables.cell,
                                                                            frame), self.sums_of)
        crew(cells.fit, self.moments, self.state, self.pair, self.flat, self.Q)
        boxed = self._map(field.boxes, "boxes", self.size,
                          (x, length, volume, tables.knots, tables.cell, self.state, self.offsets, self.steps,
                           self.strides, frame, self.hoop))
        crew(cells.integrate, boxed, self.state, tables.knots, frame, self.exps, self.strides, self.hoop, self.amount,
             self.corner, self.dims)
        self._keep_positive()

    def _enter(self, window: Window) -> None:
        """Room for the cells of a window."""
        self.window, n, nb = window, window.nnodes, len(self.monos)
        stride = window.frame[1]
        self.steps = np.array([np.array(offset) @ stride
                               for offset in itertools.product((-1, 0, 1), repeat=self.dim)])
        self.beyond = self._beyond(window)
        self.state = np.zeros(n, dtype=np.uint8)
        self.Q, self.amount, self.weights = np.zeros((n, nb, nb)), np.zeros((n, nb)), np.zeros((n, nb))
        self.positive, self.corner = np.zeros(n), np.zeros((n, self.ntables, 2 ** self.dim, nb))
        self.parts = np.zeros((n, 2 ** self.dim * self.dim))
        self.slopes = np.zeros((n, nb * len(self.rows)))

    def _beyond(self, window: Window) -> ndarray:
        """Cells of the window that are off the grid or behind a fixed plane."""
        grid, (first, stride) = self.tables.grid, window.frame
        shape = np.append(window.nnodes, stride)[:-1] // stride
        low, high = np.maximum(first, 0), np.minimum(first + shape, grid.cells.shape)
        part = grid.window(np.stack([low, high - 1], axis=1), 0)
        behind = np.zeros(part.cells.shape, dtype=bool)
        for plane in self.tables.planes:
            behind |= touched_cells(plane.behind(part).reshape(part.vertices.shape))
        out = np.ones(shape, dtype=np.uint8)
        out[tuple(slice(a, b) for a, b in zip(low - first, high - first))] = behind
        return out.ravel()

    def _map(self, kernel: Any, name: str, columns: int, amounts: tuple[Any, ...], *counts: Any) -> ndarray:
        """Sums in the cells, ``(cells, columns)``."""
        return self.sums.map_with(kernel, name, columns, amounts, (*counts, self.dims))

    def _keep_positive(self) -> None:
        """Blend in constants where the fit would leave a point too little volume."""
        if not self._weigh():
            return
        own, share = self.Q.copy(), np.zeros(len(self.Q))
        for _ in range(ROUNDS):
            cells.blend(self.state, self.moments, self.steps, self.want, share, own, self.Q)
            if not self._weigh():
                return
        share[:] = np.where(share > 0, 1.0, 0.0)
        self.want[:] = 0
        cells.blend(self.state, self.moments, self.steps, self.want, share, own, self.Q)
        self._weigh()

    def _weigh(self) -> bool:
        """Find V*; whether some points have too little of it, and cells are to take constants instead."""
        frame, cell = self.window.frame, self.tables.cell
        self.crew(cells.weigh, self.state, self.moments, self.amount, self.Q, self.weights, self.positive)
        self.crew(field.volumes, self.w, self.at, self.steps, cell, frame, self.weights, self.positive, self.volume,
                  self.sure, self.monos, self.dims)
        self.want = self.sums.buffer("want", self.window.nnodes)
        return cells.lacking(self.volume, self.sure, cell, frame, LEAST, self.want)

    def force(self, sigma: ndarray) -> ndarray:
        """Internal force at the nodes, ``(nnodes, dim)``."""
        columns = len(self.monos) * len(self.comps)
        stress = self._map(field.stresses, "stress", columns, (self.w, self.at, self.steps, self.tables.cell,
                                                               self.window.frame, sigma), self.monos, self.comps)
        self.crew(cells.forces, self.state, stress, self.Q, self.corner, self.packed, self.parts, self.dims)
        out = self.sums.buffer("force", self.window.nnodes, self.dim)
        self.crew(cells.gather, self.parts, self.window.corners, out, self.dims)
        return out

    def gradient(self, nodal: ndarray, dt: float, out: ndarray) -> None:
        """Displacement gradient of the points over a step."""
        nrows = len(self.rows)
        self.crew(cells.slopes, self.state, nodal, self.Q, self.corner, self.window.corners, nrows, self.slopes,
                  self.dims)
        self.crew(field.gradients, self.w, self.at, self.steps, self.tables.cell, self.window.frame, self.slopes,
                  self.volume, dt, out, (0,) * nrows, self.monos, self.dims)

    def norms(self, lam: float, shear: float, rows: ndarray, out: ndarray) -> None:
        """Norms of the blocks of the stiffness of an isotropic body, ``out (nnodes, 7**dim)``; not on rings."""
        dim, crew, cell, frame = self.dim, self.crew, self.tables.cell, self.window.frame
        traced, table = np.empty(self.corner.shape), np.empty((len(self.volume), 4 ** dim, dim))
        crew(cells.trace, self.state, self.Q, self.corner, traced, self.dims)
        corners, nodes = (np.indices((size,) * dim).reshape(dim, -1) for size in (2, 4))
        four, seven = (size ** np.arange(dim)[::-1] for size in (4, 7))
        crew(field.tables, self.w, self.at, self.steps, cell, frame, traced,
             (four @ self.offsets.T)[:, None] + four @ corners, self.volume, table, self.monos, self.dims)
        slots = seven @ (nodes[:, None] - nodes[:, :, None] + REACH).reshape(dim, -1)
        places = frame[1, 1:] @ np.indices((4,) * (dim - 1)).reshape(dim - 1, -1)
        crew(field.norms, table, cell, self.volume, lam, shear, frame, rows, places, slots.reshape(4 ** dim, -1), out,
             self.dims)


def _exponents(dim: int, order: int) -> ndarray:
    """Exponents of the monomials up to an order, in the order of :func:`skfem_mpm.integration.fit.monomials`."""
    rows = [np.bincount(axes, minlength=dim) for degree in range(order + 1)
            for axes in itertools.combinations_with_replacement(range(dim), degree)]
    return np.array(rows, dtype=np.int64).reshape(-1, dim)
