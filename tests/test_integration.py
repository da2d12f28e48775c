"""The sparse operators of a solver are scikit-fem's own forms on points; what supports a body in a step is sound."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import ELEMENT, FLUTTERING, MAKE, every_method, every_motion, symmetric_methods
from skfem import (
    BilinearForm,
    ElementVector,
    LinearForm,
    MeshQuad,
)
from skfem.helpers import ddot, grad

from skfem_mpm import METHODS, Hencky, LinearElastic, Particles, axisymmetric, plane_strain, solid, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.grid import Grid
from skfem_mpm.implicit import implicit_steps
from skfem_mpm.integration import INTEGRATIONS, find_integration, on_points
from skfem_mpm.kinematics import Logarithmic
from skfem_mpm.support import Support

AXES = [np.array([1, 1.2, 1.5, 1.7, 2.1, 2.3, 2.6]), np.array([0, 0.25, 0.6, 0.8, 1.1, 1.4]),
        np.array([-0.2, 0.1, 0.4, 0.7, 0.9])]                     # graded


def grid_mesh(dim):
    return MAKE[dim](*AXES[:dim])


class Scene:
    """Random points of random sizes in the inner cells of a graded mesh, seen by the bases of a method."""

    def __init__(self, kinematics, dim, method, n=60, seed=0):
        random = np.random.default_rng(seed)
        self.random, self.kinematics, self.dim = random, kinematics, dim
        self.mesh, self.elem = grid_mesh(dim), ElementVector(ELEMENT[dim]())
        low, high = (np.array([[axis[k] for axis in AXES[:dim]]]).T for k in (1, -2))
        x = low + (high - low) * random.uniform(size=(dim, n))
        self.particles = Particles(x, random.uniform(0.5, 1, n), random.uniform(0.5, 1, n), kinematics,
                                   length=random.uniform(0.02, 0.19, (dim, n)))
        self.force, self.strain = (getattr(METHODS[method], part)(self.mesh, self.elem, self.particles)
                                   for part in ("force", "strain"))
        self.operator = on_points(kinematics, self.force.stencil, self.strain.stencil, self.particles.volume,
                                         x[0])
        self.rows = kinematics.rows(dim)
        self.dofs = self.force.nodal_dofs[:, Grid.from_mesh(self.mesh).vertices.ravel()]    # (dim, nodes of the grid)

    def nodal(self):
        return self.random.uniform(-1, 1, self.dofs.shape)

    def of_points(self, *shape):
        return self.random.uniform(-1, 1, (*shape, self.particles.n))

    def vector(self, nodal):
        out = np.zeros(self.dofs.size)
        out[self.dofs] = nodal
        return out


def gradient_row(field, w, place):
    """One component of the displacement gradient in a form."""
    return field[0] / w.x[0] if place == (2, 2) and len(grad(field)) < 3 else grad(field)[place]


@every_motion
@every_method
def test_the_gradient_is_that_of_the_strain_basis(kinematics, dim, method):
    scene = Scene(kinematics, dim, method)
    u = scene.nodal()
    field, x = scene.strain.interpolate(scene.vector(u)), scene.particles.x
    slopes = [np.asarray(field)[0, :, 0] / x[0] if place == (2, 2) and dim < 3 else field.grad[place][:, 0]
              for place in scene.rows]
    assert_allclose(scene.operator.gradient(u), np.stack(slopes), atol=1e-13 * np.abs(slopes).max())


@every_motion
@every_method
def test_the_force_of_a_stress_is_scikit_fems_form(kinematics, dim, method):
    """One form for every kinematics: ddot(w.stress, strain(v, w))."""
    scene = Scene(kinematics, dim, method)
    sigma = scene.of_points(kinematics.ncomp)
    basis = METHODS[method].force(scene.mesh, scene.elem, replace(scene.particles, sigma=sigma))
    expected = LinearForm(lambda v, w: ddot(w.stress, kinematics.strain(v, w))).assemble(basis)[scene.dofs]
    packed = np.stack([sigma[kinematics.packed_index(place)] for place in scene.rows])
    assert_allclose(scene.operator.force(packed), expected, atol=1e-13 * np.abs(expected).max())


@every_motion
@every_method
def test_the_force_of_an_unsymmetric_stress_is_scikit_fems_form(kinematics, dim, method):
    scene = Scene(kinematics, dim, method)
    piola = scene.of_points(len(scene.rows))
    form = LinearForm(lambda v, w: sum(w.piola[q] * gradient_row(v, w, place) for q, place in enumerate(scene.rows)))
    expected = form.assemble(scene.force, piola=scene.force.field(piola))[scene.dofs]
    assert_allclose(scene.operator.force(piola), expected, atol=1e-13 * np.abs(expected).max())


@every_motion
@every_method
@pytest.mark.parametrize("uniform", [False, True])
def test_the_tangent_is_scikit_fems_mixed_form(kinematics, dim, method, uniform):
    scene = Scene(kinematics, dim, method, n=20 if dim == 3 else 60)
    m = len(scene.rows)
    moduli = scene.random.uniform(-1, 1, (m, m, 1)) if uniform else scene.of_points(m, m)
    full = np.broadcast_to(moduli, (m, m, scene.particles.n))

    @BilinearForm
    def form(u, v, w):
        of_u, of_v = (np.array([gradient_row(field, w, place) for place in scene.rows])[..., 0] for field in (u, v))
        return np.einsum("qn,qrn,rn->n", of_v, w.moduli[..., 0], of_u)[:, None]

    expected = form.assemble(scene.strain, scene.force, moduli=scene.force.field(full)).toarray()
    nodes = scene.dofs.shape[1]
    order = scene.dofs.T.ravel()                       # unknowns ascend with node, then component
    expected = expected[order][:, order]
    number = np.arange(order.size).reshape(nodes, dim).T
    found = scene.operator.tangent(moduli, number, order.size).toarray()
    assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())

    left_out = scene.random.uniform(size=nodes) < 0.4                  # unknowns that do not take part
    kept = np.flatnonzero(~left_out)
    number = np.full((dim, nodes), -1)
    number[:, kept] = np.arange(dim * kept.size).reshape(kept.size, dim).T
    part = scene.operator.tangent(moduli, number, dim * kept.size).toarray()
    inner = (kept[:, None] * dim + np.arange(dim)).ravel()
    assert_allclose(part, expected[inner][:, inner], atol=1e-13 * np.abs(expected).max())


@every_method
def test_many_points_are_handled_piece_by_piece_without_seams(method):
    scene = Scene(axisymmetric, 2, method, n=20000)
    sigma, u = scene.of_points(4), scene.nodal()
    basis = METHODS[method].force(scene.mesh, scene.elem, replace(scene.particles, sigma=sigma))
    expected = LinearForm(lambda v, w: ddot(w.stress, axisymmetric.strain(v, w))).assemble(basis)[scene.dofs]
    packed = np.stack([sigma[axisymmetric.packed_index(place)] for place in scene.rows])
    assert_allclose(scene.operator.force(packed), expected, atol=1e-12 * np.abs(expected).max())
    one = np.ones((5, 5, 1))
    number = np.arange(scene.dofs.size).reshape(-1, 2).T
    force = scene.operator.force(np.ones((5, 5)) @ scene.operator.gradient(u))
    tangent = scene.operator.tangent(one, number, scene.dofs.size) @ u.T.ravel()
    assert_allclose(tangent.reshape(-1, 2).T, force, atol=1e-11 * np.abs(force).max())


@every_motion
@every_method
@pytest.mark.parametrize("law", [LinearElastic(E=2.0, nu=0.3), Hencky(E=2.0, nu=0.3)],
                         ids=lambda law: type(law).__name__)
def test_the_tangent_is_the_derivative_of_the_force(kinematics, dim, method, law):
    """Also at large strain and on prestrained points: with stress relative to the start there is no geometric term."""
    scene = Scene(kinematics, dim, method)
    shear = [i != j and (i, j) not in scene.rows for i, j in kinematics.components]
    epsilon = 0.1 * scene.of_points(kinematics.ncomp)
    epsilon[shear] = 0
    motion = Logarithmic(kinematics, dim, law, np.zeros_like(epsilon), epsilon)

    def force(u):
        return scene.operator.force(motion.respond(scene.operator.gradient(u)).piola)

    u, change = 0.01 * scene.nodal(), scene.nodal()
    number = np.arange(u.size).reshape(-1, dim).T
    tangent = scene.operator.tangent(motion.respond(scene.operator.gradient(u)).tangent(), number, u.size)
    expected = (force(u + 1e-6 * change) - force(u - 1e-6 * change)) / 2e-6
    found = (tangent @ change.T.ravel()).reshape(-1, dim).T
    assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


@every_motion
@every_method
def test_internal_force_moves_no_body_as_a_whole(kinematics, dim, method):
    """Functions sum to one; only the hoop stress pulls towards the axis, with its volume over the radius."""
    scene = Scene(kinematics, dim, method)
    piola = scene.of_points(len(scene.rows))
    expected = np.zeros(dim)
    if kinematics.hoop:
        expected[0] = (scene.particles.volume * piola[-1] / scene.particles.x[0]).sum()
    force = scene.operator.force(piola)
    assert_allclose(force.sum(axis=1), expected, atol=1e-13 * np.abs(force).sum())


def work(scene):
    """Virtual work at the nodes and at the points."""
    piola, u = scene.of_points(len(scene.rows)), scene.nodal()
    return (u * scene.operator.force(piola)).sum(), (scene.particles.volume * piola * scene.operator.gradient(u)).sum()


@every_motion
@symmetric_methods
def test_conjugate_pairs_do_the_same_work_at_nodes_and_points(kinematics, dim, method):
    scene = Scene(kinematics, dim, method)
    at_nodes, at_points = work(scene)
    assert at_nodes == pytest.approx(at_points, rel=1e-12, abs=1e-12)


@every_motion
@symmetric_methods
def test_conjugate_pairs_and_a_stored_energy_make_symmetric_stiffness(kinematics, dim, method):
    scene = Scene(kinematics, dim, method)
    law, zero = Hencky(E=2.0, nu=0.3), np.zeros((kinematics.ncomp, scene.particles.n))
    gradient = scene.operator.gradient(0.01 * scene.nodal())
    moduli = Logarithmic(kinematics, dim, law, zero, None).respond(gradient).tangent()
    size = scene.dofs.size
    stiffness = scene.operator.tangent(moduli, np.arange(size).reshape(-1, dim).T, size).toarray()
    assert_allclose(stiffness, stiffness.T, atol=1e-13 * np.abs(stiffness).max())


@pytest.mark.parametrize("method", FLUTTERING)
def test_cmpm_recovers_a_strain_that_is_not_conjugate_to_its_force(method):
    """A known property of the paper's CMPM, and of all methods with two bases for strain and force."""
    at_nodes, at_points = work(Scene(plane_strain, 2, method))
    assert abs(at_nodes - at_points) > 1e-3 * abs(at_points)


def test_all_ways_to_integrate_have_a_name():
    assert find_integration("points") is INTEGRATIONS["points"]


# Which nodes carry the body.

def block(dim=2, cells=10, kinematics=plane_strain, where=None, **changes):
    """A body inside a mesh of the unit box, two empty cells wide at least on every side."""
    axis = np.linspace(0, 1, cells + 1)
    mesh = MAKE[dim](*[axis] * dim)
    inside = where or (lambda x: (np.abs(x - 0.5) < 0.3).all(axis=0))
    return mesh, replace(Particles.fill(mesh, kinematics, where=inside), **changes)


def l_shape(x):
    return (np.abs(x - 0.5) < 0.3).all(axis=0) & ~(x > 0.5).all(axis=0)


def positions(grid):
    return np.stack([part.ravel() for part in np.meshgrid(*grid.axes, indexing="ij")])


BODIES = {"bar": dict(dim=1, kinematics=uniaxial), "block": dict(), "L": dict(where=l_shape),
          "box": dict(dim=3, cells=6, kinematics=solid)}
every_body = pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)


@every_body
@every_method
def test_slaved_nodes_follow_every_linear_field(body, method):
    mesh, particles = block(**body)
    support = Support(mesh, particles, METHODS[method], "ghost", [])
    x, random = positions(support.grid), np.random.default_rng(1)
    field = random.uniform(-1, 1, (support.grid.dim, 1)) + random.uniform(-1, 1, (support.grid.dim,) * 2) @ x
    out = support.spread(field[:, support.solved_nodes].T.ravel())
    assert_allclose(out[:, support.known], field[:, support.known], atol=1e-13)
    assert not out[:, ~support.known].any()
    assert support.slaved == METHODS[method].mass.reads_domains        # GIMP may reach beyond the body, and only it


@every_body
@every_method
def test_gather_is_the_transpose_of_spread(body, method):
    """Forces on slaved nodes do the same work on those that they follow: none is lost."""
    mesh, particles = block(**body)
    support = Support(mesh, particles, METHODS[method], "ghost", [])
    random = np.random.default_rng(1)
    unknowns = random.uniform(-1, 1, support.transfer.shape[1])
    nodal = random.uniform(-1, 1, (support.grid.dim, support.grid.nnodes)) * support.known
    assert (support.gather(nodal) @ unknowns) == pytest.approx((nodal * support.spread(unknowns)).sum(), rel=1e-12)
    total = support.gather(nodal).reshape(-1, support.grid.dim).sum(axis=0)
    assert_allclose(total, nodal.sum(axis=1), atol=1e-12)


@every_method
def test_points_read_only_nodes_in_play(method):
    mesh, particles = block(where=l_shape)
    particles = replace(particles, x=particles.x + 0.013)
    support = Support(mesh, particles, METHODS[method], "ghost", [])
    for part in ("mass", "strain", "force"):
        stencil = support.stencil(getattr(METHODS[method], part))
        seen = stencil.nodes()[np.abs(stencil.value()) > 1e-12]
        assert support.known[seen].all()


@pytest.mark.parametrize("share, active", [(1e-10, False), (1e-6, True)])
def test_a_node_is_active_by_its_share_of_mass(share, active):
    """The last point has just crossed a face, so the node beyond carries next to nothing."""
    mesh, particles = block(dim=1, kinematics=uniaxial)
    last = particles.x[0].argmax()
    x = particles.x.copy()
    x[0, last] = 0.8 + 0.1 * share
    support = Support(mesh, replace(particles, x=x), METHODS["mpm"], "ghost", [])
    node = np.isclose(support.grid.axes[0], 0.9)
    assert support.solved[node] == [active]
    assert support.known[node] == [True]           # the light node follows the body instead


@pytest.mark.parametrize("share, reaches", [(1e-10, False), (1e-6, True)])
def test_a_patch_reaches_into_occupied_cells_with_active_nodes_only(share, reaches):
    mesh, particles = block(dim=1, kinematics=uniaxial)
    last = particles.x[0].argmax()
    x = particles.x.copy()
    x[0, last] = 0.8 + 0.1 * share
    support = Support(mesh, replace(particles, x=x), METHODS["cmpm"], "ghost", [])
    cell = support.grid.locate(np.array([[0.75]]))[0, 0]
    assert support.occupied[cell + 1]              # occupied in both cases
    assert support.sides[1, 0, cell] == reaches
    assert support.sides[0, 0, cell]
    assert not support.sides[:, 0, support.grid.locate(np.array([[0.25]]))[0, 0]][0]     # nothing left of the body


def test_nodes_behind_a_fixed_plane_are_slaved_and_those_on_it_are_fixed():
    """Even where domains of points reach through the plane and put mass there."""
    mesh, particles = block(dim=2)
    particles = replace(particles, x=particles.x + 0.02)
    plane = FixedPlane(axis=0, at=0.8, side=1)
    support = Support(mesh, particles, METHODS["gimp"], "ghost", [plane])
    x = positions(support.grid)
    behind = x[0] > 0.8 + 1e-9
    assert support.mass[behind].max() > 1e-3 * support.mass.max()
    assert not support.solved[behind].any() and support.known[behind].any()
    on = np.isclose(x[0], 0.8)
    assert support.fixed[0, on].all() and not support.fixed[0, ~on].any() and not support.fixed[1].any()
    free = support.free.reshape(-1, 2).T
    assert_array_equal(free, ~support.fixed[:, support.solved_nodes])


@every_method
def test_a_step_sees_only_the_grid_around_the_body(method):
    """So a body in a mesh of a hundred times its size costs no more."""
    sizes = []
    for spare in (3, 30):
        axis = 0.1 * np.arange(-spare, 6 + spare)
        mesh = MeshQuad.init_tensor(axis, axis)
        body = Particles.fill(mesh, plane_strain, where=lambda x: (x > 0).all(axis=0) & (x < 0.5).all(axis=0))
        support = Support(mesh, body, METHODS[method], "ghost", [])
        assert_array_equal(mesh.p[:, support.grid.vertices.ravel()], positions(support.grid))
        sizes.append(support.grid.nnodes)
    assert sizes[0] == sizes[1] <= 10 * 10


@pytest.mark.parametrize("method", METHODS)
def test_ten_times_more_empty_mesh_changes_nothing(method):
    """A body costs what it is, wherever in a mesh it stands."""
    width, law = 0.125, LinearElastic(E=100.0, nu=0.3)             # powers of two: coordinates are the same numbers
    results = []
    for spare in (2, 12):
        axis = width * np.arange(-spare, 5 + spare)
        mesh = MeshQuad.init_tensor(axis, axis)
        body = Particles.fill(mesh, plane_strain, where=lambda x: (x > 0).all(axis=0) & (x < 0.5).all(axis=0))
        planes = [FixedPlane(1, 0.0, -1, components=(0, 1), name="base")]
        results.append([state for state in implicit_steps(mesh, body, law, planes, method=method, steps=3,
                                                          gravity=lambda step: (0.0, -step))][-1])
    small, large = results
    for name, array in small.particles.arrays().items():
        assert_allclose(getattr(large.particles, name), array, rtol=0, atol=1e-12 * np.abs(array).max(), err_msg=name)
    assert_allclose(large.reactions["base"], small.reactions["base"], rtol=1e-12, atol=1e-14)
