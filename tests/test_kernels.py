"""The compiled stencils against the grid's, and the compiled nodes against numpy's."""

import numpy as np
import pytest
from skfem import MeshHex, MeshLine, MeshQuad

from skfem_mpm.grid import Grid, available_sides

pytest.importorskip("numba")

from skfem_mpm.explicit.window import Window  # noqa: E402
from skfem_mpm.kernels import nodes as at_nodes  # noqa: E402
from skfem_mpm.kernels import stencil as kernels  # noqa: E402
from skfem_mpm.kernels.axes import axes_arrays, cmpm_table  # noqa: E402
from skfem_mpm.kernels.options import CHUNKS  # noqa: E402

EQUAL = np.linspace(-1.0, 2.0, 13)
GRADED = np.concatenate([EQUAL[:5], 0.0 + np.cumsum([0.2, 0.25, 0.3, 0.25, 0.2])])


def grid_of(dim, graded):
    axes = [GRADED if graded and k == 0 else EQUAL for k in range(dim)]
    return Grid.from_mesh({1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[dim](*axes))


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
        self.cell, self.bands = np.empty((n, grid.dim), dtype=np.int32), np.empty((CHUNKS, 2), dtype=np.int64)
        self.occupied = np.zeros(self.window.nnodes, dtype=np.uint8)
        kernels.locate(self.x, *self.axes, self.window.frame, 1, self.cell, self.bands, self.occupied)
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
    kernels.fill_linear(points.x, *points.axes[:2], points.cell, w)
    points.check(points.grid.linear(points.x, points.index), points.cell, w)


def test_cells_and_linear_functions_in_one_go():
    points = Points(grid_of(2, False))
    cell, occupied, bands, w = np.empty_like(points.cell), points.occupied * 0, points.bands * 0, points.room(2)
    kernels.place_linear(points.x, *points.axes, points.window.frame, cell, bands, occupied, w)
    assert (cell == points.cell).all() and (occupied == points.occupied).all()
    stride = points.window.frame[1, 0]
    assert (bands[:, 0] == points.bands[:, 0] + stride).all() and (bands[:, 1] == points.bands[:, 1] - stride).all()
    points.check(points.grid.linear(points.x, points.index), cell, w)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_gimp_of_narrow_domains(share):
    points = Points(grid_of(2, False))
    smallest = min(step.min() for step in points.grid.steps)
    length = np.full_like(points.x, share * smallest)
    w = points.room(3)
    kernels.place_gimp(points.x, length, *points.axes[:2], points.window.frame, points.base, points.bands, w)
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
    kernels.fill_gimp_masked(points.x, length, knots, inverse, sizes, points.cell, window.frame, code, points.base, w)
    dense = grid._stencil(points.x, points.index, 4,
                          lambda k, part, knots: _gimp(points, sides, length, k, part, knots))
    points.check(dense, points.base, w)
    kernels.fill_cmpm(points.x, knots, inverse, sizes, points.cell, window.frame, code, cmpm_table(grid.axes),
                      points.base, w)
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
    usable, sides = (np.empty(window.nnodes, dtype=np.uint8) for _ in range(2))
    at_nodes.available_sides(points.occupied, active.astype(np.uint8), window.corners, window.faces, window.diagonals,
                             usable, sides)
    part = grid.window(points.index)
    local = part.locate(points.x)
    node = window.frame[1] @ (points.index - window.frame[0][:, None])
    first = np.array([np.argmin(abs(full - axis[0])) for full, axis in zip(grid.axes, part.axes)])
    ids = window.frame[1] @ (np.indices(part.vertices.shape).reshape(grid.dim, -1) + (first - window.frame[0])[:, None])
    expected = available_sides(part.occupied(local), active[ids].reshape(part.vertices.shape))
    for side in (0, 1):
        for k in range(grid.dim):
            assert ((sides[node] >> (2 * k + side) & 1) == expected[side, k][tuple(local)]).all()
