"""A mesh is seen as a tensor grid whatever its numbering, and every point is in one cell, always the same one."""

import itertools
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from skfem import (
    MeshHex,
    MeshHex2,
    MeshLine,
    MeshQuad,
    MeshQuad2,
    MeshTet,
    MeshTri,
)

from skfem_mpm import OutsideGridError
from skfem_mpm.grid import Grid, available_sides


def shuffled(mesh, seed=5):
    """The same mesh with vertices and cells numbered at random, and quads that begin at any corner."""
    rng = np.random.default_rng(seed)
    old = rng.permutation(mesh.nvertices)               # new vertex i is the old vertex old[i]
    t = np.argsort(old)[mesh.t][:, rng.permutation(mesh.nelements)]
    if isinstance(mesh, MeshQuad):
        t = np.take_along_axis(t, (np.arange(4)[:, None] + rng.integers(0, 4, t.shape[1])) % 4, axis=0)
    return type(mesh)(mesh.p[:, old], t)


def axis(count, grading=1.0, low=0.0, high=1.0):
    return low + (high - low) * np.linspace(0, 1, count + 1) ** grading


STRAIGHT = {
    "line tensor": MeshLine(axis(5, low=1, high=3)),
    "line refined": MeshLine().refined(3),
    "line graded": MeshLine(axis(6, 1.4)),
    "quad tensor": MeshQuad.init_tensor(axis(5, low=1, high=3), axis(4)),
    "quad refined": MeshQuad().refined(2),
    "quad graded": MeshQuad.init_tensor(axis(5, 1.4), axis(4, 0.8, -1, 2)),
    "hex tensor": MeshHex.init_tensor(axis(4), axis(3), axis(5, low=-1)),
    "hex refined": MeshHex().refined(2),
    "hex graded": MeshHex.init_tensor(axis(4, 1.4), axis(3, 1.2), axis(4, 0.8)),
}
MESHES = STRAIGHT | {f"{name} shuffled": shuffled(mesh) for name, mesh in STRAIGHT.items()}
AWKWARD = {        # axes whose faces are not where arithmetic puts them
    "tenths": np.linspace(0, 1, 11),
    "tenths far off": 1e6 + np.linspace(0, 1, 11),
    "thirds": np.arange(8) / 3 - 1,
    "small": 3.3e-7 * np.arange(12) - 1e-7,
    "large": 7e5 * np.arange(6) - 2e6,
    "sums of rounding": np.cumsum(np.full(40, 0.1)),
    "nearly equal": np.linspace(0, 1, 21) + 1e-11 * np.sin(np.arange(21)),
    "graded": axis(15, 2.0),
    "one cell": np.array([0.0, 1.0]),
}


def dim_of(mesh):
    return mesh.p.shape[0]


def scattered(mesh, n=300, seed=0):
    """Points anywhere in the box of a mesh, then points on all nodes, hence on faces, edges and corners of cells."""
    low, high = mesh.p.min(axis=1, keepdims=True), mesh.p.max(axis=1, keepdims=True)
    inside = low + (high - low) * np.random.default_rng(seed).random((dim_of(mesh), n))
    on_faces = inside[:, :60].copy()
    on_faces[0] = np.random.default_rng(seed).choice(mesh.p[0], 60)
    return np.concatenate([inside, on_faces, mesh.p], axis=1)


def by_counting(axis, x):
    """The half-open rule, said plainly: the cell is the number of inner faces at or below the point."""
    return (axis[1:-1, None] <= x).sum(axis=0)


def around_faces(axis):
    """All faces of an axis and one unit in the last place to either side, but none outside."""
    x = np.concatenate([axis, np.nextafter(axis[1:], -np.inf), np.nextafter(axis[:-1], np.inf)])
    return x[np.random.default_rng(0).permutation(len(x))]


def dense(grid, stencil, part, size):
    """A table of the stencil as the matrix that it is, one column per mesh vertex."""
    out = np.zeros((stencil.n, size))
    vertices = grid.vertices.ravel()[stencil.nodes()]
    np.add.at(out, (np.broadcast_to(np.arange(stencil.n), vertices.shape), vertices), part)
    return out


# The view.

@pytest.mark.parametrize("name", MESHES)
def test_any_numbering_gives_the_same_tensor_view(name):
    mesh = MESHES[name]
    grid = Grid.from_mesh(mesh)
    for index in np.ndindex(grid.vertices.shape):
        assert_allclose(mesh.p[:, grid.vertices[index]], [a[i] for a, i in zip(grid.axes, index)], atol=1e-12)
    for index in np.ndindex(grid.cells.shape):
        corners = mesh.p[:, mesh.t[:, grid.cells[index]]]
        assert_allclose(corners.min(axis=1), [a[i] for a, i in zip(grid.axes, index)], atol=1e-12)
        assert_allclose(corners.max(axis=1), [a[i + 1] for a, i in zip(grid.axes, index)], atol=1e-12)
    assert_array_equal(np.sort(grid.vertices, axis=None), np.arange(mesh.nvertices))
    assert_array_equal(np.sort(grid.cells, axis=None), np.arange(mesh.nelements))
    assert (grid.dim, grid.nnodes) == (dim_of(mesh), mesh.nvertices)


def test_coordinates_equal_up_to_rounding_are_one_node():
    mesh = MESHES["quad tensor"]
    noisy = MeshQuad(mesh.p * (1 + 1e-15 * np.random.default_rng(0).integers(-1, 2, mesh.p.shape)), mesh.t)
    assert Grid.from_mesh(noisy).cells.shape == Grid.from_mesh(mesh).cells.shape


def test_a_mesh_is_viewed_once():
    mesh = MeshQuad().refined(2)
    assert Grid.from_mesh(mesh) is Grid.from_mesh(mesh)


def test_meshes_made_one_after_the_other_are_not_mistaken_for_each_other():
    for count in range(1, 30):                          # freed at once, so the memory is likely to be used again
        assert Grid.from_mesh(MeshLine(axis(count))).cells.shape == (count,)


def rotated(mesh, angle=0.1):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return MeshQuad(turn @ mesh.p, mesh.t)


def bent(mesh):
    p = mesh.p.copy()
    p[:, mesh.interior_nodes()[0]] += 0.05
    return type(mesh)(p, mesh.t)


def l_shape():
    return MeshQuad().refined(2).remove_elements(np.array([0, 1])).remove_unused_nodes()


BAD = {
    "triangles": MeshTri().refined(1),
    "tetrahedra": MeshTet(),
    "quadratic quads": MeshQuad2.from_mesh(MeshQuad().refined(1)),
    "quadratic hexes": MeshHex2.from_mesh(MeshHex()),
    "a bent quad mesh": bent(MeshQuad().refined(2)),
    "a bent hex mesh": bent(MeshHex().refined(1)),
    "a turned quad mesh": rotated(MeshQuad().refined(2)),
    "a turned single quad": rotated(MeshQuad(), np.pi / 4),
    "an L": l_shape(),
    "a mesh with a hole": MeshQuad.init_tensor(axis(3), axis(3)).remove_elements(np.array([4])),
}


@pytest.mark.parametrize("name", BAD)
def test_other_meshes_are_refused_with_what_to_do(name):
    with pytest.raises(ValueError, match=rf"mesh: got (a )?{type(BAD[name]).__name__}") as e:
        Grid.from_mesh(BAD[name])
    assert re.search("expected|do not make a full box", str(e.value))
    assert re.search("ParticleBasis|init_tensor", str(e.value))


# Locating points.

@pytest.mark.parametrize("name", AWKWARD)
def test_a_point_on_a_face_is_in_the_cell_that_begins_there_and_one_ulp_below_in_the_one_before(name):
    faces = AWKWARD[name]
    grid = Grid.from_mesh(MeshLine(faces))
    assert_array_equal(grid.locate(faces[None, :-1])[0], np.arange(len(faces) - 1))
    assert_array_equal(grid.locate(np.nextafter(faces[None, 1:], -np.inf))[0], np.arange(len(faces) - 1))
    assert_array_equal(grid.locate(np.nextafter(faces[None, :-1], np.inf))[0], np.arange(len(faces) - 1))


@pytest.mark.parametrize("name", AWKWARD)
def test_the_last_cell_holds_its_last_face(name):
    faces = AWKWARD[name]
    assert Grid.from_mesh(MeshLine(faces)).locate(faces[-1:, None]) == len(faces) - 2


@pytest.mark.parametrize("name", AWKWARD)
def test_locate_is_the_same_as_counting_faces(name):
    faces = AWKWARD[name]
    x = np.concatenate([around_faces(faces), np.random.default_rng(1).uniform(faces[0], faces[-1], 2000)])
    assert_array_equal(Grid.from_mesh(MeshLine(faces)).locate(x[None])[0], by_counting(faces, x))


@pytest.mark.parametrize("name", MESHES)
def test_located_cells_contain_their_points(name):
    mesh = MESHES[name]
    grid, x = Grid.from_mesh(mesh), scattered(MESHES[name])
    index = grid.locate(x)
    assert_array_equal(index, [by_counting(a, row) for a, row in zip(grid.axes, x)])
    corners = mesh.p[:, mesh.t[:, grid.cells[tuple(index)]]]
    assert (corners.min(axis=1) - 1e-12 <= x).all() and (x <= corners.max(axis=1) + 1e-12).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_edges_and_corners_follow_the_rule_along_each_axis(dim):
    faces = AWKWARD["tenths"]
    mesh = {2: MeshQuad, 3: MeshHex}[dim].init_tensor(*[faces[:5]] * dim)
    around = np.sort(np.concatenate([faces[:5], np.nextafter(faces[1:5], 0), np.nextafter(faces[:4], 1)]))
    x = np.stack(np.meshgrid(*[around] * dim, indexing="ij")).reshape(dim, -1)
    assert_array_equal(Grid.from_mesh(mesh).locate(x), [by_counting(faces[:5], row) for row in x])


@pytest.mark.parametrize("name", ["line graded", "quad tensor", "hex refined shuffled"])
def test_a_point_is_found_in_the_same_cell_alone_and_among_others(name):
    grid, x = Grid.from_mesh(MESHES[name]), scattered(MESHES[name])
    together = grid.locate(np.tile(x, 30))              # more than one chunk
    assert_array_equal(together, np.tile(grid.locate(x), 30))
    alone = np.concatenate([grid.locate(x[:, p:p + 1]) for p in range(x.shape[1])], axis=1)
    assert_array_equal(alone, together[:, :x.shape[1]])


@pytest.mark.parametrize("bad", [np.nextafter(0, -1), np.nextafter(1, 2), -5.0, 1e300, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("name", ["line refined", "line graded", "quad refined", "quad refined shuffled"])
def test_points_outside_are_named_by_index_and_position(name, bad):
    mesh = MESHES[name]
    x = np.full((dim_of(mesh), 7), 0.5)
    x[-1, 3] = x[-1, 5] = bad
    with pytest.raises(OutsideGridError, match="outside the grid") as e:
        Grid.from_mesh(mesh).locate(x)
    assert "point 3 " in str(e.value) and repr(float(bad)) in str(e.value)
    assert "[0, 1]" in str(e.value) and "use a larger mesh" in str(e.value)
    assert isinstance(e.value, ValueError)


def test_occupied_cells_are_those_with_points():
    grid = Grid.from_mesh(MESHES["quad refined"])
    index = grid.locate(np.array([[0.1, 0.15, 0.9], [0.1, 0.2, 0.6]]))
    assert_array_equal(np.argwhere(grid.occupied(index)), [[0, 0], [3, 2]])


# The stencil.

def patch_of(grid, low=0.25, high=0.6, n=200, seed=2):
    """Points in a corner region of a grid, and small domains."""
    rng = np.random.default_rng(seed)
    box = np.array([[a[0], a[-1]] for a in grid.axes])
    x = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.uniform(low, high, (grid.dim, n))
    length = np.full_like(x, 0.6) * np.array([step.min() for step in grid.steps])[:, None]
    return x, length


def stencils(grid, x, length):
    index = grid.locate(x)
    sides = available_sides(grid.occupied(index))
    return {"linear": grid.linear(x, index), "gimp": grid.gimp(x, index, length), "cmpm": grid.cmpm(x, index, sides),
            "gimp clipped to the body": grid.gimp(x, index, length, "clip", sides)}


@pytest.mark.parametrize("low, high", [(0.25, 0.6), (0.7, 0.95), (0.6, 0.65)])
@pytest.mark.parametrize("name", ["line graded", "quad refined", "quad graded shuffled", "hex tensor"])
def test_a_window_round_the_body_gives_the_stencil_of_the_whole_grid(name, low, high):
    mesh = MESHES[name] if "hex" in name else MESHES[name].refined(1) if "refined" in name else MESHES[name]
    grid = Grid.from_mesh(mesh)
    x, length = patch_of(grid, low, high)
    length *= 0.1 if high > 0.9 else 1                  # ghost: domains must stay in the grid
    window = grid.window(grid.locate(x))
    assert window.nnodes <= grid.nnodes
    whole, part = stencils(grid, x, length), stencils(window, x, length)
    assert_array_equal(window.cells[tuple(window.locate(x))], grid.cells[tuple(grid.locate(x))])
    for kind in whole:
        for a, b in [(whole[kind].value(), part[kind].value()),
                     *zip(whole[kind].gradient(), part[kind].gradient())]:
            assert_array_equal(dense(window, part[kind], b, mesh.nvertices),
                               dense(grid, whole[kind], a, mesh.nvertices))


def test_a_window_holds_the_body_and_two_cells_more():
    grid = Grid.from_mesh(MeshQuad.init_tensor(axis(100), axis(100)))
    assert grid.window(grid.locate(np.array([[0.505, 0.515], [0.001, 0.001]]))).cells.shape == (6, 3)


@pytest.mark.parametrize("name", ["line graded", "quad graded", "hex graded"])
def test_pieces_of_a_stencil_are_those_of_the_whole(name):
    grid = Grid.from_mesh(MESHES[name])
    x, length = patch_of(grid)
    for stencil in stencils(grid, x, length).values():
        part = slice(37, 90)
        assert_array_equal(stencil.value(part), stencil.value()[:, part])
        assert_array_equal(stencil.gradient(part), stencil.gradient()[:, :, part])
        assert_array_equal(stencil.nodes(part), stencil.nodes()[:, part])


@pytest.mark.parametrize("name", ["line graded", "quad graded", "hex graded"])
def test_a_stencil_holds_one_factor_per_axis_and_nothing_else(name):
    grid = Grid.from_mesh(MESHES[name])
    x, length = patch_of(grid)
    for kind, width in {"linear": 2, "gimp": 3, "cmpm": 4}.items():
        stencil = stencils(grid, x, length)[kind]
        arrays = [a for a in vars(stencil).values() if isinstance(a, np.ndarray)]
        assert sum(a.size for a in arrays) == x.size * (2 * width + 1)
        assert stencil.w.dtype == np.float64 and stencil.base.dtype.kind == "i"
        assert sum(a.nbytes for a in arrays) <= 8 * x.size * (2 * width + 1)


def test_large_gimp_domains_see_four_nodes_per_axis():
    grid = Grid.from_mesh(MESHES["quad refined"])
    x = np.array([[0.5 - 0.1, 0.5 + 0.1], [0.4, 0.6]])
    assert grid.gimp(x, grid.locate(x), np.full((2, 2), 0.25)).w.shape.count(3) == 1
    wide = grid.gimp(x, grid.locate(x), np.full((2, 2), 0.45))
    assert wide.value().shape == (16, 2)
    assert_allclose(wide.value().sum(axis=0), 1, rtol=1e-14)


# Domains and edges of the grid.

def test_a_domain_beyond_the_neighbours_of_its_cell_is_refused():
    grid = Grid.from_mesh(MESHES["line refined"])       # cells of 1/8
    x = np.array([[0.3, 0.55]])
    with pytest.raises(ValueError, match=r"length: the domain of point 1 at \(0\.55\) is 0\.4 long along axis 0") as e:
        grid.gimp(x, grid.locate(x), np.array([[0.1, 0.4]]))
    assert "use smaller domains or larger cells" in str(e.value)


@pytest.mark.parametrize("edges", ["truncate", "clip"])
def test_a_domain_that_leaves_the_grid_is_refused_by_ghost_and_taken_by_the_others(edges):
    grid = Grid.from_mesh(MESHES["quad refined"])
    x = np.array([[0.5, 0.05], [0.5, 0.5]])
    index, length = grid.locate(x), np.full((2, 2), 0.2)
    with pytest.raises(OutsideGridError, match=r"domain of point 1 at \(0\.05, 0\.5\) leaves the grid") as e:
        grid.gimp(x, index, length)
    assert "spare layer" in str(e.value) and f"edges='{edges}'" in str(e.value)
    assert grid.gimp(x, index, length, edges).n == 2


def test_a_domain_that_ends_on_the_edge_of_the_grid_is_inside():
    grid = Grid.from_mesh(MeshLine(AWKWARD["tenths"]))
    half = np.array([0.05, 0.03, 0.02])
    x = np.concatenate([half, 1 - half])[None]
    grid.gimp(x, grid.locate(x), 2 * np.tile(half, 2)[None])


def test_unknown_edges_are_refused_and_the_known_ones_listed():
    grid = Grid.from_mesh(MESHES["line refined"])
    x = np.array([[0.5]])
    with pytest.raises(ValueError, match="edges: got 'mirror'") as e:
        grid.gimp(x, grid.locate(x), np.array([[0.1]]), edges="mirror")
    assert all(name in str(e.value) for name in ("ghost", "truncate", "clip"))


# Which sides a patch may reach into.

def plainly(occupied, active=None):
    """The rule of design.md 5, one cell at a time."""
    def usable(cell):
        if min(cell) < 0 or any(c >= size for c, size in zip(cell, occupied.shape)):
            return False
        corners = itertools.product(*[(c, c + 1) for c in cell])
        return occupied[cell] and (active is None or all(active[corner] for corner in corners))

    def moved(cell, offset):
        return tuple(c + o for c, o in zip(cell, offset))

    dim = occupied.ndim
    sides = np.zeros((2, dim, *occupied.shape), dtype=bool)
    for cell in np.ndindex(occupied.shape):
        free = {(side, k): usable(moved(cell, [(2 * side - 1) * (j == k) for j in range(dim)]))
                for side in (0, 1) for k in range(dim)}
        dropped = set()
        for offset in itertools.product((-1, 0, 1), repeat=dim):
            involved = [(int(o > 0), k) for k, o in enumerate(offset) if o]
            if len(involved) > 1 and all(free[i] for i in involved) and not usable(moved(cell, offset)):
                dropped |= set(involved)
        for (side, k), there in free.items():
            sides[(side, k, *cell)] = there and (side, k) not in dropped
    return sides


L = np.zeros((4, 4), dtype=bool)
L[:2] = L[:, :2] = True


def bodies(dim, n=12):
    rng = np.random.default_rng(dim)
    shape = {1: (9,), 2: (6, 5), 3: (4, 3, 5)}[dim]
    yield np.ones(shape, dtype=bool)
    if dim == 2:
        yield L
    if dim == 3:
        yield L[:, :, None] & np.ones(3, dtype=bool)
        yield ~np.pad(np.ones((1, 1, 1), dtype=bool), [(2, 1)] * 3)          # a cube without one corner cell inside
    for _ in range(n):
        yield rng.random(shape) < 0.75


def with_active(dim):
    rng = np.random.default_rng(10 + dim)
    for occupied in bodies(dim):
        yield occupied, None
        yield occupied, rng.random([size + 1 for size in occupied.shape]) < 0.93


def test_at_the_corner_of_an_l_the_patch_drops_both_sides_of_the_missing_cell():
    low_x, low_y = available_sides(L)[0, :, 1, 1]
    high_x, high_y = available_sides(L)[1, :, 1, 1]
    assert low_x and low_y and not high_x and not high_y
    assert available_sides(L)[:, :, 2, 1].tolist() == [[True, True], [True, False]]     # below it: only up is missing


def test_three_cells_round_a_corner_are_left_with_what_is_in_line():
    occupied = np.array([[True, True], [True, False]])
    assert not available_sides(occupied)[:, :, 0, 0].any()
    assert available_sides(occupied)[:, :, 1, 0].tolist() == [[True, False], [False, False]]


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_available_sides_are_the_rule_said_plainly(dim):
    for occupied, active in with_active(dim):
        assert_array_equal(available_sides(occupied, active), plainly(occupied, active))


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_patch_reads_only_active_nodes_of_occupied_cells(dim):
    for occupied, active in with_active(dim):
        sides = available_sides(occupied, active)
        for cell in np.argwhere(occupied):
            reach = [range(c - sides[(0, k, *cell)], c + sides[(1, k, *cell)] + 1) for k, c in enumerate(cell)]
            for other in set(itertools.product(*reach)) - {tuple(cell)}:
                assert occupied[other]
                assert active is None or active[tuple(slice(c, c + 2) for c in other)].all()


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_mirrors_commute_with_the_rule(dim):
    for occupied, active in with_active(dim):
        for k in range(dim):
            mirrored = available_sides(np.flip(occupied, k), None if active is None else np.flip(active, k))
            expected = np.flip(available_sides(occupied, active), k + 2)
            expected[:, k] = expected[::-1, k].copy()
            assert_array_equal(mirrored, expected)


@pytest.mark.parametrize("dim", [2, 3])
def test_axis_swaps_commute_with_the_rule(dim):
    for occupied, active in with_active(dim):
        for order in itertools.permutations(range(dim)):
            swapped = available_sides(occupied.transpose(order), None if active is None else active.transpose(order))
            expected = available_sides(occupied, active)[:, list(order)].transpose(0, 1, *[2 + k for k in order])
            assert_array_equal(swapped, expected)


def test_all_nodes_active_is_the_same_as_not_saying():
    assert_array_equal(available_sides(L, np.ones((5, 5), dtype=bool)), available_sides(L))


def test_an_inactive_node_closes_all_cells_round_it():
    active = np.ones((6, 6), dtype=bool)
    active[2, 2] = False
    sides = available_sides(np.ones((5, 5), dtype=bool), active)
    assert not sides[1, 0, 0, 1] and not sides[1, 0, 0, 2]          # from the left into cells (1, 1) and (1, 2)
    assert not sides[0, 1, 1, 3]                                    # from above into cell (1, 2)
    assert sides[0, 0, 4, 4] and sides[1, 0, 3, 3]


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_asking_for_sides_does_not_change_the_masks(dim):
    for occupied, active in with_active(dim):
        kept = occupied.copy(), None if active is None else active.copy()
        available_sides(occupied, active)
        assert_array_equal(occupied, kept[0])
        assert active is None or (active == kept[1]).all()
