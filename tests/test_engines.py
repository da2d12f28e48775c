"""The numba engine against the numpy engine, and what is bit-identical."""

import importlib.util
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from shared import block, both_engines, every_method
from skfem import MeshQuad

from skfem_mpm import (
    METHODS,
    LinearElastic,
    Method,
    ParticleBasis,
    Particles,
    UnstableError,
    VonMises,
    axisymmetric,
    explicit_steps,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.checks import OutsideGridError

pytest.importorskip("numba")

ELASTIC = LinearElastic(E=100.0, nu=0.3)
PLASTIC = VonMises(E=100.0, nu=0.3, peak=2.0, residual=0.5, softening=-5.0)
ARRAYS = ("x", "velocity", "sigma", "volume", "history", "epsilon")
pytestmark = pytest.mark.filterwarnings("ignore:the strain of this method:UserWarning")


def run(body, law, steps=50, every=None, start=None, **choices):
    mesh, particles, planes = body
    gravity = (0.0,) * (particles.dim - 1) + (-1.0,)
    choices = {"gravity": gravity, "safety": 0.25, "flip": 0.95} | choices
    return list(explicit_steps(mesh, start or particles, law, planes, steps=steps, every=every or steps, **choices))


def check_equal(a, b, tolerance=1e-12):
    for name in ARRAYS:
        one, other = getattr(a.particles, name), getattr(b.particles, name)
        assert (one is None) == (other is None)
        if one is not None:
            assert abs(one - other).max() <= tolerance * max(abs(one).max(), 1e-30), name
    largest = max(map(abs, a.energy.values()))
    for name, value in a.energy.items():
        assert abs(value - b.energy[name]) <= tolerance * largest, name


def check_identical(a, b):
    for name in ARRAYS:
        one, other = getattr(a.particles, name), getattr(b.particles, name)
        assert (one is None and other is None) or (one == other).all(), name
    assert dict(a.energy) == dict(b.energy) and a.dt == b.dt and a.time == b.time


def both(body, law, **choices):
    return [run(body, law, engine=engine, **choices)[-1] for engine in ("numpy", "numba")]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dim, kinematics, law", [
    (1, uniaxial, ELASTIC), (1, axisymmetric, PLASTIC), (2, plane_strain, PLASTIC), (2, axisymmetric, ELASTIC),
    (3, solid, ELASTIC)], ids=["bar", "ring", "plane", "axisymmetric", "solid"])
def test_engines_agree(dim, kinematics, law, method):
    a, b = both(block(dim, kinematics, cells=4 if dim < 3 else 2), law, method=method, integrator="usl")
    assert (a.engine, b.engine) == ("numpy", "numba")
    check_equal(a, b)


@pytest.mark.parametrize("choices", [
    {}, {"integrator": "usf"}, {"integrator": "usf", "method": "cmpm-c"}, {"integrator": "usf", "method": "gimp"},
    {"method": "cmpm-c", "gravity": None}, {"method": "gc", "xpic": 3}, {"method": "cmpm", "xpic": 1, "flip": 0.5},
    {"integrator": "usl", "damping": 0.2, "gravity": None}, {"integrator": "usl", "strain": "logarithmic"},
    {"strain": "logarithmic", "method": "gimp", "integrator": "usf"}, {"refresh": 7}, {"refresh": 7, "method": "gimp"},
    {"integrator": "usl", "method": "gimp", "ramp": 0.1, "damping": 0.1}, {"tpic": True, "flip": 0.0},
    {"tpic": True, "method": "gimp", "integrator": "usl"}, {"tpic": True, "method": "cmpm-c", "integrator": "usf"},
    {"remedy": "bbar"}, {"remedy": "bbar", "method": "gimp", "integrator": "usl"},
    {"remedy": "bbar", "method": "cmpm", "integrator": "usf"},
    {"integrator": "usavg"}, {"integrator": "usavg", "method": "gimp", "flip": 0.9, "remedy": "bbar"},
    {"integrator": "usavg", "method": "cmpm-c", "strain": "logarithmic", "damping": 0.1},
    {"remedy": "bbar", "method": "gimp", "tpic": True}], ids=str)
def test_engines_agree_for_every_choice(choices):
    check_equal(*both(block(2, plane_strain), ELASTIC, **choices))


@pytest.mark.parametrize("dim, kinematics", [(1, axisymmetric), (2, axisymmetric), (3, solid)])
@pytest.mark.parametrize("choices", [{"remedy": "bbar", "method": "gimp"}, {"tpic": True, "method": "cmpm-c"}, {}],
                         ids=str)
def test_engines_agree_for_choices_in_other_kinematics(dim, kinematics, choices):
    check_equal(*both(block(dim, kinematics, cells=4 if dim < 3 else 2), ELASTIC, **choices))


@pytest.mark.parametrize("edges", ["clip", "truncate"])
def test_engines_agree_at_the_edges_of_the_grid(edges):
    lines = np.linspace(0, 1.5, 7)
    body = block(2, plane_strain, axes=[lines, lines])
    check_equal(*both(body, ELASTIC, method="gimp", edges=edges, integrator="usl"))
    if edges == "clip":
        check_equal(*both(body, ELASTIC, method="gimp", edges=edges, remedy="bbar"))


def test_engines_agree_on_graded_axes():
    lines = np.concatenate([[-0.3, 0.0, 0.2, 0.45], 0.75 + 0.3 * np.arange(4)])
    body = block(2, plane_strain, axes=[lines, lines])
    check_equal(*both(body, ELASTIC, method="cmpm", integrator="usl"))
    check_equal(*both(body, ELASTIC, method="mpm", remedy="bbar"))
    body = (body[0], replace(body[1], length=body[1].length * 2.2), body[2])        # longer than the smallest cell
    check_equal(*both(body, ELASTIC, method="gimp", edges="clip", integrator="usl"))


def test_engines_agree_in_plastic_space():
    for choices in ({"integrator": "usl"}, {}, {"remedy": "bbar"}):
        check_equal(*both(block(3, solid, cells=2), PLASTIC, method="mpm", **choices))


class Stiffening(LinearElastic):
    """A law of the user's own: stiffer under pressure."""

    def update(self, strain, stress, history, components):
        size = 1 + 0.1 * np.tanh(-stress[:3].mean(axis=0))
        return stress + size * self.trial(strain, np.zeros_like(stress), components), history


@pytest.mark.parametrize("choices", [{}, {"integrator": "usl"}, {"integrator": "usf", "remedy": "bbar"}], ids=str)
def test_engines_agree_with_a_law_of_ones_own(choices):
    check_equal(*both(block(2, plane_strain), Stiffening(E=100.0, nu=0.3), method="gimp", **choices))


@pytest.mark.parametrize("integrator", ["musl", "usl"])
@pytest.mark.parametrize("method", ["mpm", "fe-gimp", "gimp", "cmpm-c"])
def test_engines_agree_on_points_on_nodes_and_faces(method, integrator):
    """The far nodes have no mass, but points see them by their slopes."""
    mesh, particles, planes = block(2, plane_strain)
    x = particles.x.copy()
    x[:, 10], x[0, 20], x[1, 30], x[0, -5:] = (0.25, 0.5), 0.75, 0.25, 1.0
    particles = replace(particles, x=x)
    check_equal(*both((mesh, particles, planes), ELASTIC, method=method, integrator=integrator))


@both_engines
@every_method
def test_a_block_with_points_on_faces_is_stretched_without_shear(method, engine):
    """The nodes beyond have no mass: they follow those across the face, however many rows there are above and below."""
    body = Particles.fill(MeshQuad.init_tensor(np.arange(5.0), np.arange(4.0)), plane_strain)
    body = replace(body, x=body.x + [[0.25], [0.1]])
    body = replace(body, velocity=np.stack([np.zeros(body.n), -1e-3 * body.x[1]]))
    mesh = MeshQuad.init_tensor(*[np.arange(-2.0, 8.0)] * 2)
    *_, state = explicit_steps(mesh, body, LinearElastic(E=1.0, nu=0.0), steps=1, method=method, integrator="usl",
                               engine=engine)
    assert (body.x[0] % 1 == 0).any()
    sigma = np.abs(state.particles.sigma).max(axis=1)
    assert sigma[3] < 1e-13 * sigma[1] and sigma[0] < 1e-13 * sigma[1]


@both_engines
@pytest.mark.parametrize("side", [-1, 1])
@every_method
def test_points_on_a_smooth_plane_slide_along_it_without_stress(method, side, engine):
    """Those that count to the cells behind it read images of nodes in cells that hold no point."""
    axis, n = np.arange(7.0), 3
    body = Particles(np.array([[3.0] * n, [2.0, 2.4, 3.0]]), np.ones(n), np.ones(n), plane_strain,
                     length=np.full((2, n), 0.5), velocity=np.repeat([[0.0], [0.01]], n, axis=1))
    *_, state = explicit_steps(MeshQuad.init_tensor(axis, axis), body, ELASTIC, [FixedPlane(0, 3.0, side)], steps=5,
                               method=method, engine=engine)
    np.testing.assert_allclose(state.particles.velocity, body.velocity, atol=1e-15)
    assert np.abs(state.particles.sigma).max() < 1e-14 * ELASTIC.E


def test_engines_agree_on_a_detached_body_of_almost_no_mass():
    mesh, particles, planes = block(2, plane_strain, axes=[0.25 * np.arange(-1, 12)] * 2)
    joined = {"x": [[2.05], [2.1]], "volume": particles.volume[:1], "mass": particles.mass[:1] * 1e-10,
              "length": particles.length[:, :1], "velocity": [[0.0], [0.1]]}
    joined = {name: np.concatenate([getattr(particles, name), more], axis=-1) for name, more in joined.items()}
    both_bodies = Particles(kinematics=plane_strain, **joined)
    a, b = both((mesh, both_bodies, planes), ELASTIC, gravity=None, steps=20)
    check_equal(a, b)
    assert abs(a.particles.velocity[:, -1] - [0.0, 0.1]).max() < 1e-10


@pytest.mark.parametrize("method", ["mpm", "gimp", "cmpm-c"])
def test_threads_and_repeats_are_bit_identical(method):
    body = block(2, plane_strain, cells=20)
    one = run(body, PLASTIC, method=method, engine="numba", threads=1, steps=30)[-1]
    for threads in (2, 3, 1):
        check_identical(one, run(body, PLASTIC, method=method, engine="numba", threads=threads, steps=30)[-1])


def test_threads_are_bit_identical_with_every_extra():
    body, choices = block(2, plane_strain, cells=20), {"method": "gimp", "engine": "numba", "steps": 10}
    choices |= {"tpic": True, "remedy": "bbar", "damping": 0.1, "xpic": 2}
    check_identical(run(body, ELASTIC, threads=1, **choices)[-1], run(body, ELASTIC, threads=2, **choices)[-1])


@both_engines
@pytest.mark.parametrize("choices", [{"method": "gimp"}, {"method": "cmpm", "tpic": True}], ids=str)
def test_a_continued_run_is_bit_identical(choices, engine):
    """From snapshots on, before and in between two sorts, and with the step found anew on the way."""
    body, choices = block(2, plane_strain), {"engine": engine, "refresh": 60} | choices
    whole = run(body, PLASTIC, steps=220, every=10, **choices)
    for at in (7, 9, 10, 19):                                           # after steps 80, 100, 110 and 200
        rest = run(body, PLASTIC, steps=220 - whole[at].step, every=10, start=whole[at], **choices)
        for a, b in zip(whole[at + 1:], rest, strict=True):
            check_identical(a, b)


@both_engines
@pytest.mark.parametrize("length, mass, time", [(30, 0, 0), (0, 30, 0), (0, 0, 30), (30, -30, 30), (-30, 0, 0),
                                                (0, -30, 0), (0, 0, -30), (-30, 30, -30), (0, 1, 0), (5, -7, 3)])
def test_units_scaled_by_powers_of_two_change_no_bit(length, mass, time, engine):
    body = mesh, particles, planes = block(2, plane_strain)
    along, heavy, fast = 2.0 ** length, 2.0 ** mass, 2.0 ** (length - time)
    pull = 2.0 ** (length - 2 * time)
    scaled = Particles(particles.x * along, particles.volume * along ** 2, particles.mass * heavy,
                       plane_strain, length=particles.length * along, velocity=particles.velocity * fast)
    law = LinearElastic(E=ELASTIC.E * 2.0 ** (mass - 2 * time), nu=ELASTIC.nu)      # per unit of thickness
    walls = [replace(plane, at=plane.at * along) for plane in planes]
    choices = {"method": "gimp", "engine": engine, "steps": 20}
    a = run(body, ELASTIC, **choices)[-1]
    b = run((mesh.scaled(along), scaled, walls), law, gravity=(0.0, -pull), **choices)[-1]
    assert (a.particles.x * along == b.particles.x).all() and a.dt * 2.0 ** time == b.dt
    assert (a.particles.sigma * 2.0 ** (mass - 2 * time) == b.particles.sigma).all()


def test_auto_decides_by_size_and_goes_on_with_what_it_was():
    small = run(block(2, plane_strain), ELASTIC, steps=1)[-1]
    large = run(block(2, plane_strain, cells=16), ELASTIC, steps=1)[-1]
    assert (small.engine, large.engine) == ("numpy", "numba")
    assert run(block(2, plane_strain, cells=16), ELASTIC, steps=1, start=large)[-1].engine == "numba"
    forced = run(block(2, plane_strain), ELASTIC, steps=1, engine="numba")[-1]
    assert run(block(2, plane_strain), ELASTIC, steps=1, start=forced)[-1].engine == "numba"


def test_without_numba(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"skfem-mpm\[fast\]"):
        run(block(2, plane_strain), ELASTIC, steps=1, engine="numba")
    with pytest.warns(UserWarning, match="numba"):
        assert run(block(2, plane_strain, cells=16), ELASTIC, steps=1)[-1].engine == "numpy"


def test_a_basis_of_ones_own_runs_with_numpy():
    class Own(ParticleBasis):
        pass

    method = Method(Own, Own, Own)
    assert run(block(2, plane_strain, cells=16), ELASTIC, steps=1, method=method)[-1].engine == "numpy"
    with pytest.raises(ValueError, match="engine"):
        run(block(2, plane_strain), ELASTIC, steps=1, method=method, engine="numba")


def test_numba_stays_unloaded_until_it_is_used():
    code = ("import sys, numpy as np\nfrom skfem import MeshLine\n"
            "from skfem_mpm import LinearElastic, Particles, explicit_steps, uniaxial\n"
            "mesh = MeshLine(np.linspace(0, 1, 5))\n"
            "list(explicit_steps(mesh, Particles.fill(mesh, uniaxial), LinearElastic(1.0, 0.0), steps=1))\n"
            "sys.exit('numba' in sys.modules)")
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# -- guards ------------------------------------------------------------------------------------------------------------

def both_refuse(error, body, law, **choices):
    messages = []
    for engine in ("numpy", "numba"):
        with pytest.raises(error) as caught:
            run(body, law, engine=engine, every=1, **choices)
        messages.append(str(caught.value))
    assert messages[0].split(" (it was")[0] == messages[1].split(" (it was")[0]
    return caught.value


def flying(speed):
    mesh, particles, _ = block(2, plane_strain)
    return mesh, replace(particles, velocity=particles.velocity - 0.3 + np.array([[speed], [0.0]])), []


@pytest.mark.parametrize("method", ["mpm", "gimp"])
def test_a_point_that_leaves_is_named(method):
    error = both_refuse(OutsideGridError, flying(3.0), ELASTIC, steps=300, method=method)
    assert "point" in str(error) and "step" in str(error)


@pytest.mark.parametrize("leaving", ["error", "remove"])
def test_a_domain_that_is_off_the_grid_at_the_start_is_refused(leaving):
    mesh, particles, _ = block(2, plane_strain)
    error = both_refuse(OutsideGridError, (mesh, replace(particles, x=particles.x - 0.3), []), ELASTIC, steps=1,
                        method="gimp", leaving=leaving)
    assert "domain of point 0" in str(error)


@pytest.mark.parametrize("method", ["mpm", "gimp"])
def test_points_that_leave_are_removed(method):
    """Before and after a sort; what stays keeps its place in the user's order."""
    choices = {"method": method, "leaving": "remove", "steps": 130, "gravity": None, "tpic": True}
    a, b = both(flying(2.8), ELASTIC, **choices)
    assert 0 < a.particles.n < 64 and (a.kept == b.kept).all()
    check_equal(a, b)
    states = run(flying(2.8), ELASTIC, engine="numba", every=10, **choices)
    at = next(i for i, state in enumerate(states) if state.particles.n < 64)
    rest = run(flying(2.8), ELASTIC, engine="numba", start=states[at], **choices | {"steps": 130 - states[at].step})
    check_identical(states[-1], rest[-1])


@pytest.mark.parametrize("integrator", ["musl", "usl", "usf", "usavg"])
@pytest.mark.parametrize("method", ["mpm", "cmpm"])
def test_a_point_that_turns_inside_out_or_runs_away_is_named(method, integrator):
    body = block(2, plane_strain)
    error = both_refuse(UnstableError, body, ELASTIC, dt=0.2, steps=50, method=method, integrator=integrator)
    sigma = error.state.particles.sigma                                 # of the start if the first step fails
    assert sigma is None or np.isfinite(sigma).all()


def test_a_velocity_that_is_no_longer_finite_is_named():
    body = block(2, plane_strain)
    state = run(body, ELASTIC, steps=1, engine="numba")[-1]
    error = both_refuse(UnstableError, body, ELASTIC, steps=2, start=state, gravity=(0.0, -1e308), dt=100.0)
    assert error.state is not None


def test_a_point_that_moves_more_than_a_cell_is_named():
    error = both_refuse(UnstableError, flying(3.0), ELASTIC, steps=1, dt=0.1)
    assert "more than a cell" in str(error)
