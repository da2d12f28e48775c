"""The vertical cut: its numbers, what a failure looks like, and which method shows it without noise."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import SYMMETRIC, symmetric_methods

from skfem_mpm import METHODS, Hencky, LinearElastic, VonMises, implicit_steps, plane_strain, solid
from skfem_mpm.scenes import vertical_cut

LOADINGS = ("sudden", "ramped")


def run(scene, method="mpm", steps=20_000, every=5, **choices):
    """States until the toe has moved 10 cm."""
    states = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the strain of this method")
        for state in scene.run(method, steps=steps, every=every, **choices):
            states.append(state)
            if scene.toe_displacement(state) >= 0.1:
                break
    return states


@cache
def failed(method, loading, h=0.05):
    """The scene on the grid of the example, and its states up to 10 cm, in half the stable step as there."""
    scene = vertical_cut(h, loading=loading)
    return scene, run(scene, method, safety=0.5)


# The scene

def test_the_papers_numbers():
    """1 m by 2 m, E = 400 kPa, nu = 0.35, c from 6 to 1 kPa, -25 kPa; left face u_x = 0, base u_y = 0."""
    scene = vertical_cut()
    law = scene.material
    assert law == VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3)
    assert_allclose(scene.particles.volume.sum(), 2.0)
    low, high = scene.particles.x.min(axis=1), scene.particles.x.max(axis=1)
    half = scene.particles.length[:, 0] / 2
    assert_allclose(low - half, [0, 0], atol=1e-12)
    assert_allclose(high + half, [2, 1])
    assert {(plane.axis, plane.at, plane.side, plane.components) for plane in scene.boundary} == {
        (1, 0.0, -1, (1,)), (0, 0.0, -1, (0,))}


def test_our_numbers():
    """rho = 2000, g = 10, h = 0.05, 2 x 2 points, ramp 0.5 s; and the docstring says whose is whose."""
    scene = vertical_cut()
    assert scene.particles.n == 40 * 20 * 4
    assert_allclose(scene.particles.mass, 2000 * 0.025 ** 2)
    assert scene.gravity == (0.0, -10.0) and scene.ramp == 0.0 and scene.weight == 20e3
    assert vertical_cut(loading="ramped").ramp == 0.5
    text = " ".join(vertical_cut.__doc__.split())
    paper, ours = text.split("From the paper:")[1].split("Ours,")
    for number in ("1 m by 2 m", "400 kPa", "0.35", "6 kPa", "1 kPa", "-25 kPa"):
        assert number in paper
    for name in ("density", "gravity", "cell size", "points per cell", "loading", "sqrt(J2)"):
        assert name in ours


def test_a_rough_base_holds_all_components():
    assert vertical_cut(0.25, base="rough").boundary[0].components == (0, 1)
    assert vertical_cut(0.5, dim=3, base="rough").boundary[0].components == (0, 1, 2)


def test_in_space_it_is_one_cell_deep_between_rollers():
    flat, deep = vertical_cut(0.25), vertical_cut(0.25, dim=3)
    assert (flat.particles.kinematics, deep.particles.kinematics) == (plane_strain, solid)
    assert deep.particles.n == 2 * flat.particles.n
    assert_allclose(deep.particles.mass.sum(), 0.25 * flat.particles.mass.sum())
    assert {(plane.axis, plane.at, plane.side) for plane in deep.boundary} >= {(2, 0.0, -1), (2, 0.25, 1)}


def test_the_toe_is_the_point_nearest_to_the_corner():
    scene = vertical_cut(0.1)
    distance = np.hypot(scene.particles.x[0] - 2, scene.particles.x[1])
    assert distance[scene.toe] == distance.min()
    assert_allclose(scene.particles.x[:, scene.toe], [1.975, 0.025])


@pytest.mark.parametrize("given", [{"base": "icy"}, {"loading": "slow"}, {"h": 0.0}, {"h": np.nan}, {"density": -1.0},
                                   {"dim": 1}, {"room": 0.0}, {"height": -1.0}, {"per_cell": 0},
                                   {"acceleration": 0.0}, {"initial": "wet"},
                                   {"initial": "geostatic", "loading": "ramped"}], ids=str)
def test_numbers_and_names_that_do_not_fit_are_refused(given):
    with pytest.raises(ValueError, match=next(iter(given))):
        vertical_cut(**given)


@pytest.mark.parametrize("h", [0.3, 0.07, 5.0])
def test_cells_that_do_not_divide_the_cut_are_made_to(h):
    scene = vertical_cut(h)
    x, y = (np.unique(row) for row in scene.mesh.p)
    for lines, value in [(x, 0.0), (x, 2.0), (y, 0.0), (y, 1.0)]:
        assert np.abs(lines - value).min() < 1e-12
    assert_allclose(scene.particles.mass.sum(), 4000)
    next(scene.run("gimp", steps=1))


# A start that carries its weight

def elastic(**choices):
    return vertical_cut(material=LinearElastic(E=400e3, nu=0.35), **choices)


def moved(scene, method, **choices):
    """How far any point gets from where it was."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the strain of this method")
        return max(np.abs(state.particles.x - scene.particles.x).max()
                   for state in scene.run(method, steps=100, every=5, engine="numpy", safety=0.8, **choices))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("choices", [{"h": 0.1}, {"h": 0.1, "base": "rough"}, {"h": 0.25, "per_cell": 3},
                                     {"h": 0.25, "dim": 3}, {"h": 0.25, "dim": 3, "base": "rough"}], ids=str)
def test_an_elastic_cut_that_carries_its_weight_stays_at_rest(method, choices):
    """Settling takes centimetres; this is rounding, or little where CMPM's functions carry force."""
    start = elastic(initial="geostatic", **choices)
    settling = moved(elastic(**choices), "mpm")
    assert settling > 2e-3
    assert moved(start, method) < (0.05 if method == "cmpm-c" else 1e-12) * settling


def test_it_stays_at_rest_in_logarithmic_strain_too():
    scene = elastic(h=0.1, initial="geostatic")
    assert moved(scene, "gimp", strain="logarithmic") < 1e-12


def test_a_geostatic_start_has_stress_and_nothing_else():
    zero, loaded = vertical_cut(0.1), vertical_cut(0.1, initial="geostatic")
    for name in ("x", "volume", "mass", "length"):
        assert_array_equal(getattr(loaded.particles, name), getattr(zero.particles, name))
    assert loaded.particles.velocity is None and loaded.particles.history is None
    assert zero.particles.sigma is None
    row = loaded.particles.x[1] < 0.1
    assert_allclose(loaded.particles.sigma[1, row].mean(), -20e3 * 0.95, rtol=1e-9)      # the weight of the rows above
    assert loaded.ramp == 0 and loaded.gravity == zero.gravity


def test_a_geostatic_cut_in_softening_soil_fails_with_balanced_energies():
    """Stress beyond the yield surface comes back in the first step."""
    scene = vertical_cut(0.1, initial="geostatic")
    states = run(scene, "gimp")
    assert scene.toe_displacement(states[-1]) >= 0.1
    assert abs(scene.energy_balance(states[-1])) < 0.05


def test_a_law_without_elastic_constants_has_no_geostatic_start():
    with pytest.raises(ValueError, match="initial: .* object, expected a law with elastic constants"):
        vertical_cut(0.25, initial="geostatic", material=object())


# What is measured on it

def test_roughness_is_zero_for_a_plane_of_stress_and_counts_what_is_left():
    scene = vertical_cut(0.1)
    state = next(scene.run("mpm", steps=1, every=1, engine="numpy"))

    def rough(stress):
        sigma = np.zeros((4, scene.particles.n))
        sigma[0] = stress
        return scene.roughness(replace(state, particles=replace(scene.particles, sigma=sigma)))

    x, y = scene.particles.x
    assert rough(3e3 + 4e3 * x - 5e3 * y) < 1e-12
    noise = np.random.default_rng(0).normal(size=x.shape)
    assert_allclose(rough(2e3 * noise), 0.1 * np.sqrt(15 / 16), rtol=0.05)      # the plane takes its share of a point
    assert_allclose(rough(4e3 * noise), 2 * rough(2e3 * noise), rtol=1e-12)


@pytest.mark.parametrize("unit", [2.0 ** 30, 2.0 ** -30])
def test_roughness_does_not_depend_on_the_unit_of_length(unit):
    scene = vertical_cut(0.25)
    state = list(scene.run("mpm", steps=20, every=20, engine="numpy"))[-1]
    other = replace(state, particles=replace(state.particles, x=state.particles.x * unit))
    assert scene.roughness(other) == scene.roughness(state) > 0


def test_toe_and_run_out_are_zero_at_the_start():
    scene = vertical_cut(0.25)
    state = next(scene.run("mpm", steps=1, engine="numpy"))
    state = replace(state, particles=replace(scene.particles, x=scene.particles.x + [[0.5], [0.0]]))
    assert_allclose([scene.toe_displacement(state), scene.run_out(state)], 0.5)


def test_the_toe_is_found_among_points_that_are_left():
    scene = vertical_cut(0.25)
    state = next(scene.run("mpm", steps=9, every=9, engine="numpy"))
    mask = np.arange(scene.particles.n) % 2 == scene.toe % 2
    left = replace(state, particles=state.particles.where(mask), kept=np.flatnonzero(mask))
    assert scene.toe_displacement(left) == scene.toe_displacement(state) != 0
    mask = ~mask
    left = replace(state, particles=state.particles.where(mask), kept=np.flatnonzero(mask))
    assert np.isnan(scene.toe_displacement(left))


# What happens on it

def test_a_cut_of_elastic_soil_stands():
    """Damped to rest it is where equilibrium puts it."""
    scene = vertical_cut(0.25, material=LinearElastic(E=400e3, nu=0.35))
    state = run(scene, "gimp", steps=600, every=600, damping=0.3)[-1]
    rest = next(implicit_steps(scene.mesh, scene.particles, scene.material, scene.boundary, steps=1, strain="small",
                               gravity=scene.gravity))
    assert_allclose(scene.toe_displacement(state), rest.particles.x[0, scene.toe] - scene.particles.x[0, scene.toe],
                    rtol=0.1)
    base = state.particles.sigma[1, state.particles.x[1] < 0.125].mean()
    assert_allclose(base, -20e3 * 0.875, rtol=0.05)


@pytest.mark.parametrize("loading", LOADINGS)
@symmetric_methods
def test_the_cut_fails_and_its_energies_balance(method, loading):
    """Within 2 % sudden, 1 % ramped, at 10 cm, on the grid of the example."""
    scene, states = failed(method, loading)
    state = states[-1]
    assert scene.toe_displacement(state) >= 0.1
    assert 0.1 < state.time < 1.0
    assert abs(scene.energy_balance(state)) < {"sudden": 0.02, "ramped": 0.01}[loading]
    strength = np.maximum(1e3, 6e3 - 25e3 * state.particles.history[0])
    deviator = state.particles.sigma.copy()
    deviator[:3] -= deviator[:3].mean(axis=0)
    reached = np.sqrt((deviator[:3] ** 2).sum(axis=0) / 2 + deviator[3] ** 2)
    assert (reached <= strength * (1 + 1e-9)).all()
    assert 0.2 < state.particles.history.max() < 2
    assert_allclose(state.particles.mass, scene.particles.mass)
    assert state.particles.x[1].min() > 0 and state.particles.x[0].min() > 0


@symmetric_methods
def test_the_balance_gets_better_with_the_time_step(method):
    """On a coarse grid, where steps are long; a part of it stays, see below."""
    scene = vertical_cut(0.1)
    gaps = [abs(scene.energy_balance(run(scene, method, safety=safety)[-1])) for safety in (0.8, 0.4, 0.1)]
    assert gaps[0] > gaps[1] > gaps[2] and gaps[0] > 2 * gaps[2]
    assert gaps[2] < 0.01


@symmetric_methods
def test_what_stays_of_the_balance_is_the_volume_change_of_stressed_points(method):
    """The rate law has no energy; without what V sigma : eps / 2 gains from V alone, first order in the step."""
    gaps = []
    for safety in (0.8, 0.2, 0.05):
        scene, change = vertical_cut(0.1), 0.0
        volume, density = scene.particles.volume, 0.0
        for state in run(scene, method, every=1, safety=safety):
            points = state.particles
            before, density = density, np.einsum(
                "in,in,i->n", points.sigma, scene.material.elastic_strain(points.sigma, plane_strain.components),
                [0.5, 0.5, 0.5, 1.0])
            change += (before + density) / 2 @ (points.volume - volume)
            volume = points.volume
        gaps.append(abs(scene.energy_balance(state) + change / state.energy["external"]))
    assert gaps[0] > 2 * gaps[1] > 4 * gaps[2]
    assert gaps[2] < 2e-3


@symmetric_methods
def test_with_a_law_that_stores_energy_it_falls_to_zero(method):
    """Hencky's: V_0 tau : eps / 2, here after 0.1 s of elastic settling."""
    gaps = []
    for safety in (0.8, 0.2, 0.05):
        scene, state = vertical_cut(0.1, material=Hencky(E=400e3, nu=0.35)), None
        for state in scene.run(method, steps=3000, every=1, safety=safety, strain="logarithmic"):
            if state.time >= 0.1:
                break
        gaps.append(abs(scene.energy_balance(state)))
    assert gaps[0] > 2 * gaps[1] > 4 * gaps[2]
    assert gaps[2] < 2e-3


@pytest.mark.parametrize("loading", LOADINGS)
def test_plastic_energy_and_strain_only_grow(loading):
    _, states = failed("gimp", loading)
    assert (np.diff([state.energy["plastic"] for state in states]) >= 0).all()
    for one, other in zip(states, states[1:]):
        assert (other.particles.history >= one.particles.history).all()


@pytest.mark.parametrize("loading", LOADINGS)
def test_conjugate_cmpm_lies_between_gimp_and_mpm_in_noise(loading):
    """gc or gimp < cmpm-c < mpm at 10 cm, and gimp well below mpm."""
    rough = {}
    for method in ("mpm", "gimp", "cmpm-c", "gc"):
        scene, states = failed(method, loading)
        rough[method] = scene.roughness(states[-1])
    assert min(rough["gimp"], rough["gc"]) < rough["cmpm-c"] < rough["mpm"]
    assert rough["gimp"] < 0.9 * rough["mpm"]


@pytest.mark.parametrize("method", METHODS)
def test_methods_that_flutter_warn_when_a_run_starts(method):
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        next(vertical_cut(0.25).run(method, steps=2, every=2, engine="numpy"))
    assert [("waves grow" in str(entry.message)) for entry in record] == [True] * (method not in SYMMETRIC)


def test_a_cut_goes_on_from_a_state():
    scene = vertical_cut(0.25)
    whole = list(scene.run("gimp", steps=60, every=20, engine="numpy"))
    rest = list(scene.run("gimp", steps=40, every=20, start=whole[0], engine="numpy"))
    for one, other in zip(whole[1:], rest, strict=True):
        for name, array in one.particles.arrays().items():
            assert_array_equal(array, other.particles.arrays()[name])
        assert dict(one.energy) == dict(other.energy)


def test_space_fails_like_the_plane():
    """Between rollers nothing happens across: 3-D is plane strain."""
    flat, deep = (vertical_cut(0.25, dim=dim) for dim in (2, 3))
    dt = 2e-3
    one, other = (list(scene.run("mpm", steps=60, every=60, dt=dt, engine="numpy"))[-1] for scene in (flat, deep))
    order = [np.lexsort(particles.x[:2].round(6)) for particles in (flat.particles, deep.particles)]
    a, b = one.particles.x[:, order[0]], other.particles.x[:2, order[1]]
    assert_allclose(b[:, ::2], a, rtol=1e-9)
    assert_allclose(b[:, 1::2], a, rtol=1e-9)
    assert one.particles.history.max() > 0
