"""The three 1-D functions are those of the papers, on any grid, and lose nothing that theory says they keep."""

import numpy as np
import printed
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skfem_mpm import shapes

UNIT = np.array([[-1.0], [0.0], [1.0], [2.0]])          # knots of cells of width one
X = np.sort(np.concatenate([np.linspace(0, 1, 81), np.random.default_rng(0).random(40)]))    # holds 1/4, 1/2, 3/4
XI = 2 * X - 1                                            # the same places as Eqs. (7) and (8) count them
HALVES = [0.01, 0.1, 0.25, 1 / 3, 0.5]
SIDES = {"both": (True, True), "no left": (False, True), "no right": (True, False), "alone": (False, False)}
PRINTED = {"both": (printed.eq8, slice(0, 4)), "no left": (printed.eq7, slice(1, 4)),
           "no right": (printed.eq7_mirrored, slice(0, 3))}


def knots_for(x, scale=1.0, origin=0.0):
    return origin + scale * np.broadcast_to(UNIT, (4, len(x)))


def graded(n=400, seed=1):
    """Random grids of unequal cells, each with one point in its host cell and a domain within the neighbours."""
    rng = np.random.default_rng(seed)
    width = rng.uniform(0.5, 1.5, (3, n))
    knots = np.cumsum(np.concatenate([rng.uniform(-5, 5, (1, n)), width]), axis=0)
    x = knots[1] + rng.random(n) * width[1]
    return x, rng.uniform(0.02, 1, n) * width.min(axis=0), knots


def functions(name, x, half, knots):
    return {"linear": lambda: shapes.linear(x, knots), "gimp": lambda: shapes.gimp(x, half, knots),
            "cmpm": lambda: shapes.cmpm(x, knots)}[name]()


def seen(name, knots):
    """The knots whose functions are given: FE has those of the host only."""
    return knots[1:3] if name == "linear" else knots


def hats(y, knots):
    """The linear functions of all four knots at ``y``, which lies between them."""
    return np.array([np.interp(y, knots, row) for row in np.eye(4)])


# What the papers print.

def test_gimp_of_a_quarter_cell_is_eq6():
    value, _ = shapes.gimp(X, np.full(len(X), 0.25), knots_for(X))
    assert_allclose(value, printed.eq6(X - UNIT), rtol=0, atol=1e-15)


def test_eq6_as_printed_is_wrong_left_of_the_node():
    value, _ = shapes.gimp(np.zeros(1), np.full(1, 0.25), knots_for(np.zeros(1)))
    point_left_of_the_node = -1.0
    assert printed.eq6_as_printed(np.array(point_left_of_the_node)) == 81 / 16        # a weight of five
    assert printed.eq6(np.array(point_left_of_the_node)) == value[2, 0] == 1 / 16


@pytest.mark.parametrize("l", HALVES)
@pytest.mark.parametrize("scale, origin", [(1.0, 0.0), (0.1, 1.0), (1e-6, 0.0), (2000.0, -3e4)])
def test_gimp_of_any_domain_is_the_closed_form(l, scale, origin):
    x, half = origin + scale * X, np.full(len(X), l * scale)
    value, slope = shapes.gimp(x, half, knots_for(X, scale, origin))
    rounding = 1e-14 + 4 * np.spacing(abs(origin)) / scale / l
    assert_allclose(value, printed.gimp(X - UNIT, l), rtol=0, atol=rounding)
    assert_allclose(slope * scale, printed.gimp_slope(X - UNIT, l), rtol=0, atol=rounding / l)


@pytest.mark.parametrize("sides", PRINTED)
@pytest.mark.parametrize("scale, origin", [(1.0, 0.0), (0.1, 1.0), (1e-6, 0.0), (2000.0, -3e4)])
def test_cmpm_is_eq8_with_both_neighbours_and_eq7_with_one(sides, scale, origin):
    equation, there = PRINTED[sides]
    value, slope = shapes.cmpm(origin + scale * X, knots_for(X, scale, origin), *SIDES[sides])
    rounding = 1e-15 + 4 * np.spacing(abs(origin)) / scale
    assert_allclose(value[there], equation(XI), rtol=0, atol=2 * rounding)
    assert_allclose(slope[there] * scale, 2 * printed.slope(equation, XI), rtol=0, atol=20 * rounding)


def test_cmpm_without_neighbours_is_fe():
    x, _, knots = graded()
    for ours, fe in zip(shapes.cmpm(x, knots, False, False), shapes.linear(x, knots)):
        assert_allclose(ours[1:3], fe, rtol=1e-14, atol=1e-15)
        assert not ours[[0, 3]].any()


# What theory says they keep.

@pytest.mark.parametrize("name", ["linear", "gimp", "cmpm"])
def test_functions_sum_to_one_and_slopes_to_zero_on_graded_grids(name):
    x, half, knots = graded()
    value, slope = functions(name, x, half, knots)
    assert_allclose(value.sum(axis=0), 1, rtol=1e-14)
    assert_allclose(slope.sum(axis=0), 0, atol=1e-14 * np.abs(slope).max())


@pytest.mark.parametrize("name", ["linear", "gimp", "cmpm"])
def test_linear_fields_are_reproduced_on_graded_grids(name):
    x, half, knots = graded()
    value, slope = functions(name, x, half, knots)
    assert_allclose((value * seen(name, knots)).sum(axis=0), x, rtol=0, atol=1e-13)
    assert_allclose((slope * seen(name, knots)).sum(axis=0), 1, rtol=1e-13)


@pytest.mark.parametrize("name", ["linear", "gimp", "cmpm"])
def test_slope_is_the_finite_difference_of_value(name):
    x, half, knots = graded()
    step = 1e-5 * half                                  # GIMP bends at most by 1/(half * width) in a step
    x = np.clip(x, knots[1] + step, knots[2] - step)
    _, slope = functions(name, x, half, knots)
    ahead, behind = (functions(name, x + sign * step, half, knots)[0] for sign in (1, -1))
    assert_allclose((ahead - behind) / (2 * step), slope, rtol=0, atol=1e-4)


def test_gimp_is_the_mean_of_the_linear_functions_over_the_domain():
    x, half, knots = graded(60)
    value, slope = shapes.gimp(x, half, knots)
    for p in range(len(x)):
        low, high = x[p] - half[p], x[p] + half[p]
        y = np.unique(np.clip(knots[:, p], low, high).tolist() + [low, high])          # straight in between
        mean = np.sum([(hats(a, knots[:, p]) + hats(b, knots[:, p])) / 2 * (b - a) for a, b in zip(y, y[1:])], axis=0)
        assert_allclose(value[:, p], mean / (2 * half[p]), rtol=0, atol=1e-14)
        rise = hats(high, knots[:, p]) - hats(low, knots[:, p])
        assert_allclose(slope[:, p], rise / (2 * half[p]), rtol=0, atol=1e-13 / half[p])


@pytest.mark.parametrize("sides", SIDES)
def test_gimp_cut_at_missing_neighbours_is_the_mean_over_what_is_left(sides):
    x, half, knots = graded()
    left, right = SIDES[sides]
    low = np.maximum(x - half, knots[0 if left else 1])
    high = np.minimum(x + half, knots[3 if right else 2])
    value, slope = shapes.gimp(x, half, knots, left, right)
    assert_allclose(value.sum(axis=0), 1, rtol=1e-14)
    assert_allclose((value * knots).sum(axis=0), (low + high) / 2, rtol=0, atol=1e-13)     # the field at its middle
    assert_allclose((slope * knots).sum(axis=0), 1, rtol=1e-13)
    assert left or not value[0].any()
    assert right or not value[3].any()


@pytest.mark.parametrize("sides, degree", [("both", 3), ("no left", 2), ("no right", 2), ("alone", 1)])
def test_cmpm_reproduces_polynomials_in_physical_coordinates_on_graded_grids(sides, degree):
    x, _, knots = graded()
    x, knots = x - knots[1], knots - knots[1]
    value, slope = shapes.cmpm(x, knots, *SIDES[sides])
    for p in range(degree + 1):
        assert_allclose((value * knots**p).sum(axis=0), x**p, rtol=0, atol=1e-13)
        assert_allclose((slope * knots**p).sum(axis=0), p * x ** max(p - 1, 0), rtol=0, atol=1e-13)
    wrong = (value * knots ** (degree + 1)).sum(axis=0) - x ** (degree + 1)
    assert np.abs(wrong).max() > 0.01, "one degree more is beyond it"


def test_printed_local_forms_would_lose_even_linear_fields_on_graded_grids():
    x, _, knots = graded()
    width = knots[2] - knots[1]
    slope = 2 / width * printed.slope(printed.eq8, 2 * (x - knots[1]) / width - 1)
    assert np.abs((slope * knots).sum(axis=0) - 1).max() > 0.1
    assert_allclose((shapes.cmpm(x, knots)[1] * knots).sum(axis=0), 1, rtol=1e-13)


@pytest.mark.parametrize("sides", SIDES)
def test_cmpm_functions_are_one_at_their_node_and_zero_at_the_others(sides):
    _, _, knots = graded()
    for node in (1, 2):
        value, _ = shapes.cmpm(knots[node], knots, *SIDES[sides])
        assert_allclose(value, np.repeat(np.eye(4)[:, node:node + 1], knots.shape[1], axis=1), rtol=0, atol=1e-14)


def test_knots_of_missing_neighbours_do_not_matter():
    x, half, knots = graded()
    moved = knots.copy()
    moved[0] -= 7
    moved[3] += 1e6
    assert_array_equal(shapes.cmpm(x, moved, False, False), shapes.cmpm(x, knots, False, False))
    assert_array_equal(shapes.gimp(x, half, moved, False, False), shapes.gimp(x, half, knots, False, False))


def test_sides_may_differ_from_point_to_point():
    x, half, knots = graded(4)
    left, right = np.array([True, True, False, False]), np.array([True, False, True, False])
    mixed = shapes.cmpm(x, knots, left, right), shapes.gimp(x, half, knots, left, right)
    for p in range(4):
        one = slice(p, p + 1)
        assert_array_equal(mixed[0][0][:, one], shapes.cmpm(x[one], knots[:, one], left[p], right[p])[0])
        assert_array_equal(mixed[1][0][:, one], shapes.gimp(x[one], half[one], knots[:, one], left[p], right[p])[0])


# Known properties that decide what each is good for.

def test_gimp_is_fe_at_quarter_points_so_methods_agree_in_the_first_step():
    x = np.array([0.25, 0.75])
    for gimp, fe in zip(shapes.gimp(x, np.full(2, 0.25), knots_for(x)), shapes.linear(x, knots_for(x))):
        assert_array_equal(gimp[1:3], fe)
        assert not gimp[[0, 3]].any()


def test_gimp_differs_from_fe_at_gauss_points():
    x = 0.5 + np.array([-1, 1]) / np.sqrt(12)
    gimp, fe = shapes.gimp(x, np.full(2, 0.25), knots_for(x))[0], shapes.linear(x, knots_for(x))[0]
    assert np.abs(gimp[1:3] - fe).max() > 1e-3


@pytest.mark.parametrize("sides, lowest", [("both", -1 / 16), ("no left", -1 / 8), ("no right", -1 / 8)])
def test_cmpm_takes_negative_values_which_mass_must_not(sides, lowest):
    value, _ = shapes.cmpm(X, knots_for(X), *SIDES[sides])
    assert_allclose(value.min(), lowest, atol=5e-3)
    assert value.min() >= lowest - 5e-3


@pytest.mark.parametrize("name", ["linear", "gimp"])
def test_functions_that_carry_mass_are_never_negative(name):
    x, half, knots = graded()
    assert functions(name, x, half, knots)[0].min() >= 0


def crossing(name, seed=3):
    """Value and slope of random nodal values on either side of the faces of a uniform grid with cells of width one."""
    u = np.random.default_rng(seed).random((5, 50))     # at -1, 0, 1, 2, 3; the face is at 1
    face, half = np.ones(50), np.full(50, 0.3)
    left, right = (functions(name, face, half, knots_for(face, origin=cell)) for cell in (0, 1))
    nodes = (slice(1, 3), slice(2, 4)) if name == "linear" else (slice(0, 4), slice(1, 5))
    return [u, *([(table * u[n]).sum(axis=0) for table in tables] for tables, n in zip((left, right), nodes))]


@pytest.mark.parametrize("name", ["linear", "gimp", "cmpm"])
def test_fields_are_continuous_when_a_point_crosses_a_face(name):
    _, left, right = crossing(name)
    assert_allclose(left[0], right[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize("name, difference, factor", [("linear", [0, 1, -2, 1, 0], 1), ("gimp", [0, 0, 0, 0, 0], 0),
                                                      ("cmpm", [1, -4, 6, -4, 1], -1 / 6)])
def test_gradients_jump_at_a_face_as_theory_says(name, difference, factor):
    u, left, right = crossing(name)
    assert_allclose(right[1] - left[1], factor * np.array(difference) @ u, rtol=0, atol=1e-13)


def test_gradient_of_cmpm_jumps_by_the_third_difference_next_to_the_edge():
    u = np.random.default_rng(4).random((4, 50))        # at 0, 1, 2, 3; the grid begins at 0, the face is at 1
    face = np.ones(50)
    edge = (shapes.cmpm(face, knots_for(face), False, True)[1][1:] * u[:3]).sum(axis=0)
    inner = (shapes.cmpm(face, knots_for(face, origin=1.0))[1] * u).sum(axis=0)
    assert_allclose(inner - edge, -np.array([-1, 3, -3, 1]) @ u / 6, rtol=0, atol=1e-13)
