"""The references of the thick-walled cylinder against printed values, their own equations and a second solver."""

import numpy as np
import pytest
import sympy
from numpy.polynomial import Chebyshev
from numpy.testing import assert_allclose
from scipy.integrate import solve_bvp
from scipy.special import lambertw

from skfem_mpm.checks import NotConvergedError
from skfem_mpm.scenes import cylinder_reference
from skfem_mpm.scenes.cylinder_reference import (
    MEASURES,
    deviatoric,
    finite,
    finite_history,
    incremental,
    lame,
    reaction_lame,
)

E, NU = 25e6, 0.3
LAM, G = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
WALLS = [(0.5, 1.5), (1.0, 2.0), (1.0, 3.0), (2.0, 4.0), (5.0, 10.0)]
LARGE = [(1.0, 3.0, 0.75), (1.0, 2.0, 0.5), (1.0, 3.0, 1.5), (1.0, 20.0, 2.0)]
# radial, hoop and deviatoric stress in kPa at the inner, middle and outer radius, for 1.5 cm
PRINTED = {
    (0.5, 1.5): ([-829.33, -342.55, -252.40], [468.75, -18.03, -108.17], [1126.48, 290.15, 144.23]),
    (1.0, 2.0): ([-625.00, -411.32, -336.54], [144.23, -69.44, -144.23], [673.08, 311.30, 192.31]),
    (1.0, 3.0): ([-414.66, -171.27, -126.20], [234.38, -9.01, -54.09], [563.24, 145.07, 72.12]),
    (2.0, 4.0): ([-312.50, -205.66, -168.27], [72.12, -34.72, -72.12], [336.54, 155.65, 96.15]),
    (5.0, 10.0): ([-125.00, -82.26, -67.31], [28.85, -13.89, -28.85], [134.62, 62.26, 38.46]),
}


def by_collocation(R, E, nu, inner, outer, displacement, measure):
    """Solve the same problem in other unknowns (r and radial stress over R) and by another method (collocation)."""
    lam, G = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    M = lam + 2 * G

    def strains(R, r, radial):
        hoop = np.log(r / R)
        if measure == "cauchy":
            return radial - lam / M * hoop, hoop
        x = -lambertw(-radial * np.exp(hoop * (1 - lam / M))).real      # x exp(-x) = radial exp(...)
        return x - lam / M * hoop, hoop

    def slope(R, yz):
        r, radial = yz                                                  # radial stress over M
        e_r, e_t = strains(R, r, radial)
        ratio = np.exp(e_r + e_t) if measure == "kirchhoff" else 1.0
        stretch = np.exp(e_r)
        return np.array([stretch, -stretch * 2 * G / M * (e_r - e_t) / ratio / r])

    def ends(a, b):
        return np.array([a[0] - inner - wall, b[0] - outer])

    grid = np.geomspace(inner, outer, 60)
    guess = np.array([grid, 0 * grid])
    for wall in np.append(np.linspace(0, displacement, 11)[1:], displacement):
        tol = 1e-10 if guess[0, 0] == pytest.approx(inner + wall) else 1e-4
        guess[0] += (inner + wall - guess[0, 0]) * (outer - guess[0]) / (outer - guess[0, 0])
        solution = solve_bvp(slope, ends, grid, guess, tol=tol, max_nodes=50000)
        assert solution.success, (wall, solution.message)
        grid, guess = solution.x, solution.y
    r, radial = solution.sol(R)
    e_r, e_t = strains(R, r, radial)
    ratio = np.exp(e_r + e_t) if measure == "kirchhoff" else 1.0
    volumetric = lam * (e_r + e_t)
    return r, np.array([volumetric + 2 * G * e_r, volumetric, volumetric + 2 * G * e_t, 0 * r]) / ratio


# --- Lame


@pytest.mark.parametrize("wall", WALLS)
def test_lame_gives_the_printed_stresses(wall):
    r = np.array([wall[0], sum(wall) / 2, wall[1]])
    _, stress = lame(r, E, NU, *wall, 0.015)
    assert_allclose(np.array([stress[0], stress[2], deviatoric(stress)]) / 1e3, PRINTED[wall], atol=0.0051)


def test_lame_is_in_equilibrium_and_meets_both_ends():
    r, inner, outer, u_i, lam, shear = sympy.symbols("r r_i r_e u lambda G", positive=True)
    a, b = -u_i * inner / (outer**2 - inner**2), u_i * inner * outer**2 / (outer**2 - inner**2)
    u = a * r + b / r
    trace = sympy.diff(u, r) + u / r
    radial, hoop = lam * trace + 2 * shear * sympy.diff(u, r), lam * trace + 2 * shear * u / r
    assert sympy.simplify(sympy.diff(radial, r) + (radial - hoop) / r) == 0
    assert sympy.simplify(u.subs(r, inner) - u_i) == 0 and sympy.simplify(u.subs(r, outer)) == 0
    q_squared = 3 * shear**2 * 4 * (a**2 / 3 + b**2 / r**4)
    strain = [sympy.diff(u, r), u / r, 0]
    second = sum((e - trace / 3) ** 2 for e in strain) / 2
    assert sympy.simplify(3 * (2 * shear) ** 2 * second - q_squared) == 0
    # the code against these symbols
    values = {inner: 1, outer: 3, u_i: 0.015, lam: LAM, shear: G}
    points = np.linspace(1, 3, 7)
    code_u, stress = lame(points, E, NU, 1.0, 3.0, 0.015)
    for symbol, code in ((u, code_u), (radial, stress[0]), (lam * trace, stress[1]), (hoop, stress[2])):
        expected = [float(symbol.subs(values).subs(r, point)) for point in points]
        assert_allclose(code, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert_allclose(deviatoric(stress)**2, [float(q_squared.subs(values).subs(r, p)) for p in points], rtol=1e-12)


@pytest.mark.parametrize("nu", [-0.9, 0.0, 0.3, 0.4999])
@pytest.mark.parametrize("wall", WALLS)
def test_lame_is_in_equilibrium_by_differences(wall, nu):
    r, h = np.linspace(*wall, 9)[1:-1], 1e-4 * wall[0]
    stress, after, before = (lame(r + d, E, nu, *wall, 0.01)[1] for d in (0, h, -h))
    residual = (after[0] - before[0]) / (2 * h) + (stress[0] - stress[2]) / r
    assert np.abs(residual * r).max() < 1e-6 * deviatoric(stress).max()


def test_lame_is_linear_in_displacement_and_modulus():
    r = np.linspace(1, 3, 5)
    u, stress = lame(r, E, NU, 1.0, 3.0, 0.01)
    u2, stress2 = lame(r, 3 * E, NU, 1.0, 3.0, -0.02)
    assert_allclose(u2, -2 * u, rtol=1e-13, atol=1e-17)
    assert_allclose(stress2, -6 * stress, rtol=1e-12)


def test_reaction_is_wall_stress_times_radius():
    _, stress = lame(np.array([0.5]), E, NU, 0.5, 1.5, 0.015)
    assert reaction_lame(E, NU, 0.5, 1.5, 0.015) == pytest.approx(-0.5 * stress[0, 0], rel=1e-14)
    assert reaction_lame(E, NU, 0.5, 1.5, 0.015) == pytest.approx(0.5 * 829.33e3, rel=1e-5)


def test_reaction_is_the_derivative_of_the_stored_energy():
    x, weight = np.polynomial.legendre.leggauss(40)
    r = 2 + x
    u, stress = lame(r, E, NU, 1.0, 3.0, 0.01)
    a, b = -0.01 / 8, 0.09 / 8
    energy = (weight * r * (stress[0] * (a - b / r**2) + stress[2] * u / r)).sum() / 2
    assert energy == pytest.approx(reaction_lame(E, NU, 1.0, 3.0, 0.01) * 0.01 / 2, rel=1e-12)


# --- incremental


def test_incremental_gives_the_printed_curve():
    history = incremental(np.array([1.525]), E, NU, 1.0, 3.0, 0.015, 50)
    q = deviatoric(history.stress)[:, 0] / 1e3
    assert_allclose(q[[0, 9, 24, 49]], [244.4, 2530.7, 6661.1, 14439.0], atol=0.051)
    assert history.position[-1, 0] == pytest.approx(2.01, abs=0.001)


def test_first_increment_is_lame():
    R = np.linspace(1, 3, 6)
    u, stress = lame(R, E, NU, 1.0, 3.0, 0.015)
    history = incremental(R, E, NU, 1.0, 3.0, 0.015, 1)
    assert_allclose(history.position[0], R + u, rtol=1e-15)
    assert_allclose(history.stress[:, 0], stress, rtol=1e-15)
    assert history.reaction[0] == pytest.approx(reaction_lame(E, NU, 1.0, 3.0, 0.015) * 1.015)


def test_incremental_wall_points_stay_on_the_walls():
    history = incremental(np.array([1.0, 3.0]), E, NU, 1.0, 3.0, 0.015, 50)
    assert_allclose(history.position[:, 0], 1 + 0.015 * np.arange(1, 51), rtol=1e-14)
    assert_allclose(history.position[:, 1], 3, rtol=1e-14)
    assert_allclose(history.pressure, -history.stress[0, :, 0], rtol=1e-15)


def test_incremental_stays_close_to_equilibrium_but_is_not_in_it():
    R = np.array([1.0, 1.525, 3.0])
    exact = deviatoric(finite(R, E, NU, 1.0, 3.0, 0.75).stress)
    for steps, expected in ((50, [0.075, 0.011, -0.075]), (1000, [0.072, 0.013, -0.067])):
        q = deviatoric(incremental(R, E, NU, 1.0, 3.0, 0.75 / steps, steps).stress)[-1]
        assert_allclose(q / exact - 1, expected, atol=0.001)


# --- finite


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("inner, outer, push", LARGE)
def test_finite_agrees_with_a_second_solver(inner, outer, push, measure):
    R = np.linspace(inner, outer, 23)
    state = finite(R, E, NU, inner, outer, push, measure)
    r, stress = by_collocation(R, E, NU, inner, outer, push, measure)
    assert_allclose(state.position, r, rtol=1e-8)
    assert_allclose(state.stress, stress, atol=1e-8 * np.abs(stress).max())
    assert state.pressure == pytest.approx(-stress[0, 0], rel=1e-8)
    assert state.reaction == pytest.approx(-stress[0, 0] * (inner + push), rel=1e-8)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.4999])
@pytest.mark.parametrize("measure", MEASURES)
def test_finite_agrees_with_a_second_solver_for_any_poisson_ratio(measure, nu):
    R = np.linspace(1, 3, 11)
    state = finite(R, E, nu, 1.0, 3.0, 0.75, measure)
    r, stress = by_collocation(R, E, nu, 1.0, 3.0, 0.75, measure)
    assert_allclose(state.position, r, rtol=1e-8)
    assert_allclose(state.stress, stress, atol=1e-8 * np.abs(stress).max())


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("inner, outer, push", LARGE[:3])
def test_finite_is_in_equilibrium_and_obeys_its_law(inner, outer, push, measure):
    """Spectral derivatives of the returned positions and stresses; nothing of the solver is used."""
    R = Chebyshev.basis(49, domain=[inner, outer]).roots()
    state = finite(R, E, NU, inner, outer, push, measure)
    stretch = Chebyshev.fit(R, state.position, 48, domain=[inner, outer]).deriv()(R)
    e_r, e_t = np.log(stretch), np.log(state.position / R)
    ratio = np.exp(e_r + e_t) if measure == "kirchhoff" else 1.0
    law = np.array([LAM * (e_r + e_t) + 2 * G * e_r, LAM * (e_r + e_t), LAM * (e_r + e_t) + 2 * G * e_t, 0 * R]) / ratio
    size = np.abs(state.stress).max()
    assert_allclose(state.stress, law, atol=1e-9 * size)
    gradient = Chebyshev.fit(R, state.stress[0], 48, domain=[inner, outer]).deriv()(R) / stretch
    assert_allclose(gradient + (state.stress[0] - state.stress[2]) / state.position, 0, atol=1e-8 * size)


@pytest.mark.parametrize("measure", MEASURES)
def test_finite_is_in_equilibrium_by_differences(measure):
    R, h = np.linspace(1.1, 2.9, 10), 1e-4
    state = finite(np.concatenate([R - h, R, R + h]), E, NU, 1.0, 3.0, 0.75, measure)
    r, stress = state.position.reshape(3, -1), state.stress.reshape(4, 3, -1)
    # parabola through three places that are nearly, not exactly, evenly spaced
    left, right = r[1] - r[0], r[2] - r[1]
    before, after = (stress[0, 1] - stress[0, 0]) / left, (stress[0, 2] - stress[0, 1]) / right
    gradient = (after * left + before * right) / (left + right)
    assert_allclose(gradient + (stress[0, 1] - stress[2, 1]) / r[1], 0, atol=1e-7 * np.abs(stress).max())


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("inner, outer, push", LARGE)
def test_finite_meets_both_ends_keeps_mass_and_order(inner, outer, push, measure):
    x, weight = np.polynomial.legendre.leggauss(60)
    R = (inner + outer) / 2 + (outer - inner) / 2 * x
    state = finite(np.concatenate([[inner], R, [outer]]), E, NU, inner, outer, push, measure)
    assert_allclose(state.position[[0, -1]], [inner + push, outer], rtol=1e-12)
    assert (np.diff(state.position) > 0).all()
    # The volume ratio J follows from the axial stress: lambda ln J, over J for "kirchhoff".
    axial = state.stress[1, 1:-1] / LAM
    J = np.exp(axial if measure == "cauchy" else -lambertw(-axial).real)
    volume = (outer - inner) / 2 * (weight * J * R).sum()
    assert volume == pytest.approx((outer**2 - (inner + push) ** 2) / 2, rel=1e-8)


@pytest.mark.parametrize("measure", MEASURES)
def test_finite_tends_to_lame_at_first_order(measure):
    R, push = np.linspace(1, 3, 11), 0.1 / 4.0 ** np.arange(6)
    history = finite_history(R, E, NU, 1.0, 3.0, push, measure)
    error = []
    for i, displacement in enumerate(push):
        _, stress = lame(R, E, NU, 1.0, 3.0, displacement)
        error.append(np.abs(history.stress[:, i] - stress).max() / np.abs(stress).max())
    order = np.log(np.array(error[:-1]) / error[1:]) / np.log(4)
    assert_allclose(order[2:], 1, atol=0.02)
    assert error[-1] < 1e-3


def test_measures_agree_at_small_and_differ_at_large_strain():
    R = np.linspace(1, 2, 5)
    for push, low, high in ((1e-6, 0, 1e-5), (0.5, 0.3, 1)):
        cauchy, kirchhoff = (deviatoric(finite(R, E, NU, 1.0, 2.0, push, m).stress) for m in MEASURES)
        assert low < np.abs(cauchy / kirchhoff - 1).max() < high


def test_wall_carries_21_9_mpa_with_cauchy_and_36_9_with_kirchhoff():
    q = [deviatoric(finite(np.array([1.0]), E, NU, 1.0, 2.0, 0.5, m).stress)[0] / 1e6 for m in MEASURES]
    assert_allclose(q, [21.9, 36.9], atol=0.05)


@pytest.mark.parametrize("measure", MEASURES)
def test_history_is_the_single_solutions_in_any_order(measure):
    R, push = np.linspace(1, 3, 5), np.array([0.3, 0.0, 0.75, 1e-9, 0.3])
    history = finite_history(R, E, NU, 1.0, 3.0, push, measure)
    assert history.stress.shape == (4, 5, 5) and history.pressure.shape == (5,)
    for i, displacement in enumerate(push):
        state = finite(R, E, NU, 1.0, 3.0, displacement, measure)
        assert_allclose(history.position[i], state.position, rtol=1e-12)
        assert_allclose(history.stress[:, i], state.stress, rtol=1e-10, atol=1e-11 * np.abs(state.stress).max())


@pytest.mark.parametrize("measure", MEASURES)
def test_nothing_happens_without_displacement(measure):
    state = finite(np.array([1.0, 2.0, 3.0]), E, NU, 1.0, 3.0, 0.0, measure)
    assert_allclose(state.position, [1, 2, 3], rtol=1e-15)
    assert (state.stress == 0).all() and state.pressure == 0


@pytest.mark.parametrize("measure", MEASURES)
def test_size_and_modulus_only_scale(measure):
    R = np.linspace(1, 3, 5)
    small, big = finite(R, E, NU, 1.0, 3.0, 0.75, measure), finite(1e3 * R, 1.0, NU, 1e3, 3e3, 750.0, measure)
    assert_allclose(big.position, 1e3 * small.position, rtol=1e-12)
    assert_allclose(big.stress * E, small.stress, rtol=1e-10)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("nu", [-0.9, 0.3, 0.4999])
@pytest.mark.parametrize("inner, outer, push", [
    (1.0, 3.0, 1.99), (1.0, 2.0, 0.99999), (1.0, 1.001, 5e-4), (1.0, 1e3, 50.0), (1.0, 1e3, 990.0), (1.0, 3.0, 1e-14)])
def test_finite_survives_extremes(inner, outer, push, nu, measure):
    R = np.linspace(inner, outer, 9)
    state = finite(R, E, nu, inner, outer, push, measure)
    assert_allclose(state.position[0], inner + push, rtol=1e-11)
    assert (np.diff(state.position) > 0).all() and np.isfinite(state.stress).all() and state.pressure > 0


# --- deviatoric stress


def test_deviatoric_is_von_mises_of_the_tensor_and_blind_to_pressure():
    stress = np.random.default_rng(1).normal(size=(4, 3, 20))
    x, y, z, shear = stress
    tensor = np.zeros((3, 20, 3, 3))
    tensor[..., 0, 0], tensor[..., 1, 1], tensor[..., 2, 2] = x, y, z
    tensor[..., 0, 1] = tensor[..., 1, 0] = shear
    deviator = tensor - (x + y + z)[..., None, None] / 3 * np.eye(3)
    assert_allclose(deviatoric(stress), np.sqrt(1.5 * (deviator**2).sum(axis=(2, 3))), rtol=1e-13)
    assert_allclose(deviatoric(stress + 7.0 * np.array([1, 1, 1, 0])[:, None, None]), deviatoric(stress), rtol=1e-12)


# --- refusals


GOOD = dict(E=E, nu=NU, inner=1.0, outer=3.0)
BAD = [dict(nu=0.5), dict(nu=-1.0), dict(nu=np.nan), dict(E=0.0), dict(E=-1.0), dict(E=np.inf), dict(inner=0.0),
       dict(inner=-1.0), dict(outer=1.0), dict(outer=0.5), dict(outer=np.inf)]


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_bad_cylinders_are_refused(bad):
    R, arguments = np.array([2.0]), GOOD | bad
    name = next(iter(bad))
    for call in (lambda: lame(R, **arguments, displacement=0.1), lambda: reaction_lame(**arguments, displacement=0.1),
                 lambda: incremental(R, **arguments, increment=0.1, steps=2),
                 lambda: finite(R, **arguments, displacement=0.1)):
        with pytest.raises(ValueError, match=f"^{name}: got .*, expected"):
            call()


@pytest.mark.parametrize("displacement", [2.0, 5.0, -1.0, np.nan, np.inf])
def test_impossible_displacements_are_refused(displacement):
    R = np.array([2.0])
    for call in (lambda: lame(R, **GOOD, displacement=displacement),
                 lambda: finite(R, **GOOD, displacement=displacement),
                 lambda: incremental(R, **GOOD, increment=displacement / 4, steps=4)):
        with pytest.raises(ValueError, match="got .*, expected"):
            call()


@pytest.mark.parametrize("R", [0.9, 3.1])
def test_points_outside_the_wall_are_refused(R):
    R = np.array([2.0, R])
    for call in (lambda: lame(R, **GOOD, displacement=0.1), lambda: finite(R, **GOOD, displacement=0.1),
                 lambda: incremental(R, **GOOD, increment=0.1, steps=2)):
        with pytest.raises(ValueError, match="at point 1, expected radii from inner = 1.0 to outer = 3.0"):
            call()


def test_other_bad_input_is_refused():
    R = np.array([2.0])
    with pytest.raises(ValueError, match="zero or more"):
        finite(R, **GOOD, displacement=-0.1)
    with pytest.raises(ValueError, match="at least one"):
        finite_history(R, **GOOD, displacements=np.zeros(0))
    with pytest.raises(ValueError, match="'cauchy', 'kirchhoff'"):
        finite(R, **GOOD, displacement=0.1, measure="biot")
    with pytest.raises(ValueError, match="steps: got 0"):
        incremental(R, **GOOD, increment=0.1, steps=0)
    with pytest.raises(TypeError, match="steps: got 2.5"):
        incremental(R, **GOOD, increment=0.1, steps=2.5)
    with pytest.raises(TypeError, match="R: got an array of int64"):
        incremental(np.array([2]), **GOOD, increment=0.1, steps=2)
    for stress in (np.zeros((3, 5)), np.zeros(()), np.full((4, 2), np.nan)):
        with pytest.raises(ValueError, match="stress: got"):
            deviatoric(stress)


def test_a_hopeless_solve_says_so(monkeypatch):
    monkeypatch.setattr(cylinder_reference._secant, "__defaults__", (1,))
    with pytest.raises(NotConvergedError, match="after 1 passes; take a smaller"):
        finite(np.array([2.0]), **GOOD, displacement=0.75)
