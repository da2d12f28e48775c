"""What the scripts under examples/verification find is what their closed forms say."""

import numpy as np
import pytest
from shared import SYMMETRIC
from test_examples import KINDS, ROOT, results, table

from skfem_mpm import METHODS


def rows_of(name, kind, file=None):
    """Rows of a table that a script has written."""
    out, _ = results(ROOT / "examples" / "verification" / f"{name}.py", kind)
    return table(out / f"{file or name}.csv")[1]


def errors(rows, what, **choice):
    """Column ``what`` of the rows that fit."""
    return np.array([float(row[what]) for row in rows if all(row[name] == value for name, value in choice.items())])


# A column under its own weight (V3, V3b)

@pytest.mark.parametrize("kind", KINDS)
def test_gimp_brings_the_column_to_rest_where_it_should(kind):
    rows = rows_of("column", kind, "errors")
    position = errors(rows, "position", solver="implicit", method="gimp")
    assert (position[:3] < [2e-3, 5e-4, 2e-4]).all()
    assert errors(rows, "stress", solver="implicit", method="gimp")[2] < 4e-3


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_cross_cells_keep_linear_functions_from_converging(kind):
    rows = rows_of("column", kind, "errors")
    for method in ("mpm", "cmpm"):
        stress = errors(rows, "stress", solver="implicit", method=method)
        assert stress[-1] > 0.04 and stress[-1] > 0.9 * stress[1]


@pytest.mark.parametrize("kind", KINDS)
def test_with_domains_that_stretch_gimp_converges_in_first_order_or_better(kind):
    for method in ("gimp", "gc"):
        stress = errors(rows_of("column", kind, "errors"), "stress", solver="stretched", method=method)
        assert np.log2(stress[0] / stress[-1]) > len(stress) - 1 - 0.4
        if kind == "full":
            fixed = errors(rows_of("column", kind, "errors"), "stress", solver="implicit", method=method)
            assert stress[-1] < 2e-4 < 1e-3 < fixed[-1] < 2e-3                # which stays at 0.17 %


@pytest.mark.parametrize("kind", KINDS)
def test_damped_time_steps_come_to_the_same_rest_as_load_steps(kind):
    rows = rows_of("column", kind, "errors")
    for what, gap in [("position", 3e-4), ("stress", 1e-3)]:
        explicit = errors(rows, what, solver="explicit", method="gimp")
        implicit = errors(rows, what, solver="implicit", method="gimp")[:len(explicit)]
        np.testing.assert_allclose(explicit, implicit, atol=gap)


@pytest.mark.parametrize("kind", KINDS)
def test_sudden_gravity_swings_to_twice_the_settlement_in_the_period_of_the_column(kind):
    rows = rows_of("column", kind, "swing")
    assert [row["method"] for row in rows] == (["mpm", "gimp", "cmpm", "gc"] if kind == "quick" else list(METHODS))
    for row in rows:
        assert float(row["peak"]) == pytest.approx(2, rel=0.01)
        assert float(row["period"]) == pytest.approx(1, rel=0.005)
        assert float(row["error"]) < (0.02 if kind == "quick" else 0.005)


# A vibrating bar (V4)

@pytest.mark.parametrize("kind", KINDS)
def test_the_bar_keeps_its_first_mode_whenever_stress_is_updated(kind):
    rows = rows_of("bar", kind)
    found = errors(rows, "error", mode="1", method="mpm")
    assert len(found) == 3 and (found < 0.025).all()
    assert (errors(rows, "error", mode="1") < 0.03).all()


@pytest.mark.parametrize("kind", KINDS)
def test_its_tenth_mode_has_the_frequency_of_the_grid(kind):
    rows = rows_of("bar", kind)
    found = errors(rows, "frequency", mode="10", cells="16", method="mpm")
    np.testing.assert_allclose(found, errors(rows, "frequency_of_mpm", mode="10", cells="16", method="mpm"), rtol=0.01)
    assert (errors(rows, "error", mode="10", cells="16") > 0.5).all()
    if kind == "full":
        assert (errors(rows, "error", mode="10", cells="480") < 0.025).all()


# Two discs (V8)

@pytest.mark.parametrize("kind", KINDS)
def test_discs_keep_momentum_and_gain_no_energy(kind):
    rows = rows_of("discs", kind)
    assert [row["method"] for row in rows] == SYMMETRIC
    assert errors(rows, "kinetic_at_start") == pytest.approx(2.513, rel=0.02)
    assert (errors(rows, "largest_total") < 1.01).all() and (errors(rows, "smallest_total") > 0.97).all()
    assert (errors(rows, "momentum") < 1e-13).all()


@pytest.mark.parametrize("kind", KINDS)
def test_discs_meet_up_to_a_few_cells_early_and_return_most_of_their_energy(kind):
    rows = rows_of("discs", kind)
    touch, h = errors(rows, "touch"), {"quick": 0.05, "full": 0.025}[kind]
    assert (touch < 1.586 + 0.02).all() and (touch > 1.586 - 2 * np.sqrt(2) * h / 0.283).all()     # two cells across
    assert (errors(rows, "kinetic_at_end") > 0.8).all()
    assert ((0.85 < errors(rows, "restitution")) & (errors(rows, "restitution") < 1)).all()


# A cut in perfectly plastic soil (V14)

def test_locking_delays_failure_and_bbar_cures_it():
    rows = rows_of("cut_limit", "quick")
    cured, locked = (errors(rows, "error", remedy=remedy)[0] for remedy in ("bbar", "none"))
    assert 0 < cured < 0.13 and locked > cured + 0.08


@pytest.mark.slow
def test_the_cut_fails_at_the_weight_of_limit_analysis():
    """3.776, within 5 %, on the finest grid and where the size of cells is taken to zero."""
    rows = rows_of("cut_limit", "full")
    cured = errors(rows, "error", method="gimp", remedy="bbar")
    assert (np.diff(cured) < 0).all() and 0 < cured[-1] < 0.05
    assert abs(2 * cured[-1] - cured[-2]) < 0.05
    assert errors(rows, "error", method="gimp", remedy="none")[0] > 0.2


# A cantilever that falls and swings back (V10)

@pytest.mark.parametrize("kind", KINDS)
def test_the_tip_of_the_cantilever_falls_as_far_as_it_should(kind):
    """To the lowest point, before anything can tear, every choice is right within 4 % of what the sources print."""
    rows = rows_of("cantilever", kind)
    assert all(row["status"] == "finished" for row in rows)
    for moment, printed in [("0.66", -2.34), ("1.045", -3.28)]:
        assert (abs(errors(rows, f"tip_{moment}") - printed) < 0.04 * 3.28).all()
    if kind == "quick":
        assert (errors(rows, "error_fe") < 0.02).all() and (errors(rows, "gap") < 2.5).all()


@pytest.mark.slow
def test_one_choice_follows_the_cantilever_back_and_explicit_steps_do_not():
    """Field integration with a ghost penalty stays within 5 % of the finite element solution of the same law."""
    rows = rows_of("cantilever", "full")
    error = {row["choice"]: float(row["error_fe"]) for row in rows}
    assert error["field2, ghost, half the step"] < 0.05
    assert min(error["gimp, explicit"], error["dual"]) > 0.3
