"""What every basis and every operator keeps, on any graded grid and for points at any place."""

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shared import ELEMENT, MAKE
from skfem import CellBasis, MeshLine
from strategies import axes, layouts, places, units

from skfem_mpm import (
    CMPMBasis,
    CubicBasis,
    ElementHexCMPM,
    ElementHexGIMP,
    ElementLineCMPM,
    ElementLineGIMP,
    ElementQuadCMPM,
    ElementQuadGIMP,
    GIMPBasis,
    LinearElastic,
    ParticleBasis,
    patch_dofs,
    plane_strain,
    solid,
)
from skfem_mpm.cover import Cover
from skfem_mpm.grid import Grid, available_sides
from skfem_mpm.integration import INTEGRATIONS, on_points
from skfem_mpm.integration.dilation import Means, shares_of

EPS = np.finfo(float).eps
UNIFORM = {"fe": ParticleBasis, "cmpm": CMPMBasis, "cubic": CubicBasis}
KINDS = ["fe", "gimp ghost", "gimp clip", "gimp truncate", "cmpm", "cubic"]
SOUND = [name for name in KINDS if name != "gimp truncate"]         # which lose nothing at the edge of the grid
CARRIERS = ["fe", "gimp ghost", "gimp clip"]            # whose functions may carry mass
TWINS = ["twin", "twin2", "dual"]
USERS = {1: (ElementLineGIMP, ElementLineCMPM), 2: (ElementQuadGIMP, ElementQuadCMPM),
         3: (ElementHexGIMP, ElementHexCMPM)}


@st.composite
def bases(draw, kinds=KINDS, **kind):
    """Any basis: its kind, and what it makes of a layout; patches reach into random cells beside the occupied ones."""
    name = draw(st.sampled_from(list(kinds)))
    mesh, body = draw(layouts(margin=int(name == "gimp ghost"), **kind))
    elem = ELEMENT[body.dim]()
    if name.startswith("gimp"):
        return name, GIMPBasis(mesh, elem, body, edges=name.split()[1])
    if name == "fe":
        return name, ParticleBasis(mesh, elem, body)
    grid = Grid.from_mesh(mesh)
    filled = grid.occupied(grid.locate(body.x))
    for _ in range(draw(st.integers(0, 6))):                # boxes of cells
        corners = [sorted(draw(st.tuples(*[st.integers(0, size)] * 2))) for size in filled.shape]
        filled[tuple(slice(*ends) for ends in corners)] = True
    return name, UNIFORM[name](mesh, elem, body, occupied=grid.cells[filled])


def functions(basis):
    """Value and gradient, and where the nodes are, from the point's first node on: ``(K, n)``, ``(dim, K, n)``."""
    nodes = basis.mesh.p[:, basis.nodes]
    return basis.value, basis.gradient, nodes


def noise(basis):
    """Rounding of values, and of slopes ``(dim,)``; positions far from the origin have lost digits already."""
    value = 64 * EPS * np.abs(basis.value).sum(axis=0).max()
    return value, 64 * EPS * np.abs(basis.gradient).sum(axis=1).max(axis=1)


def middles(name, basis):
    """Where a linear field is read: at the point, but for what is left of a domain that leaves the grid."""
    x, half = basis.particles.x, basis.particles.length / 2
    if name != "gimp clip":
        return x
    low, high = (end(basis.mesh.p, axis=1, keepdims=True) for end in (np.min, np.max))
    return (np.maximum(x - half, low) + np.minimum(x + half, high)) / 2


def whole(name, basis):
    """Points that lose nothing: not those whose domains leave the grid, by more than rounding, and are cut off."""
    if name != "gimp truncate":
        return slice(None)
    return ~Grid.from_mesh(basis.mesh).outside(basis.particles.x, basis.particles.length * (1 + 1e-9))


# -- bases ---------------------------------------------------------------------------------------------------------

@given(bases())
def test_functions_sum_to_one(case):
    name, basis = case
    held = whole(name, basis)
    assert_allclose(basis.value.sum(axis=0)[held], 1, rtol=0, atol=noise(basis)[0])


@given(bases())
def test_gradients_sum_to_nothing(case):
    name, basis = case
    held = whole(name, basis)
    assert (np.abs(basis.gradient.sum(axis=1)).T[held] <= noise(basis)[1]).all()


@given(bases())
def test_linear_fields_are_read_where_the_point_is(case):
    name, basis = case
    held = whole(name, basis)
    value, _, nodes = functions(basis)
    found, size = (value * nodes).sum(axis=1), np.abs(value * nodes).sum(axis=1).max()
    assert_allclose(found[:, held], middles(name, basis)[:, held], rtol=0, atol=64 * EPS * size)


@given(bases())
def test_linear_fields_have_their_gradient(case):
    name, basis = case
    held = whole(name, basis)
    _, gradient, nodes = functions(basis)
    found = np.einsum("kan,ian->kin", gradient, nodes - nodes[:, :1])
    size = np.einsum("kan,ian->kin", np.abs(gradient), np.abs(nodes))
    error = np.abs(found - np.eye(len(nodes))[:, :, None])[..., held]
    assert (error <= 1e-13 + 64 * EPS * size[..., held]).all()


@given(bases(CARRIERS))
def test_functions_that_carry_mass_are_positive_and_share_out_all_of_it(case):
    _, basis = case
    mass = basis.particles.mass
    assert basis.value.min() >= -4 * EPS
    assert_allclose(basis.stencil.to_nodes(mass).sum(), mass.sum(), rtol=1e-13)


@given(st.data(), bases(CARRIERS))
def test_means_over_cells_lie_between_what_they_are_means_of(data, case):
    """In any units, and in cells that a domain touches by rounding alone; no number is made of nothing."""
    _, basis = case
    body = basis.particles
    values = np.array(data.draw(st.lists(units, min_size=body.n, max_size=body.n)))
    means = Means(shares_of(Grid.from_mesh(basis.mesh), basis.stencil), body.volume * 2.0 ** 200)
    found = means.of_cells(values)
    assert (found >= min(values.min(), 0) - 1e-12).all() and (found <= max(values.max(), 0) + 1e-12).all()


@given(bases(["cmpm", "cubic"]))
def test_patches_read_polynomials_of_as_many_nodes_as_they_have(case):
    """Along an axis a patch of k nodes reads degree k - 1, also in products over the axes."""
    _, basis = case
    stencil, grid = basis.stencil, Grid.from_mesh(basis.mesh)
    for k, axis in enumerate(grid.axes):
        w = stencil.w[k]
        place = axis[np.clip(stencil.base[k] + np.arange(w.shape[1])[:, None], 0, len(axis) - 1)]
        count = ((w != 0).any(axis=0) & (stencil.base[k] + np.arange(w.shape[1])[:, None] >= 0)).sum(axis=0)
        width = np.ptp(np.where((w != 0).any(axis=0), place, place[1]), axis=0)
        local, x = (place - place[1]) / width, (basis.particles.x[k] - place[1]) / width
        for degree in (2, 3):
            told = count > degree
            found, size = (w[0] * local ** degree).sum(axis=0), np.abs(w[0]).sum(axis=0)
            assert (np.abs(found - x ** degree) <= 1e-13 * size)[told].all()
            slope, steep = (w[1] * local ** degree).sum(axis=0) * width, np.abs(w[1] * width).sum(axis=0)
            assert (np.abs(slope - degree * x ** (degree - 1)) <= 1e-13 * steep)[told].all()


@given(bases(["cmpm", "cubic"]))
def test_patches_read_nodes_of_occupied_cells_alone(case):
    _, basis = case
    allowed = np.unique(basis.mesh.t[:, basis.occupied])
    felt = (basis.value != 0) | (basis.gradient != 0).any(axis=0)
    assert np.isin(basis.nodes[felt], allowed).all()


@given(st.data(), st.sampled_from(["fe", "gimp"]), st.integers(1, 3))
def test_what_points_read_does_not_jump_at_a_face(data, kind, dim):
    lines = data.draw(axes(dim, least=3))
    x = np.array([data.draw(places(axis, 1, len(axis) - 2)) for axis in lines])[:, None]
    axis = data.draw(st.integers(0, dim - 1))
    face = lines[axis][data.draw(st.integers(1, len(lines[axis]) - 2))]
    x = np.repeat(x, 3, axis=1)
    x[axis] = np.nextafter(face, -np.inf), face, np.nextafter(face, np.inf)
    grid = Grid.from_mesh(MAKE[dim](*lines))
    index = grid.locate(x)
    smallest = np.array([[step.min()] for step in grid.steps])
    length = np.broadcast_to(smallest * data.draw(st.floats(0.1, 1)), x.shape)
    stencil = grid.linear(x, index) if kind == "fe" else grid.gimp(x, index, length)
    nodal = np.cos(np.arange(grid.nnodes))[None]
    jump = EPS * np.abs(x).max() * np.abs(stencil.gradient()).sum(axis=1).max()
    assert np.ptp(stencil.to_points(nodal)) <= 1e-13 + 4 * jump


@given(st.data())
def test_what_patches_read_does_not_jump_at_a_face_of_a_line(data):
    (line,) = data.draw(axes(1, least=2))
    face = line[data.draw(st.integers(1, len(line) - 2))]
    x = np.array([[np.nextafter(face, -np.inf), face, np.nextafter(face, np.inf)]])
    grid = Grid.from_mesh(MeshLine(line))
    index = grid.locate(x)
    filled = grid.occupied(index) | data.draw(st.lists(st.booleans(), min_size=len(line) - 1, max_size=len(line) - 1))
    stencil = grid.cmpm(x, index, available_sides(np.asarray(filled, dtype=bool)))
    jump = EPS * np.abs(x).max() * np.abs(stencil.gradient()).sum(axis=1).max()
    assert np.ptp(stencil.to_points(np.cos(np.arange(grid.nnodes))[None])) <= 1e-13 + 4 * jump


@settings(max_examples=40)
@given(st.data(), st.integers(1, 3), st.sampled_from(["gimp", "cmpm"]))
def test_user_elements_sum_to_one_and_read_linear_fields_where_they_should(data, dim, kind):
    """GIMP's at edges too if told what is occupied: the mean is then over the rest of the domain."""
    mesh = MAKE[dim](*data.draw(axes(dim, most=3)))
    grid = Grid.from_mesh(mesh)
    smallest = [step.min() * data.draw(st.floats(0.1, 1)) for step in grid.steps]
    elem = USERS[dim][0](smallest) if kind == "gimp" else USERS[dim][1]()
    basis = CellBasis(mesh, elem, intorder=2, dofs=patch_dofs(mesh, elem, occupied=np.arange(mesh.nelements)))
    value = np.stack([np.asarray(fields[0]) for fields in basis.basis])
    gradient = np.stack([fields[0].grad for fields in basis.basis])
    assert_allclose(value.sum(axis=0), 1, atol=1e-12)
    steep = np.abs(gradient).sum(axis=0).max(axis=(1, 2))
    assert (np.abs(gradient.sum(axis=0)).max(axis=(1, 2)) <= 64 * EPS * steep).all()
    for k in range(dim):
        place = basis.doflocs[k][basis.element_dofs]
        found = np.einsum("ikcq,ic->kcq", gradient, place - place[-1])
        size = np.abs(gradient).sum(axis=0) * np.abs(place).max()
        assert (np.abs(found - np.eye(dim)[k][:, None, None]) <= 1e-13 + 64 * EPS * size).all()


# -- operators -----------------------------------------------------------------------------------------------------

def pair_of(basis):
    """Points as the quadrature, with one basis for strain and force."""
    body = basis.particles
    return on_points(body.kinematics, basis.stencil, basis.stencil, body.volume, body.x[0])


@st.composite
def pairs(draw, kinds, twins=(), **kind):
    """Operators of a basis, or of a twin, with the positions of their nodes and what else they came from."""
    name = draw(st.sampled_from([*kinds, *twins]))
    if name in twins:
        mesh, body = draw(layouts(margin=1, **kind))
        support = Covered(mesh, body)
        pair = INTEGRATIONS[name].pair(support, None, None, np.ones(body.n))
    else:
        basis = draw(bases([name], **kind))[1]
        mesh, body, pair = basis.mesh, basis.particles, pair_of(basis)
    return pair, body, nodes_of(mesh)


class Covered:
    """What a twin reads of a support, for points that need not be a sound body."""

    def __init__(self, mesh, body):
        self.grid, self.particles = Grid.from_mesh(mesh), replace(body, spans=np.eye(body.dim)[..., None] * body.length)
        self.index = self.grid.locate(body.x)
        self.cover = Cover(self.grid, self.index, self.particles)


def nodes_of(mesh):
    return np.stack(np.meshgrid(*Grid.from_mesh(mesh).axes, indexing="ij")).reshape(mesh.dim(), -1)


def drawn_stress(data, pair, n):
    """Symmetric stress in the rows of a gradient."""
    places = {tuple(sorted(row)) for row in pair.rows}
    held = {place: np.array(data.draw(st.lists(units, min_size=n, max_size=n))) for place in sorted(places)}
    return np.stack([held[tuple(sorted(row))] for row in pair.rows])


def rigid(body, nodes):
    """Translations and linearised rotations about the body's middle that strain nothing, ``(dim, nnodes)`` each."""
    dim, hoop = len(nodes), body.kinematics.hoop
    moves = [np.eye(dim)[k][:, None] * np.ones(nodes.shape[1]) for k in range(int(hoop), dim)]
    arm = nodes - body.x.mean(axis=1, keepdims=True)
    for i, j in itertools.combinations(range(dim if not hoop else 0), 2):
        turn = np.zeros_like(nodes)
        turn[i], turn[j] = -arm[j], arm[i]
        moves.append(turn / np.abs(turn).max())
    return moves


def size_of(pair, stress):
    """Sum of the sizes of what forces are added up from."""
    tables = pair.force_functions.tables(slice(None))
    return sum((np.abs(stress[q] * pair.volume) * np.abs(tables[l]).sum(axis=0)).sum()
               for terms in pair.terms for q, l in terms)


def stiffness(data, pair, body, nodes):
    """The elastic stiffness of some law over all components of all nodes."""
    law = LinearElastic(E=1.0, nu=data.draw(st.floats(0, 0.49)))
    none = np.zeros((body.kinematics.ncomp, body.n))
    moduli = law.tangent(none, none, np.zeros((0, body.n)), pair.rows) * np.ones(body.n)
    number = np.arange(nodes.size).reshape(nodes.shape[::-1]).T.copy()
    return pair.tangent(moduli, number, nodes.size).toarray()


@given(st.data(), pairs(SOUND, TWINS))
def test_internal_forces_have_no_resultant(data, case):
    pair, body, _ = case
    stress = drawn_stress(data, pair, body.n)
    lost = np.abs(pair.force(stress).sum(axis=1))[int(body.kinematics.hoop):]
    assert (lost <= 1e-13 * size_of(pair, stress)).all()


@given(st.data(), pairs(SOUND, TWINS, motion=st.sampled_from([(2, plane_strain), (3, solid)])))
def test_symmetric_stress_makes_no_torque(data, case):
    pair, body, nodes = case
    stress = drawn_stress(data, pair, body.n)
    arm = nodes - body.x.mean(axis=1, keepdims=True)
    torque = np.einsum("in,jn->ij", arm, pair.force(stress))
    assert np.abs(torque - torque.T).max() <= 1e-13 * size_of(pair, stress) * np.abs(arm).max()


@settings(max_examples=60)
@given(st.data(), pairs(KINDS, TWINS, most=4))
def test_a_conjugate_pair_has_a_symmetric_stiffness_that_never_gives_energy(data, case):
    pair, body, nodes = case
    K = stiffness(data, pair, body, nodes)
    used = np.abs(K).max(axis=1) > 0
    K = K[np.ix_(used, used)]
    assert np.abs(K - K.T).max() <= 1e-13 * np.abs(K).max()
    assert np.linalg.eigvalsh(K)[0] >= -1e-13 * np.abs(K).sum(axis=1).max()


@settings(max_examples=60)
@given(st.data(), pairs(SOUND, TWINS, most=4))
def test_rigid_motions_cost_no_force(data, case):
    pair, body, nodes = case
    K = stiffness(data, pair, body, nodes)
    for move in rigid(body, nodes):
        force, size = K @ move.T.ravel(), np.abs(K) @ np.abs(move.T.ravel())
        assert (np.abs(force) <= 1e-12 * size.max()).all()
