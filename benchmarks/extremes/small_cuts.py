"""Columns under their weight whose ends only just reach into a cell: condition, error, and what a bare mode costs."""

from dataclasses import replace

import numpy as np

from extremes.bodies import MAKE, block, last, worst_of
from skfem_mpm import LinearElastic, implicit_steps
from skfem_mpm.boundary import FixedPlane, Wall

LAW = LinearElastic(E=1.0, nu=0.0)
CELLS = 6                                    # across the body
WEIGHT = 1e-6                                # of a cell over the modulus: strains are small
CUTS = [1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5]


def positions(quick):
    """Where the cut is: what reaches that far into the last cell, points or the edge of domains."""
    return [(cut, edge) for cut in ((1e-6, 0.3) if quick else CUTS) for edge in (True, False)]


def scene(dim, cut, edge):
    """Mesh, body, planes, gravity: corners at the origin, cells a little wider than the body's own."""
    body = block(dim, CELLS)
    width = (CELLS if edge else body.x.max()) / (CELLS - 1 + cut)
    mesh = MAKE[dim](*[width * np.arange(-3.0, CELLS + 4)] * dim)
    return mesh, body, [FixedPlane(k, 0.0, -1, name=str(k)) for k in range(dim)], -WEIGHT * np.eye(dim)[-1]


class Seen(Exception):
    """The first matrix of a run has been seen."""


def first_matrix(dim, cut, edge, choices):
    """The matrix that the solver of a first step gets."""
    found = []

    def solver(matrix, rhs):
        found.append(matrix.toarray())
        raise Seen

    mesh, body, planes, gravity = scene(dim, cut, edge)
    try:
        last(implicit_steps(mesh, body, LAW, planes, steps=1, gravity=gravity, solver=solver, **choices))
    except Seen:
        return found[0]


def condition(dim):
    """Largest condition number over the cuts, over that without a cut; what is singular has to stop."""
    def measure(choices, quick):
        worst = 0.0
        for cut, edge in positions(quick):
            size = np.linalg.svd(first_matrix(dim, cut, edge, choices), compute_uv=False)
            if size[-1] <= 1e-15 * size[0]:
                answer(dim, cut, edge, choices)
                return np.inf
            worst = worst_of(worst, size[0] / size[-1])
        return worst / np.linalg.cond(first_matrix(dim, 1.0, True, {"method": choices["method"]}))
    return measure


def answer(dim, cut, edge, choices):
    """Largest error of stress at a point, in weights of one cell."""
    mesh, body, planes, gravity = scene(dim, cut, edge)
    state = last(implicit_steps(mesh, body, LAW, planes, steps=1, gravity=gravity, max_cuts=0, **choices))
    exact = np.zeros(state.particles.sigma.shape)
    exact[dim - 1] = -WEIGHT * (CELLS - body.x[-1])
    return abs(state.particles.sigma - exact).max() / WEIGHT


def error(dim):
    """Largest error over the cuts."""
    return lambda choices, quick: worst_of(answer(dim, cut, edge, choices) for cut, edge in positions(quick))


def one_point_a_cell(choices, quick):
    """Largest error of stress of the column in 2-D with one point a cell, on nodes, in the middle and between."""
    worst = 0.0
    body = block(2, CELLS, per_cell=1)
    mesh = MAKE[2](*[np.arange(-3.0, CELLS + 5)] * 2)
    for shift in (0.0, 0.5, 0.5 + 1e-9) if quick else (0.0, 0.1, 0.25, 0.4, 0.5, 0.5 - 1e-9, 0.5 + 1e-9):
        here = replace(body, x=body.x + shift)
        along, line = np.arange(CELLS + 1.0) + shift, np.full(CELLS + 1, shift)
        walls = [Wall(np.stack([along, line]), (None, 0.0), name="base"),
                 Wall(np.stack([line, along]), (0.0, None), name="side")]
        state = last(implicit_steps(mesh, here, LAW, walls, steps=1, gravity=(0.0, -WEIGHT), **choices))
        exact = np.outer([0, 1, 0, 0], -WEIGHT * (CELLS - body.x[1]))
        worst = worst_of(worst, abs(state.particles.sigma - exact).max() / WEIGHT)
    return worst
