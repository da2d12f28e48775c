"""The grid shifted against the body: what an answer should not know of."""

from dataclasses import replace

import numpy as np
from skfem import MeshLine

from extremes.bodies import last, rms
from extremes.row import Row
from skfem_mpm import LinearElastic, Particles, explicit_steps, uniaxial
from skfem_mpm.scenes import block

ELASTIC = LinearElastic(E=1.0, nu=0.0)                # with density 1: waves of speed 1


def offsets(quick):
    """Along the diagonal of a cell."""
    return (np.arange(5) + 0.3) / 5 if quick else (np.arange(50) + 0.3) / 50


def spread(answers):
    """Largest less smallest answer, relative to their mean, of the worst kind of answer."""
    answers = np.array(answers)
    return float((np.ptp(answers, axis=0) / abs(answers.mean(axis=0))).max())


def period(times, swing):
    """Twice the time between the first two times at which a swing passes zero."""
    at = np.flatnonzero(np.diff(np.sign(swing)))[:2]
    zero = times[at] - swing[at] * (times[at + 1] - times[at]) / (swing[at + 1] - swing[at])
    return 2 * np.diff(zero)[0]


def vibrated(offset, choices, cells=8):
    """First period of the longest wave along a free bar, and the largest stress in it."""
    body = Particles.fill(MeshLine(np.arange(cells + 1.0)), uniaxial, density=1.0)
    mode = np.cos(np.pi * body.x[0] / cells)
    moving = replace(body, x=body.x + offset, velocity=1e-4 * mode[None])
    states = explicit_steps(MeshLine(np.arange(-3.0, cells + 4)), moving, ELASTIC, steps=90, dt=0.15, engine="numpy",
                            **choices)
    found = [(state.time, mode @ state.particles.velocity[0], abs(state.particles.sigma[0]).max()) for state in states]
    times, swing, stress = np.transpose(found)
    return period(times, swing), stress.max()


def of_vibration(choices, quick):
    """Spread of period and largest stress over offsets."""
    return spread([vibrated(offset, choices) for offset in offsets(quick)])


def settled(offset, choices):
    """Settlement of the top, and rms of the vertical stress, of a block that stands on a base."""
    scene = block(0.25, rotation=0.0, slide=0.0, steps=1, stretch=0.95, offset=offset)
    points, start = last(scene.run(**choices)).particles, scene.particles.x
    top = start[1] == start[1].max()
    return (start - points.x)[1, top].mean(), rms(points.stress[1, 1])


def of_settlement(choices, quick):
    """Spread of settlement and stress over offsets."""
    return spread([settled(offset, choices) for offset in offsets(quick)])


FREE = ("xpic 2",)
HELD = ("eq10", "interior", "overlap", "field", "field2", "cubic", "twin", "dual", "ghost")
ROWS = [
    Row("the grid shifted against a bar that vibrates",
        """A free bar of 8 cells vibrates on grids with 50 offsets (5 in the quick map): largest less smallest first
        period, or largest stress, relative to its mean, whichever is more.""",
        of_vibration, holds=0.1, useless=1.0, remedies=FREE),
    Row("the grid shifted against a block (implicit)",
        """A block of 4 by 4 cells with free sides stands on a base in mid-cell, its own weight shortens its lowest part
        by 5 %; the same for the settlement of its top and the rms of its vertical stress, with offsets along the
        diagonal of a cell.""",
        of_settlement, holds=0.1, useless=1.0, remedies=HELD, stops="residual|nothing is fixed|solver"),
]
