"""Fits reproduce what their points determine, leave out what they do not, and never jump."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from test_cover import AXES, MAKE, MOTION, MOTIONS, cover_of, even, every_motion, grid_of, points_of, powers, scattered

from skfem_mpm import Particles
from skfem_mpm.grid import Grid
from skfem_mpm.integration.field import keep_positive
from skfem_mpm.integration.fit import FLAT, Fit, filtered_inverse, monomial_degrees, monomials

every_order = pytest.mark.parametrize("order", [1, 2])


def jittered(kinematics, dim, seed=0, amount=0.1, per_cell=2):
    """A body that fills the inner cells of a graded grid, points moved by a share of their distance."""
    mesh = MAKE[dim](*AXES[:dim])
    body = Particles.fill(mesh, kinematics, per_cell=per_cell, where=lambda x: np.all(
        [(row > axis[1]) & (row < axis[-2]) for row, axis in zip(x, AXES)], axis=0))
    random = np.random.default_rng(seed)
    x = body.x + amount * body.length * random.uniform(-1, 1, body.x.shape)
    spans = np.einsum("ij,jn->ijn", np.eye(dim), body.length)
    return Grid.from_mesh(mesh), Particles(x, body.volume, body.mass, kinematics, spans=spans)


def table_of(fit):
    """How the coefficients in a unit follow from what points carry, ``(units, nb, n)``."""
    units, nb = fit.Q.shape[:2]
    table = np.zeros((units, nb, fit.cover.particles.n))
    for _, points, unit, weighted in fit.pairs():
        table[unit, :, points] += np.einsum("nbc,cn->nb", fit.Q[unit], weighted)
    return table


def at_places(fit, values, per_unit=5, seed=0):
    """The fitted field at some places of each unit: places, units and values."""
    random = np.random.default_rng(seed)
    unit = np.repeat(np.arange(len(fit.Q)), per_unit)
    xi = random.uniform(-0.5, 0.5, (fit.cover.grid.dim, len(unit)))
    coefficients = table_of(fit) @ values
    return fit.middle[:, unit] + xi * fit.width[:, unit], unit, (coefficients[unit] * monomials(xi, fit.order).T).sum(1)


@every_motion
@every_order
def test_polynomials_that_points_determine_are_reproduced(kinematics, dim, order):
    grid, points = jittered(kinematics, dim)
    fit = Fit(cover_of(grid, points), order, 1.5)
    assert (fit.weight > 0).all()
    for power in powers(dim, order):
        def field(x, power=power):
            return np.prod([(row - 2) ** a for row, a in zip(x, power)], axis=0)

        x, unit, found = at_places(fit, field(points.x))
        sure = np.isin(fit.cover.keys, fit.cover.key)[unit] | (order == 1)      # units that hold points
        assert_allclose(found[sure], field(x)[sure], atol=1e-10)


@every_motion
@every_order
@pytest.mark.parametrize("reach", [1, 2])
@pytest.mark.parametrize("kappa", [0.5, 4.0])
def test_constants_are_reproduced_wherever_there_are_points(kinematics, dim, order, reach, kappa):
    for seed in range(3):
        points = scattered(kinematics, dim, seed=seed, size=0.45)
        fit = Fit(cover_of(grid_of(*AXES[:dim]), points), order, kappa, reach)
        _, unit, found = at_places(fit, np.ones(points.n))
        assert_allclose(found[fit.weight[unit] > 0], 1.0, rtol=1e-9)
        assert_array_equal(found[fit.weight[unit] == 0], 0.0)


@every_order
@pytest.mark.parametrize("axis", [0, 1])
def test_a_row_of_single_points_makes_a_field_along_it_that_is_constant_across(order, axis):
    x = np.full((2, 6), 4.5)
    x[axis] = np.arange(6) + 1.4
    x[1 - axis] = 4.3
    points = points_of(x, np.repeat(np.eye(2)[:, :, None], 6, axis=2), MOTION[2])
    fit = Fit(cover_of(even(2), points), order, 1.5)
    place, unit, found = at_places(fit, 3 + x[axis])
    middle = np.isin(np.floor(place[axis]), [2, 3, 4, 5])                # units that have points on both sides
    assert_allclose(found[middle], 3 + place[axis, middle], atol=1e-9)
    assert np.isfinite(found).all()


@every_motion
@every_order
@pytest.mark.parametrize("reach", [1, 2])
def test_a_lonely_point_makes_a_constant_field(kinematics, dim, order, reach):
    """Wherever it is: also right on nodes and faces, next to cells far smaller than its own."""
    axis = np.array([0, 0.05, 1.0, 2.0, 2.001, 3.0, 3.2])
    for place in (1.5, 1.0, 2.0, 1.9999, 2.0005, 1.65):
        x = np.full((dim, 1), place)
        points = points_of(x, 0.8 * np.eye(dim)[:, :, None], kinematics)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fit = Fit(cover_of(grid_of(*[axis] * dim), points), order, 4.0, reach)
        assert np.isfinite(fit.Q).all()
        _, unit, found = at_places(fit, np.ones(1))
        assert_allclose(found[fit.weight[unit] > 0], 1.0, rtol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 10 ** 6), st.sampled_from(MOTIONS), st.sampled_from([1, 2]), st.floats(0.3, 8))
def test_any_layout_has_a_symmetric_positive_fit_that_keeps_constants(seed, motion, order, kappa):
    points = scattered(*motion, n=5, seed=seed, size=0.45)
    fit = Fit(cover_of(grid_of(*AXES[:motion[1]]), points), order, kappa)
    assert np.isfinite(fit.Q).all()
    assert_allclose(fit.Q, fit.Q.transpose(0, 2, 1), atol=1e-10 * np.abs(fit.Q).max())
    value = np.linalg.eigvalsh(fit.Q)
    assert (value[:, 0] >= -1e-9 * value[:, -1]).all()
    _, unit, found = at_places(fit, np.ones(points.n))
    assert_allclose(found[fit.weight[unit] > 0], 1.0, rtol=1e-8)


@every_motion
@every_order
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_blending_keeps_constants_symmetry_and_what_is_positive(kinematics, dim, order, share):
    points = scattered(kinematics, dim, size=0.45)
    fit = Fit(cover_of(grid_of(*AXES[:dim]), points), order, 1.5)
    before = fit.Q.copy()
    shares = share * np.random.default_rng(1).uniform(0.5, 1, len(fit.Q)) if share < 1 else np.ones(len(fit.Q))
    fit.blend(shares)
    if share == 0:
        assert_array_equal(fit.Q, before)
    _, unit, found = at_places(fit, np.ones(points.n))
    assert_allclose(found[fit.weight[unit] > 0], 1.0, rtol=1e-9)
    if share == 1:
        assert_allclose(fit.Q[:, 1:], 0, atol=1e-12 * np.abs(before).max())
    assert_allclose(fit.Q, fit.Q.transpose(0, 2, 1), atol=1e-9 * np.abs(fit.Q).max())
    assert np.linalg.eigvalsh(fit.Q).min() > -1e-9 * np.abs(fit.Q).max()


@pytest.mark.parametrize("dim", [1, 2, 3])
@every_order
def test_the_filtered_inverse_is_the_inverse_where_points_tell_all(dim, order):
    random = np.random.default_rng(dim)
    phi = monomials(random.uniform(-1, 1, (dim, 60)), order)
    gram = np.stack([(phi * w) @ phi.T for w in random.uniform(0.5, 1, (4, 60))])
    assert_allclose(filtered_inverse(gram, monomial_degrees(dim, order)) @ gram,
                    np.repeat(np.eye(len(phi))[None], 4, axis=0), atol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3])
@every_order
def test_the_filtered_inverse_does_not_jump_as_points_fall_into_a_line_or_a_place(dim, order):
    """A layout is squeezed to a place; eigenvalues pass their thresholds, one after the other."""
    random = np.random.default_rng(7)
    x = random.uniform(-1, 1, (dim, 12))

    def inverse(flat):
        phi = monomials(x * np.geomspace(flat, flat ** 0.3, dim)[:, None], order)
        return filtered_inverse((phi @ phi.T)[None], monomial_degrees(dim, order))[0]

    def jump(steps):
        path = np.stack([inverse(flat) for flat in np.geomspace(1, 1e-3, steps)])
        return np.abs(np.diff(path, axis=0)).max() / np.abs(path).max()

    coarse, fine = jump(400), jump(1600)
    assert fine < 0.4 * coarse and coarse < 0.1


def test_at_its_threshold_the_filter_is_continuous_and_largest():
    """1 / lambda above, lambda / threshold^2 below: no slope is stiffer than one over the threshold."""
    flat = FLAT[1]

    def factor(value):
        return filtered_inverse(np.diag([1.0, value])[None], np.array([0, 1]))[0, 1, 1]

    assert abs(factor(flat * (1 - 1e-9)) - factor(flat * (1 + 1e-9))) < 1e-5
    assert max(factor(value) for value in flat * np.geomspace(1e-3, 1e3, 101)) <= (1 + 1e-12) / flat
    assert factor(0.0) == 0.0 and factor(-1e-17) == 0.0


@pytest.mark.parametrize("weight", [1.0, 1e-12, 1e12, 1e-150])
def test_the_filter_does_not_see_how_heavy_all_points_are(weight):
    phi = monomials(np.array([[0.1, 0.3, -0.4, 0.2], [0.0, 0.05, 0.01, -0.02]]), 1)
    degrees = monomial_degrees(2, 1)
    one = filtered_inverse((phi @ phi.T)[None], degrees)
    assert_allclose(weight * filtered_inverse((weight * phi @ phi.T)[None], degrees), one, rtol=1e-9, atol=1e-9)


def test_a_unit_without_points_has_no_field():
    degrees = monomial_degrees(2, 2)
    assert_array_equal(filtered_inverse(np.zeros((1, 6, 6)), degrees), 0.0)


@pytest.mark.parametrize("dim", [1, 2])
@every_order
def test_the_fit_depends_continuously_on_points_within_their_cells(dim, order):
    """Two rows of points that fall into one: no coefficient jumps."""
    def table(t):
        x = np.stack(np.meshgrid(*[np.arange(2.25, 5, 0.5)] * dim, indexing="ij")).reshape(dim, -1)
        middle = np.floor(x) + 0.5 + 0.003
        x = middle + t * (x - middle)
        points = points_of(x, np.repeat(0.5 * np.eye(dim)[:, :, None], x.shape[1], axis=2), MOTION[dim])
        fit = Fit(cover_of(even(dim), points), order, 1.5)
        return fit.Q * fit.weight[:, None, None]

    path = np.stack([table(t) for t in np.linspace(1, 0, 161)])
    step = np.abs(np.diff(path, axis=0)).max(axis=(1, 2, 3))
    worst = int(step.argmax())
    fine = np.stack([table(t) for t in np.linspace(*np.linspace(1, 0, 161)[worst:worst + 2], 9)])
    assert np.abs(np.diff(fine, axis=0)).max() < 0.4 * step.max()


@every_order
def test_points_of_one_body_have_no_say_in_the_fit_of_another(order):
    rng = np.random.default_rng(0)
    x = 3 + rng.uniform(0, 2, (2, 24))
    spans = np.repeat(0.4 * np.eye(2)[:, :, None], 24, axis=2)
    body = np.repeat([0.0, 1.0], 12)
    fit = Fit(cover_of(even(2), points_of(x, spans, MOTION[2], fields={"body": body})), order, 1.5)
    table, part = table_of(fit), fit.cover.keys % fit.cover.nparts
    for number in (0, 1):
        parts = np.unique(fit.cover.part[body == number])
        other = np.isin(part, parts)
        assert (table[other][:, :, body != number] == 0).all() and (table[other][:, :, body == number] != 0).any()


@pytest.mark.parametrize("dim", [2, 3])
@every_order
def test_swapped_axes_make_swapped_fits(dim, order):
    points = scattered(MOTION[dim], dim, n=12, seed=4, size=0.4)
    turned = list(range(dim))[::-1]
    swapped = points_of(points.x[turned], points.spans[turned][:, turned], points.kinematics, 1.7)
    values = np.random.default_rng(0).normal(size=12)
    fits = [Fit(cover_of(grid_of(*[AXES[k] for k in order_]), each), order, 1.5)
            for order_, each in ((range(dim), points), (turned, swapped))]
    amounts = []
    for fit, back in zip(fits, (list(range(dim)), turned)):
        unit = np.arange(len(fit.Q))
        coefficients = (table_of(fit) @ values)[unit]
        place = fit.middle[back]
        sort = np.lexsort([*place.round(9), coefficients[:, 0].round(9)])
        amounts.append((place[:, sort], coefficients[sort, 0], coefficients[sort][:, 1:dim + 1][:, back]))
    for one, two in zip(*amounts):
        assert_allclose(two, one, atol=1e-9)


def test_a_nice_layout_needs_no_limiter():
    for motion, order, kappa in [(m, *choice) for m in MOTIONS for choice in ((1, 4.0), (2, 1.5))]:
        mesh = MAKE[motion[1]](*[1 + np.arange(9.0)] * motion[1])
        body = Particles.fill(mesh, motion[0], where=lambda x: ((x > 3) & (x < 7)).all(axis=0))
        fit = Fit(cover_of(Grid.from_mesh(mesh), body), order, kappa)
        before = fit.Q.copy()
        keep_positive(fit)
        assert_array_equal(fit.Q, before)
