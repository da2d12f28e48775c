"""Points are a scikit-fem basis: any form assembles on them, and on Gauss points gives what scikit-fem gives."""

import gc
import operator
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import ELEMENT
from skfem import (
    BilinearForm,
    CellBasis,
    ElementDG,
    ElementHex1,
    ElementHex2,
    ElementHexS2,
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad0,
    ElementQuad1,
    ElementQuad2,
    ElementQuadS2,
    ElementTetP1,
    ElementTetP2,
    ElementTetRT0,
    ElementTriCR,
    ElementTriMorley,
    ElementTriN1,
    ElementTriP0,
    ElementTriP1,
    ElementTriP2,
    ElementTriRT0,
    ElementVector,
    Functional,
    LinearForm,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshQuad2,
    MeshTet,
    MeshTri,
    asm,
    condense,
    solve,
)
from skfem.element import DiscreteField
from skfem.helpers import ddot, div, dot, eye, grad, inner, sym_grad, trace
from skfem.models.poisson import laplace, mass
from skfem.quadrature import get_quadrature

from skfem_mpm import (
    METHODS,
    CMPMBasis,
    GIMPBasis,
    Method,
    OutsideGridError,
    ParticleBasis,
    Particles,
    axisymmetric,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.grid import Grid

BASES = [ParticleBasis, GIMPBasis, CMPMBasis]
KINEMATICS = {1: uniaxial, 2: plane_strain, 3: solid}
LAM, MU = 1.3, 0.8


def distorted(mesh):
    """The mesh with all its nodes moved, each by less than folds a cell."""
    shift = 0.08 * mesh.param() * np.sin(7 * np.arange(mesh.p.size).reshape(mesh.p.shape) + 1)
    return type(mesh)(mesh.p + shift, mesh.t)


def axis(count, grading=1.0, low=0.0, high=1.0):
    return low + (high - low) * np.linspace(0, 1, count + 1) ** grading


def difference(got, expected):
    """Largest difference, relative to the largest entry expected."""
    got, expected = (a.toarray() if hasattr(a, "toarray") else np.asarray(a) for a in (got, expected))
    return np.abs(got - expected).max() / np.abs(expected).max()


# Points on Gauss points: scikit-fem's own matrices.

@BilinearForm
def elasticity(u, v, w):
    return LAM * div(u) * div(v) + 2 * MU * ddot(sym_grad(u), sym_grad(v))


def hooke(e):
    return LAM * eye(trace(e), 3) + 2 * MU * e


def stiffness(kinematics, factor):
    """Elasticity in the words of the library; ``factor(w)`` is the r of scikit-fem's own axisymmetric form."""
    return BilinearForm(lambda u, v, w: ddot(hooke(kinematics.strain(u, w)), kinematics.strain(v, w)) * factor(w))


def internal_force(kinematics, factor):
    return LinearForm(lambda v, w: ddot(w.stress, kinematics.strain(v, w)) * factor(w))


def one(w):
    return 1.0


def radius(w):
    return w.x[0]


QUAD = MeshQuad.init_tensor(axis(3, 1.3, 1, 2), axis(2))
GAUSS = {
    "line P1": (MeshLine(axis(5, 1.3, 1, 2)), ElementLineP1()),
    "line P2": (MeshLine(axis(4, 1.3, 1, 2)), ElementLineP2()),
    "tri P1": (MeshTri.init_tensor(axis(3, 1.3, 1, 2), axis(2)), ElementTriP1()),
    "tri P2": (MeshTri.init_tensor(axis(2, 1.3, 1, 2), axis(2)), ElementTriP2()),
    "quad Q1": (QUAD, ElementQuad1()),
    "quad Q1 refined": (MeshQuad().refined(2).translated((1.0, 0.0)), ElementQuad1()),
    "quad Q2": (QUAD, ElementQuad2()),
    "tet P1": (MeshTet.init_tensor(axis(2, 1.3, 1, 2), axis(1), axis(2)), ElementTetP1()),
    "tet P2": (MeshTet.init_tensor(axis(1, 1, 1, 2), axis(1), axis(1)), ElementTetP2()),
    "hex Q1": (MeshHex.init_tensor(axis(2, 1.3, 1, 2), axis(3), axis(2)), ElementHex1()),
    "hex Q2": (MeshHex.init_tensor(axis(2, 1.3, 1, 2), axis(1), axis(1)), ElementHex2()),
}
GAUSS |= {f"{name} distorted": (distorted(mesh), elem) for name, (mesh, elem) in GAUSS.items()}
RINGS = [name for name in GAUSS if name.split()[0] in ("line", "tri", "quad")]
EVERY = [(name, None) for name in GAUSS] + [(name, axisymmetric) for name in RINGS]


def rule_inside(mesh, order):
    """scikit-fem's first rule of that order or more with points strictly inside the cell and positive weights."""
    rules = (get_quadrature(mesh.refdom, k) for k in range(order, order + 9))
    simplex = isinstance(mesh, (MeshTri, MeshTet))
    return next((X, W) for X, W in rules
                if W.min() > 0 and X.min() > 1e-6 and (X.sum(axis=0) if simplex else X).max() < 1 - 1e-6)


def on_gauss_points(name, kinematics=None, vector=True):
    """scikit-fem's basis, points on its quadrature points in any order, the basis on them, and that order."""
    mesh, elem = GAUSS[name]
    elem = ElementVector(elem) if vector else elem
    kinematics = kinematics or KINEMATICS[mesh.dim()]
    stock = CellBasis(mesh, elem, quadrature=rule_inside(mesh, 2 * elem.maxdeg))
    x = np.asarray(stock.global_coordinates()).reshape(mesh.dim(), -1)
    rng = np.random.default_rng(0)
    shuffle = rng.permutation(x.shape[1])
    volume = (stock.dx.ravel() * (x[0] if kinematics.hoop else 1))[shuffle]
    points = Particles(x[:, shuffle], volume, volume * rng.uniform(1, 2, len(shuffle)), kinematics,
                       sigma=rng.normal(size=(kinematics.ncomp, len(shuffle))))
    return stock, points, ParticleBasis(mesh, elem, points), shuffle


def at_quadrature(stock, order, array):
    """A field of the points, put back to scikit-fem's quadrature points."""
    back = np.empty_like(array)
    back[..., order] = array
    return DiscreteField(back.reshape(array.shape[:-1] + stock.dx.shape))


@pytest.mark.parametrize("name", GAUSS)
def test_mass_on_gauss_points_is_scikit_fems(name):
    stock, _, basis, _ = on_gauss_points(name, vector=False)
    assert difference(mass.assemble(basis), mass.assemble(stock)) < 1e-13


@pytest.mark.parametrize("name", GAUSS)
def test_elasticity_on_gauss_points_is_scikit_fems(name):
    stock, points, basis, _ = on_gauss_points(name)
    assert difference(elasticity.assemble(basis), elasticity.assemble(stock)) < 1e-13
    assert difference(stiffness(points.kinematics, one).assemble(basis), elasticity.assemble(stock)) < 1e-13


@pytest.mark.parametrize("name", RINGS)
def test_axisymmetric_elasticity_needs_no_factor_r_on_points(name):
    stock, _, basis, _ = on_gauss_points(name, axisymmetric)
    ours, theirs = stiffness(axisymmetric, one), stiffness(axisymmetric, radius)
    assert difference(ours.assemble(basis), theirs.assemble(stock)) < 1e-13


@pytest.mark.parametrize("name, kinematics", EVERY)
def test_internal_force_on_gauss_points_is_scikit_fems(name, kinematics):
    stock, points, basis, order = on_gauss_points(name, kinematics)
    expected = internal_force(points.kinematics, radius if points.kinematics.hoop else one).assemble(
        stock, stress=at_quadrature(stock, order, points.stress))
    assert difference(internal_force(points.kinematics, one).assemble(basis), expected) < 1e-13


@pytest.mark.parametrize("name, kinematics", EVERY)
def test_body_force_on_gauss_points_is_scikit_fems(name, kinematics):
    stock, points, basis, order = on_gauss_points(name, kinematics)

    def load(x):
        return np.stack([np.cos(3 * x[0]) + k * x[-1] for k in range(len(x))])

    ours = LinearForm(lambda v, w: w.mass / w.volume * dot(load(w.x), v))
    factor = radius if points.kinematics.hoop else one
    theirs = LinearForm(lambda v, w: w.density * dot(load(w.x), v) * factor(w))
    density = at_quadrature(stock, order, points.mass / points.volume)
    assert difference(ours.assemble(basis), theirs.assemble(stock, density=density)) < 1e-13


@pytest.mark.parametrize("name", ["tri P1 distorted", "quad Q1", "quad Q2 distorted", "hex Q1 distorted", "tet P2"])
def test_fields_and_functionals_on_gauss_points_are_scikit_fems(name):
    stock, _, basis, order = on_gauss_points(name)
    u = np.random.default_rng(1).normal(size=basis.N)
    for ours, theirs in ((basis.interpolate(u), stock.interpolate(u)),
                         (basis.interpolate(u).grad, stock.interpolate(u).grad)):
        theirs = np.asarray(theirs)
        flat = theirs.reshape(theirs.shape[:-2] + (-1,))
        assert_allclose(np.asarray(ours)[..., 0], flat[..., order], rtol=0, atol=1e-12 * np.abs(flat).max())
    energy = Functional(lambda w: ddot(w.u.grad, w.u.grad) + dot(w.x, w.u) * w.h)
    assert_allclose(energy.assemble(basis, u=u), energy.assemble(stock, u=u), rtol=1e-13)


@pytest.mark.parametrize("name", GAUSS)
def test_cell_size_in_forms_is_scikit_fems(name):
    stock, _, basis, order = on_gauss_points(name, vector=False)
    flat = np.asarray(stock.default_parameters()["h"]).ravel()
    assert_allclose(np.asarray(basis.default_parameters()["h"])[:, 0], flat[order], rtol=1e-12)
    assert_array_equal(basis.mesh_parameters(), basis.default_parameters()["h"])


@pytest.mark.parametrize("name, elem", [
    ("tri P1 distorted", ElementTriCR()), ("tri P1 distorted", ElementTriRT0()), ("tri P1", ElementTriN1()),
    ("tri P1 distorted", ElementTriMorley()), ("tri P1", ElementTriP0()), ("quad Q1 distorted", ElementQuadS2()),
    ("quad Q1", ElementDG(ElementQuad1())), ("tet P1 distorted", ElementTetRT0()), ("hex Q1", ElementHexS2()),
    ("line P1", ElementLineHermite())], ids=lambda value: type(value).__name__ if not isinstance(value, str) else value)
def test_any_element_of_the_mesh_works(name, elem):
    _, points, _, _ = on_gauss_points(name)
    mesh, form = GAUSS[name][0], BilinearForm(lambda u, v, w: inner(u, v) * w.x[0])
    quadrature = rule_inside(mesh, 2 * GAUSS[name][1].maxdeg)
    expected = form.assemble(CellBasis(mesh, elem, quadrature=quadrature))
    assert difference(form.assemble(ParticleBasis(mesh, elem, points)), expected) < 1e-12


@pytest.mark.parametrize("name", ["quad Q1", "quad Q1 distorted", "tri P2", "hex Q1"])
def test_a_problem_on_gauss_points_has_scikit_fems_solution(name):
    stock, _, basis, _ = on_gauss_points(name)
    solution = []
    for b in (stock, basis):
        f = LinearForm(lambda v, w: v[0] * w.x[0]).assemble(b)
        solution.append(solve(*condense(elasticity.assemble(b), f, D=b.get_dofs(nodes=lambda x: x[0] < 1.15))))
    assert difference(solution[1], solution[0]) < 1e-11


# What every basis keeps, inside and at the edge of the grid.

GRIDS = {
    "line": MeshLine(axis(8)),
    "line graded": MeshLine(axis(8, 1.4, 1, 3)),
    "quad": MeshQuad.init_tensor(axis(6), axis(5, low=1, high=2)),
    "quad refined": MeshQuad().refined(3),
    "quad graded": MeshQuad.init_tensor(axis(6, 1.3), axis(5, 0.8, -1, 2)),
    "hex": MeshHex.init_tensor(axis(4), axis(3), axis(4)),
    "hex graded": MeshHex.init_tensor(axis(4, 1.3), axis(3, 1.2), axis(4, 0.9, -1, 1)),
}
THIN = {
    "one layer": MeshQuad.init_tensor(axis(6, 1.2), axis(1, 1, 0, 0.3)),
    "one cell": MeshHex(),
    "one row": MeshHex.init_tensor(axis(1), axis(5), axis(1)),
}
KINDS = {
    "fe": (ParticleBasis, {}),
    "gimp ghost": (GIMPBasis, {"edges": "ghost"}),
    "gimp clip": (GIMPBasis, {"edges": "clip"}),
    "gimp truncate": (GIMPBasis, {"edges": "truncate"}),
    "cmpm": (CMPMBasis, {}),
}


def finest(mesh):
    return np.array([step.min() for step in Grid.from_mesh(mesh).steps])[:, None]


def box(mesh):
    return mesh.p.min(axis=1, keepdims=True), mesh.p.max(axis=1, keepdims=True)


def scattered(mesh, n=150, seed=0, kinematics=None, inside=False, **more):
    """Points all over a grid, on its nodes and faces too; ``inside`` moves them so that no domain leaves the grid."""
    rng = np.random.default_rng(seed)
    low, high = box(mesh)
    x = low + (high - low) * rng.random((mesh.dim(), n))
    x[0, :40] = rng.choice(mesh.p[0], 40)
    x = np.concatenate([x, mesh.p], axis=1)
    length = rng.uniform(0.05, 1, x.shape) * finest(mesh)
    if inside:
        x = np.clip(x, low + length / 2, high - length / 2)
    volume = rng.uniform(0.5, 1, x.shape[1])
    return Particles(x, volume, 2 * volume, kinematics or KINEMATICS[mesh.dim()], length=length, **more)


def basis_of(kind, mesh, elem=None, points=None, **more):
    cls, options = KINDS[kind]
    points = points or scattered(mesh, inside=kind == "gimp ghost", **more)
    return cls(mesh, elem or ELEMENT[mesh.dim()](), points, **options)


def linear_field(x):
    return 0.5 + np.tensordot([1.0, -2.0, 3.0][:len(x)], x, 1)


def slopes(dim):
    return np.array([1.0, -2.0, 3.0][:dim])[:, None]


@pytest.mark.parametrize("name", GRIDS | THIN)
@pytest.mark.parametrize("kind", ["fe", "gimp ghost", "gimp clip", "cmpm"])
def test_partition_of_unity_inside_and_at_edges(kind, name):
    basis = basis_of(kind, (GRIDS | THIN)[name])
    assert_allclose(basis.value.sum(axis=0), 1, rtol=0, atol=1e-13)
    assert_allclose(basis.gradient.sum(axis=1), 0, atol=1e-13 * np.abs(basis.gradient).max())


@pytest.mark.parametrize("name", GRIDS | THIN)
@pytest.mark.parametrize("kind", ["fe", "gimp ghost", "gimp clip", "cmpm"])
def test_linear_fields_are_reproduced_inside_and_at_edges(kind, name):
    mesh = (GRIDS | THIN)[name]
    basis = basis_of(kind, mesh)
    field = basis.interpolate(linear_field(basis.doflocs))
    x, half = basis.particles.x, basis.particles.length / 2
    low, high = box(mesh)
    middle = (np.maximum(x - half, low) + np.minimum(x + half, high)) / 2     # of what clip leaves of the domain
    at = middle if kind == "gimp clip" else x
    assert_allclose(field[:, 0], linear_field(at), rtol=0, atol=1e-13 * np.abs(linear_field(x)).max())
    assert_allclose(field.grad[..., 0], slopes(mesh.dim()) + 0 * x, rtol=0, atol=1e-13 * np.abs(basis.gradient).max())


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("kind", KINDS)
def test_tables_and_forms_say_the_same(kind, name):
    basis = basis_of(kind, GRIDS[name])
    u = np.random.default_rng(3).normal(size=basis.N)
    nodal = u[basis.nodal_dofs[0]][basis.nodes]
    field, steepest = basis.interpolate(u), np.abs(basis.gradient).max()
    assert_allclose(field[:, 0], (basis.value * nodal).sum(axis=0), rtol=0, atol=1e-12)
    assert_allclose(field.grad[..., 0], (basis.gradient * nodal).sum(axis=1), rtol=0, atol=1e-12 * steepest)
    sums = LinearForm(lambda v, w: w.mass / w.volume * v).assemble(basis)
    assert_allclose(sums.sum(), (basis.value.sum(axis=0) * basis.particles.mass).sum(), rtol=1e-13)


@pytest.mark.parametrize("cells", [10, 20, 40])
def test_truncate_loses_what_theory_says_and_its_gradient_error_grows_like_one_over_h(cells):
    h = 1 / cells
    half, distance = h / 4, np.array([0, 0.05, 0.1, 0.2, 0.25]) * h
    x = np.concatenate([distance, 1 - distance])[None]
    ones = np.ones(x.shape[1])
    points = Particles(x, ones, ones, uniaxial, length=np.full_like(x, 2 * half))
    basis = GIMPBasis(MeshLine(axis(cells)), ElementLineP1(), points, edges="truncate")
    missing = np.tile(half - distance, 2)               # length of the domain beyond the grid
    assert_allclose(1 - basis.value.sum(axis=0), missing**2 / (4 * half * h), rtol=1e-9, atol=1e-13)
    outwards = np.repeat([1, -1], len(distance))
    assert_allclose(basis.gradient.sum(axis=1)[0], outwards * missing / (2 * half * h), rtol=1e-9, atol=1e-11)
    assert_allclose(basis.gradient.sum(axis=1)[0, 0] * h, 1 / 2, rtol=1e-9)       # of a constant field, at the edge


@pytest.mark.parametrize("name", ["quad", "hex graded"])
def test_truncate_loses_only_where_domains_leave_the_grid(name):
    mesh = GRIDS[name]
    basis = basis_of("gimp truncate", mesh)
    x, half = basis.particles.x, basis.particles.length / 2
    low, high = box(mesh)
    out = ((x - half < low) | (x + half > high)).any(axis=0)
    total = basis.value.sum(axis=0)
    assert (total[out] < 1).all() and out.any()
    assert_allclose(total[~out], 1, rtol=1e-13)


@pytest.mark.parametrize("name", GRIDS)
def test_cmpm_reproduces_cubics_inside_and_quadratics_at_edges(name):
    mesh = GRIDS[name]
    basis = basis_of("cmpm", mesh)
    x = basis.particles.x
    edge = np.array([(row < a[1]) | (row >= a[-2]) for row, a in zip(x, Grid.from_mesh(mesh).axes)]).any(axis=0)
    assert edge.any() and not edge.all()
    for power, where in ((2, slice(None)), (3, ~edge)):
        field = basis.interpolate((linear_field(basis.doflocs) / 4) ** power)
        exact = (linear_field(x) / 4) ** power
        assert_allclose(field[where, 0], exact[where], rtol=0, atol=1e-12 * np.abs(exact).max())
        slope = power * (linear_field(x) / 4) ** (power - 1) * slopes(mesh.dim()) / 4
        assert_allclose(field.grad[:, where, 0], slope[:, where], rtol=0, atol=1e-12 * np.abs(basis.gradient).max())
    assert np.abs(field[edge, 0] - exact[edge]).max() > 1e-6, "cubics are beyond it at edges"


def test_cmpm_reads_nothing_from_cells_without_points():
    mesh = MeshQuad().refined(4)
    x = np.random.default_rng(0).uniform([[0.0], [0.25]], [[0.5], [0.75]], (2, 2000))
    ones = np.ones(2000)
    basis = CMPMBasis(mesh, ElementQuad1(), Particles(x, ones, ones, plane_strain))
    in_body = (basis.doflocs[0] <= 0.5) & (basis.doflocs[1] >= 0.25) & (basis.doflocs[1] <= 0.75)
    u = np.where(in_body, basis.doflocs[0] ** 2, 1e6)
    assert_allclose(basis.interpolate(u).grad[0, :, 0], 2 * x[0], atol=1e-12)


def test_cmpm_takes_occupied_cells_in_all_the_ways_of_scikit_fem():
    mesh = MeshQuad().refined(3).with_subdomains({"left": lambda x: x[0] < 0.5})
    x = np.random.default_rng(0).uniform(0.3, 0.5, (2, 50))
    points = Particles(x, np.ones(50), np.ones(50), plane_strain)
    cells = mesh.subdomains["left"]
    mask = np.isin(np.arange(mesh.nelements), cells)
    expected = CMPMBasis(mesh, ElementQuad1(), points, occupied=cells).value
    assert np.abs(expected - CMPMBasis(mesh, ElementQuad1(), points, occupied=np.arange(64)).value).max() > 0.01
    for occupied in ("left", list(map(int, cells)), lambda x: x[0] < 0.5, mask):
        assert_array_equal(CMPMBasis(mesh, ElementQuad1(), points, occupied=occupied).value, expected)


def test_gimp_is_fe_at_the_usual_first_positions_so_both_give_the_same_first_step():
    mesh = MeshQuad().refined(3)
    points = Particles.fill(mesh, plane_strain)
    fe, gimp = (cls(mesh, ElementQuad1(), points) for cls in (ParticleBasis, GIMPBasis))
    assert_allclose(laplace.assemble(gimp).toarray(), laplace.assemble(fe).toarray(), rtol=0, atol=1e-14)
    moved = replace(points, x=points.x + 0.01)
    moved = moved.where((moved.x < 0.9).all(axis=0))
    fe, gimp = (cls(mesh, ElementQuad1(), moved) for cls in (ParticleBasis, GIMPBasis))
    assert difference(laplace.assemble(gimp), laplace.assemble(fe)) > 0.01


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("kind", KINDS)
def test_numbering_of_the_mesh_does_not_matter(kind, name):
    mesh = GRIDS[name]
    old = np.random.default_rng(0).permutation(mesh.nvertices)
    other = type(mesh)(mesh.p[:, old], np.argsort(old)[mesh.t][:, ::-1])
    points = scattered(mesh, inside=kind == "gimp ghost")
    one, two = (basis_of(kind, m, points=points) for m in (mesh, other))
    a, b = (mass.assemble(basis).toarray() for basis in (one, two))
    assert_allclose(a[np.ix_(old, old)], b, rtol=0, atol=1e-13)


def test_points_on_unstructured_meshes_keep_unity_and_linear_fields():
    for name in ("tri P1 distorted", "tet P1 distorted", "quad Q1 distorted", "hex Q1 distorted"):
        mesh, elem = GAUSS[name]
        points = Particles.fill(mesh, KINEMATICS[mesh.dim()], per_cell=3)
        field = ParticleBasis(mesh, elem, points).interpolate(linear_field(mesh.p))
        assert_allclose(field[:, 0], linear_field(points.x), rtol=1e-13)
        assert_allclose(field.grad[..., 0], slopes(mesh.dim()) + 0 * points.x, rtol=0, atol=1e-12)


# What scikit-fem users do with a basis.

GRID = MeshQuad.init_tensor(axis(5), axis(4)).with_boundaries({"wall": lambda x: x[0] == 0})
TALL = {"own": np.arange(1, 81, dtype=float), "many": np.arange(160, dtype=float).reshape(2, 80)}


def body(**more):
    """Four points in each cell of GRID, off the usual places, with stress."""
    points = Particles.fill(GRID, plane_strain, density=2.0, rule="gauss")
    low, high = points.length / 2, 1 - points.length / 2
    x = np.clip(points.x + 0.01 * np.random.default_rng(0).normal(size=points.x.shape), low, high)
    sigma = np.random.default_rng(1).normal(size=(4, points.n))
    return replace(points, x=x, sigma=sigma, **more)


@pytest.fixture(params=["fe", "gimp ghost", "cmpm"])
def kind(request):
    return request.param


def on_grid(kind, elem=None, points=None):
    cls, options = KINDS[kind]
    return cls(GRID, elem or ElementQuad1(), points or body(), **options)


def test_fields_of_the_points_are_in_forms_by_name_and_shaped_for_them(kind):
    points = body(fields=TALL)
    basis = on_grid(kind, points=points)
    seen = {}

    @Functional
    def look(w):
        names = ("stress", "mass", "volume", "length", "own", "many", "x", "h")
        seen.update({name: np.shape(getattr(w, name)) for name in names})
        return w.own * w.volume**0

    total = look.assemble(basis)
    n = points.n
    assert seen == {"stress": (3, 3, n, 1), "mass": (n, 1), "volume": (n, 1), "length": (2, n, 1), "own": (n, 1),
                    "many": (2, n, 1), "x": (2, n, 1), "h": (n, 1)}
    assert_allclose(total, points.volume @ TALL["own"], rtol=1e-13)
    assert_array_equal(basis.default_parameters()["stress"][..., 0], points.stress)
    assert_array_equal(basis.global_coordinates()[..., 0], points.x)


def test_stress_of_points_without_any_is_zero_in_forms(kind):
    points = replace(body(), sigma=None)
    assert not internal_force(plane_strain, one).assemble(on_grid(kind, ElementVector(ElementQuad1()), points)).any()


def test_elastic_strain_is_in_forms_when_points_hold_it():
    points = body()
    basis = on_grid("fe", points=replace(points, epsilon=np.ones((4, points.n))))
    assert basis.default_parameters()["strain"].shape == (3, 3, points.n, 1)
    assert "strain" not in on_grid("fe", points=points).default_parameters()


def test_linear_forms_and_functionals_sum_mass_and_volume(kind):
    basis = on_grid(kind)
    points = basis.particles
    assert_allclose(Functional(lambda w: 1.0 + 0 * w.x[0]).assemble(basis), points.volume.sum(), rtol=1e-13)
    assert_allclose(LinearForm(lambda v, w: w.mass / w.volume * v).assemble(basis).sum(), points.mass.sum(), rtol=1e-13)
    assert_allclose(Functional(lambda w: w.mass / w.volume).elemental(basis), points.mass, rtol=1e-13)
    assert_allclose(mass.assemble(basis).sum(), points.volume.sum(), rtol=1e-13)


def test_vector_forms_are_scalar_forms_per_component(kind):
    scalar, vector = on_grid(kind), on_grid(kind, ElementVector(ElementQuad1()))
    one_component = laplace.assemble(scalar).toarray()
    both = BilinearForm(lambda u, v, w: ddot(grad(u), grad(v))).assemble(vector).toarray()
    for i in range(2):
        for j in range(2):
            block = both[np.ix_(vector.nodal_dofs[i], vector.nodal_dofs[j])]
            assert_allclose(block, one_component * (i == j), rtol=0, atol=1e-13)
    assert vector.Nbfun == 2 * scalar.Nbfun


def test_composite_of_vector_and_scalar_is_the_sum_of_its_blocks(kind):
    elem = ElementVector(ElementQuad1()) * ElementQuad1()
    basis, u_basis, p_basis = (on_grid(kind, e) for e in (elem, elem.elems[0], elem.elems[1]))
    form = BilinearForm(lambda u, p, v, q, w: ddot(grad(u), grad(v)) + div(v) * p + 2 * p * q)
    coupled = form.assemble(basis).toarray()
    u, p = basis.split_indices()
    expected = {
        (0, 0): BilinearForm(lambda u, v, w: ddot(grad(u), grad(v))).assemble(u_basis),
        (0, 1): BilinearForm(lambda p, v, w: div(v) * p).assemble(p_basis, u_basis),
        (1, 1): 2 * mass.assemble(p_basis),
    }
    for (i, j), block in expected.items():
        assert_allclose(coupled[np.ix_((u, p)[i], (u, p)[j])], block.toarray(), rtol=0, atol=1e-13)
    assert not coupled[np.ix_(p, u)].any()


def test_a_vector_of_other_length_than_the_dimension(kind):
    basis = on_grid(kind, ElementVector(ElementQuad1(), dim=3))
    assert basis.interpolate(basis.ones()).shape == (3, basis.nelems, 1)
    assert_allclose(np.asarray(basis.interpolate(basis.ones())), 1, rtol=1e-13)


def test_mixed_forms_of_vector_q1_and_q0_are_scikit_fems_on_gauss_points():
    stock, points, basis, _ = on_gauss_points("quad Q1")
    elem = ElementVector(ElementQuad1()) * ElementQuad0()
    mixed = BilinearForm(lambda u, p, v, q, w: ddot(sym_grad(u), sym_grad(v)) - div(v) * p - div(u) * q)
    ours, theirs = ParticleBasis(stock.mesh, elem, points), CellBasis(stock.mesh, elem, quadrature=stock.quadrature)
    assert difference(mixed.assemble(ours), mixed.assemble(theirs)) < 1e-13
    coupling = BilinearForm(lambda p, v, w: div(v) * p)
    assert difference(coupling.assemble(basis.with_element(ElementQuad0()), basis),
                      coupling.assemble(stock.with_element(ElementQuad0()), stock)) < 1e-13


@pytest.mark.parametrize("elem", [ElementVector(ElementQuad1()), ElementVector(ElementQuad1()) * ElementQuad1()])
def test_split_gives_components_that_interpolate_alone(kind, elem):
    basis = on_grid(kind, elem)
    u = np.random.default_rng(0).normal(size=basis.N)
    whole = basis.interpolate(u)
    components = list(whole) if isinstance(elem, ElementVector) else [whole[0], whole[1]]
    parts = basis.split(u)
    assert len(parts) == len(components) == len(basis.split_bases())
    for (values, part), component in zip(parts, components):
        assert type(part) is type(basis)
        assert_allclose(np.asarray(part.interpolate(values)), np.asarray(component), rtol=0, atol=1e-13)


def test_split_of_a_mixed_element_with_constants():
    stock, points, _, _ = on_gauss_points("quad Q1")
    basis = ParticleBasis(stock.mesh, ElementVector(ElementQuad1()) * ElementQuad0(), points)
    u = np.random.default_rng(0).normal(size=basis.N)
    (velocity, v_basis), (pressure, p_basis) = basis.split(u)
    assert_allclose(np.asarray(v_basis.interpolate(velocity)), np.asarray(basis.interpolate(u)[0]), atol=1e-13)
    assert_allclose(np.asarray(p_basis.interpolate(pressure)), np.asarray(basis.interpolate(u)[1]), atol=1e-13)


def test_a_scalar_basis_is_its_own_only_component(kind):
    basis = on_grid(kind)
    assert basis.split_bases() == [basis]


def test_composite_bases_assemble_as_blocks(kind):
    u, p = on_grid(kind), on_grid("fe")                 # (scikit-fem's CompositeBasis cannot mix vectors and scalars)
    pair = u * p
    form = BilinearForm(lambda u, p, v, q, w: dot(grad(u), grad(v)) + v.grad[0] * p + w.mass / w.volume * p * q)
    K = form.assemble(pair).toarray()
    coupling = BilinearForm(lambda p, v, w: v.grad[0] * p).assemble(p, u)
    assert pair.N == u.N + p.N
    assert_allclose(K[:u.N, :u.N], laplace.assemble(u).toarray(), rtol=0, atol=1e-13)
    assert_allclose(K[:u.N, u.N:], coupling.toarray(), rtol=0, atol=1e-13)
    assert_allclose(K[u.N:, u.N:], 2 * mass.assemble(p).toarray(), rtol=0, atol=1e-13)
    assert not K[u.N:, :u.N].any()
    x = np.random.default_rng(0).normal(size=pair.N)
    assert_allclose(np.asarray(pair.interpolate(x)[1]), np.asarray(p.interpolate(x[u.N:])), rtol=0, atol=1e-14)


def test_asm_takes_lists_of_bases(kind):
    points = body()
    left = points.x[0] < 0.5
    whole = on_grid("fe", points=points)
    halves = [on_grid("fe", points=points.where(mask)) for mask in (left, ~left)]
    assert_allclose(asm(mass, halves).toarray(), asm(mass, whole).toarray(), rtol=0, atol=1e-14)
    basis = on_grid(kind)
    assert_allclose(asm(mass, basis).toarray(), mass.assemble(basis).toarray(), rtol=0, atol=1e-15)
    force = LinearForm(lambda v, w: w.mass / w.volume * v)
    assert_allclose(asm(force, halves), asm(force, whole), rtol=0, atol=1e-14)


@pytest.mark.parametrize("cut", [np.arange(0, 80, 3), np.arange(79, 0, -7), np.arange(80) % 5 == 0])
def test_with_elements_is_the_basis_of_some_points(kind, cut):
    points = body()
    basis = on_grid(kind, points=points)
    part = basis.with_elements(cut)
    assert type(part) is type(basis) and part.nelems == points.where(cut).n
    u = np.random.default_rng(0).normal(size=basis.N)
    assert_allclose(np.asarray(part.interpolate(u)), np.asarray(basis.interpolate(u))[cut], rtol=0, atol=1e-13)
    assert_array_equal(part.default_parameters()["stress"][..., 0], points.stress[..., cut])
    weighted = basis.with_weights("eq10")
    assert_array_equal(weighted.with_elements(cut).dx, weighted.dx[cut])


def test_with_elements_of_nothing_said_is_all_as_in_scikit_fem(kind):
    basis = on_grid(kind)
    assert CellBasis(GRID, ElementQuad1()).with_elements().nelems == GRID.nelements
    assert basis.with_elements().nelems == basis.nelems


def test_with_element_keeps_points_options_and_weights():
    points = scattered(GRID, inside=False)
    for kind in KINDS:
        basis = on_grid(kind, points=points) if kind != "gimp ghost" else on_grid(kind)
        weighted = basis.with_weights("interior")
        other = weighted.with_element(ElementVector(ElementQuad1()))
        assert other.N == 2 * basis.N and other.particles is basis.particles
        assert_array_equal(other.dx, weighted.dx)
        assert_array_equal(other.value, basis.value)


def test_with_elements_of_cmpm_keeps_what_is_occupied():
    basis = on_grid("cmpm")
    alone = basis.with_elements(np.array([17]))
    assert_allclose(alone.value[:, 0], basis.value[:, 17], rtol=0, atol=1e-15)


@pytest.mark.parametrize("elem", [None, ElementVector(ElementQuad1())])
def test_projection_returns_fields_of_the_space(kind, elem):
    basis = on_grid(kind, elem)
    shape = (2,) if elem else ()
    constant = basis.project(lambda x: np.full(shape + x.shape[1:], 3.0))
    assert_allclose(constant, 3, rtol=1e-9)
    u = basis.project((lambda x: np.stack([linear_field(x), x[0]])) if elem else linear_field)
    x = basis.doflocs
    expected = linear_field(x)
    if elem:
        expected = np.where(np.isin(np.arange(basis.N), basis.nodal_dofs[1]), x[0], expected)
    assert_allclose(u, expected, rtol=0, atol=1e-9)
    v = np.random.default_rng(0).normal(size=basis.N)
    assert_allclose(basis.project(basis.interpolate(v)), v, rtol=0, atol=1e-8)


def test_projection_takes_a_number_and_points_fields():
    basis = on_grid("fe")
    assert_allclose(basis.project(2.5), 2.5, rtol=1e-10)
    field = basis.field(linear_field(basis.particles.x))
    assert_allclose(basis.project(field), linear_field(basis.doflocs), rtol=0, atol=1e-10)


def test_projection_leaves_what_no_point_sees_at_zero():
    points = body()
    basis = on_grid("fe", points=points.where(points.x[0] < 0.4))
    far = basis.doflocs[0] > 0.41
    u = basis.project(1.0)
    assert not u[far].any()
    assert_allclose(u[~far], 1, rtol=1e-9)


def test_projection_on_cells_is_refused_and_says_what_to_do():
    with pytest.raises(ValueError, match=r"elements: got .*use with_elements\(points\)"):
        on_grid("fe").project(1.0, elements=np.array([0, 1]))


def test_degrees_of_freedom_are_found_as_in_scikit_fem(kind):
    elem = ElementVector(ElementQuad1())
    basis, stock = on_grid(kind, elem), CellBasis(GRID, elem)
    for question in ({"facets": "wall"}, {}, {"facets": lambda x: x[1] == 1}, {"nodes": lambda x: x[0] <= 0.5},
                     {"elements": lambda x: x[0] < 0.3}, {"facets": "wall", "skip": ["u^1"]}):
        assert_array_equal(basis.get_dofs(**question).all(), stock.get_dofs(**question).all())
    assert_array_equal(basis.complement_dofs(basis.get_dofs("wall")), stock.complement_dofs(stock.get_dofs("wall")))
    assert_array_equal(basis.doflocs, stock.doflocs)
    assert_array_equal(basis.nodal_dofs, stock.nodal_dofs)
    assert (basis.N, len(basis.zeros()), basis.ones().sum()) == (stock.N, stock.N, stock.N)


def test_a_bar_under_its_own_weight_with_condense_and_solve(kind):
    basis = on_grid(kind, ElementVector(ElementQuad1()))
    K = stiffness(plane_strain, one).assemble(basis)
    f = LinearForm(lambda v, w: w.mass / w.volume * v[0]).assemble(basis)
    fixed = basis.get_dofs("wall")
    u = solve(*condense(K, f, D=fixed))
    assert not u[fixed.all()].any()
    free = basis.complement_dofs(fixed)
    assert_allclose((K @ u)[free], f[free], rtol=0, atol=1e-10)
    assert u[basis.nodal_dofs[0]].max() > 0


def test_cell_work_is_passed_to_the_plain_basis(kind):
    basis, stock = on_grid(kind), CellBasis(GRID, ElementQuad1())
    u = np.random.default_rng(0).normal(size=basis.N)
    x = np.random.default_rng(1).random((2, 9))
    assert_allclose(basis.probes(x) @ u, stock.probes(x) @ u, rtol=1e-13)
    assert_allclose(basis.interpolator(u)(x), stock.interpolator(u)(x), rtol=1e-13)
    assert_allclose(basis.point_source(x[:, 0]), stock.point_source(x[:, 0]), rtol=1e-13)
    (mesh, values), (same, expected) = basis.refinterp(u, 2), stock.refinterp(u, 2)
    assert_array_equal(mesh.p, same.p)
    assert_array_equal(values, expected)
    length = Functional(lambda w: 1.0 + 0 * w.x[0])
    assert_allclose(length.assemble(basis.boundary("wall")), 1, rtol=1e-13)


def test_interpolator_of_a_vector():
    elem = ElementVector(ElementQuad1())
    basis, stock = on_grid("fe", elem), CellBasis(GRID, elem)
    u, x = np.random.default_rng(0).normal(size=basis.N), np.random.default_rng(1).random((2, 9))
    assert_allclose(basis.interpolator(u)(x), stock.interpolator(u)(x), rtol=1e-13)


def test_a_solution_can_be_plotted(kind):
    basis = on_grid(kind)
    axes = basis.plot(basis.doflocs[0], nrefs=1)
    assert axes.collections
    plt.close("all")


@pytest.mark.parametrize("cls", BASES)
def test_repr_tells_what_it_is_and_how_large(cls):
    text = repr(cls(GRID, ElementVector(ElementQuad1()), body()))
    assert text.startswith(f"<skfem_mpm {cls.__name__}(MeshQuad1, ElementVector) object>")
    width = {ParticleBasis: 8, GIMPBasis: 18, CMPMBasis: 32}[cls]
    assert all(line in text for line in ("Number of points: 80", "Number of DOFs: 60", f"Functions per point: {width}"))


# Own arrays, and the traps of shapes.

@pytest.mark.parametrize("shape", [(), (3,), (2, 2), (3, 3)])
def test_field_shapes_an_array_over_points_for_forms(kind, shape):
    basis = on_grid(kind)
    array = np.random.default_rng(0).normal(size=shape + (basis.nelems,))
    field = basis.field(array)
    assert isinstance(field, DiscreteField)
    assert_array_equal(np.asarray(field), array[..., None])


@pytest.mark.parametrize("shape", [(), (79,), (80, 1), (80, 2), (2, 80, 1), (2, 81), (1,)])
def test_field_refuses_other_shapes_instead_of_broadcasting(shape):
    with pytest.raises(ValueError, match="field: got shape"):
        on_grid("fe").field(np.zeros(shape))


def test_field_says_to_transpose():
    with pytest.raises(ValueError, match=r"got shape \(80, 2\).*points last"):
        on_grid("fe").field(np.zeros((80, 2)))


@pytest.mark.parametrize("array, error, message", [
    (np.arange(80), TypeError, "an array of int64, expected floats"), (np.full(80, np.nan), ValueError, "nan at index"),
    (np.full(80, np.inf), ValueError, "inf at index"), (np.array(["a"] * 80), TypeError, "expected floats"),
    (np.ones(80, dtype=bool), TypeError, "an array of bool, expected floats"), (None, TypeError, "expected floats")])
def test_field_refuses_what_is_not_finite_floats(array, error, message):
    with pytest.raises(error, match=f"field: got .*{message}"):
        on_grid("fe").field(array)


def test_a_bare_array_as_long_as_the_solution_is_taken_for_one_and_field_is_not():
    points = body()
    points = points.where(np.arange(30))                # as many points as degrees of freedom
    basis = on_grid("fe", points=points)
    assert basis.N == points.n == 30
    a = np.random.default_rng(0).normal(size=30)
    total = Functional(lambda w: w.a)
    assert_allclose(total.assemble(basis, a=basis.field(a)), a @ points.volume, rtol=1e-12)
    assert abs(total.assemble(basis, a=a) - a @ points.volume) > 1e-3, "scikit-fem's trap is gone: say so in the docs"


def test_a_bare_array_without_the_last_axis_counts_every_point_n_times_and_field_is_right():
    basis = on_grid("fe", ElementVector(ElementQuad1()))
    load = np.random.default_rng(0).uniform(1, 2, (2, basis.nelems))
    force = LinearForm(lambda v, w: dot(w.b, v))
    assert_allclose(force.assemble(basis, b=basis.field(load)).sum(), (load * basis.particles.volume).sum(), rtol=1e-13)
    too_large = force.assemble(basis, b=load).sum() / (load * basis.particles.volume).sum()
    assert too_large > 0.5 * basis.nelems, "scikit-fem's trap is gone: say so in the docs"


def test_a_bare_array_over_the_points_is_refused_by_scikit_fem_when_lengths_differ():
    basis = on_grid("fe")
    with pytest.raises(ValueError, match="wrong size"):
        Functional(lambda w: w.a).assemble(basis, a=np.ones(basis.nelems))


def test_fields_by_name_do_not_fall_into_the_trap():
    points = body()
    points = replace(points.where(np.arange(30)), fields={"own": np.arange(30.0)})
    basis = on_grid("fe", points=points)
    assert_allclose(Functional(lambda w: w.own).assemble(basis), np.arange(30.0) @ points.volume, rtol=1e-13)


# Two bases in one form.

@pytest.mark.parametrize("kinematics", [plane_strain, axisymmetric])
@pytest.mark.parametrize("strain, force", [("cmpm", "fe"), ("gimp ghost", "fe"), ("cmpm", "gimp ghost"),
                                           ("fe", "cmpm")])
def test_a_form_on_two_bases_is_the_exact_tangent_of_force_with_recovered_strain(strain, force, kinematics):
    elem, points = ElementVector(ElementQuad1()), replace(body(), kinematics=kinematics)
    read, write = (on_grid(kind, elem, points) for kind in (strain, force))

    def stress(e):
        return hooke(e) + 0.7 * eye(trace(e) ** 2, 3) + 0.4 * trace(e) * e

    def rate(e, de):
        return hooke(de) + 1.4 * eye(trace(e) * trace(de), 3) + 0.4 * (trace(de) * e + trace(e) * de)

    @LinearForm
    def force_form(v, w):
        return ddot(stress(w.e), kinematics.strain(v, w))

    @BilinearForm
    def tangent(u, v, w):
        return ddot(rate(w.e, kinematics.strain(u, w)), kinematics.strain(v, w))

    def strain_of(u):
        w = SimpleNamespace(**read.default_parameters())
        return write.field(kinematics.strain(read.interpolate(u), w)[..., 0])

    rng = np.random.default_rng(0)
    u, step = rng.normal(size=(2, read.N))
    K = tangent.assemble(read, write, e=strain_of(u))
    ahead, behind = (force_form.assemble(write, e=strain_of(u + sign * step)) for sign in (1, -1))
    assert difference(K @ step, (ahead - behind) / 2) < 1e-11         # the law is quadratic: this is its derivative
    assert K.shape == (write.N, read.N)


def test_the_tangent_of_fe_force_with_cmpm_strain_is_not_symmetric():
    elem, points = ElementVector(ElementQuad1()), body()
    K = elasticity.assemble(on_grid("cmpm", elem, points), on_grid("fe", elem, points))
    assert difference(K, K.T) > 0.01


@pytest.mark.parametrize("other", ["moved", "reordered", "fewer", "twice"])
def test_bases_with_different_points_in_one_form_are_refused(other):
    points = body()
    others = {"moved": replace(points, x=points.x + 1e-9), "reordered": points.where(np.arange(points.n)[::-1].copy()),
              "fewer": points.where(np.arange(points.n - 1)), "twice": points.where(np.arange(1))}[other]
    trial, test = on_grid("cmpm", points=others), on_grid("fe", points=points)
    for pair in ((trial, test), (test, trial)):
        with pytest.raises(ValueError, match="same points"):
            laplace.assemble(*pair)
        with pytest.raises(ValueError, match="same points"):
            asm(laplace, *pair)


def test_bases_with_different_points_in_one_unstructured_form_are_refused():
    mesh, elem = GAUSS["tri P1 distorted"]
    points = Particles.fill(mesh, plane_strain)
    other = ParticleBasis(mesh, elem, points.where(np.arange(points.n)[::-1].copy()))
    with pytest.raises(ValueError, match="same points"):
        mass.assemble(ParticleBasis(mesh, elem, points), other)


@pytest.mark.parametrize("combine", [operator.mul, operator.matmul])
@pytest.mark.parametrize("same_number", [True, False])
def test_composite_bases_of_different_points_are_refused(same_number, combine):
    points = body()
    other = points.where(np.arange(points.n)[::-1].copy() if same_number else np.arange(40))
    coupled = BilinearForm(lambda u, p, v, q, w: u * q + p * v)
    with pytest.raises(ValueError, match="same points"):
        coupled.assemble(combine(on_grid("fe", points=points), on_grid("fe", points=other)))


def test_a_basis_of_cells_in_one_form_with_points_is_refused():
    basis = on_grid("fe")
    with pytest.raises(ValueError):
        mass.assemble(basis, CellBasis(GRID, ElementQuad1()))
    with pytest.raises(ValueError):
        mass.assemble(CellBasis(GRID, ElementQuad1()), basis)


def test_the_same_points_with_other_stress_are_accepted():
    points = body()
    later = replace(points, sigma=np.zeros_like(points.sigma))
    copied = replace(points, x=points.x.copy())
    expected = laplace.assemble(on_grid("fe", points=points)).toarray()
    for other in (later, copied):
        got = laplace.assemble(on_grid("fe", points=points), on_grid("fe", points=other))
        assert_array_equal(got.toarray(), expected)


# What is held, and what is not.

def array_bytes(thing):
    """Bytes of all arrays that can be reached from an object, whatever holds them."""
    todo, seen, total = [thing], set(), 0
    while todo:
        held = todo.pop()
        if id(held) in seen or isinstance(held, (type, type(gc))) or callable(held):
            continue
        seen.add(id(held))
        total += held.nbytes if isinstance(held, np.ndarray) else 0
        todo += gc.get_referents(held)
    return total


@pytest.mark.parametrize("name", ["quad Q1", "quad Q1 distorted", "quad Q2 distorted", "hex Q1 distorted", "tri P1"])
def test_the_mesh_does_not_grow_with_every_set_of_points(name):
    mesh, elem = GAUSS[name]
    kinematics, sizes = KINEMATICS[mesh.dim()], []
    points = Particles.fill(mesh, kinematics)
    for step in range(4):
        moved = replace(points, x=points.x + 1e-4 * step)
        basis = ParticleBasis(mesh, elem, moved)
        mass.assemble(basis)
        Functional(lambda w: w.h).assemble(basis)
        _ = basis.X, basis.doflocs
        sizes.append(array_bytes(vars(mesh)))
    assert sizes[1] == sizes[-1]


def test_functions_are_made_when_a_form_asks_for_them():
    basis = on_grid("gimp ghost")
    assert "basis" not in vars(basis)
    mass.assemble(basis)
    assert len(basis.basis) == 9


def test_degrees_of_freedom_made_before_can_be_passed(kind):
    first = on_grid(kind)
    again = type(first)(GRID, ElementQuad1(), body(), dofs=first.dofs)
    assert again.dofs is first.dofs
    assert_array_equal(mass.assemble(again).toarray(), mass.assemble(first).toarray())


@pytest.mark.parametrize("name", ["quad Q1 distorted", "tri P1", "hex Q1 distorted"])
def test_cells_known_from_before_give_the_same_basis(name):
    mesh, elem = GAUSS[name]
    points = Particles.fill(mesh, KINEMATICS[mesh.dim()])
    first = ParticleBasis(mesh, elem, points)
    again = ParticleBasis(mesh, elem, points, cells=first.tind[::-1].copy())
    assert_array_equal(again.tind, first.tind)
    assert_array_equal(mass.assemble(again).toarray(), mass.assemble(first).toarray())


@pytest.mark.parametrize("name", ["quad graded", "hex", "line graded"])
def test_structured_and_unstructured_paths_agree(name):
    mesh = GRIDS[name]
    points = scattered(mesh)
    cells = Grid.from_mesh(mesh)
    basis = basis_of("fe", mesh, points=points)
    assert_array_equal(basis.tind, cells.cells[tuple(cells.locate(points.x))])
    local = basis.mapping.F(np.asarray(basis.X), tind=basis.tind)
    assert_allclose(local[..., 0], points.x, rtol=0, atol=1e-13)


def test_forms_read_of_a_basis_only_what_we_provide(kind):
    """The contract with scikit-fem: if this fails, a new version reads more of a basis than it did."""
    basis = on_grid(kind)
    read = ("nelems", "dx", "Nbfun", "element_dofs", "basis", "N", "X", "default_parameters", "interpolate")
    bare = SimpleNamespace(**{name: getattr(basis, name) for name in read})
    u = np.random.default_rng(0).normal(size=basis.N)
    bilinear = BilinearForm(lambda u, v, w: w.u * u * v + dot(grad(u), grad(v)))
    other = SimpleNamespace(**vars(bare))
    linear = LinearForm(lambda v, w: w.u * v + w.h * v.grad[0])
    functional = Functional(lambda w: w.u**2 + w.mass)
    assert_array_equal(bilinear.assemble(bare, u=u).toarray(), bilinear.assemble(basis, u=u).toarray())
    assert_array_equal(laplace.assemble(bare, other).toarray(), laplace.assemble(basis).toarray())
    assert_array_equal(linear.assemble(bare, u=u), linear.assemble(basis, u=u))
    assert functional.assemble(bare, u=u) == functional.assemble(basis, u=u)


def test_a_basis_is_a_scikit_fem_cell_basis(kind):
    basis = on_grid(kind)
    assert isinstance(basis, CellBasis)
    assert basis.zero_w().shape == (basis.nelems, 1) == basis.dx.shape
    assert basis.X.shape == (2, basis.nelems, 1)
    assert basis.quadrature[1].tolist() == [1.0]


# The table of methods.

def test_methods_are_the_table_of_the_design():
    fe, gimp, cmpm = ParticleBasis, GIMPBasis, CMPMBasis
    table = {"mpm": (fe, fe, fe), "gimp": (gimp, gimp, gimp), "cmpm": (fe, cmpm, fe), "fe-gimp": (fe, gimp, fe),
             "gc": (gimp, cmpm, gimp), "cmpm-c": (fe, cmpm, cmpm)}
    assert {name: (m.mass, m.strain, m.force) for name, m in METHODS.items()} == table


def test_a_method_that_maps_mass_with_negative_functions_is_refused():
    with pytest.raises(ValueError, match="mass: got CMPMBasis.*ParticleBasis or GIMPBasis"):
        Method(mass=CMPMBasis, strain=CMPMBasis, force=CMPMBasis)


# Bad input.

@pytest.mark.parametrize("cls", BASES)
@pytest.mark.parametrize("mesh, elem, kinematics", [
    (GRIDS["line"], ElementLineP1(), uniaxial), (GRID, ElementQuad1(), plane_strain),
    (GRIDS["hex"], ElementHex1(), solid)])
def test_a_point_outside_is_named(cls, mesh, elem, kinematics):
    x = np.full((mesh.dim(), 5), 0.5)
    x[-1, 3] = 1.25
    points = Particles(x, np.ones(5), np.ones(5), kinematics, length=np.full_like(x, 0.05))
    with pytest.raises(OutsideGridError, match=r"point 3 .*1\.25.*outside the grid.*use a larger mesh"):
        cls(mesh, elem, points)


@pytest.mark.parametrize("name", ["tri P1", "tet P1", "quad Q1 distorted", "quad Q2"])
def test_a_point_outside_an_unstructured_mesh_is_named(name):
    mesh, elem = GAUSS[name]
    x = np.tile(mesh.p[:, mesh.t[:, 0]].mean(axis=1)[:, None], 5)
    x[0, 2] = 9.5
    points = Particles(x, np.ones(5), np.ones(5), KINEMATICS[mesh.dim()])
    with pytest.raises(OutsideGridError, match=r"point 2 .*9\.5.*outside"):
        ParticleBasis(mesh, elem, points)


@pytest.mark.parametrize("cls", [GIMPBasis, CMPMBasis])
@pytest.mark.parametrize("mesh, elem, message", [
    (GAUSS["tri P1"][0], ElementTriP1(), "ElementTriP1"), (GAUSS["tet P1"][0], ElementTetP1(), "ElementTetP1"),
    (GRID, ElementQuad2(), "ElementQuad2"),
    (GRID, ElementVector(ElementQuad2()), "expected ElementLineP1, ElementQuad1"),
    (GRID, ElementVector(ElementQuad1()) * ElementQuad0(), "expected ElementLineP1, ElementQuad1"),
    (distorted(GRID), ElementQuad1(), "axis-aligned"), (MeshQuad2.from_mesh(GRID), ElementQuad1(), "axis-aligned"),
    (GAUSS["hex Q1 distorted"][0], ElementHex1(), "axis-aligned")])
def test_gimp_and_cmpm_refuse_what_they_do_not_exist_on(cls, mesh, elem, message):
    x = mesh.p[:, mesh.t].mean(axis=1)
    ones = np.ones(x.shape[1])
    points = Particles(x, ones, ones, KINEMATICS[mesh.dim()], length=np.full_like(x, 0.01))
    with pytest.raises(ValueError, match=message) as e:
        cls(mesh, elem, points)
    assert "expected" in str(e.value) or "use init_tensor" in str(e.value)


@pytest.mark.parametrize("cls", BASES)
def test_mesh_element_and_points_must_fit(cls):
    with pytest.raises(ValueError, match="elem: got ElementTriP1 for a MeshQuad1, expected"):
        cls(GRID, ElementTriP1(), body())
    with pytest.raises(ValueError, match=r"particles: got points in 2 dimension\(s\) for a mesh in 3"):
        cls(GRIDS["hex"], ElementHex1(), body())


def test_gimp_needs_domains():
    with pytest.raises(ValueError, match=r"length: the points have none.*give Particles a length \(dim, n\)"):
        GIMPBasis(GRID, ElementQuad1(), replace(body(), length=None))


def test_fe_and_cmpm_do_not_need_domains():
    for cls in (ParticleBasis, CMPMBasis):
        assert cls(GRID, ElementQuad1(), replace(body(), length=None)).nelems == 80


def test_unknown_edges_are_refused_and_the_names_listed():
    with pytest.raises(ValueError, match="edges: got 'periodic', expected one of 'ghost', 'truncate', 'clip'"):
        GIMPBasis(GRID, ElementQuad1(), body(), edges="periodic")


def test_gimp_refuses_domains_that_leave_the_grid_unless_told():
    points = replace(body(), length=np.full((2, 80), 0.2))
    with pytest.raises(OutsideGridError, match="leaves the grid.*spare layer of cells"):
        GIMPBasis(GRID, ElementQuad1(), points)


@pytest.mark.parametrize("edges", ["ghost", "truncate", "clip"])
def test_gimp_refuses_domains_larger_than_it_allows(edges):
    points = replace(body(), length=np.full((2, 80), 0.7))
    with pytest.raises(ValueError, match="length: the domain of point .* beyond the neighbours.*use smaller domains"):
        GIMPBasis(GRID, ElementQuad1(), points, edges=edges)


def test_tables_of_points_that_have_none_are_refused_with_what_to_do():
    mesh, elem = GAUSS["tri P1"]
    basis = ParticleBasis(mesh, elem, Particles.fill(mesh, plane_strain))
    for name in ("value", "gradient", "nodes"):
        with pytest.raises(ValueError, match="stencil: there is none for this mesh or element; take an axis"):
            getattr(basis, name)


def test_points_are_checked_before_they_reach_a_basis():
    with pytest.raises(ValueError, match="no points"):
        Particles(np.empty((2, 0)), np.empty(0), np.empty(0), plane_strain)
    with pytest.raises(ValueError, match="transpose it"):
        Particles(np.ones((5, 2)), np.ones(5), np.ones(5), plane_strain)
