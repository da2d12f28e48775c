"""The symmetric twin of field integration in explicit runs."""

from dataclasses import replace

import numpy as np
import pytest
from shared import MAKE, block

from skfem_mpm import (
    METHODS,
    CMPMBasis,
    LinearElastic,
    Method,
    ParticleBasis,
    Particles,
    VonMises,
    axisymmetric,
    explicit_steps,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.explicit.bound import stable_step
from skfem_mpm.explicit.boxes import BoxCover, Boxes
from skfem_mpm.explicit.dilation import CellMeans
from skfem_mpm.explicit.twin import TwinNodes
from skfem_mpm.grid import Grid
from skfem_mpm.integration import Field, Twin, find_integration
from skfem_mpm.scenes import vertical_cut

ELASTIC = LinearElastic(E=100.0, nu=0.3)
PLASTIC = VonMises(E=100.0, nu=0.3, peak=2.0, residual=0.5, softening=-5.0)
KINDS = [(1, uniaxial), (2, plane_strain), (3, solid), (1, axisymmetric), (2, axisymmetric)]
kinds = pytest.mark.parametrize("dim, kinematics", KINDS, ids=["1d", "2d", "3d", "rings1", "rings2"])
twins = pytest.mark.parametrize("twin", ["twin", "twin2", "dual"])


def layout(dim, kinematics, seed, jitter=0.3, cells=3, spacing=1.0):
    """A shifted and jittered block of points in a grid with room around."""
    rng = np.random.default_rng(seed)
    start = 5.0 if kinematics.hoop else 0.0
    axis = start + spacing * np.arange(-2.0, cells + 4)
    lines = start + np.linspace(0, cells, cells + 1)
    body = Particles.fill(MAKE[dim](*[lines] * dim), kinematics, density=2.0)
    shift = rng.uniform(0, 1, (dim, 1)) * spacing
    x = body.x + shift + jitter / 2 * rng.uniform(-1, 1, body.x.shape)
    return MAKE[dim](*[axis] * dim), replace(body, x=x)


def nodes_of(mesh, body, twin="twin", planes=(), method="mpm"):
    boxes = Boxes(body.x, body.length, body.volume, body.kinematics)
    return TwinNodes(Grid.from_mesh(mesh), body.kinematics, body.x, body.mass, body.length, METHODS[method], "ghost",
                     planes, False, boxes, find_integration(twin))


def positions(nodes):
    return np.stack([axis.ravel() for axis in np.meshgrid(*nodes.grid.axes, indexing="ij")])


def symmetric_stress(kinematics, dim, n, seed=0):
    packed = np.random.default_rng(seed).normal(size=(kinematics.ncomp, n))
    return packed[[kinematics.packed_index(place) for place in kinematics.rows(dim)]]


# -- operators --------------------------------------------------------------------------------------------------------


@twins
@kinds
def test_internal_forces_have_no_resultant_and_no_torque(dim, kinematics, twin):
    mesh, body = layout(dim, kinematics, seed=1)
    nodes = nodes_of(mesh, body, twin)
    force = nodes.force.force(nodes.volume * symmetric_stress(kinematics, dim, body.n))
    x, size = positions(nodes), abs(force).max()
    along = range(1, dim) if kinematics.hoop else range(dim)          # a ring has a resultant along the radius
    assert size > 0.1
    assert all(abs(force[k].sum()) < 1e-12 * size * force.shape[1] for k in along)
    if not kinematics.hoop:
        torque = np.einsum("in,jn->ij", x, force)
        assert abs(torque - torque.T).max() < 1e-11 * size * force.shape[1]


@twins
@kinds
def test_linear_motion_has_its_gradient_at_every_point(dim, kinematics, twin):
    """In cut cells too, as long as no node is light: the sums over nodes are exact inside the integrals."""
    mesh, body = layout(dim, kinematics, seed=2)
    nodes = nodes_of(mesh, body, twin)
    assert not len(nodes.light)
    A = np.random.default_rng(0).normal(size=(dim, dim))
    if kinematics.hoop:
        A[0] = np.eye(dim)[0]
    gradient = nodes.strain.gradient(A @ positions(nodes))
    np.testing.assert_allclose(gradient[:dim * dim], np.tile(A.reshape(-1, 1), body.n), atol=1e-11)
    if kinematics.hoop:
        np.testing.assert_allclose(gradient[-1], 1.0, atol=1e-11)


@twins
@kinds
def test_force_is_the_transpose_of_strain(dim, kinematics, twin):
    mesh, body = layout(dim, kinematics, seed=3)
    nodes, rng = nodes_of(mesh, body, twin), np.random.default_rng(0)
    v, stress = rng.normal(size=(dim, nodes.grid.nnodes)), symmetric_stress(kinematics, dim, body.n)
    power = (nodes.force.force(nodes.volume * stress) * v).sum()
    assert power == pytest.approx((nodes.volume * stress * nodes.strain.gradient(v)).sum(), rel=1e-11)


@twins
@kinds
def test_points_share_what_is_covered(dim, kinematics, twin):
    """Full cells count with their own measure, and boxes with all that their points have."""
    mesh, body = layout(dim, kinematics, seed=4, cells=4)
    nodes = nodes_of(mesh, body, twin)
    unit, x, area = nodes.cover.quadrature(3)
    measure = area * x[0] if kinematics.hoop else area
    assert nodes.volume.sum() == pytest.approx(measure.sum(), rel=1e-12)
    assert (nodes.volume > 0).all()
    cell = np.ravel_multi_index(tuple(nodes.index), nodes.grid.cells.shape)
    assert set(nodes.cover.keys) == set(cell) and set(nodes.cover.full) < set(cell)
    lone = body.where(np.arange(body.n) == 0)
    alone = nodes_of(mesh, lone, twin)
    assert alone.volume == pytest.approx(lone.volume, rel=1e-12)      # its box may reach into empty cells


def test_boxes_are_cut_at_the_faces():
    mesh, body = layout(2, plane_strain, seed=5)
    index = Grid.from_mesh(mesh).locate(body.x)
    cover = BoxCover(Grid.from_mesh(mesh), index, Boxes(body.x, body.length, body.volume, plane_strain))
    owner, unit, middle, edges = cover._cut_boxes()
    cell = np.stack(np.unravel_index(cover.cells[unit], cover.grid.cells.shape))
    for k, axis in enumerate(cover.grid.axes):
        assert (middle[k] - edges[k] / 2 > axis[cell[k]] - 1e-12).all()
        assert (middle[k] + edges[k] / 2 < axis[cell[k] + 1] + 1e-12).all()
    assert (np.bincount(owner, weights=edges.prod(axis=0)) <= body.length.prod(axis=0) * (1 + 1e-12)).all()


def test_cells_next_to_a_fixed_plane_are_full():
    mesh, body = layout(2, plane_strain, seed=6, jitter=0.1)
    body = replace(body, x=body.x - np.floor(body.x.min(axis=1, keepdims=True)))
    base = FixedPlane(1, 0.0, -1)
    free, held = nodes_of(mesh, body), nodes_of(mesh, body, planes=(base,))
    assert set(free.cover.full) < set(held.cover.full)


# -- stability --------------------------------------------------------------------------------------------------------


def stiffness(nodes, kinematics, law):
    """K by columns, ``(dim nnodes, dim nnodes)``."""
    dim, n = nodes.grid.dim, nodes.grid.nnodes
    rows = kinematics.rows(dim)
    zero = np.zeros((kinematics.ncomp, 1))
    moduli = law.tangent(zero, zero, np.zeros((0, 1)), rows)[..., 0]
    matrices = [np.zeros((len(nodes.x[0]), dim * n)) for _ in rows]
    for i, terms in enumerate(nodes.strain.terms):
        for q, l in terms:
            matrices[q][:, i * n:(i + 1) * n] = nodes.strain.matrices[l].toarray()
    return sum(moduli[q, r] * matrices[q].T @ (nodes.volume[:, None] * matrices[r])
               for q in range(len(rows)) for r in range(len(rows)) if moduli[q, r])


@twins
@pytest.mark.parametrize("dim, kinematics, seeds", [(1, uniaxial, 40), (2, plane_strain, 40), (3, solid, 20)],
                         ids=["1d", "2d", "3d"])
def test_no_motion_grows_on_frozen_layouts(dim, kinematics, seeds, twin):
    """Eigenvalues of the lumped mass and the stiffness are real and not negative; the step found is below the limit."""
    for seed in range(seeds):
        mesh, body = layout(dim, kinematics, seed, jitter=0.8 * (seed % 2), cells=5 - dim)
        nodes = nodes_of(mesh, body, twin)
        assert not len(nodes.light) and (nodes.volume > 0).all()
        K, active = stiffness(nodes, kinematics, ELASTIC), np.tile(nodes.active, dim)
        values = np.linalg.eigvals(K[np.ix_(active, active)] / np.tile(nodes.mass, dim)[active][:, None])
        largest = abs(values).max()
        assert abs(values.imag).max() < 1e-7 * largest and values.real.min() > -1e-9 * largest
        if seed < 4:
            zero = np.zeros((kinematics.ncomp, 1))
            moduli = ELASTIC.tangent(zero, zero, np.zeros((0, 1)), kinematics.rows(dim))
            step = stable_step(nodes, moduli, nodes.volume, body.mass, False, False)
            assert 0.2 * 2 / np.sqrt(largest) < step <= 2 / np.sqrt(largest) * (1 + 1e-9)


@twins
def test_means_over_cells_keep_the_operator_symmetric(twin):
    mesh, body = layout(2, plane_strain, seed=7)
    nodes, rng = nodes_of(mesh, body, twin), np.random.default_rng(0)
    means = CellMeans(nodes.grid, nodes.mapping, nodes.integrated(body.volume))
    v, stress = rng.normal(size=(2, nodes.grid.nnodes)), symmetric_stress(plane_strain, 2, body.n)
    power = (nodes.force.force(nodes.volume * means.smooth(stress)) * v).sum()
    assert power == pytest.approx((nodes.volume * stress * means.smooth(nodes.strain.gradient(v))).sum(), rel=1e-11)


# -- runs -------------------------------------------------------------------------------------------------------------


def run(body, law=ELASTIC, steps=50, every=None, start=None, **choices):
    mesh, particles, planes = body
    choices = {"gravity": (0.0,) * (particles.dim - 1) + (-1.0,), "safety": 0.25, "flip": 0.95,
               "integration": "twin"} | choices
    return list(explicit_steps(mesh, start or particles, law, planes, steps=steps, every=every or steps, **choices))


@twins
def test_a_free_body_keeps_its_momentum(twin):
    mesh, body = layout(2, plane_strain, seed=8)
    rng = np.random.default_rng(0)
    body = replace(body, velocity=0.2 + 0.1 * rng.normal(size=body.x.shape))
    state = run((mesh, body, []), gravity=None, integration=twin, flip=1.0)[-1]
    momentum = [(body.mass * each.velocity).sum(axis=1) for each in (body, state.particles)]
    np.testing.assert_allclose(*momentum, rtol=1e-12)
    assert abs(state.particles.sigma).max() > 0.1


@pytest.mark.parametrize("choices", [{}, {"integration": "twin2"}, {"remedy": "bbar"}, {"method": "gimp"},
                                     {"domains": "fixed"}, {"strain": "logarithmic"}], ids=str)
def test_a_continued_run_is_the_same_run(choices):
    body = block(2, plane_strain)
    *_, half, whole = run(body, steps=20, every=10, **choices)
    again = run(body, steps=10, start=half, **choices)[-1]
    for name in ("x", "velocity", "sigma", "volume", "length"):
        assert (getattr(whole.particles, name) == getattr(again.particles, name)).all(), name
    assert dict(whole.energy) == dict(again.energy)


def test_boxes_follow_the_stretch_by_default():
    body = block(2, plane_strain)
    assert (run(body, steps=5)[-1].particles.length != body[1].length).any()
    assert (run(body, steps=5, domains="fixed")[-1].particles.length == body[1].length).all()
    assert (run(body, steps=5, integration="points", method="gimp")[-1].particles.length == body[1].length).all()


def test_the_method_only_maps():
    """Strain and force are the twin's: methods with the same mass basis are one, and none makes waves grow."""
    body = block(2, plane_strain)
    mpm, cmpm = (run(body, steps=10, method=method)[-1].particles for method in ("mpm", "cmpm"))
    assert (mpm.sigma == cmpm.sigma).all() and (mpm.x == cmpm.x).all()


def energies(seconds, **choices):
    """Elastic cut under sudden gravity: kinetic energy, its sum with the elastic one less work, over time."""
    scene = vertical_cut(h=0.1, room=1.0, material=LinearElastic(E=400e3, nu=0.35))
    time, kinetic, excess = [], [], []
    for state in scene.run(steps=100_000, every=10, **choices):
        time.append(state.time)
        kinetic.append(state.energy["kinetic"])
        excess.append(state.energy["kinetic"] + state.energy["elastic"] - state.energy["external"])
        if state.time >= seconds:
            break
    return np.array(time), np.array(kinetic), np.array(excess)


@pytest.mark.slow
@twins
def test_elastic_motion_does_not_grow(twin):
    time, kinetic, excess = energies(4.0, integration=twin)
    quarters = [kinetic[(time >= k) & (time < k + 1)].mean() for k in range(4)]
    assert max(quarters[1:]) < 1.02 * quarters[0] and min(quarters) > 0.85 * quarters[0]
    swings = [excess[(time >= k) & (time < k + 1)].max() for k in range(4)]    # of a rate law, which stores no energy
    assert max(swings) == swings[0] and swings[0] < 0.06 * kinetic.max()


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integration", ["field", "cubic", Field()])
def test_unsymmetric_fields_are_refused(integration):
    with pytest.raises(ValueError, match="integration: got .*conjugate"):
        run(block(1, uniaxial), integration=integration)


def test_bad_input():
    body = block(1, uniaxial)
    with pytest.raises(ValueError, match="integration: got 'twins', expected one of"):
        run(body, integration="twins")
    with pytest.raises(ValueError, match="length: the points have none"):
        run((body[0], replace(body[1], length=None), body[2]))
    with pytest.raises(ValueError, match="domains"):
        run(body, domains="bent")
    for bad in ({"order": 3}, {"kappa": -1.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Twin(**bad)


# -- engines ----------------------------------------------------------------------------------------------------------


def both(body, law=ELASTIC, **choices):
    pytest.importorskip("numba")
    numpy, numba = (run(body, law, engine=engine, **choices)[-1] for engine in ("numpy", "numba"))
    assert (numpy.engine, numba.engine) == ("numpy", "numba")
    return numpy, numba


def check_equal(a, b, tolerance=1e-12):
    for name in ("x", "velocity", "sigma", "volume", "length", "history"):
        one, other = getattr(a.particles, name), getattr(b.particles, name)
        if one is not None:
            assert abs(one - other).max() <= tolerance * max(abs(one).max(), 1e-30), name
    assert a.dt == pytest.approx(b.dt, rel=1e-12)


@twins
def test_engines_are_one(twin):
    check_equal(*both(block(2, plane_strain), integration=twin))


@pytest.mark.slow
@twins
@kinds
def test_engines_are_one_in_every_kinematics(dim, kinematics, twin):
    check_equal(*both(block(dim, kinematics), integration=twin, steps=50 if dim < 3 else 10))


@pytest.mark.parametrize("choices", [{"remedy": "bbar", "law": PLASTIC}, {"method": "gimp"}, {"integrator": "usl"},
                                     {"integration": Twin(order=2, kappa=4.0)}], ids=str)
def test_engines_are_one_with_other_choices(choices):
    choices = dict(choices)
    check_equal(*both(block(2, plane_strain), choices.pop("law", ELASTIC), **choices))


@pytest.mark.parametrize("kappa", [4.0, 9.0])
def test_engines_are_one_where_points_would_lose_their_volume(kappa, monkeypatch):
    """On loose layouts the limiter acts; at the larger kappa it must."""
    pytest.importorskip("numba")
    from skfem_mpm.kernels import cells

    acted, blend = [], cells.blend
    monkeypatch.setattr(cells, "blend", lambda *arguments: acted.append(1) or blend(*arguments))
    mesh, body = layout(2, plane_strain, seed=3, jitter=0.9)
    moving = replace(body, velocity=0.3 * np.sin(body.x[::-1]))
    check_equal(*both((mesh, moving, []), integration=Twin(kappa=kappa)), tolerance=1e-11)
    assert acted or kappa < 5


@twins
def test_results_do_not_depend_on_threads(twin):
    pytest.importorskip("numba")
    body = block(2, plane_strain, cells=24)               # enough points for several tiles
    one, two = (run(body, steps=5, integration=twin, engine="numba", threads=threads)[-1] for threads in (1, 2))
    for name in ("x", "velocity", "sigma", "length"):
        assert (getattr(one.particles, name) == getattr(two.particles, name)).all(), name


def test_a_continued_compiled_run_is_the_same_run():
    pytest.importorskip("numba")
    body = block(2, plane_strain)
    *_, half, whole = run(body, steps=20, every=10, engine="numba")
    again = run(body, steps=10, start=half, engine="numba")[-1]
    for name in ("x", "velocity", "sigma", "length"):
        assert (getattr(whole.particles, name) == getattr(again.particles, name)).all(), name


@pytest.mark.parametrize("changes, message", [
    ({"integration": "dm"}, "integration: got 'dm', which is for implicit steps"),
    ({"integration": "field"}, "integration: got 'field', which is for implicit steps"),
    ({"method": Method(ParticleBasis, ParticleBasis, ParticleBasis, motion=CMPMBasis)}, "method: got one that moves"),
])
def test_what_is_for_implicit_steps_is_refused(changes, message):
    mesh, body = layout(2, plane_strain, 0)
    with pytest.raises(ValueError, match=message):
        explicit_steps(mesh, body, ELASTIC, steps=1, **changes)
