"""Domains that follow the deformation, and the radius inside the means over rings."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import MAKE, both_engines
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    OutsideGridError,
    Particles,
    axisymmetric,
    explicit_steps,
    implicit_steps,
    plane_strain,
    shapes,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.explicit.operators import Operators
from skfem_mpm.grid import Grid
from skfem_mpm.integration import Points, on_points
from skfem_mpm.kinematics import carried, stretched
from skfem_mpm.kinematics.blocks import volume_ratio
from skfem_mpm.scenes import cylinder

LAW = LinearElastic(E=1e3, nu=0.3)
BOTH = {"domains": "stretched", "radius": "domain"}
rng = np.random.default_rng(0)


def rows(F, hoop=None):
    """Gradient rows of one point from its deformation gradient over a step."""
    flat = (F - np.eye(len(F))).ravel()
    return np.append(flat, [] if hoop is None else hoop)[:, None]


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


# What a step does to a box.

def test_edges_follow_stretch_along_the_axes():
    length = np.array([[0.1], [0.2], [0.3]])
    assert_allclose(stretched(length, rows(np.diag([2.0, 0.5, 1.5])))[:, 0], [0.2, 0.1, 0.45], rtol=1e-14)
    assert_allclose(stretched(length[:1], rows(np.diag([0.7]), hoop=0.3))[:, 0], [0.07], rtol=1e-14)


@pytest.mark.parametrize("angle", [1e-3, 0.3, 1.5, np.pi / 2, 2.5, np.pi])
def test_rotation_leaves_boxes_as_they_are(angle):
    length = np.array([[0.1], [0.3]])
    assert_allclose(stretched(length, rows(turn(angle))), length, rtol=1e-13)


def test_simple_shear_leaves_boxes_as_they_are():
    length = np.array([[0.1], [0.3]])
    assert_allclose(stretched(length, rows(np.array([[1.0, 5.0], [0.0, 1.0]]))), length, rtol=1e-13)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_product_of_the_edges_follows_the_volume_without_the_hoop(dim):
    gradient, length = 0.4 * rng.uniform(-1, 1, (dim * dim, 500)), rng.uniform(0.1, 1, (dim, 500))
    ratio = volume_ratio(gradient, dim)
    sound = ratio > 1e-3
    with_hoop = np.concatenate([gradient, rng.uniform(0, 1, (1, 500))])
    for each in (gradient, with_hoop)[:2 if dim < 3 else 1]:
        after = stretched(length[:, sound], each[:, sound])
        assert (after > 0).all()
        assert_allclose(after.prod(axis=0), (length.prod(axis=0) * ratio)[sound], rtol=1e-12)


def test_parallelograms_follow_turns_and_shear():
    spans = np.array([[[0.2], [0.0]], [[0.0], [0.1]]])
    F = turn(0.4) @ np.array([[1.1, 0.3], [0.0, 0.8]])
    assert_allclose(carried(spans, rows(F))[:, :, 0], F @ spans[:, :, 0], rtol=1e-14)


# Means over rings.

def ring_case(n=200):
    """Points with domains that stay within the neighbours of their cells, on graded cells."""
    knots = 0.5 + np.cumsum(rng.uniform(0.3, 1.0, (4, n)), axis=0)
    x = knots[1] + rng.uniform(0, 1, n) * (knots[2] - knots[1])
    half = rng.uniform(0.05, 1, n) * np.minimum(x - knots[0], knots[3] - x)
    return x, half, knots


@pytest.mark.parametrize("left, right", [(True, True), (False, True), (True, False), (False, False)])
def test_ring_means_are_the_integrals_they_stand_for(left, right):
    x, half, knots = ring_case()
    low = x - half if left else np.maximum(x - half, knots[1])
    high = x + half if right else np.minimum(x + half, knots[2])
    value, slope, plain = shapes.ring_gimp(x, half, knots, left, right)
    cuts = np.sort(np.clip(np.concatenate([[low], knots[1:3], [high]]), low, high), axis=0)
    point, weight = np.polynomial.legendre.leggauss(2)
    found = np.zeros((3, 4, len(x)))
    for a, b in zip(cuts[:-1], cuts[1:]):
        for t, w in zip(point, weight):
            r, dr = (a + b) / 2 + t * (b - a) / 2, w * (b - a) / 2
            for j in range(4):
                unit = np.eye(4)[j]
                N = np.array([np.interp(r[i], knots[:, i], unit) for i in range(len(x))])
                d = np.array([(np.interp(r[i] + 1e-7, knots[:, i], unit) - np.interp(r[i] - 1e-7, knots[:, i], unit))
                              / 2e-7 for i in range(len(x))])
                found[:, j] += np.stack([N * r, d * r, N]) * dr
    ring, size = (high - low) * (high + low) / 2, high - low
    assert_allclose(value, found[0] / ring, atol=1e-13)
    assert_allclose(plain, found[2] / size, atol=1e-13)
    assert_allclose(slope, found[1] / ring, atol=1e-5)


def test_ring_means_see_a_uniform_stretch_as_it_is():
    x, half, knots = ring_case()
    value, slope, plain = shapes.ring_gimp(x, half, knots)
    assert_allclose(value.sum(axis=0), 1, rtol=1e-13)
    assert_allclose((slope * knots).sum(axis=0), 1, rtol=1e-12)
    assert_allclose((plain * knots).sum(axis=0), x, rtol=1e-13)                    # so the hoop strain is exact too
    assert_allclose((value * knots).sum(axis=0), x + half ** 2 / (3 * x), rtol=1e-13)     # the middle of its mass


def rings(dim):
    """A ring of boxes that tile it, but are not alike, and a grid around it."""
    faces = [np.cumsum(np.append(start, rng.uniform(0.03, 0.07, 21))) for start in (1.0, 0.0)][:dim]
    axes = [0.1 * np.arange(-2, 19) + face[0] for face in faces]
    make = MeshLine if dim == 1 else MeshQuad.init_tensor
    body = Particles.fill(make(*faces), axisymmetric, per_cell=1)
    return faces, axes, body, make(*axes)


@pytest.mark.parametrize("dim", [1, 2])
def test_uniform_pressure_puts_no_force_on_inner_nodes(dim):
    """With the radius at the point it does."""
    lines, axes, body, mesh = rings(dim)
    grid = Grid.from_mesh(mesh)
    stress = -np.array([[1.0], [1.0]] if dim == 1 else [[1.0], [0.0], [0.0], [1.0], [1.0]]) * np.ones(body.n)
    inner = np.all(np.meshgrid(*[(a[0] + 0.11 < b) & (b < a[-1] - 0.11) for a, b in zip(lines, axes)], indexing="ij"),
                   axis=0).ravel()
    size = {}
    for ring in (False, True):
        stencil = grid.gimp(body.x, grid.locate(body.x), body.length, ring=ring)
        pair = on_points(axisymmetric, stencil, stencil, body.volume, body.x[0])
        force = pair.force(stress)
        operators = Operators(axisymmetric, stencil, body.x[0])
        assert_allclose(operators.force(body.volume * stress), force, atol=1e-14)
        u = rng.uniform(-1, 1, (dim, grid.nnodes))
        assert_allclose(operators.gradient(u), pair.gradient(u), atol=1e-12)
        assert stencil.to_nodes(body.mass).sum() == pytest.approx(body.mass.sum(), rel=1e-13)
        size[ring] = np.abs(force[:, inner]).max() / np.abs(force).max()
    assert size[True] < 1e-14 and size[False] > 1e-5


# Patch tests: uniform strain of rings of tiling boxes, over several steps and wherever the grid is.

def radial(dim, offset, a=0.02):
    """A ring that is stretched alike in radius and hoop."""
    axis, walls = 0.1 * np.arange(-2, 10) + 1 + 0.1 * offset, []
    if dim == 1:
        mesh, body = MeshLine(axis), Particles.fill(MeshLine(np.linspace(1, 1.5, 6)), axisymmetric)
        place = {r: np.array([[r]]) for r in (1.0, 1.5)}
    else:
        height = np.linspace(0, 0.3, 4)
        mesh = MeshQuad.init_tensor(axis, 0.1 * np.arange(-1, 5))
        body = Particles.fill(MeshQuad.init_tensor(np.linspace(1, 1.5, 6), height), axisymmetric)
        place = {r: np.stack([np.full(9, r), np.linspace(0.02, 0.28, 9)]) for r in (1.0, 1.5)}
        walls = [FixedPlane(1, 0.0, -1), FixedPlane(1, 0.3, 1)]
    return mesh, body, walls + [Wall(x, (a * r, None)[:dim], name=f"at {r}") for r, x in place.items()]


def axial(dim, offset):
    """A ring between fixed cylinders that is shortened."""
    mesh, body, walls = radial(2, offset, a=0.0)
    top = Wall(np.stack([np.linspace(1.02, 1.48, 9), np.full(9, 0.3)]), (None, -0.006), name="top")
    return mesh, body, [walls[0], *walls[2:], top]


def run_patch(scene, method, steps=5, **choices):
    mesh, body, boundary = scene
    return list(implicit_steps(mesh, body, LAW, boundary, steps=steps, method=method, floor=0.0, **choices))


def spread(state):
    """Largest difference between points in any component of stress, relative to the largest stress."""
    return np.ptp(state.particles.sigma, axis=1).max() / np.abs(state.particles.sigma).max()


@pytest.mark.parametrize("offset", [0.0, 0.37])
@pytest.mark.parametrize("method", ["gimp", "gc"])
@pytest.mark.parametrize("make, dim", [(radial, 1), (radial, 2), (axial, 2)])
def test_rings_pass_the_patch_test_step_after_step(make, dim, method, offset):
    states = run_patch(make(dim, offset), method, **BOTH)
    assert max(map(spread, states)) < 1e-12
    order = np.lexsort(states[-1].particles.x[::-1].round(9))
    x, length = (getattr(states[-1].particles, name)[:, order] for name in ("x", "length"))
    along = -1 if dim == 2 else 0                              # neighbours along the last axis still touch
    gap = (x[along, 1:] - length[along, 1:] / 2) - (x[along, :-1] + length[along, :-1] / 2)
    same = np.abs(x[0, 1:] - x[0, :-1]) < 1e-9 if dim == 2 else np.ones(len(gap), dtype=bool)
    assert np.abs(gap[same]).max() < 1e-13


@pytest.mark.parametrize("choices", [{}, {"domains": "stretched"}, {"radius": "domain"}], ids=str)
@pytest.mark.parametrize("method", ["gimp", "gc"])
def test_rings_fail_the_patch_test_without_either_choice(method, choices):
    assert spread(run_patch(radial(1, 0.37), method, steps=2, **choices)[-1]) > 2e-3


@pytest.mark.parametrize("method", ["gimp", "gc"])
def test_a_cylinder_without_a_hole_passes_the_patch_test(method):
    body = Particles.fill(MeshLine(np.linspace(0, 1, 11)), axisymmetric)
    boundary = [FixedPlane(0, 0.0, -1), Wall(np.array([[1.0]]), (0.02,), name="out")]
    scene = MeshLine(0.1 * np.arange(-2, 14)), body, boundary
    assert max(map(spread, run_patch(scene, method, **BOTH))) < 1e-12


@pytest.mark.parametrize("dim, kinematics", [(1, uniaxial), (2, plane_strain), (3, solid)])
def test_a_second_stretch_of_a_block_is_uniform_too(dim, kinematics):
    """With boxes of fixed size it is not."""
    make = MAKE[dim]
    mesh = make(*[0.25 * np.arange(-1, 7)] + [0.25 * np.arange(3)] * (dim - 1))
    body = Particles.fill(make(*[0.25 * np.arange(5)] + [0.25 * np.arange(3)] * (dim - 1)), kinematics)
    other = [FixedPlane(k, at, side) for k in range(1, dim) for at, side in ((0.0, -1), (0.5, 1))]
    wall = np.meshgrid([1.0], *[[0.0, 0.25, 0.5]] * (dim - 1), indexing="ij")
    pull = Wall(np.stack([axis.ravel() for axis in wall]), (0.03, None, None)[:dim], name="end")
    scene = mesh, body, [FixedPlane(0, 0.0, -1), *other, pull]
    edges = {} if dim == 1 else {"edges": "clip"}
    assert spread(run_patch(scene, "gimp", steps=3, domains="stretched", **edges)[-1]) < 1e-12
    assert spread(run_patch(scene, "gimp", steps=3, **edges)[-1]) > 1e-3


# What it is worth.

@pytest.mark.parametrize("offset", [0.0, 0.37])
@pytest.mark.parametrize("method", ["gimp", "gc"])
def test_the_cylinder_converges_once_boxes_stretch(method, offset):
    """Better than with order one; boxes of fixed size are no better on the finer grid."""
    found = {}
    for domains in ("fixed", "stretched"):
        scenes = [cylinder(cells, dim=1, offset=offset, increment=0.03) for cells in (10, 30)]
        found[domains] = [scene.error(list(scene.run(method, steps=15, domains=domains))[-1]) for scene in scenes]
    assert found["stretched"][1] < found["stretched"][0] / 3.5
    assert found["stretched"][1] < found["fixed"][1] / 8


def test_a_heavy_column_converges_once_boxes_stretch():
    errors = {}
    for domains in ("fixed", "stretched"):
        errors[domains] = []
        for cells in (40, 160):
            lines = 50.0 / cells * np.arange(-1, cells + 2)
            column = Particles.fill(MeshLine(lines[1:-1]), uniaxial, density=80.0)
            *_, state = implicit_steps(MeshLine(lines), column, Hencky(E=1e6, nu=0.0), [FixedPlane(0, 0.0, -1)],
                                       steps=10, method="gimp", domains=domains,
                                       gravity=lambda step: (-step,))
            exact = -80.0 * 10.0 * (50.0 - column.x[0])
            errors[domains].append(np.sqrt(((state.particles.sigma[0] - exact) ** 2).mean()) / np.abs(exact).max())
    assert errors["stretched"][1] < errors["stretched"][0] / 6 and errors["stretched"][1] < errors["fixed"][1] / 5


# Boxes that outgrow the neighbours of their cell.

def test_domains_are_cut_to_what_lies_within_the_neighbours():
    lines = np.array([0.0, 0.1, 0.3, 0.35, 0.6, 1.0, 1.1])
    grid = Grid.from_mesh(MeshLine(lines))
    x = rng.uniform(0.1, 1.0, (1, 300))
    index, length = grid.locate(x), rng.uniform(0.01, 1.0, (1, 300))
    cut = grid.fitting(x, index, length)
    grid.check_reach(x, index, cut, "ghost")
    low, high = lines[index - 1], lines[index + 2]
    assert_array_equal(cut[length <= 2 * np.minimum(x - low, high - x)],
                       length[length <= 2 * np.minimum(x - low, high - x)])
    touches = (cut < length) & (np.minimum(x - cut / 2 - low, high - x - cut / 2) < 1e-12)
    assert_array_equal(touches, cut < length)
    face = np.array([[0.3 - 1e-9, 0.3 + 1e-9]])
    before, after = grid.fitting(face, grid.locate(face), np.ones((1, 2)))[0]
    assert before == pytest.approx(after, abs=1e-7) or abs(lines[4] - 0.3) != abs(lines[1] - 0.3)


def bar(scale, cells=8, spare=4):
    lines = np.arange(-spare, cells + spare + 1) / cells
    body = Particles.fill(MeshLine(lines[spare:-spare]), uniaxial)
    return MeshLine(lines), replace(body, length=scale * body.length)


def test_boxes_that_outgrow_their_neighbours_are_seen_cut_off_and_still_follow_the_body():
    mesh, body = bar(7.0)
    boundary = [FixedPlane(0, 0.0, -1), Wall(np.array([[1.0]]), (0.05,), name="end")]
    with pytest.raises(ValueError, match="length: the domain of point .* beyond the neighbours"):
        next(implicit_steps(mesh, body, LAW, boundary, steps=1, method="gimp"))
    *_, state = implicit_steps(mesh, body, LAW, boundary, steps=4, method="gimp", domains="stretched")
    after = state.particles
    assert_allclose(after.length[0] / body.length[0], after.volume / body.volume, rtol=1e-12)
    assert after.length.max() > 3 / 8
    run = {"steps": 5, "dt": 1e-4, "method": "gimp", "every": 5}
    with pytest.raises(ValueError, match="length"):
        next(explicit_steps(mesh, body, LAW, [FixedPlane(0, 0.0, -1)], **run))
    state = next(explicit_steps(mesh, body, LAW, [FixedPlane(0, 0.0, -1)], gravity=(1.0,), domains="stretched", **run))
    after = state.particles
    assert_allclose(after.length[0] / body.length[0], after.volume / body.volume, rtol=1e-12)


def test_a_stretched_box_that_leaves_the_grid_is_refused():
    mesh, body = bar(1.0, spare=1)
    boundary = [FixedPlane(0, 0.0, -1), Wall(np.array([[1.0]]), (0.065,), name="end")]
    with pytest.raises(OutsideGridError, match="step 3: the domain of point 15"):
        list(implicit_steps(mesh, body, LAW, boundary, steps=4, method="gimp", domains="stretched"))


# What is carried along.

def test_fixed_boxes_and_those_that_nothing_reads_stay_or_go():
    mesh, body = bar(1.0)
    boundary = [FixedPlane(0, 0.0, -1), Wall(np.array([[1.0]]), (0.01,), name="end")]

    def lengths(**choices):
        return next(implicit_steps(mesh, body, LAW, boundary, steps=1, **choices)).particles.length

    assert lengths(method="gimp") is body.length
    assert lengths(method="mpm", domains="stretched") is None
    assert not np.array_equal(lengths(method="mpm", domains="stretched", weights="overlap"), body.length)
    explicit = next(explicit_steps(mesh, body, LAW, steps=1, method="gimp"))
    assert explicit.particles.length is body.length


class Covering(Points):
    """Points as quadrature, but asking for parallelograms."""

    covers = True


@pytest.mark.parametrize("given", [False, True])
def test_parallelograms_are_carried_if_there_are_any_and_made_if_the_integration_reads_them(given):
    lines = np.linspace(0, 1, 5)
    mesh = MeshQuad.init_tensor(0.25 * np.arange(-1, 7), 0.25 * np.arange(-1, 6))
    body = Particles.fill(MeshQuad.init_tensor(lines, lines), plane_strain)
    start = np.eye(2)[:, :, None] * body.length
    if given:
        start = start + 0.02 * np.array([[0.0, 1.0], [0.0, 0.0]])[:, :, None]
        body = replace(body, spans=start)
    top = Wall(np.stack([np.linspace(0.02, 0.98, 9), np.ones(9)]), (0.1, 0.05), name="top")
    boundary = [FixedPlane(1, 0.0, -1, (0, 1)), top]
    *_, state = implicit_steps(mesh, body, LAW, boundary, steps=2, integration=Covering())
    after = state.particles
    assert after.length is None
    area, before = (np.linalg.det(spans.transpose(2, 0, 1)) for spans in (after.spans, start))
    assert_allclose(area / before, after.volume / body.volume, rtol=1e-12)         # every part of the body as a whole
    assert np.abs(after.spans[0, 1] / after.spans[1, 1]).min() > 0.02               # they lean with the shear
    on_points = next(implicit_steps(mesh, body, LAW, boundary, steps=1)).particles
    assert (on_points.spans is not None) == given


@pytest.mark.parametrize("name", ["domains", "radius"])
def test_unknown_choices_are_refused(name):
    mesh, body = bar(1.0)
    for run in (lambda: next(implicit_steps(mesh, body, LAW, [FixedPlane(0, 0.0, -1)], steps=1, **{name: "round"})),
                lambda: next(explicit_steps(mesh, body, LAW, steps=1, **{name: "round"}))):
        with pytest.raises(ValueError, match=name):
            run()


@pytest.mark.parametrize("radius", ["point", "domain"])
def test_the_radius_makes_no_difference_in_plane_strain_nor_to_points(radius):
    """Nor to methods that average over nothing."""
    mesh, body, boundary = radial(1, 0.0)
    for method in METHODS:
        if not any(basis.reads_domains for basis in vars(METHODS[method]).values() if hasattr(basis, "reads_domains")):
            one, other = (next(implicit_steps(mesh, body, LAW, boundary, steps=1, method=method, radius=choice))
                          for choice in ("point", radius))
            assert_array_equal(one.particles.sigma, other.particles.sigma)


# The explicit engines.

def apart(dim, kinematics, scale=1.0):
    """A block that flies apart along the first axis, so that boxes grow past the neighbours of their cells."""
    start = 2.0 if kinematics is axisymmetric else 0.0
    axes = [0.25 * np.arange(-3, 30) + start, 0.25 * np.arange(-3, 8)][:dim]
    make, lines = MeshLine if dim == 1 else MeshQuad.init_tensor, np.linspace(0, 1, 5)
    body = Particles.fill(make(*[lines + start, lines][:dim]), kinematics)
    velocity = np.zeros_like(body.x)
    velocity[0] = 6 * (body.x[0] - start)
    return make(*axes), replace(body, velocity=velocity, length=scale * body.length)


def fly(scene, steps=40, every=None, start=None, **choices):
    mesh, body = scene
    choices = {"dt": 0.02, "method": "gimp", **BOTH, **choices}
    return list(explicit_steps(mesh, start or body, LinearElastic(E=1.0, nu=0.0), steps=steps, every=every or steps,
                               **choices))


@pytest.mark.parametrize("dim, kinematics, scale, choices", [
    (1, axisymmetric, 1.0, {"tpic": True}), (2, plane_strain, 1.0, {}), (2, axisymmetric, 1.0, {"integrator": "usl"}),
    (2, axisymmetric, 4.0, {"remedy": "bbar"})], ids=str)
def test_engines_agree_on_boxes_that_grow(dim, kinematics, scale, choices):
    pytest.importorskip("numba")
    scene = apart(dim, kinematics, scale)
    a, b = (fly(scene, engine=engine, **choices)[-1].particles for engine in ("numpy", "numba"))
    assert a.length[0].max() > (0.25 if dim == 2 else 0.13)
    for name in ("x", "velocity", "sigma", "volume", "length"):
        one, other = getattr(a, name), getattr(b, name)
        assert np.abs(one - other).max() <= 1e-12 * np.abs(one).max(), name


@both_engines
def test_runs_with_growing_boxes_go_on_as_if_never_stopped(engine):
    scene = apart(2, plane_strain)
    whole = fly(scene, every=5, engine=engine)
    longest = [state.particles.length.max() for state in whole]
    assert longest[0] < 0.25 < 0.5 < longest[-1]                # the stencil changes its width on the way
    for at in (0, 3):
        rest = fly(scene, steps=40 - whole[at].step, start=whole[at], engine=engine)[-1]
        for name in ("x", "velocity", "sigma", "volume", "length"):
            assert_array_equal(getattr(rest.particles, name), getattr(whole[-1].particles, name))
    if engine == "numba":
        threads = fly(scene, engine=engine, threads=2)[-1]
        assert_array_equal(threads.particles.length, whole[-1].particles.length)
        assert_array_equal(threads.particles.sigma, whole[-1].particles.sigma)


def test_a_ring_at_rest_under_its_own_uniform_pressure_stays_uniform_inside():
    """Waves come from the free faces; until they arrive nothing moves, if the radius is part of the means."""
    (faces,), _, body, mesh = rings(1)
    body = replace(body, sigma=np.full((4, body.n), -1.0) * [[1.0], [0.0], [1.0], [0.0]])
    fast = {}
    for radius in ("point", "domain"):
        state = next(explicit_steps(mesh, body, LAW, steps=1, method="gimp", radius=radius))
        speed = np.abs(state.particles.velocity[0])
        fast[radius] = speed[(body.x[0] > 1.3) & (body.x[0] < faces[-1] - 0.3)].max() / speed.max()
    assert fast["domain"] < 1e-14 and fast["point"] > 1e-5
