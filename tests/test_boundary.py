"""Planes hold where grid lines are, walls push where they are, and their forces are reported to the last digit."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csr_array
from shared import MAKE, MOTION, every_method
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    OutsideGridError,
    Particles,
    explicit_steps,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.grid import Grid
from skfem_mpm.implicit.solve import independent_rows
from skfem_mpm.scenes import cylinder
from skfem_mpm.support import Support

LAW = LinearElastic(E=100.0, nu=0.3)


def boxed(dim, cells=8):
    """A box of material with two spare cells on every side, all cells 0.125 wide."""
    axis = np.arange(-2, cells + 3) * 0.125
    mesh = MAKE[dim](*[axis] * dim)
    return mesh, Particles.fill(mesh, MOTION[dim], density=1.0,
                                where=lambda x: ((x > 0) & (x < cells * 0.125)).all(axis=0))


# Planes.

@pytest.mark.parametrize("at", [0.05, 0.3, 0.9999])
@every_method
def test_a_plane_that_is_on_no_grid_line_is_refused(at, method):
    mesh, body = boxed(1)
    with pytest.raises(ValueError, match=rf"fixed plane 'base' at {at}.*no grid line of axis 0.*move the grid"):
        next(implicit_steps(mesh, body, LAW, [FixedPlane(0, at, -1, name="base")], steps=1, method=method))


@pytest.mark.parametrize("side", [0, 2, -3])
def test_a_plane_has_one_of_two_sides(side):
    with pytest.raises(ValueError, match=rf"^side: got {side}, expected \+1 .* or -1"):
        FixedPlane(0, 1.0, side)


@pytest.mark.parametrize("components, expected", [((), (1,)), ((0,), (0,)), ((0, 1), (0, 1))])
def test_a_plane_holds_its_normal_unless_told_otherwise(components, expected):
    assert FixedPlane(1, 0.0, -1, components).components == expected
    assert FixedPlane(1, 0.0, -1, components).advanced(0.5) == FixedPlane(1, 0.0, -1, components)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_plane_divides_the_grid(axis, side):
    mesh, _ = boxed(2)
    grid = Grid.from_mesh(mesh)
    plane = FixedPlane(axis, 0.5, side, components=(0, 1))
    x = mesh.p[axis][grid.vertices.ravel()]
    assert_array_equal(plane.behind(grid), side * (x - 0.5) > 1e-9)
    assert_array_equal(plane.fixes(grid), np.tile(np.isclose(x, 0.5), (2, 1)))


@every_method
def test_a_fixed_face_stays_where_it_is(method):
    mesh, body = boxed(2)
    planes = [FixedPlane(1, 0.0, -1, components=(0, 1), name="base")]
    state = next(implicit_steps(mesh, body, LAW, planes, steps=1, method=method, gravity=(0.5, -1.0)))
    on = np.isclose(mesh.p[1], 0)
    assert not state.displacement[:, on].any()
    assert np.abs(state.displacement[:, np.isclose(mesh.p[1], 1.0)]).max() > 1e-3


# Walls: where they push.

WALLS = {1: np.linspace(0, 0.125, 9, endpoint=False)[None],
         2: np.stack([np.linspace(0, 0.125, 9, endpoint=False), np.linspace(0.01, 0.99, 9)]),
         3: np.stack([np.linspace(0, 0.125, 5, endpoint=False), *np.random.default_rng(0).uniform(0, 0.5, (2, 5))])}


def support_of(method, dim, empty, cells=None):
    """Support of a body whose cells along x[0] < 0.125, where the walls are, hold points or not."""
    mesh, body = boxed(dim, cells or (8 if dim < 3 else 4))
    if empty:
        body = body.where(body.x[0] > 0.125)
    return Support(mesh, body, METHODS[method], "ghost", []), body


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize("dim", MOTION)
@every_method
def test_wall_rows_read_any_linear_field_at_the_true_wall(method, dim, empty):
    """With points in the wall's cell or without: never a node that nothing holds, which would say zero."""
    support, body = support_of(method, dim, empty)
    grid, random = support.grid, np.random.default_rng(1)
    nodes = np.stack([part.ravel() for part in np.meshgrid(*grid.axes, indexing="ij")])
    shift, slope = random.uniform(-1, 1, (dim, 1)), random.uniform(-1, 1, (dim, dim))
    unknowns = (shift + slope @ nodes)[:, support.solved_nodes].T.ravel()
    wall = Wall(WALLS[dim], [0.25] * dim)
    rows, _, values, components = wall.rows(support, share=0.5)
    assert len(rows) == wall.x.size
    assert_array_equal(values, 0.125)
    expected = (shift + slope @ wall.x).T.ravel()          # point by point, component inner
    assert components == list(range(dim)) * wall.x.shape[1]
    assert_allclose([(row @ unknowns).item() for row in rows], expected, atol=1e-12)


def test_the_scene_for_the_rows_is_what_it_says():
    for empty in (False, True):
        support, _ = support_of("mpm", 1, empty)
        cell = support.grid.locate(np.array([[0.06]]))
        assert support.occupied[tuple(cell)].item() == (not empty)
        assert support.holds(cell).item() == (not empty)


@pytest.mark.parametrize("dim", MOTION)
def test_a_component_without_increment_is_free(dim):
    support, _ = support_of("mpm", dim, empty=False)
    wall = Wall(WALLS[dim], [None] * (dim - 1) + [0.1])
    rows, _, values, components = wall.rows(support, share=1.0)
    assert len(rows) == wall.x.shape[1] and set(components) == {dim - 1}
    assert_allclose(wall.advanced(0.5).x[:-1], wall.x[:-1])
    assert_allclose(wall.advanced(0.5).x[-1], wall.x[-1] + 0.05)


@pytest.mark.parametrize("offset", np.linspace(0, 0.96, 9).round(3))
@pytest.mark.parametrize("strain", ["small", "logarithmic"])
@every_method
def test_the_wall_goes_exactly_as_far_as_it_is_told(method, offset, strain):
    """Displacement of the grid, interpolated to where the wall is: in its own cell, or, where that is empty and finite
    elements know nothing of it, on from the next."""
    scene = cylinder(dim=1, offset=offset)
    r, wall, state = scene.mesh.p[0], scene.boundary[0].x[0, 0], next(scene.run(method, steps=1, strain=strain))
    order = np.argsort(r)
    r, u = r[order], state.displacement[0, order]
    cell = np.searchsorted(r, wall, side="right") - 1
    empty = not ((scene.particles.x[0] > r[cell]) & (scene.particles.x[0] < r[cell + 1])).any()
    assert empty == (offset > 0.75)
    cell += empty and not METHODS[method].mass.reads_domains
    t = (wall - r[cell]) / (r[cell + 1] - r[cell])
    assert (1 - t) * u[cell] + t * u[cell + 1] == pytest.approx(scene.increment, rel=1e-12)
    assert state.boundary[0].x[0, 0] == pytest.approx(wall + scene.increment, rel=1e-15)


@pytest.mark.parametrize("x, increment", [(-0.3, 0.1), (1.3, 0.1)])
@every_method
def test_a_wall_off_the_grid_is_named(method, x, increment):
    mesh, body = boxed(1)
    wall = Wall(np.array([[x]]), (increment,), name="piston")
    with pytest.raises(OutsideGridError, match=r"wall 'piston'.*outside the grid \[-0\.25, 1\.25\].*larger mesh"):
        next(implicit_steps(mesh, body, LAW, [wall], steps=1, method=method))


def test_a_wall_on_the_grid_but_far_from_the_body_is_not_said_to_be_off_the_grid():
    """A larger mesh, which is what a wall off the grid needs, would not help."""
    mesh = MeshLine(np.arange(-40, 41) * 0.125)
    body = Particles.fill(mesh, uniaxial, where=lambda x: (x[0] > 0) & (x[0] < 1))
    boundary = [FixedPlane(0, 0.0, -1), Wall(np.array([[3.0]]), (0.1,), name="piston")]
    with pytest.raises(ValueError, match="wall 'piston'.*body"):
        next(implicit_steps(mesh, body, LAW, boundary, steps=1))


@pytest.mark.parametrize("method", ["mpm", "gimp", "cmpm"])
def test_a_wall_that_leaves_the_grid_on_its_way_stops_the_run(method):
    """It stretches a bar that ends a cell before it, 0.02 per step from 0.03 before the end of the grid."""
    _, body = boxed(1)
    mesh, body = MeshLine(np.arange(-2, 9) * 0.125), body.where(body.x[0] < 0.875)
    boundary = [FixedPlane(0, 0.0, -1, name="base"), Wall(np.array([[0.97]]), (0.02,), name="piston")]
    run = implicit_steps(mesh, body, LAW, boundary, steps=5, method=method)
    assert [next(run).step, next(run).step] == [1, 2]
    with pytest.raises(OutsideGridError, match=r"wall 'piston': .*\(1\.01\), outside the grid"):
        next(run)


@pytest.mark.parametrize("x, match", [(np.zeros((2, 3)), r"^wall: got shape \(2, 3\), expected \(1, n\)"),
                                      (np.zeros(3), r"^wall: got shape \(3,\), expected \(1, n\)"),
                                      (np.array([[np.nan]]), r"^wall: got nan.*finite")])
def test_wall_points_of_a_wrong_shape_are_refused(x, match):
    with pytest.raises(ValueError, match=match):
        Wall(x, increment=(0.1,))


def test_integer_wall_points_are_refused():
    with pytest.raises(TypeError, match="^wall: got an array of int64, expected floats"):
        Wall(np.array([[1]]), increment=(0.1,))


def test_nobody_moves_a_wall_behind_its_back():
    x = np.array([[1.0]])
    wall = Wall(x, increment=(0.1,))
    x += 1
    assert wall.x[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        wall.x[0, 0] = 2.0
    with pytest.raises(ValueError, match="read-only"):
        wall.advanced(1.0).x[0, 0] = 2.0


# Reactions.

def balance(state, weight):
    """What is left of all forces on a body, relative to the largest of them."""
    forces = [*state.reactions.values(), np.asarray(weight, dtype=float)]
    return np.abs(np.sum(forces, axis=0)).max() / np.abs(forces).max()


@pytest.mark.parametrize("material", [LAW, Hencky(E=100.0, nu=0.3)], ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("steps", [1, 4])
@every_method
def test_a_bar_between_a_plane_and_a_wall_is_in_balance(method, steps, material):
    mesh, body = boxed(1)
    boundary = [FixedPlane(0, 0.0, -1, name="base"), Wall(np.array([[0.97]]), (-0.007,), name="piston")]
    *_, state = implicit_steps(mesh, body, material, boundary, steps=steps, method=method, gravity=(-0.5,),
                               tolerance=1e-13)
    assert balance(state, [-0.5]) < 1e-11                         # the mass is 1
    assert state.reactions["base"][0] > 0 > state.reactions["piston"][0]


@pytest.mark.parametrize("gravity", [(0.0, -2.0), (1.0, -2.0)])
@every_method
def test_a_block_on_rollers_with_a_wall_is_in_balance(method, gravity):
    mesh, body = boxed(2)
    wall = Wall(np.stack([np.full(4, 0.93), np.array([0.1, 0.3, 0.6, 0.8])]), (0.004, None), name="wall")
    boundary = [FixedPlane(0, 0.0, -1, name="left"), FixedPlane(1, 0.0, -1, name="base"), wall]
    *_, state = implicit_steps(mesh, body, LAW, boundary, steps=3, method=method, gravity=gravity, tolerance=1e-12)
    assert balance(state, gravity) < 1e-10
    assert set(state.reactions) == {"left", "base", "wall"}
    assert state.reactions["base"][0] == 0 == state.reactions["wall"][1]         # rollers


@pytest.mark.parametrize("method", ["mpm", "gc"])
def test_two_planes_that_share_an_edge_do_not_count_its_force_twice(method):
    mesh, body = boxed(2)
    boundary = [FixedPlane(0, 0.0, -1, components=(0, 1), name="left"),
                FixedPlane(1, 0.0, -1, components=(0, 1), name="base")]
    state = next(implicit_steps(mesh, body, LAW, boundary, steps=1, method=method, gravity=(1.0, -2.0),
                                tolerance=1e-12))
    assert balance(state, (1.0, -2.0)) < 1e-10


def test_the_weight_of_a_box_is_carried_by_its_base():
    mesh, body = boxed(3, cells=3)
    boundary = [FixedPlane(2, 0.0, -1, components=(0, 1, 2), name="base")]
    state = next(implicit_steps(mesh, body, LAW, boundary, steps=1, gravity=(0.1, 0.2, -2.0), tolerance=1e-12))
    assert_allclose(state.reactions["base"], -body.mass.sum() * np.array([0.1, 0.2, -2.0]), rtol=1e-10)


@pytest.mark.parametrize("scheme, strain", [("equilibrated", "small"), ("incremental", "small"),
                                            ("equilibrated", "logarithmic")])
@pytest.mark.parametrize("steps", [1, 3])
def test_reactions_are_those_of_the_whole_load_not_of_the_last_step(scheme, strain, steps):
    """A state says what pushes now, whichever scheme made it."""
    mesh, body = boxed(1)
    *_, state = implicit_steps(mesh, body, LAW, [FixedPlane(0, 0.0, -1, name="base")], steps=steps, scheme=scheme,
                               strain=strain, gravity=lambda step: (-1e-6 * step / steps,), tolerance=1e-12)
    assert state.reactions["base"][0] == pytest.approx(1e-6, rel=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_every_wall_and_plane_answers_under_its_own_name(method):
    mesh, body = boxed(1)
    walls = [Wall(np.array([[x]]), (push,), name=name)
             for x, push, name in [(0.06, 0.001, "low"), (0.94, -0.001, "high")]]
    state = next(implicit_steps(mesh, body, LAW, walls, steps=1, method=method))
    assert list(state.reactions) == ["low", "high"]
    assert state.reactions["low"][0] == pytest.approx(-state.reactions["high"][0], rel=1e-9)
    assert state.reactions["low"][0] > 0


# What fits the body.

@pytest.mark.parametrize("at, side", [(0.0, 1), (0.5, -1), (1.0, -1)])
def test_a_plane_with_points_behind_it_is_refused(at, side):
    mesh, body = boxed(1)
    with pytest.raises(ValueError, match=rf"plane 'base': got point \d+ .* behind the plane at .*side={side}"):
        next(implicit_steps(mesh, body, LAW, [FixedPlane(0, at, side, name="base")], steps=1))


# How wide cells are where the body is not says nothing about it.


def on_a_plane(behind, side=-1):
    """A mesh with cells of a width of their own behind a plane at y = 0, and points of which some domains touch it."""
    lines = np.concatenate([[-2 * behind, -behind], np.arange(6.0)])
    rng = np.random.default_rng(1)
    x = np.stack([rng.uniform(0, 5, 40), rng.uniform(0.05, 3, 40)])
    velocity = 1e-3 * rng.normal(size=x.shape)
    turn = np.array([[1.0], [-side]])
    quarter = np.full(40, 0.25)
    body = Particles(turn * x, quarter, quarter, plane_strain, length=np.full((2, 40), 0.5), velocity=turn * velocity)
    return MeshQuad.init_tensor(np.arange(-3.0, 9), lines if side < 0 else -lines[::-1]), body


def moved(planes, method, behind=1.0, side=-1, engine="numpy", **choices):
    """Stress on that plane after ten explicit steps."""
    mesh, body = on_a_plane(behind, side)
    *_, state = explicit_steps(mesh, body, LinearElastic(E=1.0, nu=0.3), planes, steps=10, every=10, dt=0.05,
                               method=method, engine=engine, **choices)
    return state.particles.sigma


@pytest.mark.filterwarnings("ignore:the strain of this method")
@pytest.mark.parametrize("components", [(), (0, 1)], ids=["smooth", "rough"])
@pytest.mark.parametrize("integration", ["points", "twin"])
@pytest.mark.parametrize("method", ["mpm", "gimp", "gc"])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_width_of_cells_behind_a_plane_does_not_matter_to_explicit_runs(side, method, integration, components):
    planes = [FixedPlane(1, 0.0, side, components)]
    one, *others = (moved(planes, method, behind, side, integration=integration) for behind in (1.0, 0.6, 3.0))
    for other in others:
        assert_allclose(other, one, rtol=0, atol=1e-12 * abs(one).max())


def test_nor_does_it_to_compiled_runs():
    pytest.importorskip("numba")
    planes = [FixedPlane(1, 0.0, -1)]
    one, other = (moved(planes, "gimp", behind, engine="numba") for behind in (1.0, 0.6))
    assert_allclose(other, one, rtol=0, atol=1e-12 * abs(one).max())


@pytest.mark.parametrize("method", ["mpm", "gimp", "gc", "fe-gimp"])
@pytest.mark.parametrize("beside", [0.3, 3.0])
def test_the_width_of_empty_cells_does_not_matter_to_implicit_runs(method, beside):
    """Domains of a bar reach 0.05 behind a plane, and as far into the empty cell beyond the wall."""
    x = -0.05 + 4.1 / 8 * (np.arange(8) + 0.5)[None]
    size = np.full(8, 4.1 / 8)
    bar = Particles(x, size, size, uniaxial, length=size[None])
    held = [FixedPlane(0, 0.0, -1), Wall(np.array([[4.0]]), (0.004,))]

    def stress(width):
        mesh = MeshLine(np.concatenate([[-2 * width, -width], np.arange(5.0), [4 + width, 4 + 2 * width]]))
        return next(implicit_steps(mesh, bar, LAW, held, steps=1, method=method, strain="small",
                                   floor=0.0)).particles.sigma

    one = stress(1.0)
    assert_allclose(stress(beside), one, rtol=0, atol=1e-10 * abs(one).max())


@pytest.mark.filterwarnings("ignore:the strain of this method")
@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("method", ["mpm", "gimp", "gc"])
def test_planes_at_one_place_are_one_plane(method, engine):
    """One for each component, say, each with a name of its own."""
    if engine == "numba":
        pytest.importorskip("numba")
    along, across = FixedPlane(1, 0.0, -1, (0,)), FixedPlane(1, 0.0, -1, (1,))
    whole = moved([FixedPlane(1, 0.0, -1, (0, 1))], method, engine=engine)
    for planes in ([along, across], [across, along]):
        assert_array_equal(moved(planes, method, engine=engine), whole)


def test_a_plane_of_another_dimension_or_off_the_lines_is_refused():
    mesh, body = boxed(1)
    for plane in (FixedPlane(1, 0.0, -1, name="base"), FixedPlane(0, 0.0, -1, (0, 1), name="base")):
        with pytest.raises(ValueError, match="plane 'base': got axis . and components .* expected numbers from 0 to 0"):
            next(implicit_steps(mesh, body, LAW, [plane], steps=1))
    with pytest.raises(ValueError, match="nan.*no grid line"):
        next(implicit_steps(mesh, body, LAW, [FixedPlane(0, np.nan, -1)], steps=1))


def test_a_wall_that_does_not_touch_the_body_is_refused():
    mesh = MeshLine(np.arange(-2, 13) * 0.125)
    body = Particles.fill(mesh, uniaxial, where=lambda x: (x[0] > 0) & (x[0] < 1))
    held = FixedPlane(0, 0.0, -1)
    next(implicit_steps(mesh, body, LAW, [held, Wall(np.array([[1.1]]), (-0.01,))], steps=1))
    with pytest.raises(ValueError, match="wall 'wall': got point 0 at .*more than a cell away from the body"):
        next(implicit_steps(mesh, body, LAW, [held, Wall(np.array([[1.3]]), (-0.01,))], steps=1))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [3, 8, 40])
def test_a_wall_may_have_more_points_than_the_grid_has_nodes_to_obey_them(method, count):
    """Rows that others imply are left out: the wall moves as told at every point, however many there are."""
    axis = np.arange(-1, 6) * 0.25
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    points = np.stack([np.linspace(0.02, 0.98, count), np.full(count, 0.97)])
    boundary = [FixedPlane(1, 0.0, -1, (0, 1), name="base"), Wall(points, (0.0, -0.01), name="top")]
    state = next(implicit_steps(mesh, body, LAW, boundary, steps=1, method=method, strain="small"))
    assert state.reactions["top"][1] < 0
    assert_allclose(state.reactions["top"], -state.reactions["base"], atol=1e-6 * abs(state.reactions["top"][1]))


def test_walls_and_planes_that_contradict_each_other_are_refused():
    axis = np.arange(-1, 6) * 0.25
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    base = FixedPlane(1, 0.0, -1, (0, 1), name="base")
    for wall in (Wall(np.array([[0.0], [0.0]]), (0.01, 0.0)), Wall(np.array([[0.4, 0.4], [1.0, 1.0]]), (0.01, None))):
        others = [Wall(np.array([[0.4], [1.0]]), (0.02, None))] if wall.x.shape[1] == 2 else []
        with pytest.raises(ValueError, match="wall: got a displacement of .* where other walls and planes allow only"):
            next(implicit_steps(mesh, body, LAW, [base, wall, *others], steps=1))


def test_a_wall_that_is_told_nothing_finite_is_refused():
    with pytest.raises(ValueError, match=r"increment: got \(nan,\) for wall 'wall'"):
        Wall(np.array([[1.0]]), (np.nan,))


def test_a_body_thinner_than_a_cell_is_refused():
    """Points on one grid line: nothing says how the nodes around move."""
    body = Particles(np.array([[0.5]]), np.array([0.1]), np.array([1.0]), uniaxial)
    with pytest.raises(ValueError, match="particles: got points that read the node at .*body that spans a cell"):
        next(implicit_steps(MeshLine(np.linspace(0, 1, 9)), body, LAW, [Wall(np.array([[0.47]]), (0.01,))], steps=1))


# Walls that bend, and means over segments.

def quarter(count):
    angle = np.linspace(0, np.pi / 2, count)
    return 0.6 * np.stack([np.cos(angle), np.sin(angle)])


def outwards(x):
    return 0.01 * x / np.hypot(*x)


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_segment_takes_the_mean_of_the_rows_and_values_of_its_points(dim, empty):
    support, _ = support_of("mpm", dim, empty)
    random = np.random.default_rng(3)
    n = WALLS[dim].shape[1]
    increment, labels = list(random.uniform(-1, 1, (dim, n))), random.permutation(np.arange(n) % 3) - 1
    single, means = Wall(WALLS[dim], increment), Wall(WALLS[dim], increment, segments=labels)
    rows, _, values, _ = single.rows(support, share=0.5)
    mean_rows, _, mean_values, components = means.rows(support, share=0.5)
    assert components == list(range(dim)) * 3
    assert_allclose(values, 0.5 * np.array(increment).T.ravel())
    dense = np.stack([row.toarray()[0] for row in rows]).reshape(n, dim, -1)
    found = np.stack([row.toarray()[0] for row in mean_rows]).reshape(3, dim, -1)
    for segment in range(3):
        inside = labels == segment - 1
        assert_allclose(found[segment], dense[inside].mean(axis=0), atol=1e-14)
        assert_allclose(np.reshape(mean_values, (3, dim))[segment],
                        np.reshape(values, (n, dim))[inside].mean(axis=0))


def test_one_number_is_the_same_as_that_number_for_every_point():
    support, _ = support_of("mpm", 2, empty=False)
    n = WALLS[2].shape[1]
    for segments in (None, np.arange(n) // 2):
        given = [Wall(WALLS[2], (step, None), segments=segments) for step in (0.3, np.full(n, 0.3))]
        (rows, _, values, components), (others, _, same, names) = (wall.rows(support, share=1.0) for wall in given)
        assert_allclose(values, same, rtol=1e-15)
        assert components == names
        assert_allclose(*(np.stack([row.toarray()[0] for row in each]) for each in (rows, others)))
        assert_allclose(given[0].advanced(0.5).x, given[1].advanced(0.5).x)


def test_a_wall_keeps_segments_and_increments_on_its_way():
    wall = Wall.along(quarter(100), outwards, size=0.1, name="inner")
    half = wall.advanced(0.25).advanced(0.25)
    assert_allclose(np.hypot(*half.x), np.hypot(*wall.x) + 0.005, rtol=1e-12)
    assert_array_equal(half.segments, wall.segments)
    assert_array_equal(half.increment, wall.increment)
    assert half.name == "inner"


@pytest.mark.parametrize("size, samples", [(0.1, 8), (0.3, 1), (10.0, 5)])
def test_a_wall_along_a_curve_has_equal_segments(size, samples):
    curve = np.array([[0.0, 0.5, 0.5], [0.0, 0.0, 1.0]])
    wall = Wall.along(curve, (None, 0.1), size=size, samples=samples)
    count = max(round(1.5 / size), 1)
    assert_array_equal(np.bincount(wall.segments), [samples] * count)
    way = wall.x.sum(axis=0)                        # along this curve
    assert_allclose(way, 1.5 * (np.arange(count * samples) + 0.5) / (count * samples))
    assert wall.increment == (None, 0.1)


@pytest.mark.parametrize("changes, error, match", [
    (dict(increment=(np.zeros(3), 0.0)), ValueError, r"^increment of wall 'wall': got shape \(3,\), expected \(4,\)"),
    (dict(increment=(np.array([0.0, np.nan, 0, 0]), None)), ValueError, "^increment of wall 'wall': got nan"),
    (dict(increment=(np.arange(4), None)), TypeError, "^increment of wall 'wall': got an array of int64"),
    (dict(segments=np.arange(3)), ValueError, r"^segments: got shape \(3,\) for wall 'wall', expected \(4,\)"),
    (dict(segments=np.zeros(4)), TypeError, "^segments: got an array of float64 for wall 'wall', expected integers"),
])
def test_segments_and_increments_that_do_not_fit_are_refused(changes, error, match):
    with pytest.raises(error, match=match):
        Wall(**{"x": np.zeros((2, 4)), "increment": (0.0, 0.0), **changes})


@pytest.mark.parametrize("curve, size, match", [
    (np.zeros((2, 3)), 0.1, r"curve \(its length\)"), (np.zeros((3, 2)), 0.1, "^curve: got shape"),
    (np.eye(2), 0.0, "^size")])
def test_curves_without_length_are_refused(curve, size, match):
    with pytest.raises(ValueError, match=match):
        Wall.along(curve, (0.0, 0.0), size=size)


def test_nobody_moves_a_bending_wall_behind_its_back():
    step, labels = np.zeros(4), np.arange(4)
    wall = Wall(np.zeros((2, 4)), (step, None), segments=labels)
    step += 1
    labels += 1
    assert not wall.increment[0].any() and wall.segments[0] == 0
    for array in (wall.increment[0], wall.segments, wall.advanced(1.0).increment[0]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("size, samples", [(0.125, 8), (0.03, 3), (0.01, 1)])
def test_a_bending_wall_does_not_contradict_itself(size, samples):
    """However many rows it has, up to ten times what the grid can obey: a hole in a plate that is pushed open."""
    mesh, body = boxed(2)
    body = body.where(np.hypot(*body.x) > 0.6)
    wall = Wall.along(quarter(500), outwards, size=size, samples=samples, name="hole")
    boundary = [wall, FixedPlane(0, 0.0, -1, name="left"), FixedPlane(1, 0.0, -1, name="base")]
    state = next(implicit_steps(mesh, body, LAW, boundary, steps=1, method="gimp"))
    push = state.reactions["hole"]
    assert push[0] > 0 and push[0] == pytest.approx(push[1], rel=0.02)          # the diagonal mirrors the scene
    assert_allclose(push + state.reactions["left"] + state.reactions["base"], 0, atol=1e-8 * push[0])


def test_best_values_are_those_of_least_squares():
    """Three rows on two unknowns, the third being the sum of the others."""
    rows, values = csr_array(np.array([[1.0, 0], [0, 1], [1, 1]])), np.array([1.0, 1.0, 2.06])
    kept, fitted = independent_rows(rows, values, ["wall"] * 3)
    best = np.linalg.lstsq(rows.toarray(), values, rcond=None)[0]
    assert_allclose(rows[kept] @ best, fitted, rtol=1e-12)
    with pytest.raises(ValueError, match="wall: got a displacement of .* where other walls and planes allow only"):
        independent_rows(rows, values, ["left", "left", "right"])       # two walls that move as one each
    with pytest.raises(ValueError, match="wall: got a displacement of"):
        independent_rows(rows, np.array([1.0, 1.0, 3.0]), ["wall"] * 3)
