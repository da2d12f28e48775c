"""Error beside cost: every choice run, measured and timed, and which of them nobody beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from ..checks import check_counts
from .choices import SIZES, Choice, crossed, key, label, plain
from .pareto import pareto
from .problems import Problem, find_problem
from .processes import DIED, answers, cores
from .runs import (
    FAILURES,
    check_sendable,
    compiled,
    failed,
    measured,
    measured_apart,
    timed,
    undisturbed,
)
from .store import Row, Store, machine, read, summary

COSTS = ("wall_s", "cpu_s", "memory_mb")
Progress = Callable[[Iterable[Any]], Iterable[Any]]
AHEAD = 1000               # runs handed out to an executor at once


@dataclass(frozen=True)
class Study:
    """What :func:`tradeoff` found.

    Attributes
    ----------
    about
        Scene, machine, versions, threads and date; and how far the scene's reference is ``known``, if it is not exact.
    rows
        One dictionary for each choice: its arguments; ``status`` and ``reason``; ``error_NAME`` for each quantity;
        ``points``, ``steps_done``, ``engine_used``, ``warnings``; ``wall_s`` and ``cpu_s``, medians of ``repeats`` runs
        with ``_least`` and ``_most``; ``setup_s`` and ``compile_s``, which are not in them; ``point_steps_per_s``;
        ``memory_mb``.  What was not measured is not a number.
    """

    about: Mapping[str, Any]
    rows: tuple[Row, ...]

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the errors, those that some row has."""
        names = (name for row in self.rows for name in row if name.startswith("error_"))
        return tuple(dict.fromkeys(name[len("error_"):] for name in names))

    def column(self, name: str) -> ndarray:
        """A column as numbers ``(n,)``, not a number where a row has none."""
        values = [row.get(name) for row in self.rows]
        return np.array([np.nan if value is None else value for value in values], dtype=float)

    def front(self, quantity: str | None = None, cost: str = "wall_s") -> list[Row]:
        """Rows that no other beats in both error and cost, the cheapest first.

        Parameters
        ----------
        quantity
            Name of the error; the first one if not given.
        cost
            ``wall_s``, ``cpu_s`` or ``memory_mb``.
        """
        return [self.rows[index] for index in pareto(self.column(cost), self.column(self.error_name(quantity)))]

    def error_name(self, quantity: str | None = None) -> str:
        """Name of the column of a quantity's error."""
        if not self.quantities:
            reason = next((row["reason"] for row in self.rows if row["reason"]), "none was started")
            raise ValueError(f"quantity: got a study in which no run was done ({reason}); look at the reasons in its "
                             "rows.")
        if quantity is not None and quantity not in self.quantities:
            raise ValueError(f"quantity: got {quantity!r}, expected one of {', '.join(map(repr, self.quantities))}.")
        return f"error_{quantity or self.quantities[0]}"

    def known(self, quantity: str | None = None) -> float:
        """How far the reference of a quantity's error may itself be off; zero if it is exact."""
        return self.about.get("known", {}).get(self.error_name(quantity)[len("error_"):], 0.0)

    def table(self, quantity: str | None = None) -> str:
        """The rows as text, the most accurate last: error, seconds with least and most, memory; ``*`` on the front."""
        name = self.error_name(quantity)
        best = [id(row) for row in self.front(quantity)]
        head = ["", "choice", "cells", name, "wall_s", "least", "most", "cpu_s", "MB", "Mpoint-steps/s", ""]
        lines = [[" *"[id(row) in best], self.label(row), *(_short(row.get(each)) for each in (
            "cells", name, "wall_s", "wall_s_least", "wall_s_most", "cpu_s", "memory_mb")),
            _short(row["point_steps_per_s"] / 1e6), "warns" if row.get("warnings") else ""]
            for row in sorted(self.rows, key=lambda row: -np.nan_to_num(row.get(name, np.nan), nan=np.inf))
            if row["status"] == "done"]
        wide = [max(map(len, column)) for column in zip(head, *lines)]
        texts = ["  ".join(cell.ljust(size) if k < 2 else cell.rjust(size) for k, (cell, size) in
                           enumerate(zip(line, wide))).rstrip() for line in [head, *lines]]
        texts += [f"failed: {self.label(row)}, cells={row.get('cells')}: {row['reason']}" for row in self.rows
                  if row["status"] == "failed"]
        return "\n".join(texts)

    def label(self, row: Row) -> str:
        """The way to compute of a row, in a few words, with sizes other than cells in which rows differ."""
        words = label({name: row[name] for name in self.about["arguments"] if row.get(name) is not None})
        sizes = [name for name in SIZES[1:] if len({each.get(name) for each in self.rows}) > 1]
        return ", ".join([words] + [f"{name}={row[name]}" for name in sizes if row.get(name) is not None])


def tradeoff(scene: Any, methods: Sequence[Any] | None = None, cells: Sequence[int] | None = None, *,
             per_cell: Sequence[int] | None = None, weights: Sequence[str] | None = None,
             schemes: Sequence[str] | None = None, integrations: Sequence[Any] | None = None,
             domains: Sequence[str] | None = None, integrators: Sequence[str] | None = None,
             engines: Sequence[str] | None = None, steps: Sequence[int] | None = None,
             more: Mapping[str, Sequence[Any]] | None = None, choices: Iterable[Choice] | None = None,
             repeats: int = 3, memory: bool = True, out: str | Path | None = None, name: str = "tradeoff",
             executor: Executor | None = None, progress: Progress | None = None) -> Study:
    """Run every combination of some choices; their errors beside their seconds and their memory.

    A first, untimed run of each gives the errors and the peak memory.  Timed runs are serial and alone, ``repeats`` of
    them in rounds over all choices, so that a machine that slows down meanwhile does so for all and shows in the
    spread.

    Parameters
    ----------
    scene
        A name of ``study.PROBLEMS`` (``cylinder``, ``column``, ``bar``, ``cut``); or a function that makes a scene of
        your own.  What it makes has ``run(**choices)``, which yields states, and ``measure(states)``, which gives named
        errors of a run, or ``errors(state)`` or ``error(state)``.  Arguments of a choice that the function has go to
        it, the others to ``run``.
    methods, cells, per_cell, weights, schemes, integrations, domains, integrators, engines, steps
        Values to combine, of the arguments ``method``, ``cells``, ... of scene and run; those not given stay as scene
        and run have them, but ``cells``, and ``methods`` without ``choices``, which then are the problem's.
    more
        Values of any other argument, such as ``{"ghost": [0.0, 0.1]}``; of each argument once.
    choices
        Dictionaries of arguments to combine with all of these, such as ``{"method": "gc", "domains": "stretched"}``.
    repeats
        Timed runs of each choice; 0 for none.  One that is not counted, for what is imported and compiled, is before.
    memory
        Whether untimed runs have a process of their own each, whose peak memory is measured; without timed runs as
        many go on at once as there are cores.
    out
        Folder of ``NAME.json`` and ``NAME.csv``, which are whole at every moment; a study that was interrupted goes on
        from there.  What failed stays failed until the files are taken away.
    name
        Of these files.
    executor
        Where untimed runs go instead, if there are to be no timed ones (``repeats=0``); memory is not measured then.
    progress
        Wraps the runs to come, as ``tqdm.tqdm`` does.

    Raises
    ------
    ValueError, TypeError
        If an argument does not fit, or the folder has a study of another scene or machine.

    Examples
    --------
    >>> study = tradeoff("cylinder", ["mpm", "gc"], [5, 10], steps=[1], repeats=1, memory=False)
    >>> len(study.rows), study.quantities[:2]
    (4, ('point', 'all'))
    >>> best = study.front("all")[-1]
    >>> best["method"], best["cells"]
    ('gc', 10)
    """
    problem = find_problem(scene)
    axes = _axes(more or {}, method=methods, cells=cells, per_cell=per_cell, weights=weights, scheme=schemes,
                 integration=integrations, domains=domains, integrator=integrators, engine=engines, steps=steps)
    ways = problem.choices if "method" not in axes else [{}]
    listed = crossed(ways if choices is None else choices, **{"method": None, "cells": problem.cells, **axes})
    _check(problem, listed, repeats, memory, executor)
    if out is not None and ("<lambda>" in problem.name or " at 0x" in problem.name):
        raise ValueError(f"scene: got {problem.name}, whose name does not tell it from others, so a folder cannot say "
                         "whose rows it has; expected a named function, or no folder.")
    store = Store(out, name, {"scene": problem.name, "known": _known(problem, listed), **machine()})
    for choice in listed:
        store.rows.setdefault(key(choice), _empty(choice))
    chosen = [(store.rows[key(choice)], choice) for choice in listed]
    try:
        if executor is not None:
            _spread(problem, chosen, executor, False, store, progress or iter)
        elif memory and not repeats:                # nothing is timed, and each run has a process of its own
            with ThreadPoolExecutor(cores()) as threads:
                _spread(problem, chosen, threads, True, store, progress or iter)
        else:
            _alone(problem, chosen, repeats, memory, store, progress or iter)
    finally:
        store.save(late=True)
    return Study({**store.about, "arguments": _arguments(listed)}, tuple(summary(row) for row, _ in chosen))


def _axes(more: Mapping[str, Sequence[Any]], **own: Sequence[Any] | None) -> dict[str, Sequence[Any]]:
    """Values by the name of the argument, where there are some."""
    given = {name: values for name, values in own.items() if values is not None}
    for name in set(given) & set(more):
        raise ValueError(f"more: got values of {name!r}, which has an argument of its own; give it once.")
    return {**given, **more}


def _short(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.3g}"
    return "" if value is None else str(value)


def _known(problem: Problem, listed: Sequence[Choice]) -> dict[str, float]:
    """How far the references of all choices may themselves be off at most, by the name of the error."""
    found: dict[str, float] = {}
    for choice in listed:
        for quantity, error in problem.known(choice).items():
            found[quantity] = max(error, found.get(quantity, 0.0))
    return found


def _check(problem: Problem, listed: Sequence[Choice], repeats: int, memory: bool,
           executor: Executor | None) -> None:
    if problem.spans and any("steps" in choice for choice in listed):
        raise ValueError(f"steps: got some for {problem.name!r}, whose runs cover a span of time in as many steps as "
                         "their cells make of it; leave them out.")
    check_counts({"repeats": (repeats, 0)})
    if executor is not None and repeats:
        raise ValueError(f"executor: got one with repeats={repeats}, but timed runs are alone on their machine; "
                         "expected repeats=0.")
    if executor is not None:
        check_sendable(problem.make, "Or leave the executor out.")
    elif memory:
        check_sendable(problem.make, "Or give memory=False.")


def _empty(choice: Choice) -> Row:
    return {"key": key(choice), "choice": {name: plain(value) for name, value in choice.items()}, "status": "",
            "reason": "", "errors": {}, "times": []}


def _arguments(listed: Sequence[Choice]) -> list[str]:
    return list(dict.fromkeys(name for choice in listed for name in choice))


def _alone(problem: Problem, chosen: Sequence[tuple[Row, Choice]], repeats: int, memory: bool, store: Store,
           progress: Progress) -> None:
    """All that is to be done of every row, one after the other: errors in the first round, then times."""
    jobs = [(row, choice, turn) for turn in range(repeats + 1) for row, choice in chosen
            if (_open(row, memory) if turn == 0 else len(row["times"]) < turn)]
    warm: set[str] = set()
    with undisturbed():
        for row, choice, turn in progress(jobs):
            if turn == 0 and memory:
                row.update(measured_apart(problem.make, choice))
            elif turn == 0:
                if repeats:
                    _warm_up(problem, choice, row, warm)
                row.update(measured(problem.make, choice))
            elif row["status"] == "done":
                _time(problem, choice, row, warm)
            store.save()


def _open(row: Row, memory: bool) -> bool:
    """Whether a row is still to be measured, its memory included if that is asked for."""
    return not row["status"] or (memory and row["status"] == "done" and "memory_mb" not in row)


def _warm_up(problem: Problem, choice: Choice, row: Row, warm: set[str]) -> None:
    """Once in this process and not counted: what is imported and compiled for a choice."""
    if row["key"] not in warm:
        warm.add(row["key"])
        try:
            row.setdefault("compile_s", compiled(problem.make, choice))
        except FAILURES as failure:
            row.update(failed(failure))


def _time(problem: Problem, choice: Choice, row: Row, warm: set[str]) -> None:
    """One more timed run; a row whose run fails now has no errors either."""
    try:
        _warm_up(problem, choice, row, warm)
        if row["status"] == "done":
            row["times"].append(timed(problem.make, choice))
    except FAILURES as failure:
        row.update(failed(failure))
    if row["status"] == "failed":
        row.update(errors={}, times=[])


def _spread(problem: Problem, chosen: Sequence[tuple[Row, Choice]], executor: Executor, memory: bool, store: Store,
            progress: Progress) -> None:
    """Errors of every row, and the memory of its run if wanted, wherever the executor works them out."""
    waiting = [index for index, (row, _) in enumerate(chosen) if _open(row, memory)]
    task = partial(_numbered, measured_apart if memory else measured, problem.make, [choice for _, choice in chosen])
    for index, found in progress(answers(executor, task, waiting, AHEAD)):
        chosen[index][0].update(found or {"status": "failed", "reason": DIED})
        store.save()


def _numbered(measure: Any, make: Any, choices: Sequence[Choice], number: int, alone: bool = False) -> dict[str, Any]:
    return measure(make, choices[number])


def load(folder: str | Path, name: str = "tradeoff") -> Study:
    """The study whose files are in a folder.

    Raises
    ------
    ValueError
        If there is none.
    """
    path = Path(folder) / f"{name}.json"
    if not path.exists():
        raise ValueError(f"folder: got {folder}, which has no {path.name}; give the folder a study was written to.")
    about, rows = read(path)
    return Study({**about, "arguments": _arguments([row["choice"] for row in rows.values()])},
                 tuple(map(summary, rows.values())))
