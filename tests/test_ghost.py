"""The ghost penalty acts on jumps of the normal gradient at cut cells, and on nothing else."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import MAKE, every_method

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    Particles,
    axisymmetric,
    implicit_steps,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.ghost import cut_cells, ghost_stiffness, young
from skfem_mpm.grid import Grid
from skfem_mpm.scenes import cylinder
from skfem_mpm.support import Support

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import conditioning  # noqa: E402

LAW = LinearElastic(E=100.0, nu=0.3)
CASES = [(1, uniaxial), (1, axisymmetric), (2, plane_strain), (2, axisymmetric), (3, solid)]
every_case = pytest.mark.parametrize("dim, kinematics", CASES, ids=lambda value: getattr(value, "name", value))


def tensor_mesh(*axes):
    return MAKE[len(axes)](*axes)


def ragged(dim, kinematics, method="mpm", scale=1.0, offset=0.0):
    """A body with a bite out of a corner, on cells of several widths; mesh and support."""
    axes = [offset + scale * np.cumsum([1.0, *[(1.0, 0.7, 1.2)[(i + k) % 3] for i in range(7 - dim)]])
            for k in range(dim)]
    mesh = tensor_mesh(*axes)
    middle = [np.median(axis) for axis in axes]
    points = Particles.fill(mesh, kinematics, where=lambda x: (
        np.all([(row > axis[1]) & (row < axis[-2]) for row, axis in zip(x, axes)], axis=0)
        & ((dim == 1) | np.any([row < half for row, half in zip(x, middle)], axis=0))))
    return mesh, Support(mesh, points, METHODS[method], "ghost", [])


def matrix_of(mesh, support, factor=1.0):
    return ghost_stiffness(mesh, support, support.occupied, factor)


def components(support, nodal):
    """Nodal vectors ``(dim, nnodes)`` in the order of rows and columns."""
    return nodal[:, support.known].T.ravel()


def places(support):
    return np.stack(np.meshgrid(*support.grid.axes, indexing="ij")).reshape(support.grid.dim, -1)


@every_case
@pytest.mark.parametrize("method", ["mpm", "gimp"])
def test_affine_displacement_makes_no_force(dim, kinematics, method):
    mesh, support = ragged(dim, kinematics, method)
    random = np.random.default_rng(dim)
    x = places(support)
    matrix = matrix_of(mesh, support)
    affine = components(support, random.normal(size=(dim, dim)) @ x + random.normal(size=(dim, 1)))
    assert abs(matrix @ affine).max() < 1e-12 * abs(matrix).max() * abs(affine).max()
    assert abs(matrix @ components(support, x ** 2)).max() > 0.1 * abs(matrix).max()


@every_case
def test_it_is_symmetric_and_never_releases_energy(dim, kinematics):
    dense = matrix_of(*ragged(dim, kinematics)).toarray()
    assert_allclose(dense, dense.T, atol=1e-14 * abs(dense).max())
    size = np.linalg.eigvalsh(dense)
    assert size[0] > -1e-13 * size[-1] and size[-1] > 0


@pytest.mark.parametrize("kinematics", [plane_strain, axisymmetric], ids=lambda value: value.name)
@pytest.mark.parametrize("normal", [0, 1])
def test_two_cells_by_hand(kinematics, normal):
    """Normal gradients are linear along the face: the mean of their squares is (a a + a b + b b) / 3."""
    across, along = np.array([2.0, 2.5, 3.3]), np.array([1.0, 1.6])
    mesh = tensor_mesh(*((across, along) if normal == 0 else (along, across)))
    support = Support(mesh, Particles.fill(mesh, kinematics), METHODS["mpm"], "ghost", [])
    u = np.random.default_rng(1).normal(size=(2, 6))
    table = u.reshape((2, 3, 2) if normal == 0 else (2, 2, 3))
    slopes = np.diff(table, axis=1 + normal) / np.diff(across).reshape((-1, 1) if normal == 0 else (1, -1))
    first, last = np.squeeze(np.diff(slopes, axis=1 + normal), axis=1 + normal).T      # jumps at the ends of the face
    mean = first @ first + first @ last + last @ last
    if kinematics.hoop and normal == 0:
        mean *= across[1]
    elif kinematics.hoop:       # the mean of r (a (1 - t) + b t)^2 with r = along[0] + t length
        weights = [first @ first / 4, first @ last / 2, 3 * last @ last / 4]
        mean = along[0] * mean + 0.6 * sum(weights)
    expected = 7.0 * 0.65 * 0.6 * mean / 3
    unknowns = components(support, u)
    assert_allclose(unknowns @ (matrix_of(mesh, support, 7.0) @ unknowns), expected, rtol=1e-12)


@pytest.mark.parametrize("dim, kinematics", [(1, uniaxial), (2, plane_strain), (3, solid)])
def test_it_scales_as_a_stiffness(dim, kinematics):
    """With lengths as E h^(d - 2), like any stiffness; and with its factor."""
    one, two = (matrix_of(*ragged(dim, kinematics, scale=scale)).toarray() for scale in (1.0, 2.0))
    assert_allclose(two, 2.0 ** (dim - 2) * one, atol=1e-13 * abs(one).max())
    assert_allclose(matrix_of(*ragged(dim, kinematics), factor=3.0).toarray(), 3 * one, rtol=1e-14)


@pytest.mark.parametrize("dim, kinematics", [(1, uniaxial), (2, plane_strain), (3, solid)])
def test_far_from_the_origin_it_is_the_same(dim, kinematics):
    near, far = (matrix_of(*ragged(dim, kinematics, offset=offset)).toarray() for offset in (0.0, 1e6))
    assert_allclose(far, near, rtol=0, atol=1e-8 * abs(near).max())


def test_a_scene_twice_as_long_or_stiff_moves_alike():
    """With ghost penalty and weight: lengths and stiffness times two, gravity as it was, displacement times two."""
    def moved(length, stiffness):
        axes = [length * np.arange(-1.0, 7.0)] * 2
        mesh = tensor_mesh(*axes)
        body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 4 * length)).all(axis=0))
        body = replace(body, x=body.x + length * np.array([[0.3], [0.2]]))
        run = implicit_steps(mesh, body, LinearElastic(E=stiffness, nu=0.3), [FixedPlane(1, 0.0, -1, (0, 1))], steps=1,
                             gravity=(1.0, -1.0), ghost=0.5)
        return next(run).particles.x - body.x

    one = moved(1.0, 100.0)
    assert_allclose(moved(2.0, 200.0), 2 * one, rtol=1e-9)
    assert abs(one).max() > 0.05


# Which faces count.

def test_cells_behind_planes_are_full_and_beyond_the_mesh_are_empty():
    mesh = tensor_mesh(np.arange(5.0), np.arange(6.0))
    grid, full = Grid.from_mesh(mesh), np.ones((4, 5), dtype=bool)
    around = [FixedPlane(0, 0.0, -1), FixedPlane(0, 4.0, 1), FixedPlane(1, 0.0, -1), FixedPlane(1, 5.0, 1)]
    assert not cut_cells(grid, full, around).any()
    top_free = cut_cells(grid, full, around[:3])
    assert top_free[:, -1].all() and not top_free[:, :-1].any()
    assert cut_cells(grid, full, []).sum() == 20 - 6
    holed = full.copy()
    holed[2, 2] = False
    assert_array_equal(np.argwhere(cut_cells(grid, holed, around)),
                       [[i, j] for i in (1, 2, 3) for j in (1, 2, 3) if (i, j) != (2, 2)])


def test_faces_between_whole_cells_are_left_alone():
    """A bar of nine cells: only the two faces at either end touch a cut cell."""
    mesh = tensor_mesh(np.arange(-1.0, 11.0))
    body = Particles.fill(mesh, uniaxial, where=lambda x: (x[0] > 0) & (x[0] < 9))
    support = Support(mesh, body, METHODS["mpm"], "ghost", [])
    dense = matrix_of(mesh, support).toarray()
    assert_array_equal(np.flatnonzero(dense.any(axis=0)), [0, 1, 2, 7, 8, 9])
    planes = [FixedPlane(0, 0.0, -1), FixedPlane(0, 9.0, 1)]
    held = Support(mesh, body, METHODS["mpm"], "ghost", planes)
    assert matrix_of(mesh, held).nnz == 0


def test_cells_in_play_without_points_count_once_their_nodes_do():
    """A cell between two points' cells: in play it has two faces; out of play, or with a node unknown, none."""
    mesh = tensor_mesh(np.arange(4.0))
    pair = Particles.fill(mesh, uniaxial, where=lambda x: (x[0] < 1) | (x[0] > 2))
    support = Support(mesh, pair, METHODS["mpm"], "ghost", [])
    assert ghost_stiffness(mesh, support, support.occupied, 1.0).nnz == 0
    assert ghost_stiffness(mesh, support, np.ones(3, dtype=bool), 1.0).nnz == 14
    known = ["grid", "planes", "number", "transfer", "particles"]
    partly = SimpleNamespace(**{name: getattr(support, name) for name in known}, sound=np.array([True, True, False]))
    assert ghost_stiffness(mesh, partly, np.ones(3, dtype=bool), 1.0).nnz == 9


def test_empty_mesh_costs_nothing():
    """The same matrix, and the faces of the whole mesh are never looked up."""
    few, many = (tensor_mesh(np.arange(-1.0, size), np.arange(-1.0, size)) for size in (7, 300))
    body = Particles.fill(few, plane_strain, where=lambda x: ((x > 0) & (x < 4)).all(axis=0))
    small, large = (matrix_of(mesh, Support(mesh, body, METHODS["gimp"], "ghost", [])) for mesh in (few, many))
    assert_array_equal(small.toarray(), large.toarray())
    made = set(vars(many))
    _ = many.t2f
    assert set(vars(many)) - made, "this mesh keeps its faces elsewhere; look there"


# In load steps.

@every_case
@every_method
def test_the_patch_test_stays_exact(method, dim, kinematics):
    """A box stretched by one per cent: the stress without ghost penalty is uniform, and with it the same."""
    ring = kinematics is axisymmetric
    start = 1.0 if ring else 0.0
    axes = [(start if k == 0 else 0.0) + np.arange(-1, 6) / 4 for k in range(dim)]
    mesh = tensor_mesh(*axes)
    low = np.array([[start], [0.0], [0.0]])[:dim]
    body = Particles.fill(mesh, kinematics, rule="gauss" if method == "cmpm-c" else "quarter",
                          where=lambda x: ((x > low) & (x < low + 1)).all(axis=0))
    held = [] if ring else [FixedPlane(0, 0.0, -1, name="0")]
    held += [FixedPlane(k, 0.0, -1, name=str(k)) for k in range(1, dim)]
    for at in ([1.0, 2.0] if ring else [1.0]):
        on = np.isclose(mesh.p[0], at) & ((mesh.p[1:] > -1e-9) & (mesh.p[1:] < 1 + 1e-9)).all(axis=0)
        held.append(Wall(mesh.p[:, on], [0.01 * at] + [None] * (dim - 1), name=f"wall {at}"))
    state = next(implicit_steps(mesh, body, LAW, held, steps=1, method=method, floor=0.0, ghost=0.7))
    sigma, u = state.particles.sigma, state.particles.x - body.x
    assert_allclose(sigma, np.repeat(sigma.mean(axis=1, keepdims=True), body.n, axis=1), atol=1e-10 * abs(sigma).max())
    assert_allclose(u[0], 0.01 * body.x[0], atol=1e-12)


@pytest.mark.parametrize("scheme", ["equilibrated", "incremental"])
def test_it_acts_in_load_steps_and_newton_knows_it(scheme):
    def run(ghost):
        return next(cylinder(20, dim=2, offset=0.3).run("gimp", steps=1, ghost=ghost, scheme=scheme))

    bare, held = run(0.0), run(1.0)
    change = abs(held.particles.sigma - bare.particles.sigma).max() / abs(bare.particles.sigma).max()
    assert 1e-4 < change < 0.2
    assert len(held.residuals) <= len(bare.residuals) + 1


# What it is for.

@pytest.mark.parametrize("body, variant", [("block", name) for name in conditioning.VARIANTS] + [("turned", "cmpm")])
def test_small_cuts_do_not_spoil_the_stiffness(body, variant):
    """However small the cut; on the grid lines mpm has 55, and 33 when scaled by the diagonal."""
    rows = list(conditioning.sweep(body, variant, [(1e-6, 0.1)], deltas=[1e-6, 1e-3, 0.1]))
    assert max(row["condition"] for row in rows) < 600 and max(row["scaled"] for row in rows) < 100


def test_without_it_they_do():
    bare = list(conditioning.sweep("turned", "cmpm", [(1e-6, 0.0)], deltas=[1e-6]))
    assert max(row["scaled"] for row in bare) > 1e4


def test_a_sliding_block_needs_it():
    """Turned against the grid: most methods find no equilibrium without it; the error falls as the penalty grows."""
    def error(ghost):
        return float(conditioning.sliding("gimp", cells=6, steps=4, ghost=ghost).split("/")[1])

    assert error(1.0) < error(0.1) < error(0.0)


@pytest.mark.parametrize("ghost", [-0.1, np.nan, np.inf, None, "a"])
def test_bad_input_is_refused(ghost):
    scene = cylinder(10, dim=1)
    with pytest.raises(ValueError, match="ghost: got"):
        scene.run(steps=1, ghost=ghost)


def test_the_modulus_is_youngs_and_stays_bounded():
    def modulus(law, dim, kinematics):
        zero, places = np.zeros((kinematics.ncomp, 1)), kinematics.rows(dim)
        return young(law.tangent(zero, zero, np.zeros((0, 1)), places)[:, :, 0], places)

    for law in (LAW, Hencky(E=100.0, nu=0.3), LinearElastic(E=100.0, nu=0.4999)):
        for case in CASES[1:]:
            assert_allclose(modulus(law, *case), 100.0)
    assert_allclose(modulus(LAW, 1, uniaxial), LAW.lam + 2 * LAW.G)
    assert young(np.zeros((4, 4)), plane_strain.rows(2)) == 0


def test_a_line_of_radii_is_a_row_of_quads():
    """The same scene in one and two dimensions has the same penalty."""
    line, row = (cylinder(10, dim=dim, offset=0.3) for dim in (1, 2))
    partner = np.abs(row.particles.x[0][:, None] - line.particles.x[0]).argmin(axis=1)
    one, two = (next(scene.run("gc", steps=1, ghost=0.5)).particles.sigma for scene in (line, row))
    assert_allclose(two, one[:, partner], atol=1e-10 * np.abs(one).max())
