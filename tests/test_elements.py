"""GIMP and CMPM as scikit-fem user elements: the same functions as the points see, in a stock ``CellBasis``."""

from types import SimpleNamespace

import numpy as np
import printed
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import ELEMENT
from skfem import (
    BilinearForm,
    CellBasis,
    ElementQuad1,
    ElementQuad2,
    ElementVector,
    Functional,
    LinearForm,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshTri,
    condense,
    solve,
)
from skfem.helpers import ddot, dot, grad, sym_grad
from skfem.models.poisson import laplace, mass
from test_grid import MESHES

from skfem_mpm import (
    CMPMBasis,
    ElementHexCMPM,
    ElementHexGIMP,
    ElementLineCMPM,
    ElementLineGIMP,
    ElementQuadCMPM,
    ElementQuadGIMP,
    GIMPBasis,
    Particles,
    axisymmetric,
    patch_dofs,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.grid import Grid, available_sides

CMPM = {1: ElementLineCMPM, 2: ElementQuadCMPM, 3: ElementHexCMPM}
GIMP = {1: ElementLineGIMP, 2: ElementQuadGIMP, 3: ElementHexGIMP}
KINEMATICS = {1: uniaxial, 2: plane_strain, 3: solid}
FAMILIES = {"cmpm": CMPM, "gimp": GIMP}


def cells_of(mesh, elem, occupied=None, **more):
    """A stock basis of scikit-fem, with two Gauss points per direction unless told otherwise."""
    return CellBasis(mesh, elem, dofs=patch_dofs(mesh, elem, occupied), **({"intorder": 2} | more))


def at_points(mesh, elem, x, cells, occupied=None):
    """A stock basis with one quadrature point per entry: any points, in their cells."""
    local = mesh._mapping().invF(x[:, :, None], tind=cells)
    return cells_of(mesh, elem, occupied, elements=cells, quadrature=(local, np.ones((x.shape[1], 1))))


def polynomial(x, power):
    return (0.4 + np.tensordot([0.3, -0.2, 0.25][:len(x)], x, 1)) ** power


def slopes(x, power):
    inner = np.reshape([0.3, -0.2, 0.25][:len(x)], (len(x),) + (1,) * (x.ndim - 1))
    return power * polynomial(x, power - 1) * inner


def inner_cells(mesh, margin=1):
    """Mask over the cells of a mesh: those with neighbours on all sides."""
    grid = Grid.from_mesh(mesh)
    inside = np.zeros(mesh.nelements, dtype=bool)
    inside[grid.cells[tuple(slice(margin, size - margin) for size in grid.cells.shape)]] = True
    return inside


def partly(mesh, seed=0):
    """A body in some cells of a mesh, with holes and corners; a mask."""
    occupied = np.random.default_rng(seed).random(mesh.nelements) < 0.75
    occupied[:2] = True
    return occupied


def scattered_in(mesh, occupied, n=200, seed=0):
    """Random points in the occupied cells, and these cells."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.flatnonzero(occupied), n)
    corners = mesh.p[:, mesh.t[:, cells]]
    low, high = corners.min(axis=1), corners.max(axis=1)
    return low + (high - low) * rng.uniform(0.001, 0.999, low.shape), cells, high - low


def points_at(mesh, x, length=None):
    ones = np.ones(x.shape[1])
    return Particles(x, ones, ones, KINEMATICS[mesh.dim()], length=length)


def whole(mesh):
    return np.ones(mesh.nelements, dtype=bool)


# What the spaces keep.

@pytest.mark.parametrize("name", MESHES)
def test_cmpm_sums_to_one_everywhere(name):
    mesh = MESHES[name]
    for occupied in (None, partly(mesh)):
        basis = cells_of(mesh, CMPM[mesh.dim()](), occupied)
        field = basis.interpolate(basis.ones())
        assert_allclose(np.asarray(field), 1, rtol=0, atol=1e-13)
        assert_allclose(field.grad, 0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", MESHES)
def test_gimp_sums_to_one_where_nodes_exist_and_everywhere_when_clipped(name):
    mesh = MESHES[name]
    loses = np.asarray(cells_of(mesh, GIMP[mesh.dim()]()).interpolate(np.ones(mesh.nvertices)))
    assert_allclose(loses[inner_cells(mesh)], 1, rtol=0, atol=1e-13)
    assert (loses[~inner_cells(mesh)].min(axis=1) < 1 - 1e-4).all(), "edge cells of the mesh lose it, as documented"
    for occupied in (whole(mesh), partly(mesh)):
        field = cells_of(mesh, GIMP[mesh.dim()](), occupied).interpolate(np.ones(mesh.nvertices))
        assert_allclose(np.asarray(field), 1, rtol=0, atol=1e-13)
        assert_allclose(field.grad, 0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", MESHES)
def test_cmpm_gradients_are_exact_for_cubics_inside_and_quadratics_at_edges(name):
    mesh = MESHES[name]
    basis = cells_of(mesh, CMPM[mesh.dim()]())
    x = np.asarray(basis.global_coordinates())
    for power, where in ((1, whole(mesh)), (2, whole(mesh)), (3, inner_cells(mesh))):
        field = basis.interpolate(polynomial(mesh.p, power)[vertex_of_dof(basis)])
        assert_allclose(np.asarray(field)[where], polynomial(x, power)[where], rtol=0, atol=1e-12)
        assert_allclose(field.grad[:, where], slopes(x, power)[:, where], rtol=0, atol=1e-11)
    edge = ~inner_cells(mesh)
    assert np.abs(field.grad[:, edge] - slopes(x, power)[:, edge]).max() > 1e-4


@pytest.mark.parametrize("name", MESHES)
def test_gimp_reproduces_linear_fields_inside(name):
    mesh = MESHES[name]
    basis = cells_of(mesh, GIMP[mesh.dim()]())
    x, inside = np.asarray(basis.global_coordinates()), inner_cells(mesh)
    field = basis.interpolate(polynomial(mesh.p, 1)[vertex_of_dof(basis)])
    assert inside.any()
    assert_allclose(np.asarray(field)[inside], polynomial(x, 1)[inside], rtol=0, atol=1e-13)
    assert_allclose(field.grad[:, inside], slopes(x, 1)[:, inside], rtol=0, atol=1e-11)


def vertex_of_dof(basis):
    """Mesh vertex of each degree of freedom of a scalar basis."""
    vertex = np.empty(basis.N, dtype=int)
    vertex[basis.nodal_dofs[0]] = np.arange(basis.mesh.nvertices)
    return vertex


def test_on_equal_cells_the_elements_are_the_printed_equations():
    mesh = MeshLine(np.arange(6.0))
    X = np.linspace(0, 1, 41)
    point = (X[None], np.ones(41))
    one_per_node = np.eye(6)
    cubic, gimp = (np.array([np.asarray(cells_of(mesh, e, quadrature=point).interpolate(u)) for u in one_per_node])
                   for e in (ElementLineCMPM(), ElementLineGIMP()))
    assert_allclose(cubic[1:5, 2], printed.eq8(2 * X - 1), rtol=0, atol=1e-14)
    assert_allclose(cubic[0:3, 0], printed.eq7(2 * X - 1), rtol=0, atol=1e-14)
    assert_allclose(cubic[3:6, 4], printed.eq7_mirrored(2 * X - 1), rtol=0, atol=1e-14)
    assert_allclose(gimp[1:5, 2], printed.eq6(2 + X - np.arange(1, 5)[:, None]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("family", FAMILIES)
def test_each_function_has_the_slope_that_finite_differences_give(family, name):
    mesh = MESHES[name]
    elem, step = FAMILIES[family][mesh.dim()](), 1e-6
    x, cells, size = scattered_in(mesh, whole(mesh), 30)
    u = np.random.default_rng(1).normal(size=mesh.nvertices)
    got = at_points(mesh, elem, x, cells).interpolate(u).grad[..., 0]
    for k in range(mesh.dim()):
        shift = step * size[k] * (np.arange(mesh.dim()) == k)[:, None]
        ahead, behind = (at_points(mesh, elem, x + sign * shift, cells).interpolate(u) for sign in (1, -1))
        assert_allclose(got[k] * size[k], np.asarray(ahead - behind)[:, 0] / (2 * step), rtol=0, atol=2e-4)


# The same functions as the points see.

@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("body", ["whole", "partly"])
def test_cmpm_element_is_the_stencil_of_points(name, body):
    mesh = MESHES[name]
    occupied = whole(mesh) if body == "whole" else partly(mesh)
    x, cells, _ = scattered_in(mesh, occupied)
    points = CMPMBasis(mesh, ELEMENT[mesh.dim()](), points_at(mesh, x), occupied=np.flatnonzero(occupied))
    element = at_points(mesh, CMPM[mesh.dim()](), x, cells, occupied)
    u = np.random.default_rng(2).normal(size=mesh.nvertices)
    assert_allclose(np.asarray(element.interpolate(u)), np.asarray(points.interpolate(u)), rtol=0, atol=1e-12)
    assert_allclose(element.interpolate(u).grad, points.interpolate(u).grad, rtol=0,
                    atol=1e-12 * np.abs(points.gradient).max())


def table_at(grid, stencil, u):
    """Value and gradient of nodal values by a stencil."""
    nodal = u[grid.vertices.ravel()[stencil.nodes()]]
    return (stencil.value() * nodal).sum(axis=0), (stencil.gradient() * nodal).sum(axis=1)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("size", ["half a cell", "given"])
@pytest.mark.parametrize("body", ["truncated at the mesh", "clipped to the mesh", "clipped to a body"])
def test_gimp_element_is_the_stencil_of_points_of_its_size(name, size, body):
    mesh = MESHES[name]
    occupied = {"truncated at the mesh": None, "clipped to the mesh": whole(mesh),
                "clipped to a body": partly(mesh)}[body]
    x, cells, cell_size = scattered_in(mesh, whole(mesh) if occupied is None else occupied)
    grid = Grid.from_mesh(mesh)
    given = np.array([0.7 * step.min() for step in grid.steps])
    length = cell_size / 2 if size == "half a cell" else np.repeat(given[:, None], x.shape[1], axis=1)
    elem = GIMP[mesh.dim()](None if size == "half a cell" else given)
    element = at_points(mesh, elem, x, cells, occupied)
    u = np.random.default_rng(2).normal(size=mesh.nvertices)
    if body == "clipped to a body":
        sides = available_sides(occupied[grid.cells])
        value, gradient = table_at(grid, grid.gimp(x, grid.locate(x), length, "clip", sides), u)
    else:
        edges = "clip" if body == "clipped to the mesh" else "truncate"
        points = GIMPBasis(mesh, ELEMENT[mesh.dim()](), points_at(mesh, x, length), edges=edges)
        value, gradient = np.asarray(points.interpolate(u))[:, 0], points.interpolate(u).grad[..., 0]
    assert_allclose(np.asarray(element.interpolate(u))[:, 0], value, rtol=0, atol=1e-12)
    assert_allclose(element.interpolate(u).grad[..., 0], gradient, rtol=0, atol=1e-12 / given.min())


def test_strain_of_a_moved_ring_through_a_stock_basis_is_that_of_the_points():
    mesh = MeshQuad.init_tensor(np.linspace(0.8, 3, 23), np.linspace(0, 0.2, 3))
    start = Particles.fill(mesh, axisymmetric, where=lambda x: (x[0] > 1) & (x[0] < 2.6))
    x = start.x + np.stack([0.07 / start.x[0], 0 * start.x[1]])
    points = Particles(x, start.volume, start.mass, axisymmetric)
    elem = ElementVector(ElementQuadCMPM())
    basis = CMPMBasis(mesh, ElementVector(ElementQuad1()), points)
    u = np.random.default_rng(0).normal(size=basis.N)
    stock = at_points(mesh, elem, x, basis.tind, np.unique(basis.tind))
    got, expected = (axisymmetric.strain(b.interpolate(u), SimpleNamespace(x=b.global_coordinates()))
                     for b in (stock, basis))
    assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


# What a stock basis can do with them.

@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("family", FAMILIES)
def test_degrees_of_freedom_are_those_of_the_linear_element_and_stand_at_their_nodes(family, name):
    mesh = MESHES[name]
    elem, plain = FAMILIES[family][mesh.dim()](), CellBasis(mesh, ELEMENT[mesh.dim()]())
    basis = cells_of(mesh, elem, intorder=1)
    assert_array_equal(basis.nodal_dofs, plain.nodal_dofs)
    assert_allclose(basis.doflocs, plain.doflocs, rtol=0, atol=1e-13)
    assert basis.N == plain.N == mesh.nvertices
    assert basis.Nbfun == 4 ** mesh.dim()
    vector = cells_of(mesh, ElementVector(elem), intorder=1)
    assert_array_equal(vector.nodal_dofs, CellBasis(mesh, ElementVector(ELEMENT[mesh.dim()]())).nodal_dofs)
    assert_allclose(vector.doflocs[:, vector.nodal_dofs[-1]], mesh.p, rtol=0, atol=1e-13)


def test_boundaries_are_found_by_name():
    mesh = MESHES["quad graded"].with_boundaries({"wall": lambda x: x[0] == 0})
    basis = cells_of(mesh, ElementQuadCMPM())
    assert_array_equal(np.sort(basis.get_dofs("wall").all()), np.flatnonzero(basis.doflocs[0] == 0))


@pytest.mark.parametrize("name", ["line graded", "quad refined shuffled", "hex tensor"])
@pytest.mark.parametrize("family", FAMILIES)
def test_vector_elements_are_the_scalar_one_per_component(family, name):
    mesh = MESHES[name]
    elem = FAMILIES[family][mesh.dim()]()
    scalar = cells_of(mesh, elem, intorder=1)
    expected = laplace.assemble(scalar).toarray()[np.ix_(scalar.nodal_dofs[0], scalar.nodal_dofs[0])]
    vector = cells_of(mesh, ElementVector(elem), intorder=1)
    both = BilinearForm(lambda u, v, w: ddot(grad(u), grad(v))).assemble(vector).toarray()
    assert vector.Nbfun == mesh.dim() * 4 ** mesh.dim()
    for i in range(mesh.dim()):
        for j in range(mesh.dim()):
            block = both[np.ix_(vector.nodal_dofs[i], vector.nodal_dofs[j])]
            assert_allclose(block, expected * (i == j), rtol=0, atol=1e-11)


def test_vector_strain_of_a_quadratic_displacement_is_exact():
    mesh = MESHES["quad graded shuffled"]
    basis = cells_of(mesh, ElementVector(ElementQuadCMPM()))
    u = basis.zeros()
    u[basis.nodal_dofs[0]], u[basis.nodal_dofs[1]] = mesh.p[0] * mesh.p[1], mesh.p[0] ** 2
    x, y = np.asarray(basis.global_coordinates())
    assert_allclose(sym_grad(basis.interpolate(u)), [[y, 1.5 * x], [1.5 * x, 0 * x]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_problem_is_solved_in_the_space(family):
    mesh = MESHES["quad refined shuffled"].refined(1)
    basis = cells_of(mesh, FAMILIES[family][2](), whole(mesh))
    K = laplace.assemble(basis)
    assert_allclose(K.toarray(), K.T.toarray(), rtol=0, atol=1e-13)
    u = solve(*condense(K, LinearForm(lambda v, w: v).assemble(basis), D=basis.get_dofs()))
    plain = CellBasis(mesh, ElementQuad1())
    other = solve(*condense(laplace.assemble(plain), LinearForm(lambda v, w: v).assemble(plain), D=plain.get_dofs()))
    assert_allclose(u.max(), other.max(), rtol=0.2)


@pytest.mark.parametrize("name", ["line graded", "quad refined", "hex graded"])
def test_probes_evaluate_the_space(name):
    mesh = MESHES[name]
    elem = CMPM[mesh.dim()]()
    x, cells, _ = scattered_in(mesh, whole(mesh), 20)
    u = np.random.default_rng(0).normal(size=mesh.nvertices)
    expected = np.asarray(at_points(mesh, elem, x, cells).interpolate(u))[:, 0]
    assert_allclose(cells_of(mesh, elem).probes(x) @ u, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("family", FAMILIES)
def test_functions_of_missing_nodes_are_zero(family, name):
    """So that a padded entry, which repeats a node of the cell, adds nothing to it."""
    mesh = MESHES[name]
    basis = cells_of(mesh, FAMILIES[family][mesh.dim()]())
    largest = np.array([[np.abs(np.asarray(field)).max(axis=-1) + np.abs(field.grad).max(axis=(0, -1))]
                        for (field,) in basis.basis])[:, 0]        # of each function in each cell
    dofs = basis.element_dofs
    for cell in range(mesh.nelements):
        seen = dofs[largest[:, cell] > 0, cell]
        assert len(np.unique(seen)) == len(seen), "a node is met twice"
    if family == "cmpm":
        counts = (largest > 0).sum(axis=0)
        assert (counts[inner_cells(mesh)] == 4 ** mesh.dim()).all()
        assert counts.min() >= 3 ** mesh.dim() and counts.min() < 4 ** mesh.dim()


def test_cells_alone_are_fe():
    mesh = MeshQuad().refined(2)
    alone = np.array([5])
    element = cells_of(mesh, ElementQuadCMPM(), alone, elements=alone)
    plain = CellBasis(mesh, ElementQuad1(), elements=alone, intorder=2)
    u = np.random.default_rng(0).normal(size=mesh.nvertices)
    assert_allclose(element.interpolate(u).grad, plain.interpolate(u).grad, rtol=0, atol=1e-12)


def test_occupied_is_taken_in_all_the_ways_of_scikit_fem():
    mesh = MeshQuad().refined(3).with_subdomains({"left": lambda x: x[0] < 0.5})
    cells = mesh.subdomains["left"]
    u = np.random.default_rng(0).normal(size=mesh.nvertices)

    def energy(occupied):
        return Functional(lambda w: dot(w.u.grad, w.u.grad)).assemble(cells_of(mesh, ElementQuadCMPM(), occupied), u=u)

    assert energy(None) != energy(cells)
    for occupied in ("left", list(map(int, cells)), lambda x: x[0] < 0.5, np.isin(np.arange(64), cells)):
        assert energy(occupied) == energy(cells)


def test_a_body_of_cells_integrates_over_its_own_cells():
    mesh = MESHES["quad graded"]
    occupied = np.flatnonzero(partly(mesh))
    basis = cells_of(mesh, ElementQuadCMPM(), occupied, elements=occupied)
    area = CellBasis(mesh, ElementQuad1(), elements=occupied).dx.sum()
    assert_allclose(mass.assemble(basis).sum(), area, rtol=1e-12)


# Bad input.

@pytest.mark.parametrize("elem", [ElementQuadCMPM(), ElementQuadGIMP(), ElementVector(ElementQuadCMPM())])
def test_an_element_that_knows_no_mesh_says_what_to_pass(elem):
    with pytest.raises(ValueError, match=r"does not know this mesh yet; pass dofs=patch_dofs\(mesh, elem\)"):
        CellBasis(MeshQuad().refined(2), elem)


def test_an_element_bound_to_another_mesh_is_refused():
    elem, mesh = ElementQuadCMPM(), MeshQuad().refined(2)
    dofs = patch_dofs(mesh, elem)
    patch_dofs(mesh.refined(1), elem)
    with pytest.raises(ValueError, match=r"does not know this mesh yet; pass dofs=patch_dofs\(mesh, elem\)"):
        CellBasis(mesh, elem, dofs=dofs)
    assert CellBasis(mesh, elem, dofs=patch_dofs(mesh, elem)).N == 25


def test_a_basis_made_before_its_element_was_bound_again_still_interpolates():
    elem, mesh = ElementQuadCMPM(), MeshQuad().refined(2)
    basis = cells_of(mesh, elem)
    patch_dofs(mesh.refined(1), elem)
    x = np.asarray(basis.global_coordinates())
    assert_allclose(basis.interpolate(mesh.p[0] ** 2).grad[0], 2 * x[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("mesh", [MeshTri().refined(1), MeshHex(), MeshLine()])
@pytest.mark.parametrize("elem", [ElementQuadCMPM(), ElementQuadGIMP()])
def test_an_element_of_another_cell_is_refused(mesh, elem):
    with pytest.raises(ValueError, match=f"elem: got {type(elem).__name__} for a {type(mesh).__name__}"):
        patch_dofs(mesh, elem)


def test_a_mesh_that_is_not_a_grid_is_refused():
    mesh = MeshQuad().refined(2)
    p = mesh.p.copy()
    p[:, mesh.interior_nodes()[0]] += 0.02
    with pytest.raises(ValueError, match="axis-aligned"):
        patch_dofs(MeshQuad(p, mesh.t), ElementQuadCMPM())


@pytest.mark.parametrize("elem", [ElementQuad1(), ElementQuad2(), ElementVector(ElementQuad1()),
                                  ElementVector(ElementQuad1()) * ElementQuad1()])
def test_other_elements_are_refused(elem):
    with pytest.raises(ValueError, match="elem: got .*expected a GIMP or CMPM element or an ElementVector of one"):
        patch_dofs(MeshQuad().refined(2), elem)


@pytest.mark.parametrize("length", [0.1, [0.1], [0.1, 0.0], [0.1, -0.1], [0.1, np.nan], [0.1, 0.1, 0.1]])
def test_wrong_lengths_of_a_gimp_element_are_refused(length):
    with pytest.raises(ValueError, match=r"length: got .*expected 2 edge length\(s\) above zero"):
        ElementQuadGIMP(length)


def test_a_gimp_element_with_a_domain_beyond_the_neighbours_is_refused():
    mesh = MeshQuad().refined(2)                        # cells of 1/4
    with pytest.raises(ValueError, match="length: got 0.51 along axis 1, expected at most 0.5.*use a smaller length"):
        cells_of(mesh, ElementQuadGIMP([0.1, 0.51]))
    assert cells_of(mesh, ElementQuadGIMP([0.5, 0.5])).N == 25


def test_a_gimp_element_of_half_a_cell_is_refused_where_the_next_cell_is_narrower_than_a_quarter():
    with pytest.raises(ValueError, match="expected at most 4 for domains of half a cell"):
        cells_of(MeshLine(np.array([0.0, 1.0, 1.2])), ElementLineGIMP())
    basis = cells_of(MeshLine(np.array([0.0, 1.0, 1.25])), ElementLineGIMP())
    assert_allclose(np.asarray(basis.interpolate(basis.ones())).max(), 1, rtol=1e-13)
