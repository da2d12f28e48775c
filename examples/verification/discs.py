"""Do two elastic discs that collide keep their momentum, and how much of their energy?

V8, after Sulsky and MaterialPointSolver.jl: two discs of radius 0.2 (E = 1000, nu = 0.3, rho = 1000) with their centres
0.6 apart in x and in y meet at 0.1 in each direction.  Without contact laws, through the grid alone, they collide and
fly apart.  Before the collision the closed form is free flight with the kinetic energy 2 pi R^2 rho v^2 = 2.513; the
discs touch at t = 1.586, and up to a cell earlier on the grid.  Afterwards momentum is still zero, energy is at most
what it was, and a part of it stays behind as vibration.  Grid, points and law (Hencky's, which stores energy at any
strain) are ours, and so is the time step, 0.15 of the stable one, for the error of the energy goes with it.  Writes,
under results/verification/discs/ or --out, discs.csv, energy.csv (over time), discs.png.
"""

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from skfem import MeshQuad

from skfem_mpm import METHODS, Hencky, Particles, explicit_steps, plane_strain

SYMMETRIC = [name for name, method in METHODS.items() if method.strain is method.force]     # the others flutter
COLOURS = dict(zip(SYMMETRIC, ["tab:red", "tab:blue", "tab:orange"]))
R, V, DENSITY, END = 0.2, 0.1, 1000.0, 3.6
CENTRES = np.array([[0.2, 0.8], [0.2, 0.8]])            # of both discs, one a column
TOUCH = (0.6 * np.sqrt(2) - 2 * R) / (2 * np.sqrt(2) * V)
SHOWN = [0.0, 1.6, 2.2, END]

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="a coarser grid")
parser.add_argument("--out", type=Path, default=Path("results/verification/discs"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
h = 0.05 if options.quick else 0.025

# -- runs -------------------------------------------------------------------------------------------------------------

lines = h * np.arange(-2, round(1 / h) + 3)
mesh = MeshQuad.init_tensor(lines, lines)
bodies = Particles.fill(mesh, plane_strain, density=DENSITY, per_cell=3,
                        where=lambda x: (np.hypot(*(x[:, None] - CENTRES[:, :, None])) < R).any(axis=0))
lower = bodies.x.sum(axis=0) < 1
start = Particles(bodies.x, bodies.volume, bodies.mass, plane_strain, length=bodies.length,
                  velocity=np.where(lower, V, -V) * np.ones((2, 1)))
first = (start.mass * (start.velocity ** 2).sum(axis=0)).sum() / 2
scale = (start.mass * np.hypot(*start.velocity)).sum()
rows, energies, pictures = [], [], {}
for method in SYMMETRIC:
    shown, total, momentum, slowed = list(SHOWN[1:]), [], [], None
    pictures[method] = [(0.0, start)]
    for state in explicit_steps(mesh, start, Hencky(E=1000.0, nu=0.3), steps=100_000, every=10, method=method,
                                strain="logarithmic", safety=0.15):
        kinetic, elastic = state.energy["kinetic"], state.energy["elastic"]
        total.append((kinetic + elastic) / first)
        momentum.append(np.abs(state.particles.velocity @ state.particles.mass).max() / scale)
        energies.append({"method": method, "time": state.time, "kinetic": kinetic / first, "elastic": elastic / first,
                         "total": total[-1]})
        if slowed is None and kinetic < 0.999 * first:
            slowed = state.time
        if state.time >= shown[0]:
            pictures[method].append((state.time, state.particles))
            shown.pop(0)
            if not shown:
                break
    points = state.particles
    apart = np.array([np.average(points.velocity[:, half], 1, points.mass[half]) for half in (~lower, lower)])
    rows.append({"method": method, "kinetic_at_start": first, "touch": slowed, "largest_total": max(total),
                 "smallest_total": min(total), "momentum": max(momentum), "kinetic_at_end": kinetic / first,
                 "translation_at_end": (apart ** 2).sum() / (4 * V ** 2),
                 "restitution": float((apart[0] - apart[1]).sum() / (4 * V))})
for name, content in [("discs.csv", rows), ("energy.csv", energies)]:
    with open(options.out / name, "w", newline="") as file:
        table = csv.DictWriter(file, content[0])
        table.writeheader()
        table.writerows(content)

# -- picture -----------------------------------------------------------------------------------------------------------

figure, axes = plt.subplots(len(SYMMETRIC), len(SHOWN) + 1, figsize=(17, 3.4 * len(SYMMETRIC)), layout="constrained")
for line, method in zip(axes, SYMMETRIC):
    for axis, (time, points) in zip(line, pictures[method]):
        pressure = np.zeros(points.n) if points.sigma is None else -points.sigma[:3].mean(axis=0)
        cloud = axis.scatter(*points.x, c=pressure, s=1.5 * (h / 0.025) ** 2, cmap="coolwarm", vmin=-40, vmax=40)
        axis.set(aspect="equal", xlim=(0, 1), ylim=(0, 1), title=f"{method}, t = {time:.2f}")
    mine = [row for row in energies if row["method"] == method]
    for name, style in [("kinetic", "-"), ("elastic", ":"), ("total", "--")]:
        line[-1].plot([row["time"] for row in mine], [row[name] for row in mine], style, color=COLOURS[method],
                      label=name)
    line[-1].axvline(TOUCH, color="grey", linewidth=1, label="discs touch")
    line[-1].set(title=f"{method}: energy / first", ylim=(0, 1.15), xlabel="time")
    line[-1].grid(alpha=0.3)
    line[-1].legend(fontsize="small", loc="center right")
figure.colorbar(cloud, ax=axes[:, :-1], location="left", shrink=0.5, label="pressure")
figure.savefig(options.out / "discs.png", dpi=90)

# -- the answer --------------------------------------------------------------------------------------------------------

print(f"Kinetic energy at the start {first:.4f} (closed form {np.pi * R ** 2 * DENSITY * 2 * V ** 2:.4f}); the discs "
      f"touch at {TOUCH:.3f}")
print(f"{'method':9}{'slowed at':>10}{'total energy':>20}{'momentum':>11}{'kinetic at end':>16}{'of centres':>12}"
      f"{'restitution':>13}")
for row in rows:
    print(f"{row['method']:9}{row['touch']:10.3f}{row['smallest_total']:10.4f} to {row['largest_total']:.4f}"
          f"{row['momentum']:12.1e}{row['kinetic_at_end']:15.3f}{row['translation_at_end']:12.3f}"
          f"{row['restitution']:13.3f}")
worst = max(rows, key=lambda row: row["largest_total"])
print(f"\nTotal energy is never more than {100 * (worst['largest_total'] - 1):.2f} % above its start "
      f"({worst['method']}); momentum stays zero to {max(row['momentum'] for row in rows):.0e} of what they bring.")
print(f"Pictures and tables are in {options.out}.")
