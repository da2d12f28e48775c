"""What a run warns of: laws that lock or differ from point to point in a cell, and bodies that fly apart."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from shared import compiled
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    Hencky,
    LinearElastic,
    Particles,
    axisymmetric,
    explicit_steps,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.cautions import Pieces

UNIT = LinearElastic(E=1.0, nu=0.0)
SOLVERS = {"explicit": explicit_steps, "implicit": implicit_steps}
solvers = pytest.mark.parametrize("solve", SOLVERS.values(), ids=SOLVERS)


class Patches:
    """Elasticity with a Young's modulus for each point and no lateral contraction, small strain."""

    kirchhoff = False
    history = ()

    def __init__(self, E):
        self.E = E

    def update(self, strain, stress, history, components):
        return stress + self.E * strain, history

    def tangent(self, strain, stress, history, places):
        return UNIT.tangent(strain, stress, history, places) * self.E


def square(cells=3):
    lines = np.arange(cells + 3.0) - 1
    mesh = MeshQuad.init_tensor(lines, lines)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < cells)).all(axis=0), density=1.0)
    return mesh, body, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1)]


def heard(solve, mesh, body, law, boundary, **choices):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        next(solve(mesh, body, law, boundary, steps=1, **choices))
    return [str(each.message) for each in said if each.category is UserWarning]


# -- strain without its stress -----------------------------------------------------------------------------------------

@solvers
def test_strain_that_does_not_go_with_the_stress_is_told(solve):
    mesh, body, planes = square()
    law, epsilon = Hencky(E=1.0, nu=0.0), np.zeros((4, body.n))
    epsilon[0, 3] = 0.01
    good = replace(body, epsilon=epsilon, sigma=law.update(epsilon, 0 * epsilon, np.zeros((0, body.n)),
                                                           plane_strain.components)[0] / np.exp(epsilon[0]))
    assert not heard(solve, mesh, good, law, planes, strain="logarithmic")
    assert not heard(solve, mesh, replace(good, epsilon=None), UNIT, planes, strain="small")
    assert not heard(solve, mesh, replace(good, sigma=None), law, planes, strain="logarithmic")
    said, = heard(solve, mesh, replace(good, sigma=2 * good.sigma), law, planes, strain="logarithmic")
    assert said.startswith("epsilon: got strain that goes with the stress [0.0099") and "point 3 at" in said
    said, = heard(solve, mesh, replace(good, sigma=None), UNIT, planes, strain="small")
    assert said.startswith("epsilon: got strain without stress")


# -- locking ----------------------------------------------------------------------------------------------------------

@solvers
@pytest.mark.parametrize("nu, warned", [(0.3, False), (0.45, False), (0.46, True), (0.499999, True)])
def test_a_nearly_incompressible_law_is_warned_of(solve, nu, warned):
    mesh, body, planes = square()
    said = heard(solve, mesh, body, LinearElastic(E=1.0, nu=nu), planes)
    assert [f"{nu:g}" in word and "remedy='bbar'" in word for word in said] == [True] * warned


@solvers
def test_with_a_remedy_nothing_is_said(solve):
    mesh, body, planes = square()
    assert not heard(solve, mesh, body, LinearElastic(E=1.0, nu=0.499), planes, remedy="bbar")


def test_rings_on_a_line_lock_and_bars_do_not():
    mesh = MeshLine(np.arange(6.0))
    law, planes = LinearElastic(E=1.0, nu=0.499), [FixedPlane(0, 1.0, -1)]
    for kinematics, count in [(uniaxial, 0), (axisymmetric, 1)]:
        body = Particles.fill(mesh, kinematics, where=lambda x: (x[0] > 1) & (x[0] < 4), density=1.0)
        assert len(heard(explicit_steps, mesh, body, law, planes)) == count


# -- points that differ -----------------------------------------------------------------------------------------------

def layers(ratio, x, at):
    return Patches(np.where(x[0] > at, ratio, 1.0))


@solvers
@pytest.mark.parametrize("at, ratio, warned", [(2.0, 1e8, False), (1.5, 1e8, True), (1.5, 50.0, False)])
def test_points_of_a_cell_that_differ_in_stiffness_are_warned_of(solve, at, ratio, warned):
    mesh, body, planes = square()
    said = heard(solve, mesh, body, layers(ratio, body.x, at), planes, strain="small")
    assert ["cell" in word and "point" in word for word in said] == [True] * warned


@pytest.mark.parametrize("method", ["mpm", "gimp"])
@pytest.mark.parametrize("ratio", [1e2, 1e5, 1e8])
def test_soft_and_hard_parts_in_series(method, ratio):
    """The floor is a share of the softest stiffness around: one of the mean would carry more than the soft part."""
    mesh, body, planes = square(4)
    law, pull = layers(ratio, body.x, 2.0), 1e-6
    along = np.arange(5.0)
    end = Wall(np.stack([0 * along + 4, along]), (pull, None), name="end")
    state = next(implicit_steps(mesh, body, law, [*planes, end], steps=1, strain="small", method=method))
    exact = 4 * pull / (2 + 2 / ratio)
    assert state.reactions["end"][0] == pytest.approx(exact, rel=1e-4)


@pytest.mark.parametrize("remedy", ["none", "bbar"])
@pytest.mark.parametrize("ghost", [0.0, 0.1])
def test_a_soft_end_in_a_cut_cell_is_not_held_by_what_steadies_the_grid(remedy, ghost):
    mesh, body, planes = square(4)
    body = body.where(body.x[1] < 3.5)
    law, pull = layers(1e8, body.x, 2.0), 1e-6
    along = np.linspace(0, 3.5, 5)
    end = Wall(np.stack([0 * along + 4, along]), (pull, None), name="end")
    state = next(implicit_steps(mesh, body, law, [*planes, end], steps=1, strain="small", remedy=remedy, ghost=ghost))
    kink = 0.05 if ghost else 1e-4                  # the penalty is on the kink at the interface too
    assert state.reactions["end"][0] == pytest.approx(3.5 * pull / 2, rel=kink)


@compiled
def test_a_law_with_numbers_for_each_point_sees_them_in_their_order():
    """Engines agree, though the compiled one sorts points: not those of a law that it does not know."""
    mesh, body, planes = square()
    order = np.random.default_rng(3).permutation(body.n)
    body = body.where(order)
    body = replace(body, velocity=np.stack([-1e-3 * body.x[0], 2e-3 * body.x[1]]))
    law = Patches(np.where(body.x[0] > 1, 50.0, 1.0))
    found = [next(explicit_steps(mesh, body, law, planes, steps=120, every=120, engine=engine)).particles
             for engine in ("numpy", "numba")]
    for name in ("x", "sigma"):
        ours, theirs = (getattr(each, name) for each in found)
        assert abs(ours - theirs).max() < 1e-10 * abs(ours).max()


# -- bodies that fly apart ---------------------------------------------------------------------------------------------

@pytest.mark.parametrize("engine", ["numpy", pytest.param("numba", marks=[pytest.mark.slow, compiled])])
@pytest.mark.parametrize("start, warned", [("one", True), ("two", False)])
def test_bodies_that_fly_apart(engine, start, warned):
    """Two that were apart from the start are no news."""
    body = Particles.fill(MeshLine(np.arange(3.0)), uniaxial, density=1.0)
    right = body.x > 1
    body = replace(body, x=body.x + (1 + 2 * (start == "two")) * right - 0.5, velocity=np.where(right, 0.3, -0.3))
    soft, mesh = LinearElastic(E=1e-9, nu=0.0), MeshLine(np.arange(-40.0, 40))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        list(explicit_steps(mesh, body, soft, steps=200, dt=0.3, engine=engine))
    assert [str(each.message)[:8] for each in said if "come apart" in str(each.message)] == ["step 200"] * warned


def test_pieces_are_counted_over_edges_and_corners():
    assert Pieces(np.array([[0, 1, 5], [0, 1, 0]]), 1).first.tolist() == [0, 0, 1]
    assert Pieces(np.array([[0, 1, 3, 10 ** 6], [0, 1, 0, 10 ** 6]]), 2).first.tolist() == [0, 0, 0, 1]
    assert Pieces(np.array([[7], [3]]), 1).first.tolist() == [0]


def test_bodies_that_meet_and_part_have_not_come_apart():
    body = Particles.fill(MeshLine(np.arange(3.0)), uniaxial, density=1.0)
    right = body.x > 1
    body = replace(body, x=body.x + 2.0 * right - 0.5, velocity=np.where(right, -0.03, 0.03))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*come apart")
        warnings.filterwarnings("ignore", message=".*times the")        # a blow between cells gives energy
        *_, state = explicit_steps(MeshLine(np.arange(-40.0, 40)), body, UNIT, steps=400, engine="numpy")
    assert (np.diff(state.particles.velocity[0][[0, -1]]) > 0).all()             # they have met


def test_what_domains_reach_over_is_no_gap():
    body = Particles.fill(MeshLine(np.arange(9.0)), uniaxial, per_cell=1, density=1.0)
    body = replace(body, velocity=0.03 * np.cos(np.pi * body.x / 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(explicit_steps(MeshLine(np.arange(-4.0, 13)), body, UNIT, steps=1000, method="gimp", engine="numpy"))
