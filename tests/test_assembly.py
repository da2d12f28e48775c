"""The compiled operators are those of numpy, and the solvers of large systems find what factorising finds."""

import importlib.util
import inspect
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.sparse import block_diag, csc_array, diags_array
from shared import MAKE, every_motion

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    NotConvergedError,
    Particles,
    axisymmetric,
    implicit_steps,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.grid import Grid
from skfem_mpm.implicit import solve, solve_cg, solve_direct
from skfem_mpm.integration import OfTable, Pair, on_points

LAW = LinearElastic(E=1e3, nu=0.3)


def body_of(kinematics, dim, cells=3):
    """Shaken points in no order on a graded grid that is longer along its last axis than the body."""
    rng = np.random.default_rng(0)
    lines = np.linspace(1, 2, cells + 1) ** 1.2
    axis = np.array([2 * lines[0] - lines[1], *lines, 2 * lines[-1] - lines[-2]])
    whole = Particles.fill(MAKE[dim](*[lines] * dim), kinematics, density=1.0)
    body = whole.where(rng.permutation(whole.n)[:max(2, whole.n * 3 // 4)])
    x = body.x + 0.05 * np.diff(lines).min() * rng.uniform(-1, 1, body.x.shape)
    return Grid.from_mesh(MAKE[dim](*[axis] * (dim - 1), [*axis, axis[-1] + 1.0])), body, x


def pair_of(kinematics, dim, method):
    grid, body, x = body_of(kinematics, dim)
    index = grid.locate(x)
    chosen, stencils = METHODS[method], {}
    for basis in (chosen.force, chosen.strain):
        stencils[basis] = basis.stencil_of(grid, x, index, body.length, "ghost", None)
    return on_points(kinematics, stencils[chosen.force], stencils[chosen.strain], body.volume, x[0])


def table_of(kinematics, dim, seed, shape, base, width=4):
    """Functions without any structure, on nodes of which some are off the grid and weigh nothing."""
    count = dim + (kinematics is axisymmetric)
    table = np.random.default_rng(seed).normal(size=(count, width ** dim, base.shape[1]))
    place = base[:, None] + np.indices((width,) * dim).reshape(dim, -1)[:, :, None]
    table[:, ((place < 0) | (place >= np.reshape(shape, (-1, 1, 1)))).any(axis=0)] = 0
    return OfTable(base, table, shape)


def tables_of(kinematics, dim, same):
    grid, body, x = body_of(kinematics, dim)
    base, shape = grid.locate(x) - 1, grid.vertices.shape
    force = table_of(kinematics, dim, 1, shape, base)
    return Pair(kinematics, force, force if same else table_of(kinematics, dim, 2, shape, base - 1, 3), body.volume)


def pairs(kinematics, dim):
    """All kinds of pairs: every method, and tables."""
    yield from (pair_of(kinematics, dim, method) for method in METHODS)
    yield from (tables_of(kinematics, dim, same) for same in (True, False))


def twin(pair):
    return pytest.importorskip("skfem_mpm.integration.compiled").CompiledPair(pair)


def numbers(pair, kind):
    """All components of all nodes numbered, or some nodes, or some components, or none that any point sees."""
    nnodes = int(np.prod(pair.force_functions.shape))
    rng, known = np.random.default_rng(3), np.ones((nnodes, pair.dim), dtype=bool)
    if kind == "some nodes":
        known &= rng.random((nnodes, 1)) > 0.3
    elif kind == "some components":
        known &= rng.random(known.shape) > 0.3
    elif kind == "unseen":
        known[np.unique(pair.strain_functions.nodes(slice(None)))] = False
    out = np.full(known.shape, -1)
    out[known] = np.arange(known.sum())
    return out.T, int(known.sum())


def close(one, other):
    assert abs(one - other).max(initial=0) <= 1e-13 * np.abs(other).max(initial=0)


@every_motion
def test_the_compiled_gradient_and_force_are_those_of_numpy(kinematics, dim):
    rng = np.random.default_rng(4)
    for pair in pairs(kinematics, dim):
        fast = twin(pair)
        u = rng.normal(size=(dim, int(np.prod(pair.force_functions.shape))))
        stress = rng.normal(size=(len(pair.rows), pair.volume.size))
        close(fast.gradient(u), pair.gradient(u))
        close(fast.force(stress), pair.force(stress))
        power = (stress * pair.volume * fast.gradient(u)).sum()
        if pair.force_functions is pair.strain_functions:
            assert abs((fast.force(stress) * u).sum() - power) <= 1e-12 * np.abs(stress * pair.volume).sum()


@every_motion
@pytest.mark.parametrize("kind", ["all", "some nodes", "some components", "unseen"])
def test_the_compiled_tangent_is_that_of_numpy(kinematics, dim, kind):
    for pair in pairs(kinematics, dim):
        fast, m, n = twin(pair), len(pair.rows), pair.volume.size
        number, size = numbers(pair, kind)
        dense = np.random.default_rng(5).normal(size=(m, m, n))
        for moduli in (dense, dense[:, :, :1]):
            got, want = fast.tangent(moduli, number, size), pair.tangent(moduli, number, size)
            assert got.has_canonical_format and got.indices.dtype == want.indices.dtype
            close(got.toarray(), want.toarray())
        again = fast.tangent(moduli, number, size)
        for name in ("data", "indices", "indptr"):
            assert_array_equal(getattr(again, name), getattr(got, name))


@every_motion
def test_the_tangent_is_what_force_and_gradient_say(kinematics, dim):
    """Twice independent: a product with the matrix is force of moduli times gradient."""
    rng = np.random.default_rng(6)
    for pair in pairs(kinematics, dim):
        fast, m, n = twin(pair), len(pair.rows), pair.volume.size
        number, size = numbers(pair, "all")
        moduli, u = rng.normal(size=(m, m, n)), rng.normal(size=number.shape)
        want = pair.force(np.einsum("qrn,rn->qn", moduli, pair.gradient(u)))
        for each in (pair, fast):
            got = (each.tangent(moduli, number, size) @ u.T.ravel()).reshape(-1, dim).T
            assert abs(got - want).max() <= 1e-12 * abs(want).max()


# -- engines of a run --------------------------------------------------------------------------------------------------

def block(method="mpm", dim=2, cells=4, **choices):
    """A block that slumps under its weight."""
    axis = np.arange(-1, cells + 2) / cells
    mesh = MAKE[dim](*[axis] * dim)
    body = Particles.fill(mesh, {1: uniaxial, 2: plane_strain, 3: solid}[dim],
                          where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    given = dict(mesh=mesh, start=body, material=Hencky(E=100.0, nu=0.3), method=method, steps=2,
                 boundary=[FixedPlane(dim - 1, 0.0, -1, tuple(range(dim)), name="base")],
                 gravity=lambda step: (0.0,) * (dim - 1) + (-step,))
    return implicit_steps(**(given | choices))


def last(run):
    *_, state = run
    return state


def near(one, other, accuracy=1e-9):
    for name in ("x", "sigma", "volume"):
        mine, theirs = getattr(one.particles, name), getattr(other.particles, name)
        assert abs(mine - theirs).max() <= accuracy * abs(theirs).max(), name
    assert one.step == other.step and one.cuts == other.cuts


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("method", ["mpm", "gimp", "cmpm"])
def test_both_engines_find_the_same_equilibrium(method, dim):
    pytest.importorskip("numba")
    slow, fast = (last(block(method, dim, cells=3, engine=engine)) for engine in ("numpy", "numba"))
    assert (slow.engine, fast.engine) == ("numpy", "numba")
    near(fast, slow)
    assert len(fast.residuals) == len(slow.residuals)


def test_auto_decides_by_size_and_goes_on_with_what_it_was():
    pytest.importorskip("numba")
    small, large = last(block(steps=1)), last(block("gimp", steps=1, cells=26))
    assert (small.engine, large.engine) == ("numpy", "numba")
    forced = last(block(steps=1, engine="numba"))
    assert last(block(steps=1, start=forced, boundary=None)).engine == "numba"
    whole, parts = last(block(engine="numba")), last(block(start=forced, boundary=None, steps=1))
    assert_array_equal(whole.particles.x, parts.particles.x)


def test_without_numba(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"skfem-mpm\[fast\]"):
        block(engine="numba")
    with pytest.warns(UserWarning, match="numba") as caught:
        assert last(block("gimp", cells=26, steps=1)).engine == "numpy"
    assert caught[0].filename == __file__


def test_unknown_engines_are_refused():
    with pytest.raises(ValueError, match="engine: got 'cuda'"):
        block(engine="cuda")
    assert inspect.signature(implicit_steps).parameters["engine"].default == "auto"


def test_numba_stays_unloaded_until_it_is_used():
    code = ("import sys, numpy as np\nfrom skfem import MeshLine\n"
            "from skfem_mpm import LinearElastic, Particles, implicit_steps, uniaxial\n"
            "from skfem_mpm.boundary import FixedPlane\n"
            "mesh = MeshLine(np.linspace(0, 1, 5))\n"
            "held = [FixedPlane(0, 0.0, -1)]\n"
            "list(implicit_steps(mesh, Particles.fill(mesh, uniaxial), LinearElastic(1.0, 0.0), held, steps=1))\n"
            "sys.exit('numba' in sys.modules)")
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# -- solvers -----------------------------------------------------------------------------------------------------------

def pulled(**choices):
    """The block with a wall on top that draws it out: multipliers."""
    x = np.linspace(0.05, 0.95, 12)
    wall = Wall(np.stack([x, np.ones_like(x)]), (0.0, 0.02), name="top")
    return block(boundary=[FixedPlane(1, 0.0, -1, (0, 1), name="base"), wall], **choices)


@pytest.fixture
def eager(monkeypatch):
    """All systems count as large; counts factorisations."""
    made, factorised = [], solve.factorised

    def counted(matrix):
        made.append(matrix.shape)
        return factorised(matrix)

    monkeypatch.setattr(solve, "SMALL", 0)
    monkeypatch.setattr(solve, "factorised", counted)
    return made


@pytest.mark.parametrize("run", [block, pulled])
@pytest.mark.parametrize("method", METHODS)
def test_one_factorisation_a_step_is_enough(method, run, eager):
    kept = last(run(method=method, cells=6))
    assert len(eager) == 2 and len(kept.residuals) > 2
    direct = last(run(method=method, cells=6, solver=solve_direct))
    near(kept, direct)
    assert len(kept.residuals) <= len(direct.residuals) + 1
    for name, force in direct.reactions.items():
        assert abs(kept.reactions[name] - force).max() <= 1e-8 * abs(force).max()


def test_reusing_a_factorisation_is_repeatable_and_forgotten_between_steps(eager):
    first, second = (last(block("gimp", cells=6)) for _ in range(2))
    halfway = next(block("gimp", cells=6))
    onward = last(block("gimp", cells=6, start=halfway, boundary=None, steps=1))
    for other in (second, onward):
        assert_array_equal(first.particles.x, other.particles.x)
        assert first.residuals == other.residuals


def matrix_of(size, seed=0):
    """Well posed, unsymmetric, with off-diagonals of all sizes."""
    bands = np.random.default_rng(seed).uniform(-1, 1, (5, size))
    bands[2] = 5
    return csc_array(diags_array([band[:size - abs(k)] for band, k in zip(bands, (-7, -1, 0, 1, 9))],
                                 offsets=[-7, -1, 0, 1, 9]))


def test_gmres_solves_to_rounding_and_gives_up_in_time():
    A = matrix_of(300)
    b = np.random.default_rng(1).normal(size=300)
    x = solve.gmres(A, b, lambda v: v / 5)
    assert np.linalg.norm(A @ x - b) <= 1e-11 * np.linalg.norm(b)
    assert (solve.gmres(A, np.zeros(300), lambda v: v) == 0).all()
    assert solve.gmres(A, b, lambda v: v * np.nan) is None
    assert solve.gmres(csc_array(diags_array(np.logspace(0, 9, 300))), b, lambda v: v) is None


def test_a_factorisation_that_does_not_help_is_replaced(eager):
    A, b = matrix_of(300), np.random.default_rng(1).normal(size=300)
    far = csc_array(diags_array(np.logspace(0, 9, 300)))
    singular = csc_array((300, 300))
    for bad in (far, singular):
        factors = solve.Factors()
        assert np.linalg.norm(A @ factors.solver(lambda: bad)(A, b) - b) <= 1e-11 * np.linalg.norm(b)
        before = len(eager)
        factors.solver(lambda: bad)(A, b)
        assert len(eager) == before                 # its own factorisation, kept
        other = matrix_of(300, seed=2) * 1000 + far
        assert np.linalg.norm(other @ factors.solver(lambda: other)(other, b) - b) <= 1e-11 * np.linalg.norm(b)


def test_conjugate_gradients_solve_what_is_positive_definite_and_refuse_the_rest():
    direct = last(block("gimp", solver=solve_direct))
    near(last(block("gimp", solver=solve_cg)), direct)
    with pytest.raises(NotConvergedError, match="positive diagonal"):
        last(pulled(solver=solve_cg))
    singular = block_diag([[[1.0, 1.0], [1.0, 1.0]]] * 50, format="csc")
    with pytest.raises(RuntimeError, match="positive definite"):
        solve_cg(singular, np.random.default_rng(0).normal(size=100))
