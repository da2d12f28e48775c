"""Long runs and many crossings."""

from dataclasses import replace

import numpy as np

from extremes.bodies import FASTEST, LAW, MAKE, block, grid_of, last, mechanical, with_noise, worst_of
from extremes.row import MUST, Row
from skfem_mpm import explicit_steps
from skfem_mpm.boundary import FixedPlane

TITLE = "Long runs"
WORDS = """
A free elastic block of 5 x 5 cells with 100 points that rings with random velocities of a thousandth of the wave speed,
or flies. The time step is the default one, half of the bound that runs take.
"""
TRANSFERS = ("usavg", "usl", "usf", "pic 1 %", "xpic 2", "tpic")
CELLS, NOISE = 5, 1e-3
GROWS, BREAKS = "times the|waves grow", "times the energy|inside out|more than a cell"
TENSION = 0.03
KEPT = 1e-9


def ringing(choices, steps, drift):
    """States of a block that rings and drifts across the grid, ``drift`` cells per thousand steps or so."""
    room = int(1.2 * drift * steps / 1000) + 8
    mesh = MAKE[2](np.arange(-4.0, CELLS + room), np.arange(-4.0, CELLS + 5))
    body = with_noise(block(2, CELLS, shift=0.24), NOISE)
    body = replace(body, velocity=body.velocity + [[2.5e-3 * drift], [0.0]])
    return body, explicit_steps(mesh, body, LAW[2], steps=steps, every=steps // 100, engine=FASTEST, **choices)


def internal(state):
    """Kinetic and elastic energy less that of the motion as a whole."""
    points = state.particles
    momentum = (points.mass * points.velocity).sum(axis=1)
    return mechanical(state) - momentum @ momentum / points.mass.sum() / 2


def momentum_lost(body, state):
    """Change of momentum relative to the sizes of its parts."""
    points = state.particles
    change = (points.mass * (points.velocity - body.velocity)).sum(axis=1)
    return float(abs(change).max() / (body.mass * abs(body.velocity)).sum())


def energy_drift(steps, drift):
    """Of a run of so many steps: how far the mean energy in its last tenth is from that in the first.

    Infinite if momentum is lost, which no choice may do.
    """
    def measure(choices, quick):
        body, states = ringing(choices, steps // 20 if quick else steps, drift)
        energy = []
        for state in states:
            energy.append(internal(state))
        kept = momentum_lost(body, state) < KEPT
        return abs(np.mean(energy[-10:]) / np.mean(energy[:10]) - 1) if kept else np.inf
    return measure


def momentum_drift(choices, quick):
    """Change of momentum of the drifting block."""
    body, states = ringing(choices, 5000 if quick else 100_000, 0.4)
    return momentum_lost(body, last(states))


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
        worst = worst_of(worst, abs(way).max(), abs(state.particles.sigma).max())
    return worst


def in_time(choices, quick):
    """The same with the integrator that is symmetric in time."""
    return flight({"integrator": "usavg", **choices}, quick)


def held_in_tension(choices, quick):
    """Largest velocity of a block that is held between planes under tension, and should stay at rest."""
    cells = 6
    body = with_noise(block(2, cells), 1e-6)
    sigma = np.zeros((4, body.n))
    sigma[0] = TENSION
    planes = [FixedPlane(axis, at, side) for axis in (0, 1) for at, side in ((0.0, -1), (float(cells), 1))]
    states = explicit_steps(grid_of(2, cells), replace(body, sigma=sigma), LAW[2], planes, refresh=50, engine=FASTEST,
                            steps=2000 if quick else 20_000, every=1000, **choices)
    return abs(last(states).particles.velocity).max()


ROWS = [
    Row("1000 crossings at constant speed, `usavg`",
        """A body of two cells flies through 1000 cells of an empty grid (50 in the quick map) at 0.2 of the wave speed,
        on a line and in the plane, with `integrator="usavg"`, which is symmetric in time; the largest stress in units
        of the modulus, or the largest way off the straight line in cells, which should both be zero.""",
        in_time, holds=1e-9, useless=1e-3, remedies=("xpic 2",), must=True, warns=GROWS,
        stops=f"{BREAKS}|leaves the grid"),
    Row("1000 crossings at constant speed, `musl`",
        """The same with the default integrator: each crossing multiplies rounding by some percent, in proportion to the
        time step.""",
        flight, holds=1e-9, useless=1e-3, remedies=("usavg", "xpic 2"), warns=GROWS,
        stops=f"{BREAKS}|leaves the grid"),
    Row("equilibrium in tension",
        """A block is held between planes under a tension of 3 % of its modulus, with noise of 1e-6 of the wave speed;
        its largest velocity after 20 000 steps (2000 in the quick map), by the wave speed. Stress that changes places
        with the points, and strain that lags behind them, make tension negative damping.""",
        held_in_tension, holds=1e-5, useless=0.01, remedies=TRANSFERS, warns="in tension", stops=BREAKS),
    Row("100 000 steps, points stay in their cells",
        """Energy that the ringing block has gained or lost, in the last tenth of the run relative to the first.  The
        quick map takes a twentieth of the steps.  A cell that loses a billionth of its momentum, too, is wrong.""",
        energy_drift(100_000, 0.0), holds=0.05, useless=1.0, remedies=TRANSFERS, warns=GROWS, stops=BREAKS),
    Row("100 000 steps, points cross cells",
        """The same while the block drifts across 40 cells.""",
        energy_drift(100_000, 0.4), holds=0.05, useless=1.0, remedies=TRANSFERS, warns=GROWS, stops=BREAKS),
    Row("a million steps, points stay in their cells",
        """The same over ten times the steps.""",
        energy_drift(1_000_000, 0.0), holds=0.05, useless=1.0, methods=MUST, warns=GROWS, stops=BREAKS),
    Row("a million steps, points cross cells",
        """The same while the block drifts across 400 cells.""",
        energy_drift(1_000_000, 0.4), holds=0.05, useless=1.0, methods=MUST, warns=GROWS, stops=BREAKS),
    Row("momentum over 100 000 steps",
        """Change of the momentum of the drifting block, relative to that of its points.""",
        momentum_drift, holds=KEPT, useless=1e-6, warns=GROWS, stops=BREAKS),
]
