"""docs/results.md says what the stored studies say, and these hold what is claimed of them."""

import csv
import runpy
from pathlib import Path

import pytest

from skfem_mpm import study

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "data"
SCRIPT = runpy.run_path(str(ROOT / "benchmarks" / "results.py"))
STUDIES = {name: study.load(DATA, f"tradeoff_{name}") for name in SCRIPT["PAGES"]}


def test_the_page_is_what_its_script_makes_of_the_tables():
    assert SCRIPT["page_of"](STUDIES, DATA) == (ROOT / "docs" / "results.md").read_text()


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_is_complete_and_undisturbed(name):
    page, found = SCRIPT["PAGES"][name], STUDIES[name]
    problem = study.PROBLEMS[page.scene]
    assert found.about["scene"] == problem.name
    assert len(found.rows) == len(problem.choices) * len(problem.cells)
    for row in found.rows:
        assert row["status"] == "done" and row["repeats"] == page.repeats, row
        assert row["wall_s_least"] <= row["wall_s"] <= row["wall_s_most"]
        assert row["wall_s"] < 1.2 * row["cpu_s"] + 0.01        # the processor had nothing else to do


def test_the_best_choice_is_a_hundred_times_better_than_mpm_on_its_finest_grid_in_no_more_time():
    rows = STUDIES["cylinder_50"].rows
    plain = next(row for row in rows if STUDIES["cylinder_50"].label(row) == "mpm" and row["cells"] == 80)
    best = min(row["error_all"] for row in rows if row["wall_s"] <= plain["wall_s"])
    assert 100 * best <= plain["error_all"]


def test_what_cheapest_recommends_is_verified_and_at_most_half_as_much_again_as_the_best_of_the_full_study():
    with (DATA / "cheapest.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], float(row["tolerance"])) for row in rows] == [
        (scene, tolerance) for scene in ("cylinder", "column", "bar") for tolerance in (0.1, 0.01, 0.001)]
    for row in rows:
        assert (row["reached"] == "True") == (float(row["error"]) <= float(row["tolerance"]))
        assert row["reached"] == "True" or not row["best_of_full_study"]
        assert not row["ratio"] or float(row["ratio"]) <= 1.5
