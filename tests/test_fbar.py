"""Points that answer to the mean dilation of their cells: a potential, its exact tangent, and no locking."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csr_array
from shared import MAKE
from skfem import MeshQuad

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    Particles,
    VonMises,
    axisymmetric,
    implicit_steps,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.grid import Grid
from skfem_mpm.implicit import State, _check, solve
from skfem_mpm.implicit.step import Step, _Problem
from skfem_mpm.integration.dilation import Means, shares_of

MOTIONS = [(plane_strain, 2), (axisymmetric, 1), (axisymmetric, 2), (solid, 3)]
STIFF = LinearElastic(E=1.0, nu=0.4999)
LAWS = {"small": (STIFF, VonMises(E=1.0, nu=0.4999, peak=5e-3, residual=1e-3, softening=-1e-3)),
        "logarithmic": (Hencky(E=1.0, nu=0.4999), VonMises(E=1.0, nu=0.4999, peak=5e-3, residual=5e-3))}
CONJUGATE = [("mpm", "points"), ("gimp", "points"), ("cmpm-c", "points"), ("mpm", "twin")]
every_motion = pytest.mark.parametrize("kinematics, dim", MOTIONS, ids=["plane", "line", "rings", "space"])
every_strain = pytest.mark.parametrize("strain", LAWS)


def boxed(kinematics, dim, cells=2, shake=0.04, shift=0.0):
    """A box of shaken points from 1 to 2 along every axis on a grid with two spare cells around."""
    h, lines = 1 / cells, np.linspace(1, 2, cells + 1)
    body = Particles.fill(MAKE[dim](*[lines] * dim), kinematics)
    noise = shake * h * np.random.default_rng(0).uniform(-1, 1, body.x.shape)
    axis = 1 + h * (np.arange(-2, cells + 3) - shift)
    return MAKE[dim](*[axis] * dim), replace(body, x=body.x + noise)


def step_of(mesh, body, law, method="mpm", integration="points", strain="logarithmic", boundary=(), **more):
    """A step before it is solved."""
    options = _check(method, strain, "equilibrated", "one", integration, "ghost", None, 1e-6, 0.1, 1e-11, None)
    state = State(0, body, tuple(boundary), np.zeros((body.dim, 0)), {})
    return Step(mesh, state, law, replace(options, **{"remedy": "bbar", **more}))


def answers(step):
    """What a step makes of the unknowns, without walls."""
    size = len(step.support.free)
    problem = _Problem(np.zeros(size), csr_array((0, size)), np.zeros(0), csr_array((size, 0)))
    return size, lambda unknowns: step._iterate(problem, unknowns, np.zeros(0))


def last(run):
    *_, state = run
    return state


# The mean.

@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("boxes", [False, True])
def test_the_mean_over_cells_is_self_adjoint_and_keeps_constants(dim, boxes):
    mesh, body = boxed({1: axisymmetric, 2: plane_strain, 3: solid}[dim], dim, cells=3, shake=0.4)
    grid = Grid.from_mesh(mesh)
    index = grid.locate(body.x)
    stencil = grid.gimp(body.x, index, body.length, "ghost", None) if boxes else grid.linear(body.x, index)
    means = Means(shares_of(grid, stencil), body.volume)
    one, two = np.random.default_rng(1).normal(size=(2, body.n))
    mean, other = one + means.lack(one), two + means.lack(two)
    assert_allclose(means.lack(np.full(body.n, 0.7)), 0, atol=1e-14)
    assert_allclose(body.volume @ (mean * two), body.volume @ (one * other), rtol=1e-12)
    assert_allclose(body.volume @ mean, body.volume @ one, rtol=1e-12)
    again = np.abs(means.lack(mean)).max()
    assert again < 1e-14 if not boxes else again > 1e-3         # a projection where cells do not share points
    assert body.volume @ mean ** 2 < body.volume @ one ** 2


# Force and tangent.

def combined(pairs):
    """Every motion with every pair of method and integration; fields in 3-D are slow, and no other code than in 2-D."""
    cases = [(*motion, *pair) for motion in MOTIONS for pair in pairs if motion[1] < 3 or pair[1] == "points"]
    return pytest.mark.parametrize("kinematics, dim, method, integration", cases,
                                   ids=lambda value: getattr(value, "name", value))


@every_strain
@pytest.mark.parametrize("which", [0, 1], ids=["elastic", "plastic"])
@combined([*CONJUGATE, ("cmpm", "points"), ("gc", "points"), ("gimp", "field")])
def test_the_tangent_is_the_derivative_of_the_force(kinematics, dim, strain, which, method, integration):
    law = LAWS[strain][which]
    step = step_of(*boxed(kinematics, dim), law, method, integration, strain)
    size, answer = answers(step)
    u, direction = np.random.default_rng(1).normal(size=(2, size))
    at, tiny = answer(0.02 * u), 1e-6
    if law.history:
        assert (at.response.history > 1e-3).mean() > 0.5
    stiffness = step._stiffness(at.response.tangent())
    above, below = (answer(0.02 * u + sign * tiny * direction).force for sign in (1, -1))
    change = (above - below) / (2 * tiny)
    assert_allclose(stiffness @ direction, change, atol=1e-8 * np.abs(change).max())
    conjugate = integration == "twin" or (METHODS[method].conjugate and integration == "points")
    if conjugate and (strain == "small" or law.kirchhoff):
        assert abs(stiffness - stiffness.T).max() < 1e-14 * abs(stiffness).max()


@combined(CONJUGATE)
def test_the_force_is_the_derivative_of_an_energy(kinematics, dim, method, integration):
    law = Hencky(E=1.0, nu=0.45)
    step = step_of(*boxed(kinematics, dim), law, method, integration)
    step.soft = 0 * step.soft
    size, answer = answers(step)
    u, direction = np.random.default_rng(2).normal(size=(2, size))

    def energy(unknowns):
        response = answer(unknowns).response
        density = law.energy_density(response.sigma, response.epsilon, kinematics.components)
        return step.operator.volume @ (response.ratio * density)

    tiny = 1e-5
    power = (energy(0.02 * u + tiny * direction) - energy(0.02 * u - tiny * direction)) / (2 * tiny)
    assert answer(0.02 * u).force @ direction == pytest.approx(power, rel=1e-6)


@every_strain
def test_rigid_motion_makes_no_stress(strain):
    step = step_of(*boxed(plane_strain, 2, cells=3), LAWS[strain][0], strain=strain)
    x = np.stack([part.ravel() for part in np.meshgrid(*step.support.grid.axes, indexing="ij")])
    angle = 0.4 if strain == "logarithmic" else 1e-9
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    response = step.motion.respond(step.operator.gradient(turn @ x + 0.1 - x))
    assert_allclose(response.sigma, 0, atol=1e-14 * STIFF.lam)
    assert_allclose(response.ratio, 1, atol=1e-14)


@every_motion
@every_strain
@pytest.mark.parametrize("method, integration", [*CONJUGATE, ("gc", "points")])
def test_affine_motion_is_what_it_is_without(kinematics, dim, strain, method, integration):
    """Stress of a homogeneous gradient is that of the points themselves."""
    found = []
    for remedy in ("none", "bbar"):
        step = step_of(*boxed(kinematics, dim), LAWS[strain][0], method, integration, strain, remedy=remedy)
        x = np.stack([part.ravel() for part in np.meshgrid(*step.support.grid.axes, indexing="ij")])
        random = 0.05 * np.random.default_rng(3).normal(size=(dim, dim))
        if kinematics is axisymmetric:
            random[0, 1:] = 0
        response = step.motion.respond(step.operator.gradient(random @ x))
        found.append((response.sigma, response.piola, response.ratio))
    for without, averaged in zip(*found):
        assert_allclose(averaged, without, atol=1e-10 * np.abs(without).max())


@every_strain
def test_bending_that_keeps_volume_makes_no_pressure(strain):
    """u = (x y, -(x^2 + y^2) / 2) about the middle: its interpolation dilates every point and no cell."""
    step = step_of(*boxed(plane_strain, 2, cells=4, shake=0.0), STIFF, strain=strain)
    x, y = (part.ravel() - 1.5 for part in np.meshgrid(*step.support.grid.axes, indexing="ij"))
    gradient = step.operator.gradient(1e-8 * np.stack([x * y, -(x ** 2 + y ** 2) / 2]))
    means = [response.sigma[:3].mean(axis=0) for response in
             (step.motion.motion.respond(gradient), step.motion.respond(gradient))]
    inside = (np.abs(step.particles.x - 1.5) < 0.25).all(axis=0)
    assert np.abs(means[1][inside]).max() < 1e-3 * np.abs(means[0][inside]).max()


# Whole steps.

@every_strain
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method, integration", [("mpm", "points"), ("gimp", "points"), ("cmpm", "points"),
                                                 ("mpm", "twin")])
def test_a_stretched_box_has_uniform_stress(strain, dim, method, integration):
    """The patch test: a box on rollers whose other sides are free."""
    mesh, body = boxed(plane_strain if dim == 2 else solid, dim, shake=0.0)
    law = LinearElastic(E=1.0, nu=0.45)
    planes = [FixedPlane(k, 1.0, -1) for k in range(dim)]
    on = np.isclose(mesh.p[0], 2.0) & ((mesh.p > 0.99) & (mesh.p < 2.01)).all(axis=0)
    wall = Wall(mesh.p[:, on], (0.01, *[None] * (dim - 1)))
    state = last(implicit_steps(mesh, body, law, [*planes, wall], steps=1, method=method, integration=integration,
                                strain=strain, floor=0.0, remedy="bbar"))
    stretch = np.log(1.01) if strain == "logarithmic" else 0.01
    modulus = law.E if dim == 3 else law.E / (1 - law.nu ** 2)
    assert_allclose(state.particles.sigma[0], modulus * stretch, rtol=1e-9)
    assert_allclose(state.particles.sigma[1], 0, atol=1e-11)


def pressed(method="mpm", integration="points", cells=6, steps=1, law=Hencky(E=1.0, nu=0.4999), **choices):
    """A block between rough plates, off the grid lines."""
    mesh, body = boxed(plane_strain, 2, cells=cells, shake=0.0, shift=0.37)
    along = np.linspace(1, 2, cells + 1)
    plates = [Wall(np.stack([along, 0 * along + at]), (0.0, push), name) for at, push, name in
              [(1.0, 0.0, "bottom"), (2.0, -0.02, "top")]]
    return implicit_steps(mesh, body, law, plates, steps=steps, method=method, integration=integration,
                          **{"remedy": "bbar", "ghost": 0.1, **choices})


@pytest.mark.parametrize("method, integration", [*CONJUGATE, ("gc", "points"), ("gimp", "field")])
def test_newton_converges_quadratically_near_incompressibility(method, integration):
    state = last(pressed(method, integration, steps=2))
    residuals = np.array(state.residuals)
    assert state.cuts == 0 and residuals[-1] <= 1e-11
    assert (residuals[-2:] <= np.maximum(100 * residuals[-3:-1] ** 2, 1e-10)).all(), residuals


@pytest.mark.parametrize("method", ["mpm", "gimp", "cmpm-c"])
def test_volume_goes_with_the_strain_that_the_stress_knows(method):
    """So the energy of the points is that of the potential, step after step."""
    states = list(pressed(method, steps=3))
    begin = boxed(plane_strain, 2, cells=6, shake=0.0)[1].volume
    for state in states:
        assert_allclose(state.particles.volume / begin, np.exp(state.particles.epsilon[:3].sum(axis=0)), rtol=1e-12)


@pytest.mark.parametrize("method, integration", [*CONJUGATE, ("gc", "points"), ("gimp", "field")])
def test_the_locked_load_falls_to_that_of_the_others(method, integration):
    """With a remedy the load hardly changes from nu = 0.499 to 0.49999; without, up to a hundred times as much."""
    loads = {(remedy, nu): last(pressed(method, integration, law=LinearElastic(E=1.0, nu=nu), strain="small",
                                        remedy=remedy)).reactions["top"][1]
             for remedy, nu in [("none", 0.499), ("none", 0.49999), ("bbar", 0.499), ("bbar", 0.49999)]}
    ratio = {remedy: loads[remedy, 0.49999] / loads[remedy, 0.499] for remedy in ("none", "bbar")}
    assert abs(ratio["bbar"] - 1) < 0.01 and ratio["none"] > 1.03, ratio


@every_strain
@pytest.mark.parametrize("method, integration", [*CONJUGATE, ("gc", "points")])
def test_a_cavity_in_nearly_incompressible_rings(strain, method, integration):
    """Pressure of a cavity that widens by 1e-6, against Lame; free at three radii."""
    cells, h, push = 10, 0.2, 1e-6
    mesh = MeshQuad.init_tensor(1 + h * np.arange(-1, cells + 2), h * np.arange(-1, 3))
    body = Particles.fill(mesh, axisymmetric, where=lambda x: (x[0] > 1) & (x[0] < 3) & (x[1] > 0) & (x[1] < h))
    wall = Wall(np.array([[1.0, 1.0], [0.0, h]]), (push, None), name="inner")
    lam, G = STIFF.lam, STIFF.G
    a, b = np.linalg.solve([[1, 1], [2 * (lam + G), -2 * G / 9]], [push, 0])
    exact = h * (2 * G * b - 2 * (lam + G) * a)
    for remedy, low, high in [("bbar", 0.99, 1.01), ("none", 1.1, np.inf)]:
        state = last(implicit_steps(mesh, body, STIFF, [FixedPlane(1, 0.0, -1), FixedPlane(1, h, 1), wall], steps=1,
                                    method=method, integration=integration, strain=strain, remedy=remedy, floor=1e-10))
        assert low < state.reactions["inner"][0] / exact < high


def test_one_small_step_is_the_same_in_both_schemes():
    states = [last(pressed("gimp", law=STIFF, strain="small", scheme=scheme, tangent="exact"))
              for scheme in ("equilibrated", "incremental")]
    assert_allclose(states[0].displacement, states[1].displacement, atol=1e-9 * 0.02)
    assert_allclose(states[0].reactions["top"], states[1].reactions["top"], rtol=1e-6)


@pytest.mark.parametrize("method, integration", CONJUGATE)
def test_both_engines_agree(method, integration):
    pytest.importorskip("numba")
    one, two = (last(pressed(method, integration, engine=engine)) for engine in ("numpy", "numba"))
    assert (one.engine, two.engine) == ("numpy", "numba")
    assert_allclose(one.particles.x, two.particles.x, atol=1e-12)
    assert_allclose(one.particles.sigma, two.particles.sigma, atol=1e-9 * np.abs(one.particles.sigma).max())


@pytest.mark.parametrize("method", ["mpm", "gimp", "gc"])
def test_systems_that_are_not_factorised_each_time_end_alike(method, monkeypatch):
    direct = last(pressed(method))
    monkeypatch.setattr(solve, "SMALL", 0)
    kept = last(pressed(method))
    assert_allclose(kept.particles.x, direct.particles.x, atol=1e-10)


@every_strain
@pytest.mark.parametrize("method", METHODS)
def test_stress_is_recovered_from_the_same_means(method, strain):
    mesh, body = boxed(plane_strain, 2, cells=6, shake=0.0, shift=0.37)
    state = last(pressed(method, law=LAWS[strain][0], strain=strain))
    assert_allclose(state.recover(body.x, body.length), state.particles.sigma,
                    atol=1e-10 * np.abs(state.particles.sigma).max())


def test_a_run_that_goes_on_is_the_uninterrupted_one():
    one, two = pressed("gimp", steps=2)
    mesh = boxed(plane_strain, 2, cells=6, shake=0.0, shift=0.37)[0]
    on = last(implicit_steps(mesh, one, Hencky(E=1.0, nu=0.4999), steps=1, method="gimp", remedy="bbar", ghost=0.1))
    assert_array_equal(on.particles.sigma, two.particles.sigma)


def test_a_body_that_swings_keeps_momentum_and_about_its_energy():
    mesh, body = boxed(plane_strain, 2, cells=6, shake=0.0)
    body = replace(body, velocity=0.05 * np.stack([body.x[0] - 1.5, 1.5 - body.x[1]]))
    begin = (body.mass * (body.velocity ** 2).sum(axis=0)).sum() / 2
    state = last(implicit_steps(mesh, body, Hencky(E=1.0, nu=0.4999), steps=5, dt=0.1, remedy="bbar"))
    assert_allclose(state.particles.mass @ state.particles.velocity.T, body.mass @ body.velocity.T, atol=1e-12)
    assert 0.9 * begin < sum(state.energy.values()) < 1.001 * begin


# Bad input.

def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="^remedy: got 'fbar'"):
        pressed(remedy="fbar")
    with pytest.raises(ValueError, match="^remedy: got 'bbar' with edges='truncate'.*use edges='ghost'"):
        pressed("gimp", edges="truncate")
    mesh, bar = boxed(uniaxial, 1)
    with pytest.raises(ValueError, match="^remedy: got 'bbar' with uniaxial points.*use 'none'"):
        implicit_steps(mesh, bar, STIFF, [FixedPlane(0, 1.0, -1)], steps=1, remedy="bbar")
