"""The compiled stencils against the grid's, and the compiled nodes against numpy's."""

import numpy as np
import pytest
from shared import MAKE

from skfem_mpm.grid import Grid, available_sides

pytest.importorskip("numba")

from skfem_mpm.explicit.window import Window  # noqa: E402
from skfem_mpm.kernels import chunks, transfer2  # noqa: E402
from skfem_mpm.kernels import nodes as at_nodes  # noqa: E402
from skfem_mpm.kernels import stencil as kernels  # noqa: E402
from skfem_mpm.kernels.axes import axes_arrays, cmpm_table  # noqa: E402
from skfem_mpm.kernels.crew import Crew  # noqa: E402
from skfem_mpm.kernels.options import CHUNKS, TILE  # noqa: E402

EQUAL = np.linspace(-1.0, 2.0, 13)
GRADED = np.concatenate([EQUAL[:5], 0.0 + np.cumsum([0.2, 0.25, 0.3, 0.25, 0.2])])


def grid_of(dim, graded):
    axes = [GRADED if graded and k == 0 else EQUAL for k in range(dim)]
    return Grid.from_mesh(MAKE[dim](*axes))


class Points:
    """Random points, some of them on faces, and what the kernels need of them."""

    def __init__(self, grid, n=200):
        rng = np.random.default_rng(1)
        self.grid, self.x = grid, rng.uniform(-0.5, 0.9, (grid.dim, n))
        self.x[0, :5] = grid.axes[0][3:8]
        self.x[0, :5] = np.clip(self.x[0, :5], -0.5, 0.9)
        self.index = grid.locate(self.x)
        self.axes = axes_arrays(grid.axes)
        self.window = Window(grid, self.index.min(axis=1), self.index.max(axis=1), (), "ghost")
        self.cell = np.empty((n, grid.dim), dtype=np.int32)
        self.occupied = np.zeros(self.window.nnodes, dtype=np.uint8)
        kernels.locate(self.x, *self.axes, self.cell, 0, CHUNKS)
        kernels.mark(self.cell, self.window.frame, self.occupied, 0, CHUNKS)
        self.base = np.empty_like(self.cell)

    def room(self, width):
        return np.empty((self.x.shape[1], self.grid.dim, 2, width))

    def check(self, expected, base, w):
        got = w.transpose(1, 2, 3, 0)
        shift = base.T - expected.base
        assert (shift == 0).all()
        scale = abs(expected.w).max(axis=(0, 2, 3))[None, :, None, None]
        assert (abs(got - expected.w) <= 1e-13 * scale).all()


@pytest.fixture(params=[(1, False), (2, True), (3, False)], ids=["line", "graded quads", "hexes"])
def points(request):
    return Points(grid_of(*request.param))


def test_cells_and_linear_functions(points):
    assert (points.cell.T == points.index).all()
    w = points.room(2)
    kernels.fill_linear(points.x, *points.axes[:2], points.cell, w, 0, CHUNKS)
    points.check(points.grid.linear(points.x, points.index), points.cell, w)


def test_cells_and_linear_functions_in_one_go():
    points = Points(grid_of(2, False))
    cell, w = np.empty_like(points.cell), points.room(2)
    kernels.place_linear(points.x, *points.axes, cell, w, 0, CHUNKS)
    assert (cell == points.cell).all()
    points.check(points.grid.linear(points.x, points.index), cell, w)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_gimp_of_narrow_domains(share):
    points = Points(grid_of(2, False))
    smallest = min(step.min() for step in points.grid.steps)
    length = np.full_like(points.x, share * smallest)
    w = points.room(3)
    kernels.place_gimp(points.x, length, 1, *points.axes[:2], points.base, w, 0, CHUNKS)
    expected = points.grid.gimp(points.x, points.index, length)
    if expected.w.shape[2] == 3:
        points.check(expected, points.base, w)


@pytest.mark.parametrize("masked", [False, True])
def test_gimp_and_cmpm_with_masks(points, masked):
    grid, window = points.grid, points.window
    occupied = grid.occupied(points.index)
    occupied[(slice(3, 5),) * grid.dim] = False
    sides = available_sides(occupied) if masked else available_sides(np.ones_like(occupied))
    code = np.zeros(window.nnodes, dtype=np.uint8)
    node = window.frame[1] @ (points.index - window.frame[0][:, None])
    for side in (0, 1):
        for k in range(grid.dim):
            code[node] |= (sides[side, k][tuple(points.index)] << (2 * k + side)).astype(np.uint8)
    w, length = points.room(4), np.full_like(points.x, 0.2)
    knots, inverse, sizes = points.axes
    kernels.fill_gimp_masked(points.x, length, knots, inverse, sizes, points.cell, window.frame, code, points.base, w,
                             0, CHUNKS)
    dense = grid._stencil(points.x, points.index, 4,
                          lambda k, part, knots: _gimp(points, sides, length, k, part, knots))
    points.check(dense, points.base, w)
    kernels.fill_cmpm(points.x, knots, inverse, sizes, points.cell, window.frame, code, cmpm_table(grid.axes),
                      points.base, w, 0, CHUNKS)
    points.check(grid.cmpm(points.x, points.index, sides), points.base, w)


def _gimp(points, sides, length, k, part, knots):
    from skfem_mpm import shapes

    left, right = (sides[side, k][tuple(points.index[:, part])] for side in (0, 1))
    return shapes.gimp(points.x[k, part], length[k, part] / 2, knots, left, right)


def test_available_sides(points):
    """Occupied cells and active nodes at random."""
    grid, window = points.grid, points.window
    rng = np.random.default_rng(2)
    active = rng.random(window.nnodes) < 0.9
    usable, dropped, sides = (np.empty(window.nnodes, dtype=np.uint8) for _ in range(3))
    at_nodes.available_sides(points.occupied, active.astype(np.uint8), window.corners, window.faces, window.diagonals,
                             usable, dropped, sides)
    part = grid.window(points.index)
    local = part.locate(points.x)
    node = window.frame[1] @ (points.index - window.frame[0][:, None])
    first = np.array([np.argmin(abs(full - axis[0])) for full, axis in zip(grid.axes, part.axes)])
    ids = window.frame[1] @ (np.indices(part.vertices.shape).reshape(grid.dim, -1) + (first - window.frame[0])[:, None])
    expected = available_sides(part.occupied(local), active[ids].reshape(part.vertices.shape))
    for side in (0, 1):
        for k in range(grid.dim):
            assert ((sides[node] >> (2 * k + side) & 1) == expected[side, k][tuple(local)]).all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_chunks_sum_up_to_the_same_whole_for_any_crew(threads):
    """Chunks of unsorted points overlap, and some are empty; a node out of reach gets zero."""
    points = Points(grid_of(2, False), n=3000)
    w, mass, velocity = points.room(2), np.ones(3000), np.random.default_rng(3).normal(size=(2, 3000))
    kernels.place_linear(points.x, *points.axes, points.cell, w, 0, CHUNKS)
    rows = np.array([[low, high] for low, high in _touched(points.cell[:, 0])])
    window, crew = points.window, Crew(threads)
    out = np.full((window.nnodes, 3), np.nan)
    copies = np.full((CHUNKS if threads > 1 else 1, window.nnodes, 3), np.nan)
    crew(transfer2.p2g_mass, points.cell, w, mass, velocity, window.frame, out, copies, rows, (0, 0))
    if threads > 1:
        crew(chunks.sum_bands, window.frame, copies, rows, out)
    linear = points.grid.linear(points.x, points.index)
    assert np.isclose(out.sum(axis=0), [3000, *velocity.sum(axis=1)], rtol=1e-12).all()
    place = window.frame[1] @ (np.indices(linear.shape).reshape(2, -1) - window.frame[0][:, None])
    inside = (place >= 0) & (place < window.nnodes)
    expected = linear.to_nodes(velocity[0])
    touched = abs(linear.to_nodes(mass)) > 0
    assert inside[touched].all() and np.isclose(out[place[touched], 1], expected[touched], atol=1e-12).all()


def _touched(first):
    for c in range(CHUNKS):
        tiles = -(-len(first) // TILE)
        part = first[tiles * c // CHUNKS * TILE:tiles * (c + 1) // CHUNKS * TILE]
        yield (part.min(), part.max() + 2) if len(part) else (first.min(), first.min())
