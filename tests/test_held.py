"""Load steps stop or say so: where nothing holds a part of a body, where one comes apart, and where cells fold."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import MAKE, MOTION, every_method
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    NotConvergedError,
    Particles,
    axisymmetric,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.implicit import Control
from skfem_mpm.implicit.held import Parts
from skfem_mpm.support import Support

LAW, BAR = LinearElastic(E=100.0, nu=0.3), LinearElastic(E=100.0, nu=0.0)


def scene(dim, cells=2, gap=None, kinematics=None):
    """A block of ``cells`` cells an axis at the origin, and another one behind a gap along the first axis."""
    shift = 0 if gap is None else cells + gap
    low = 5.0 if kinematics is axisymmetric else 0.0
    mesh = MAKE[dim](*[np.arange(-3.0, cells + 12) + (low if k == 0 else 0) for k in range(dim)])
    start = np.array([[low], [0.0], [0.0]])[:dim]
    body = Particles.fill(mesh, kinematics or MOTION[dim], density=1.0,
                          where=lambda x: ((x > start) & (x < start + cells)).all(axis=0))
    if gap is not None:
        x = np.concatenate([body.x, body.x + np.eye(dim)[0][:, None] * shift], axis=1)
        body = Particles(x, np.tile(body.volume, 2), np.tile(body.mass, 2), body.kinematics,
                         length=np.tile(body.length, 2))
    return mesh, body


def run(mesh, body, boundary, gravity=None, **choices):
    return next(implicit_steps(mesh, body, LAW, boundary, steps=1, gravity=gravity, **choices))


def nail(*x):
    return Wall(np.array(x)[:, None], [0.0] * len(x), name="nail")


# Every rigid motion that is left is found and named.

@every_method
@pytest.mark.parametrize("shift", [0.0, 0.3])
@pytest.mark.parametrize("floor", [0.0, 1e-6])
def test_a_block_on_a_slippery_floor_is_refused(method, shift, floor):
    """Even if nothing pushes it: rounding alone would say where it slides."""
    mesh, body = scene(2)
    body = replace(body, x=body.x + [[shift], [0.0]])
    with pytest.raises(NotConvergedError, match="^step 1: boundary: .*point 0 .* nothing holds along axis 0;") as stop:
        run(mesh, body, [FixedPlane(1, 0.0, -1)], (0.0, -1e-3), method=method, floor=floor)
    assert stop.value.state.step == 0


@pytest.mark.parametrize("dim, boundary, way", [
    (2, [nail(1.0, 1.0)], "against rotation"), (2, [nail(0.0, 0.0)], "against rotation"),
    (2, [FixedPlane(0, 0.0, -1)], "along axis 1"),
    (3, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1)], "along axis 2"),
    (3, [FixedPlane(2, 0.0, -1), nail(1.0, 1.0, 0.0)], "against rotation in the plane of axes 0 and 1"),
    (3, [nail(1.0, 1.0, 1.0)], "against rotation"),
    (3, [nail(0.0, 0.0, 0.0), nail(0.0, 0.0, 2.0)], "against rotation in the plane of axes 0 and 1")])
def test_the_way_that_is_free_is_named(dim, boundary, way):
    mesh, body = scene(dim)
    with pytest.raises(NotConvergedError, match=f"nothing holds {way}"):
        run(mesh, body, boundary, [-1e-3] * dim)


@pytest.mark.parametrize("dim, boundary", [
    (1, [FixedPlane(0, 0.0, -1)]), (2, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1)]),
    (2, [FixedPlane(0, 0.0, -1, (0, 1))]), (2, [nail(0.1, 0.1), nail(1.9, 0.1)]),
    (2, [FixedPlane(1, 0.0, -1), nail(1.0, 1.0)]), (3, [FixedPlane(k, 0.0, -1) for k in range(3)]),
    (3, [nail(0.0, 0.0, 0.0), nail(0.0, 0.0, 2.0), nail(0.0, 2.0, 0.0)])])
def test_what_is_held_is_let_through(dim, boundary):
    mesh, body = scene(dim)
    state = run(mesh, body, boundary, [-1e-3] * dim)
    assert 0 < abs(state.particles.x - body.x).max() < 0.01


def test_hoops_hold_the_radius_but_not_the_axis():
    mesh, body = scene(2, kinematics=axisymmetric)
    wall = Wall(np.array([[5.0, 5.0], [0.5, 1.5]]), (1e-3, None))
    with pytest.raises(NotConvergedError, match="nothing holds"):
        run(mesh, body, [wall])
    run(mesh, body, [wall, FixedPlane(1, 0.0, -1)])
    run(mesh, body, [FixedPlane(1, 0.0, -1)])


def test_with_inertia_a_body_may_be_free():
    mesh, body = scene(2)
    state = run(mesh, body, [FixedPlane(1, 0.0, -1)], (1e-3, 0.0), dt=0.1)
    assert_allclose(state.particles.velocity[0], 1e-4, rtol=1e-6)


def test_a_control_holds_its_place():
    """The lower end of a bar on which nothing else but a weight acts."""
    mesh, body = scene(2)
    held = [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1)]
    state = run(mesh, body, held, (0.0, -1.0), control=Control([0.0, 2.0], [0.0, -1.0], 1e-3))
    assert state.control.x[1] == pytest.approx(2.0 - 1e-3)
    with pytest.raises(NotConvergedError, match="nothing holds along axis 0"):
        run(mesh, body, held[1:], (0.0, -1.0), control=Control([0.0, 2.0], [0.0, -1.0], 1e-3))


# Parts.

@every_method
@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("gap", [1, 2, 3])
def test_a_second_body_does_not_hang_on_the_soft_floor(method, dim, gap):
    mesh, body = scene(dim, gap=gap)
    with pytest.raises(NotConvergedError, match="nothing holds"):
        run(mesh, body, [FixedPlane(0, 0.0, -1, tuple(range(dim)))], (1e-9,) + (0.0,) * (dim - 1), method=method)


@every_method
def test_two_bodies_that_are_held_are_two_runs_in_one(method):
    mesh, both = scene(1, cells=3, gap=4)
    _, one = scene(1, cells=3)
    base, far = FixedPlane(0, 0.0, -1, name="base"), Wall(np.array([[7.0]]), (0.0,), name="far")
    together = run(mesh, both, [base, far], (-1e-3,), method=method, floor=0.0)
    alone = run(mesh, one, [base], (-1e-3,), method=method, floor=0.0)
    assert_allclose(together.particles.sigma[0, :one.n], alone.particles.sigma[0], rtol=1e-9)
    assert together.reactions["far"][0] == pytest.approx(3e-3)


@pytest.mark.parametrize("gap, linear, wide", [(0, 1, 1), (1, 2, 1), (2, 2, 1), (3, 2, 2)])
def test_parts_are_linked_by_nodes_that_both_read(gap, linear, wide):
    """Domains a little wider than a cell reach into the gap from both sides, and meet at its nodes."""
    mesh, body = scene(2, gap=gap)
    for method, size, expected in (("mpm", 1.0, linear), ("gimp", 2.2, wide)):
        points = replace(body, length=body.length * size)
        found = Parts(Support(mesh, points, METHODS[method], "ghost", []))
        of_points, of_nodes = found.found[0]
        assert len(np.unique(of_points)) == len(np.unique(of_nodes)) == expected


# Coming apart.

def pulled(method, steps, **choices):
    """Steps of a bar of four cells that is drawn by half a cell in each."""
    mesh = MeshLine(np.arange(-8.0, 24.0))
    body = Particles.fill(MeshLine(np.arange(5.0)), uniaxial, density=1.0)
    ends = [FixedPlane(0, 0.0, -1, name="base"), Wall(np.array([[4.0]]), (0.5,), name="pull")]
    return implicit_steps(mesh, body, BAR, ends, steps=steps, method=method, **choices)


def drawn_stress(step):
    """What the bar carries while it holds together."""
    return BAR.E * np.log(1 + step / 8)


@every_method
def test_a_bar_that_comes_apart_says_so_or_stops(method):
    """Two points a cell, drawn to four times its length: its reaction is gone, and that is no physics."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            for state in pulled(method, 24):
                lost = abs(state.reactions["pull"][0]) < 1e-3 * drawn_stress(state.step)
                assert not lost or any("comes apart" in str(each.message) for each in heard)
            assert lost
        except NotConvergedError as stop:
            assert "nothing holds" in str(stop) and stop.state.step > 3
    apart = [str(each.message) for each in heard if "comes apart" in str(each.message)]
    assert not any(f"step {step}:" in text for step in range(1, 5) for text in apart)


@every_method
def test_points_that_get_too_few_are_told_before_the_bar_breaks(method):
    """Once, at a stretch where half of a cell has become most of it."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        list(pulled(method, 5))
    texts = [str(each.message) for each in heard]
    assert len(texts) == 1 and "getting too few" in texts[0]


def test_a_bar_that_comes_apart_is_told_once():
    """By then some of it carries nothing; up to a stretch of 1.375 it does, and nothing is said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, whole = pulled("mpm", 3)
    assert whole.particles.sigma.mean() > 0.5 * drawn_stress(3)
    with pytest.warns(UserWarning, match="step .*comes apart: points 0 at .* have no cell left that links") as said:
        *_, apart = pulled("mpm", 10)
    texts = [str(each.message) for each in said]
    assert [word in text for text, word in zip(texts, ("getting too few", "comes apart"), strict=True)] == [True, True]
    assert abs(apart.particles.sigma).min() < 0.01 * drawn_stress(10)


def test_a_body_in_one_piece_is_not_said_to_come_apart():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in pulled("gimp", 6, domains="stretched"):
            pass


# Planes that hold nothing.

def test_a_plane_outside_the_mesh_is_refused():
    mesh, body = scene(2)
    with pytest.raises(ValueError, match=r"^at: got a fixed plane 'far' at -30.0, which is no grid line of axis 1"):
        run(mesh, body, [FixedPlane(1, 0.0, -1, (0, 1)), FixedPlane(1, -30.0, -1, name="far")])


def test_a_plane_that_the_body_does_not_reach_is_told():
    mesh, body = scene(2)
    held = [FixedPlane(1, 0.0, -1, (0, 1)), FixedPlane(0, -2.0, -1, name="far")]
    with pytest.warns(UserWarning, match="plane 'far': no node of the body is on the plane at -2 along axis 0"):
        state = run(mesh, body, held, (0.0, -1e-3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")                       # once, and in dynamics it may be on its way there
        next(implicit_steps(mesh, state, LAW, steps=1, gravity=(0.0, -1e-3)))
        run(mesh, body, held, (0.0, -1e-3), dt=0.1)


# Steps that are cut.

@every_method
def test_a_constant_load_that_is_too_large_at_once_comes_in_parts(method):
    """A column under 1.6 times its modulus; then as far as when the load is a ramp, bit for bit."""
    mesh, column = MeshLine(np.arange(-3.0, 12.0)), Particles.fill(MeshLine(np.arange(9.0)), uniaxial, density=1.0)
    states = [next(implicit_steps(mesh, column, Hencky(E=1.0, nu=0.0), [FixedPlane(0, 0.0, -1)], steps=1,
                                  method=method, gravity=load)) for load in ((-0.2,), lambda step: (-0.2 * step,))]
    assert states[0].cuts > 0
    assert_array_equal(states[0].particles.x, states[1].particles.x)
    assert states[0].gravity == (-0.2,)


def test_what_no_longer_fits_in_a_later_step_stops_with_the_last_state():
    """The first step is a matter of input, and a ValueError; the fourth is not."""
    mesh, body = scene(2)
    held = [FixedPlane(1, 0.0, -1, (0, 1))]
    states = []
    with pytest.raises(NotConvergedError, match="step 4: gravity: got shape") as stop:
        for state in implicit_steps(mesh, body, LAW, held, steps=5,
                                    gravity=lambda step: (0.0, -1e-3) if step <= 3 else (0.0,)):
            states.append(state)
    assert stop.value.state is states[-1] and states[-1].step == 3
    with pytest.raises(ValueError, match="^gravity: got shape"):
        run(mesh, body, held, (0.0,))


def test_a_solver_that_complains_stops_with_the_last_state():
    def solver(matrix, rhs):
        raise ValueError("array must not contain infs or NaNs")

    mesh, body = scene(2)
    with pytest.raises(NotConvergedError, match="^step 1: solver: array must not contain") as stop:
        run(mesh, body, [FixedPlane(1, 0.0, -1, (0, 1))], (0.0, -1e-3), solver=solver)
    assert stop.value.state.step == 0


# Cells that turn inside out without a point that feels it.

def slid(**choices):
    """A block turned by 20 degrees that slides over the grid; its lowest corners are small cuts."""
    angle = np.radians(20)
    along, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    fill = Particles.fill(MeshQuad.init_tensor(np.arange(5.0), np.arange(5.0)), plane_strain, density=1.0)
    body = replace(fill, x=np.stack([along, up], axis=1) @ fill.x)
    axis = np.arange(-6.0, 13.0) + 0.0371
    wall = Wall(along[:, None] * np.linspace(0, 4, 5), tuple(along / 3), name="base")
    for state in implicit_steps(MeshQuad.init_tensor(axis, axis), body, LinearElastic(E=1.0, nu=0.0), [wall], steps=6,
                                gravity=lambda step: -0.075 * step / 6 * up, **choices):
        pass
    exact = -0.075 * (4 - fill.x[1]) * np.multiply.outer(up, up)[:, :, None]
    return np.sqrt(((state.particles.stress[:2, :2] - exact) ** 2).sum(axis=(0, 1)).mean()) / 0.3


@pytest.mark.parametrize("method", ["mpm", "cmpm-c"])
def test_small_cuts_that_fold_are_told_and_a_ghost_penalty_helps(method):
    with pytest.warns(UserWarning, match=r"step \d: the cell around \(.*\) is turned inside out.*ghost=0.1"):
        assert slid(method=method) > 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert slid(method=method, ghost=0.1) < 0.2


def test_cells_of_one_point_are_told_where_no_domains_reach_on():
    mesh = MeshQuad.init_tensor(np.arange(-3.0, 8.0), np.arange(-3.0, 8.0))
    held = [FixedPlane(1, 0.0, -1, (0, 1))]
    few, many = (Particles.fill(MeshQuad.init_tensor(np.arange(4.0), np.arange(4.0)), plane_strain, per_cell=count,
                                density=1.0) for count in (1, 2))
    with pytest.warns(UserWarning, match="each cell holds one point"):
        run(mesh, few, held, (0.0, -1e-3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(mesh, few, held, (0.0, -1e-3), method="gimp")
        run(mesh, many, held, (0.0, -1e-3))
