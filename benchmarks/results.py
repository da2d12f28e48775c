"""Error against cost for the scenes that ship: runs the studies, and writes docs/results.md from what they found.

    python benchmarks/results.py                    all studies, half an hour on a machine that does nothing else
    python benchmarks/results.py --only column      one of them; the others' tables are taken as they are
    python benchmarks/results.py --draw             no runs: figures and page from the tables
    python benchmarks/results.py --quick --out DIR  coarse grids, two minutes, page, tables and figures in DIR

Tables go to docs/data/tradeoff_NAME.csv and .json, figures to docs/figures/tradeoff_NAME.png.  A study that was
interrupted goes on where it was; delete its .json to have it run anew.
"""

import argparse
import csv
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from tqdm import tqdm

from skfem_mpm import plot, study

DOCS = Path(__file__).parents[1] / "docs"
TOLERANCES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001)


@dataclass(frozen=True)
class Page:
    """A study, and what to say about it."""

    title: str
    scene: str
    quantity: str
    about: str                              # what is measured
    words: str                              # what to choose, when
    axes: dict = field(default_factory=dict)
    quick: dict = field(default_factory=dict)
    repeats: int = 3
    beside: tuple = ()                      # other quantities of the finest grid, in a table of their own


PAGES = {
    "cylinder_1": Page(
        "The cylinder, one step", "cylinder", "all",
        "One step of 1.5 cm, points where they start. The error is the rms of q over all points, relative to the "
        "largest q.",
        "Take CMPM strain. Where no point has moved, errors are those of the strain: `cmpm` costs what `mpm` and "
        "`gimp` cost, within the spread, and its error falls with more than the second power of the cell size, "
        "theirs with the first. Patches that are `cubic` at the edges too cost two to three times as much and "
        "gain a digit. Up to 80 cells a step costs the same few hundredths of a second, so refine before anything "
        "else.",
        {"steps": [1]}, {"cells": [10, 20]}),
    "cylinder_50": Page(
        "The cylinder, fifty steps", "cylinder", "all",
        "Fifty steps to equilibrium; the inner wall moves by three quarters of its radius and points cross cells. "
        "The error is that of step 50.",
        "Take `gimp` with `domains=\"stretched\"`, and for the last digit `gc` with them or `field2`. Once points "
        "cross cells, no refinement helps `mpm` and `cmpm`: they stay near a tenth, and Eq. (10) in interior "
        "cells makes that a fiftieth. With boxes of fixed size `gimp` and `gc` stay near a hundredth on every "
        "grid. Boxes that follow the stretch cost next to nothing and converge with order one and a half to two, "
        "as do the fields.",
        {"steps": [50]}, {"cells": [10, 20], "steps": [10]}, repeats=9),
    "column": Page(
        "The column under its own weight", "column", "all",
        "A column that shortens to two thirds in fifty steps. The error is the rms of stress over all points at "
        "the end, relative to the largest.",
        "Take `gc` with stretched boxes, and below a tenth of a percent `field2` with them. Masses must be mapped by "
        "GIMP for that: under gravity they limit `cubic`. `mpm` is off by a seventh whatever the "
        "grid.",
        {}, {"cells": [8, 16], "steps": [10]}),
    "bar": Page(
        "The bar that vibrates in flight", "bar", "stress",
        "A free elastic bar vibrates in its first mode for one period, and flies over a quarter of its length, so "
        "that points cross cells: explicit, MUSL where nothing else is said. The error is the rms of stress over "
        "points and time, relative to its amplitude.",
        "Take `gimp`, with the compiled engine even for 16 points; where that is not installed `mpm`, `gimp` and "
        "`cmpm-c` are alike down to a percent. `mpm` and `cmpm-c` cross cells less smoothly: with MUSL their "
        "errors stop falling at 64 cells. USL cures that for `mpm`, at three times the seconds, for it looks for "
        "its time step anew in every step. `gc` does well for one period, and warns that its waves grow; do not "
        "take it for many.",
        {}, {"cells": [8, 16]}),
    "cut": Page(
        "The vertical cut", "cut", "toe",
        "The cut in softening soil under sudden gravity, 0.3 s in which it fails. The error is the rms over time "
        "of the displacement of the toe, relative to the last, against the reference of [the cut's page](cut.md), "
        "which is extrapolated from fine grids.",
        "Take `gimp` with B-bar. By the toe alone the paper's `cmpm` would win, and it would be wrong to take it: "
        "on the finest grid its energy balance is open by 60 %, for its waves grow (it warns of that). Look at "
        "what else an engineer reads off a run, in the last table: the stress of `mpm` is eight times as rough as "
        "that of `gimp` with B-bar and its balance ten times as wide open, for a toe that is no worse.",
        {}, {"cells": [5, 10]}, beside=("run_out", "failure_time", "dissipation", "roughness", "balance")),
}

# -- text -------------------------------------------------------------------------------------------------------------


def percent(error):
    return f"{two(100 * error)} %"


def two(number):
    """Two digits, or all before the point."""
    return f"{number:.0f}" if number >= 100 else f"{number:.2g}"


def front_table(found, page):
    """The Pareto set, the cheapest first."""
    rows = [["choice", "cells", "error", "seconds (least to most)", "memory / MB"]]
    for row in found.front(page.quantity):
        rows.append([f"`{found.label(row)}`", row["cells"], percent(row[found.error_name(page.quantity)]),
                     f"{row['wall_s']:.3g} ({row['wall_s_least']:.3g} to {row['wall_s_most']:.3g})",
                     two(row["memory_mb"]) if row.get("memory_mb") else "below what starting takes"])
    return markdown(rows)


def cheapest_table(found, page):
    """For round tolerances, the cheapest row that is within."""
    name, rows = found.error_name(page.quantity), [["within", "cheapest choice", "cells", "error", "seconds"]]
    for tolerance in TOLERANCES:
        if tolerance < found.known(page.quantity):     # runs within cannot be told apart
            break
        good = [row for row in found.front(page.quantity) if row[name] <= tolerance]
        if good:
            best = good[0]
            line = [f"`{found.label(best)}`", best["cells"], percent(best[name]), f"{best['wall_s']:.3g}"]
            if not (len(rows) > 1 and rows[-1][1:] == line):
                rows.append([percent(tolerance), *line])
            else:
                rows[-1][0] = percent(tolerance)
    return markdown(rows)


def markdown(rows):
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def beside_table(found, page):
    """All quantities of every way to compute, on its finest grid."""
    if not page.beside:
        return ""
    names = [page.quantity, *page.beside]
    rows = [["choice", "cells", *(name.replace("_", " ") for name in names), "seconds"]]
    finest = max(row["cells"] for row in found.rows)
    for row in found.rows:
        if row["cells"] == finest and row["status"] == "done":
            rows.append([f"`{found.label(row)}`", finest, *(percent(row[f"error_{name}"]) for name in names),
                         f"{row['wall_s']:.2g}"])
    return "On the finest grid, everything that is measured:\n\n" + markdown(rows)


def against_mpm(found, page):
    """How much better the best choice is that takes no longer than plain mpm on its finest grid."""
    name = found.error_name(page.quantity)
    plain = [row for row in found.rows if found.label(row) == "mpm" and row["status"] == "done"]
    if not plain:
        return ""
    finest = max(plain, key=lambda row: row["cells"])
    best = min((row for row in found.rows if row["status"] == "done" and row["wall_s"] <= finest["wall_s"]),
               key=lambda row: row[name])
    if found.known(page.quantity) > finest[name]:
        return ""
    return (f"Plain `mpm` with {finest['cells']} cells takes {finest['wall_s']:.3g} s and is off by "
            f"{percent(finest[name])}. In no more time `{found.label(best)}` with {best['cells']} cells is off by "
            f"{percent(best[name])}, {finest[name] / best[name]:.0f} times less.")


def uncertainty(found, page):
    off = found.known(page.quantity)
    return (f"That reference may itself be off by {percent(off)}: runs whose errors are below that cannot be told "
            "apart." if off else "")


def failures(found):
    lines = [f"`{found.label(row)}` with {row['cells']} cells: {row['reason'][:200]}" for row in found.rows
             if row["status"] == "failed"]
    return "Runs that failed: " + "; ".join(lines) if lines else ""


def section(name, page, found):
    command = f"`python benchmarks/results.py --only {name}`"
    parts = [f"## {page.title}", page.about, page.words,
             f"![error against seconds and against memory](figures/tradeoff_{name}.png)",
             f"{command}; every run is in [tradeoff_{name}.csv](data/tradeoff_{name}.csv).",
             uncertainty(found, page), against_mpm(found, page),
             "The runs that no other beats in both error and seconds:", front_table(found, page),
             "The cheapest for round tolerances:", cheapest_table(found, page),
             beside_table(found, page), failures(found)]
    return "\n\n".join(part if part[0] in "|!" or "\n" in part else textwrap.fill(
        part, 120, break_long_words=False, break_on_hyphens=False) for part in parts if part)


HEAD = """# Results: error against cost

<!-- Written by benchmarks/results.py from docs/data/tradeoff_*.json; edit that script, not this page. -->

Every study here runs each choice on several grids, once untimed for its errors and its peak memory, then three times
(the cylinder of fifty steps nine times) alone on the machine in rounds over all choices. Seconds are by the clock,
without making the scene and without compiling; the least and the most of the runs stand beside the median. How to run
such a study of a scene of your own: [trade](trade.md). The cylinder in more detail: [the cylinder in
numbers](cylinder.md).

Rows whose ranges of seconds overlap cost the same as far as can be seen; which of them stands on the front is chance.
Memory is what a run needs beyond the library, some 110 MB of it the compiled engine where that is used."""


def pilots(data):
    """The table that benchmarks/cheapest.py has written."""
    with (data / "cheapest.csv").open() as file:
        found = list(csv.DictReader(file))
    rows = [["scene", "within", "recommended", "cells", "predicted", "verified", "seconds", "best of the full study",
             "cells", "seconds", "ratio"]]
    for row in found:
        best = [f"`{row['best_of_full_study']}`", row["its_cells"], f"{float(row['its_seconds']):.2g}",
                f"{float(row['ratio']):.2f}"] if row["ratio"] else ["none", "", "", ""]
        name = f"`{row['choice']}`" if row["reached"] == "True" else f"not reachable; best `{row['choice']}`"
        rows.append([row["scene"], percent(float(row["tolerance"])), name, row["cells"],
                     percent(float(row["predicted"])), percent(float(row["error"])), f"{float(row['seconds']):.2g}",
                     *best])
    return "\n\n".join([PILOTS, markdown(rows)])


PILOTS = """## What `cheapest` finds with a few pilots

`python benchmarks/cheapest.py`. `study.cheapest` knows of a scene what its pilots tell, three coarse grids for each
choice. Here its answers stand beside the cheapest row of the full studies above (of those that came within 1.3 times of
the cheapest, all timed again); seconds are those of the processor, timed in the same minutes. Where a pilot is
recommended, what was predicted is what the pilot gave."""


def page_of(studies, data):
    about = next(iter(studies.values())).about
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items() if version)
    machine = (f"Machine: {about['machine']}, {about['system']}, {about['cores']} cores, "
               f"OMP_NUM_THREADS {about['OMP_NUM_THREADS'] or 'not set'}; Python "
               f"{about['python']}, {versions}; {about['date'][:10]}.")
    texts = [HEAD, textwrap.fill(machine, 120)]
    texts += [section(name, PAGES[name], found) for name, found in studies.items()]
    if (data / "cheapest.csv").exists():
        texts.append(pilots(data))
    return "\n\n".join(texts) + "\n"


# -- the work ---------------------------------------------------------------------------------------------------------

def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse grids and few steps")
    parser.add_argument("--only", nargs="+", choices=PAGES, default=list(PAGES), metavar="NAME", help=", ".join(PAGES))
    parser.add_argument("--draw", action="store_true", help="no runs")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder with data, figures and the page")
    options = parser.parse_args()
    if options.quick and options.out == DOCS:
        parser.error("--quick: give another folder by --out; the page has the full studies.")
    data, figures = options.out / "data", options.out / "figures"
    for folder in (data, figures):
        folder.mkdir(parents=True, exist_ok=True)
    for name in () if options.draw else options.only:
        page = PAGES[name]
        axes = {**page.axes, **(page.quick if options.quick else {})}
        study.tradeoff(page.scene, **axes, out=data, name=f"tradeoff_{name}",
                       repeats=3 if options.quick else page.repeats,
                       progress=lambda runs, name=name: tqdm(runs, desc=name, unit="run"))
    studies = {name: study.load(data, f"tradeoff_{name}") for name in PAGES
               if (data / f"tradeoff_{name}.json").exists()}
    for name, found in studies.items():
        plot.trade(found, PAGES[name].quantity).savefig(figures / f"tradeoff_{name}.png", dpi=120)
    (options.out / "results.md").write_text(page_of(studies, data))


if __name__ == "__main__":
    main()
