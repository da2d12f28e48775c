"""Methods with conjugate forces have real frequencies on any layout; the others make waves grow at any time step."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import FASTEST, FLUTTERING, MAKE, MOTION, symmetric_methods

from skfem_mpm import METHODS, LinearElastic, Particles, UnstableError, explicit_steps
from skfem_mpm.explicit.nodes import Nodes
from skfem_mpm.grid import Grid

LAW = {1: LinearElastic(E=1.0, nu=0.0), 2: LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3)}     # pressure waves of speed 1
fluttering_methods = pytest.mark.parametrize("method", FLUTTERING)
both_dimensions = pytest.mark.parametrize("dim, cells", [(1, 20), (2, 6)], ids=["bar", "block"])
quiet = pytest.mark.filterwarnings("ignore:the strain of this method:UserWarning")


def shifted(dim, cells, shift=0.0):
    """A free body with two points per direction, on cells of size 1."""
    body = Particles.fill(MAKE[dim](*[np.arange(cells + 1.0)] * dim), MOTION[dim])
    return MAKE[dim](*[np.arange(-4.0, cells + 5)] * dim), replace(body, x=body.x + shift)


def scattered(dim, seed):
    """Points anywhere in a few cells, some of them next to faces, with volumes, masses and domains of their own."""
    random = np.random.default_rng(seed)
    cells, n = {1: (6, 14), 2: (4, 30)}[dim]
    x, volume = random.uniform(0, cells, (dim, n)), random.uniform(0.1, 1.0, n)
    x[:, ::5] = np.round(x[:, ::5]) + random.choice([1e-10, 1e-5, 1e-3], x[:, ::5].shape)
    return MAKE[dim](*[np.arange(-3.0, cells + 4)] * dim), Particles(
        x, volume, volume * random.uniform(0.5, 2.0), MOTION[dim], length=random.uniform(0.2, 1.0, (dim, n)))


def nodes_of(mesh, body, method):
    return Nodes(Grid.from_mesh(mesh), body.kinematics, body.x, body.mass, body.length, METHODS[method], "ghost", ())


def squares(mesh, body, method, mapped):
    """Squared frequencies of a frozen layout, through what a step does to every nodal velocity."""
    nodes, law = nodes_of(mesh, body, method), LAW[body.dim]
    moduli = law.tangent(None, None, None, body.kinematics.rows(body.dim))[:, :, 0]
    shape = (body.dim, len(nodes.mass))
    free = np.flatnonzero(np.broadcast_to(nodes.active, shape))
    root = np.sqrt(np.broadcast_to(np.where(nodes.active, nodes.mass, 1.0), shape)).ravel()

    def matrix(sums):
        columns = []
        for place in free:
            momentum = np.zeros(shape)
            momentum.flat[place] = root[place]
            columns.append((nodes.gather(sums(nodes.velocity(momentum))).ravel() / root)[free])
        return np.array(columns).T

    found = matrix(lambda u: nodes.force.force(body.volume * (moduli @ nodes.strain.gradient(u))))
    if mapped:
        points = nodes.mapping
        found = matrix(lambda u: points.to_nodes(body.mass * points.to_points(u))) @ found
    return np.linalg.eigvals(found)


def growth(*layout, mapped=True):
    """Largest growth rate; in c / h, as c and h are 1."""
    return abs(np.sqrt(squares(*layout, mapped).astype(complex)).imag).max()


# Frozen layouts

@symmetric_methods
@pytest.mark.parametrize("mapped", [False, True], ids=["direct", "mapped"])
@pytest.mark.parametrize("dim", [1, 2])
def test_conjugate_forces_have_real_frequencies_on_any_layout(method, dim, mapped):
    for seed in range(15):
        found = squares(*scattered(dim, seed), method, mapped)
        size = abs(found).max()
        assert abs(found.imag).max() < 1e-7 * size
        assert found.real.min() > -1e-7 * size


@fluttering_methods
@both_dimensions
def test_others_have_complex_ones_where_points_are_off_their_quarter_points(method, dim, cells):
    for shift in (0.1, 0.24, 0.76):
        assert growth(*shifted(dim, cells, shift), method) > 0.001
    assert growth(*shifted(dim, cells, 0.24), method) > 0.01


@pytest.mark.parametrize("method, direct, mapped", [("cmpm", 0.0402, 0.1208), ("gc", 0.0960, 0.0537),
                                                    ("fe-gimp", 0.1927, 0.1743)])
def test_rates_of_the_shifted_bar(method, direct, mapped):
    """20 cells, 2 points per cell, free ends, all points shifted by 0.24 of a cell: what the documentation quotes."""
    layout = shifted(1, 20, 0.24)
    assert_allclose(growth(*layout, method, mapped=False), direct, atol=1e-4)
    assert_allclose(growth(*layout, method), mapped, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_no_bar_flutters_on_quarter_points(method):
    for mapped in (False, True):
        assert growth(*shifted(1, 20), method, mapped=mapped) < 1e-6


def test_a_block_on_quarter_points_flutters_at_its_edges_with_cmpm():
    assert 0.001 < growth(*shifted(2, 8), "cmpm") < 0.05
    assert growth(*shifted(2, 8), "fe-gimp") < 1e-6            # the same operators as mpm there


@pytest.mark.parametrize("shift", [0.0, 0.1, 0.24, 0.4, 0.6])
@pytest.mark.parametrize("wave", [0.5, 2 * np.pi / 3, 3.0])
def test_a_plane_wave_in_a_long_bar_has_the_closed_form(shift, wave):
    """Im omega^2 = 4 t sin(k / 2)^2 sin(k) for cmpm, with the mean distance t of points from the centre of a cell."""
    mesh, body = shifted(1, 15, shift)
    nodes = nodes_of(mesh, body, "cmpm")
    place, middle = nodes.grid.axes[0], len(nodes.mass) // 2
    parts = [nodes.force.force(body.volume * nodes.strain.gradient(part(wave * (place - place[middle]))[None]))
             for part in (np.cos, np.sin)]
    found = (parts[0][0, middle] + 1j * parts[1][0, middle]) / nodes.mass[middle]
    mean = np.mean(np.mod(np.array([0.25, 0.75]) + shift, 1.0)) - 0.5
    assert_allclose(found.imag, 4 * mean * np.sin(wave / 2) ** 2 * np.sin(wave), atol=1e-13)
    assert found.real > 0


# Runs

def ringing(dim, cells, method, shift=0.24, **choices):
    """Times and energies of a frozen body with tiny random velocities, until the end or until it is stopped."""
    mesh, body = shifted(dim, cells, shift)
    noise = np.random.default_rng(7).uniform(-1, 1, body.x.shape)
    body = replace(body, velocity=1e-9 * (noise - noise.mean(axis=1, keepdims=True)))
    found = []
    try:
        for state in explicit_steps(mesh, body, LAW[dim], method=method,
                                    **{"engine": "numpy", "safety": 0.8} | choices):
            found.append((state.time, state.energy["kinetic"] + state.energy["elastic"]))
    except UnstableError:
        pass
    return np.transpose(found) / [[1.0], [(body.mass * (body.velocity ** 2).sum(axis=0)).sum() / 2]]


def growth_of_step(dim, cells, method, dt, size=1e-9):
    """Growth rate of the real step: its spectral radius, from what it does to each velocity and stress of a point."""
    mesh, body = shifted(dim, cells, 0.24)
    parts = dim, dim if dim == 1 else 4
    columns = []
    for unit in np.eye(sum(parts) * body.n):
        velocity, sigma = np.split(unit.reshape(-1, body.n) * size, parts[:1])
        start = replace(body, velocity=velocity, sigma=sigma)
        points = next(explicit_steps(mesh, start, LAW[dim], method=method, steps=1, dt=dt, engine="numpy")).particles
        columns.append(np.concatenate([points.velocity, points.sigma]).ravel() / size)
    return np.log(abs(np.linalg.eigvals(np.array(columns).T)).max()) / dt


def growth_of_long_steps(dim, cells, method, dt):
    """From the eigenvalues of the layout: steps of finite length give sin(Omega dt / 2) = omega dt / 2."""
    omega = np.sqrt(squares(*shifted(dim, cells, 0.24), method, True).astype(complex))
    return abs(2 / dt * np.arcsin(omega * dt / 2).imag).max()


@quiet
@pytest.mark.parametrize("dt", [0.4, 0.2, 0.02])
@fluttering_methods
def test_a_bar_grows_at_the_rate_of_its_eigenvalues_whatever_the_time_step(method, dt):
    expected = growth(*shifted(1, 20, 0.24), method)
    assert_allclose(growth_of_step(1, 20, method, dt), growth_of_long_steps(1, 20, method, dt), rtol=1e-3)
    assert_allclose(growth_of_step(1, 20, method, dt), expected, rtol=0.05)


@quiet
@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.4, 0.1])
@fluttering_methods
def test_a_block_grows_at_the_rate_of_its_eigenvalues_whatever_the_time_step(method, dt):
    expected = growth(*shifted(2, 3, 0.24), method)
    assert_allclose(growth_of_step(2, 3, method, dt), growth_of_long_steps(2, 3, method, dt), rtol=1e-3)
    assert_allclose(growth_of_step(2, 3, method, dt), expected, rtol=0.1)


@quiet
@pytest.mark.parametrize("safety", [0.8, 0.4])
@pytest.mark.parametrize("method", ["cmpm", "fe-gimp"])
def test_energy_grows_until_the_run_is_stopped(method, safety):
    time, energy = ringing(2, 6, method, steps=600, every=10, safety=safety)
    assert time[-1] < 100 and energy[-1] > 2                # the last that is yielded; ten steps later it is tenfold


@symmetric_methods
@pytest.mark.parametrize("dim, cells, steps", [
    (1, 20, 3000), (2, 5, 400), pytest.param(2, 6, 5000, marks=pytest.mark.slow)], ids=["bar", "block", "block, long"])
def test_energy_stays_with_conjugate_forces(method, dim, cells, steps):
    """It wobbles, as the velocities of symplectic steps are half a step off, and has no trend."""
    _, energy = ringing(dim, cells, method, steps=steps, every=10, engine=FASTEST if steps > 400 else "numpy")
    assert 0.7 < energy.min() and energy.max() < 1.5
    first, second = np.array_split(energy, 2)
    assert_allclose(second.mean(), first.mean(), rtol=0.05)


@quiet
@fluttering_methods
def test_a_run_that_is_stopped_names_another_method_and_no_shorter_step(method):
    mesh, body = shifted(1, 20, 0.24)
    body = replace(body, velocity=1e-9 * np.random.default_rng(7).uniform(-1, 1, body.x.shape))
    with pytest.raises(UnstableError, match="'cmpm-c'") as caught:
        for state in explicit_steps(mesh, body, LAW[1], method=method, steps=2000, every=10, engine="numpy",
                                    safety=0.8):
            pass
    assert "shorter" not in str(caught.value)
    assert caught.value.state is state and np.isfinite(state.particles.velocity).all()


@quiet
def test_neither_damping_nor_a_share_of_pic_stops_it():
    for choices in ({"damping": 0.05}, {"flip": 0.95}):
        _, energy = ringing(2, 6, "cmpm", steps=600, every=10, **choices)
        assert energy[-1] > 5


@pytest.mark.parametrize("method", METHODS)
def test_a_method_that_flutters_says_so_once_when_it_starts_and_runs(method):
    mesh, body = shifted(1, 5)
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        states = list(explicit_steps(mesh, body, LAW[1], method=method, steps=3, engine="numpy"))
    assert len(states) == 3
    assert len(record) == (method in FLUTTERING)
    assert all("waves grow" in str(entry.message) and "'cmpm-c'" in str(entry.message) for entry in record)
