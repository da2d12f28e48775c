"""Where points are and in which units: what must not change an answer."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import MAKE, MOTION
from skfem import MeshQuad

from skfem_mpm import METHODS, LinearElastic, Particles, explicit_steps, implicit_steps, plane_strain
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.kinematics.blocks import determinant

NAMES = list(METHODS)
LENGTHS, TIMES, MASSES = [(2.0 ** 30, 1.0, 1.0), (1.0, 2.0 ** -30, 1.0), (1.0, 1.0, 2.0 ** 30)]


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_determinants_scale_bit_by_bit_and_agree_with_numpy(dim):
    blocks = np.random.default_rng(3).normal(size=(dim, dim, 50))
    assert_allclose(determinant(blocks), np.linalg.det(blocks.transpose(2, 0, 1)), rtol=1e-12, atol=1e-14)
    assert_array_equal(determinant(2.0 ** 30 * blocks), 2.0 ** (30 * dim) * determinant(blocks))


def scene(length=1.0, time=1.0, mass=1.0, shift=0.0):
    """A block in a corner of two planes, with a velocity; in units so many times as small."""
    lines = [length * (shift + np.arange(-2.0, 6.0))] * 2
    body = Particles.fill(MeshQuad.init_tensor(*(axis[2:5] for axis in lines)), plane_strain,
                          density=3.0 * mass / length ** 2)
    body = replace(body, velocity=np.full(body.x.shape, -0.1 * length / time))
    planes = [FixedPlane(k, float(lines[0][2]), -1, name=str(k)) for k in (0, 1)]
    return MeshQuad.init_tensor(*lines), body, LinearElastic(E=7.0 * mass / time ** 2, nu=0.3), planes


@pytest.mark.parametrize("method", NAMES)
@pytest.mark.parametrize("length, time, mass", [LENGTHS, TIMES, MASSES, (2.0 ** 30, 2.0 ** 30, 2.0 ** -30)])
@pytest.mark.filterwarnings("ignore:the strain of this method")
def test_time_steps_in_other_units_agree_bit_by_bit(method, length, time, mass):
    def run(*units):
        *_, state = explicit_steps(*scene(*units), steps=8, every=8, method=method, engine="numpy")
        return state

    here, there = run(), run(length, time, mass)
    assert there.time == here.time * time
    assert_array_equal(there.particles.x, here.particles.x * length)
    assert_array_equal(there.particles.sigma, here.particles.sigma * mass / time ** 2)


@pytest.mark.parametrize("held", ["planes", "wall"])
@pytest.mark.parametrize("method", NAMES)
@pytest.mark.parametrize("length, mass", [(2.0 ** 30, 1.0), (1.0, 2.0 ** 30), (2.0 ** -30, 2.0 ** -30)])
def test_load_steps_in_other_units_agree(held, method, length, mass):
    """To rounding with walls, whose rows have no unit: pivots then are others."""
    def run(length, mass):
        mesh, body, law, boundary = scene(length, 1.0, mass)
        if held == "wall":
            boundary = [Wall(length * np.array([[0.3, 1.7], [0.1, 0.1]]), (0.0, 0.0))]
        *_, state = implicit_steps(mesh, body, law, boundary, steps=1, method=method, ghost=0.1,
                                   gravity=(0.01 * length, -0.1 * length))
        return state.particles

    here, there = run(1.0, 1.0), run(length, mass)
    rounding = 1e-9 * (held == "wall")
    assert_allclose(there.x, here.x * length, rtol=rounding, atol=0)
    assert_allclose(there.sigma, here.sigma * mass, rtol=0, atol=rounding * mass * abs(here.sigma).max())


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_ghost_penalty_is_the_same_far_from_the_origin(dim):
    """Inverse maps of scikit-fem do not converge a million cells away, which is an error of no class of its own."""
    def run(shift):
        lines = 0.1 * (shift + np.arange(-2.0, 5.0))
        body = Particles.fill(MAKE[dim](*[lines[2:5]] * dim), MOTION[dim])
        planes = [FixedPlane(k, float(lines[2]), -1, name=str(k)) for k in range(dim)]
        *_, state = implicit_steps(MAKE[dim](*[lines] * dim), body, LinearElastic(E=1.0, nu=0.3 * (dim > 1)), planes,
                                   steps=1, ghost=0.1, gravity=(-0.1,) * dim)
        return state.particles.sigma

    near, far = run(0.0), run(3e6)
    assert_allclose(far, near, rtol=0, atol=1e-7 * abs(near).max())


@pytest.mark.parametrize("method", NAMES)
@pytest.mark.parametrize("aside", [-np.inf, np.inf, 0.0])
@pytest.mark.filterwarnings("ignore:the strain of this method")
def test_points_on_nodes_or_an_ulp_beside_follow_a_linear_field(method, aside):
    body = Particles.fill(MeshQuad.init_tensor(*[np.arange(3.0)] * 2), plane_strain)
    x = np.round(body.x) + 1                             # an ulp of zero would be none
    body = replace(body, x=np.nextafter(x, aside) if aside else x)
    nodes = np.stack(np.meshgrid(*[np.arange(0.0, 5.0)] * 2)).reshape(2, -1)
    gradient = 1e-3 * np.array([[1.0, 0.3], [0.3, -0.5]])
    mesh = MeshQuad.init_tensor(*[np.arange(-4.0, 7.0)] * 2)
    wall = Wall(nodes, tuple(gradient @ nodes))
    *_, state = implicit_steps(mesh, body, LinearElastic(E=1.0, nu=0.0), [wall], steps=1, strain="small", method=method)
    assert_allclose(state.particles.stress[:2, :2], np.repeat(gradient[:, :, None], body.n, axis=2), atol=1e-12)


@pytest.mark.parametrize("method", NAMES)
@pytest.mark.parametrize("away", [0.0, 1e-1, -1e-4, 1e-9, -1e-12, 1e-16])
@pytest.mark.filterwarnings("ignore:the strain of this method")
def test_a_lone_point_flies_straight_and_free_of_stress(method, away):
    x, one = np.full((2, 1), 1 + away), np.ones(1)
    point = Particles(x, one, one, plane_strain, length=np.full((2, 1), 0.5), velocity=np.full((2, 1), 0.1))
    mesh = MeshQuad.init_tensor(*[np.arange(-2.0, 8.0)] * 2)
    *_, state = explicit_steps(mesh, point, LinearElastic(E=1.0, nu=0.3), steps=20, every=20, method=method,
                               engine="numpy")
    assert_allclose(state.particles.x, x + 0.1 * state.time, rtol=1e-13)
    assert_allclose(state.particles.sigma, 0, atol=1e-13)
    assert state.time > 2                                # steps do not collapse
