"""Integration weights mend volumes where they should, move smoothly where they claim to, and never touch mass."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import ELEMENT
from skfem import (
    CellBasis,
    ElementQuad1,
    ElementTriP1,
    Functional,
    LinearForm,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshTri,
)
from skfem.models.poisson import laplace, mass

from skfem_mpm import (
    CMPMBasis,
    GIMPBasis,
    ParticleBasis,
    Particles,
    axisymmetric,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.grid import Grid
from skfem_mpm.weights import WEIGHTS, weights


def axis(count, grading=1.0, low=0.0, high=1.0):
    return low + (high - low) * np.linspace(0, 1, count + 1) ** grading


BODIES = {
    "bar": (MeshLine(axis(9)), uniaxial),
    "rings on a line": (MeshLine(axis(9, 1.3, 1, 3)), axisymmetric),
    "plane": (MeshQuad.init_tensor(axis(7, 1.2), axis(6)), plane_strain),
    "ring": (MeshQuad.init_tensor(axis(7, 1.2, 1, 3), axis(6)), axisymmetric),
    "ring of one layer": (MeshQuad.init_tensor(axis(9, low=1, high=3), axis(1)), axisymmetric),
    "solid": (MeshHex.init_tensor(axis(5), axis(4), axis(4)), solid),
}


@pytest.fixture(params=BODIES)
def case(request):
    """A mesh and points that have moved at random, in part of it: cells hold too many, too few or none."""
    mesh, kinematics = BODIES[request.param]
    points = Particles.fill(mesh, kinematics, density=3.0, where=lambda x: x[0] < 0.8 * mesh.p[0].max())
    rng = np.random.default_rng(0)
    x = points.x + 0.3 * points.length * rng.uniform(-1, 1, points.x.shape)
    low, high = mesh.p.min(axis=1, keepdims=True), mesh.p.max(axis=1, keepdims=True)
    return mesh, replace(points, x=np.clip(x, low + points.length / 2, high - points.length / 2))


def call(name, mesh, points, length=None):
    grid = Grid.from_mesh(mesh)
    return weights(name, grid, grid.locate(points.x), points.x, points.volume, points.kinematics.hoop,
                   points.length if length is None else length)


def volumes(mesh, kinematics):
    """scikit-fem's volume of every cell, per radian in axial symmetry."""
    return Functional(lambda w: w.x[0] if kinematics.hoop else 1 + 0 * w.x[0]).elemental(CellBasis(mesh, mesh.elem()))


def hosts(mesh, points):
    return ParticleBasis(mesh, ELEMENT[mesh.dim()](), points).tind


def interior_cells(mesh, points):
    """Occupied cells all of whose face neighbours are, by scikit-fem's facets; beyond the mesh none is missed."""
    occupied = np.isin(np.arange(mesh.nelements), hosts(mesh, points))
    inside = occupied.copy()
    for first, second in mesh.f2t.T:
        if second >= 0:
            inside[first] &= occupied[second]
            inside[second] &= occupied[first]
    return inside


# What they sum to.

def test_one_is_one(case):
    assert (call("one", *case) == 1).all()


def test_eq10_gives_every_cell_its_volume(case):
    mesh, points = case
    cells = hosts(mesh, points)
    sums = np.bincount(cells, call("eq10", *case) * points.volume, mesh.nelements)
    held = np.unique(cells)
    assert len(held) < mesh.nelements
    assert_allclose(sums[held], volumes(mesh, points.kinematics)[held], rtol=1e-13)


def test_eq10_is_the_same_for_all_points_of_a_cell(case):
    mesh, points = case
    w, cells = call("eq10", *case), hosts(mesh, points)
    for cell in np.unique(cells):
        assert np.ptp(w[cells == cell]) == 0


def test_interior_gives_interior_cells_their_volume_and_leaves_the_others(case):
    mesh, points = case
    cells, inside = hosts(mesh, points), interior_cells(mesh, points)
    w = call("interior", *case)
    assert inside.any() and not inside[cells].all()
    sums = np.bincount(cells, w * points.volume, mesh.nelements)
    assert_allclose(sums[inside], volumes(mesh, points.kinematics)[inside], rtol=1e-13)
    assert (w[~inside[cells]] == 1).all()


def overlaps(mesh, points):
    """Share of each domain in each cell, by clipping boxes; what is beyond the mesh counts to the nearest cell."""
    grid = Grid.from_mesh(mesh)
    shares = []
    for a, x, length in zip(grid.axes, points.x, points.length):
        faces = a.copy()
        faces[0], faces[-1] = -np.inf, np.inf
        low, high = np.maximum(faces[:-1, None], x - length / 2), np.minimum(faces[1:, None], x + length / 2)
        shares.append(np.maximum(high - low, 0) / length)
    table = shares[0]
    for share in shares[1:]:
        table = (table[:, None] * share).reshape(-1, points.n)
    by_cell = np.empty_like(table)
    by_cell[grid.cells.ravel()] = table
    return by_cell


def test_overlap_gives_interior_cells_their_volume_by_the_parts_of_domains_in_them(case):
    mesh, points = case
    share, inside = overlaps(mesh, points), interior_cells(mesh, points)
    held = share @ points.volume
    factor = np.where(inside, volumes(mesh, points.kinematics) / np.where(inside, held, 1), 1)
    assert_allclose(call("overlap", *case), factor @ share, rtol=1e-12)
    total = volumes(mesh, points.kinematics)[inside].sum() + held[~inside].sum()
    assert_allclose(call("overlap", *case) @ points.volume, total, rtol=1e-13)


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("body", BODIES)
def test_a_body_that_fills_its_cells_needs_no_weights(body, name):
    mesh, kinematics = BODIES[body]
    points = Particles.fill(mesh, kinematics)
    assert_allclose(call(name, mesh, points), 1, rtol=0, atol=1e-13)


# What happens when a point crosses a face.

def crossing(shift):
    """A full body, one point of which has moved across a face at x = 0.5 by ``shift`` beyond it."""
    mesh = MeshQuad.init_tensor(axis(8), axis(8))
    points = Particles.fill(mesh, plane_strain)
    mover = int(np.argmin(np.abs(points.x - [[0.5 - 1 / 32], [0.5 + 1 / 32]]).sum(axis=0)))
    x = points.x.copy()
    x[0, mover] = 0.5 + shift
    return mesh, replace(points, x=x)


@pytest.mark.parametrize("name, jumps", [("one", False), ("eq10", True), ("interior", True), ("overlap", False)])
def test_only_weights_by_host_cell_jump_when_a_point_crosses_a_face(name, jumps):
    tiny = 1e-9
    change = np.abs(call(name, *crossing(tiny)) - call(name, *crossing(-tiny))).max()
    assert change > 0.1 if jumps else change < 100 * tiny


def test_overlap_moves_all_the_way_across_without_a_jump():
    path = np.linspace(-1 / 16, 1 / 16, 201)
    w = np.array([call("overlap", *crossing(shift)) for shift in path])
    steps = np.abs(np.diff(w, axis=0)).max(axis=1)
    assert steps.max() < 0.02 and np.abs(w - 1).max() > 0.1


# On a second basis.

@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("cls", [ParticleBasis, GIMPBasis, CMPMBasis])
def test_with_weights_changes_the_measure_and_nothing_else(case, cls, name):
    mesh, points = case
    basis = cls(mesh, ELEMENT[mesh.dim()](), points)
    other = basis.with_weights(name)
    assert type(other) is cls and other is not basis
    assert_array_equal(other.dx[:, 0], call(name, *case) * points.volume)
    assert_array_equal(basis.dx[:, 0], points.volume)
    assert other.particles is basis.particles
    for attribute in ("value", "gradient", "nodes", "element_dofs", "tind"):
        assert_array_equal(getattr(other, attribute), getattr(basis, attribute))
    for field, values in basis.default_parameters().items():
        assert_array_equal(other.default_parameters()[field], values)


@pytest.mark.parametrize("name", WEIGHTS)
def test_mass_from_the_basis_without_weights_is_the_points_mass(case, name):
    mesh, points = case
    basis = ParticleBasis(mesh, ELEMENT[mesh.dim()](), points)
    before = mass.assemble(basis).toarray()
    weighted = basis.with_weights(name)
    laplace.assemble(weighted)
    assert_array_equal(mass.assemble(basis).toarray(), before)
    lumped = LinearForm(lambda v, w: w.mass / w.volume * v)
    assert_allclose(lumped.assemble(basis).sum(), points.mass.sum(), rtol=1e-13)
    volume = Functional(lambda w: 1 + 0 * w.x[0])
    assert_allclose(volume.assemble(weighted), call(name, *case) @ points.volume, rtol=1e-13)


def test_the_last_weights_asked_for_are_the_ones_used(case):
    mesh, points = case
    basis = ParticleBasis(mesh, ELEMENT[mesh.dim()](), points)
    assert_array_equal(basis.with_weights("eq10").with_weights("one").dx, basis.dx)
    assert_array_equal(basis.with_weights("interior").with_weights("eq10").dx, basis.with_weights("eq10").dx)


def test_stiffness_on_eq10_is_that_of_full_cells():
    """One point in the middle of each cell, whatever its volume, then counts as its cell."""
    mesh = MeshQuad().refined(2)
    points = Particles.fill(mesh, plane_strain, per_cell=1)
    lost = replace(points, volume=points.volume * np.random.default_rng(0).uniform(0.3, 2, points.n))
    basis = ParticleBasis(mesh, ElementQuad1(), lost)
    full = CellBasis(mesh, ElementQuad1(), quadrature=(np.array([[0.5], [0.5]]), np.ones(1)))
    weighted, plain, expected = (laplace.assemble(b).toarray() for b in (basis.with_weights("eq10"), basis, full))
    assert_allclose(weighted, expected, rtol=0, atol=1e-13)
    assert np.abs(plain - expected).max() > 0.1


# Bad input.

def test_an_unknown_name_is_refused_and_the_names_are_listed(case):
    mesh, points = case
    for attempt in (lambda: call("eq11", mesh, points),
                    lambda: ParticleBasis(mesh, ELEMENT[mesh.dim()](), points).with_weights("eq11")):
        with pytest.raises(ValueError, match="weights: got 'eq11', .* 'one', 'eq10', 'interior', 'overlap'"):
            attempt()


def test_overlap_needs_domains():
    mesh = MeshQuad().refined(2)
    points = replace(Particles.fill(mesh, plane_strain), length=None)
    basis = ParticleBasis(mesh, ElementQuad1(), points)
    with pytest.raises(ValueError, match=r"weights: 'overlap' needs .*give the particles a length \(dim, n\)"):
        basis.with_weights("overlap")
    for name in ("one", "eq10", "interior"):
        assert basis.with_weights(name).nelems == points.n


@pytest.mark.parametrize("name", ["eq10", "interior", "overlap"])
def test_weights_by_cell_on_a_mesh_that_is_no_grid_are_refused(name):
    mesh = MeshTri().refined(2)
    basis = ParticleBasis(mesh, ElementTriP1(), Particles.fill(mesh, plane_strain))
    with pytest.raises(ValueError, match="mesh: got MeshTri1, expected an axis-aligned"):
        basis.with_weights(name)


def test_overlap_refuses_domains_beyond_the_neighbours():
    mesh = MeshQuad().refined(3)
    points = Particles.fill(mesh, plane_strain)
    with pytest.raises(ValueError, match="length"):
        ParticleBasis(mesh, ElementQuad1(), replace(points, length=6 * points.length)).with_weights("overlap")


@pytest.mark.parametrize("name", ["interior", "overlap"])
def test_rows_of_cells_between_rollers_are_one_problem_however_many(name):
    """A ring modelled with one row of cells has the weights of the same ring with three."""
    def weights_of(rows):
        height = np.linspace(0, 0.1 * rows, rows + 1)
        body = Particles.fill(MeshQuad.init_tensor(np.linspace(1, 2, 11), height), axisymmetric)
        body = replace(body, x=body.x * np.array([[1.13], [1.0]]))
        mesh = MeshQuad.init_tensor(np.linspace(0.9, 2.5, 17), height)
        basis = ParticleBasis(mesh, ElementQuad1(), body).with_weights(name)
        return {round(r, 9): w for r, w in zip(body.x[0], basis.dx[:, 0] / body.volume)}

    one, three = weights_of(1), weights_of(3)
    assert_allclose([three[r] for r in one], list(one.values()), rtol=1e-12)
    assert max(one.values()) > 1.01 or min(one.values()) < 0.99
