"""Stable steps and growth rates of frozen layouts are those of real steps, and the bound is safe and not far below."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import FLUTTERING, MAKE, MOTION, SYMMETRIC, symmetric_methods
from skfem import MeshLine, MeshQuad

from skfem_mpm import METHODS, Hencky, LinearElastic, Particles, axisymmetric, plane_strain, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.explicit import explicit_steps, run_before_its_start
from skfem_mpm.stability import critical_step, growth
from skfem_mpm.stability.layout import Layout
from skfem_mpm.stability.safe import safe_step
from skfem_mpm.stability.spectrum import Spectrum

LAW = LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3)             # pressure waves of speed 1
BAR = LinearElastic(E=1.0, nu=0.0)
PLANES = (FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1, (0, 1)))
STEPS = [{}, {"integrator": "usf"}, {"integrator": "usavg"}, {"integrator": "usl"}]
TRANSFERS = [{"flip": 0.6}, {"flip": 0.0, "integrator": "usl"}, {"flip": 0.9, "integrator": "usf"}, {"xpic": 3},
             {"flip": 0.5, "xpic": 2, "integrator": "usavg"},
             {"xpic": 2, "flip": 0.5, "integrator": "usl"}]
SLOPES = [{"tpic": True, "flip": 0.0}, {"tpic": True}, {"tpic": True, "integrator": "usl", "flip": 0.3},
          {"tpic": True, "integrator": "usf", "xpic": 2}]
OTHERS = [{"remedy": "bbar"}, {"integration": "twin"}, {"integration": "dual", "remedy": "bbar"},
          {"strain": "logarithmic"}, {"edges": "clip"}, {"domains": "stretched"}]


def in_turn(choices, methods):
    """Each choice with one method by day, and with all of them if there is time."""
    return [pytest.param(each, method, id=f"{names(each)} {method}",
                         marks=[] if turn == place % len(methods) else [pytest.mark.slow])
            for place, each in enumerate(choices) for turn, method in enumerate(methods)]


def names(choices):
    return " ".join(f"{name}={value}" for name, value in choices.items()) or "flip"


def scattered(dim, seed, n=None, cells=None, kinematics=None):
    """Points anywhere in a few cells, some of them next to faces, with volumes, masses and domains of their own."""
    random = np.random.default_rng(seed)
    cells = cells or int(random.integers(1, {1: 20, 2: 5, 3: 3}[dim]))
    n = n or int(random.integers(1, {1: 3, 2: 4, 3: 2}[dim] * cells ** dim + 2))
    kinematics = kinematics or MOTION[dim]
    x, volume = random.uniform(0, cells, (dim, n)), random.uniform(0.1, 1.0, n)
    x[:, ::5] = np.round(x[:, ::5]) + random.choice([1e-10, 1e-5, 1e-3], x[:, ::5].shape)
    axes = [np.arange(-3.0, cells + 4)] * dim
    if kinematics.hoop:
        x[0], axes = x[0] + 1, [np.arange(0.0, cells + 5)] + axes[1:]
    return MAKE[dim](*axes), Particles(x, volume, volume * random.uniform(0.5, 2.0, n), kinematics,
                                       length=random.uniform(0.2, 1.0, (dim, n)))


def graded(seed):
    """A scattered block on a grid whose cells grow by the way, and the points with them."""
    mesh, body = scattered(2, seed)
    axes = [np.sinh(0.2 * np.unique(row)) for row in mesh.p]
    return MeshQuad.init_tensor(*axes), replace(body, x=np.sinh(0.2 * body.x), length=0.15 * body.length)


def shifted(dim, cells, shift=0.24):
    """A free body with two points per direction, on cells of size 1."""
    body = Particles.fill(MAKE[dim](*[np.arange(cells + 1.0)] * dim), MOTION[dim])
    return MAKE[dim](*[np.arange(-4.0, cells + 5)] * dim), replace(body, x=body.x + shift)


def radius_of_real_step(mesh, body, law, planes, dt, size=1e-9, **choices):
    """Spectral radius of the real step, from what it does to each velocity, stress and slope of a point."""
    def begin():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return run_before_its_start(mesh, body, law, planes, dt=dt, **choices)

    run = begin()
    carried = [name for name in ("velocity", "sigma", "slope") if getattr(run, name) is not None]
    ends = np.cumsum([getattr(run, name).size for name in carried])
    columns = []
    for unit in np.eye(ends[-1]):
        run = begin()
        for name, part in zip(carried, np.split(unit * size, ends[:-1])):
            setattr(run, name, part.reshape(getattr(run, name).shape))
        if run.epsilon is not None:
            run.epsilon = law.elastic_strain(run.sigma, run.kinematics.components)
        run.dt, run.refreshed = dt, run.step
        run.advance()
        columns.append(np.concatenate([getattr(run, name).ravel() for name in carried]) / size)
    return max(1.0, abs(np.linalg.eigvals(np.array(columns).T)).max())


def check_radius(mesh, body, planes=(), law=LAW, **choices):
    limit = critical_step(mesh, body, law, planes, exact=True, **choices).exact
    for share in (0.4, 1.2):
        dt = share * limit if 0 < limit < np.inf else share
        found = growth(mesh, body, law, planes, dt=dt, **choices)
        assert_allclose(found.radius, radius_of_real_step(mesh, body, law, planes, dt, **choices), rtol=1e-6)
        assert_allclose(found.rate, np.log(found.radius) / dt)


# Real steps

@pytest.mark.parametrize("choices, method", in_turn(STEPS + TRANSFERS + SLOPES + OTHERS, list(METHODS)))
def test_the_radius_is_that_of_a_real_step_in_a_bar(choices, method):
    check_radius(*scattered(1, 3, n=7, cells=4), method=method, **choices)


@pytest.mark.parametrize("choices, method", [
    ({}, "cmpm"), ({"integrator": "usl"}, "cmpm-c"), ({"xpic": 2, "flip": 0.5}, "gimp"),
    ({"tpic": True, "flip": 0.2}, "gc"), ({"remedy": "bbar"}, "gimp"), ({"integration": "twin2"}, "mpm")], ids=str)
@pytest.mark.parametrize("planes", [pytest.param((), marks=pytest.mark.slow, id="free"),
                                    pytest.param(PLANES, id="held")])
def test_the_radius_is_that_of_a_real_step_in_a_block(choices, method, planes):
    check_radius(*scattered(2, 5, n=5, cells=2), planes, method=method, **choices)


@pytest.mark.parametrize("method, radius", [("mpm", "point"), ("gimp", "domain"), ("cmpm-c", "point")])
@pytest.mark.parametrize("choices", [{}, {"tpic": True, "flip": 0.0}, {"remedy": "bbar"}], ids=names)
def test_the_radius_is_that_of_a_real_step_in_rings(choices, method, radius):
    check_radius(*scattered(2, 7, n=4, cells=2, kinematics=axisymmetric), method=method, radius=radius, **choices)


def test_the_radius_is_that_of_a_real_step_in_space_and_with_another_law():
    check_radius(*scattered(3, 1, n=4, cells=1), method="mpm")
    check_radius(*scattered(1, 4, n=6, cells=4), law=Hencky(E=2.0, nu=0.2), method="gimp", strain="logarithmic")


# The exact limit

@pytest.mark.parametrize("choices, method", in_turn(STEPS + TRANSFERS + OTHERS, SYMMETRIC))
def test_waves_grow_above_the_exact_limit_and_not_below(method, choices):
    for dim, seed in [(1, 1), (1, 2), (2, 3)]:
        layout = scattered(dim, seed)
        limit = critical_step(*layout, LAW, exact=True, method=method, **choices)
        assert not limit.flutters and 0 < limit.bound <= limit.exact
        for share in (0.3, 0.7, 0.999):
            found = growth(*layout, LAW, dt=share * limit.exact, method=method, **choices)
            assert found.radius < 1 + 1e-6 and found.cause == "none"
        found = growth(*layout, LAW, dt=1.001 * limit.exact, method=method, **choices)
        assert found.radius > 1 + 1e-5 and found.cause == "step"


@pytest.mark.parametrize("share", [0.5, 0.25, 0.01, 1e-6])
def test_one_point_alone_has_a_known_limit(share):
    """With USL sqrt(2) / omega, omega = c / h / sqrt(xi (1 - xi)); remapped velocities never strain it."""
    body = Particles(np.array([[share]]), np.array([0.5]), np.array([0.5]), uniaxial, length=np.array([[0.5]]))
    mesh = MeshLine(np.arange(-2.0, 4))
    found = critical_step(mesh, body, BAR, integrator="usl")
    assert_allclose([found.exact, found.bound], np.sqrt(2 * share * (1 - share)), rtol=1e-6)
    assert critical_step(mesh, body, BAR).exact == np.inf
    assert growth(mesh, body, BAR, dt=100.0).cause == "none"


def test_a_uniform_bar_has_the_limit_of_a_long_one():
    """Waves of length k: omega^2 = 2 (1 - cos k) (5 + 3 cos k) / 8, at most 4/3 with cos k = -1/3."""
    found = critical_step(*shifted(1, 40, 0.0), BAR)
    assert_allclose(found.exact, 2 / np.sqrt(4 / 3), rtol=2e-3)
    assert found.bound > 0.9 * found.exact


def test_units_change_nothing_but_the_unit():
    mesh, body = scattered(2, 3)
    plain = critical_step(mesh, body, LAW, method="gimp")
    L, M, T = 2.0 ** 30, 2.0 ** -20, 2.0 ** -25
    scaled = replace(body, x=L * body.x, volume=L ** 2 * body.volume, mass=M * body.mass, length=L * body.length)
    law = LinearElastic(E=LAW.E * M / L ** 2 * (L / T) ** 2, nu=LAW.nu)
    found = critical_step(MeshQuad(L * mesh.p, mesh.t), scaled, law, method="gimp")
    assert_allclose([found.bound, found.exact], np.array([plain.bound, plain.exact]) * T, rtol=1e-10)


# The bound

def shares_of_limit(layouts, method, planes=(), **choices):
    """Bounds as shares of the exact limits, where there are any."""
    found = [critical_step(*layout, LAW, planes, exact=True, method=method, **choices) for layout in layouts]
    return np.array([each.bound / each.exact for each in found if np.isfinite(each.exact)])


@pytest.mark.parametrize("choices", [STEPS[0], *STEPS[2:]], ids=names)
@symmetric_methods
@pytest.mark.parametrize("dim, least, seeds", [
    (1, 0.7, range(30)), (2, 0.6, range(15)), pytest.param(1, 0.7, range(30, 500), marks=pytest.mark.slow),
    pytest.param(2, 0.6, range(15, 500), marks=pytest.mark.slow)], ids=str)
def test_the_bound_is_safe_and_near_the_exact_limit(dim, least, seeds, method, choices):
    shares = shares_of_limit((scattered(dim, seed) for seed in seeds), method, **choices)
    assert len(shares) > 0.7 * len(seeds)
    assert least < shares.min() and shares.max() <= 1 + 1e-7


@pytest.mark.parametrize("choices, method", in_turn(STEPS[1:] + TRANSFERS + OTHERS[:3], list(METHODS)))
def test_the_bound_is_safe_with_every_transfer(method, choices):
    for dim in (1, 2):
        assert shares_of_limit((scattered(dim, seed) for seed in range(4)), method, **choices).max() <= 1 + 1e-7


def layouts_with_tpic(dim, seeds, **choices):
    """Random layouts of runs whose points hand on velocity gradients."""
    for seed in range(seeds):
        yield Layout(run_before_its_start(*scattered(dim, seed), LAW, tpic=True, **{"flip": 0.0, **choices}))


@pytest.mark.parametrize("choices", [{}, pytest.param({"integrator": "usl"}, marks=pytest.mark.slow)], ids=names)
@symmetric_methods
@pytest.mark.parametrize("dim, count", [(1, 100), (2, 15), pytest.param(2, 100, marks=pytest.mark.slow)])
def test_the_step_of_a_run_is_safe_with_tpic(dim, count, method, choices):
    """No wave grows at the whole bound, nor at a tenth of it, and it is not far below the limit of most layouts."""
    shares = []
    for layout in layouts_with_tpic(dim, count, method=method, **choices):
        spectrum, bound = Spectrum(layout), layout.usual_step
        assert bound <= spectrum.limit * (1 + 1e-7) and not spectrum.flutters
        assert bound <= safe_step(layout) * (1 + 1e-6) and safe_step(layout) <= spectrum.limit * (1 + 1e-7)
        assert all(spectrum.rate(dt) <= spectrum.noise(dt) for dt in (0.999 * bound, 0.1 * bound))
        shares.append(bound / spectrum.limit)
    assert np.median(shares) > 0.65


@pytest.mark.parametrize("kinematics, planes, edges", [
    (plane_strain, PLANES, "ghost"), (axisymmetric, (), "ghost"), (plane_strain, (), "clip"),
    (plane_strain, (), "truncate")], ids=["planes", "rings", "clip", "truncate"])
@pytest.mark.parametrize("method", ["mpm", "gimp"])
def test_points_hand_back_no_more_motion_than_there_was(method, kinematics, planes, edges):
    """With tpic the map to the points and back is symmetric, and its eigenvalues are shares."""
    for seed in range(8):
        mesh, body = scattered(2, seed, cells=3, kinematics=kinematics)
        if edges != "ghost":
            mesh = MeshQuad.init_tensor(*[np.arange(4.0)] * 2)
            body = replace(body, x=np.clip(body.x, 1e-3, 3 - 1e-3))
        radius = "domain" if kinematics.hoop and method == "gimp" else "point"
        run = run_before_its_start(mesh, body, LAW, planes, method=method, edges=edges, radius=radius, tpic=True,
                                   flip=0.0)
        layout = Layout(run)
        given = np.random.default_rng(seed).normal(size=(2, layout.nodes.grid.nnodes))
        given[:, ~layout.nodes.active] = given[layout.nodes.fixed] = 0
        seen = layout.nodes.spread(given.copy())
        slopes = layout.nodes.fitted.gradient(seen)[:4]
        back = layout.nodes.gather(layout.nodes.tilted(run.mass * slopes))[:, layout.nodes.active].T.ravel()
        scale = np.sqrt(np.repeat(layout.nodes.mass[layout.nodes.active], 2)) * layout.free
        assert_allclose(scale * (layout.slope @ (scale * given[:, layout.nodes.active].T.ravel())), layout.free * back,
                        atol=1e-12 * abs(back).max())
        shares = np.linalg.eigvalsh((layout.half.T @ layout.half).toarray())
        assert shares.min() > -1e-12 and shares.max() < 1 + 1e-12


def test_a_share_of_flip_makes_waves_grow_with_tpic_at_any_step():
    """In the plane what points keep and what they hand on do not commute: runs say so, and flip=0 is the cure."""
    layout = scattered(2, 6)
    found = critical_step(*layout, LAW, tpic=True)
    for dt in (0.1 * found.exact, 0.5 * found.exact):
        grown = growth(*layout, LAW, tpic=True, dt=dt)
        assert grown.cause == "flutter" and "flip=0" in str(grown)
        assert growth(*layout, LAW, tpic=True, flip=0.0, dt=dt).cause == "none"
    assert found.flutters and not critical_step(*layout, LAW).flutters
    with pytest.warns(UserWarning, match="^flip: got 1.0 with tpic=True"):
        explicit_steps(*layout, LAW, steps=1, tpic=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        explicit_steps(*layout, LAW, steps=1, tpic=True, flip=0.0)


@symmetric_methods
def test_the_bound_is_safe_at_planes_in_rings_in_space_and_on_graded_grids(method):
    layouts = {PLANES: [scattered(2, seed) for seed in range(8)],
               (): [graded(seed) for seed in range(8)] + [scattered(3, seed) for seed in range(3)]
               + [scattered(dim, seed, kinematics=axisymmetric) for dim in (1, 2) for seed in range(8)]}
    for planes, each in layouts.items():
        shares = shares_of_limit(each, method, planes)
        assert shares.max() <= 1 + 1e-7 and shares.min() > 0.6


def test_pic_needs_shorter_steps_than_flip():
    """The points then keep less of what drives a wave back: with little of it kept, the limit is by sqrt(2) shorter."""
    layouts = [scattered(1, seed) for seed in range(30)]
    shares = [critical_step(*each, LAW, flip=0.0).exact / critical_step(*each, LAW).exact for each in layouts]
    shares = [share for share in shares if np.isfinite(share)]
    assert min(shares) < 0.85 and min(shares) > np.sqrt(0.5) - 1e-9


# Growth

@pytest.mark.parametrize("method, rate", [("cmpm", 0.1208), ("gc", 0.0537), ("fe-gimp", 0.1743)])
def test_flutter_of_the_shifted_bar(method, rate):
    """20 cells, 2 points per cell, free ends, all points shifted by 0.24 of a cell: what the documentation quotes."""
    found = growth(*shifted(1, 20), BAR, method=method)
    assert_allclose(found.flutter, rate, atol=1e-4)
    assert_allclose(found.rate, rate, rtol=0.1)
    assert found.cause == "flutter" and "flutter" in str(found)
    assert_allclose(growth(*shifted(1, 20), BAR, method=method, dt=1e-3).rate, found.flutter, rtol=1e-4)


@pytest.mark.parametrize("dim, cells", [(1, 20), (2, 4)])
@pytest.mark.parametrize("method", METHODS)
def test_flutter_is_told_from_a_step_that_is_too_long(method, dim, cells):
    layout = shifted(dim, cells)
    limit = critical_step(*layout, LAW, method=method)
    assert limit.flutters == (method in FLUTTERING)
    assert growth(*layout, LAW, method=method).cause == ("flutter" if method in FLUTTERING else "none")
    assert growth(*layout, LAW, method=method, dt=1.1 * limit.exact).cause == "step"
    assert growth(*layout, LAW, method=method, dt=1.1 * limit.exact).rate > 0.1


def test_pic_and_usl_damp_what_flutters():
    layout = shifted(2, 4)
    plain = growth(*layout, LAW, method="cmpm", dt=0.3)
    for choices in ({"flip": 0.9}, {"xpic": 2}, {"integrator": "usl"}):
        found = growth(*layout, LAW, method="cmpm", dt=0.3, **choices)
        assert found.rate < plain.rate and found.flutter == plain.flutter


def test_the_step_is_that_of_a_run():
    layout = shifted(2, 3)
    for choices in ({}, {"integrator": "usl", "safety": 0.8}, {"method": "cmpm-c", "tpic": True}, {"dt": 0.01}):
        run = run_before_its_start(*layout, LAW, None, **choices)
        run.advance()
        assert_allclose(growth(*layout, LAW, **choices).dt, run.dt, rtol=1e-12)


# Odd layouts and bad input

ODD = {"point": [[0.5], [0.5]], "point on a node": [[1.0], [1.0]], "point on a face": [[1.0], [0.3]],
       "cover of 1e-12": [[1 + 1e-12, 0.5], [0.3, 0.5]],
       "corner": [[2 - 1e-14, 1.0, 1.0, 0.5], [1.0, 1 - 1e-16, 1.3, 0.5]], "one place": [[0.3] * 5, [0.6] * 5]}


@pytest.mark.parametrize("x", ODD.values(), ids=ODD)
@pytest.mark.parametrize("choices, method", in_turn(
    STEPS[::2] + TRANSFERS[:1] + SLOPES[:1] + OTHERS[:2], list(METHODS)))
def test_odd_layouts_have_answers(x, method, choices):
    x = np.array(x)
    body = Particles(x, np.full(x.shape[1], 0.3), np.full(x.shape[1], 0.4), plane_strain, length=np.full(x.shape, 0.5))
    mesh = MeshQuad.init_tensor(*[np.arange(-2.0, 5)] * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        limit = critical_step(mesh, body, LAW, method=method, **choices)
        found = growth(mesh, body, LAW, method=method, **choices)
    assert 0 < limit.bound <= limit.exact * (1 + 1e-7)
    assert np.isfinite([found.radius, found.rate, found.dt]).all()
    assert found.cause == "none" or limit.flutters


def test_a_mesh_of_one_cell_has_an_answer():
    body = Particles.fill(MeshQuad(), plane_strain)
    found = critical_step(MeshQuad(), body, LAW, [FixedPlane(1, 0.0, -1)])
    assert 0 < found.bound <= found.exact < np.inf


def test_the_exact_limit_is_looked_for_on_demand():
    layout = shifted(2, 3)
    found = critical_step(*layout, LAW, exact=False)
    assert found.exact is None and found.flutters is None and "not looked for" in str(found)
    assert critical_step(*layout, LAW, exact=True).exact == critical_step(*layout, LAW).exact > found.bound


@pytest.mark.parametrize("given, message", [
    ({"damping": 0.1}, "^damping: got 0.1, expected 0"), ({"speed": 1}, "^speed: not a choice"),
    ({"exact": 1}, "^exact: got 1, expected True"), ({"steps": 3}, "^steps: not a choice"),
    ({"flip": 2.0}, "^flip: got 2.0"), ({"method": "fem"}, "^method")])
def test_bad_input_is_refused_by_name(given, message):
    with pytest.raises((TypeError, ValueError), match=message):
        critical_step(*shifted(1, 3), BAR, **given)


def test_a_bad_step_is_refused():
    with pytest.raises(ValueError, match="^dt: got -1"):
        growth(*shifted(1, 3), BAR, dt=-1)
