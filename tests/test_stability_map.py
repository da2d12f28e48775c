"""The stability map: its page, what must hold, the words with which runs stop, and that a worse map is told."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
import stability_map  # noqa: E402
from extremes import page  # noqa: E402
from extremes.bodies import worst_of  # noqa: E402
from extremes.row import MUST, VERDICTS, Row, evaluate, judge  # noqa: E402

FAMILIES = stability_map.families()
STORED = json.loads(stability_map.STORE.read_text())
ROWS = {row.name: row for family in FAMILIES.values() for row in family.ROWS}
SIZES = ("full", "quick")
CELLS = [(size, name, key, cell) for size in SIZES for name, cells in STORED[size].items()
         for key, cell in cells.items()]


def split(key):
    method, _, remedy = key.partition(", ")
    return method, remedy


def test_the_page_is_what_its_script_makes_of_the_map():
    assert page.page_of(FAMILIES.values(), STORED) == stability_map.PAGE.read_text()


def test_names_of_rows_are_unique():
    assert len(ROWS) == sum(len(family.ROWS) for family in FAMILIES.values())


@pytest.mark.parametrize("size", SIZES)
def test_the_map_is_complete(size):
    expected = {name: {stability_map.key_of(*cell) for cell in row.cells(size == "quick")}
                for name, row in ROWS.items()}
    assert {name: set(cells) for name, cells in STORED[size].items()} == expected


def test_no_cell_is_wrong_without_a_word():
    assert not [cell[:3] for cell in CELLS if cell[3]["verdict"] not in ("", *VERDICTS[:3])]


EXTREMES = ["points on nodes, faces and corners, and one ulp", "a lone point", "a cover of 1e-12", "of the exact step",
            "scaled by powers of two", "a million body sizes from the origin", "100 turns", "Poisson's ratio 0.49",
            "1000 crossings at constant speed"]


@pytest.mark.parametrize("extreme", EXTREMES)
def test_no_method_may_fail_at(extreme):
    assert any(row.must and extreme in name for name, row in ROWS.items())


def test_what_must_hold_holds():
    cells = [(size, name, key, cell["verdict"]) for size, name, key, cell in CELLS if ROWS[name].must and key in MUST]
    assert not [cell for cell in cells if cell[-1] != "holds"]
    assert len(cells) == len(SIZES) * len(MUST) * sum(row.must for row in ROWS.values())


def test_verdicts_are_those_of_the_numbers_beside_them():
    """So a row whose limits change has to be measured again.  Numbers are stored with two digits."""
    for size, name, key, cell in CELLS:
        values = [None] if cell["value"] is None else [cell["value"] * share for share in (0.95, 1.0, 1.05)]
        verdicts = {judge(ROWS[name], value, cell["message"], cell["warnings"]) for value in values}
        assert cell["verdict"] in verdicts, (size, name, key)


def test_a_stop_says_where_and_what_to_do():
    """With the words that the row expects; a run stops by an error of the library."""
    for size, name, key, cell in CELLS:
        if cell["verdict"] == "stops":
            assert ROWS[name].stops and re.search(ROWS[name].stops, cell["message"]), (size, name, key, cell["message"])


STOPS = sorted({(name, key) for size, name, key, cell in CELLS if size == "quick" and cell["verdict"] == "stops"})


@pytest.mark.slow
@pytest.mark.parametrize("name, key", STOPS)
def test_runs_that_stop_do_so_with_these_words(name, key):
    cell = evaluate(ROWS[name], *split(key), quick=True)
    assert cell["verdict"] == "stops" and re.search(ROWS[name].stops, cell["message"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.must])
@pytest.mark.parametrize("method", MUST)
def test_what_must_hold_does_so_now(name, method):
    assert evaluate(ROWS[name], method, "", quick=True)["verdict"] == "holds"


@pytest.mark.parametrize("value, message, warned, verdict", [
    (0.5, "", [], "holds"), (1.0, "", [], "holds"), (1.5, "", [], "degrades"), (3.0, "", [], "wrong"),
    (3.0, "", ["a word"], "degrades"), (float("nan"), "", ["a word"], "wrong"), (None, "", [], ""),
    (None, "UnstableError: step 3", [], "stops"), (None, "ValueError: shapes", [], "wrong")])
def test_verdicts(value, message, warned, verdict):
    row = Row("a row", "It says.", lambda choices, quick: value, holds=1.0, useless=2.0, stops="step 3")
    assert judge(row, value, message, warned) == verdict


@pytest.mark.parametrize("values", [(1.0, float("nan")), (float("nan"), 1.0)])
def test_what_is_no_number_is_never_the_best(values):
    assert np.isnan(worst_of(*values)) and np.isnan(worst_of(iter(values)))
    assert worst_of(1.0, 3.0) == worst_of([1.0, 3.0]) == 3.0


def test_a_map_that_is_worse_is_told():
    def cells(verdict):
        return {"row": {"mpm": {"verdict": verdict, "value": 1.0, "message": ""}}}

    assert not stability_map.worse(cells("degrades"), cells("degrades"))
    assert not stability_map.worse(cells("holds"), cells("stops"))
    assert not stability_map.worse(cells("degrades"), {})
    assert stability_map.worse(cells("stops"), cells("degrades"))
    assert stability_map.worse(cells("degrades"), cells("holds"))
    assert stability_map.worse(cells("wrong"), cells("wrong"))
    assert stability_map.worse(cells(""), cells("holds"))
    assert stability_map.worse({}, cells("holds"), whole=True) and not stability_map.worse({}, cells("holds"))
    assert stability_map.worse(cells("holds"), {}, whole=True)


def test_the_script_exits_with_one_if_a_cell_is_worse_and_else_with_zero(tmp_path, monkeypatch):
    name = next(iter(ROWS))
    better = {size: {name: {key: {**cell, "verdict": "holds"} for key, cell in STORED[size][name].items()}}
              for size in SIZES}
    monkeypatch.setattr(stability_map, "measured", lambda jobs, quick, workers: {
        name: {key: {**cell, "verdict": "stops", "seconds": 0.0} for key, cell in STORED["quick"][name].items()}})
    store = tmp_path / "stability.json"
    store.write_text(json.dumps(better))
    monkeypatch.setattr(stability_map, "STORE", store)
    assert stability_map.main(["--quick", "--only", name]) == 1
    store.write_text("{}")
    assert stability_map.main(["--quick", "--only", name]) == 0
