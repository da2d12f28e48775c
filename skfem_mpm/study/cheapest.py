"""The cheapest choice for a tolerance, found by a few small runs and verified by running it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import check_choice, check_counts, check_positive
from .choices import Choice, changes, crossed, distinct, key, label
from .problems import Problem, find_problem
from .store import Row
from .trade import COSTS, Progress, Study, tradeoff
from .trend import Trend

TRIES = 12                 # runs beyond the pilots
MORE = 4                   # how much finer than the finest pilot a grid may get, if nothing is said


@dataclass(frozen=True)
class Smaller:
    """What a smaller model would give, with the recommended choice.

    Attributes
    ----------
    name, change
        What it is, and the arguments that make it (``None`` for one that is left out).
    error, cost
        Measured; not a number if it cannot be run.
    would_do
        Whether it is as good: within the tolerance, or no worse.
    reason
        Why it cannot be run, if so.
    """

    name: str
    change: Choice
    error: float
    cost: float
    would_do: bool
    reason: str = ""

    def __str__(self) -> str:
        if self.reason:
            return f"{self.name} cannot be run: {self.reason[:160]}"
        verdict = "would do" if self.would_do else "would not do"
        return f"{self.name} {verdict}: error {self.error:.3g}, cost {self.cost:.3g}"


@dataclass(frozen=True)
class Recommendation:
    """The answer of :func:`cheapest`; printed, it says all this in words.

    Attributes
    ----------
    reached
        Whether some choice has an error within the tolerance.
    choice
        Its arguments, the number of cells among them; the best one that was run if none is within.
    predicted
        ``error`` and ``cost`` expected of it before it was run with so many cells; of a pilot, what the pilot gave.
    row
        What was measured in the end, as in :class:`~skfem_mpm.study.Study`.
    tolerance, quantity, cost
        What was asked for.
    notes
        Why choices fall out, and what to be careful about.
    smaller
        What smaller models would give.
    rows
        All that was run.
    """

    reached: bool
    choice: Choice
    predicted: Mapping[str, float]
    row: Row
    tolerance: float
    quantity: str
    cost: str
    notes: tuple[str, ...]
    smaller: tuple[Smaller, ...]
    rows: tuple[Row, ...]

    def __str__(self) -> str:
        error = self.row.get(f"error_{self.quantity}", np.nan)
        unit = "MB" if self.cost == "memory_mb" else "s"
        head = f"{label(self.choice)}, cells={self.choice['cells']}"
        if not self.reached:
            head = f"not reachable: {self.tolerance:.3g}; the best that was run is {head}"
        lines = [head, f"  error {error:.3g} (predicted {self.predicted['error']:.3g}), {self.row[self.cost]:.3g} "
                       f"{unit} (predicted {self.predicted['cost']:.3g})"]
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines + [f"  {each}" for each in self.smaller])


def cheapest(scene: Any, tolerance: float, quantity: str | None = None, *, choices: Iterable[Choice] | None = None,
             pilots: Sequence[int] | None = None, most: int | None = None,
             simpler: Mapping[str, Choice] | None = None, cost: str = "cpu_s", repeats: int = 3,
             out: str | Path | None = None, progress: Progress | None = None, **fixed: Any) -> Recommendation:
    """The cheapest choice whose error is within a tolerance.

    Every choice is run on a few coarse grids.  From powers fitted to its errors and costs follows how many cells it
    needs and what that costs; the choice that promises to be cheapest is run with so many cells, what is measured
    takes the place of the promise, and so on until the cheapest one is a measured one.

    Parameters
    ----------
    scene
        As for :func:`tradeoff`.
    tolerance
        Largest error.
    quantity
        Which error; the problem's own, or the first one, if not given.
    choices
        Ways to compute to choose from; the problem's if not given.  Those that warn are left out, unless all do.
    pilots
        Numbers of cells of the first runs, at least two; the first three of the problem if not given.  Coarser grids
        than these are not considered.
    most
        Largest number of cells to consider; four times the finest pilot if not given.
    simpler
        Smaller models to compare with, as arguments by name, such as ``{"elastic": {"material": LinearElastic(...)}}``;
        those of the problem if not given.  An argument that is ``None`` is left out.
    cost
        What is to be least: ``cpu_s``, which other work on the machine disturbs least, ``wall_s`` or ``memory_mb``.
    repeats
        Timed runs of the recommended choice.
    out
        Folder in which all runs are kept, as ``cheapest.json`` and ``cheapest.csv``; what is there is not run again.
    progress
        Wraps the runs to come, as ``tqdm.tqdm`` does.
    fixed
        Other arguments that all choices share, such as ``steps=1``.

    Raises
    ------
    ValueError, TypeError
        If an argument does not fit, or no pilot can be run.

    Examples
    --------
    >>> answer = cheapest("cylinder", 0.05, steps=1, dim=1, choices=[{"method": "mpm"}, {"method": "gc"}],
    ...                   pilots=[5, 10], simpler={}, repeats=1)
    >>> answer.reached, answer.row["error_all"] <= 0.05
    (True, True)
    """
    problem = find_problem(scene)
    models = problem.simpler if simpler is None else simpler
    if not isinstance(models, Mapping):
        raise TypeError(f"simpler: got {models!r}, expected arguments by name such as {{'elastic': {{...}}}}.")
    check_positive("tolerance", tolerance)
    check_choice("cost", cost, COSTS)
    check_positive("repeats", repeats)
    pilots = sorted(set(problem.cells[:3] if pilots is None else pilots))
    ways = distinct({**way, **fixed} for way in crossed(problem.choices if choices is None else choices))
    most = _check_sizes(pilots, most, ways)
    search = _Search(problem, float(tolerance), quantity or problem.quantity, cost, most,
                     {"name": "cheapest", "out": out, "progress": progress, "memory": cost == "memory_mb"})
    study = search.pilot(ways, pilots)
    search.warn_of_reference(study.known(search.quantity))
    choice, predicted = search.best()
    row, = search.run([choice], repeats).rows
    reached = search.error(row) <= search.tolerance
    smaller = tuple(search.compare(name, change, choice, row, repeats) for name, change in models.items()
                    if changes(problem.make, choice, change))
    return Recommendation(reached, choice, predicted, row, search.tolerance, search.quantity or "", cost,
                          tuple(search.notes), smaller, tuple(search.rows))


def _check_sizes(pilots: Sequence[int], most: int | None, ways: Sequence[Choice]) -> int:
    """The largest number of cells to consider."""
    given = [way["cells"] for way in ways if "cells" in way]
    if given:
        raise ValueError(f"cells: got {given[0]!r}, but the number of cells is what is looked for; give pilots and "
                         "most.")
    if len(pilots) < 2:
        raise ValueError(f"pilots: got {pilots}, expected at least two numbers of cells, from which to go on.")
    for name, number in [("pilots", each) for each in pilots] + [("most", pilots[-1] if most is None else most)]:
        check_counts({name: (number, 1)})
    if most is not None and most < pilots[-1]:
        raise ValueError(f"most: got {most}, expected at least the finest pilot, {pilots[-1]}; give coarser pilots.")
    return MORE * pilots[-1] if most is None else most


@dataclass
class _Way:
    """A way to compute, and its rows by number of cells; no others are run if it has ``stopped``."""

    choice: Choice
    done: dict[int, Row]
    stopped: bool = False

    @property
    def warnings(self) -> str:
        """What its last run that warned said; nothing if none did."""
        return next((text for row in reversed(self.done.values()) if (text := row.get("warnings"))), "")


class _Search:
    """Runs so far, and what they promise."""

    def __init__(self, problem: Problem, tolerance: float, quantity: str | None, cost: str, most: int,
                 how: dict[str, Any]):
        self.problem, self.tolerance, self.quantity, self.cost, self.most = problem, tolerance, quantity, cost, most
        self.how = how
        self.rows: list[Row] = []
        self.notes: list[str] = []
        self.ways: list[_Way] = []

    def run(self, choices: Sequence[Choice], repeats: int = 1) -> Study:
        """Rows of choices, which have their cells."""
        study = tradeoff(self.problem, choices=choices, repeats=repeats, **self.how)
        self.rows += study.rows
        return study

    def error(self, row: Row) -> float:
        """The error that counts; not a number if the run failed or does not have it."""
        return row.get(f"error_{self.quantity}", np.nan) if row["status"] == "done" else np.nan

    def pilot(self, choices: Sequence[Choice], pilots: Sequence[int]) -> Study:
        """The first runs of every way to compute; those of which none can be used fall out, and those that warn."""
        study = self.run([{**choice, "cells": cells} for choice in choices for cells in pilots])
        if study.quantities:
            self.quantity = study.error_name(self.quantity)[len("error_"):]
        rows = iter(study.rows)
        for choice in choices:
            mine = {cells: next(rows) for cells in pilots}
            way = _Way(choice, {cells: row for cells, row in mine.items() if self._usable(row)})
            missing = [cells for cells in pilots if cells not in way.done]
            if way.done:
                self.ways.append(way)
            if missing:
                what = f"lacks pilots {missing}" if way.done else "falls out"
                self.notes.append(f"{label(choice)} {what}: {self._why(mine[missing[-1]])}")
        if not self.ways:
            raise ValueError("choices: got none that can be run; " + "; ".join(self.notes))
        self._set_aside()
        return study

    def _set_aside(self) -> None:
        """Leave out ways to compute that warn, but if all do: whatever their error here, they are not to be trusted."""
        trusted = [way for way in self.ways if not way.warnings]
        what = "falls out" if trusted else "warns"
        self.notes += [f"{label(way.choice)} {what}: {way.warnings[:160]}" for way in self.ways if way.warnings]
        self.ways = trusted or self.ways

    def warn_of_reference(self, known: float) -> None:
        """A reference that is not exact may be further off than the tolerance."""
        if known > self.tolerance:
            self.notes.append(f"the scene's reference may itself be off by {known:.2g}, more than the tolerance: "
                              "smaller errors are agreement with it, no more")

    def _usable(self, row: Row) -> bool:
        return bool(np.isfinite(self.error(row)) and np.isfinite(row[self.cost]))

    def _why(self, row: Row) -> str:
        """Why a row cannot be used."""
        missing = self.cost if np.isfinite(self.error(row)) else f"its error {self.quantity!r}"
        return row["reason"][:160] or f"{missing} is not a finite number"

    def trend(self, way: _Way) -> Trend:
        """Error and cost of one way to compute over its numbers of cells."""
        rows = way.done.values()
        return Trend(list(way.done), [self.error(row) for row in rows], [row[self.cost] for row in rows])

    def best(self) -> tuple[Choice, dict[str, float]]:
        """The choice to recommend, which was run, and what was predicted of it."""
        predicted: dict[str, dict[str, float]] = {}
        for _ in range(TRIES):
            promising = self._promising()
            if promising is None:
                break
            way, cells = promising
            choice, trend = {**way.choice, "cells": cells}, self.trend(way)
            promise = predicted.setdefault(key(choice), {"error": trend.error_at(cells), "cost": trend.cost_at(cells)})
            if cells in way.done:
                self._warn(trend, cells)
                return choice, promise
            self._try(way, choice)
        return self._within() or self._closest()

    def _try(self, way: _Way, choice: Choice) -> None:
        """Put what is measured in the place of what was promised."""
        row, = self.run([choice]).rows
        if self._usable(row):
            way.done[choice["cells"]] = row
        else:
            way.stopped = True
            self.notes.append(f"{label(choice)} goes no further: with {choice['cells']} cells {self._why(row)}")

    def _promising(self) -> tuple[_Way, int] | None:
        """The way that promises to be the cheapest one within the tolerance, and how many cells it needs."""
        offers: list[tuple[float, int, int]] = []
        for index, way in enumerate(self.ways):
            trend = self.trend(way)
            cells = trend.needed(self.tolerance)
            if cells is not None and way.stopped:               # what it has, if that will do
                cells = min((each for each in way.done if each >= cells), default=None)
            if cells is not None and cells <= self.most:
                offers.append((trend.cost_at(cells), index, cells))
        return (self.ways[min(offers)[1]], min(offers)[2]) if offers else None

    def _warn(self, trend: Trend, cells: int) -> None:
        if cells != trend.cells[0] and not trend.asymptotic:
            self.notes.append("its runs are not in the asymptotic range (orders " + _orders(trend) + "): do not expect "
                              "the error to go on falling")

    def _measured(self) -> list[tuple[float, float, int, int]]:
        """Cost, error, way and cells of every run that can be used, the cheapest first."""
        return sorted((row[self.cost], self.error(row), index, cells) for index, way in enumerate(self.ways)
                      for cells, row in way.done.items())

    def _within(self) -> tuple[Choice, dict[str, float]] | None:
        """The cheapest run within the tolerance, where no trend leads to one."""
        for cost, error, index, cells in self._measured():
            if error <= self.tolerance:
                self.notes.append("this run is within the tolerance, but its trend (orders "
                                  f"{_orders(self.trend(self.ways[index]))}) does not say why: luck perhaps")
                return {**self.ways[index].choice, "cells": cells}, {"error": error, "cost": cost}
        return None

    def _closest(self) -> tuple[Choice, dict[str, float]]:
        """The run with the smallest error, after a word on why no way gets there."""
        for way in self.ways:
            if not way.stopped:
                self.notes.append(f"{label(way.choice)} {self._why_not(way)}")
        cost, error, index, cells = min(self._measured(), key=lambda run: run[1])
        return {**self.ways[index].choice, "cells": cells}, {"error": error, "cost": cost}

    def _why_not(self, way: _Way) -> str:
        """Why a way to compute does not get within the tolerance."""
        trend = self.trend(way)
        needed, orders = trend.needed(self.tolerance), f"(orders {_orders(trend)})"
        if len(way.done) < 2:
            return "has one run only, which tells no order"
        if needed is None:
            return f"stalls {orders}"
        why = (f"would need some {needed:.3g} cells, more than {self.most}" if needed > self.most else
               f"was not found within {TRIES} runs")
        return why if trend.asymptotic else f"{why}; but its runs are not in the asymptotic range {orders}"

    def compare(self, name: str, change: Choice, choice: Choice, row: Row, repeats: int) -> Smaller:
        """What a smaller model gives instead of the recommended choice."""
        smaller = {key: value for key, value in {**choice, **change}.items() if value is not None}
        other, = self.run([smaller], repeats).rows
        if not self._usable(other):
            return Smaller(name, change, np.nan, np.nan, False, self._why(other))
        error = self.error(other)
        good = error <= max(self.tolerance, 1.01 * self.error(row))
        return Smaller(name, change, error, other[self.cost], bool(good))


def _orders(trend: Trend) -> str:
    return ", ".join(f"{order:.2g}" for order in trend.orders) or "none"
