"""Von Mises soil keeps to its yield surface, follows its rate equations, and refuses numbers that make no sense."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skfem_mpm import LinearElastic, VonMises, axisymmetric, plane_strain, solid, uniaxial
from skfem_mpm.kinematics import Logarithmic, Objective, Small

PAPER = {"E": 400e3, "nu": 0.35, "peak": 6e3, "residual": 1e3, "softening": -25e3}
SOIL = VonMises(**PAPER)
ROOT = np.sqrt(3)
PLANE, SPACE = plane_strain.components, solid.components
every_motion = pytest.mark.parametrize("kinematics", [plane_strain, axisymmetric, solid], ids=lambda k: k.name)


def contract(a, b, components):
    """Double contraction of packed tensors, ``(n,)``."""
    return sum(x * y * (1 if i == j else 2) for x, y, (i, j) in zip(a, b, components))


def deviator(a, components):
    mean = a[:3].sum(axis=0) / 3
    return np.stack([row - (mean if i == j else 0) for row, (i, j) in zip(a, components)])


def shear_stress(stress, components):
    """sqrt(J2)."""
    s = deviator(stress, components)
    return np.sqrt(contract(s, s, components) / 2)


def cohesion(law, history):
    return np.maximum(law.residual, law.peak + law.softening * history[0])


def follow(law, increments, components, stress=None, history=None):
    """States after each of the strain increments ``(steps, ncomp, n)``, the start first."""
    n = increments.shape[2]
    stress = np.zeros((len(components), n)) if stress is None else stress
    history = np.zeros((1, n)) if history is None else history
    states = [(stress, history)]
    for strain in increments:
        states.append(law.update(strain, *states[-1], components))
    return states


def walk(components, size, steps=60, n=80, seed=0):
    return size * np.random.default_rng(seed).normal(size=(steps, len(components), n))


# The yield surface and the flow rule

@every_motion
@pytest.mark.parametrize("size", [2e-3, 2e-2, 1.0])
def test_the_yield_surface_is_never_exceeded(kinematics, size):
    states = follow(SOIL, walk(kinematics.components, size), kinematics.components)
    slips = []
    for (_, before), (stress, history) in zip(states, states[1:]):
        strength, reached = cohesion(SOIL, history), shear_stress(stress, kinematics.components)
        assert (reached <= strength * (1 + 1e-11)).all()
        slipping = history[0] > before[0]
        assert_allclose(reached[slipping], strength[slipping], rtol=1e-10)
        assert (history >= before).all()
        slips.append(slipping.mean())
    assert 0 < np.mean(slips) and (np.mean(slips) < 1 or size == 1)


@every_motion
def test_flow_follows_the_deviator_keeps_the_volume_and_has_the_length_of_the_history(kinematics):
    components = kinematics.components
    increments = walk(components, 1e-2)
    states = follow(SOIL, increments, components)
    for strain, (stress, history), (after, later) in zip(increments, states, states[1:]):
        elastic = SOIL.elastic_strain(after, components) - SOIL.elastic_strain(stress, components)
        plastic, s, slip = strain - elastic, deviator(after, components), later[0] - history[0]
        assert_allclose(plastic[:3].sum(axis=0), 0, atol=1e-14)
        assert_allclose(np.sqrt(contract(plastic, plastic, components) * 2 / 3), slip, atol=1e-13)
        q = np.sqrt(1.5 * contract(s, s, components))
        assert_allclose(plastic, 1.5 * slip * s / q, atol=1e-13)


@every_motion
def test_below_yield_and_in_pressure_the_soil_is_elastic(kinematics):
    components = kinematics.components
    elastic, strain = LinearElastic(SOIL.E, SOIL.nu), walk(components, 1e-4, steps=1)[0]
    strain[:3] += 10.0                                  # a great pressure changes nothing
    stress, history = SOIL.update(strain, np.zeros_like(strain), np.zeros((1, strain.shape[1])), components)
    expected, _ = elastic.update(strain, np.zeros_like(strain), np.zeros((0, strain.shape[1])), components)
    assert_array_equal(stress, expected)
    assert (history == 0).all()


def test_a_state_on_the_yield_surface_is_left_alone():
    (stress, history) = follow(SOIL, walk(PLANE, 1e-2), PLANE)[-1]
    again, later = SOIL.update(np.zeros_like(stress), stress, history, PLANE)
    assert_allclose(again, stress, rtol=1e-12, atol=1e-9)
    assert_allclose(later, history, rtol=1e-12)


@pytest.mark.parametrize("steps", [1, 2, 7, 1000])
@pytest.mark.parametrize("gamma", [0.02, 0.0405, 0.2, 0.36, 1.0])
def test_simple_shear_has_a_closed_form_in_any_number_of_steps(gamma, steps):
    """tau = G gamma, then c_p + H gamma_p / sqrt(3) with gamma_p = gamma - tau / G, then c_r."""
    increments = np.zeros((steps, 4, 1))
    increments[:, 3] = gamma / 2 / steps
    stress, history = follow(SOIL, increments, PLANE)[-1]
    slope = SOIL.softening / ROOT
    soft = (SOIL.peak + slope * gamma) / (1 + slope / SOIL.G)
    tau = min(SOIL.G * gamma, max(SOIL.residual, soft))
    assert_allclose(stress[:, 0], [0, 0, 0, tau], rtol=1e-11, atol=1e-9)
    assert_allclose(history[0, 0], (gamma - tau / SOIL.G) / ROOT, rtol=1e-11, atol=1e-14)


def test_the_papers_soil_is_residual_from_a_plastic_strain_of_a_fifth():
    strain = np.zeros((4, 2))
    strain[3] = ROOT / 2 * np.array([0.1999, 0.2001]) + SOIL.residual / (2 * SOIL.G)
    _, history = SOIL.update(strain, np.zeros((4, 2)), np.zeros((1, 2)), PLANE)
    assert history[0, 0] < 0.2 < history[0, 1]
    assert cohesion(SOIL, history)[0] > SOIL.residual == cohesion(SOIL, history)[1]


def bent_path(t):
    """A strain path that turns while the soil flows, and its rate."""
    turn, amount = 1.5 * t, 0.1
    return amount * np.array([np.cos(turn), -np.cos(turn), 0.1, 0.6 * np.sin(turn) + 0.2])


def rate_equations(law, components):
    """Prandtl-Reuss: elastic rates less flow along the deviator, the flow from consistency."""
    def rhs(t, y):
        stress, eps_p, strain = y[:4, None], y[4], bent_path(t)[:, None]
        s = deviator(stress, components)
        q = np.sqrt(1.5 * contract(s, s, components))[0]
        hardening = ROOT * (law.softening if law.peak + law.softening * eps_p > law.residual else 0.0)
        slip = max(0.0, 3 * law.G * contract(s, strain, components)[0] / q / (3 * law.G + hardening))
        flow = strain - 1.5 * slip * s / q
        return np.append(law.trial(flow, np.zeros((4, 1)), components)[:, 0], slip)

    return rhs


@pytest.mark.parametrize("law", [SOIL, VonMises(**(PAPER | {"residual": 6e3})),
                                 VonMises(**(PAPER | {"softening": -200e3}))], ids=["soft", "perfect", "brittle"])
def test_the_return_tends_to_the_rate_equations_at_first_order(law):
    start = np.array([law.peak, -law.peak, 0.0, 0.0])
    rates = rate_equations(law, PLANE)
    end = solve_ivp(rates, (0, 1), np.append(start, 0.0), rtol=1e-10, atol=1e-8, max_step=1e-3).y[:, -1]
    errors = []
    for steps in (100, 200, 400):
        middles = (np.arange(steps) + 0.5) / steps
        increments = np.array([bent_path(t) / steps for t in middles])[:, :, None]
        stress, history = follow(law, increments, PLANE, start[:, None], np.zeros((1, 1)))[-1]
        errors.append([np.abs(stress[:, 0] - end[:4]).max() / law.peak, abs(history[0, 0] - end[4])])
    errors = np.array(errors)
    assert (errors[-1] < 3e-3).all()
    assert (errors[:-1] / errors[1:] > 1.7).all()


def test_one_large_step_is_the_limit_of_many_small_ones_along_a_ray():
    """From rest and in one direction the closed form is exact, across the corner where softening ends too."""
    direction = walk(SPACE, 0.3, steps=1, n=50)
    one = follow(SOIL, direction, SPACE)[-1]
    many = follow(SOIL, np.repeat(direction / 3000, 3000, axis=0), SPACE)[-1]
    assert 0 < (one[1] > 0.2).sum() < 50 or (one[1] > 0.2).all()
    assert_allclose(many[0], one[0], rtol=1e-8, atol=1e-5)
    assert_allclose(many[1], one[1], rtol=1e-8)


def test_equal_cohesions_are_perfect_plasticity_whatever_the_softening():
    increments = walk(SPACE, 1e-2)
    laws = [VonMises(E=1e5, nu=0.3, peak=500.0, residual=500.0, softening=H) for H in (0.0, -1e3, -6e4)]
    paths = [follow(law, increments, SPACE) for law in laws]
    for path in paths[1:]:
        for (stress, history), (other, later) in zip(paths[0], path):
            assert_allclose(other, stress, rtol=1e-10, atol=1e-7)
            assert_allclose(later, history, rtol=1e-10)
    assert_allclose(shear_stress(paths[0][-1][0], SPACE), 500.0, rtol=1e-10)


def test_without_softening_the_peak_holds():
    law = VonMises(E=1e5, nu=0.3, peak=500.0, residual=1.0)
    stress, _ = follow(law, walk(PLANE, 1e-1), PLANE)[-1]
    assert_allclose(shear_stress(stress, PLANE), 500.0, rtol=1e-10)


def test_a_cohesion_without_bound_is_elasticity():
    """The default never yields."""
    law, increments = VonMises(E=1e5, nu=0.3), walk(PLANE, 1e-2, steps=3)
    stress, history = follow(law, increments, PLANE)[-1]
    assert_allclose(stress, law.trial(increments.sum(axis=0), np.zeros_like(stress), PLANE), rtol=1e-12, atol=1e-9)
    assert (history == 0).all()


@pytest.mark.parametrize("given", [{}, {"softening": -1e3}, {"residual": 5.0, "softening": -1e3}], ids=str)
def test_a_cohesion_without_bound_dissipates_nothing(given):
    """No infinity meets a zero, in stress, tangent or energy."""
    law, elastic = VonMises(E=1e5, nu=0.3, **given), LinearElastic(E=1e5, nu=0.3)
    strain, history = walk(PLANE, 1.0, steps=1)[0], np.zeros((1, 80))
    with np.errstate(all="raise"):
        stress, later = law.update(strain, np.zeros((4, 80)), history, PLANE)
        moduli = law.tangent(strain, np.zeros((4, 80)), history, plane_strain.rows(2))
        assert_array_equal(law.dissipation(history, later), np.zeros(80))
    assert_array_equal(stress, elastic.trial(strain, np.zeros((4, 80)), PLANE))
    assert_array_equal(moduli, elastic.tangent(strain, stress, later, plane_strain.rows(2)) * np.ones(80))
    assert (later == 0).all()


def test_the_law_has_no_direction():
    """Turned strains make turned stresses."""
    increments = walk(SPACE, 1e-2, steps=20, n=5)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()

    def turned(packed):
        full = np.einsum("ij,jkn,lk->iln", turn, solid.tensor(packed), turn)
        return np.stack([full[place] for place in SPACE])

    stress, history = follow(SOIL, increments, SPACE)[-1]
    other, later = follow(SOIL, np.stack([turned(strain) for strain in increments]), SPACE)[-1]
    assert_allclose(other, turned(stress), atol=1e-8)
    assert_allclose(later, history, rtol=1e-11)


def test_plane_strain_is_space_without_its_other_shears():
    increments = walk(PLANE, 1e-2)
    increments[:, 2] = 0
    wide = np.concatenate([increments, np.zeros((60, 2, 80))], axis=1)
    (stress, history), (other, later) = follow(SOIL, increments, PLANE)[-1], follow(SOIL, wide, SPACE)[-1]
    assert_array_equal(np.concatenate([stress, np.zeros((2, 80))]), other)
    assert_array_equal(history, later)


def test_units_do_not_matter():
    """Stresses scaled by a power of two: the same strains, bit for bit."""
    for scale in (2.0 ** 30, 2.0 ** -30):
        law = VonMises(**{name: value if name == "nu" else scale * value for name, value in PAPER.items()})
        increments = walk(PLANE, 1e-2)
        (stress, history), (other, later) = (follow(which, increments, PLANE)[-1] for which in (SOIL, law))
        assert_array_equal(stress * scale, other)
        assert_array_equal(history, later)


# Energy

def balance(law, states, increments, components):
    """Work of the mean stress, change of stored energy and dissipation, summed over steps, each ``(n,)``."""
    work = sum(contract((a + b) / 2, strain, components)
               for strain, (a, _), (b, _) in zip(increments, states, states[1:]))
    lost = sum(law.dissipation(a, b) for (_, a), (_, b) in zip(states, states[1:]))
    first, last = (law.energy_density(states[k][0], None, components) for k in (0, -1))
    return work, last - first, lost


@every_motion
@pytest.mark.parametrize("eps_p", [0.0, 0.15, 0.1999, 0.3], ids=["peak", "soft", "corner", "residual"])
def test_energy_balances_exactly_in_a_step_along_the_stress_that_is_plastic_throughout(kinematics, eps_p):
    """With the mean of the cohesions before and after; with the one after, the share of softening would be missing."""
    components = kinematics.components
    along = deviator(walk(components, 1.0, steps=1)[0], components)
    along /= shear_stress(along, components)
    before = np.full((1, along.shape[1]), eps_p)
    start = (cohesion(SOIL, before) * along, before)
    strain = 0.01 * along
    strain[:3] += 0.02 * walk(components, 1.0, steps=1, seed=1)[0][0]       # pressure comes and goes as it likes
    states = [start, SOIL.update(strain, *start, components)]
    assert (states[1][1] > before).all()
    work, stored, lost = balance(SOIL, states, [strain], components)
    assert_allclose(work, stored + lost, rtol=1e-11, atol=1e-9)


def test_dissipation_is_the_area_under_the_cohesion_in_any_number_of_steps():
    area = ROOT * (6e3 * 0.18 - 25e3 * 0.18 ** 2 / 2)
    for steps in (1, 3, 50):
        path = np.linspace(0, 0.18, steps + 1)[:, None, None]
        assert_allclose(sum(SOIL.dissipation(a, b) for a, b in zip(path, path[1:])), area, rtol=1e-13)
    ends = np.linspace(0.18, 0.22, 401)[:, None, None]              # softening ends at 0.2, within a step or not
    area += ROOT * ((1500.0 + 1000.0) / 2 * 0.02 + 1000.0 * 0.02)
    found = SOIL.dissipation(np.zeros((1, 1)), ends[0]) + sum(SOIL.dissipation(a, b) for a, b in zip(ends, ends[1:]))
    assert_allclose(found, area, rtol=1e-6)


def test_energy_balances_to_second_order_along_a_bent_path():
    start = np.array([[SOIL.peak], [-SOIL.peak], [0.0], [0.0]])
    gaps = []
    for steps in (200, 400, 800):
        increments = np.array([bent_path(t) / steps for t in (np.arange(steps) + 0.5) / steps])[:, :, None]
        states = follow(SOIL, increments, PLANE, start, np.zeros((1, 1)))
        work, stored, lost = balance(SOIL, states, increments, PLANE)
        gaps.append(abs(work - stored - lost)[0] / lost[0])
    assert gaps[-1] < 2e-5
    assert min(gaps[0] / gaps[1], gaps[1] / gaps[2]) > 3.4


@every_motion
def test_flow_takes_energy_and_never_gives(kinematics):
    states = follow(SOIL, walk(kinematics.components, 1e-2), kinematics.components)
    lost = np.array([SOIL.dissipation(a, b) for (_, a), (_, b) in zip(states, states[1:])])
    slipped = np.array([b[0] > a[0] for (_, a), (_, b) in zip(states, states[1:])])
    assert (lost[slipped] > 0).all() and (lost[~slipped] == 0).all()


@pytest.mark.parametrize("kinematics", [uniaxial, plane_strain, axisymmetric, solid], ids=lambda k: k.name)
@pytest.mark.parametrize("nu", [-0.3, 0.0, 0.49])
def test_elastic_strain_is_the_inverse_of_the_elastic_law(kinematics, nu):
    law, strain = LinearElastic(E=3.0, nu=nu), walk(kinematics.components, 1.0, steps=1)[0]
    stress = law.trial(strain, np.zeros_like(strain), kinematics.components)
    assert_allclose(law.elastic_strain(stress, kinematics.components), strain, rtol=1e-11, atol=1e-12)


# In the kinematics

def test_in_logarithmic_strain_stress_belongs_to_the_elastic_strain_left():
    random = np.random.default_rng(1)
    epsilon, history = np.zeros((4, 30)), np.zeros((1, 30))
    for _ in range(5):
        motion = Logarithmic(plane_strain, 2, SOIL, np.zeros((4, 30)), epsilon, history)
        answer = motion.respond(0.05 * random.normal(size=(4, 30)))
        epsilon, history = answer.epsilon, answer.history
        assert_allclose(SOIL.elastic_strain(answer.sigma, PLANE), epsilon, atol=1e-14)
        assert (shear_stress(answer.sigma, PLANE) <= cohesion(SOIL, history) * (1 + 1e-11)).all()
    assert (history > 0).any()


def test_turning_does_not_make_soil_yield():
    """A body on its yield surface is turned around in 360 steps."""
    start = follow(SOIL, walk(PLANE, 1e-2, n=10), PLANE)[-1]
    stress, history = start
    angle = np.tan(np.pi / 360)                       # Hughes-Winget: half the spin of a step of one degree
    spin = np.repeat(np.array([[0.0], [-2 * angle], [2 * angle], [0.0]]), 10, axis=1)
    for _ in range(360):
        answer = Objective(plane_strain, 2, SOIL, stress, None, history).respond(spin)
        stress, history = answer.sigma, answer.history
    assert_allclose(stress, start[0], rtol=1e-9, atol=1e-6)
    assert_allclose(history, start[1], rtol=1e-9)


class KirchhoffSoil(VonMises):
    """The same in Kirchhoff stress."""

    kirchhoff = True


BRANCHES = {"elastic": (0.0, 1e-3), "soft": (0.0, 0.03), "residual": (0.3, 0.03), "both": (0.17, 0.05)}
ROOM = [(plane_strain, 2), (axisymmetric, 1), (axisymmetric, 2), (solid, 3)]


@pytest.mark.parametrize("strain, law", [(Small, SOIL), (Logarithmic, SOIL), (Logarithmic, KirchhoffSoil(**PAPER))],
                         ids=["small", "logarithmic", "kirchhoff"])
@pytest.mark.parametrize("kinematics, dim", ROOM, ids=lambda value: getattr(value, "name", value))
@pytest.mark.parametrize("branch", BRANCHES)
def test_the_tangent_is_the_derivative_of_the_stress(strain, law, kinematics, dim, branch):
    (eps_p, size), random = BRANCHES[branch], np.random.default_rng(0)
    rows, n = kinematics.rows(dim), 30
    sheared = np.array([[i == j or (i, j) in rows] for i, j in kinematics.components])
    epsilon = 1e-3 * sheared * random.normal(size=(kinematics.ncomp, n))
    sigma, history = law.trial(epsilon, 0 * epsilon, kinematics.components), np.full((1, n), eps_p)
    motion = strain(kinematics, dim, law, sigma, epsilon, history)
    gradient = size * random.normal(size=(len(rows), n))
    answer = motion.respond(gradient)
    slips, ends = answer.history > history, cohesion(law, answer.history) == law.residual
    assert {"elastic": ~slips, "soft": ~ends, "residual": ends, "both": ends | slips}[branch].mean() > 0.7
    exact = np.broadcast_to(answer.tangent(), (len(rows), len(rows), n))
    step = 1e-7
    found = np.stack([motion.respond(gradient + step * unit[:, None]).piola
                      - motion.respond(gradient - step * unit[:, None]).piola for unit in np.eye(len(rows))], axis=1)
    close = np.isclose(found / (2 * step), exact, atol=2e-6 * law.E).all(axis=(0, 1))
    assert close.mean() > 0.95           # no derivative where a difference reaches over the corner of a branch


def test_a_bar_drawn_out_and_back_keeps_the_work_of_its_flow():
    """Finite strain in space: work is stored energy and dissipation; in Kirchhoff stress per volume at rest, here 1."""
    def gradient(t):
        return 0.3 * np.array([np.sin(t), 0.5 * np.sin(2 * t), 0, -0.2 * np.sin(t), -0.5 * np.sin(t), 0, 0, 0, 0.0])

    gaps = []
    for steps in (100, 200, 400):
        sigma, epsilon, history, volume = np.zeros((6, 1)), np.zeros((6, 1)), np.zeros((1, 1)), 1.0
        work = lost = 0.0
        F = np.eye(3)
        for t in np.linspace(0, 2 * np.pi, steps + 1)[1:]:
            new = np.eye(3) + gradient(t).reshape(3, 3)
            change = (new @ np.linalg.inv(F) - np.eye(3)).reshape(9, 1)
            answer = Logarithmic(solid, 3, KirchhoffSoil(**PAPER), sigma, epsilon, history).respond(change)
            start = np.stack([solid.tensor(sigma)[place] for place in solid.rows(3)])
            work += volume * ((start + answer.piola) / 2 * change).sum()
            lost += SOIL.dissipation(history, answer.history)[0]
            F, volume = new, volume * answer.ratio[0]
            sigma, epsilon, history = answer.sigma, answer.epsilon, answer.history
        stored = KirchhoffSoil(**PAPER).energy_density(sigma, epsilon, SPACE)[0] * volume
        gaps.append(abs(work - stored - lost) / lost)
    assert history[0, 0] > 0.2 and gaps[-1] < 1e-3
    assert gaps[0] / gaps[2] > 3


# What it refuses

def test_updates_are_pure():
    strain, stress, history = np.full((4, 3), 0.1), np.full((4, 3), 2.0), np.full((1, 3), 0.05)
    for array in (strain, stress, history):
        array.flags.writeable = False
    first, second = (SOIL.update(strain, stress, history, PLANE) for _ in range(2))
    for one, two in zip(first, second):
        assert_array_equal(one, two)
    with pytest.raises(FrozenInstanceError):
        SOIL.peak = 1.0


@pytest.mark.parametrize("given, message", [
    ({"residual": 7e3}, r"^residual: got 7000\.0 with peak 6000\.0, expected 0 < residual <= peak"),
    ({"residual": 0.0}, "^residual: got 0"),
    ({"residual": -1.0}, "^residual: got -1"),
    ({"residual": np.nan}, "^residual: got nan"),
    ({"peak": np.nan}, "^residual: got 1000.* with peak nan"),
    ({"peak": -6e3, "residual": -7e3}, "^residual: got -7000"),
    ({"softening": 1.0}, "^softening: got 1.0, expected zero or a negative"),
    ({"softening": np.nan}, "^softening: got nan"),
    ({"softening": -np.inf}, "^softening: got -inf"),
    ({"softening": -257e3}, r"^softening: got -257000\.0, steeper.*-256600"),
    ({"softening": "steep"}, "^softening: got 'steep', expected one number"),
    ({"peak": np.array([6e3, 7e3])}, r"^peak: got array\(.*\), expected one number for the whole body"),
    ({"residual": [1e3, 2e3]}, "^residual: got .*expected one number"),
    ({"peak": None}, "^peak: got None, expected one number"),
    ({"E": 0.0}, "^E: got 0"),
    ({"nu": 0.5}, "^nu: got 0.5"),
], ids=str)
def test_numbers_that_make_no_sense_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        VonMises(**(PAPER | given))


def test_softening_just_less_steep_than_the_limit_is_followed():
    law = VonMises(**(PAPER | {"softening": -0.999 * ROOT * SOIL.G}))
    increments = walk(PLANE, 1e-3)
    for stress, history in follow(law, increments, PLANE):
        assert (shear_stress(stress, PLANE) <= cohesion(law, history) * (1 + 1e-9)).all()


@pytest.mark.parametrize("call", ["update", "tangent"])
def test_a_bar_is_refused(call):
    with pytest.raises(ValueError, match="got 1 component.*expected 4 or 6.*plane_strain, axisymmetric or solid"):
        getattr(SOIL, call)(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), uniaxial.components)
