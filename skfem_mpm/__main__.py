"""The command line: studies of the scenes that ship."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import study

LISTS = ("methods", "weights", "schemes", "integrations", "domains", "integrators", "engines")
NUMBERS = ("cells", "per-cell", "steps")
QUICK = {"cylinder": {"steps": [10], "cells": [10, 20]}, "column": {"steps": [10], "cells": [8, 16]},
         "bar": {"cells": [8, 16]}, "cut": {"cells": [5, 10]}}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``skfem-mpm`` with its arguments, those of the command line if none are given; 0 if all went well."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except (ValueError, TypeError, RuntimeError, OSError) as failure:
        print(f"skfem-mpm: {failure}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("skfem-mpm: interrupted; the same command goes on from here", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="skfem-mpm", description="Material points for scikit-fem: what choices cost "
                                                                   "and what they gain.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    trade = commands.add_parser("tradeoff", help="error against cost of many choices, as table and picture")
    trade.set_defaults(command=_tradeoff)
    best = commands.add_parser("cheapest", help="the cheapest choice for a tolerance, verified")
    best.set_defaults(command=_cheapest)
    for each in (trade, best):
        each.add_argument("scene", choices=study.PROBLEMS)
        each.add_argument("--quantity", help="which error; the scene's own if not given")
        each.add_argument("--repeats", type=int, default=3, help="timed runs of each choice (3)")
    for name in LISTS:
        trade.add_argument(f"--{name}", type=_names, metavar="NAME,...")
    for name in NUMBERS:
        trade.add_argument(f"--{name}", type=_whole, metavar="N,...")
    trade.add_argument("--quick", action="store_true", help="coarse grids and few steps, below a minute")
    trade.add_argument("--no-memory", dest="memory", action="store_false", help="do not measure peak memory")
    trade.add_argument("--out", type=Path, help="folder of tradeoff.csv, .json, .png (results/tradeoff/SCENE)")
    best.add_argument("--tolerance", type=float, required=True, help="largest error, such as 0.01")
    best.add_argument("--steps", type=int, help="load steps of cylinder or column; the scene's own if not given")
    best.add_argument("--cost", choices=study.COSTS, default="cpu_s", help="what is to be least (cpu_s)")
    best.add_argument("--out", type=Path, help="folder in which runs are kept, and found again")
    return parser


def _names(text: str) -> list[str]:
    names = [part.strip() for part in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected names with commas between them")
    return names


def _whole(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected whole numbers with commas between them") from None


def _tradeoff(options: argparse.Namespace) -> int:
    import matplotlib
    from tqdm import tqdm

    matplotlib.use("Agg")
    from . import plot

    names = [name.replace("-", "_") for name in (*LISTS, *NUMBERS)]
    axes = {name: values for name in names if (values := getattr(options, name)) is not None}
    out = options.out or Path("results/tradeoff") / options.scene
    if options.quick:
        axes = {**QUICK.get(options.scene, {}), **axes}
    found = study.tradeoff(options.scene, **axes, repeats=options.repeats, memory=options.memory, out=out,
                           progress=_bar(tqdm))
    quantity = options.quantity or study.PROBLEMS[options.scene].quantity
    print(found.table(quantity))
    plot.trade(found, quantity).savefig(out / "tradeoff.png", dpi=130)
    print(f"tradeoff.csv, tradeoff.json and tradeoff.png are in {out}")
    return 0


def _cheapest(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    fixed: dict[str, Any] = {} if options.steps is None else {"steps": options.steps}
    answer = study.cheapest(options.scene, options.tolerance, options.quantity, cost=options.cost,
                            repeats=options.repeats, out=options.out, progress=_bar(tqdm), **fixed)
    print(answer)
    return 0 if answer.reached else 1


def _bar(tqdm: Any) -> Any:
    """A progress bar, where somebody looks at it."""
    return lambda runs: tqdm(runs, disable=not sys.stderr.isatty(), unit="run", leave=False)


if __name__ == "__main__":
    sys.exit(main())
