"""Is `study.cheapest` right?  Its answers beside the cheapest rows of the full studies of docs/results.md.

    python benchmarks/cheapest.py                   docs/data/cheapest.csv, three minutes on a quiet machine
    python benchmarks/cheapest.py --out FILE.csv
    python benchmarks/cheapest.py --overhead        what a study itself takes, beside the runs

Seconds of both are those of the processor.  Rows of a full study that took up to 1.3 times its cheapest are timed again
beside the answer, and the cheapest of these is taken: on the same machine, in the same minutes, and not by chance.
"""

import argparse
import csv
import json
import tempfile
import time
from pathlib import Path

from skfem_mpm import study
from skfem_mpm.study.runs import compiled

DATA = Path(__file__).parents[1] / "docs" / "data"
SCENES = {"cylinder": "cylinder_50", "column": "column", "bar": "bar"}
TOLERANCES = (0.1, 0.01, 0.001)


def again(scene, full, tolerance, name):
    """The cheapest row of the full study within the tolerance, of those that come near to it; ``None`` without any."""
    rows = [row for row in full.rows if row["status"] == "done" and row[name] <= tolerance]
    if not rows:
        return None
    near = [row for row in rows if row["cpu_s"] <= 1.3 * min(each["cpu_s"] for each in rows)]
    choices = [{each: row[each] for each in full.about["arguments"] if row.get(each) is not None} for row in near]
    return min(study.tradeoff(scene, choices=choices, repeats=5, memory=False).rows, key=lambda row: row["cpu_s"])


def compare(scene, folder):
    """Rows of the table for one scene."""
    full = study.load(DATA, f"tradeoff_{SCENES[scene]}")
    name = f"error_{study.PROBLEMS[scene].quantity}"
    for tolerance in TOLERANCES:
        answer = study.cheapest(scene, tolerance, out=folder / scene, repeats=5)
        best = again(scene, full, tolerance, name)
        print(answer, "" if best is None else f"  the full study's: {full.label(best)}, cells={best['cells']}, "
              f"{best['cpu_s']:.3g} s", sep="\n", flush=True)
        words = ", ".join(f"{key}={value}" for key, value in answer.choice.items() if key not in ("method", "cells"))
        yield {"scene": scene, "tolerance": tolerance, "reached": answer.reached,
               "choice": ", ".join(filter(None, [str(answer.choice.get("method", "")), words])),
               "cells": answer.choice["cells"], "predicted": answer.predicted["error"], "error": answer.row[name],
               "seconds": answer.row["cpu_s"], "best_of_full_study": "" if best is None else full.label(best),
               "its_cells": "" if best is None else best["cells"],
               "its_seconds": "" if best is None else best["cpu_s"],
               "ratio": "" if best is None else answer.row["cpu_s"] / best["cpu_s"]}


def overhead(repeats=20):
    """Share of a study's time that is not in its runs; the first, untimed one of each choice apart."""
    given = {"scene": "cylinder", "methods": ["mpm", "gimp", "gc"], "cells": [10, 20], "steps": [10], "memory": False}
    with tempfile.TemporaryDirectory() as folder:
        study.tradeoff(**given, repeats=1, out=folder)
        start = time.perf_counter()
        study.tradeoff(**given, repeats=repeats + 1, out=folder)
        total = time.perf_counter() - start
        rows = json.loads((Path(folder) / "tradeoff.json").read_text())["rows"]
    inside = sum(each["setup_s"] + each["wall_s"] for row in rows for each in row["times"][1:])
    start = time.perf_counter()
    for row in rows:
        compiled(study.PROBLEMS["cylinder"].make, row["choice"])
    first = time.perf_counter() - start
    print(f"{len(rows)} choices, {repeats} runs of each: {total:.2f} s; runs {inside:.2f} s, first steps, "
          f"not counted, {first:.2f} s; the rest is {100 * (total - first - inside) / inside:.1f} %")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DATA / "cheapest.csv", help="the table")
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--overhead", action="store_true", help="this instead")
    options = parser.parse_args()
    if options.overhead:
        return overhead()
    with tempfile.TemporaryDirectory() as folder:
        rows = [row for scene in options.only for row in compare(scene, Path(folder))]
    with options.out.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
