"""Errors of the ways to integrate stress, for scenes with exact solutions; the tables and figures of docs/field.md.

    python benchmarks/accuracy.py --quick                   coarse grids, half a minute
    python benchmarks/accuracy.py --out docs/data           all tables; the finest grids take most of an hour
    python benchmarks/accuracy.py --only ring --out docs/data
    python benchmarks/accuracy.py --draw docs/figures --out docs/data       figures from these tables, no tables

Each table is written as accuracy_NAME.csv: errors are rms over points relative to the largest exact value, of the
deviatoric stress in the cylinder and of the stress tensor elsewhere.
"""

import argparse
import csv
import platform
import time
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from skfem_mpm import NotConvergedError
from skfem_mpm.scenes import block, column, cylinder, ring

CHOICES = {
    "mpm": {"method": "mpm"},
    "gimp": {"method": "gimp"},
    "gimp, stretched": {"method": "gimp", "domains": "stretched"},
    "gc, stretched": {"method": "gc", "domains": "stretched"},
    "field": {"method": "cmpm", "integration": "field"},
    "field2": {"method": "cmpm", "integration": "field2"},
    "cubic": {"integration": "cubic"},
    "twin": {"integration": "twin"},
    "twin2": {"integration": "twin2"},
    "dual": {"integration": "dual"},
    "field2, gc": {"method": "gc", "domains": "stretched", "integration": "field2"},
    "dual, gimp": {"method": "gimp", "domains": "stretched", "integration": "dual"},
}
# Those of the costly scenes, the most telling ones first.
PLANE = ("dual", "gimp", "mpm", "dual, gimp", "twin", "twin2", "field2", "gimp, stretched")
GHOST = 0.1


class Table:
    """Rows of a table, printed and written as they come."""

    def __init__(self, out, name, head):
        self.rows, self.file = [], None if out is None else (out / f"accuracy_{name}.csv").open("w", newline="")
        self.write(head)

    def write(self, row):
        cells = [f"{entry:.4g}" if isinstance(entry, float) else entry for entry in row]
        print(*cells, sep="\t", flush=True)
        if self.file:
            csv.writer(self.file, lineterminator="\n").writerow(cells)
            self.file.flush()

    def add(self, *row):
        self.rows.append(row)
        self.write(row)


def history(scene, choice, steps, **more):
    """Errors after each step; not a number from where a run stops."""
    found = {"all": np.full(steps, np.nan), "inner": np.full(steps, np.nan)}
    try:
        for state in scene.run(steps=steps, **CHOICES[choice], **more):
            for name, value in scene.errors(state).items():
                if name in found:
                    found[name][state.step - 1] = value
    except NotConvergedError as failure:
        print(f"# {choice}: {str(failure)[:90]}", flush=True)
    return found


# -- one dimension ----------------------------------------------------------------------------------------------------

def refined(out, name, scenes, choices=tuple(CHOICES)):
    """Errors under refinement, ``scenes`` by cell size; with the orders of the last halving."""
    table = Table(out, name, ["choice", "h", "step 1", "step 10", "step 50", "worst step"])
    for choice in choices:
        found = []
        for h, scene in scenes.items():
            error = history(scene, choice, 50)["all"]
            found.append((error[0], error[9], error[49], error.max()))
            table.add(choice, h, *map(float, found[-1]))
        orders = np.log2(np.array(found[-2]) / found[-1])
        print(f"# {choice}: orders", *np.round(orders, 2))


def table_cylinder(quick, out):
    cells = (10, 20, 40) if quick else (10, 20, 40, 80)
    refined(out, "cylinder", {2 / n: cylinder(n, dim=1) for n in cells})


def table_column(quick, out):
    sizes = (0.1, 0.05, 0.025) if quick else (0.1, 0.05, 0.025, 0.0125)
    refined(out, "column", {h: column(h, dim=1) for h in sizes})


def table_offsets(quick, out):
    """The worst of 50 steps and of all places of the wall in its cell."""
    offsets = np.linspace(0, 0.95, 5 if quick else 21)
    table = Table(out, "offsets", ["choice", "points per cell", "worst", "at offset", "median"])
    for choice in ("cubic", "dual", "field2", "twin2", "twin", "gimp, stretched"):
        for per_cell in (1, 2, 3):
            worst = np.array([history(cylinder(20, dim=1, per_cell=per_cell, offset=float(offset)), choice, 50)
                              ["all"].max() for offset in offsets])
            table.add(choice, per_cell, float(worst.max()), float(offsets[worst.argmax()]), float(np.median(worst)))


# -- two and three dimensions -----------------------------------------------------------------------------------------

def cut_scene(out, name, scenes, choices=PLANE, steps=(1, 10, 20), only=None):
    """Errors of all and of inner points, ``scenes`` by what comes first in a row."""
    head = [f"{which}, step {step}" for which in ("all", "inner") for step in steps]
    table = Table(out, name, ["choice", "rotation", "h", *head])
    for h in sorted({h for _, h in scenes}, reverse=True):
        for choice, rotation in product(choices, [turn for turn, size in scenes if size == h]):
            found = history(scenes[rotation, h](), choice, steps[-1], ghost=GHOST)
            errors = [float(found[which][step - 1]) for which in ("all", "inner") for step in steps]
            table.add(choice, rotation, h, *errors)


def table_block(quick, out):
    cases = [(turn, h) for h in ((0.1,) if quick else (0.1, 0.05, 0.025)) for turn in (20, 45, 0, 30)]
    cut_scene(out, "block", {(turn, h): lambda turn=turn, h=h: block(h, rotation=turn) for turn, h in cases})


def table_ring(quick, out):
    sizes = (0.1,) if quick else (0.1, 0.05, 0.025)
    cut_scene(out, "ring", {("", h): lambda h=h: ring(h) for h in sizes})


def table_solid(quick, out):
    """The block in three dimensions."""
    cut_scene(out, "solid", {(20, 0.25): lambda: block(0.25, dim=3, rotation=20, slide=0.25, steps=10)},
              ("dual", "gimp", "mpm", "twin"), (1, 2) if quick else (1, 5, 10))


TABLES = {"cylinder": table_cylinder, "column": table_column, "offsets": table_offsets, "ring": table_ring,
          "block": table_block, "solid": table_solid}


# -- figures ----------------------------------------------------------------------------------------------------------

def read(folder, name):
    """Rows of a table as dictionaries."""
    with (folder / f"accuracy_{name}.csv").open() as file:
        return list(csv.DictReader(file))


def lines(axes, rows, column, shown):
    """Error over cell size, a line for each choice, and slopes 1 and 2."""
    for number, choice in enumerate(shown):
        pairs = sorted((float(row["h"]), float(row[column])) for row in rows if row["choice"] == choice)
        if pairs:
            axes.loglog(*zip(*pairs), marker="osv^D<>p"[number % 8], ms=4, lw=1.2, color=f"C{number}", label=choice)
    low, high = axes.get_xlim()
    bottom = axes.get_ylim()[0]
    ends = np.array([low * 1.15, high / 1.15])
    for slope, style in ((1, ":"), (2, "--")):
        axes.loglog(ends, 0.8 * bottom * (ends / ends[0]) ** slope, style, color="0.5", lw=0.9, label=f"slope {slope}")
    sizes = sorted({float(row["h"]) for row in rows})
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axes.minorticks_off()
    axes.set_xlabel("h / m")
    axes.grid(alpha=0.3)


def draw_cylinder(folder, out):
    rows = read(folder, "cylinder")
    shown = ["mpm", "gimp", "gimp, stretched", "twin", "dual", "twin2", "field2", "cubic"]
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
    for axes, when in zip(panels, ("step 50", "worst step")):
        lines(axes, rows, when, shown)
        axes.set_title(f"cylinder, {when}", fontsize=10)
    panels[0].set_ylabel("rms error of q / largest q")
    figure.legend(*panels[1].get_legend_handles_labels(), fontsize=8, loc="outside right center")
    figure.savefig(out / "accuracy_cylinder.png", dpi=130)


def draw_cut(folder, out):
    shown = ["mpm", "gimp", "gimp, stretched", "twin", "twin2", "field2", "dual", "dual, gimp"]
    ringed, blocks = read(folder, "ring"), read(folder, "block")
    panels = [("ring", ringed)] + [(f"block, {turn} degrees", [row for row in blocks if row["rotation"] == turn])
                                   for turn in ("0", "20", "45")]
    figure, places = plt.subplots(1, len(panels), figsize=(13, 4), sharey=True, layout="constrained")
    for axes, (title, rows) in zip(places, panels):
        lines(axes, rows, "all, step 20", shown)
        axes.set_title(f"{title}, step 20, all points", fontsize=10)
    places[0].set_ylabel("rms error of stress / largest stress")
    handles = {label: handle for axes in places for handle, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), fontsize=8, loc="outside right center")
    figure.savefig(out / "accuracy_block_ring.png", dpi=130)


def draw_field(folder, out, h=0.05):
    """Radial stress at the points of the ring in the end, exact and found, and its error."""
    figure, places = plt.subplots(2, 4, figsize=(13, 6.2), sharex=True, sharey=True, layout="constrained")
    for (upper, lower), choice in zip(places.T, (None, "mpm", "gimp", "dual")):
        scene = ring(h)
        x, exact = scene.exact(scene.steps)
        outwards = scene.particles.x / np.hypot(*scene.particles.x)
        if choice:
            *_, state = scene.run(ghost=GHOST, **CHOICES[choice])
            x, stress, error = state.particles.x, state.particles.stress, scene.error(state)
        radial, right = (np.einsum("in,ijn,jn->n", outwards, each[:2, :2], outwards) / 1e3
                         for each in (stress if choice else exact, exact))
        most = np.abs(right).max()
        first = upper.scatter(*x, c=radial, s=5, cmap="viridis", vmin=-1.1 * most, vmax=0.1 * most)
        upper.set_title(f"{choice}: {100 * error:.2g} %" if choice else "exact", fontsize=11)
        upper.set_aspect("equal")
        if choice:
            second = lower.scatter(*x, c=100 * (radial - right) / most, s=5, cmap="RdBu_r", vmin=-15, vmax=15)
            lower.set_aspect("equal")
    places[1, 0].axis("off")
    figure.colorbar(first, ax=places[0], label="radial stress / kPa", shrink=0.9)
    figure.colorbar(second, ax=places[1], label="error / % of the largest", shrink=0.9)
    figure.savefig(out / "ring_field.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer and coarser grids")
    parser.add_argument("--out", type=Path, help="folder of the tables")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE",
                        help="which tables: " + ", ".join(TABLES))
    parser.add_argument("--draw", type=Path, help="folder of the figures, drawn from the tables in --out; no tables")
    options = parser.parse_args()
    if options.draw and not options.out:
        parser.error("--draw: tell where the tables are by --out.")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    print(f"# {platform.machine()}, Python {platform.python_version()}, {time.strftime('%Y-%m-%d')}")
    for draw in (draw_cylinder, draw_cut, draw_field) if options.draw else ():
        draw(options.out, options.draw)
    for each in () if options.draw else options.only:
        print(f"# {each}")
        TABLES[each](options.quick, options.out)
    print(f"# {time.perf_counter() - start:.0f} s")
