"""Richardson extrapolation, the stored reference of the vertical cut, and what a run measured against it says."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from skfem_mpm import LinearElastic, VonMises
from skfem_mpm.scenes import vertical_cut
from skfem_mpm.scenes.richardson import richardson
from skfem_mpm.scenes.vertical_cut_reference import FILE, QUANTITIES, CutHistory, Moment, cut_reference, stored

ROOT = Path(__file__).parents[1]
LOADINGS = ("sudden", "ramped")
AGAINST = {"toe", "run_out", "failure_time", "dissipation"}
needs_numba = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="the reference is numba's")


# Richardson

@pytest.mark.parametrize("sizes", [[0.4, 0.2, 0.1], [0.1, 0.05, 0.025, 0.0125], [1.0, 0.7, 0.3], [8.0, 5.0, 4.0, 1.0]])
@pytest.mark.parametrize("order", [0.31, 0.5, 1.0, 2.0, 2.99])
@pytest.mark.parametrize("slope", [-3.0, 1e-4])
def test_a_power_of_the_cell_size_is_recovered(sizes, order, slope):
    values = 7.0 + slope * np.array(sizes) ** order
    found = richardson(values, sizes)
    assert found.value == pytest.approx(7.0, abs=1e-8 * abs(slope) + 1e-12)
    assert found.order == pytest.approx(order, abs=1e-6)
    assert found.error >= abs(values[-1] - 7.0) * (1 - 1e-6)


def test_a_higher_power_beside_it_stays_within_the_error():
    sizes = 0.2 / 2.0 ** np.arange(4)
    for second in (-4.0, -1.0, 1.0, 4.0):
        found = richardson(3.0 + sizes + second * sizes ** 2, sizes)
        assert abs(found.value - 3.0) < found.error < 0.2


def test_unit_and_origin_do_not_matter():
    values, sizes = np.array([3.4, 3.2, 3.13, 3.1]), np.array([0.4, 0.2, 0.1, 0.05])
    plain, moved = richardson(values, sizes), richardson(-8 * values + 1.0, 4 * sizes)
    assert_allclose([moved.value, moved.error, moved.order],
                    [-8 * plain.value + 1.0, 8 * plain.error, plain.order], rtol=1e-9)


@pytest.mark.parametrize("values", [[1.0, 1.2, 1.1], [1.0, 1.1, 1.3], [1.0, 1.1, 1.19], [1.0, 1.3, 1.301],
                                    [1.0, 1.0, 1.1], [1.0, 1.1, 1.1], [1.0, 1.0, 1.0]], ids=str)
def test_values_that_show_no_order_are_not_extrapolated(values):
    """Swinging, growing, too slow, too fast, still: the finest grid, and the spread as its error."""
    found = richardson(values, [0.4, 0.2, 0.1])
    assert found.value == values[-1] and np.isnan(found.order)
    assert found.error == max(values) - min(values)


def test_a_lucky_order_does_not_hide_the_last_change():
    found = richardson([1.0, 1.35, 1.40], [0.4, 0.2, 0.1])
    assert found.order > 2.5 and found.error == pytest.approx(0.05)


def test_a_limit_that_moves_is_not_trusted_further_than_it_moves():
    sizes = [0.8, 0.4, 0.2, 0.1]
    before, found = richardson([0.0, 0.5, 0.6], sizes[:3]), richardson([0.0, 0.5, 0.6, 0.68], sizes)
    assert found.error >= abs(found.value - before.value) > abs(found.value - 0.68) > 0


def test_a_history_has_one_order():
    sizes, time = np.array([0.4, 0.2, 0.1]), np.linspace(0, 1, 9)
    limit, shape = time ** 2, np.sin(9 * time)                              # changes sign over time
    found = richardson(limit + shape * sizes[:, None] ** 1.5, sizes)
    assert found.order == pytest.approx(1.5)
    assert_allclose(found.value, limit, atol=1e-12)
    assert found.error.shape == time.shape and (found.error >= abs(shape) * 0.1 ** 1.5 * (1 - 1e-9)).all()
    swinging = richardson(limit + shape * np.array([[1.0], [-0.5], [0.25]]), sizes)
    assert np.isnan(swinging.order)
    assert_allclose(swinging.error, 1.5 * abs(shape))


@pytest.mark.parametrize("values, sizes, name", [
    ([1.0, 2.0], [0.2, 0.1], "sizes"), ([1.0, 2.0, 3.0], [0.4, 0.2], "sizes"), ([1.0, 2.0], [0.4, 0.2, 0.1], "values"),
    ([1.0, 2.0, 3.0], [0.1, 0.2, 0.4], "sizes"), ([1.0, 2.0, 3.0], [0.4, 0.2, 0.2], "sizes"),
    ([1.0, 2.0, 3.0], [0.4, 0.2, 0.0], "sizes"), ([1.0, 2.0, 3.0], [0.4, np.nan, 0.1], "sizes"),
    ([1.0, np.nan, 3.0], [0.4, 0.2, 0.1], "values"), (1.0, [0.4, 0.2, 0.1], "values"),
    ([1.0, 2.0, 3.0], [[0.4, 0.2, 0.1]], "sizes")], ids=str)
def test_grids_that_make_no_sequence_are_refused(values, sizes, name):
    with pytest.raises(ValueError, match=f"^{name}: got"):
        richardson(values, sizes)


# A history

def history(toe, dt=0.1):
    return CutHistory.of(Moment(dt * (k + 1), u, 2 * u, 10 * u) for k, u in enumerate(toe))


def test_a_history_starts_at_rest_and_is_read_off_straight_lines():
    held = history([0.04, 0.12, 0.3])
    assert_allclose(held.toe_at([0.0, 0.05, 0.1, 0.25]), [0.0, 0.02, 0.04, 0.21])
    assert np.isnan(held.toe_at(0.31))
    assert held.failure_time() == pytest.approx(0.175)
    assert held.quantities(0.25) == pytest.approx({"run_out": 0.42, "failure_time": 0.175, "dissipation": 2.1})


def test_failure_is_when_the_toe_first_gets_there():
    assert history([0.04, 0.12, 0.05, 0.3]).failure_time() == pytest.approx(0.175)
    assert history([0.2]).failure_time() == pytest.approx(0.05)


def test_a_cut_that_stands_fails_at_the_end_at_the_earliest():
    held = history([0.04, 0.05, 0.04])
    assert held.failure_time() == np.inf
    assert held.quantities(0.3)["failure_time"] == 0.3


def test_a_run_that_ends_early_has_no_quantities():
    assert all(np.isnan(value) for value in history([0.04, 0.12]).quantities(0.25).values())


# The file

def test_the_file_says_how_it_was_made():
    held = json.loads(FILE.read_text(encoding="utf-8"))
    assert held == stored()
    script = re.fullmatch(r"python (benchmarks/\w+\.py)", held["command"])[1]
    assert (ROOT / script).is_file()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", held["date"])
    assert {"python", "numpy", "scipy", "scikit-fem", "numba"} <= held["versions"].keys()
    assert held["machine"] and held["choice"]["method"] and held["second_choice"] != held["choice"]


@pytest.mark.parametrize("loading", LOADINGS)
def test_the_file_is_complete(loading):
    held, found = stored()[loading], cut_reference(loading)
    assert len(held["grids"]) >= 4 and len(held["second"]) >= 4
    assert found.until == vertical_cut(1.0, loading=loading).until == pytest.approx(found.times[-1])
    for row in held["grids"] + held["second"] + held["half_step"]:
        assert {"points", "steps", "seconds", "roughness", "balance", *QUANTITIES} <= row.keys()
        assert len(row["toe"]) == len(found.times) == len(found.toe.value) == len(found.toe.error)
    for name in ("toe", *QUANTITIES):
        value, error, order = getattr(found, name)
        assert np.isfinite(value).all() and np.isfinite(error).all() and np.min(error) >= 0
        assert np.isnan(order) or 0.3 <= order <= 3


@pytest.mark.parametrize("loading", LOADINGS)
def test_the_limits_are_those_of_the_stored_grids(loading):
    held, found = stored()[loading], cut_reference(loading)
    for name in ("toe", *QUANTITIES):
        best, second = (richardson([row[name] for row in rows], [row["h"] for row in rows])
                        for rows in (held["grids"], held["second"]))
        again = best.beside(second)
        assert_allclose(again.value, getattr(found, name).value, rtol=1e-7, atol=1e-10)
        assert_allclose(again.error, getattr(found, name).error, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("loading", LOADINGS)
def test_the_reference_is_a_failure_and_its_numbers_agree(loading):
    found = cut_reference(loading)
    assert (np.diff(found.toe.value) > 0).all()
    at_failure = np.interp(found.failure_time.value, found.times, found.toe.value)
    assert at_failure == pytest.approx(0.10, abs=3 * np.interp(found.failure_time.value, found.times, found.toe.error))
    assert abs(found.run_out.value - found.toe.value[-1]) <= found.run_out.error + found.toe.error[-1]
    assert found.run_out.error < 0.5 * found.run_out.value
    weight_lost = 4000 * 10 * 0.5               # [J]: were all of it to sink to the ground
    assert 0 < found.dissipation.value < weight_lost


@pytest.mark.parametrize("loading", LOADINGS)
def test_the_time_step_has_little_share_in_the_error(loading):
    """Half the step changes a grid by a tenth at most of what the next finer grid does to it."""
    grids = {row["h"]: row for row in stored()[loading]["grids"]}
    for row in stored()[loading]["half_step"]:
        same, finer = grids[row["h"]], grids[row["h"] / 2]
        assert row["steps"] > 1.9 * same["steps"]
        step, cells = (np.linalg.norm(np.subtract(other["toe"], same["toe"])) for other in (row, finer))
        assert step < 0.1 * cells


@needs_numba
@pytest.mark.parametrize("loading", LOADINGS)
def test_stored_grids_are_reproduced(loading):
    held = stored()
    rows = [(row, held[choice]) for kind, choice in (("grids", "choice"), ("second", "second_choice"))
            for row in held[loading][kind][:2]]
    for row, choices in rows:
        scene = vertical_cut(row["h"], loading=loading, room=held["room"])
        found = scene.history(scene.run(**choices))
        assert_allclose(found.toe_at(cut_reference(loading).times), row["toe"], rtol=1e-6, atol=1e-9)
        assert found.quantities(scene.until) == pytest.approx({name: row[name] for name in QUANTITIES}, rel=1e-6)


@pytest.mark.slow
@needs_numba
def test_the_script_makes_such_a_file(tmp_path):
    """The quick one has the three coarsest grids of the stored one."""
    subprocess.run([sys.executable, ROOT / "benchmarks/cut_reference.py", "--quick", "--out", tmp_path / "quick.json"],
                   check=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
    quick = json.loads((tmp_path / "quick.json").read_text())
    assert quick["command"].endswith("--quick")
    assert quick.keys() == stored().keys()
    for loading in LOADINGS:
        assert quick[loading].keys() == stored()[loading].keys()
        assert [row["h"] for row in quick[loading]["grids"]] == [row["h"] for row in stored()[loading]["grids"][:3]]
        for one, other in zip(quick[loading]["grids"], stored()[loading]["grids"]):
            assert_allclose(one["toe"], other["toe"], rtol=1e-6, atol=1e-9)


def test_the_file_is_shipped():
    """It stands in the package, all of which the build takes along."""
    assert resources.files("skfem_mpm.scenes").joinpath(FILE.name).read_text(encoding="utf-8") == FILE.read_text()
    assert 'build-backend = "flit_core.buildapi"' in (ROOT / "pyproject.toml").read_text()


# A run measured against it

@pytest.fixture(scope="module")
def coarse():
    """States of coarse runs, which are many times faster in numpy than numba is to load."""
    def states(loading):
        scene = vertical_cut(0.25, loading=loading)
        return scene, list(scene.run("gimp", engine="numpy"))
    return {loading: states(loading) for loading in LOADINGS}


@pytest.mark.parametrize("loading", LOADINGS)
def test_a_coarse_run_has_errors_of_some_tens_of_percent(coarse, loading):
    scene, states = coarse[loading]
    errors = scene.measure(iter(states))
    assert errors.keys() == AGAINST | {"roughness", "balance"}
    assert all(type(value) is float for value in errors.values())
    assert all(0.01 < errors[name] < 0.8 for name in AGAINST)
    assert 0 < errors["roughness"] < 0.5 and 0 < errors["balance"] < 0.1


@pytest.mark.parametrize("loading", LOADINGS)
def test_a_finer_run_is_nearer(coarse, loading):
    finer = vertical_cut(0.1, loading=loading)
    near, far = finer.measure(finer.run("gimp", engine="numpy")), coarse[loading][0].measure(coarse[loading][1])
    for name in ("toe", "run_out", "failure_time"):
        assert near[name] < far[name]


def test_the_reference_measured_against_itself_has_no_error():
    found = cut_reference("sudden")
    held = CutHistory.of(map(Moment, found.times, found.toe.value, found.toe.value, found.times))
    errors = found.errors(held)
    assert errors["toe"] < 1e-12
    shifted = CutHistory.of(map(Moment, found.times, found.toe.value + 0.1 * found.toe.value[-1], *[found.times] * 2))
    assert found.errors(shifted)["toe"] == pytest.approx(0.1)


@pytest.mark.parametrize("loading", LOADINGS)
def test_its_uncertainty_is_in_the_measures_of_its_errors(loading):
    """A history that is off by the error everywhere has errors of that size."""
    found = cut_reference(loading)
    known = found.uncertainty()
    assert known.keys() == AGAINST and all(0 < value < 1 for value in known.values())
    off = CutHistory.of(map(Moment, found.times, found.toe.value + found.toe.error,
                            [found.run_out.value + found.run_out.error] * len(found.times),
                            [found.dissipation.value - found.dissipation.error] * len(found.times)))
    errors = found.errors(off)
    assert_allclose([errors[name] for name in ("toe", "run_out", "dissipation")],
                    [known[name] for name in ("toe", "run_out", "dissipation")], rtol=1e-9)


@pytest.mark.parametrize("loading", LOADINGS)
@pytest.mark.parametrize("h, method", [(0.25, "mpm"), (0.2, "gimp")])
def test_a_run_spans_the_same_time_whatever_the_cells(loading, h, method):
    scene = vertical_cut(h, loading=loading)
    times = np.array([state.time for state in scene.run(method, engine="numpy")])
    assert scene.until <= times[-1] < scene.until + 0.02
    assert (np.diff(times) > 0).all() and np.diff(times).max() < 0.03


def test_steps_and_spacing_are_the_users_if_given():
    scene = vertical_cut(0.25)
    assert [state.step for state in scene.run("mpm", steps=3, engine="numpy")] == [1, 2, 3]
    assert [state.step for state in scene.run("mpm", engine="numpy", every=20)][:2] == [20, 40]
    assert len(list(scene.run("mpm", engine="numpy", every_seconds=0.1))) in (3, 4)
    assert len(list(vertical_cut(0.25, until=0.05).run("mpm", engine="numpy"))) < 8


OTHERS = {"height": {"height": 2.0}, "width": {"width": 3.0}, "density": {"density": 1900.0}, "base": {"base": "rough"},
          "gravity": {"acceleration": 9.81}, "start": {"initial": "geostatic"}, "until": {"until": 0.2},
          "cohesion": {"material": VonMises(E=400e3, nu=0.35, peak=7e3, residual=1e3, softening=-25e3)},
          "law": {"material": LinearElastic(E=400e3, nu=0.35)}, "dim": {"dim": 3}}


@pytest.mark.parametrize("given", OTHERS.values(), ids=OTHERS)
def test_another_cut_has_no_reference(given):
    scene = vertical_cut(**{"h": 0.5, "until": 0.3, **given})
    errors = scene.measure(scene.run("mpm", engine="numpy"))
    assert all(np.isnan(errors[name]) for name in AGAINST)
    assert errors["roughness"] >= 0 and errors["balance"] >= 0


def test_points_room_and_sizes_made_to_fit_are_still_the_same_cut():
    for given in ({"per_cell": 3}, {"room": 1.0}, {"h": 0.3}):
        scene = vertical_cut(**{"h": 0.5, **given})
        assert all(np.isfinite(value) for value in scene.measure(scene.run("mpm", engine="numpy")).values())


def test_a_cut_changed_by_hand_has_no_reference(coarse):
    scene, states = coarse["sudden"]
    strong = replace(scene, material=replace(scene.material, peak=6.1e3))
    for other in (strong, replace(scene, gravity=(0.0, -9.0)), replace(scene, boundary=scene.boundary[:1])):
        assert np.isnan(other.measure(states)["toe"])


def test_a_run_that_ends_early_has_numbers_of_its_own_only(coarse):
    scene, states = coarse["sudden"]
    errors = scene.measure(states[:-3])
    assert all(np.isnan(errors[name]) for name in AGAINST)
    assert errors["balance"] == abs(scene.energy_balance(states[-4]))


def test_roughness_is_that_of_the_papers_instant(coarse):
    scene, states = coarse["sudden"]
    first = next(state for state in states if scene.toe_displacement(state) >= 0.1)
    assert scene.measure(states)["roughness"] == scene.roughness(first) != scene.roughness(states[-1])
    assert scene.measure(states[:3])["roughness"] == scene.roughness(states[2])


def test_no_states_are_refused():
    with pytest.raises(ValueError, match="states: got none"):
        vertical_cut(0.5).measure([])


@pytest.mark.parametrize("until", [0.0, -1.0, np.nan])
def test_a_span_that_is_none_is_refused(until):
    with pytest.raises(ValueError, match="until"):
        vertical_cut(0.5, until=until)
