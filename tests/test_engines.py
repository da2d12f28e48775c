"""The numba engine against the numpy engine, and what is bit-identical."""

import importlib.util
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from skfem import MeshHex, MeshLine, MeshQuad

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


def block(dim, kinematics, cells=4, axes=None):
    """A block with random velocities on a rough floor, rising and tilting so that points cross cells."""
    h, start = 1 / cells, 2.0 if kinematics is axisymmetric else 0.0
    lines, axis = np.linspace(0, 1, cells + 1), h * np.arange(-1, cells + 4)
    make = {1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[dim]
    inner, outer = [lines + start, lines, lines][:dim], axes or [axis + start, axis, axis][:dim]
    particles = Particles.fill(make(*inner), kinematics, density=1.0)
    rng = np.random.default_rng(0)
    particles = replace(particles, x=particles.x + 0.03 * h * rng.uniform(-1, 1, particles.x.shape),
                        velocity=0.3 + 0.1 * rng.uniform(-1, 1, particles.x.shape))
    floor = FixedPlane(dim - 1, start if dim == 1 else 0.0, -1, tuple(range(dim)), name="floor")
    planes = [floor] + ([FixedPlane(0, start, -1, name="left")] if dim > 1 else [])
    return make(*outer), particles, planes


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
    a, b = both(block(dim, kinematics, cells=4 if dim < 3 else 3), law, method=method, integrator="usl")
    assert (a.engine, b.engine) == ("numpy", "numba")
    check_equal(a, b)


@pytest.mark.parametrize("choices", [
    {"integrator": "musl"}, {"integrator": "usf"}, {"integrator": "usf", "method": "cmpm-c"},
    {"integrator": "musl", "method": "cmpm-c", "gravity": None}, {"integrator": "musl", "method": "gc", "xpic": 3},
    {"integrator": "usl", "damping": 0.2, "gravity": None}, {"integrator": "usl", "strain": "logarithmic"},
    {"integrator": "usl", "method": "gimp", "ramp": 0.1, "damping": 0.1}, {"integrator": "musl", "refresh": 7}],
    ids=str)
def test_engines_agree_for_every_choice(choices):
    a, b = both(block(2, plane_strain), ELASTIC, **choices)
    check_equal(a, b)


@pytest.mark.parametrize("edges", ["clip", "truncate"])
def test_engines_agree_at_the_edges_of_the_grid(edges):
    lines = np.linspace(0, 1.5, 7)
    body = block(2, plane_strain, axes=[lines, lines])
    check_equal(*both(body, ELASTIC, method="gimp", edges=edges, integrator="usl"))


def test_engines_agree_on_graded_axes():
    lines = np.concatenate([[-0.3, 0.0, 0.2, 0.45], 0.75 + 0.3 * np.arange(4)])
    body = block(2, plane_strain, axes=[lines, lines])
    check_equal(*both(body, ELASTIC, method="cmpm", integrator="usl"))
    body = (body[0], replace(body[1], length=body[1].length * 2.2), body[2])        # longer than the smallest cell
    check_equal(*both(body, ELASTIC, method="gimp", edges="clip", integrator="usl"))


def test_engines_agree_in_plastic_space():
    check_equal(*both(block(3, solid, cells=2), PLASTIC, method="mpm", integrator="usl"))


@pytest.mark.parametrize("method", ["mpm", "gimp", "cmpm-c"])
def test_threads_and_repeats_are_bit_identical(method):
    body = block(2, plane_strain, cells=16)
    one = run(body, PLASTIC, method=method, engine="numba", threads=1, steps=30)[-1]
    for threads in (2, 1):
        check_identical(one, run(body, PLASTIC, method=method, engine="numba", threads=threads, steps=30)[-1])


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("method", ["gimp", "cmpm"])
def test_a_continued_run_is_bit_identical(method, engine):
    """From snapshots on, before and in between two sorts, and with the step found anew on the way."""
    body, choices = block(2, plane_strain), {"method": method, "engine": engine, "refresh": 60}
    whole = run(body, PLASTIC, steps=230, every=10, **choices)
    for at in (7, 9, 10, 19):                                           # after steps 80, 100, 110 and 200
        rest = run(body, PLASTIC, steps=230 - whole[at].step, every=10, start=whole[at], **choices)
        for a, b in zip(whole[at + 1:], rest, strict=True):
            check_identical(a, b)


def test_lengths_scaled_by_a_power_of_two_change_no_bit():
    mesh, particles, planes = block(2, plane_strain)
    scale = 2.0 ** 30
    big = Particles(particles.x * scale, particles.volume * scale ** 2, particles.mass * scale ** 2,
                    plane_strain, length=particles.length * scale, velocity=particles.velocity * scale)
    walls = [replace(plane, at=plane.at * scale) for plane in planes]
    law = LinearElastic(E=ELASTIC.E * scale ** 2, nu=ELASTIC.nu)
    a = run((mesh, particles, planes), ELASTIC, method="gimp", engine="numba")[-1]
    b = run((mesh.scaled(scale), big, walls), law, method="gimp", engine="numba", gravity=(0.0, -scale))[-1]
    assert (a.particles.x * scale == b.particles.x).all()
    assert (a.particles.sigma * scale ** 2 == b.particles.sigma).all()


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
    assert messages[0].split(" at ")[0] == messages[1].split(" at ")[0]
    return caught.value


def test_a_point_that_leaves_is_named():
    mesh, particles, _ = block(2, plane_strain)
    fast = replace(particles, velocity=particles.velocity * 0 + np.array([[3.0], [0.0]]))
    assert "point" in str(both_refuse(OutsideGridError, (mesh, fast, []), ELASTIC, steps=300))


@pytest.mark.parametrize("method", ["mpm", "cmpm"])
def test_a_point_that_turns_inside_out_is_named(method):
    error = both_refuse(UnstableError, block(2, plane_strain), ELASTIC, dt=0.2, steps=50, method=method)
    assert error.state is not None and np.isfinite(error.state.particles.sigma).all()


def test_a_velocity_that_is_no_longer_finite_is_named():
    body = block(2, plane_strain)
    state = run(body, ELASTIC, steps=1, engine="numba")[-1]
    error = both_refuse(UnstableError, body, ELASTIC, steps=2, start=state, gravity=(0.0, -1e308), dt=1.0)
    assert error.state is not None
