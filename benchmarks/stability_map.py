"""Where does each method hold, degrade or stop?  Measures every cell of the stability map and compares it.

    python benchmarks/stability_map.py              all cells; exits with 1 if one is worse than the committed map
    python benchmarks/stability_map.py --quick      the same rows, smaller or shorter and without remedies, against the
                                                    committed quick map; two minutes
    python benchmarks/stability_map.py --only NAME  rows with NAME in their name
    python benchmarks/stability_map.py --write      stores what it finds as the committed map, and draws the page
    python benchmarks/stability_map.py --draw       no runs: docs/stability.md from the committed map

The committed map is docs/data/stability.json; rows are in benchmarks/extremes/, a family a file.
"""

import argparse
import importlib
import json
import os
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from datetime import date
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from extremes import page
from extremes.row import VERDICTS, evaluate
from tqdm import tqdm

from skfem_mpm.output import write_text

ROOT = Path(__file__).parents[1]
STORE, PAGE = ROOT / "docs" / "data" / "stability.json", ROOT / "docs" / "stability.md"
FAMILIES = ("steps", "places", "scales", "materials", "motion", "long_runs", "equilibrium", "stops")


def families():
    return {name: importlib.import_module(f"extremes.{name}") for name in FAMILIES}


def jobs_of(only, quick):
    """Family, row, method and remedy of every cell."""
    return [(name, number, method, remedy) for name, family in families().items()
            for number, row in enumerate(family.ROWS) if only.lower() in row.name.lower()
            for method, remedy in row.cells(quick)]


def measure(job, quick):
    name, number, method, remedy = job
    row = importlib.import_module(f"extremes.{name}").ROWS[number]
    return row.name, method, remedy, evaluate(row, method, remedy, quick)


def key_of(method, remedy):
    return f"{method}, {remedy}" if remedy else method


def measured(jobs, quick, workers):
    """All cells, ``{row: {method and remedy: cell}}`` in the order of the jobs."""
    os.environ["OMP_NUM_THREADS"] = "1"                     # there is a worker for every core
    found = {}
    with ProcessPoolExecutor(workers) as pool:
        longest_first = sorted(jobs, key=lambda job: job[0] != "long_runs")
        runs = {pool.submit(measure, job, quick): job for job in longest_first}
        for run in tqdm(as_completed(runs), total=len(runs), disable=None):
            found[runs[run]] = run.result()
    table = {}
    for job in jobs:
        row, method, remedy, cell = found[job]
        table.setdefault(row, {})[key_of(method, remedy)] = cell
    return table


def worse(found, known, whole=False):
    """Cells that are worse than they were, wrong without a word, or gone from the ``whole`` map; a line each."""
    lines = [f"{row} | {key}: gone" for row, cells in known.items() for key in cells
             if whole and key not in found.get(row, {})]
    if whole and not known:
        lines.append("there is no committed map to compare with")
    for row, cells in found.items():
        for key, cell in cells.items():
            before = known.get(row, {}).get(key, {}).get("verdict", "")
            if cell["verdict"] == "wrong" or (before and not cell["verdict"]) or (
                    before and VERDICTS.index(cell["verdict"]) > VERDICTS.index(before)):
                lines.append(f"{row} | {key}: {before or 'new'} -> {cell['verdict'] or 'nothing'} "
                             f"{cell['value']} {cell['message']}")
    return lines


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="", metavar="NAME")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--draw", action="store_true")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args(arguments)
    stored = json.loads(STORE.read_text()) if STORE.exists() else {}
    size = "quick" if options.quick else "full"
    if not options.draw:
        began = time.perf_counter()
        jobs = jobs_of(options.only, options.quick)
        found = measured(jobs, options.quick, options.workers)
        seconds = time.perf_counter() - began
        print(page.as_text(found))
        slow = sorted(((cell["seconds"], row, key) for row, cells in found.items() for key, cell in cells.items()),
                      reverse=True)[:5]
        print(f"{len(jobs)} cells in {seconds:.0f} s; the slowest: {slow}")
        lines = worse(found, stored.get(size, {}), whole=not options.only)
        print("\n".join(lines) if lines else f"none is worse than in the committed {size} map.")
        if not options.write:
            return 1 if lines else 0
        known = stored.get(size, {}) if options.only else {}
        order = [row.name for family in families().values() for row in family.ROWS]
        merged = {**known, **found}
        stored[size] = {name: {key: {part: value for part, value in cell.items() if part != "seconds"}
                               for key, cell in merged[name].items()} for name in order if name in merged}
        if not options.only:
            stored.setdefault("about", {})[size] = {
                "date": str(date.today()), "minutes": round(seconds / 60, 1), "cores": options.workers,
                "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"}
        write_text(STORE, json.dumps(stored, indent=1) + "\n")
    write_text(PAGE, page.page_of(families().values(), stored))
    return 0


if __name__ == "__main__":
    sys.exit(main())
