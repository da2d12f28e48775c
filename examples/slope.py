"""How does a vertical cut in softening soil fail, and which method shows the failure without noise?

Section 4 of Gonzalez Acosta, Vardon and Hicks (2017): a cut 1 m high and 2 m wide under its own weight, explicit, with
gravity applied suddenly and ramped over 0.5 s.  Every method runs to 10 cm of displacement at the toe, where its fields
are compared, and on towards run-out: on the smooth base that the paper prints nothing stops the soil, so `run-out` is
where it is 0.6 s later.  Writes, under results/slope/ or --out,

  fig7_sudden.png, fig7_ramped.png    stresses and plastic strain at 10 cm, one row per method
  roughness.png                       noise of the horizontal stress over the displacement of the toe
  failure.gif                         the failure with GIMP, ramped gravity
  slope.csv                           energies, run-out and noise at 1, 2, 5, 10 cm and at run-out

Density, gravity, grid and loading are ours, for the paper does not print them (see skfem_mpm.scenes.vertical_cut).
"""

import argparse
import csv
import time
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from tqdm import tqdm

from skfem_mpm import METHODS, OutsideGridError, UnstableError
from skfem_mpm.scenes import vertical_cut

warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")    # the paper does it
COLOURS = dict(zip(METHODS, ["tab:red", "tab:blue", "tab:green", "tab:cyan", "tab:purple", "tab:orange"]))
MARKS = [0.01, 0.02, 0.05, 0.10]        # displacements of the toe [m]
AFTER = 0.6                             # time from the last mark to what is called run-out [s]

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="a coarser grid, three methods, no run-out")
parser.add_argument("--out", type=Path, default=Path("results/slope"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
h, methods = (0.1, ["mpm", "gimp", "cmpm-c"]) if options.quick else (0.05, list(METHODS))
every = 5

# -- runs -------------------------------------------------------------------------------------------------------------


def row(state, seconds):
    energy = state.energy
    stored = energy["kinetic"] + energy["elastic"] + energy["plastic"] + energy["damped"]
    return {"method": method, "loading": loading, "step": state.step, "time": state.time,
            "toe": scene.toe_displacement(state), "runout": scene.run_out(state),
            "eps_p_max": state.particles.history.max(),
            **{name: energy[name] for name in ("kinetic", "elastic", "plastic", "external")},
            "energy_balance": (energy["external"] - stored) / energy["external"],
            "roughness": scene.roughness(state), "point_steps_per_s": scene.particles.n * state.step / seconds}


rows, fields, noise, frames = [], {}, {}, []
for loading in ["sudden", "ramped"]:
    for method in methods:
        scene = vertical_cut(h=h, loading=loading, room=6.0)
        marks, limit, state = list(MARKS), np.inf, None
        curve = noise[loading, method] = []
        begin = time.perf_counter()
        bar = tqdm(desc=f"{loading} {method}", unit=" point steps", unit_scale=True, leave=False)
        try:
            for state in scene.run(method, steps=10_000, every=every):
                bar.update(every * scene.particles.n)
                toe, seconds = scene.toe_displacement(state), time.perf_counter() - begin
                if marks and toe >= marks[0]:
                    marks.pop(0)
                    rows.append(row(state, seconds))
                    if not marks:
                        fields[loading, method], limit = (state.particles, rows[-1]), state.time + AFTER
                if np.isinf(limit):
                    curve.append((toe, scene.roughness(state)))
                if (loading, method) == ("ramped", "gimp") and state.step % 20 == 0:
                    frames.append(state)
                if state.time > limit or (options.quick and not marks):
                    break
        except (UnstableError, OutsideGridError) as failure:
            tqdm.write(f"{loading} {method}: {failure}")
        bar.close()
        if not options.quick:
            rows.append(row(state, time.perf_counter() - begin))

with open(options.out / "slope.csv", "w", newline="") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)

# -- pictures ---------------------------------------------------------------------------------------------------------

SHOWN = [("horizontal stress [kPa]", lambda p: p.sigma[0] / 1e3, (-20, 10)),
         ("shear stress [kPa]", lambda p: p.sigma[3] / 1e3, (-7, 7)),
         ("accumulated plastic strain", lambda p: p.history[0], (0, 0.5))]
for loading in ["sudden", "ramped"]:
    figure, axes = plt.subplots(len(methods), 3, figsize=(13, 2.3 * len(methods)), squeeze=False, layout="constrained",
                                sharex=True, sharey=True)
    for line, method in zip(axes, methods):
        for axis, (title, value, (low, high)) in zip(line, SHOWN):
            if (loading, method) in fields:
                points, _ = fields[loading, method]
                cloud = axis.scatter(*points.x, c=value(points), s=(h / 0.05) ** 2 * 6, vmin=low, vmax=high, marker="s")
            axis.set_aspect("equal")
            axis.set_title(f"{method}: {title}", fontsize="small")
    for column, (title, _, _) in enumerate(SHOWN):
        figure.colorbar(axes[-1, column].collections[0], ax=axes[:, column], location="bottom", shrink=0.8, label=title)
    figure.suptitle(f"Fig. 7: the cut when its toe has moved 10 cm, {loading} gravity")
    figure.savefig(options.out / f"fig7_{loading}.png", dpi=90)

figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True, layout="constrained")
for axis, loading in zip(axes, ["sudden", "ramped"]):
    for method in methods:
        axis.plot(*(100 * np.array(noise[loading, method])).T, color=COLOURS[method], label=method)
    axis.set_xlabel("displacement of the toe [cm]")
    axis.set_title(f"{loading} gravity")
    axis.grid(alpha=0.3)
    axis.legend()
axes[0].set_ylabel("noise of horizontal stress [% of unit weight x height]")
axes[0].set_yscale("log")
figure.savefig(options.out / "roughness.png", dpi=100)

figure, axis = plt.subplots(figsize=(7, 2.6), layout="constrained")
cloud = axis.scatter(*frames[0].particles.x, c=frames[0].particles.history[0], s=3, vmin=0, vmax=1)
axis.set(xlim=(0, 5), ylim=(0, 1.1), aspect="equal")
figure.colorbar(cloud, ax=axis, label="plastic strain")


def draw(state):
    cloud.set_offsets(state.particles.x.T)
    cloud.set_array(state.particles.history[0])
    axis.set_title(f"GIMP, ramped gravity, t = {state.time:.2f} s", fontsize="small")


FuncAnimation(figure, draw, frames).save(options.out / "failure.gif", PillowWriter(fps=12), dpi=70)

# -- the answer -------------------------------------------------------------------------------------------------------

print("\nAt 10 cm of the toe: noise of the horizontal stress (% of unit weight x height) / largest plastic strain")
print(f"{'loading':10}" + "".join(f"{method:>16}" for method in methods))
for loading in ["sudden", "ramped"]:
    found = {m: fields[loading, m][1] for m in methods if (loading, m) in fields}
    print(f"{loading:10}" + "".join(f"{100 * found[m]['roughness']:>8.1f} / {found[m]['eps_p_max']:.2f} " if m in found
                                    else f"{'no failure':>16}" for m in methods))
print(f"Pictures and tables are in {options.out}.")
