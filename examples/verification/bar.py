"""Does a vibrating bar keep its period and its amplitude, whenever stress is updated?

V4: a bar of length 25 (E = 100, rho = 1, so c = 10), fixed at one end, starts with v = 0.1 sin(b_n x), b_n = (2 n - 1)
pi / (2 L).  Its centre of mass then moves with v_cm = 0.1 / (b_n L) cos(b_n c t).  Numbers of the problem are those of
the tutorials of Marble.jl: 16 cells of 2 points, steps of 0.1 h / c, up to t = 40; USF, USL and MUSL.  The error is the
2-norm of v_cm over time, relative to that of the closed form.

Mode 1 must be within 2.5 %.  Mode 10 has 3.4 cells to a wave, and cannot be.  With k = b_n h / 2 a lumped grid swings
it at sin(k) / k of its frequency; velocities that are mapped to the nodes and back, with points on quarters, bring a
second factor sqrt(1 - 3/4 sin(k)^2) (ours, for small time steps): 0.62 in all.  So its frequency is measured against
that product, and its error again on a grid thirty times as fine, over as many periods as mode 1 has.  Writes, under
results/verification/bar/ or --out, bar.csv, bar.png.
"""

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import curve_fit

from skfem_mpm import METHODS
from skfem_mpm.scenes import bar

COLOURS = {"usf": "tab:red", "usl": "tab:blue", "musl": "tab:green"}
L, C, V0 = 25.0, 10.0, 0.1

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="plain mpm, 16 cells, shorter")
parser.add_argument("--out", type=Path, default=Path("results/verification/bar"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
methods = ["mpm"] if options.quick else [name for name, method in METHODS.items() if method.strain is method.force]

# -- runs -------------------------------------------------------------------------------------------------------------


def vibrate(method, integrator, n, cells, until):
    """Times and velocity of the centre of mass."""
    scene = bar(cells, mode=n, ends="fixed", speed=V0, length=L, E=C ** 2)
    steps = round(until / (0.1 * L / cells / C))
    found = [(0.0, scene.particles.velocity[0].mean())]
    for state in scene.run(method, steps=steps, every=2, integrator=integrator, dt=until / steps):
        found.append((state.time, state.particles.velocity[0].mean()))
    return np.array(found).T


def closed(n):
    """Amplitude and angular frequency of the centre of mass."""
    b = (2 * n - 1) * np.pi / (2 * L)
    return V0 / (b * L), b * C


def slowed(n, cells):
    """Angular frequency of plain mpm on a grid, as a share of that of the bar."""
    k = (2 * n - 1) * np.pi / (4 * cells)
    return np.sin(k) / k * np.sqrt(1 - 0.75 * np.sin(k) ** 2)


def frequency(times, velocity, guess):
    """Angular frequency of the fading cosine that fits best."""
    (_, found, _), _ = curve_fit(lambda t, a, w, f: a * np.exp(-f * t) * np.cos(w * t), times, velocity,
                                 p0=(velocity[0], guess, 0.0))
    return found


CASES = [(1, 16, 40.0), (10, 16, 40.0), (10, 480, 8 * np.pi / closed(10)[1])]       # mode, cells, time
if options.quick:
    CASES = [(1, 16, 20.0), (10, 16, 5.0)]
rows, curves = [], {}
for n, cells, until in CASES:
    amplitude, omega = closed(n)
    for method in methods[:1] if cells > 16 else methods:
        for integrator in COLOURS:
            times, velocity = curves[n, cells, method, integrator] = vibrate(method, integrator, n, cells, until)
            exact = amplitude * np.cos(omega * times)
            found = frequency(times, velocity, omega * slowed(n, cells))
            rows.append({"mode": n, "cells": cells, "method": method, "integrator": integrator, "time": until,
                         "error": np.linalg.norm(velocity - exact) / np.linalg.norm(exact),
                         "frequency": found / omega, "frequency_of_mpm": slowed(n, cells)})
with open(options.out / "bar.csv", "w", newline="") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)

# -- picture -----------------------------------------------------------------------------------------------------------

figure, axes = plt.subplots(len(CASES), 1, figsize=(11, 3 * len(CASES)), layout="constrained")
for axis, (n, cells, _) in zip(axes, CASES):
    amplitude, omega = closed(n)
    for integrator in COLOURS:
        times, velocity = curves[n, cells, "mpm", integrator]
        axis.plot(times, velocity / amplitude, color=COLOURS[integrator], label=f"mpm, {integrator}")
    fine = np.linspace(0, times[-1], 4000)
    axis.plot(fine, np.cos(omega * fine), "k--", linewidth=1, label="closed form")
    axis.set(xlabel="time", ylabel="v_cm / first amplitude", ylim=(-1.5, 1.5), title=f"mode {n}, {cells} cells",
             xlim=(0, min(times[-1], 8 * np.pi / omega)))
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right", fontsize="small")
figure.savefig(options.out / "bar.png", dpi=100)

# -- the answer --------------------------------------------------------------------------------------------------------

print("Relative error of v_cm [%], and its frequency over that of the closed form")
print(f"{'':31}" + "".join(f"{integrator:>18}" for integrator in COLOURS) + "    frequency of small steps, mpm")
for n, cells, _ in CASES:
    for method in methods[:1] if cells > 16 else methods:
        mine = [row for row in rows if (row["mode"], row["cells"], row["method"]) == (n, cells, method)]
        print(f"mode {n:2}, {cells:3} cells, {method:12}"
              + "".join(f"{100 * row['error']:10.2f}{row['frequency']:8.4f}" for row in mine)
              + (f"{mine[0]['frequency_of_mpm']:10.4f}" if method == "mpm" else ""))
for n, cells, _ in CASES:
    mine = [row for row in rows if (row["mode"], row["cells"]) == (n, cells)]
    worst = max(mine, key=lambda row: row["error"])
    print(f"Mode {n} on {cells} cells: {sum(row['error'] < 0.025 for row in mine)} of {len(mine)} runs are within "
          f"2.5 %; the worst, {worst['method']} {worst['integrator']}, is wrong by {100 * worst['error']:.1f} %.")
print(f"Pictures and tables are in {options.out}.")
