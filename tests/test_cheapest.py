"""The cheapest choice, on scenes whose error and cost are known laws: what brute force finds, or a true "no"."""

import math
import warnings
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skfem_mpm import study

PILOTS, MOST = (10, 20, 40), 160
LAWS: dict = {}                 # method -> Law, of the scenes to be made


class Law:
    """Error and cost of a method by its number of cells."""

    def __init__(self, scale=1.0, order=1.0, price=1e-3, dearer=1.0, floor=0.0, jitter=0.0, wrong=(),
                 names=("all", "other")):
        self.scale, self.order, self.price, self.dearer = scale, order, price, dearer
        self.floor, self.jitter, self.wrong, self.names = floor, jitter, wrong, names

    def error(self, cells):
        if cells in self.wrong:
            return math.nan
        noise = zlib.crc32(f"{self.order} {cells}".encode()) / 2**31 - 1
        return (self.scale * cells**-self.order + self.floor) * (1 + self.jitter * noise)

    def cost(self, cells):
        return self.price * cells**self.dearer

    def __repr__(self):
        return f"Law({self.__dict__})"


class Scene:
    def __init__(self, cells, dim):
        self.cells, self.dim = cells, dim

    def run(self, method="mpm", model="plastic"):
        law = LAWS[method]
        if law is None or (self.dim == 1 and method == "gc"):
            raise ValueError(f"method: got {method!r}, which cannot be run here")
        if self.cells in getattr(law, "stops", ()):
            raise RuntimeError("no equilibrium")
        if getattr(law, "warns", False):
            warnings.warn("waves grow", stacklevel=2)
        yield SimpleNamespace(step=1, particles=SimpleNamespace(n=self.cells), law=law, model=model)

    def errors(self, state):
        factor = 5.0 if state.model == "elastic" else 1.0
        found = {"all": factor * state.law.error(self.cells), "other": 1.0}
        return {name: found[name] for name in state.law.names}


def make(cells=10, dim=2):
    return Scene(cells, dim)


def seconds(make, choice):
    """Seconds of a run by its law: a smaller model costs half."""
    cost = LAWS[choice["method"]].cost(choice["cells"])
    cost *= 0.5 if choice.get("model") in ("elastic", "small") or choice.get("dim") == 1 else 1.0
    return {"setup_s": 0.0, "wall_s": cost, "cpu_s": cost}


@pytest.fixture(autouse=True)
def costs(monkeypatch):
    monkeypatch.setattr(study.trade, "timed", seconds)
    monkeypatch.setattr(study.trade, "compiled", lambda make, choice: 0.0)


def ask(laws, tolerance, **more):
    LAWS.clear()
    LAWS.update(laws)
    return study.cheapest(make, tolerance, **{"quantity": "all", "choices": [{"method": name} for name in laws],
                                              "pilots": PILOTS, "most": MOST, "repeats": 1, **more})


def brute(laws, tolerance):
    """The cheapest of all numbers of cells from the coarsest pilot on, its cost, and those within."""
    within = [(law.cost(cells), name, cells) for name, law in laws.items() if law is not None
              for cells in range(PILOTS[0], MOST + 1) if law.error(cells) <= tolerance]
    return min(within, default=None)


laws_ = st.builds(Law, scale=st.floats(0.1, 10), order=st.floats(0.5, 4), price=st.floats(1e-4, 1e-2),
                  dearer=st.floats(0.5, 3), floor=st.sampled_from([0.0, 0.0, 1e-4, 1e-2]))
tolerances = st.floats(-4, -0.5).map(lambda power: 10**power)


@given(st.lists(laws_, min_size=1, max_size=4), tolerances, st.sampled_from([0.0, 0.01, 0.05]))
@settings(max_examples=150)
def test_it_is_what_brute_force_finds(listed, tolerance, jitter):
    """Up to the margin of a tenth that promises are kept with: the best is that of a tolerance smaller by this."""
    for law in listed:
        law.jitter = jitter
    laws = {f"way{k}": law for k, law in enumerate(listed)}
    answer, best, strict = ask(laws, tolerance), brute(laws, tolerance), brute(laws, (0.89 - jitter) * tolerance)
    verified(answer, laws, tolerance)
    assert not answer.reached or best is not None
    if strict is not None:
        assert answer.reached and answer.row["cpu_s"] <= 1.5 * strict[0]


def verified(answer, laws, tolerance):
    """What is recommended was run, and what is said of it is so."""
    law, cells = laws[answer.choice["method"]], answer.choice["cells"]
    assert answer.row["error_all"] == law.error(cells) and answer.row["cpu_s"] == law.cost(cells)
    assert answer.reached == (answer.row["error_all"] <= tolerance) and cells <= MOST
    assert any(row["method"] == answer.choice["method"] and row["cells"] == cells for row in answer.rows)
    if not answer.reached:
        errors = [row["error_all"] for row in answer.rows if row["status"] == "done"]
        assert answer.row["error_all"] == min(errors) > tolerance and str(answer).startswith("not reachable")
        assert len(answer.notes) >= len(laws)


def test_the_answer_says_what_was_predicted():
    answer = ask({"mpm": Law(1.0, 1.0), "gc": Law(1.0, 2.0)}, 2e-4)
    assert answer.choice == {"method": "gc", "cells": 75} and answer.reached
    assert answer.predicted["error"] == pytest.approx(75**-2) and answer.predicted["cost"] == pytest.approx(0.075)
    assert str(answer).startswith("gc, cells=75\n  error 0.000178 (predicted 0.000178), 0.075 s (predicted 0.075)")
    assert answer.notes == () and answer.smaller == ()


def test_why_it_is_not_reachable():
    answer = ask({"stalls": Law(1.0, 2.0, floor=0.1), "slow": Law(1.0, 1.0), "no": None}, 1e-3)
    assert not answer.reached and answer.choice["method"] == "slow" and answer.choice["cells"] == 40
    assert [note.split(",")[0].split(" (")[0] for note in answer.notes] == [
        "no falls out: ValueError: method: got 'no'", "stalls stalls",
        f"slow would need some {math.ceil(1 / 0.9e-3):.3g} cells"]


def test_cells_that_would_be_needed_are_called_a_guess_where_they_are_one():
    bends = Law()
    bends.error = {10: 0.4, 20: 0.1, 40: 0.053}.get
    one = Law(1.0, 1.0, wrong=(10, 20))
    notes = ask({"bends": bends, "one": one}, 1e-4).notes
    assert any(note.startswith("bends would need") and "not in the asymptotic range (orders 2, 0.92)" in note
               for note in notes)
    assert any(note.startswith("one lacks pilots [10, 20]") for note in notes)
    assert "one has one run only, which tells no order" in notes


def test_ways_that_warn_are_left_out_unless_all_do():
    laws = {"shaky": Law(1.0, 2.0, 1e-6), "gc": Law(1.0, 1.0)}
    laws["shaky"].warns = True
    answer = ask(laws, 0.05)
    assert answer.choice["method"] == "gc" and "shaky falls out: waves grow" in answer.notes
    answer = ask({"shaky": laws["shaky"]}, 0.05)
    assert answer.choice["method"] == "shaky" and "shaky warns: waves grow" in answer.notes


def test_a_smaller_model_may_leave_an_argument_out():
    answer = ask({"mpm": Law()}, 0.02, choices=[{"method": "mpm", "model": "alike"}],
                 simpler={"plain": {"dim": 1, "model": None}, "nothing": {"other": None}})
    assert [each.name for each in answer.smaller] == ["plain"]
    assert "model" not in next(row for row in answer.rows if row.get("dim") == 1)


def test_pilots_that_are_not_asymptotic():
    pre = Law()
    pre.error = {10: 0.5, 20: 0.4, 40: 0.02}.get
    answer = ask({"mpm": pre}, 0.02)
    assert answer.reached and answer.choice["cells"] == 40
    assert any("not in the asymptotic range (orders 0.32, 4.3)" in note for note in answer.notes)


def test_a_run_within_the_tolerance_by_luck():
    law = Law()
    law.error = {10: 0.1, 20: 0.001, 40: 0.08}.get
    answer = ask({"mpm": law}, 0.01)
    assert answer.reached and answer.choice["cells"] == 20 and "luck perhaps" in answer.notes[0]


def test_errors_that_are_not_numbers_are_not_recommended():
    laws = {"mpm": Law(1.0, 1.0, wrong=range(1, 1000)), "gc": Law(1.0, 1.0, 1.0, wrong=(20,)),
            "x": Law(names=["other"])}
    answer = ask(laws, 0.015)
    assert [note.split(":")[0] for note in answer.notes[:3]] == ["mpm falls out", "gc lacks pilots [20]",
                                                                      "x falls out"]
    assert answer.choice["method"] == "gc" and np.isfinite(answer.row["error_all"])
    with pytest.raises(ValueError, match="none that can be run; mpm falls out: its error 'all' is not a finite number"):
        ask({"mpm": Law(wrong=range(1000))}, 0.1)


def test_a_way_that_fails_on_the_way_goes_no_further():
    laws = {"cheap": Law(1.0, 1.0, 1e-4), "dear": Law(1.0, 1.0, 1.0)}
    laws["cheap"].stops = range(21, 40)
    answer = ask(laws, 1 / 25)
    assert (answer.choice, answer.reached) == ({"method": "cheap", "cells": 40}, True)
    assert "cheap goes no further: with 28 cells RuntimeError: no equilibrium" in answer.notes
    laws["cheap"].stops = range(41, 100)
    answer = ask(laws, 1 / 60)
    assert answer.choice["method"] == "dear" and answer.reached


def test_smaller_models_are_judged_by_what_they_measure():
    simpler = {"elastic": {"model": "elastic"}, "small strain": {"model": "small"}, "in 1-D": {"dim": 1},
               "alike": {"model": "alike"}, "what it is": {"dim": 2}}
    answer = ask({"mpm": Law(1.0, 1.0)}, 0.02, simpler=simpler)
    found = {each.name: each for each in answer.smaller}
    assert list(found) == ["elastic", "small strain", "in 1-D", "alike"]        # no smaller model, no comparison
    assert [each.would_do for each in answer.smaller] == [False, True, True, True]
    assert found["alike"].cost == answer.row["cpu_s"]                           # as good, and what it costs is said
    assert found["elastic"].error == pytest.approx(5 * answer.row["error_all"])
    assert "in 1-D would do: error" in str(answer) and "elastic would not do: error" in str(answer)
    failing, = ask({"gc": Law()}, 0.02, simpler={"in 1-D": {"dim": 1}}).smaller
    assert not failing.would_do and failing.reason.startswith("ValueError") and "cannot be run" in str(failing)
    unknown, = ask({"mpm": Law()}, 0.02, simpler={"x": {"nothing": 1}}).smaller
    assert "unexpected keyword" in unknown.reason


def test_it_goes_on_from_its_folder(tmp_path, monkeypatch):
    laws = {"mpm": Law(1.0, 1.0), "gc": Law(1.0, 2.0, 1e-2)}
    first = ask(laws, 1.5e-2, out=tmp_path)
    assert first.row["cells"] == 75 and (tmp_path / "cheapest.csv").exists()
    monkeypatch.setattr(study.trade, "measured", None)                         # whoever runs anything fails
    monkeypatch.setattr(study.trade, "timed", None)
    again = ask(laws, 1.5e-2, out=tmp_path)
    assert (again.choice, again.row, again.notes) == (first.choice, first.row, first.notes)


def test_the_same_choice_twice_is_one():
    answer = ask({"mpm": Law(1.0, 1.0), "gc": Law(1.0, 2.0)}, 5e-3,
                 choices=[{"method": "mpm", "model": "a"}, {"method": "mpm"}, {"method": "gc"}], model="b")
    assert answer.choice == {"method": "gc", "model": "b", "cells": 15}
    assert [row["cells"] for row in answer.rows[:6]] == [*PILOTS, *PILOTS]       # three pilots of two ways


def test_seconds_of_the_answer_are_a_median():
    assert ask({"mpm": Law()}, 0.05, repeats=3).row["repeats"] == 3


@pytest.mark.parametrize("arguments, error, message", [
    ({"tolerance": 0.0}, ValueError, "tolerance"), ({"tolerance": math.nan}, ValueError, "tolerance"),
    ({"quantity": "stress"}, ValueError, "quantity: got 'stress', expected one of 'all', 'other'"),
    ({"pilots": [10]}, ValueError, "pilots: got"), ({"pilots": [0, 10]}, ValueError, "pilots: got 0"),
    ({"most": 20}, ValueError, "most: got 20, expected at least the finest pilot, 40"),
    ({"cost": "euros"}, ValueError, "cost: got 'euros'"), ({"choices": []}, ValueError, "choices: got no values"),
    ({"choices": [{"method": "mpm", "cells": 3}]}, ValueError, "cells: got 3"),
    ({"cells": [10, 20]}, ValueError, r"cells: got \[10, 20\]"), ({"repeats": 0}, ValueError, "repeats: got 0"),
    ({"pilot": [10, 20]}, ValueError, "none that can be run.*unexpected keyword argument 'pilot'"),
])
def test_bad_input_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        ask({"mpm": Law()}, **{"tolerance": 0.1, **arguments})
