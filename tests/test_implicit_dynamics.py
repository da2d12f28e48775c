"""Newmark steps fall, vibrate and keep what they should; numerical damping damps what it should."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import every_method
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    Control,
    Hencky,
    LinearElastic,
    Particles,
    VonMises,
    axisymmetric,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall

LAW = LinearElastic(E=100.0, nu=0.3)


def last(run):
    *_, state = run
    return state


def square(velocity=None, shift=0.0):
    """A free square in the middle of a grid, with a velocity ``(2, n)`` or the same one for all points."""
    axis = np.linspace(-2, 3, 21)
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, density=3.0, where=lambda x: (abs(x - 0.5) < 0.5).all(axis=0))
    if velocity is not None:
        body = replace(body, velocity=np.array(velocity(body.x)) * np.ones((2, body.n)))
    return mesh, replace(body, x=body.x + shift)


# A body that nothing holds.

@every_method
@pytest.mark.parametrize("damping", [0.0, 0.3])
@pytest.mark.parametrize("shift", [0.0, 0.03])
def test_a_body_falls_along_a_parabola(method, damping, shift):
    """From a speed of its own and through the grid; with a constant load any damping is exact."""
    mesh, body = square(lambda x: [[0.3], [0.7]], shift)
    g = np.array([[0.1], [-2.0]])
    for state in implicit_steps(mesh, body, LAW, steps=8, dt=0.1, gravity=g[:, 0], method=method,
                                numerical_damping=damping):
        t = 0.1 * state.step
        assert state.time == pytest.approx(t)
        assert_allclose(state.particles.x - body.x, t * body.velocity + t**2 / 2 * g, atol=1e-12)
        assert_allclose(state.particles.velocity, body.velocity + t * g, atol=1e-12)
        assert_allclose(state.acceleration, g * np.ones((1, body.n)), atol=1e-11)
        assert_allclose(state.particles.sigma / LAW.E, 0, atol=1e-13)
        assert state.energy["elastic"] < 1e-12


def test_gravity_that_changes_is_followed_by_the_trapezoidal_rule():
    """Gravity is asked for by the step, at both ends of the first one."""
    mesh, body = square()
    state = last(implicit_steps(mesh, body, LAW, steps=5, dt=0.1, gravity=lambda step: (0.0, -0.1 * step)))
    assert_allclose(state.particles.velocity[1], -0.5 * 0.5 / 2, rtol=1e-12)       # the integral of a ramp is exact


@every_method
@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_a_free_body_that_deforms_keeps_its_momentum(method, damping):
    mesh, body = square(lambda x: [0.2 + 0.5 * (x[1] - 0.5), 0.3 * x[1] - 0.5 * (x[0] - 0.5)])
    before = (body.mass * body.velocity).sum(axis=1)
    state = last(implicit_steps(mesh, body, Hencky(E=100.0, nu=0.3), steps=15, dt=0.05, method=method,
                                numerical_damping=damping))
    assert np.abs(state.particles.sigma).max() > 0.005 * LAW.E
    assert np.abs(state.particles.x - body.x).max() > 0.25                          # more than a cell
    assert_allclose((state.particles.mass * state.particles.velocity).sum(axis=1), before, rtol=1e-11)


def test_momentum_grows_with_the_load():
    mesh, body = square(lambda x: [x[0], x[1]])
    before = (body.mass * body.velocity).sum(axis=1)
    state = last(implicit_steps(mesh, body, LAW, steps=10, dt=0.05, method="gimp", gravity=(1.0, -2.0)))
    gained = (state.particles.mass * state.particles.velocity).sum(axis=1) - before
    assert_allclose(gained, body.mass.sum() * 0.5 * np.array([1.0, -2.0]), rtol=1e-10)


# A bar that vibrates: 25 m long, fixed at one end.

LENGTH, CELLS, BAR = 25.0, 16, LinearElastic(E=100.0, nu=0.0)
H = LENGTH / CELLS
EXPLICIT = H / 10.0                                                      # limit of explicit steps, h / c


def bar(speed, n, dt, steps, method="mpm", **choices):
    """States of the bar in its mode ``n``."""
    mesh = MeshLine(np.arange(-1, CELLS + 3) * H)
    body = Particles.fill(mesh, uniaxial, where=lambda x: (x[0] > 0) & (x[0] < LENGTH))
    wave = (2 * n - 1) * np.pi / (2 * LENGTH)
    nodes = np.arange(CELLS + 1) * H
    shape = np.interp(body.x[0], nodes, np.sin(wave * nodes))           # as the grid has it
    body = replace(body, velocity=speed * shape[None])
    run = implicit_steps(mesh, body, BAR, [FixedPlane(0, 0.0, -1)], steps=steps, dt=dt, method=method, strain="small",
                         floor=0.0, **choices)
    return body, shape, run


@pytest.mark.parametrize("method", ["mpm", "gc"])
def test_a_bar_vibrates_with_its_period_and_amplitude(method):
    """V4: mean velocity v0 / (beta L) cos(omega t), with points crossing no cells."""
    _, _, run = bar(0.1, 1, EXPLICIT, 128, method)                       # two periods of 10 s
    found = np.array([(s.particles.mass * s.particles.velocity[0]).sum() / s.particles.mass.sum() for s in run])
    time = EXPLICIT * np.arange(1, 129)
    exact = 0.2 / np.pi * np.cos(0.2 * np.pi * time)
    assert np.linalg.norm(found - exact) < 0.025 * np.linalg.norm(exact)


def amplitudes(n, dt, steps, damping):
    """Velocity of the mode by theory: nodes follow Newmark, and mapping to lumped mass smooths by a factor p.

    Two points on quarter points have p = (5 + 3 cos(kh)) / 8.
    """
    kh = (2 * n - 1) * np.pi / (2 * CELLS)
    p, omega = (5 + 3 * np.cos(kh)) / 8, 2 / H * np.sqrt(BAR.E) * np.sin(kh / 2)
    gamma = 0.5 + damping
    beta = (0.5 + gamma) ** 2 / 4
    u, v, a, found = 0.0, 1.0, 0.0, []
    for _ in range(steps):
        ahead = u + p * (dt * v + dt**2 * (0.5 - beta) * a)
        u = ahead / (1 + beta * (dt * omega) ** 2)
        v, a = v + dt * ((1 - gamma) * a - gamma * omega**2 * u), -omega**2 * u
        found.append(v)
    return np.array(found)


@pytest.mark.parametrize("n", [1, 5, 16])
@pytest.mark.parametrize("damping", [0.0, 0.2])
@pytest.mark.parametrize("dt", [0.5, 5.0, 20.0])
def test_every_mode_moves_as_theory_says(n, damping, dt):
    """A tiny amplitude, so points stay where they are; the step is up to 20 times that of explicit runs."""
    dt *= EXPLICIT
    _, shape, run = bar(1e-7, n, dt, 25, numerical_damping=damping)
    found = np.array([(s.particles.velocity[0] @ shape) / (shape @ shape) for s in run]) / 1e-7
    assert_allclose(found, amplitudes(n, dt, 25, damping), atol=2e-6)


def test_the_trapezoidal_rule_is_of_second_order():
    """Steps from the period / 16 on; damping makes it first order."""
    def at_end(steps, damping):
        state = last(bar(1e-6, 1, 3.0 / steps, steps, numerical_damping=damping)[2])
        return np.concatenate([state.particles.velocity[0], state.particles.sigma[0] / 10])

    for damping, order in ((0.0, 2), (0.2, 1)):
        ends = [at_end(steps, damping) for steps in (10, 20, 40)]
        found = np.log2(np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(ends[2] - ends[1]))
        assert found == pytest.approx(order, abs=0.2)


def test_without_damping_energy_is_kept_and_with_it_the_highest_mode_goes_first():
    """Of the lowest mode in a period, and of the highest one over as many steps."""
    def left(n, damping):
        body, _, run = bar(1e-6, n, 2 * EXPLICIT, 32, numerical_damping=damping)
        energy = last(run).energy
        return (energy["kinetic"] + energy["elastic"]) / (body.mass * body.velocity**2 / 2).sum()

    lowest, damped = left(1, 0.0), left(1, 0.1)
    assert lowest == pytest.approx(1, abs=3e-3)
    assert 0.6 < damped < lowest
    assert left(16, 0.1) < 1e-3


@pytest.mark.parametrize("method", ["mpm", "gimp"])
def test_a_body_comes_to_rest_where_load_steps_put_it(method):
    """Sudden gravity, 20 times the explicit step, and damping: it ends in the static equilibrium."""
    axis = np.linspace(-0.25, 1.5, 8)
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, density=2.0, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    held = [FixedPlane(1, 0.0, -1, (0, 1), name="base")]
    choices = dict(gravity=(0.0, -1e-4), method=method, floor=0.0)
    still = next(implicit_steps(mesh, body, LAW, held, steps=1, **choices))
    limit = 0.25 / np.sqrt((LAW.lam + 2 * LAW.G) / 2.0)
    state = last(implicit_steps(mesh, body, LAW, held, steps=40, dt=20 * limit, numerical_damping=0.5, **choices))
    assert_allclose(state.particles.x - body.x, still.particles.x - body.x, atol=1e-3 * 1e-6)
    assert_allclose(state.particles.sigma, still.particles.sigma, atol=1e-3 * np.abs(still.particles.sigma).max())
    assert state.reactions["base"][1] == pytest.approx(still.reactions["base"][1], rel=1e-3)


def test_the_reaction_of_a_body_that_starts_to_fall_carries_less_than_its_weight():
    """Reactions are true forces: the momentum of the body changes by weight and reaction."""
    mesh = MeshLine(np.arange(-1, 12) / 10)
    body = Particles.fill(mesh, uniaxial, density=3.0, where=lambda x: (x[0] > 0) & (x[0] < 1))
    forces, moments = [0.0], [0.0]
    for state in implicit_steps(mesh, body, LAW, [FixedPlane(0, 0.0, -1, name="base")], steps=10, dt=0.01,
                                gravity=(-1e-3,), method="mpm"):
        forces.append(state.reactions["base"][0])
        moments.append((body.mass * state.particles.velocity[0]).sum())
    assert 0 < forces[1] < 0.5 * 3e-3
    assert moments[-1] < 0
    # Mass lumped to the fixed node does not move: its weight goes straight into the plane.
    assert abs(np.trapezoid(forces, dx=0.01) - 3e-3 * 0.1 - moments[-1]) < 0.1 * 3e-3 * 0.1


def test_a_wall_pushes_a_body_ahead():
    mesh, body = square()
    face = np.stack([np.zeros(5), np.linspace(0, 1, 5)])
    state = last(implicit_steps(mesh, body, LAW, [Wall(face, (0.02, None), name="push")], steps=20, dt=0.2,
                                numerical_damping=0.5))
    assert_allclose(state.boundary[0].x[0], 0.4, rtol=1e-12)
    assert (state.particles.x[0] - body.x[0]).mean() == pytest.approx(0.4, abs=0.02)
    assert state.particles.velocity[0].mean() == pytest.approx(0.1, rel=0.1)


# Runs and states.

def dropped(steps=6, method="gimp", law=None, **choices):
    """Soil that falls, hits nothing and is squeezed by its own waves, on a plane."""
    axis = np.linspace(-0.5, 2, 11)
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, density=2.0, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    body = replace(body, velocity=np.stack([0 * body.x[0], -0.5 * body.x[1]]))
    given = dict(start=body, boundary=[FixedPlane(1, 0.0, -1, (0, 1), name="base")], gravity=(0.0, -1.0), dt=0.05,
                 numerical_damping=0.1)
    given |= choices
    return implicit_steps(mesh, given.pop("start"), law or LAW, given.pop("boundary"), steps=steps, method=method,
                          **given)


@pytest.mark.parametrize("law", [LAW, VonMises(E=100.0, nu=0.3, peak=1.0, residual=0.3, softening=-5.0)], ids=repr)
@every_method
def test_a_run_goes_on_from_a_state_as_if_it_had_never_stopped(method, law):
    whole = list(dropped(6, method, law))
    half = pickle.loads(pickle.dumps(whole[2]))
    assert not half.acceleration.flags.writeable
    rest = list(dropped(3, method, law, start=half, boundary=None))
    for one, two in zip(whole[3:], rest):
        assert (one.step, one.time, one.residuals) == (two.step, two.time, two.residuals)
        assert_array_equal(one.acceleration, two.acceleration)
        for name, array in one.particles.arrays().items():
            assert_array_equal(two.particles.arrays()[name], array)
    assert whole[-1].particles.history is None or whole[-1].particles.history.max() > 0


def test_a_step_that_is_cut_is_two_steps_of_half_the_time():
    """A body thrown through its own length within a step turns inside out, in the first pass."""
    fast = dict(law=Hencky(E=100.0, nu=0.3), dt=1.0, numerical_damping=0.0, max_cuts=8)
    state = next(dropped(1, "mpm", gravity=(0.0, -60.0), **fast))
    assert state.cuts > 0 and state.time == 1.0
    parts = 2 ** state.cuts
    small = last(dropped(parts, "mpm", gravity=(0.0, -60.0), **(fast | dict(dt=1.0 / parts))))
    assert_allclose(state.particles.x, small.particles.x, atol=1e-9)
    assert_allclose(state.acceleration, small.acceleration, atol=1e-6)


def test_a_load_step_comes_to_rest_and_time_steps_go_on_from_it():
    """From equilibrium nothing moves; what moved before a load step does not move after it."""
    moving = next(dropped(1))
    still = next(dropped(1, start=moving, dt=None, numerical_damping=0.0))
    assert still.particles.velocity is None and still.acceleration is None and still.time == moving.time
    after = next(dropped(1, start=still))
    assert np.abs(after.particles.x - still.particles.x).max() < 1e-2 * np.abs(moving.displacement).max()


def test_axial_symmetry_moves_in_time():
    """A ring that is let go breathes about its radius: omega = sqrt(E / density) / r for a thin one."""
    mesh = MeshLine(9.8 + 0.1 * np.arange(7))
    ring = Particles.fill(mesh, axisymmetric, where=lambda x: abs(x[0] - 10.1) < 0.1)
    ring = replace(ring, velocity=np.full((1, ring.n), 1e-4))
    omega = np.sqrt(100.0) / 10.1
    run = list(implicit_steps(mesh, ring, LinearElastic(E=100.0, nu=0.0), steps=40, dt=np.pi / omega / 40))
    mean = np.array([state.particles.velocity.mean() for state in run])
    assert mean[-1] == pytest.approx(-1e-4, rel=2e-2)
    assert abs(mean[19]) < 2e-6


def test_energy_needs_a_law_with_an_energy():
    class Bare:
        kirchhoff, history, E = False, (), 1.0
        update, tangent = LAW.update, LAW.tangent

    state = next(dropped(1, law=Bare(), strain="small"))
    assert np.isnan(state.energy["elastic"]) and state.energy["kinetic"] > 0


# Bad input.

@pytest.mark.parametrize("wrong, match", [
    (dict(dt=0.0), "^dt: got 0.0"), (dict(dt=-1.0), "^dt: got -1.0"), (dict(dt=np.inf), "^dt: got inf"),
    (dict(dt="1"), "^dt: got '1'"), (dict(numerical_damping=-0.1), "^numerical_damping: got -0.1"),
    (dict(numerical_damping=None), "^numerical_damping: got None"),
    (dict(dt=None), "^numerical_damping: got some without a time step"),
    (dict(scheme="incremental"), "^scheme: got 'incremental' with dt"),
    (dict(control=Control((0.0, 1.0), (0.0, 1.0), 0.1)), "^control: got one with dt"),
    (dict(dt=None, numerical_damping=0.0, boundary=[]), "^boundary: got nothing that holds the body"),
], ids=str)
def test_what_makes_no_sense_is_refused_before_anything_runs(wrong, match):
    with pytest.raises(ValueError, match=match):
        dropped(**wrong)
