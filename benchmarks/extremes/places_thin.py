"""One to 64 points in a cell, bodies one cell wide, and meshes of one cell."""

from dataclasses import replace

import numpy as np

from extremes.bodies import MAKE, MOTION, last, low_planes, pull, rms, worst_of
from extremes.row import Row
from skfem_mpm import LinearElastic, Particles, explicit_steps, implicit_steps
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.scenes import column

ELASTIC = LinearElastic(E=1.0, nu=0.0)                # with density 1: waves of speed 1, and bars that stay as wide
CELLS, SPEED = 8, 1e-4
COUNTS = {1: (1, 2, 3, 4, 8, 16, 32, 64), 2: (1, 2, 3, 4, 6, 8), 3: (1, 2, 3, 4)}
FEW = {1: (1, 16), 2: (4,)}


def rod(dim, per_cell, shift=0.0, drift=0.0):
    """Grid and points of a bar along the first axis, one cell wide, that starts to vibrate in its first mode."""
    lines = [np.arange(-4.0, CELLS + 8), *[np.arange(-3.0, 5.0)] * (dim - 1)]
    body = Particles.fill(MAKE[dim](np.arange(CELLS + 1.0), *[np.arange(2.0)] * (dim - 1)), MOTION[dim],
                          per_cell=per_cell, density=1.0)
    velocity = np.zeros_like(body.x)
    velocity[0] = drift + SPEED * np.cos(np.pi * body.x[0] / CELLS)
    return MAKE[dim](*lines), replace(body, x=body.x + shift, velocity=velocity)


def vibration_error(state, start):
    """Rms error of stress along the bar, relative to its largest over place and time."""
    exact = -SPEED * np.sin(np.pi * start / CELLS) * np.sin(np.pi * state.time / CELLS)
    return rms(state.particles.stress[0, 0] - exact) / SPEED


def vibrate(mesh, body, planes, start, **choices):
    """Largest error of stress at eight times of a period."""
    states = explicit_steps(mesh, body, ELASTIC, planes, steps=10 ** 6, every_seconds=CELLS / 4, engine="numpy",
                            **choices)
    worst = 0.0
    for state in states:
        worst = worst_of(worst, vibration_error(state, start))
        if state.time > 2 * CELLS:
            return worst


def between_rollers(dim):
    """Rollers on all sides along the bar."""
    sides = ((0.0, -1), (1.0, 1))
    return [FixedPlane(k, at, side, name=f"side {k} {side}") for k in range(1, dim) for at, side in sides]


def many_vibrating(choices, quick):
    """Largest error over the numbers of points in a cell, of a bar between rollers that flies 2 cells in a period."""
    worst = 0.0
    for dim, counts in (FEW if quick else COUNTS).items():
        for count in counts:
            mesh, body = rod(dim, count, drift=0.125)
            start = body.x[0]
            worst = worst_of(worst, vibrate(mesh, body, between_rollers(dim), start, **choices))
    return worst


def many_standing(choices, quick):
    """Largest error of stress of a column over the numbers of points in a cell."""
    worst = 0.0
    for dim, counts in (FEW if quick else COUNTS).items():
        for count in counts:
            scene = column(0.1, dim=dim, steps=1, stretch=0.98, per_cell=count)
            worst = worst_of(worst, scene.error(last(scene.run(**choices))))
    return worst


def narrow_vibrating(choices, quick):
    """Largest error of a bar with free sides that fills one cell across, or parts of two."""
    worst = 0.0
    for aside in (0.5,) if quick else (1e-3, 0.5):
        mesh, body = rod(2, 2)
        x = body.x + np.array([[0.0], [aside]])
        worst = worst_of(worst, vibrate(mesh, replace(body, x=x), (), body.x[0], **choices))
    return worst


def narrow_standing(choices, quick):
    """Largest error of stress of a column one cell wide, free at one side, in one cell or parts of two."""
    worst, height = 0.0, 8
    for right in (0.5, 0.501, 1.0, 1.001, 1.5):
        wide = Particles.fill(MAKE[2](np.linspace(0, right, 2), np.arange(height + 1.0)), MOTION[2], density=1.0)
        mesh = MAKE[2](np.arange(-2.0, 5.0), np.arange(-2.0, height + 3))
        state = last(implicit_steps(mesh, wide, ELASTIC, low_planes(2), steps=1, gravity=pull(2), **choices))
        exact = np.zeros((3, 3, wide.n))
        exact[1, 1] = -1e-3 * (height - wide.x[1])
        worst = worst_of(worst, rms(np.linalg.norm(state.particles.stress - exact, axis=(0, 1))) / (1e-3 * height))
    return worst


def one_cell(dim, count):
    """A mesh of one cell, and the body that fills it."""
    mesh = MAKE[dim](*[np.array([0.0, 1.0])] * dim)
    return mesh, Particles.fill(mesh, MOTION[dim], per_cell=count, density=1.0)


def single_standing(choices, quick):
    """Largest difference of the mean stress from half the weight, relative to that, of a body in a mesh of one cell."""
    worst = 0.0
    for dim in (1, 2, 3):
        for count in (1, 2, 3):
            mesh, body = one_cell(dim, count)
            state = last(implicit_steps(mesh, body, ELASTIC, low_planes(dim), steps=1, gravity=pull(dim), **choices))
            worst = worst_of(worst, abs(mean_stress(state, dim) / -0.5e-3 - 1))
    return worst


def single_vibrating(choices, quick):
    """The same with gravity at once, where stress swings about that mean: its mean over time."""
    worst = 0.0
    for dim in (1, 2) if quick else (1, 2, 3):
        for count in (1, 2) if quick else (1, 2, 3):
            mesh, body = one_cell(dim, count)
            states = explicit_steps(mesh, body, ELASTIC, low_planes(dim), steps=75, gravity=pull(dim), dt=0.4,
                                    engine="numpy", **choices)
            worst = worst_of(worst, abs(np.mean([mean_stress(state, dim) for state in states]) / -0.5e-3 - 1))
    return worst


def mean_stress(state, dim):
    """Mean of the normal stress along gravity."""
    points = state.particles
    return points.volume @ points.stress[dim - 1, dim - 1] / points.volume.sum()


ROWS = [
    Row("1 to 64 points in a cell, a bar that vibrates in flight",
        """A bar of 8 cells between rollers vibrates and flies 2 cells in a period, with 1, 2, 3, 4, 8, 16, 32 or 64
        points in a cell, in two dimensions to 8 by 8 and in three to 4 by 4 by 4; the largest rms error of stress
        against the closed form, relative to its amplitude.  Linear functions alone make 8 %; no stress at all would
        score 50 %.""",
        many_vibrating, holds=0.1, useless=0.5, remedies=("xpic 2", "dual")),
    Row("1 to 64 points in a cell, a column (implicit)",
        """A column of 8 cells under its own weight, with so many points; rms error of stress relative to the largest.
        Linear functions alone make 4 %; no stress at all would score 58 %.""",
        many_standing, holds=0.08, useless=0.58,
        remedies=("eq10", "field", "cubic", "dual")),
    Row("a bar one cell wide, vibrating",
        """The bar in two dimensions, not in flight, with free sides 0.001 or 0.5 cells beside those of cells; measured
        as there.""",
        narrow_vibrating, holds=0.12, useless=0.5, remedies=("dual",)),
    Row("a column one cell wide (implicit)",
        """A column of 8 cells on a base, held by rollers at one side and free at the other, 0.5 to 1.5 cells wide;
        rms error of stress relative to the largest.  Linear functions alone make 4 %.""",
        narrow_standing, holds=0.08, useless=0.58, remedies=("eq10", "interior", "field", "cubic", "dual", "ghost")),
    Row("a mesh of one cell, gravity at once",
        """A body that fills a mesh of one cell, with 1 to 3 points along each axis, in one to three dimensions;
        difference of the mean stress over 30 transits of a wave from half the weight, relative to that.""",
        single_vibrating, holds=0.1, useless=0.5, remedies=("dual",), stops="leaves the grid"),
    Row("a mesh of one cell, under gravity (implicit)",
        """The same in equilibrium.""",
        single_standing, holds=1e-5, useless=0.1, stops="leaves the grid"),
]
