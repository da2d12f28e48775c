"""What a set-up says of itself before it runs, and what a run did."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from skfem import MeshLine, MeshQuad

from skfem_mpm import LinearElastic, Particles, axisymmetric, explicit_steps, implicit_steps, plane_strain, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.scenes import vertical_cut
from skfem_mpm.stability import critical_step, crossings, diagnose, growth, ledger, roughness

LAW = LinearElastic(E=1.0, nu=0.2)


def block(cells=4, where=None, kinematics=plane_strain, low=0.0):
    lines = np.arange(cells + 1.0)
    body = Particles.fill(MeshQuad.init_tensor(lines + low, lines), kinematics, where=where)
    wide = np.arange(-3.0, cells + 4)
    return MeshQuad.init_tensor(wide[wide >= -low] + low, wide), body


# Before a run

def test_a_full_block_is_told_as_it_is():
    found = diagnose(*block(), LAW)
    assert (found.points, found.cells, found.per_cell, found.holes, found.light) == (64, 16, (4, 4, 4), 0, 0)
    assert_allclose([found.cover, found.mass], [1, 0.5])     # a corner has a quarter of a cell, the median node half
    assert found.growth.cause == "none" and found.energy["kinetic"] == 0


def test_rings_are_full_by_their_own_volume():
    assert_allclose(diagnose(*block(kinematics=axisymmetric, low=1.0), LAW).cover, 1)


def test_steps_are_those_of_the_room():
    layout = block(2)
    found = diagnose(*layout, LAW, method="cmpm", safety=0.7)
    assert found.step == critical_step(*layout, LAW, method="cmpm")
    assert found.growth == growth(*layout, LAW, method="cmpm", safety=0.7) and found.dt == found.growth.dt


def test_holes_cuts_and_light_nodes_are_counted():
    mesh, body = block(where=lambda x: (abs(x[0] - 1.5) > 0.5) | (abs(x[1] - 1.5) > 0.5))
    assert diagnose(mesh, body, LAW).holes == 1
    lone = replace(body.where(np.array([0])), x=np.array([[4 + 1e-10], [0.5]]), volume=np.array([1e-3]))
    joined = replace(body, **{name: np.concatenate([getattr(body, name), getattr(lone, name)], axis=-1)
                              for name in ("x", "volume", "mass", "length")})
    found = diagnose(mesh, joined, LAW)
    assert_allclose(found.cover, 1e-3)
    assert found.light == 2 and found.per_cell[0] == 1


def test_the_table_is_short_and_says_when_damping_is_left_out():
    layout = block(2)
    plain, damped = (str(diagnose(*layout, LAW, damping=damping)) for damping in (0.0, 0.1))
    assert len(plain.splitlines()) == 8 and max(map(len, plain.splitlines())) < 120
    assert "damping" not in plain and "left out" in damped


# Roughness

def test_a_linear_field_is_smooth_and_a_checkerboard_is_rough():
    _, body = block()
    assert roughness(body, 3 + 2 * body.x[0] - body.x[1]) < 1e-12
    inside = np.rint(2 * body.x - 0.5).sum(axis=0) % 2 * 2 - 1.0
    assert_allclose(roughness(body, inside), 1, atol=0.1)
    assert_allclose(roughness(body, 5 * inside), 5 * roughness(body, inside))


def test_roughness_of_the_cut_is_that_of_its_horizontal_stress():
    scene = vertical_cut(h=0.25)
    *_, state = scene.run("mpm", steps=20, every=20)
    assert_allclose(roughness(state.particles, state.particles.stress[0, 0]) / scene.weight, scene.roughness(state))


def test_few_points_have_a_roughness_too():
    body = Particles.fill(MeshLine(), uniaxial)
    assert roughness(body, np.array([1.0, 3.0])) < 1e-12
    assert roughness(body.where(np.array([0])), np.array([1.0])) < 1e-12
    assert roughness(body, np.array([1.0, 3.0]), neighbours=1) < 1e-12


@pytest.mark.parametrize("values, neighbours, message", [
    (np.zeros(3), 16, "^values"), (np.zeros(2), 0, "^neighbours: got 0"), (np.zeros(2), 2.5, "^neighbours: got 2.5")])
def test_bad_fields_are_refused(values, neighbours, message):
    with pytest.raises(ValueError, match=message):
        roughness(Particles.fill(MeshLine(), uniaxial), values, neighbours)


# After a run

def flying(steps=20, every=1, **choices):
    mesh, body = block(2)
    body = replace(body, velocity=np.broadcast_to([[1.0], [0.0]], body.x.shape).copy())
    return mesh, list(explicit_steps(mesh, body, LAW, steps=steps, every=every, dt=0.05, **choices))


def test_crossings_are_those_of_a_flight():
    mesh, states = flying(19)
    numbers = [crossings(one, two, mesh).number for one, two in zip(states, states[1:])]
    assert sum(numbers) == 16 and set(numbers) == {0, 8}             # 0.95 wide: each of two columns crosses once
    whole = crossings(states[0], states[-1], mesh)
    assert whole.number == 16 and whole.share == 1 / 18              # a point crosses once in 18 steps


def test_crossings_go_forwards():
    mesh, states = flying(2)
    with pytest.raises(ValueError, match="^after: got step 1"):
        crossings(states[1], states[0], mesh)


def test_the_ledger_of_a_fall_is_that_of_a_fall():
    mesh, body = block(2)
    book = ledger(explicit_steps(mesh, body, LAW, steps=10, dt=0.05, gravity=(0.0, -2.0)))
    assert book.step.tolist() == list(range(1, 11))
    assert_allclose(book.linear, [0 * book.time, -2 * body.mass.sum() * book.time], atol=1e-12)
    assert_allclose(book.kinetic, body.mass.sum() * (2 * book.time) ** 2 / 2)
    assert_allclose(book.balance, 0, atol=1e-12)
    assert_allclose(book.angular, -2 * body.mass.sum() * book.time, atol=1e-12)      # its middle is at x = 1


def test_the_ledger_books_what_damping_takes():
    mesh, body = block(2)
    book = ledger(explicit_steps(mesh, body, LAW, [FixedPlane(1, 0.0, -1)], steps=60, every=10, damping=0.1,
                                 gravity=(0.0, -0.01)))
    assert (np.diff(book.damped) > 0).all() and abs(book.balance).max() < 0.1 * book.external.max()


def test_implicit_dynamics_have_a_ledger_without_work():
    mesh, body = block(2)
    book = ledger(implicit_steps(mesh, body, LAW, steps=2, dt=0.1, gravity=(0.0, -1.0)))
    assert_allclose(book.linear[1], -body.mass.sum() * book.time, rtol=1e-9)
    assert np.isnan(book.external).all() and np.isnan(book.balance).all()


def test_no_states_are_refused():
    with pytest.raises(ValueError, match="^states: got none"):
        ledger([])
