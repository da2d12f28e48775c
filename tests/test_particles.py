"""Points hold what they are given, unchanged for ever, and fill a body exactly."""

import copy
import pickle
from dataclasses import FrozenInstanceError, replace

import meshio
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from skfem import (
    Basis,
    ElementQuad1,
    Functional,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshQuad2,
    MeshTet,
    MeshTri,
    MeshTri2,
    MeshWedge1,
)
from skfem.helpers import dot
from skfem.io.meshio import to_meshio

from skfem_mpm import ParticleBasis, axisymmetric, plane_strain, solid, uniaxial
from skfem_mpm.particles import Particles

RULES = ("quarter", "gauss")


def distorted(mesh):
    """The mesh with its inner and outer nodes moved, each by less than folds a cell."""
    size = mesh.param()
    shift = 0.12 * size * np.sin(7 * np.arange(mesh.p.size).reshape(mesh.p.shape) + 1)
    return type(mesh)(mesh.p + shift, mesh.t)


def axes(*counts):
    return [1 + np.linspace(0, 1, count + 1) ** 1.5 for count in counts]


LINE = MeshLine(axes(5)[0])
QUAD = MeshQuad.init_tensor(*axes(3, 2))
TRI = MeshTri.init_tensor(*axes(3, 2))
HEX = MeshHex.init_tensor(*axes(2, 3, 2))
TET = MeshTet.init_tensor(*axes(2, 1, 2))
STRAIGHT = [(LINE, uniaxial), (LINE, axisymmetric), (QUAD, plane_strain), (QUAD, axisymmetric), (TRI, plane_strain),
            (TRI, axisymmetric), (HEX, solid), (TET, solid)]
BODIES = STRAIGHT + [(distorted(mesh), kinematics) for mesh, kinematics in STRAIGHT]


def names(bodies):
    return [f"{type(mesh).__name__}-{kinematics.name}-{'straight' if k < len(STRAIGHT) else 'distorted'}"
            for k, (mesh, kinematics) in enumerate(bodies)]


def integral(mesh, function):
    """scikit-fem's own integral over the body."""
    return Functional(lambda w: function(w.x)).assemble(Basis(mesh, mesh.elem(), intorder=6))


def measure(kinematics):
    return (lambda x: x[0]) if kinematics.hoop else (lambda x: 1 + 0 * x[0])


def some(n=4, **changes):
    given = dict(x=np.linspace(1, 2, 2 * n).reshape(2, n), volume=np.ones(n), mass=np.ones(n), kinematics=plane_strain)
    return Particles(**(given | changes))


def rich():
    """Points that hold everything that points can hold."""
    random = np.random.default_rng(0)
    return some(length=1 + random.random((2, 4)), sigma=random.normal(size=(4, 4)), epsilon=random.normal(size=(4, 4)),
                velocity=random.normal(size=(2, 4)), history=random.random((3, 4)),
                fields={"heat": random.normal(size=(2, 2, 4))})


# Filling.

@pytest.mark.parametrize("per_cell", [1, 2, 3])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh, kinematics", BODIES, ids=names(BODIES))
def test_volumes_add_up_to_the_body(mesh, kinematics, rule, per_cell):
    particles = Particles.fill(mesh, kinematics, per_cell=per_cell, rule=rule)
    assert_allclose(particles.volume.sum(), integral(mesh, measure(kinematics)), rtol=1e-13)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh, kinematics", BODIES, ids=names(BODIES))
def test_each_cell_gets_its_own_volume_and_its_points_stand_together(mesh, kinematics, rule):
    particles = Particles.fill(mesh, kinematics, per_cell=2, rule=rule)
    basis = Basis(mesh, mesh.elem(), intorder=6)
    cells = Functional(lambda w: measure(kinematics)(w.x)).elemental(basis)
    assert_allclose(particles.volume.reshape(mesh.nelements, -1).sum(axis=1), cells, rtol=1e-13)


@pytest.mark.parametrize("per_cell", [1, 2, 3])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh, kinematics", [body for body in STRAIGHT if not body[1].hoop])
def test_first_moments_are_those_of_the_body(mesh, kinematics, rule, per_cell):
    particles = Particles.fill(mesh, kinematics, per_cell=per_cell, rule=rule)
    moments = [integral(mesh, lambda x, i=i: x[i]) for i in range(mesh.dim())]
    assert_allclose(particles.x @ particles.volume, moments, rtol=1e-13)


@pytest.mark.parametrize("mesh, kinematics", BODIES, ids=names(BODIES))
@pytest.mark.parametrize("per_cell", [1, 2, 3, 4])
def test_quarter_points_number_per_cell_in_every_direction(mesh, kinematics, per_cell):
    assert len(Particles.fill(mesh, kinematics, per_cell=per_cell)) == mesh.nelements * per_cell ** mesh.dim()


@pytest.mark.parametrize("mesh, kinematics", [(MeshLine(), uniaxial), (MeshQuad(), plane_strain), (MeshHex(), solid)])
def test_two_points_stand_at_one_and_three_quarters(mesh, kinematics):
    particles = Particles.fill(mesh, kinematics, per_cell=2)
    expected = np.stack(np.meshgrid(*[[0.25, 0.75]] * mesh.dim())).reshape(mesh.dim(), -1)
    assert sorted(particles.x.T.tolist()) == sorted(expected.T.tolist())


def test_gauss_points_are_scikit_fems():
    basis = Basis(QUAD, QUAD.elem(), intorder=3)
    expected = np.asarray(basis.global_coordinates()).reshape(2, -1)
    order, wanted = Particles.fill(QUAD, plane_strain, rule="gauss"), np.lexsort(expected.round(9))
    found = np.lexsort(order.x.round(9))
    assert_allclose(order.x[:, found], expected[:, wanted], rtol=1e-14)
    assert_allclose(order.volume[found], basis.dx.ravel()[wanted], rtol=1e-13)


@pytest.mark.parametrize("mesh, kinematics", [(MeshTri(), plane_strain), (MeshTet(), solid)])
@pytest.mark.parametrize("per_cell", [1, 2, 3, 5])
def test_parts_of_a_simplex_are_equal_and_their_middles_distinct_and_inside(mesh, kinematics, per_cell):
    cell = type(mesh)(mesh.elem.refdom.p, mesh.elem.refdom.t)
    particles = Particles.fill(cell, kinematics, per_cell=per_cell)
    assert_allclose(particles.volume, particles.volume.mean(), rtol=1e-14)
    assert particles.x.min() > 0 and particles.x.sum(axis=0).max() < 1
    assert len(np.unique(particles.x.round(9), axis=1).T) == per_cell ** mesh.dim()


@pytest.mark.parametrize("mesh, kinematics", [body for body in BODIES if body[0].elem is not TET.elem])
def test_the_parts_of_two_per_cell_are_the_cells_of_the_refined_mesh(mesh, kinematics):
    parts, cells = Particles.fill(mesh, kinematics), Particles.fill(mesh.refined(1), kinematics, per_cell=1)
    found, wanted = (np.lexsort(points.x.round(9)) for points in (parts, cells))
    assert_allclose(parts.x[:, found], cells.x[:, wanted], rtol=1e-13)
    assert_allclose(parts.volume[found], cells.volume[wanted], rtol=1e-12)


@pytest.mark.parametrize("mesh, kinematics", [(MeshTri(), plane_strain), (MeshTet(), solid)])
def test_gauss_points_of_simplices_carry_positive_volumes(mesh, kinematics):
    for per_cell in (1, 2, 3, 4):    # scikit-fem's rules of order 3 have a negative weight
        assert Particles.fill(mesh, kinematics, per_cell=per_cell, rule="gauss").volume.min() > 0
    with pytest.raises(ValueError, match="no Gauss rule of order 99 .* use rule='quarter'"):
        Particles.fill(MeshTet(), solid, per_cell=50, rule="gauss")


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh", [
    LINE, QUAD, HEX, QUAD.mirrored((1, 0), (2, 0)), MeshQuad(QUAD.p, np.roll(QUAD.t, 1, axis=0))])
def test_boxes_have_the_edges_of_their_parts_whatever_the_order_of_corners(mesh, rule):
    kinematics = {1: uniaxial, 2: plane_strain, 3: solid}[mesh.dim()]
    particles = Particles.fill(mesh, kinematics, per_cell=2, rule=rule)
    edges = np.ptp(mesh.p[:, mesh.t], axis=1) / 2
    assert_allclose(particles.length, np.repeat(edges, 2 ** mesh.dim(), axis=1), rtol=1e-12)


@pytest.mark.parametrize("mesh", [TRI, TET, distorted(QUAD), distorted(HEX)])
def test_other_cells_have_the_edge_of_the_cube_of_their_volume(mesh):
    particles = Particles.fill(mesh, {2: plane_strain, 3: solid}[mesh.dim()])
    assert_allclose(particles.length, [particles.volume ** (1 / mesh.dim())] * mesh.dim(), rtol=1e-13)


def test_the_edges_do_not_know_about_rings():
    for mesh in (LINE, QUAD, TRI, distorted(QUAD)):
        flat = Particles.fill(mesh, uniaxial if mesh is LINE else plane_strain)
        assert_array_equal(Particles.fill(mesh, axisymmetric).length, flat.length)


def test_far_from_the_origin_the_volumes_stay_exact():
    mesh = MeshQuad.init_tensor(2.0**30 + np.arange(4.0), 2.0**30 + np.arange(3.0))
    assert_allclose(Particles.fill(mesh, plane_strain).volume, 0.25, rtol=1e-15)


@pytest.mark.parametrize("power", [30, 7, -30])
@pytest.mark.parametrize("per_cell", [2, 3])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh, kinematics", BODIES, ids=names(BODIES))
def test_units_of_powers_of_two_change_no_bit(mesh, kinematics, rule, per_cell, power):
    one, other = (Particles.fill(body, kinematics, rule=rule, per_cell=per_cell)
                  for body in (mesh, mesh.scaled(2.0 ** power)))
    space = one.dim + kinematics.hoop
    assert_array_equal(other.x, one.x * 2.0 ** power)
    assert_array_equal(other.volume, one.volume * 2.0 ** (power * space))


def test_filling_twice_gives_the_same_bits():
    first, second = (Particles.fill(distorted(HEX), solid).arrays() for _ in range(2))
    assert all((first[name] == second[name]).all() for name in first)


def test_mass_is_density_times_volume():
    assert_array_equal(Particles.fill(QUAD, plane_strain).mass, Particles.fill(QUAD, plane_strain).volume)
    whole = Particles.fill(QUAD, plane_strain, density=2000)
    assert_allclose(whole.mass, 2000 * whole.volume)
    density = 1 + whole.x[0]
    assert_allclose(Particles.fill(QUAD, plane_strain, density=density).mass, density * whole.volume)


def test_a_predicate_keeps_points_in_order():
    whole = Particles.fill(QUAD, axisymmetric)
    left = Particles.fill(QUAD, axisymmetric, where=lambda x: x[0] + x[1] < 3)
    assert 0 < len(left) < len(whole)
    for name, array in whole.where(whole.x[0] + whole.x[1] < 3).arrays().items():
        assert_array_equal(left.arrays()[name], array)


def test_cells_that_the_predicate_leaves_out_may_lie_beyond_the_axis():
    ghosts = MeshQuad.init_tensor(np.linspace(-1, 2, 4), np.linspace(0, 1, 2))
    assert_allclose(Particles.fill(ghosts, axisymmetric, where=lambda x: x[0] > 0).volume.sum(), 2.0)
    with pytest.raises(ValueError, match="cell 0 reaches to the radius -1.0"):
        Particles.fill(ghosts, axisymmetric)
    across = MeshQuad.init_tensor(np.linspace(-0.1, 1, 2), np.linspace(0, 1, 2))
    with pytest.raises(ValueError, match="reaches to the radius -0.1"):    # though its only point lies at r > 0
        Particles.fill(across, axisymmetric, per_cell=1)


@pytest.mark.parametrize("change, error, match", [
    (dict(rule="lobatto"), ValueError, "rule: got 'lobatto', expected one of 'quarter', 'gauss'"),
    (dict(per_cell=0), ValueError, "per_cell: got 0, expected at least 1"),
    (dict(per_cell=2.0), TypeError, "per_cell: got 2.0, expected an integer"),
    (dict(per_cell=True), TypeError, "per_cell: got True"),
    (dict(density=0.0), ValueError, "density: got 0.0, expected a number above zero"),
    (dict(density=-1), ValueError, "density: got -1.0"),
    (dict(density=np.nan), ValueError, "density: got nan"),
    (dict(density="steel"), TypeError, "density: got an array of"),
    (dict(density=np.ones(3)), ValueError, r"density: got shape \(3,\), expected \(24,\)"),
    (dict(density=np.linspace(1, 0, 24)), ValueError, "density: got 0.0 at point 23"),
    (dict(where="left"), TypeError, "where: got str, expected a function"),
    (dict(where=lambda x: x[0]), ValueError, "where: got float64 of shape"),
    (dict(where=lambda x: True), ValueError, r"where: got bool of shape \(\) .* expected bool of shape \(24,\)"),
    (dict(where=lambda x: x < 1.5), ValueError, r"where: got bool of shape \(2, 24\)"),
    (dict(where=lambda x: x[0] < 0), ValueError, "where: keeps no points of 24"),
    (dict(kinematics=solid), ValueError, "got solid in 2 dimension"),
    (dict(kinematics="plane"), TypeError, "kinematics: got 'plane'"),
    (dict(mesh=3), TypeError, r"mesh: got int, .* Particles\.from_meshio"),
    (dict(mesh=MeshTri2()), ValueError, r"mesh: got MeshTri2, .* MeshTri1.from_mesh\(mesh\)"),
    (dict(mesh=MeshQuad2()), ValueError, "mesh: got MeshQuad2"),
    (dict(mesh=MeshWedge1(), kinematics=solid), ValueError, "mesh: got MeshWedge1"),
    (dict(mesh=MeshQuad(np.array([[0, 1, 0, 1.0], [0, 0, 1, 1]]), np.arange(4)[:, None])), ValueError, "0 is folded"),
    (dict(mesh=MeshTri(np.array([[0, 1, 2.0], [0, 0, 0]]), np.arange(3)[:, None])), ValueError, "has no volume"),
])
def test_filling_says_what_is_wrong(change, error, match):
    with pytest.raises(error, match=match):
        Particles.fill(**(dict(mesh=QUAD, kinematics=plane_strain) | change))


def test_a_straightened_mesh_can_be_filled_as_the_message_says():
    assert_allclose(Particles.fill(MeshTri.from_mesh(MeshTri2()), plane_strain).volume.sum(), 1)


# meshio.

@pytest.mark.parametrize("mesh, kinematics", STRAIGHT, ids=names(STRAIGHT))
def test_a_meshio_body_gives_the_points_of_its_mesh(mesh, kinematics):
    found = Particles.from_meshio(to_meshio(mesh), kinematics, density=3.0, per_cell=2)
    expected = Particles.fill(mesh, kinematics, density=3.0, per_cell=2)
    assert_allclose(found.x, expected.x, rtol=1e-14)
    assert_allclose(found.mass, expected.mass, rtol=1e-13)


@pytest.mark.parametrize("ending", [".vtk", ".msh", ".vtu"])
@pytest.mark.parametrize("mesh, kinematics", [(QUAD, axisymmetric), (TET, solid), (HEX, solid)])
def test_a_file_gives_the_points_of_its_mesh(tmp_path, mesh, kinematics, ending):
    path = tmp_path / f"body{ending}"
    points = np.pad(mesh.p.T, ((0, 0), (0, 3 - mesh.dim())))
    body = to_meshio(mesh, encode_cell_data=False)
    meshio.write(path, meshio.Mesh(points, body.cells), **({"file_format": "gmsh"} if ending == ".msh" else {}))
    expected = Particles.fill(mesh, kinematics, per_cell=1, rule="gauss")
    for name in (path, str(path)):
        found = Particles.from_meshio(name, kinematics, rule="gauss")
        assert_allclose(found.x, expected.x, rtol=1e-12)
        assert_allclose(found.volume, expected.volume, rtol=1e-12)


def test_boundary_cells_and_unused_points_are_passed_over():
    points = np.vstack([[9.0, 9.0], QUAD.p.T])
    quads = QUAD.t.T + 1
    body = meshio.Mesh(points, [("vertex", [[1]]), ("line", [[1, 2]]), ("quad", quads[:2]), ("quad", quads[2:])])
    found = Particles.from_meshio(body, plane_strain)
    assert_array_equal(found.x, Particles.fill(QUAD, plane_strain, per_cell=1).x)


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])


@pytest.mark.parametrize("body, error, match", [
    (meshio.Mesh(SQUARE, [("quad", [[0, 1, 2, 3]]), ("triangle", [[1, 4, 2]])]), ValueError, "several kinds of cells"),
    (meshio.Mesh(SQUARE, []), ValueError, "no usable cells .none at all."),
    (meshio.Mesh(SQUARE, [("vertex", [[0]])]), ValueError, "no usable cells .vertex."),
    (meshio.Mesh(SQUARE, [("triangle6", [[0, 1, 2, 3, 4, 0]])]), ValueError, "no usable cells .triangle6."),
    (meshio.Mesh(SQUARE[:, [0, 2, 1]], [("quad", [[0, 1, 2, 3]])]), ValueError, r"leave the first 2 coordinate\(s\)"),
    (3, TypeError, "body: got int, expected a meshio.Mesh or the path"),
    ("no/such/file.vtk", FileNotFoundError, "there is no such file"),
])
def test_a_body_that_cannot_be_filled_is_refused(body, error, match):
    with pytest.raises(error, match=match):
        Particles.from_meshio(body, plane_strain)


@pytest.mark.parametrize("name", ["body.vtk", "body.unheard"])
def test_an_unreadable_file_does_not_end_the_program(tmp_path, name):
    (tmp_path / name).write_text("not a mesh")
    with pytest.raises(ValueError, match="meshio cannot read"):
        Particles.from_meshio(tmp_path / name, plane_strain)


# Domains as parallelograms.

def turned(mesh, degrees=20.0):
    """The mesh turned in the plane of its first two axes, and the matrix that did it."""
    turn = np.eye(mesh.dim())
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[:2, :2] = [[c, -s], [s, c]]
    return type(mesh)(turn @ mesh.p, mesh.t), turn


@pytest.mark.parametrize("mesh, kinematics", BODIES[:len(STRAIGHT)], ids=names(BODIES[:len(STRAIGHT)]))
def test_boxes_along_the_axes_and_simplices_have_no_spans(mesh, kinematics):
    assert Particles.fill(mesh, kinematics).spans is None


@pytest.mark.parametrize("per_cell", [1, 2, 3])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mesh, kinematics", [(distorted(QUAD), plane_strain), (distorted(HEX), solid)])
def test_spans_are_as_large_as_the_points(mesh, kinematics, rule, per_cell):
    particles = Particles.fill(mesh, kinematics, per_cell=per_cell, rule=rule)
    assert_allclose(np.linalg.det(particles.spans.transpose(2, 0, 1)), particles.volume, rtol=1e-12)
    assert Particles.fill(mesh, kinematics, per_cell=per_cell, where=lambda x: x[0] > 1.5).spans.shape[2] < particles.n


def test_spans_are_areas_in_axial_symmetry_too():
    ring, flat = (Particles.fill(distorted(QUAD), kinematics) for kinematics in (axisymmetric, plane_strain))
    assert_allclose(ring.spans, flat.spans, rtol=1e-14)


@pytest.mark.parametrize("per_cell", [1, 2, 3])
@pytest.mark.parametrize("mesh, kinematics", [(QUAD, plane_strain), (HEX, solid)])
def test_parallelograms_of_a_turned_body_tile_it(mesh, kinematics, per_cell):
    """They are the boxes of the body as it was, turned with it: edge for edge, whatever order and sense edges have."""
    straight, (body, turn) = Particles.fill(mesh, kinematics, per_cell=per_cell), turned(mesh)
    particles = Particles.fill(body, kinematics, per_cell=per_cell)
    assert_allclose(particles.x, turn @ straight.x, atol=1e-14)
    back = np.abs(np.einsum("ki,kjn->ijn", turn, particles.spans))
    assert_allclose(back.sum(axis=1), straight.length, rtol=1e-12)      # one edge along each axis, of the box's length
    assert_allclose(back.max(axis=1), straight.length, rtol=1e-12)


def test_spans_point_along_the_cells_of_a_polar_mesh():
    mesh = MeshQuad.init_tensor(np.linspace(1, 2, 5), np.linspace(0, np.pi / 2, 9))
    polar = MeshQuad(mesh.p[0] * np.stack([np.cos(mesh.p[1]), np.sin(mesh.p[1])]), mesh.t)
    particles = Particles.fill(polar, plane_strain)
    radius = np.hypot(*particles.x)
    size = np.linalg.norm(particles.spans, axis=0)
    across = np.abs(np.einsum("in,ijn->jn", particles.x / radius, particles.spans)) / size
    assert ((across > 0.99) | (across < 0.1)).all() and (across.max(axis=0) > 0.99).all()
    radial = across.argmax(axis=0)
    assert_allclose(size[radial, np.arange(particles.n)], 1 / 8, rtol=0.01)
    assert_allclose(size[1 - radial, np.arange(particles.n)], radius * np.pi / 32, rtol=0.01)


# Holding.

def test_arrays_holds_nothing_but_what_is_there():
    assert list(some().arrays()) == ["x", "volume", "mass"]
    assert some().length is some().sigma is some().epsilon is None and dict(some().fields) == {}
    assert list(rich().arrays()) == ["x", "volume", "mass", "length", "sigma", "epsilon", "velocity", "history", "heat"]


def test_stress_and_strain_are_tensors_and_zero_if_not_held():
    assert_array_equal(some().stress, np.zeros((3, 3, 4)))
    assert_array_equal(some().strain, np.zeros((3, 3, 4)))
    packed = np.arange(16.0).reshape(4, 4)
    held = some(sigma=packed, epsilon=2 * packed)
    assert_array_equal(held.stress, plane_strain.tensor(packed))
    assert_array_equal(held.strain, plane_strain.tensor(2 * packed))


def test_size_and_repr():
    particles = some(fields={"heat": np.ones(4)})
    assert (len(particles), particles.n, particles.dim) == (4, 4, 2)
    assert repr(particles) == ("<skfem_mpm Particles(plane strain) object>\n  Number of points: 4\n  Dimension: 2\n"
                               "  Arrays: x, volume, mass\n  Own fields: heat")


def test_everything_held_is_read_only():
    particles = replace(Particles.fill(QUAD, plane_strain), fields={"heat": np.ones(24)})
    for held in (particles, particles.where(np.arange(3)), replace(particles, x=particles.x + 1)):
        for array in held.arrays().values():
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
    with pytest.raises(TypeError):
        particles.fields["heat"] = np.zeros(24)
    with pytest.raises(FrozenInstanceError):
        particles.x = particles.x + 1


def test_the_users_array_stays_writable_and_writing_to_it_does_not_reach_the_snapshot():
    x, heat = np.ones((2, 4)), np.ones(4)
    own = {"heat": heat}
    alias = x[:]
    alias.flags.writeable = False    # read-only, but of memory that is not
    snapshots = some(x=x, fields=own), some(x=alias, fields=own)
    x[:], heat[:], own["cold"] = 7, 7, heat
    for snapshot in snapshots:
        assert (snapshot.x == 1).all() and (snapshot.fields["heat"] == 1).all() and list(snapshot.fields) == ["heat"]


def test_replace_shares_what_it_does_not_replace():
    particles = some(fields={"heat": np.ones(4)})
    moved = replace(particles, x=particles.x + 1)
    assert_array_equal(moved.x, particles.x + 1)
    assert all(moved.arrays()[name] is particles.arrays()[name] for name in ("volume", "mass", "heat"))


def test_a_read_only_array_is_taken_without_a_copy():
    x = np.ones((2, 4))
    x.flags.writeable = False
    assert some(x=x).x is x


@pytest.mark.parametrize("clone", [copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
def test_copies_and_pickles_are_frozen_too(clone):
    particles = rich()
    again = clone(particles)
    assert again.kinematics == particles.kinematics
    assert list(again.arrays()) == list(particles.arrays())
    for name, array in particles.arrays().items():
        assert_array_equal(again.arrays()[name], array)
        assert not again.arrays()[name].flags.writeable


def test_lists_and_single_precision_become_doubles():
    particles = some(volume=[1.0, 2.0, 3.0, 4.0], mass=np.ones(4, dtype=np.float32))
    assert particles.volume.dtype == particles.mass.dtype == float


def test_where_takes_masks_and_numbers():
    particles = rich()
    for which in ([False, True, False, True], np.array([1, 3]), [1, 3]):
        subset = particles.where(which)
        assert list(subset.arrays()) == list(particles.arrays())
        for name, array in particles.arrays().items():
            assert_array_equal(subset.arrays()[name], array[..., [1, 3]])
    assert_array_equal(particles.where([3, 1]).x, particles.x[:, [3, 1]])


def test_forms_see_velocity_and_history():
    mesh = MeshQuad.init_tensor(np.linspace(0.5, 2.5, 3), np.linspace(0.5, 2.5, 3))
    points = rich()
    basis = ParticleBasis(mesh, ElementQuad1(), points)
    moving = Functional(lambda w: w.mass / w.volume * dot(w.velocity, w.velocity) / 2).assemble(basis)
    assert_allclose(moving, (points.mass * (points.velocity ** 2).sum(axis=0)).sum() / 2)
    worn = Functional(lambda w: w.history[1]).assemble(basis)
    assert_allclose(worn, points.history[1] @ points.volume)


@pytest.mark.parametrize("which, error, match", [
    ([0.0, 1.0], TypeError, "which: got an array of float64"),
    ([True, False], ValueError, r"which: got shape \(2,\), expected a mask \(4,\)"),
    (2, ValueError, r"which: got shape \(\)"),
    ([], ValueError, "which: keeps no points of 4"),
    ([False] * 4, ValueError, "which: keeps no points of 4"),
    ([-1, 2], ValueError, "which: got point numbers -1 to 2, expected 0 to 3"),
    ([4], ValueError, "which: got point numbers 4 to 4, expected 0 to 3"),
    ([1, 2, 1], ValueError, "which: got point 1 more than once"),
])
def test_where_says_what_is_wrong(which, error, match):
    with pytest.raises(error, match=match):
        some().where(which)


@pytest.mark.parametrize("change, error, match", [
    (dict(x=np.ones((4, 2))), ValueError, r"x: got shape \(4, 2\), expected \(dim, n\); transpose it"),
    (dict(x=np.ones(4)), ValueError, r"x: got shape \(4,\), expected \(dim, n\); write x\[None, :\]"),
    (dict(x=np.ones((3, 4))), ValueError, "got plane strain in 3 dimension"),
    (dict(x=np.ones((2, 0)), volume=np.ones(0), mass=np.ones(0)), ValueError, "x: got no points"),
    (dict(x=np.ones((2, 4), dtype=int)), TypeError, r"x: got an array of int64, expected floats"),
    (dict(x=np.full((2, 4), np.nan)), ValueError, r"x: got nan at index \(0, 0\)"),
    (dict(x=np.ones((2, 4)) * [0, 1, 2, 3], kinematics=axisymmetric), ValueError, "radius.: got 0.0 at point 0"),
    (dict(x=np.ones((2, 4)) * [3, 2, 1, -1], kinematics=axisymmetric), ValueError, "radius.: got -1.0 at point 3"),
    (dict(volume=np.ones((1, 4))), ValueError, r"volume: got shape \(1, 4\), expected \(4,\)"),
    (dict(volume=None), TypeError, "volume: got an array of object"),
    (dict(volume=np.array([1.0, 0, 1, 1])), ValueError, "volume: got 0.0 at point 1"),
    (dict(mass=np.array([1.0, 1, -2, 1])), ValueError, "mass: got -2.0 at point 2"),
    (dict(mass=np.array([1.0, 1, np.inf, 1])), ValueError, "mass: got inf"),
    (dict(length=np.ones((4, 2))), ValueError, r"length: got shape \(4, 2\), expected \(2, 4\).*transpose it"),
    (dict(length=np.array([[1.0, 1, 1, 1], [1, 1, 0, 1]])), ValueError, "length: got 0.0 at point 2"),
    (dict(sigma=np.ones((3, 4))), ValueError, r"sigma: got shape \(3, 4\), expected \(4, 4\)"),
    (dict(sigma=np.ones((3, 3, 4))), ValueError, r"sigma: got shape \(3, 3, 4\), expected \(4, 4\)"),
    (dict(epsilon=np.full((4, 4), np.nan)), ValueError, "epsilon: got nan"),
    (dict(velocity=np.ones((4, 2))), ValueError, r"velocity: got shape \(4, 2\), expected \(2, 4\).*transpose it"),
    (dict(velocity=np.ones(4)), ValueError, r"velocity: got shape \(4,\), expected \(2, 4\)"),
    (dict(velocity=np.full((2, 4), np.inf)), ValueError, "velocity: got inf"),
    (dict(history=np.ones(4)), ValueError, r"history: got shape \(4,\), expected \(k, 4\).* write history\[None, :\]"),
    (dict(history=np.ones((4, 1))), ValueError, r"history: got shape \(4, 1\), expected \(k, 4\).*transpose it"),
    (dict(history=np.ones((1, 3))), ValueError, r"history: got shape \(1, 3\), expected \(k, 4\)"),
    (dict(history=np.full((1, 4), np.nan)), ValueError, "history: got nan"),
    (dict(history=np.ones((1, 4), dtype=int)), TypeError, "history: got an array of int64"),
    (dict(kinematics="plane"), TypeError, "kinematics: got 'plane'"),
    (dict(fields=[np.ones(4)]), TypeError, "fields: got list, expected a dict"),
    (dict(fields={3: np.ones(4)}), TypeError, "fields: got the name 3, expected a string"),
    (dict(fields={"my heat": np.ones(4)}), ValueError, "written as w.name"),
    (dict(fields={"heat": np.ones((4, 2))}), ValueError, r"fields\['heat'\]: got shape \(4, 2\).*transpose it"),
    (dict(fields={"heat": np.ones(3)}), ValueError, r"fields\['heat'\]: got shape \(3,\), expected \(..., 4\)\."),
    (dict(fields={"heat": 1.0}), ValueError, r"fields\['heat'\]: got shape \(\)"),
    (dict(fields={"heat": np.ones(4, dtype=int)}), TypeError, r"fields\['heat'\]: got an array of int64"),
    (dict(fields={"heat": np.array([1.0, 2, np.nan, 4])}), ValueError, r"fields\['heat'\]: got nan at index \(2,\)"),
])
def test_particles_say_what_is_wrong(change, error, match):
    with pytest.raises(error, match=match):
        some(**change)


@pytest.mark.parametrize("name", ["x", "h", "n", "idx", "volume", "mass", "length", "stress", "strain", "sigma",
                                  "epsilon", "velocity", "history", "kinematics", "fields", "dim", "values", "items"])
def test_own_fields_must_not_hide_what_forms_already_know(name):
    with pytest.raises(ValueError, match=f"fields: got the name '{name}', which means something else"):
        some(fields={name: np.ones(4)})


def test_replacing_goes_through_the_same_checks():
    with pytest.raises(ValueError, match="volume: got -1.0 at point 0"):
        replace(some(), volume=-np.ones(4))
