"""What domains cover: exact pieces, each in its cell, whatever the domains and the grid look like."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from shared import MAKE, MOTION, MOTIONS, every_motion
from skfem import MeshLine, MeshQuad

from skfem_mpm import OutsideGridError, Particles, plane_strain, solid, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.cover import Cover, parts, spans_of
from skfem_mpm.grid import Grid

AXES = [np.array([1, 1.3, 1.5, 1.9, 2.1, 2.6, 3.0, 3.3, 3.7]), np.array([-0.4, 0, 0.25, 0.6, 0.8, 1.1, 1.5, 1.8]),
        np.array([-0.5, -0.2, 0.1, 0.4, 0.8, 1.0, 1.3])]                     # graded


def grid_of(*axes):
    return Grid.from_mesh(MAKE[len(axes)](*axes))


def even(dim, cells=8, low=0.0):
    return grid_of(*[low + np.arange(cells + 1.0)] * dim)


def cover_of(grid, points, planes=()):
    return Cover(grid, grid.locate(points.x), points, planes)


def points_of(x, spans, kinematics, factor=1.0, **more):
    """Points whose volume is that of their domains, times a factor."""
    volume = np.linalg.det(spans.transpose(2, 0, 1)) * (x[0] if kinematics.hoop else 1.0) * factor
    return Particles(x, volume, volume, kinematics, spans=spans, **more)


def random_spans(random, dim, n, size):
    """Edges that shear and turn, of positive determinant."""
    turn = np.stack([np.linalg.qr(random.normal(size=(dim, dim)))[0] for _ in range(n)], axis=2)
    turn[:, 0] *= np.sign(np.linalg.det(turn.transpose(2, 0, 1)))
    shear = np.eye(dim)[:, :, None] + np.triu(random.uniform(-0.6, 0.6, (dim, dim)), 1)[:, :, None]
    stretch = size * random.uniform(0.5, 1, (1, dim, n))
    return np.einsum("ijn,jkn->ikn", turn, shear * stretch)


def scattered(kinematics, dim, n=7, seed=0, size=0.3, factor=1.7):
    """Few points anywhere well inside a graded grid, so that no cell is surrounded."""
    random, n = np.random.default_rng(seed), n if dim > 1 else 2
    low, high = (np.array([[axis[k]] for axis in AXES[:dim]]) for k in (0, -1))
    x = low + 0.45 + (high - low - 0.9) * random.uniform(size=(dim, n))
    return points_of(x, random_spans(random, dim, n, size), kinematics, factor)


def by_owner(cover, order):
    """Quadrature of pieces with the point that each belongs to; there must be no full cells."""
    assert not len(cover.full)
    unit, x, area = cover.quadrature(order)
    return unit, x, area, np.repeat(cover.owner, len(area) // len(cover.owner))


def powers(dim, order):
    return [a for a in itertools.product(range(order + 1), repeat=dim) if sum(a) <= order]


def monomial(x, power):
    return np.prod([row ** a for row, a in zip(x, power)], axis=0)


def over_domain(points, p, power):
    """Integral of a monomial over the domain of a point (times radius in rings), by Gauss points in its edges."""
    dim = points.dim
    xi, w = np.polynomial.legendre.leggauss(5)
    r = np.stack(np.meshgrid(*[xi / 2] * dim, indexing="ij")).reshape(dim, -1)
    weight = np.prod(np.meshgrid(*[w / 2] * dim, indexing="ij"), axis=0).ravel()
    edges = spans_of(points)[:, :, p]
    x = points.x[:, p, None] + edges @ r
    measure = x[0] if points.kinematics.hoop else 1.0
    return np.linalg.det(edges) * (weight * measure * monomial(x, power)).sum()


def in_cells(cover, slack=1e-8):
    """Whether all pieces are in the cells of their units."""
    index = np.unravel_index(cover.piece_key // cover.nparts, cover.grid.cells.shape)
    for k, axis in enumerate(cover.grid.axes):
        if not ((cover.pieces[k] >= axis[index[k]] - slack) & (cover.pieces[k] <= axis[index[k] + 1] + slack)).all():
            return False
    return True


def per_cell(cover, power=None):
    """Amount covered in each cell."""
    unit, x, area = cover.quadrature(2 + sum(power or ()))
    value = area if power is None else area * monomial(x, power)
    return np.bincount(cover.cells[unit], weights=value, minlength=cover.grid.cells.size).reshape(
        cover.grid.cells.shape)


# Polygons, for comparison: clipped edge by edge, integrated by triangles from the first corner.

def clipped(polygon, axis, at, sign):
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        da, db = sign * (a[axis] - at), sign * (b[axis] - at)
        if da <= 0:
            out.append(a)
        if da * db < 0:
            out.append(a + da / (da - db) * (b - a))
    return np.array(out).reshape(-1, 2)


def in_box(polygon, low, high):
    for axis in range(2):
        polygon = clipped(polygon, axis, high[axis], 1)
        if len(polygon):
            polygon = clipped(polygon, axis, low[axis], -1)
        if not len(polygon):
            break
    return polygon


def over_polygon(polygon, power):
    """By the divergence theorem: the integral of x^(a+1) y^b / (a+1) over y, along the edges."""
    xi, w = np.polynomial.legendre.leggauss(6)
    total = 0.0
    for p, q in zip(polygon, np.roll(polygon, -1, axis=0)):
        x = p[:, None] + (q - p)[:, None] * (1 + xi) / 2
        total += (q[1] - p[1]) * (w / 2 * x[0] ** (power[0] + 1) * x[1] ** power[1]).sum() / (power[0] + 1)
    return total


def parallelogram(x, edges):
    a, b = edges[:, 0] / 2, edges[:, 1] / 2
    return np.array([x - a - b, x + a - b, x + a + b, x - a + b])


# -- domains, cut at the grid lines ----------------------------------------------------------------------------------

@every_motion
@pytest.mark.parametrize("size", [0.05, 0.3, 0.45])
def test_pieces_have_the_volume_and_the_moments_of_their_domain(kinematics, dim, size):
    points = scattered(kinematics, dim, size=size)
    cover = cover_of(grid_of(*AXES[:dim]), points)
    _, x, area, owner = by_owner(cover, 4)
    measure = area * x[0] if kinematics.hoop else area
    assert_allclose(np.bincount(owner, measure, points.n), points.volume, rtol=1e-12)
    for power in powers(dim, 4 - kinematics.hoop):
        found = np.bincount(owner, measure * monomial(x, power), points.n)
        assert_allclose(found, [1.7 * over_domain(points, p, power) for p in range(points.n)], rtol=1e-10, atol=1e-11)


@every_motion
def test_pieces_are_in_the_cells_of_their_units(kinematics, dim):
    for seed, size in [(0, 0.05), (1, 0.3), (2, 0.45)]:
        cover = cover_of(grid_of(*AXES[:dim]), scattered(kinematics, dim, seed=seed, size=size))
        assert in_cells(cover)
        unit, x, _ = cover.quadrature(3)
        assert_array_equal(np.ravel_multi_index(tuple(cover.grid.locate(x)), cover.grid.cells.shape), cover.cells[unit])


@pytest.mark.parametrize("seed", range(3))
def test_clipped_parallelograms_are_integrated_as_polygons_are(seed):
    points = scattered(plane_strain, 2, n=4, seed=seed, size=0.45, factor=1.0)
    cover = cover_of(grid_of(*AXES[:2]), points)
    for power in powers(2, 3):
        expected = np.zeros(cover.grid.cells.shape)
        for p, (i, j) in itertools.product(range(points.n), np.ndindex(*expected.shape)):
            part = in_box(parallelogram(points.x[:, p], points.spans[:, :, p]), (AXES[0][i], AXES[1][j]),
                          (AXES[0][i + 1], AXES[1][j + 1]))
            expected[i, j] += over_polygon(part, power) if len(part) else 0.0
        assert_allclose(per_cell(cover, power), expected, atol=1e-13)


def test_clipped_prisms_are_integrated_as_polygons_times_intervals():
    random = np.random.default_rng(5)
    spans = np.zeros((3, 3, 1))
    spans[:2, :2] = random_spans(random, 2, 1, 0.8)
    spans[2, 2] = 0.7
    points = points_of(np.array([[2.0], [0.7], [0.3]]), spans, solid)
    cover = cover_of(grid_of(*AXES), points)
    z = np.clip(AXES[2], 0.3 - 0.35, 0.3 + 0.35)
    for power in powers(3, 3):
        expected = np.zeros(cover.grid.cells.shape)
        for i, j in np.ndindex(*expected.shape[:2]):
            part = in_box(parallelogram(points.x[:2, 0], spans[:2, :2, 0]), (AXES[0][i], AXES[1][j]),
                          (AXES[0][i + 1], AXES[1][j + 1]))
            across = over_polygon(part, power[:2]) if len(part) else 0.0
            expected[i, j] = across * np.diff(z ** (power[2] + 1)) / (power[2] + 1)
        assert_allclose(per_cell(cover, power), expected, atol=1e-13)


def test_domains_in_space_that_shear_and_turn_are_cut_as_samples_say():
    points = scattered(solid, 3, n=1, seed=3, size=0.8, factor=1.0)
    points = replace(points, x=np.array([[2.2], [0.7], [0.4]]))
    cover = cover_of(grid_of(*AXES), points)
    m = 60
    r = (np.indices((m,) * 3).reshape(3, -1) + 0.5) / m - 0.5
    x = points.x + points.spans[:, :, 0] @ r
    place = np.ravel_multi_index(tuple(cover.grid.locate(x)), cover.grid.cells.shape)
    expected = np.bincount(place, minlength=cover.grid.cells.size) / m ** 3 * points.volume
    assert_allclose(per_cell(cover).ravel(), expected, atol=2e-3 * points.volume[0])
    assert len(cover.keys) > 8


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.5), (0.0, 0.5, 0.5), (0.5, 0.5, 0.5)])
@pytest.mark.parametrize("size", [1e-9, 0.25, 1.0, 2.0, 5.0])
def test_boxes_on_nodes_edges_faces_and_middles(dim, place, size):
    x = 4 + np.array(place)[:dim, None]
    points = points_of(x, size * np.eye(dim)[:, :, None], MOTION[dim])
    cover = cover_of(even(dim, 9), points)
    part = [np.diff(np.clip(np.arange(10.0), a - size / 2, a + size / 2)) for a in x[:, 0]]
    expected = part[0] if dim == 1 else np.multiply.outer(part[0], part[1]) if dim == 2 else np.einsum(
        "i,j,k->ijk", *part)
    if size < 1e-6:                                                     # not cut
        assert abs(per_cell(cover).sum() / size ** dim - 1) < 1e-6
    else:
        assert_allclose(per_cell(cover), expected, atol=1e-12 * size ** dim)
    assert np.isfinite(cover.pieces).all() and in_cells(cover)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, np.pi / 2, 2.0])
@pytest.mark.parametrize("shift", [0.0, 1e-12, 0.37])
def test_domains_that_tile_a_turned_square_cover_what_it_does(angle, shift):
    m, side = 10, 5.0
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    middle = np.array([[6 + shift], [6.0]])
    r = ((np.indices((m, m)).reshape(2, -1) + 0.5) / m - 0.5) * side
    points = points_of(middle + turn @ r, np.repeat((turn * side / m)[:, :, None], m * m, axis=2), plane_strain)
    cover = cover_of(even(2, 12), points)
    whole = parallelogram(middle[:, 0], turn * side)
    expected = np.zeros((12, 12))
    for i, j in np.ndindex(12, 12):
        part = in_box(whole, (i, j), (i + 1, j + 1))
        expected[i, j] = over_polygon(part, (0, 0)) if len(part) else 0.0
    assert len(cover.full)
    assert_allclose(per_cell(cover), expected, atol=1e-9)
    assert abs(cover.quadrature(2)[2].sum() - side ** 2) < 1e-11 * side ** 2


@settings(max_examples=25)
@given(st.integers(0, 10 ** 6), st.sampled_from(MOTIONS), st.floats(1e-9, 0.45))
def test_any_domains_keep_their_volume_and_stay_in_their_cells(seed, motion, size):
    points = scattered(*motion, n=4, seed=seed, size=size, factor=1.0)
    cover = cover_of(grid_of(*AXES[:motion[1]]), points)
    assert in_cells(cover)
    _, x, area, owner = by_owner(cover, 2)
    measure = area * x[0] if motion[0].hoop else area
    assert_allclose(np.bincount(owner, measure, points.n), points.volume, rtol=1e-9 + 1e-14 / size)    # places round
    assert (area > 0).all() or np.abs(area[area <= 0]).max() <= 1e-12 * points.volume.max()


# -- planes and the edge of the grid ---------------------------------------------------------------------------------

@pytest.mark.parametrize("side", [-1, 1])
def test_what_reaches_behind_a_plane_is_mirrored(side):
    """Onto cells of other widths too: it is cut where the image crosses grid lines."""
    axis = np.array([0, 1, 2, 2.2, 2.4, 2.6, 2.8, 3.0, 4, 5])
    axis = axis if side < 0 else 5 - axis[::-1]
    place = 2.1 if side < 0 else 5 - 2.1
    points = points_of(np.array([[place]]), np.array([[[1.4]]]), uniaxial)
    cover = cover_of(grid_of(axis), points, [FixedPlane(0, 2.0 if side < 0 else 3.0, side)])
    expected = np.array([0, 0, 0.4, 0.4, 0.4, 0.2, 0, 0, 0])              # 1.4 to 2.8, folded at 2
    assert in_cells(cover)
    assert_allclose(per_cell(cover), expected if side < 0 else expected[::-1], atol=1e-13)


def test_what_leaves_the_grid_at_a_plane_is_mirrored():
    points = points_of(np.array([[0.4], [1.5]]), np.diag([2.2, 0.6])[:, :, None], plane_strain)
    cover = cover_of(grid_of(np.array([0, 0.5, 1, 1.5, 2, 3, 4]), np.arange(4.0)), points, [FixedPlane(0, 0.0, -1)])
    assert in_cells(cover)
    assert_allclose(per_cell(cover).sum(axis=1), 0.6 * np.array([1.0, 0.7, 0.5, 0, 0, 0]), atol=1e-13)


def test_corners_between_planes_mirror_twice():
    edges = 1.1 * np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])[:, :, None]
    points = points_of(np.array([[0.3], [0.2]]), edges, plane_strain)
    planes = [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1)]
    cover = cover_of(even(2, 4), points, planes)
    assert in_cells(cover) and (cover.pieces >= -1e-12).all()
    assert abs(per_cell(cover).sum() - 1.21) < 1e-12


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("end", [0, 1])
def test_a_domain_that_leaves_the_grid_is_refused_and_the_point_named(dim, end):
    x = np.full((dim, 2), 3.0)
    x[-1, 1] = 0.2 if end == 0 else 5.8
    points = points_of(x, np.repeat(0.5 * np.eye(dim)[:, :, None], 2, axis=2), MOTION[dim])
    with pytest.raises(OutsideGridError, match="domain of point 1 at .* leaves the grid"):
        cover_of(even(dim, 6), points)
    plane = FixedPlane(dim - 1, 0.0 if end == 0 else 6.0, 1 if end else -1)
    assert abs(per_cell(cover_of(even(dim, 6), points, [plane])).sum() - 2 * 0.5 ** dim) < 1e-13
    x[-1, 1] = 0.25 if end == 0 else 5.75                                # ends on the edge: inside
    cover_of(even(dim, 6), replace(points, x=x))


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_body_may_fill_the_whole_grid(dim):
    mesh = MAKE[dim](*[np.arange(5.0)] * dim)
    body = Particles.fill(mesh, MOTION[dim])
    planes = [FixedPlane(k, at, side) for k in range(dim) for at, side in ((0.0, -1), (4.0, 1))]
    for some in (planes, planes[:1], []):
        assert_allclose(per_cell(cover_of(Grid.from_mesh(mesh), body, some)), 1.0, rtol=1e-12)


def test_a_free_surface_in_the_last_cell_of_the_grid_is_seen():
    mesh = MeshLine(np.arange(6.0))
    body = Particles.fill(mesh, uniaxial, where=lambda x: x[0] < 4.5)
    assert_allclose(per_cell(cover_of(Grid.from_mesh(mesh), body)), [1, 1, 1, 1, 0.5], rtol=1e-12)


# -- parts of a body -------------------------------------------------------------------------------------------------

def test_two_bodies_in_one_cell_are_two_units():
    x = np.array([[2.25, 2.75], [2.5, 2.5]])
    spans = np.repeat(np.diag([0.5, 1.0])[:, :, None], 2, axis=2)
    points = points_of(x, spans, plane_strain, fields={"body": np.array([7.0, 3.0])})
    cover = cover_of(even(2, 5), points)
    assert len(cover.keys) == 2 and len(np.unique(cover.cells)) == 1
    assert len(cover_of(even(2, 5), replace(points, fields={})).keys) == 1


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_parts_a_cell_apart_share_no_unit(dim):
    x = np.full((dim, 2), 2.5)
    x[0, 1] = 4.5
    points = points_of(x, np.repeat(2.5 * np.eye(dim)[:, :, None], 2, axis=2), MOTION[dim])    # both reach the cell
    cover = cover_of(even(dim, 8), points)                                                   # between
    between = np.ravel_multi_index((3,) + (2,) * (dim - 1), (8,) * dim)
    assert cover.part[0] != cover.part[1] and (cover.cells == between).sum() == 2
    x[0, 1] = 3.5
    assert len(np.unique(cover_of(even(dim, 8), replace(points, x=x)).part)) == 1


def test_a_body_inside_another_one_keeps_its_volume():
    """Cells that are full of one body are not full of the other."""
    mesh = MeshQuad.init_tensor(*[np.arange(13.0)] * 2)
    outer = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 1) & (x < 11)).all(axis=0))
    x = np.concatenate([outer.x, [[6.1], [5.9]]], axis=1)
    n = x.shape[1]
    points = points_of(x, np.repeat(0.5 * np.eye(2)[:, :, None], n, axis=2), plane_strain,
                       fields={"body": (np.arange(n) == n - 1) * 1.0})
    assert abs(per_cell(cover_of(Grid.from_mesh(mesh), points)).sum() - 100.25) < 1e-11


def test_each_body_is_covered_as_if_the_others_were_not_there():
    one, other = (scattered(plane_strain, 2, n=9, seed=seed, factor=1.0) for seed in (1, 2))
    both = points_of(np.hstack([one.x, other.x]), np.concatenate([one.spans, other.spans], axis=2), plane_strain,
                     fields={"body": np.repeat([0.0, 1.0], 9)})
    grid = grid_of(*AXES[:2])
    cover = cover_of(grid, both)
    unit, x, area = cover.quadrature(2)
    for points, mine in ((one, cover.part < cover.part[9:].min()), (other, cover.part >= cover.part[9:].min())):
        parts = np.unique(cover.part[mine])
        own = np.isin(cover.keys[unit] % cover.nparts, parts)
        found = np.bincount(cover.cells[unit[own]], area[own], grid.cells.size)
        alone = replace(points, fields={"body": np.zeros(9)})
        assert_allclose(found, per_cell(cover_of(grid, alone)).ravel(), atol=1e-13)


# -- cells well inside -----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("kinematics, dim", MOTIONS)
def test_cells_well_inside_have_gauss_points_and_others_pieces(kinematics, dim):
    mesh = MAKE[dim](*AXES[:dim])
    body = Particles.fill(mesh, kinematics, where=lambda x: np.all(
        [(row > axis[1]) & (row < axis[-2]) for row, axis in zip(x, AXES)], axis=0))
    random = np.random.default_rng(0)
    body = replace(body, spans=spans_of(body) * random.uniform(0.9, 1.1, body.n))    # sizes do not matter inside
    grid = Grid.from_mesh(mesh)
    cover = cover_of(grid, body)
    inside = np.zeros(grid.cells.shape, dtype=bool)
    inside[(slice(2, -2),) * dim] = True
    assert_array_equal(np.sort(cover.full), np.flatnonzero(inside.ravel()))
    unit, x, area = cover.quadrature(3)
    number = np.flatnonzero(inside.ravel())[0]
    own = cover.cells[unit] == number
    index = np.unravel_index(number, grid.cells.shape)
    assert own.sum() == 2 ** dim
    assert_allclose(area[own].sum(), np.prod([grid.steps[k][index[k]] for k in range(dim)]), rtol=1e-13)


# -- symmetry --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("dim", [2, 3])
def test_swapped_axes_and_mirrored_layouts_give_mirrored_covers(dim):
    points = scattered(MOTION[dim], dim, n=12, seed=4, factor=1.0)
    cover = per_cell(cover_of(grid_of(*AXES[:dim]), points))
    order = list(range(dim))[::-1]
    swapped = points_of(points.x[order], points.spans[order][:, order], points.kinematics)
    assert_allclose(per_cell(cover_of(grid_of(*[AXES[k] for k in order]), swapped)), cover.transpose(order), atol=1e-13)
    sign = np.array([-1.0, 1, 1])[:dim]
    mirrored = points_of(points.x * sign[:, None], sign[:, None, None] * points.spans * sign[:, None],
                         points.kinematics)
    axes = [-AXES[0][::-1], *AXES[1:dim]]
    assert_allclose(per_cell(cover_of(grid_of(*axes), mirrored)), cover[::-1], atol=1e-13)


# -- spans -----------------------------------------------------------------------------------------------------------

def test_domains_without_spans_are_boxes_and_points_without_either_are_refused():
    x = np.array([[2.5], [2.5]])
    boxes = Particles(x, np.array([0.3]), np.array([1.0]), plane_strain, length=np.array([[0.5], [0.6]]))
    assert_array_equal(spans_of(boxes)[:, :, 0], np.diag([0.5, 0.6]))
    with pytest.raises(ValueError, match="length: the points have none"):
        spans_of(replace(boxes, length=None))


@pytest.mark.parametrize("spans", [np.diag([1.0, -1.0]), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_spans_are_no_flat_or_turned_over_parallelograms(spans):
    with pytest.raises(ValueError, match="spans"):
        Particles(np.ones((2, 1)), np.ones(1), np.ones(1), plane_strain, spans=spans[:, :, None])
    with pytest.raises(ValueError, match="spans"):
        Particles(np.ones((2, 1)), np.ones(1), np.ones(1), plane_strain, spans=np.eye(2))


def test_body_numbers_of_another_shape_are_refused():
    grid = Grid.from_mesh(MeshLine(np.arange(6.0)))
    with pytest.raises(ValueError, match=r"fields\['body'\]: got shape \(2, 1\), expected \(1,\)"):
        parts(grid, np.array([[2]]), np.zeros((2, 1)))
