"""Pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy import ndarray

# One colour per method, the same in every picture; other arguments of a choice choose the marker.
COLOURS = {"mpm": "#4477aa", "gimp": "#ee6677", "cmpm": "#228833", "fe-gimp": "#66ccee", "gc": "#aa3377",
           "cmpm-c": "#ccbb44"}
OTHERS = ("#333333", "#ee8866", "#999933", "#882255")
MARKERS = "os^Dv<>pPX*hd8"


def error_against_cost(axes: Axes, cost: ndarray, error: ndarray, front: Sequence[int], groups: Sequence[str],
                       kinds: Sequence[str], sizes: Sequence[Any] = ()) -> None:
    """Runs as points, those of one way to compute joined in their order, and the runs that nobody beats as a staircase.

    Parameters
    ----------
    axes
        Where to draw; both axes become logarithmic, if there is something to draw.
    cost, error
        ``(n,)``; runs where one is not a number are left out, and errors of zero.
    front
        Indices of the Pareto set.
    groups
        ``(n,)``; what chooses the colour: the method.
    kinds
        ``(n,)``; labels of the ways to compute, of which each has its marker.
    sizes
        ``(n,)``; what stands beside runs of the front, if given.
    """
    cost, error = np.asarray(cost, dtype=float), np.asarray(error, dtype=float)
    shown = (cost > 0) & (error > 0) & np.isfinite(cost * error)
    others = [group for group in dict.fromkeys(groups) if group not in COLOURS]
    colours = COLOURS | dict(zip(others, OTHERS * len(others)))
    best = [index for index in front if shown[index]]
    axes.step(cost[best], error[best], where="post", color="0.75", lw=5, solid_capstyle="round", zorder=1,
              label="front")
    seen: dict[str, int] = {}
    for kind in dict.fromkeys(kinds):
        mine = [index for index, each in enumerate(kinds) if each == kind and shown[index]]
        if not mine:
            continue
        group = groups[mine[0]]
        marker = MARKERS[seen.get(group, 0) % len(MARKERS)]
        seen[group] = seen.get(group, 0) + 1
        axes.plot(cost[mine], error[mine], marker=marker, ms=5, lw=0.9, color=colours[group], mec="white", mew=0.4,
                  label=kind, zorder=3 if set(mine) & set(best) else 2)
    axes.plot(cost[best], error[best], "o", ms=11, mfc="none", mec="0.25", mew=1.0, zorder=4)
    for index in best if len(sizes) else ():
        axes.annotate(str(sizes[index]), (cost[index], error[index]), (-7, -4), textcoords="offset points", fontsize=7,
                      ha="right", va="top")
    if not shown.any():
        axes.text(0.5, 0.5, "no run has both", ha="center", transform=axes.transAxes)
    else:
        axes.set(xscale="log", yscale="log")
        axes.set(xlim=_limits(cost[shown]), ylim=_limits(error[shown]))
        _ticks(axes.xaxis, cost[shown])
        _ticks(axes.yaxis, error[shown])
    axes.grid(alpha=0.3, which="major")
    axes.grid(alpha=0.12, which="minor")


def _ticks(axis: Axis, values: ndarray) -> None:
    """Numbers as people write them; a range of hardly more than a decade has them between the powers of ten too."""
    few = values.max() < 30 * values.min()
    axis.set_major_formatter(FuncFormatter(_number))
    axis.set_minor_locator(LogLocator(subs=(2, 3, 5) if few else tuple(range(2, 10))))
    axis.set_minor_formatter(FuncFormatter(_number) if few else NullFormatter())


def _limits(values: ndarray) -> tuple[float, float]:
    """Of an axis: some room on both sides, and never less than a factor of four between them."""
    room = max(1.3, np.sqrt(4 * values.min() / values.max()))
    return values.min() / room, values.max() * room


def _number(value: float, position: int | None = None) -> str:
    return f"{value:g}" if 1e-4 < value < 1e5 else f"$10^{{{np.log10(value):.0f}}}$"


def trade(study: Any, quantity: str | None = None, costs: Sequence[str] = ("wall_s", "memory_mb")) -> Figure:
    """Error against cost of a study, with the runs that nobody beats in both.

    Errors below what the scene's reference is known to are shaded, for they cannot be told apart.

    Parameters
    ----------
    study
        What :func:`skfem_mpm.study.tradeoff` returns.
    quantity
        Which error; the first one if not given.
    costs
        Columns to draw it against, a panel each; those of which nothing is known are left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    words = {"wall_s": "seconds", "cpu_s": "seconds of the processor", "memory_mb": "peak memory / MB"}
    costs = [cost for cost in costs if np.isfinite(study.column(cost)).any()] or list(costs[:1])
    figure, places = plt.subplots(1, len(costs), figsize=(4.6 * len(costs) + 2.8, 4.4), sharey=True, squeeze=False,
                                  layout="constrained")
    name = study.error_name(quantity)
    order = sorted(range(len(study.rows)), key=lambda index: float(np.prod(study.rows[index].get("cells") or 0)))
    rows = [study.rows[index] for index in order]
    kinds, groups = [study.label(row) for row in rows], [str(row.get("method", "")) for row in rows]
    place = {id(row): index for index, row in enumerate(rows)}
    known = study.known(quantity)
    for axes, cost in zip(places[0], costs):
        front = [place[id(row)] for row in study.front(quantity, cost)]
        error_against_cost(axes, study.column(cost)[order], study.column(name)[order], front, groups, kinds,
                           [row.get("cells", "") for row in rows])
        axes.set_xlabel(words.get(cost, cost))
        if known:
            axes.axhspan(known / 1e9, known, color="0.5", alpha=0.15, lw=0, label="within the reference's own error")
    errors = study.column(name)
    errors = errors[(errors > 0) & np.isfinite(errors)]
    if len(errors):
        places[0, 0].set_ylim(_limits(errors))
    places[0, 0].set_ylabel(f"relative error ({name[len('error_'):].replace('_', ' ')})")
    figure.suptitle(f"{study.about['scene']}{_steps(rows)}; numbers are cells", fontsize=11)
    figure.legend(*places[0, 0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return figure


def _steps(rows: Sequence[Any]) -> str:
    """The number of steps, if all rows have the same."""
    steps = {row.get("steps") for row in rows}
    return f", steps={steps.pop()}" if len(steps) == 1 and steps != {None} else ""
