"""Does a column that settles under its own weight come to rest where it should, and swing as it should before?

V3, V3b: a column of height L on a rigid base, Hencky's law without lateral strain.  At rest the stretch of what was at
height Y is lambda = W(s) / s with s = rho g (L - Y) / E and Lambert's W, the stress there -rho g (L - Y).  Reached in
load steps (`implicit`), and by time steps with local damping (`explicit`, methods that do not flutter).  Without
damping a stiff column under sudden gravity swings between zero and twice its static settlement with the period
4 L / c; all of it is the sum over modes

  u(y, t) = -sum_n 2 g / (c^2 L b_n^3) sin(b_n y) (1 - cos(b_n c t)),   b_n = (2 n - 1) pi / (2 L).

GIMP's domains keep their size, as in the paper, while the base is compressed by 4 %; `stretched` are load steps with
domains="stretched".  Writes, under results/verification/column/ or --out,
errors.csv (error and order for each grid), swing.csv (settlement
of the top over time) and column.png.  E, L, density and gravity are those of the column of AMPLE; grids, damping and
the stiffer column are ours.
"""

import argparse
import csv
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.special import lambertw
from skfem import MeshLine

from skfem_mpm import METHODS, Hencky, LinearElastic, Particles, explicit_steps, implicit_steps, uniaxial
from skfem_mpm.boundary import FixedPlane

warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")
COLOURS = dict(zip(METHODS, ["tab:red", "tab:blue", "tab:green", "tab:cyan", "tab:purple", "tab:orange"]))
L, E, DENSITY, GRAVITY = 50.0, 1e6, 80.0, 10.0
BASE = [FixedPlane(0, 0.0, -1, name="base")]

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="coarse grids, four methods")
parser.add_argument("--out", type=Path, default=Path("results/verification/column"),
                    help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
grids, swinging = ([10, 20, 40], 20) if options.quick else ([10, 20, 40, 80, 160, 320], 100)
damped_grids = grids[:2] if options.quick else grids[:4]
methods = ["mpm", "gimp", "cmpm", "gc"] if options.quick else list(METHODS)
symmetric = [name for name in methods if METHODS[name].strain is METHODS[name].force]       # the others flutter


def column(cells):
    """A grid with a spare cell at both ends, and the points of the column."""
    lines = L / cells * np.arange(-1, cells + 2)
    return MeshLine(lines), Particles.fill(MeshLine(lines[1:-1]), uniaxial, density=DENSITY)


def write(name, rows):
    with open(options.out / name, "w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


# -- the closed forms --------------------------------------------------------------------------------------------------

height = np.linspace(0, L, 20_001)
s = np.maximum(DENSITY * GRAVITY * (L - height) / E, 1e-300)
stretch = np.where(s > 1e-12, lambertw(s).real / s, 1.0)
position = cumulative_trapezoid(stretch, height, initial=0)
settled = L - position[-1]


def settle(solver, method, mesh, start, cells):
    """The points at rest."""
    law = Hencky(E=E, nu=0.0)
    if solver == "explicit":                            # six periods, gravity grows over two of them
        period, count = 4 * L / np.sqrt(E / DENSITY), 6 * 8 * cells
        return next(explicit_steps(mesh, start, law, BASE, steps=count, every=count, method=method,
                                   dt=6 * period / count, strain="logarithmic", gravity=(-GRAVITY,), ramp=2 * period,
                                   damping=0.5)).particles
    *_, state = implicit_steps(mesh, start, law, BASE, steps=20, method=method,
                               domains="stretched" if solver == "stretched" else "fixed",
                               gravity=lambda step: (-GRAVITY * step / 20,))
    return state.particles


def errors(particles, start):
    """Of position, relative to how far the top settles, and of stress, relative to its largest; rms over points."""
    place = np.interp(start.x[0], height, position)
    stress = -DENSITY * GRAVITY * (L - start.x[0])
    return (np.sqrt(((particles.x[0] - place) ** 2).mean()) / settled,
            np.sqrt(((particles.sigma[0] - stress) ** 2).mean()) / (DENSITY * GRAVITY * L))


def swing(y, t, c, terms=2000):
    """Displacement at ``y`` and the times ``t`` after gravity has set in."""
    b = (2 * np.arange(1, terms + 1) - 1) * np.pi / (2 * L)
    return -(2 * GRAVITY / (c ** 2 * L * b ** 3) * np.sin(b * y)) @ (1 - np.cos(b[:, None] * c * t))


# -- at rest -----------------------------------------------------------------------------------------------------------

rows = []
RUNS = [("implicit", methods, grids), ("stretched", ["gimp", "gc"], grids), ("explicit", symmetric, damped_grids)]
for solver, used, over in RUNS:
    for method in used:
        before = np.full(2, np.nan)
        for cells in over:
            mesh, start = column(cells)
            found = np.array(errors(settle(solver, method, mesh, start, cells), start))
            order = np.log2(before / found)
            rows.append({"solver": solver, "method": method, "cells": cells, "position": found[0], "stress": found[1],
                         "position_order": order[0], "stress_order": order[1]})
            before = found
write("errors.csv", rows)

# -- and on the way ----------------------------------------------------------------------------------------------------

stiff = 1e9                                             # it settles by a thousandth of a cell: nothing is crossed
c = np.sqrt(stiff / DENSITY)
period, static = 4 * L / c, GRAVITY * L ** 2 / (2 * c ** 2)
mesh, start = column(swinging)
top = start.x[0].argmax()
curves, swings = {}, []
for method in methods:
    times, moved = [0.0], [0.0]
    for state in explicit_steps(mesh, start, LinearElastic(E=stiff, nu=0.0), BASE, steps=100_000, every=1,
                                method=method, gravity=(-GRAVITY,), safety=0.5):
        times.append(state.time)
        moved.append(state.particles.x[0, top] - start.x[0, top])
        if state.time > 2 * period:
            break
    times, moved = np.array(times), np.array(moved)
    exact = swing(start.x[0, top], times, c)
    half = swing(start.x[0, top], np.array([period / 4]), c)[0]
    falls = np.flatnonzero((moved[:-1] > half) & (moved[1:] <= half))[:2]
    crossings = times[falls] + (half - moved[falls]) / (moved[falls + 1] - moved[falls]) * np.diff(times)[falls]
    curves[method] = times, moved, exact
    swings.append({"method": method, "peak": -moved[times < period].min() / static,
                   "period": np.diff(crossings)[0] / period,
                   "error": np.sqrt(((moved - exact) ** 2).mean() / (exact ** 2).mean())})
write("swing.csv", swings)

# -- picture -----------------------------------------------------------------------------------------------------------

figure, axes = plt.subplots(1, 3, figsize=(16, 5.6), layout="constrained")
for solver, line in [("implicit", "o-"), ("stretched", "s:")]:
    for method in methods:
        mine = [row for row in rows if (row["solver"], row["method"]) == (solver, method)]
        for axis, name in zip(axes, ["position", "stress"] if mine else []):
            axis.loglog([L / row["cells"] for row in mine], [100 * row[name] for row in mine], line,
                        color=COLOURS[method], label=method + ", domains stretched" * (solver == "stretched"))
for axis, name in zip(axes, ["position (% of the settlement)", "stress (% of the largest)"]):
    size = np.array([L / grids[0], L / grids[-1]])
    axis.axvline(settled, color="grey", linestyle="-.", label="cell = settlement of the top")
    axis.loglog(size, 10 * size / size[0], "k--", linewidth=1, label="first order")
    axis.loglog(size, 10 * (size / size[0]) ** 2, "k:", linewidth=1, label="second order")
    axis.set(xlabel="cell [m]", ylabel=f"rms error of {name}", title=f"at rest, implicit: {name.split(' (')[0]}")
    axis.set_xticks([L / cells for cells in grids], [f"{L / cells:.3g}" for cells in grids])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize="small")
for method in methods:
    times, moved, exact = curves[method]
    axes[2].plot(times / period, moved / static, color=COLOURS[method], label=method)
axes[2].plot(times / period, exact / static, "k--", label="sum over modes")
axes[2].set(xlabel="time / (4 L / c)", ylabel="settlement of the top / static one", title="sudden gravity, explicit")
axes[2].grid(alpha=0.3)
axes[2].legend(fontsize="small", loc="lower right")
figure.savefig(options.out / "column.png", dpi=100)

# -- the answer --------------------------------------------------------------------------------------------------------

print(f"At rest: base stretch {stretch[0]:.5f}, length {position[-1] / L:.5f} of the first; rms errors of points, %")
print(f"{'solver':10}{'method':9}{'error of':10}" + "".join(f"{n:>5} cells" for n in grids) + "   order, last grids")
for solver, used, _ in RUNS:
    for method in used:
        mine = [row for row in rows if (row["solver"], row["method"]) == (solver, method)]
        for name in ["position", "stress"]:
            print(f"{solver:10}{method:9}{name:10}" + "".join(f"{100 * row[name]:11.4f}" for row in mine)
                  + f"{mine[-1][name + '_order']:10.2f}")
print("\nUnder sudden gravity: largest settlement / static (2), period / (4 L / c) (1), relative error of two periods")
for row in swings:
    print(f"{row['method']:9}{row['peak']:8.3f}{row['period']:8.4f}{100 * row['error']:8.2f} %")
last = {(row["solver"], row["method"]): row for row in rows if row["cells"] == grids[-1]}
print("\nOrder of the error of stress on the last two grids, implicit:")
print(", ".join(f"{method} {last['implicit', method]['stress_order']:.1f}" for method in methods)
      + "; domains stretched: "
      + ", ".join(f"{method} {last['stretched', method]['stress_order']:.1f}" for method in ["gimp", "gc"])
      + ".  About 0 is a method that has stopped converging: with linear functions because points cross cells, with "
      "GIMP's because domains of constant size overlap.")
print(f"Pictures and tables are in {options.out}.")
