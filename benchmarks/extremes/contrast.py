"""Stiffness and density that jump from point to point."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from skfem import MeshLine

from extremes.bodies import last, mechanical, misfit, until, with_noise
from extremes.row import Row
from skfem_mpm import LinearElastic, Particles, explicit_steps, implicit_steps, uniaxial
from skfem_mpm.boundary import Wall

SOFT, HARD = 10, 10                          # cells of the ends and of the middle of a bar
CELLS = 2 * SOFT + HARD
RATIO = 1e8                                  # of stiffness
DENSE = 1e6                                  # of density
UNIT = LinearElastic(E=1.0, nu=0.0)
STIFFNESS = "stiffness differs"
PUSH = 1e-6


@dataclass(frozen=True, eq=False)
class Patches:
    """Elasticity with a Young's modulus for each point and no lateral contraction; small strain in one dimension."""

    E: np.ndarray
    kirchhoff = False
    history = ()

    def update(self, strain, stress, history, components):
        return stress + self.E * strain, history

    def tangent(self, strain, stress, history, places):
        return UNIT.tangent(strain, stress, history, places) * self.E

    def energy_density(self, sigma, epsilon, components):
        return sigma[0] ** 2 / (2 * self.E)


def bar(shift):
    """Points of a bar on a grid that is moved against it, and which of them are in its middle."""
    body = Particles.fill(MeshLine(np.arange(CELLS + 1.0)), uniaxial, density=1.0)
    return MeshLine(np.arange(-4.0, CELLS + 5) - shift), body, abs(body.x[0] - CELLS / 2) < HARD / 2


# -- stiffness --------------------------------------------------------------------------------------------------------

def in_series(choices, quick, shift=0.0, alternate=False):
    """Error of the force that pulls a bar of soft and hard parts in series."""
    mesh, body, hard = bar(shift)
    if alternate:
        hard = np.arange(body.n) % 2 == 1
    law = Patches(np.where(hard, RATIO, 1.0))
    ends = [Wall(np.array([[0.0]]), (0.0,), name="left"), Wall(np.array([[float(CELLS)]]), (PUSH,), name="right")]
    state = last(implicit_steps(mesh, body, law, ends, steps=1, strain="small", **choices))
    return abs(state.reactions["right"][0] * (body.volume / law.E).sum() / PUSH - 1)


def shaken(choices, quick):
    """Drift of the energy of a free bar of random velocities, whose middle is far stiffer."""
    mesh, body, hard = bar(0.3)
    law, body = Patches(np.where(hard, RATIO, 1.0)), with_noise(body, PUSH)
    state = last(explicit_steps(mesh, body, law, steps=300 if quick else 3000, every=10 ** 9, **choices))
    return abs(mechanical(state) / state.energy["start"] - 1)


# -- density, and waves at both ---------------------------------------------------------------------------------------

def quarter_waves(x):
    """Shape of waves in the ends, opposite to each other; the middle stays where it is."""
    left, right = np.cos(np.pi * x / (2 * SOFT)), -np.cos(np.pi * (CELLS - x) / (2 * SOFT))
    return np.where(x < SOFT, left, np.where(x > CELLS - SOFT, right, 0.0))


FREQUENCY = np.pi / (2 * SOFT)
EIGHTH = np.pi / 4 / FREQUENCY


def wave_error(body, state):
    """Displacement of the ends against quarter waves, rms."""
    shape = quarter_waves(body.x[0])
    exact, moved = PUSH * np.sin(FREQUENCY * state.time) * shape, state.particles.x[0] - body.x[0]
    ends = shape != 0
    return misfit(moved[ends], exact[ends])


def swinging(body):
    return replace(body, velocity=PUSH * FREQUENCY * quarter_waves(body.x))


def on_stiff(choices, quick, ratio):
    """Waves in two bars that a far stiffer one joins."""
    mesh, body, hard = bar(0.3)
    return wave_error(body, after_an_eighth(mesh, swinging(body), Patches(np.where(hard, ratio, 1.0)), choices))


def after_an_eighth(mesh, body, law, choices):
    return until(EIGHTH, explicit_steps(mesh, body, law, steps=10 ** 9, every_seconds=EIGHTH / 10, **choices))


def dense():
    """A bar whose middle is far denser."""
    mesh, body, heavy = bar(0.3)
    return mesh, replace(body, mass=body.mass * np.where(heavy, DENSE, 1.0))


def on_dense(choices, quick):
    """Waves in two bars that a far denser one joins."""
    mesh, body = dense()
    return wave_error(body, after_an_eighth(mesh, swinging(body), UNIT, choices))


def on_dense_implicit(choices, quick):
    mesh, body = dense()
    state = last(implicit_steps(mesh, swinging(body), UNIT, steps=20, dt=EIGHTH / 20, **choices))
    return wave_error(body, state)


def momentum(choices, quick, implicit):
    """Change of momentum of a shaken bar whose middle is far denser, over the sum of its parts' sizes."""
    mesh, body = dense()
    body = with_noise(body, 1e-3)
    if implicit:
        state = last(implicit_steps(mesh, body, UNIT, steps=20, dt=0.5, **choices))
    else:
        state = last(explicit_steps(mesh, body, UNIT, steps=200, every=200, **choices))
    flow = body.mass * body.velocity
    return abs((body.mass * state.particles.velocity).sum() - flow.sum()) / abs(flow).sum()


SERIES = """A bar of 10 soft, 10 hard and 10 soft cells, Young's moduli 1 : 1e8, is pulled by 1e-6; the error of the
            force against that of the parts in series."""
WAVES = """Waves swing in the ends of a bar whose middle is {}; the interfaces lie inside cells. Error of the ends'
           displacement after an eighth of the period, rms, against quarter waves on a wall."""

ROWS = [
    Row("stiffness 1 : 1e8 across a face, implicit", SERIES, in_series, holds=0.01, useless=0.5, warns=STIFFNESS,
        remedies=("twin", "dual")),
    Row("stiffness 1 : 1e8 inside a cell, implicit",
        SERIES + " The interfaces lie inside cells: stiffness is off by up to a cell of ten.",
        partial(in_series, shift=0.3), holds=0.1, useless=0.5, warns=STIFFNESS, remedies=("twin", "dual")),
    Row("stiffness 1 : 1e8 from point to point, implicit",
        "The same bar with points that are soft and hard in turn.",
        partial(in_series, alternate=True), holds=0.1, useless=0.5, warns=STIFFNESS),
    Row("stiffness 1 : 1e8, explicit: energy",
        """A free bar whose middle is far stiffer is shaken at random for 3000 steps of the stiff part (quick: 300); the
        change of its energy.""", shaken, holds=0.05, useless=0.5, warns=STIFFNESS, stops="times the energy"),
    Row("stiffness 1 : 1e3, explicit: waves", WAVES.format("1000 times stiffer"), partial(on_stiff, ratio=1e3),
        holds=0.1, useless=0.5, warns=STIFFNESS, stops="times the energy"),
    Row("density 1 : 1e6, explicit: waves", WAVES.format("a million times denser"), on_dense, holds=0.1, useless=0.5),
    Row("density 1 : 1e6, implicit: waves", WAVES.format("a million times denser"), on_dense_implicit, holds=0.1,
        useless=0.5),
    Row("density 1 : 1e6, explicit: momentum",
        """A free bar whose middle is a million times denser is shaken at random; the change of its momentum after 200
        steps, over the sum of its parts' sizes.""", partial(momentum, implicit=False), holds=1e-12, useless=1e-6),
    Row("density 1 : 1e6, implicit: momentum", "The same in 20 steps of half a cell over the wave speed.",
        partial(momentum, implicit=True), holds=1e-9, useless=1e-4),
]
