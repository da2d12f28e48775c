"""Which cell each point is in: right, the same whatever else is asked, and clear about points that are outside."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from skfem import MeshHex, MeshHex2, MeshLine, MeshQuad, MeshTet, MeshTri, MeshTri1DG

from skfem_mpm import locator
from skfem_mpm.checks import OutsideGridError
from skfem_mpm.locator import CellLocator, local_coordinates


def jittered(mesh, amount=0.2, seed=1):
    """The mesh with its inner vertices moved at random, by at most ``amount`` of ``mesh.param()``."""
    rng = np.random.default_rng(seed)
    p = mesh.p.copy()
    inner = mesh.interior_nodes()
    p[:, inner] += amount * mesh.param() * rng.uniform(-1, 1, (len(p), len(inner))) / np.sqrt(len(p))
    return type(mesh)(p, mesh.t)


def rolled(mesh, seed=2):
    """The quad mesh with the local order of vertices turned at random in every cell."""
    shifts = np.random.default_rng(seed).integers(0, 4, mesh.nelements)
    return MeshQuad(mesh.p, np.array([np.roll(column, shift) for column, shift in zip(mesh.t.T, shifts)]).T)


def ring(inner=0.5, outer=1.0, around=24, across=4):
    """A full ring of quads, with a hole; no vertex is doubled."""
    angle, radius = np.meshgrid(2 * np.pi * np.arange(around) / around, np.linspace(inner, outer, across + 1))
    number = np.arange(angle.size).reshape(angle.shape)
    right = np.roll(number, -1, axis=1)
    t = np.array([number[:-1], right[:-1], right[1:], number[1:]]).reshape(4, -1)
    return MeshQuad(np.array([radius * np.cos(angle), radius * np.sin(angle)]).reshape(2, -1), t)


def l_shape():
    """The unit square without its upper right quarter, triangles."""
    mesh = MeshTri.init_tensor(np.linspace(0, 1, 13), np.linspace(0, 1, 13))
    return mesh.remove_elements(mesh.elements_satisfying(lambda x: (x[0] > 0.5) & (x[1] > 0.5)))


def graded(count=9):
    return np.linspace(0, 1, count)**3


MESHES = {
    "line": MeshLine(graded()),
    "tri": MeshTri().refined(3),
    "tri graded": MeshTri.init_tensor(graded(), np.linspace(0, 1, 5)),
    "tri locally refined": MeshTri().refined(2).refined([0, 1, 5]).refined([3, 4]),
    "tri jittered": jittered(MeshTri().refined(3)),
    "quad tensor": MeshQuad.init_tensor(graded(), np.linspace(0, 2, 5)),
    "quad refined": MeshQuad().refined(3),
    "quad jittered": rolled(jittered(MeshQuad().refined(3), 0.4)),
    "tet": MeshTet().refined(2),
    "tet jittered": jittered(MeshTet().refined(2)),
    "hex tensor": MeshHex.init_tensor(graded(5), np.linspace(0, 2, 4), np.linspace(0, 1, 3)),
    "hex refined": MeshHex().refined(2),
    "hex bowed": jittered(MeshHex().refined(2), 0.4),
    "l-shape": l_shape(),
    "ring": ring(),
    "far from the origin": MeshTri().refined(3).scaled(1e-3).translated((4e5, 5e6)),
    "wild units": jittered(MeshQuad().refined(3), 0.4).scaled(1e-9),
}

every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


def position(mesh, cells, X):
    """The cell map, by the element's own functions."""
    elem = mesh.elem()
    return sum(elem.lbasis(X, i)[0] * mesh.p[:, mesh.t[i, cells]] for i in range(len(mesh.t)))


def inside_reference(mesh, X, tolerance=1e-11):
    """Whether local coordinates are in the reference cell."""
    inside = (X > -tolerance).all(axis=0) & (X < 1 + tolerance).all(axis=0)
    return inside & (X.sum(axis=0) < 1 + tolerance) if mesh.elem.maxdeg == 1 else inside


def size(mesh):
    """A typical length of a cell."""
    return mesh.param() if mesh.dim() > 1 else np.diff(np.sort(mesh.p[0])).min()


def resolution(mesh):
    """Relative accuracy of positions, as a share of a cell."""
    return 1e-12 + 20 * np.finfo(float).eps * abs(mesh.p).max() / size(mesh)


def scattered(mesh, count=400, seed=3):
    """Random points, and the cells they were drawn in."""
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, mesh.nelements, count)
    simplex = mesh.elem.maxdeg == 1
    X = rng.dirichlet(np.ones(mesh.dim() + 1), count).T[1:] if simplex else rng.uniform(0, 1, (mesh.dim(), count))
    return position(mesh, cells, X), cells


def on_entities(mesh):
    """All vertices, and points on every edge of the reference cell and every facet, in all cells."""
    elem, facets = mesh.elem(), [np.atleast_1d(facet) for facet in mesh.refdom.facets]
    groups = [[i] for i in range(len(elem.doflocs))] + (mesh.refdom.edges or []) + facets
    shares = [np.linspace(1, 2, len(group)) for group in groups]
    local = [share @ elem.doflocs[group] / share.sum() for group, share in zip(groups, shares)]
    cells = np.repeat(np.arange(mesh.nelements), len(local))
    X = np.tile(np.array(local).T, mesh.nelements)
    keep = np.random.default_rng(4).permutation(len(cells))[:1500]
    return position(mesh, cells[keep], X[:, keep]), cells[keep]


def test_the_helper_mesh_is_really_bowed():
    mesh = MESHES["hex bowed"]
    corners = mesh.p[:, mesh.t[mesh.refdom.facets[0]]]
    edges = corners[:, 1:] - corners[:, :1]
    assert abs(np.linalg.det(edges.transpose(2, 0, 1))).max() > 1e-4


@every_mesh
def test_points_land_in_a_cell_that_contains_them(mesh):
    x, _ = scattered(mesh)
    cells, X = CellLocator(mesh).find(x)
    assert inside_reference(mesh, X, max(1e-11, resolution(mesh))).all()
    assert_allclose(position(mesh, cells, X), x, rtol=1e-15, atol=resolution(mesh) * size(mesh))


@every_mesh
def test_points_inside_a_cell_land_in_the_cell_they_were_drawn_in(mesh):
    x, drawn = scattered(mesh)
    cells, X = CellLocator(mesh).find(x)
    clear = inside_reference(mesh, X, -1e-6)
    assert clear.mean() > 0.9
    assert_array_equal(cells[clear], drawn[clear])


@every_mesh
def test_points_on_vertices_edges_and_facets_go_to_the_lowest_cell_whatever_else_is_asked(mesh):
    x, drawn = on_entities(mesh)
    finder = CellLocator(mesh)
    cells, X = finder.find(x)
    assert (cells <= drawn).all()
    from_drawn = finder.find(x, start=drawn)
    from_far = finder.find(x, start=np.full(x.shape[1], mesh.nelements - 1))
    backwards = finder.find(x[:, ::-1])
    assert_array_equal(from_drawn[0], cells)
    assert_array_equal(from_far[0], cells)
    assert_array_equal(backwards[0][::-1], cells)
    assert_array_equal(from_drawn[1], X)
    assert_array_equal(backwards[1][:, ::-1], X)
    for point in range(0, x.shape[1], 29):
        alone = finder.find(x[:, point:point + 1])
        assert alone[0][0] == cells[point]
        assert_array_equal(alone[1][:, 0], X[:, point])


@pytest.mark.parametrize("name", ["tri", "quad jittered", "hex bowed", "tet jittered", "ring"])
def test_no_lower_cell_contains_a_point_on_an_entity(name):
    mesh = MESHES[name]
    x, _ = on_entities(mesh)
    x = x[:, :60]
    cells, _ = CellLocator(mesh).find(x)
    for point, cell in enumerate(cells):
        below = np.arange(cell)
        X = locator._invert(mesh, below, np.repeat(x[:, point:point + 1], cell, axis=1))
        assert not inside_reference(mesh, X, 1e-13).any()


def test_a_point_behind_a_bowed_facet_is_handed_over_to_the_right_cell():
    mesh = MESHES["hex bowed"]
    finder = CellLocator(mesh)
    x, drawn = scattered(mesh, 5000)
    by_planes = finder._walk_over_planes(x, None)
    assert (by_planes != drawn).sum() > 10
    assert_array_equal(finder.find(x)[0], drawn)


@every_mesh
def test_warm_start_equals_cold_start(mesh):
    x, drawn = scattered(mesh, seed=5)
    finder = CellLocator(mesh)
    cells, X = finder.find(x)
    for start in (cells, drawn, np.zeros_like(cells), cells[::-1], finder._across[0, cells].clip(0)):
        warm_cells, warm_X = finder.find(x, start=start)
        assert_array_equal(warm_cells, cells)
        assert_array_equal(warm_X, X)


def test_a_start_far_away_is_no_problem():
    mesh = MeshTri.init_tensor(np.linspace(0, 1, 200), np.linspace(0, 1, 200))
    x, drawn = scattered(mesh, 200)
    cells, _ = CellLocator(mesh).find(x, start=np.full(200, mesh.nelements - 1))
    assert (cells == drawn).mean() > 0.99


@every_mesh
@pytest.mark.parametrize("nearest", [(), (8, 64)], ids=["all cells", "nearest cells"])
def test_every_way_back_for_a_lost_point_gives_the_same_answer(mesh, nearest, monkeypatch):
    x, _ = on_entities(mesh)
    x = np.concatenate([x[:, :30], scattered(mesh, 30)[0]], axis=1)
    finder = CellLocator(mesh)
    cells, X = finder.find(x)
    monkeypatch.setattr(finder, "_walk_over_planes", lambda x, start: np.zeros(x.shape[1], dtype=int))
    monkeypatch.setattr(locator, "BOWED_STEPS", 0)
    monkeypatch.setattr(locator, "NEAREST", nearest)
    again, again_X = finder.find(x)
    assert_array_equal(again, cells)
    assert_array_equal(again_X, X)


@every_mesh
def test_a_point_outside_is_named(mesh):
    x, _ = scattered(mesh, 50)
    x[:, 17] = mesh.p.max(axis=1) + size(mesh)
    x[:, 31] = mesh.p.min(axis=1) - size(mesh)
    first = ", ".join(f"{value:.6g}" for value in x[:, 17])
    box = " x ".join(f"[{low:.6g}, {high:.6g}]" for low, high in zip(mesh.p.min(axis=1), mesh.p.max(axis=1)))
    with pytest.raises(OutsideGridError, match=re.escape(f"point 17 is at ({first})")) as caught:
        CellLocator(mesh).find(x)
    assert box in str(caught.value)
    assert "larger mesh" in str(caught.value) and "smaller step" in str(caught.value)


@pytest.mark.parametrize("name, x", [("ring", [[0.0], [0.1]]), ("l-shape", [[0.75], [0.51]])])
def test_a_point_in_a_hole_or_a_notch_is_outside(name, x):
    with pytest.raises(OutsideGridError, match="point 0"):
        CellLocator(MESHES[name]).find(np.array(x))


def test_a_point_barely_outside_is_outside_and_a_rounding_error_is_not():
    finder = CellLocator(MeshQuad().refined(2))
    cells, X = finder.find(np.array([[1 + 1e-15], [-1e-16]]))
    assert_allclose(position(finder.mesh, cells, X), [[1], [0]], atol=1e-14)
    with pytest.raises(OutsideGridError):
        finder.find(np.array([[1 + 1e-9], [0.5]]))


def test_a_walk_passes_round_a_corner_and_a_hole():
    for name in ("ring", "l-shape"):
        mesh = MESHES[name]
        x, drawn = scattered(mesh, 200)
        for cell in range(0, mesh.nelements, 17):
            assert (CellLocator(mesh).find(x, start=np.full(200, cell))[0] == drawn).mean() > 0.99


@every_mesh
def test_local_coordinates_extrapolate(mesh):
    rng = np.random.default_rng(6)
    centre = mesh.elem().doflocs.mean(axis=0)[:, None]
    X = centre + rng.uniform(-0.7, 0.7, (mesh.dim(), 100))
    cells = rng.integers(0, mesh.nelements, 100)
    assert_allclose(local_coordinates(mesh, cells, position(mesh, cells, X)), X, atol=1e2 * resolution(mesh))


def test_far_extrapolation_from_a_parallelogram_is_exact():
    mesh = MeshQuad.init_tensor(np.linspace(0, 1, 3), np.linspace(0, 1, 5))
    X = np.array([[-30.0, 12.0], [55.0, -7.5]])
    cells = np.array([0, 7])
    assert_allclose(local_coordinates(mesh, cells, position(mesh, cells, X)), X, rtol=1e-13)


def test_local_coordinates_say_where_there_are_none():
    mesh = MeshQuad(np.array([[0.0, 1, 0.6, 0], [0, 0, 0.6, 1]]), np.array([[0], [1], [2], [3]]))
    with pytest.raises(ValueError, match=r"point 1 .*cell 0"):
        local_coordinates(mesh, np.array([0, 0]), np.array([[0.1, 5.0], [0.1, 5.0]]))


@pytest.mark.parametrize("seed", range(5))
def test_extreme_but_convex_quads(seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, (4, 3000)), axis=0)
    p = np.array([np.cos(angle), np.sin(angle)]) * np.array([1.0, 10.0**rng.uniform(-3, 0)])[:, None, None]
    t = np.arange(p[0].size).reshape(p[0].shape)
    mesh = MeshQuad(p.reshape(2, -1), t)
    X = rng.uniform(0, 1, (2, t.shape[1]))
    cells = np.arange(t.shape[1])
    back = position(mesh, cells, local_coordinates(mesh, cells, position(mesh, cells, X)))
    assert_allclose(back, position(mesh, cells, X), atol=1e-12)
    assert_array_equal(inside_reference(mesh, local_coordinates(mesh, cells, back), 1e-6), True)


def test_no_points_are_no_trouble():
    cells, X = CellLocator(MeshTri()).find(np.zeros((2, 0)))
    assert cells.shape == (0,) and X.shape == (2, 0)


def test_one_cell_is_a_mesh():
    for mesh in (MeshLine(np.array([0.0, 2.0])), MeshQuad(), MeshHex()):
        cells, X = CellLocator(mesh).find(np.full((mesh.dim(), 1), 0.5))
        assert cells[0] == 0
        assert_allclose(position(mesh, cells, X), 0.5)


@pytest.mark.parametrize("mesh", [MeshHex2(), MeshTri1DG.from_mesh(MeshTri())])
def test_other_meshes_are_refused(mesh):
    with pytest.raises(ValueError, match="linear mesh"):
        CellLocator(mesh)


@pytest.mark.parametrize("corner", [[0.2, 0.2], [0.5, 0.5]])
def test_cells_that_are_not_convex_are_refused(corner):
    mesh = MeshQuad(np.array([[0, 1, corner[0], 0], [0, 0, corner[1], 1]]), np.array([[0], [1], [2], [3]]))
    with pytest.raises(ValueError, match="cell 0"):
        CellLocator(mesh)


def test_wrong_input_is_refused():
    finder = CellLocator(MeshTri())
    x = np.full((2, 3), 0.25)
    with pytest.raises(ValueError, match="x: got shape"):
        finder.find(x[0])
    with pytest.raises(ValueError, match="finite"):
        finder.find(np.array([[0.1], [np.nan]]))
    for start in (np.zeros(2, int), np.array([0, 1, 2]), np.array([0, -1, 1])):
        with pytest.raises(ValueError, match="start"):
            finder.find(x, start=start)
    with pytest.raises(TypeError, match="start"):
        finder.find(x, start=np.zeros(3))
    with pytest.raises(ValueError, match="cells"):
        local_coordinates(finder.mesh, np.array([0, 9, 0]), x)


def test_the_input_is_left_alone():
    mesh = MESHES["quad jittered"]
    x, drawn = on_entities(mesh)
    x.setflags(write=False)
    drawn.setflags(write=False)
    cells, _ = CellLocator(mesh).find(x, start=drawn)
    assert not np.shares_memory(cells, drawn)
