"""Load steps with plastic flow keep to the law's own solution, and a controlled load passes its peak."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq
from shared import every_method
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    METHODS,
    Control,
    LinearElastic,
    Particles,
    VonMises,
    axisymmetric,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.scenes import vertical_cut

SOIL = VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3)
CLAY = VonMises(E=1e8, nu=0.49, peak=1e3, residual=1e3)
BALANCED = [name for name in METHODS if name != "cmpm-c"]       # quarter points integrate their forces exactly
every_strain = pytest.mark.parametrize("strain", ["small", "logarithmic"])


def last(run):
    *_, state = run
    return state


# A block between rollers, pressed from above.

def pressed(method, strain, down, steps=1, cells=4, **choices):
    """A block of unit size with a free side; the grid is pressed with it, so points stay where they are in cells."""
    axes = [np.arange(-1, cells + 2) / cells] * 2
    mesh = MeshQuad.init_tensor(*axes)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    top = np.isclose(mesh.p[1], 1) & (abs(mesh.p[0] - 0.5) < 0.51)
    held = [FixedPlane(0, 0.0, -1, name="side"), FixedPlane(1, 0.0, -1, name="base"),
            Wall(mesh.p[:, top], (None, -down / steps), name="top")]
    low = [body.x[k].min() for k in range(2)]

    def follow(state):
        size = [[state.particles.x[k].min() / low[k]] for k in range(2)]
        return MeshQuad.init_tensor(*np.array(size) * axes[0])

    return implicit_steps(follow, body, SOIL, held, steps=steps, method=method, strain=strain, floor=0.0, **choices)


def law_alone(strain, down, steps=1):
    """Height and width, stress and history of the block, from the law and nothing else: no stress on the side."""
    height, width, history, stress = 1.0, 1.0, np.zeros((1, 1)), np.zeros((4, 1))
    elastic = np.zeros((4, 1))
    components = plane_strain.components
    for _ in range(steps):
        def after(across):
            if strain == "small":
                increment = np.array([[across], [-down / steps / height], [0.0], [0.0]])
                return SOIL.update(increment, stress, history, components)
            total = elastic + np.array([[across], [np.log1p(-down / steps / height)], [0.0], [0.0]])
            return SOIL.update(total, 0 * stress, history, components)

        across = brentq(lambda across: after(across)[0][0, 0], 0.0, 2 * down / steps / height, xtol=1e-15, rtol=1e-14)
        stress, history = after(across)
        elastic = SOIL.elastic_strain(stress, components)
        height -= down / steps
        width *= np.exp(across) if strain == "logarithmic" else 1 + across
    return height, width, stress[:, 0], history[0, 0]


@every_strain
@pytest.mark.parametrize("method", BALANCED)
@pytest.mark.parametrize("down", [0.01, 0.05, 0.1, 0.3])
def test_a_block_is_pressed_beyond_yield_and_through_softening_as_its_law_says(method, strain, down):
    """In one step: elastic, just beyond yield, half soft, and residual."""
    state = next(pressed(method, strain, down))
    _, width, stress, slip = law_alone(strain, down)
    assert state.cuts == 0
    assert_allclose(state.particles.sigma, stress[:, None] * np.ones(64), atol=1e-8 * SOIL.peak)
    assert_allclose(state.particles.history, slip, atol=1e-10)
    assert (slip > 0) == (down > 0.01)
    force = stress[1] * (width if strain == "logarithmic" else 1.0)
    assert state.reactions["top"][1] == pytest.approx(force, rel=1e-8)


@every_strain
@pytest.mark.parametrize("method", ["mpm", "cmpm"])
def test_a_block_softens_in_many_steps_as_its_law_says(method, strain):
    """The softening block is unstable, and yet stays uniform: the steps are exact to rounding."""
    peak = 0.0
    for state in pressed(method, strain, 0.25, steps=10):
        height, width, stress, slip = law_alone(strain, 0.025 * state.step, state.step)
        assert_allclose(state.particles.sigma, stress[:, None] * np.ones(64), atol=1e-6 * SOIL.peak)
        peak = max(peak, -state.reactions["top"][1])
    assert slip > 0.2 and peak > -4 * state.reactions["top"][1]


@every_strain
@every_method
@pytest.mark.parametrize("down", [0.05, 0.1, 0.3])
def test_newton_converges_quadratically_where_soil_yields(method, strain, down):
    state = next(pressed(method, strain, down, tolerance=1e-10))
    tail = np.array(state.residuals)[-3:]
    assert tail[-1] <= 1e-10
    assert (tail[1:] <= np.maximum(200 * tail[:-1] ** 2, 1e-10)).all(), state.residuals


def test_points_on_the_yield_surface_start_a_step_with_one_tangent():
    """Rounding puts some of them inside and some outside; Newton's first pass must not tell them apart."""
    state = last(pressed("mpm", "logarithmic", 0.05))
    points = state.particles
    places = plane_strain.rows(2)
    for strain, stress in [(points.epsilon, 0 * points.sigma), (0 * points.sigma, points.sigma)]:
        moduli = SOIL.tangent(strain, stress, points.history, places)
        assert points.history.min() > 0
        assert_array_equal(moduli, LinearElastic.tangent(SOIL, strain, stress, points.history, places) * np.ones(64))


# A thick cylinder without hardening.

def cylinder_pressure(moved, a=1.0, b=2.0):
    """Pressure on the inner face, incompressible: elastic, then with a plastic zone out to rho, then all plastic."""
    k, G = CLAY.peak, CLAY.G
    if moved < k * a / (2 * G):
        return 2 * G * moved / a * (1 - a**2 / b**2)
    rho = min(np.sqrt(2 * G * a * moved / k), b)
    return k * (1 - rho**2 / b**2) + 2 * k * np.log(rho / a)


@every_method
def test_a_thick_cylinder_of_clay_yields_from_within_up_to_its_limit_pressure(method):
    """Hill's solution; half of a per cent is compressibility, and what linear functions lock."""
    a, b, steps = 1.0, 2.0, 8
    mesh = MeshLine(np.linspace(a - 0.025, b + 0.025, 43))
    body = Particles.fill(mesh, axisymmetric, where=lambda x: (x[0] > a) & (x[0] < b))
    push = 1.5 * CLAY.peak * b**2 / (2 * CLAY.G * a) / steps
    for state in implicit_steps(mesh, body, CLAY, [Wall(np.array([[a]]), (push,), name="inner")], steps=steps,
                                method=method, strain="small"):
        assert state.reactions["inner"][0] / a == pytest.approx(cylinder_pressure(push * state.step), rel=0.0055)
        assert state.cuts == 0 and len(state.residuals) <= 4
    assert state.particles.history.min() > 0
    assert state.reactions["inner"][0] / a == pytest.approx(2 * CLAY.peak * np.log(b / a), rel=0.0045)


# A load that is controlled by a displacement.

def column(method="mpm", **choices):
    """An elastic column whose top comes down by a thousandth of its height per step."""
    mesh = MeshLine(np.arange(-1, 12) / 10)
    body = Particles.fill(mesh, uniaxial, density=3.0, where=lambda x: (x[0] > 0) & (x[0] < 1))
    given = dict(steps=1, method=method, strain="small", floor=0.0, gravity=(-2.0,),
                 control=Control([1.0], [-1.0], 1e-6))
    law = LinearElastic(E=100.0, nu=0.3)
    return law, implicit_steps(mesh, body, law, [FixedPlane(0, 0.0, -1, name="base")], **(given | choices))


@pytest.mark.parametrize("method", BALANCED)
def test_the_factor_of_an_elastic_column_has_a_closed_form(method):
    """The top of a column comes down by factor * density * gravity * length^2 / (2 M)."""
    law, run = column(method, steps=3)
    for state in run:
        down = 1e-6 * state.step
        assert state.factor == pytest.approx(down * 2 * (law.lam + 2 * law.G) / (3.0 * 2.0), rel=1e-4)
        assert state.gravity == pytest.approx(-2.0 * state.factor)
        assert state.reactions["base"][0] == pytest.approx(3.0 * 2.0 * state.factor, rel=1e-9)
        assert state.control.x[0] == pytest.approx(1.0 - down, rel=1e-13)


def cut(method="gimp", steps=14, **choices):
    """A vertical cut in softening soil; its crest goes down by half a per cent of its height per step."""
    scene = vertical_cut(0.1, base="rough")
    crest = Control((1.99, 0.99), (0.0, -1.0), 0.005)
    given = dict(boundary=scene.boundary, steps=steps, method=method, strain="small", gravity=scene.gravity,
                 control=crest)
    given |= choices
    return scene, implicit_steps(scene.mesh, given.pop("start", scene.particles), scene.material, **given)


@pytest.mark.parametrize("method, strain", [("gimp", "small"), ("mpm", "small"), ("gimp", "logarithmic")])
def test_a_softening_cut_passes_its_peak_in_equilibrium(method, strain):
    scene, run = cut(method, strain=strain)
    states = list(run)
    factor = np.array([state.factor for state in states])
    top = factor.argmax()
    assert 3 < top < 12 and (np.diff(factor[:5]) > 0).all() and factor[-1] < 0.8 * factor.max()
    assert 2.0 < factor.max() * scene.weight / SOIL.peak < 3.776            # without softening it would be 3.776
    weight = scene.particles.mass.sum() * scene.gravity[1]
    for state in states:
        force = sum(np.array(reaction) for reaction in state.reactions.values())
        assert_allclose(force, [0.0, -state.factor * weight], atol=1e-9 * abs(weight))
        assert state.residuals[-1] <= 1e-11
        assert 0.99 - state.control.x[1] == pytest.approx(0.005 * state.step, rel=1e-12)


def test_factors_that_are_prescribed_retrace_the_rising_branch():
    """Up to the step before the peak, where a load no longer says where the body is."""
    scene, run = cut(steps=7)
    states = list(run)
    factors = [0.0] + [state.factor for state in states]
    rising = int(np.argmax(factors)) - 1
    assert rising > 3 and factors[rising] > 0.9 * max(factors)
    _, again = cut(steps=rising, control=None,
                   gravity=lambda step: (0.0, scene.gravity[1] * np.interp(step, range(len(factors)), factors)))
    for one, two in zip(states, again):
        assert two.factor == 1.0 and two.control is None
        assert_allclose(two.gravity, one.gravity)
        assert_allclose(two.particles.x, one.particles.x, atol=1e-8)
        assert_allclose(two.particles.sigma, one.particles.sigma, atol=1e-6 * SOIL.peak)


def test_a_controlled_run_goes_on_from_a_state_as_if_it_had_never_stopped():
    whole = list(cut(steps=9)[1])
    half = pickle.loads(pickle.dumps(whole[5]))
    rest = list(cut(steps=3, start=half, boundary=None, control=half.control)[1])
    for one, two in zip(whole[6:], rest):
        assert one.step == two.step and one.factor == two.factor
        assert_array_equal(one.control.x, two.control.x)
        for name, array in one.particles.arrays().items():
            assert_array_equal(two.particles.arrays()[name], array)


def test_a_controlled_step_that_is_cut_moves_its_place_all_the_same():
    """The column loses six tenths of its height at once, too much for one part."""
    whole = Control([1.0], [-1.0], 0.6)
    state = next(column(control=whole)[1])
    assert state.cuts > 0
    parts = 2 ** state.cuts
    small = last(column(control=replace(whole, increment=0.6 / parts), steps=parts)[1])
    assert state.control.x[0] == pytest.approx(0.4, rel=1e-12)
    assert state.factor == pytest.approx(small.factor, rel=1e-9)
    assert_allclose(state.particles.x, small.particles.x, rtol=1e-9)


@pytest.mark.parametrize("wrong, match", [
    (dict(control=3), "^control: got int, expected a Control"),
    (dict(gravity=None), "^control: got no gravity to scale"),
    (dict(gravity=(0.0,)), "^control: got no load to scale"),
    (dict(dt=0.1), "^control: got one with dt"),
    (dict(scheme="incremental"), "^scheme: got 'incremental' with control"),
    (dict(control=Control([0.0], [1.0], 0.1)), "^control: got the place .*do not let move along"),
    (dict(control=Control([0.0, 0.0], [1.0, 0.0], 0.1)), r"^control: got a place of 2 coordinate\(s\) on a mesh in 1"),
    (dict(control=Control([2.5], [1.0], 0.1)), "control.*outside the grid"),
], ids=str)
def test_a_control_that_cannot_be_is_refused(wrong, match):
    with pytest.raises((TypeError, ValueError), match=match):
        next(column(**wrong)[1])


@pytest.mark.parametrize("given, match", [
    (dict(x=[0.0], direction=[0.0], increment=1.0), "^direction: got .*above zero"),
    (dict(x=[0.0], direction=[0.0, 1.0], increment=1.0), "^direction: got 2 number"),
    (dict(x=[np.nan], direction=[1.0], increment=1.0), "^x: got"),
    (dict(x=0.0, direction=[1.0], increment=1.0), "^x: got"),
    (dict(x=[0.0], direction=[1.0], increment=0.0), "^increment: got"),
    (dict(x=[0.0], direction=[1.0], increment=[1.0]), "^increment: got"),
], ids=str)
def test_a_control_checks_its_numbers(given, match):
    with pytest.raises(ValueError, match=match):
        Control(**given)


def test_a_control_is_frozen():
    control = Control((0.0, 1.0), (0.0, -3.0), 0.1)
    assert_array_equal(control.direction, [0.0, -1.0])
    with pytest.raises(ValueError, match="read-only"):
        control.x[0] = 1.0
    assert replace(control, increment=0.2).increment == 0.2
