"""A study: every choice a row, errors, seconds and memory those of its runs, files whole, nothing done twice."""

import csv
import functools
import json
import math
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fake_scenes import CLOCK, FACTORS, Clock, Slow, make, make_measured, make_slow
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from skfem_mpm import METHODS, CMPMBasis, Method, ParticleBasis, plot, study
from skfem_mpm.study import choices as choosing
from skfem_mpm.study import runs, store
from skfem_mpm.study.trend import Trend

METHODS_HERE, CELLS = ["mpm", "gimp", "gc"], [5, 10]
numbers = st.one_of(st.sampled_from([0.0, 1.0, 2.0, math.nan, math.inf, -math.inf]), st.floats(-10, 10))


def plainly(scene=make, **more):
    """A study without a process for each run, and without seconds if none are asked for."""
    return study.tradeoff(scene, **{"methods": ["mpm"], "cells": CELLS, "memory": False, "repeats": 0, **more})


def lines(path):
    return path.read_text().splitlines() if path.exists() else []


# The Pareto set.

def beaten(mine, others):
    return any(cost <= mine[0] and error <= mine[1] and (cost, error) != mine for cost, error in others)


@given(st.lists(st.tuples(numbers, numbers), max_size=12))
def test_the_pareto_set_is_what_nobody_beats(runs_):
    cost, error = [list(part) for part in zip(*runs_)] if runs_ else ([], [])
    found = study.pareto(cost, error)
    finite = [run for run in runs_ if np.isfinite(run).all()]
    assert {runs_[k] for k in found} == {run for run in finite if not beaten(run, finite)}
    assert len({runs_[k] for k in found}) == len(found) and all(runs_.index(runs_[k]) == k for k in found)
    assert (np.diff(np.array(cost)[found]) > 0).all() and (np.diff(np.array(error)[found]) < 0).all()


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8), st.floats(0, 3), st.floats(0, 3), st.data())
def test_a_beaten_run_changes_nothing(runs_, dearer, worse, data):
    cost, error = np.array(runs_).T
    found = study.pareto(cost, error)
    if len(found):
        k = data.draw(st.sampled_from(list(found)))
        assert list(study.pareto([*cost, cost[k] + dearer], [*error, error[k] + worse])) == list(found)


@pytest.mark.parametrize("cost, error", [([1.0], [1.0, 2.0]), (1.0, 1.0), ([[1.0]], [[1.0]])])
def test_the_pareto_set_refuses_what_does_not_fit(cost, error):
    with pytest.raises(ValueError, match="error: got shape"):
        study.pareto(cost, error)


# Choices.

@given(st.dictionaries(st.sampled_from("abcd"), st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True)))
def test_a_product_has_every_combination_once(axes):
    found = study.product(**axes)
    assert len(found) == math.prod(map(len, axes.values())) == len({tuple(choice.items()) for choice in found})
    assert all(choice[name] in values for choice in found for name, values in axes.items())
    assert found == study.product(**axes, nothing=None) == study.product(**{k: iter(v) for k, v in axes.items()})


@pytest.mark.parametrize("values, error", [("mpm", TypeError), (3, TypeError), ({"a": 1}, TypeError), ([], ValueError),
                                           (iter([]), ValueError)])
def test_an_axis_is_a_sequence(values, error):
    with pytest.raises(error, match="method: got"):
        study.product(method=values)


def test_what_a_choice_says_itself_stands_and_none_is_there_twice():
    found = choosing.crossed([{"method": "gc", "cells": 7}, {"method": "mpm"}, {"method": "mpm"}], cells=[5, 7])
    assert found == [{"method": "gc", "cells": 7}, {"method": "mpm", "cells": 5}, {"method": "mpm", "cells": 7}]


@dataclass(frozen=True)
class Field:
    values: np.ndarray


def test_keys_tell_choices_apart():
    long = np.linspace(0, 1, 5000)
    other = long.copy()
    other[2500] += 1e-12
    values = [1, 2, 1.5, "1", None, True, (1, 2), long, other, Field(long), Field(other), METHODS["gc"], METHODS["mpm"]]
    assert len({choosing.key({"a": value}) for value in values}) == len(values)
    assert choosing.key({"a": 1, "b": 2}) == choosing.key({"b": np.int64(2), "a": np.int32(1)})
    assert choosing.key({"a": [1, 2]}) == choosing.key({"a": (1, 2)}) == choosing.key({"a": np.array([1, 2])})


def test_keys_are_the_same_in_every_process():
    choice = "{'walls': {'left', 'right', 'top'}, 'method': METHODS['gc'], 'x': 0.1, 'n': (1, 2)}"
    code = f"from skfem_mpm import METHODS; from skfem_mpm.study.choices import key; print(key({choice}))"
    found = {subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed},
                            capture_output=True, text=True, check=True).stdout for seed in ("1", "2")}
    assert len(found) == 1


@pytest.mark.parametrize("value", [object(), lambda: 0, [object()], print.__call__])
def test_an_object_that_says_nothing_of_itself_is_refused(value):
    with pytest.raises(TypeError, match="says nothing that a table could hold"):
        choosing.key({"a": value})


def test_labels():
    assert choosing.label({"cells": 3, "steps": 1}) == "as it is"
    assert choosing.label({"domains": "fixed", "method": "gc", "per_cell": 2}) == "gc, domains=fixed"


def test_a_method_of_the_user_is_a_value_like_others(tmp_path):
    mine = Method(mass=ParticleBasis, strain=CMPMBasis, force=ParticleBasis)
    found = study.tradeoff("cylinder", [mine, "cmpm", "mpm"], [5], steps=[1], repeats=0, memory=False, out=tmp_path)
    errors = found.column("error_all")
    assert errors[0] == errors[1] != errors[2] and "CMPMBasis" in found.label(found.rows[0])
    assert study.load(tmp_path).rows[0]["method"] == found.rows[0]["method"]


# Rows.

def test_every_choice_is_a_row_with_all_that_was_measured():
    found = plainly(methods=["mpm", "gc"], per_cell=[1, 2], steps=[4], repeats=3)
    assert [(row["method"], row["cells"], row["per_cell"]) for row in found.rows] == [
        (method, cells, per_cell) for method in ("mpm", "gc") for cells in CELLS for per_cell in (1, 2)]
    assert found.quantities == ("error", "error_worst")
    for row in found.rows:
        assert row["error_error"] == FACTORS[row["method"]] * 4 / row["cells"] ** 2 == row["error_error_worst"]
        assert (row["points"], row["steps_done"]) == (row["cells"] * row["per_cell"], 4)
        assert row["status"] == "done" and row["reason"] == "" and row["repeats"] == 3
        assert row["wall_s_least"] <= row["wall_s"] <= row["wall_s_most"] and row["compile_s"] >= 0
        assert row["point_steps_per_s"] == pytest.approx(row["points"] * 4 / row["wall_s"])
    assert {"machine", "processor", "cores", "versions", "date", "OMP_NUM_THREADS", "scene"} <= set(found.about)


def test_errors_of_a_whole_run_are_the_scenes_own():
    found = plainly(make_measured)
    assert found.quantities == ("stress", "run-out")
    assert np.isnan(found.rows[0]["error_run-out"]) and found.rows[1]["error_run-out"] == 0.25
    assert [row["cells"] for row in found.front("run-out", "cells")] == [10]


@pytest.mark.parametrize("scene, cells, quantities", [("cylinder", [5], ("point", "all", "inner")),
                                                      ("column", [4], ("all", "inner", "position"))])
def test_scenes_that_ship(scene, cells, quantities):
    found = study.tradeoff(scene, ["mpm", "gimp"], cells, steps=[2], repeats=1, memory=False)
    assert found.quantities[:3] == quantities and [row["status"] for row in found.rows] == ["done"] * 2
    assert (found.column("wall_s") > 0).all() and (found.column("point_steps_per_s") > 0).all()


def test_runs_that_fail_are_rows_with_the_reason():
    found = plainly(methods=["mpm"], more={"how": ["is well", "stops", "is refused"]}, cells=[10], repeats=2)
    well, stopped, refused = found.rows
    assert well["status"] == "done" and stopped["status"] == refused["status"] == "failed"
    assert stopped["reason"].startswith("NotConvergedError: no equilibrium in step 2") and stopped["steps_done"] == 1
    assert refused["reason"].startswith("ValueError: how: got") and np.isnan(refused["wall_s"])
    assert found.front() == [well]
    assert found.table().count("failed: ") == 2 and "how=stops" in found.table()


def test_an_argument_that_the_run_does_not_have_is_a_reason():
    found = plainly(choices=[{}, {"domain": "fixed"}])
    assert [row["status"] for row in found.rows] == ["done"] * 2 + ["failed"] * 2
    assert "unexpected keyword argument 'domain'" in found.rows[2]["reason"]
    with pytest.raises(ValueError, match="no run was done .*unexpected keyword argument 'domain'"):
        plainly(more={"domain": [1]}).table()


def test_a_run_that_fails_only_when_it_is_timed_is_a_failed_row(monkeypatch):
    def fails(make, choice):
        raise MemoryError("no more")
    monkeypatch.setattr(study.trade, "timed", fails)
    found = plainly(repeats=2)
    assert [row["reason"] for row in found.rows] == ["MemoryError: no more"] * 2 and found.quantities == ()


def test_sizes_in_which_rows_differ_are_in_their_labels():
    found = plainly(methods=["mpm"], per_cell=[1, 2], steps=[3])
    assert [found.label(row) for row in found.rows[:2]] == ["mpm, per_cell=1", "mpm, per_cell=2"]


def test_cells_may_be_an_array_or_a_pair():
    assert len(plainly(cells=np.array([4, 6])).rows) == 2
    study_ = study.tradeoff(make_pair, ["mpm"], cells=[(2, 3)], repeats=0, memory=False)
    assert "[2, 3]" in study_.table() and study_.rows[0]["error_error"] == 1 / 3 * 3 / 36


def make_pair(cells=(1, 1)):
    return make(cells[0] * cells[1])


# Seconds.

def test_making_and_compiling_are_not_in_the_seconds(monkeypatch):
    monkeypatch.setattr(runs, "time", CLOCK)
    Slow.known.clear()
    found = study.tradeoff(make_slow, ["mpm", "gc"], [5, 10], steps=[7], repeats=3, memory=False)
    for row in found.rows:
        assert row["wall_s"] == row["wall_s_least"] == row["wall_s_most"] == row["cpu_s"] == 7 and row["setup_s"] == 100
        assert row["compile_s"] == (1000 if row["cells"] == 5 else 0)           # the second grid has it compiled
        assert row["point_steps_per_s"] == 2 * row["cells"]


def test_a_process_that_goes_on_compiles_before_it_times(monkeypatch, tmp_path):
    monkeypatch.setattr(runs, "time", CLOCK)
    for repeats in (1, 3):
        Slow.known.clear()                      # as a new process has nothing compiled
        found = study.tradeoff(make_slow, ["mpm"], [5], steps=[7], repeats=repeats, memory=False, out=tmp_path)
    assert found.rows[0]["wall_s_most"] == 7 and found.rows[0]["repeats"] == 3 and found.rows[0]["compile_s"] == 1000


def test_timed_runs_go_in_rounds(tmp_path):
    log = tmp_path / "log"
    found = plainly(methods=["mpm", "gc"], cells=[5], repeats=3, more={"log": [str(log)]})
    assert lines(log)[-6:] == ["mpm 5", "gc 5"] * 3 and [row["repeats"] for row in found.rows] == [3, 3]


# Memory, in a process of its own.

def test_peak_memory_is_that_of_the_run_and_a_process_that_dies_is_a_row():
    ours = np.ones(40_000_000)                  # what this process holds is not the run's
    found = study.tradeoff(make, ["mpm"], [5], more={"how": ["is well", "is large", "dies", "has a bug"]}, repeats=0)
    well, large, dead, bug = found.rows
    assert len(ours) and well["memory_mb"] < 100 and 199 <= large["memory_mb"] < 400
    assert dead["status"] == "failed" and "exit code 7" in dead["reason"] and bug["status"] == "failed"
    assert bug["reason"] == "KeyError: 'no such thing'"
    assert found.front(cost="memory_mb")[0] is well
    assert plainly().rows[0]["error_error"] == well["error_error"]


def test_a_script_without_a_main_guard_is_told(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from fake_scenes import make\nfrom skfem_mpm import study\n"
                      "study.tradeoff(make, cells=[5], repeats=0)\n")
    path = {**os.environ, "PYTHONPATH": f"{Path(__file__).parent}:{Path(__file__).parents[1]}"}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=path)
    assert done.returncode == 1 and "if __name__ == '__main__':" in done.stderr.splitlines()[-1]


def test_memory_is_measured_later_if_it_is_asked_for_later(tmp_path):
    plainly(cells=[5], out=tmp_path)
    found = plainly(cells=[5], out=tmp_path, memory=True)
    assert found.rows[0]["memory_mb"] >= 0 and found.rows[0]["status"] == "done"


# Files.

def test_files_are_strict_json_and_the_same_csv(tmp_path):
    found = plainly(make_measured, methods=["mpm", "nobody"], out=tmp_path, repeats=1)

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")
    document = json.loads((tmp_path / "tradeoff.json").read_text(), parse_constant=refuse)
    assert len(document["rows"]) == 4 and document["about"]["scene"] == "fake_scenes.make_measured"
    with (tmp_path / "tradeoff.csv").open() as file:
        table = list(csv.DictReader(file))
    again = study.load(tmp_path)
    for row, text, loaded in zip(found.rows, table, again.rows):
        assert set(row) == set(loaded) <= set(text)
        for name, value in row.items():
            np.testing.assert_equal(loaded[name], value)
            assert text[name] == ("" if value is None else str(value))
    assert again.table("stress") == found.table("stress")


def test_infinite_errors_come_back_from_the_file(tmp_path):
    rows = store.Store(tmp_path, "a", {"scene": "x"})
    rows.rows["k"] = {"key": "k", "choice": {}, "status": "done", "reason": "", "times": [],
                      "errors": {"up": math.inf, "down": -math.inf, "none": math.nan, "some": 0.1}}
    rows.save(late=True)
    np.testing.assert_equal(store.Store(tmp_path, "a", {"scene": "x"}).rows, rows.rows)


def test_a_reader_never_sees_a_part(tmp_path):
    written, seen, broken, stop = store.Store(tmp_path, "a", {"scene": "x"}), [], [], threading.Event()
    written.save()

    def look():
        while not stop.is_set():
            try:
                seen.append(len(store.read(tmp_path / "a.json")[1]))
                broken.extend([] if (tmp_path / "a.csv").read_text().endswith("\n") else ["half a table"])
            except ValueError as failure:
                broken.append(failure)
    reader = threading.Thread(target=look)
    reader.start()
    for k in range(80):
        written.rows[str(k)] = {"key": str(k), "choice": {"text": "x" * 500}, "status": "done", "reason": "",
                                "errors": {}, "times": []}
        written.save(late=True)
    stop.set()
    reader.join()
    assert not broken and len(seen) > 1 and seen == sorted(seen)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.json"]


@given(st.lists(st.floats(0.01, 30), min_size=1, max_size=60), st.floats(0.001, 0.5))
@settings(max_examples=30)
def test_writing_takes_a_hundredth_of_the_time_and_no_more_than_that_is_lost(tmp_path_factory, pauses, each):
    clock, written = Clock(), []

    def write(path, text):
        clock.now += each
        written.append(clock.now)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "time", clock)
        patch.setattr(store, "write_text", write)
        kept = store.Store(tmp_path_factory.getbasetemp() / "none", "a", {})
        kept.save()
        for pause in pauses:
            clock.now += pause
            before = written[-1]
            kept.save()
            assert written[-1] == clock.now or clock.now < before + 100 * 2 * each * (1 + 1e-9)
    assert (len(written) - 2) * each <= (written[-1] - 1) / 100 + 1e-9
    assert len(written) % 2 == 0                # table and rows together


KILLED = """
import sys
from fake_scenes import make
from skfem_mpm import study
study.tradeoff(make, ["mpm", "gimp", "gc"], [5, 7, 10], repeats=2, memory=False, out=sys.argv[1],
               more={"log": [sys.argv[2]], "pause": [0.02]})
"""


@pytest.mark.parametrize("after", [20, 38, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 12, 28, 33, 42))])
def test_a_study_that_was_killed_goes_on(tmp_path, after):
    log = tmp_path / "log"
    path = {**os.environ, "PYTHONPATH": f"{Path(__file__).parent}:{Path(__file__).parents[1]}"}
    child = subprocess.Popen([sys.executable, "-c", KILLED, tmp_path, log], env=path)
    while len(lines(log)) < after and child.poll() is None:
        time.sleep(0.002)
    child.kill()
    child.wait()                                # on a machine that stalls it may just have ended
    _, kept = store.read(tmp_path / "tradeoff.json")
    finished = lines(log)
    log.unlink()

    def study_(**more):
        return study.tradeoff(make, ["mpm", "gimp", "gc"], [5, 7, 10], memory=False, repeats=2,
                              more={"log": [str(log)], "pause": [0.02]}, **more)
    found = study_(out=tmp_path)
    for row in found.rows:
        old = kept[row["key"]]
        left = 2 - len(old["times"])
        runs_ = 3 + left if not old["status"] else 2 + left if left else 0      # a warm run is two, errors one more
        assert lines(log).count(f"{row['method']} {row['cells']}") == runs_
    whole = study_()
    assert [(row["key"], row["error_error"]) for row in found.rows] == [
        (row["key"], row["error_error"]) for row in whole.rows]
    assert {row["repeats"] for row in found.rows} == {2} and len(finished) >= after


def test_nothing_is_run_again(tmp_path):
    log = tmp_path / "log"
    first = plainly(out=tmp_path, more={"log": [str(log)], "how": ["is well", "stops"]}, repeats=1)
    log.unlink()
    again = plainly(out=tmp_path, more={"log": [str(log)], "how": ["is well", "stops"]}, repeats=1)
    np.testing.assert_equal(again.rows, first.rows)
    assert lines(log) == []


def test_rows_of_other_choices_stay_in_the_file(tmp_path):
    plainly(methods=["mpm"], out=tmp_path)
    found = plainly(methods=["gc"], out=tmp_path)
    assert {row["method"] for row in found.rows} == {"gc"} and len(found.rows) == 2
    assert [row["method"] for row in study.load(tmp_path).rows] == ["mpm"] * 2 + ["gc"] * 2


@pytest.mark.parametrize("name, value", [("machine", "abacus"), ("processor", "other"), ("python", "2.7"),
                                         ("versions", {"numpy": "0.1"}), ("OMP_NUM_THREADS", "64")])
def test_rows_of_another_machine_are_not_mixed_in(tmp_path, name, value):
    plainly(out=tmp_path)
    path = tmp_path / "tradeoff.json"
    document = json.loads(path.read_text())
    document["about"][name] = value
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=f"made with {name}=.* as now.*another folder"):
        plainly(out=tmp_path)
    assert json.loads(path.read_text()) == document


def test_rows_of_another_scene_are_not_mixed_in(tmp_path):
    plainly(functools.partial(make, per_cell=2), out=tmp_path)
    assert plainly(functools.partial(make, per_cell=2), out=tmp_path).about["scene"] == "fake_scenes.make(per_cell=2)"
    for other in (make, functools.partial(make, per_cell=3), make_measured):
        with pytest.raises(ValueError, match="made with scene="):
            plainly(other, out=tmp_path)


class Bare:
    """The least that a scene can be."""

    def __init__(self, cells):
        self.cells = cells

    def run(self):
        return iter([self.cells])

    def error(self, state):
        return 1 / state


class Silent(Bare):
    """One that measures nothing."""

    error = property()


def test_the_least_that_a_scene_can_be_and_less():
    found = study.tradeoff(Bare, cells=[4], choices=[{}], repeats=1, memory=False)
    assert found.rows[0]["error_error"] == 0.25 and np.isnan(found.rows[0]["point_steps_per_s"])
    silent = study.tradeoff(Silent, cells=[4], choices=[{}], repeats=1, memory=False)
    assert silent.rows[0]["status"] == "failed" and "measures nothing" in silent.rows[0]["reason"]


def test_a_study_knows_how_far_the_reference_is_known():
    cut = {loading: study.tradeoff("cut", ["mpm"], [2], more={"loading": [loading]}, repeats=0, memory=False)
           for loading in ("sudden", "ramped")}
    assert 0.01 < cut["sudden"].about["known"]["toe"] < cut["ramped"].about["known"]["toe"] < 0.5
    assert study.tradeoff("bar", ["mpm"], [4], repeats=0, memory=False).about["known"] == {}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"about": {}, "rows": [{"a": 1}]}', "no json"])
def test_a_file_of_something_else_is_refused(tmp_path, text):
    (tmp_path / "tradeoff.json").write_text(text)
    with pytest.raises(ValueError, match="no file of a study.*another folder"):
        plainly(out=tmp_path)
    assert (tmp_path / "tradeoff.json").read_text() == text
    with pytest.raises(ValueError, match="has no other.json"):
        study.load(tmp_path, "other")


# Bad input.

@pytest.mark.parametrize("arguments, error, message", [
    ({"repeats": -1}, ValueError, "repeats: got -1"), ({"repeats": 1.5}, ValueError, "repeats: got 1.5"),
    ({"more": {"method": ["mpm"]}}, ValueError, "more: got"),
    ({"cells": []}, ValueError, "cells: got no values"), ({"choices": []}, ValueError, "choices: got no values"),
    ({"methods": "mpm"}, TypeError, "method: got 'mpm'"), ({"choices": {"method": "mpm"}}, TypeError, "choices: got"),
    ({"choices": ["mpm"]}, TypeError, "choices: got 'mpm', expected dictionaries"),
    ({"scene": "circle"}, ValueError, "scene: got 'circle', expected one of"), ({"scene": 3}, TypeError, "scene: got"),
    ({"scene": make()}, TypeError, "scene: got Scene"),
    ({"scene": lambda cells: make(cells), "memory": True}, TypeError, "top of a module. Or give memory=False"),
    ({"scene": lambda cells: make(cells), "out": "nowhere"}, ValueError, "does not tell it from others"),
    ({"scene": "bar", "steps": [3]}, ValueError, "steps: got some for 'bar', whose runs cover a span of time"),
])
def test_bad_input_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        plainly(**arguments)


def test_a_quantity_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="quantity: got 'stress', expected one of 'error', 'error_worst'"):
        plainly().front("stress")


# Executors.

def test_a_pool_gives_the_same_errors(tmp_path):
    axes = {"methods": METHODS_HERE, "more": {"how": ["is well", "stops"]}}
    alone = plainly(**axes)
    with ThreadPoolExecutor(2) as threads:
        assert_same(plainly(**axes, executor=threads, out=tmp_path), alone)
    with ProcessPoolExecutor(1) as processes:
        assert_same(plainly(**axes, executor=processes), alone)
    assert len(study.load(tmp_path).rows) == 12


def assert_same(found, other):
    names = ("key", "status", "reason", "error_error", "points", "steps_done")
    for name in names:
        np.testing.assert_equal([row.get(name) for row in found.rows], [row.get(name) for row in other.rows])


def test_what_a_pool_cannot_do_is_refused_at_the_door():
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(ValueError, match="executor: got one with repeats=3"):
            plainly(executor=pool, repeats=3)
        with pytest.raises(TypeError, match="cannot be sent to another process"):
            plainly(lambda cells: make(cells), executor=pool)


# Trends.

orders = st.floats(0.2, 5)
sizes = st.lists(st.integers(2, 300), min_size=2, max_size=5, unique=True)


@given(sizes, orders, st.floats(0.1, 3), st.floats(1e-3, 1e3), st.integers(1, 1000))
def test_exact_powers_are_found(cells, order, dearer, scale, at):
    n = np.array(cells, dtype=float)
    trend = Trend(n, scale * n**-order, n**dearer)
    np.testing.assert_allclose(trend.orders, order, rtol=1e-6)
    if at >= n.min():
        np.testing.assert_allclose(trend.error_at(at), scale * at**-order, rtol=1e-6)
        np.testing.assert_allclose(trend.cost_at(at), at**dearer, rtol=1e-6)
    assert trend.asymptotic == (len(n) > 2)


@given(sizes, orders, st.floats(0.1, 3), st.floats(1e-6, 0.5))
def test_the_needed_cells_are_the_least_ones(cells, order, dearer, tolerance):
    n = np.sort(np.array(cells, dtype=float))
    trend = Trend(n, n**-order, n**dearer)
    needed = trend.needed(tolerance)
    run = dict(zip(n, trend.error))

    def good(m):
        return run[m] <= tolerance if m in run else m ** -order <= 0.9 * tolerance * (1 + 1e-6)
    if needed < 1e7:
        assert good(needed) and needed >= n[0]
        below = range(max(int(n[0]), needed - 300), needed)
        assert not any(m ** -order <= 0.9 * tolerance * (1 - 1e-6) or run.get(m, 1.0) <= tolerance for m in below)


@pytest.mark.parametrize("error, needed", [
    ([0.1, 0.1, 0.1], None), ([0.4, 0.2, 0.19], None), ([0.1, 0.2, 0.4], None), ([0.1, 0.001, 0.1], None),
    ([0.0, 0.0, 0.0], 10), ([0.1, 0.0, 0.0], 11), ([0.005, 0.2, 0.004], 40), ([0.001, 0.005, 0.002], 10),
])
def test_errors_that_do_not_simply_fall(error, needed):
    trend = Trend([10, 20, 40], error, [1.0, 2.0, 4.0])
    found = trend.needed(0.01)
    assert found == needed or (needed is not None and error[2] == 0.004 and 20 < found <= 40)
    assert not trend.asymptotic and np.isfinite([trend.error_at(80), trend.cost_at(80), trend.cost_at(15)]).all()


def test_one_run_says_nothing_beyond_itself():
    trend = Trend([10], [0.1], [2.0])
    assert (trend.needed(0.2), trend.needed(0.05), trend.asymptotic) == (10, None, False)
    assert trend.error_at(40) == pytest.approx(0.1) and trend.cost_at(40) == pytest.approx(2.0)


def test_far_beyond_all_machines_is_a_number_of_cells():
    assert Trend([10, 20], [1e30, 0.9e30], [0.0, 0.0]).needed(1e-30) > 1e40


@pytest.mark.parametrize("cells, error, cost", [
    ([], [], []), ([1, 2], [0.1], [1, 2]), ([1, 2], [0.1, math.nan], [1, 2]), ([1, 2], [0.1, 0.2], [1, math.inf]),
    ([1, 1], [0.1, 0.2], [1, 2]), ([0, 1], [0.1, 0.2], [1, 2]), ([1, 2], [0.1, -0.2], [1, 2])])
def test_a_trend_of_what_are_no_runs_is_refused(cells, error, cost):
    with pytest.raises(ValueError, match="(cells|error|cost): got"):
        Trend(cells, error, cost)


# The picture.

def shown(figure, axes=0):
    return {line.get_label(): line.get_xydata() for line in figure.axes[axes].get_lines()}


def made(**columns):
    """A study with seconds and memory as told."""
    n = len(columns["wall_s"])
    rows = [{"method": "mpm", "cells": k, "status": "done", "reason": "", "error_all": 0.1 / (k + 1), "memory_mb": 1.0,
             "point_steps_per_s": 1.0, **{name: values[k] for name, values in columns.items()}} for k in range(n)]
    return study.Study({"scene": "cylinder", "arguments": ["method", "cells"]}, tuple(rows))


def test_the_picture_has_the_runs_and_the_front():
    found = made(wall_s=[1.0, 4.0, 2.0, math.nan], method=["mpm", "mpm", "gc", "gc"], memory_mb=[50.0, 60.0, 90.0, 1.0],
                 error_all=[0.1, 0.05, 0.01, 0.001])
    figure = plot.trade(found)
    assert isinstance(figure, Figure) and len(figure.axes) == 2
    drawn = shown(figure)
    np.testing.assert_allclose(drawn["front"], [[1.0, 0.1], [2.0, 0.01]])
    np.testing.assert_allclose(drawn["mpm"], [[1.0, 0.1], [4.0, 0.05]])
    np.testing.assert_allclose(drawn["gc"], [[2.0, 0.01]])
    colours = {line.get_label(): line.get_color() for line in figure.axes[0].get_lines()}
    assert colours["mpm"] != colours["gc"]
    assert all(axes.get_xscale() == axes.get_yscale() == "log" and axes.get_xlabel() for axes in figure.axes)


@pytest.mark.parametrize("seconds", [[0.041, 0.053, 0.056], [1.0, 1.0, 1.0], [1.0], [0.01, 3.0, 200.0]])
def test_ticks_can_be_told_apart(seconds):
    figure = plot.trade(made(wall_s=seconds), costs=["wall_s"])
    figure.draw_without_rendering()
    axis = figure.axes[0].xaxis
    low, high = sorted(axis.get_view_interval())
    texts = [tick.label1.get_text() for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]
             if low <= tick.get_loc() <= high]
    texts = [text for text in texts if text]
    assert len(texts) >= 2 and len(texts) == len(set(texts))


def test_a_study_with_nothing_to_draw_says_so():
    with pytest.raises(ValueError, match="no run was done .*how: got a scene that cannot be"):
        plot.trade(plainly(more={"how": ["is refused"]}))
    figure = plot.trade(plainly())                              # no seconds, no memory: empty, but whole
    figure.draw_without_rendering()
    assert not len(shown(figure)["front"]) and "no run has both" in figure.axes[0].texts[0].get_text()


@pytest.mark.slow
@pytest.mark.parametrize("scene, pilots", [("cylinder", [5, 10, 20]), ("column", [4, 8, 16])])
def test_the_cheapest_choice_of_scenes_that_ship(scene, pilots):
    answer = study.cheapest(scene, 0.01, pilots=pilots, most=40, repeats=1, steps=5, simpler={},
                            choices=[{"method": "mpm"}, {"method": "gimp", "domains": "stretched"}])
    assert answer.reached == (answer.row["error_all"] <= 0.01) and np.isfinite(answer.row["cpu_s"])
    assert max(row["cells"] for row in answer.rows) <= 40
