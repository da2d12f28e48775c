"""At which weight does a vertical cut in perfectly plastic soil fail, and how much does locking hide of it?

V14: the cut of the paper on a rough base, its soil made perfectly plastic (von Mises, sqrt(J2) <= c) and stiff
(E = 1000 c), under gravity that grows so slowly that waves cross the cut hundreds of times.  It has failed when the
kinetic energy passes 1 % of the work that gravity has done.  Limit analysis encloses gamma H / c at failure between
3.7752 and 3.7776 (Kammoun, Pastor, Smaoui and Pastor 2010, doi 10.1002/nag.887).  Linear functions with 2 x 2 points in
a cell hardly flow at constant volume, which delays failure; remedy="bbar" gives the points of a cell one volume strain.
What is left goes with the size of cells, which is therefore also taken to zero in a straight line from the last two
grids, and with gravity that still grows while the cut gathers speed: the curve of the kinetic energy bends upwards
earlier than it passes 1 %.  Only methods that do not flutter can be judged by their kinetic energy.  Writes, under
results/verification/cut_limit/ or --out, cut_limit.csv, cut_limit.png.  Takes a minute or two with numba.

Width (1.25 m; the mechanism reaches 1 m behind the face), stiffness, rate of gravity and grids are ours.
"""

import argparse
import csv
import time
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

from skfem_mpm import VonMises
from skfem_mpm.scenes import vertical_cut

LOWER, UPPER, LAST = 3.7752, 3.7776, 5.0                # bounds of gamma H / c, and where gravity ends
LIMIT = (LOWER + UPPER) / 2
COHESION, SHARE = 6e3, 0.01
COLOURS = {("gimp", "bbar"): "tab:blue", ("gimp", "none"): "tab:red"}

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="one coarse grid, gravity grows faster")
parser.add_argument("--out", type=Path, default=Path("results/verification/cut_limit"),
                    help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
transits = 100 if options.quick else 800                 # times a wave crosses the height while gravity grows
RUNS = [("gimp", "bbar", 0.1), ("gimp", "none", 0.1)]
if not options.quick:
    RUNS += [("gimp", "bbar", 0.05), ("gimp", "none", 0.05), ("gimp", "bbar", 0.025)]

# -- runs -------------------------------------------------------------------------------------------------------------

law = VonMises(E=1000 * COHESION, nu=0.35, peak=COHESION, residual=COHESION)
rows, curves, band = [], {}, None
for method, remedy, h in tqdm(RUNS, desc="cut_limit"):
    scene = vertical_cut(h, base="rough", material=law, width=1.25, room=0.5)
    scene = replace(scene, gravity=(0.0, -LAST * COHESION / 2000.0))        # gamma H = LAST c at the end
    speed = np.sqrt((law.lam + 2 * law.G) / 2000.0)
    begin, ramp, failed = time.perf_counter(), transits / speed, np.nan
    curve = curves[method, remedy, h] = []
    for state in scene.run(method, steps=10_000_000, every=transits // 20, ramp=ramp, remedy=remedy, safety=1.0,
                           threads=2):
        number, share = LAST * state.time / ramp, state.energy["kinetic"] / state.energy["external"]
        curve.append((number, share))
        if number > LAST / 2 and share > SHARE:         # before, gravity has hardly set in
            failed, band = number, (h, state.particles)
        if np.isfinite(failed) or number >= LAST:
            break
    rows.append({"method": method, "remedy": remedy, "h": h, "points": scene.particles.n, "failure": failed,
                 "error": (failed if np.isfinite(failed) else number) / LIMIT - 1, "steps": state.step,
                 "transits": transits, "seconds": round(time.perf_counter() - begin, 1)})
with open(options.out / "cut_limit.csv", "w", newline="") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)

# -- picture -----------------------------------------------------------------------------------------------------------

figure, (left, right) = plt.subplots(1, 2, figsize=(14, 4.8), layout="constrained", width_ratios=[1, 1.2])
STYLES = {0.1: ":", 0.05: "--", 0.025: "-"}
for (method, remedy, h), curve in curves.items():
    left.semilogy(*np.array(curve).T, STYLES[h], color=COLOURS[method, remedy],
                  label=f"{method}, {'B-bar' if remedy == 'bbar' else 'no remedy'}, h = {h}")
left.axvline(LIMIT, color="k", linewidth=1, label="limit analysis")
left.axhline(SHARE, color="k", linestyle="-.", linewidth=1, label="taken as failure")
left.set(xlabel="gamma H / c", ylabel="kinetic energy / work of gravity", ylim=(1e-6, 1), xlim=(1, LAST))
left.grid(alpha=0.3)
left.legend(fontsize="small")
h, points = band
cloud = right.scatter(*points.x, c=1e3 * points.history[0], s=(h / 0.05) ** 2 * 90, marker="s", linewidths=0,
                      vmax=np.quantile(1e3 * points.history[0], 0.99))
right.set(aspect="equal", title=f"plastic strain at failure (h = {h}), in thousandths")
figure.colorbar(cloud, ax=right, shrink=0.7)
figure.savefig(options.out / "cut_limit.png", dpi=100)

# -- the answer --------------------------------------------------------------------------------------------------------

print(f"gamma H / c at failure; limit analysis: {LOWER} to {UPPER}")
for row in rows:
    found = f"{row['failure']:.3f}, {100 * row['error']:+.1f} %" if row["failure"] == row["failure"] else \
        f"none up to {LAST:g}"
    print(f"{row['method']:6} remedy {row['remedy']:6} h = {row['h']:<7} {found:20} ({row['steps']} steps, "
          f"{row['seconds']} s)")
if not options.quick:
    _, coarse, fine = (row["error"] for row in rows if (row["method"], row["remedy"]) == ("gimp", "bbar"))
    print(f"\ngimp with remedy 'bbar' is off by {100 * fine:+.1f} % on the finest grid and by "
          f"{100 * (2 * fine - coarse):+.1f} % extrapolated to cells of no size.")
lock = [row["error"] for row in rows if row["method"] == "gimp" and row["h"] == 0.1]
print(f"At h = 0.1 locking adds {100 * (lock[1] - lock[0]):.0f} % (or more, where there is no failure at all).")
print(f"Pictures and tables are in {options.out}.")
