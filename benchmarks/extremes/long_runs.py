"""Long runs and many crossings."""

from dataclasses import replace

import numpy as np

from extremes.bodies import FASTEST, LAW, MAKE, block, last, mechanical, with_noise
from extremes.row import MUST, Row
from skfem_mpm import explicit_steps

TITLE = "Long runs"
WORDS = """
A free elastic block of 5 x 5 cells with 100 points that rings with random velocities of a thousandth of the wave speed,
or flies. The time step is the default one, half of the sure bound.
"""
TRANSFERS = ("usl", "usf", "pic 1 %", "xpic 2", "tpic")
CELLS, NOISE = 5, 1e-3
GROWS = "times the energy|elastic waves grow"


def ringing(choices, steps, drift):
    """States of a block that rings and drifts across the grid, ``drift`` cells per thousand steps or so."""
    room = int(drift * steps / 1000) + 8
    mesh = MAKE[2](np.arange(-4.0, CELLS + room), np.arange(-4.0, CELLS + 5))
    body = with_noise(block(2, CELLS, shift=0.24), NOISE)
    body = replace(body, velocity=body.velocity + [[2.5e-3 * drift], [0.0]])
    return body, explicit_steps(mesh, body, LAW[2], steps=steps, every=steps // 100, engine=FASTEST, **choices)


def internal(state):
    """Kinetic and elastic energy less that of the motion as a whole."""
    points = state.particles
    momentum = (points.mass * points.velocity).sum(axis=1)
    return mechanical(state) - momentum @ momentum / points.mass.sum() / 2


def energy_drift(steps, drift):
    """Of a run of so many steps: how far the mean energy in its last tenth is from that in the first."""
    def measure(choices, quick):
        count = steps // 20 if quick else steps
        energy = np.array([internal(state) for state in ringing(choices, count, drift)[1]])
        return abs(energy[-10:].mean() / energy[:10].mean() - 1)
    return measure


def momentum_drift(choices, quick):
    """Change of momentum relative to the sizes of its parts."""
    body, states = ringing(choices, 5000 if quick else 100_000, 0.4)
    points = last(states).particles
    change = (points.mass * (points.velocity - body.velocity)).sum(axis=1)
    return float(abs(change).max() / (body.mass * abs(body.velocity)).sum())


def flight(choices, quick):
    """Largest stress, or way off the straight line, after 1000 crossings on a line and in the plane."""
    crossings, speed, worst = 50 if quick else 1000, 0.2, 0.0
    for dim in (1, 2):
        mesh = MAKE[dim](*[np.arange(-4.0, crossings + 50), np.arange(-4.0, 8.0)][:dim])
        body = block(dim, 2, shift=0.1)
        velocity = np.zeros_like(body.x)
        velocity[0] = speed
        for state in explicit_steps(mesh, replace(body, velocity=velocity), LAW[dim], steps=10 ** 6, every=100,
                                    engine=FASTEST, **choices):
            if state.time * speed > crossings:
                break
        way = state.particles.x - body.x - velocity * state.time
        worst = max(worst, abs(way).max(), abs(state.particles.sigma).max())
    return worst


ROWS = [
    Row("1000 crossings at constant speed",
        """A body of two cells flies through 1000 cells of an empty grid (50 in the quick map) at 0.2 of the wave speed,
        on a line and in the plane; the largest stress in units of the modulus, or the largest way off the straight line
        in cells, which should both be zero.""",
        flight, holds=1e-9, useless=1e-3, remedies=TRANSFERS, must=True, warns=GROWS, stops="times the energy"),
    Row("100 000 steps, points stay in their cells",
        """Energy that the ringing block has gained or lost, in the last tenth of the run relative to the first.  The
        quick map takes a twentieth of the steps.""",
        energy_drift(100_000, 0.0), holds=0.05, useless=1.0, remedies=TRANSFERS, warns=GROWS,
        stops="times the energy"),
    Row("100 000 steps, points cross cells",
        """The same while the block drifts across 40 cells.""",
        energy_drift(100_000, 0.4), holds=0.05, useless=1.0, remedies=TRANSFERS, warns=GROWS,
        stops="times the energy"),
    Row("a million steps, points stay in their cells",
        """The same over ten times the steps.""",
        energy_drift(1_000_000, 0.0), holds=0.05, useless=1.0, methods=MUST, warns=GROWS, stops="times the energy"),
    Row("a million steps, points cross cells",
        """The same while the block drifts across 400 cells.""",
        energy_drift(1_000_000, 0.4), holds=0.05, useless=1.0, methods=MUST, warns=GROWS, stops="times the energy"),
    Row("momentum over 100 000 steps",
        """Change of the momentum of the drifting block, relative to that of its points.""",
        momentum_drift, holds=1e-9, useless=1e-6, remedies=TRANSFERS, warns=GROWS, stops="times the energy"),
]
