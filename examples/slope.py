"""How does a vertical cut in softening soil fail, and which method shows the failure without noise?

Section 4 of Gonzalez Acosta, Vardon and Hicks (2017): a cut 1 m high and 2 m wide under its own weight, explicit, with
gravity applied suddenly and ramped over 0.5 s.  Every method runs to 10 cm of displacement at the toe, where its fields
are compared, and on to run-out: on the smooth base that the paper prints nothing stops the soil, so `run-out` is where
it is 0.6 s later.  Writes, under results/slope/ or --out,

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
from PIL import Image
from tqdm import tqdm

from skfem_mpm import METHODS, OutsideGridError, UnstableError
from skfem_mpm.scenes import vertical_cut

warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")    # the paper does it
COLOURS = dict(zip(METHODS, ["tab:red", "tab:blue", "tab:green", "tab:cyan", "tab:purple", "tab:orange"]))
MARKS = [0.01, 0.02, 0.05, 0.10]                # displacements of the toe [m]
AFTER = 0.6                                     # time from the last mark to what is called run-out [s]
EXPECTED = {"sudden": 0.15, "ramped": 0.6}      # about when the last mark is reached [s]; the bar needs it, no result

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="a coarser grid, four methods, a shorter run-out")
parser.add_argument("--out", type=Path, default=Path("results/slope"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
h, methods, after, shot = 0.05, list(METHODS), AFTER, 0.02          # a picture of the film every 0.02 s
if options.quick:
    h, methods, after, shot = 0.1, ["mpm", "gimp", "cmpm", "cmpm-c"], 0.1, 0.05

# -- runs -------------------------------------------------------------------------------------------------------------


def states(bar, seconds, end, **choices):
    """States of a run; counts its point steps in ``bar``, and the ``seconds`` that each step takes."""
    steps, begin = scene.run(method, steps=100_000, **choices), time.perf_counter()
    step = choices["start"].step if "start" in choices else 0
    for state in steps:
        seconds.append((time.perf_counter() - begin) / (state.step - step))
        bar.total = scene.particles.n * (state.step + max(0, round((end - state.time) / state.dt)))
        bar.update(scene.particles.n * (state.step - step))
        step = state.step
        yield state
        begin = time.perf_counter()


def row(state, seconds):
    return {"method": method, "loading": loading, "step": state.step, "time": state.time,
            "toe": scene.toe_displacement(state), "runout": scene.run_out(state),
            "eps_p_max": state.particles.history.max(),
            **{name: state.energy[name] for name in ("kinetic", "elastic", "plastic", "external")},
            "energy_balance": scene.energy_balance(state), "roughness": scene.roughness(state),
            "point_steps_per_s": scene.particles.n / np.median(seconds)}


rows, fields, noise, frames = [], {}, {}, []
for loading in EXPECTED:
    for method in methods:
        scene = vertical_cut(h=h, loading=loading, room=6.0)
        marks, seconds, curve, state = list(MARKS), [], [], None
        filmed = (loading, method) == ("ramped", "gimp")
        with tqdm(desc=f"{loading} {method}", unit=" point steps", unit_scale=True, leave=False) as bar:
            try:
                for state in states(bar, seconds, EXPECTED[loading] + after, every=1):
                    toe = scene.toe_displacement(state)
                    if not curve or toe >= curve[-1][0] + 1e-3 or toe >= marks[0]:
                        curve.append((toe, scene.roughness(state)))
                    if filmed and state.time >= shot * len(frames):
                        frames.append(state)
                    if toe >= marks[0]:
                        rows.append(row(state, seconds))
                        marks = [mark for mark in marks if mark > toe]
                    if not marks:
                        break
                fields[loading, method], end = (state.particles, rows[-1]), state.time + after
                for state in states(bar, seconds, end, start=state, every=5):
                    if filmed and state.time >= shot * len(frames):
                        frames.append(state)
                    if state.time >= end:
                        break
            except (UnstableError, OutsideGridError) as failure:
                tqdm.write(f"{loading} {method}: {failure}")
        rows.append(row(state, seconds))
        noise[loading, method] = np.array(curve)

with open(options.out / "slope.csv", "w", newline="") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)

# -- Fig. 7 -----------------------------------------------------------------------------------------------------------

SHOWN = [("horizontal stress [kPa]", lambda p: p.sigma[0] / 1e3, (-20, 10), "viridis"),
         ("shear stress [kPa]", lambda p: p.sigma[3] / 1e3, (-6, 6), "coolwarm"),
         ("accumulated plastic strain", lambda p: p.history[0], (0, 0.4), "magma_r")]
for loading in EXPECTED:
    figure, axes = plt.subplots(len(methods), 3, figsize=(13, 2.35 * len(methods) + 0.8), squeeze=False, sharex=True,
                                sharey=True, layout="constrained")
    for line, method in zip(axes, methods):
        for axis, (title, value, (low, high), colours) in zip(line, SHOWN):
            points, _ = fields.get((loading, method), (None, None))
            if points is not None:
                cloud = axis.scatter(*points.x, c=value(points), s=(h / 0.05) ** 2 * 12, marker="s", linewidths=0,
                                     vmin=low, vmax=high, cmap=colours)
            axis.set_aspect("equal")
            axis.set_title(f"{method}: {title}" + " (no failure)" * (points is None), fontsize="small")
    for column, (title, _, (low, high), colours) in enumerate(SHOWN):
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(low, high), colours)
        figure.colorbar(scale, ax=axes[:, column], location="bottom", aspect=30, pad=0.01, label=title,
                        extend="max" if low == 0 else "both")
    figure.suptitle(f"Fig. 7: the cut when its toe has moved 10 cm, {loading} gravity (x and y in m)")
    figure.savefig(options.out / f"fig7_{loading}.png", dpi=90)

# -- noise, and where the paper's order holds -------------------------------------------------------------------------

place = np.linspace(0.001, 0.1, 100)            # displacements of the toe at which methods are compared [m]


def along(method):
    """Noise at ``place``."""
    toe, rough = noise[loading, method].T
    return np.interp(place, np.maximum.accumulate(toe), rough)


def where(holds):
    """In words, at which displacements something holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]])))
    runs = [f"{100 * place[start]:.1f}-{100 * place[stop - 1]:.1f}" for start, stop in zip(edges[::2], edges[1::2])]
    return "nowhere" if not runs else "everywhere" if holds.all() else "at " + ", ".join(runs) + " cm"


words = {}
for loading in EXPECTED:
    mpm, gimp, cmpm = along("mpm"), along("gimp"), along("cmpm")
    words[loading] = (f"CMPM smoothest of the paper's three {where((cmpm < gimp) & (cmpm < mpm))},\n"
                      f"GIMP {where((gimp < cmpm) & (gimp < mpm))};\n"
                      f"MPM noisiest {where((mpm > gimp) & (mpm > cmpm))}")
figure, axes = plt.subplots(1, 2, figsize=(12, 5.2), sharey=True, layout="constrained")
for axis, loading in zip(axes, EXPECTED):
    for method in methods:
        toe, rough = noise[loading, method].T
        axis.semilogy(100 * toe, 100 * rough, color=COLOURS[method], label=method)
    axis.set_xlabel("displacement of the toe [cm]")
    axis.set_title(f"{loading} gravity\n{words[loading]}", fontsize="medium")
    axis.grid(alpha=0.3)
axes[0].set_ylim(1e-3, 1e2)
axes[0].legend(loc="lower right")
axes[0].set_ylabel("noise of horizontal stress [% of unit weight x height]")
figure.savefig(options.out / "roughness.png", dpi=100)

# -- the failure, moving ----------------------------------------------------------------------------------------------

figure, axis = plt.subplots(figsize=(7.5, 2.6), dpi=70, layout="constrained")
cloud = axis.scatter(*frames[0].particles.x, c=frames[0].particles.history[0], s=(h / 0.05) ** 2 * 6, vmin=0, vmax=1,
                     linewidths=0)
axis.set(xlim=(0, 4), ylim=(0, 1.1), aspect="equal", xlabel="x [m]", title=" ")
figure.colorbar(cloud, ax=axis, label="plastic strain", extend="max")
figure.canvas.draw()
figure.set_layout_engine("none")                # once is enough
pictures = []
for state in frames:
    cloud.set_offsets(state.particles.x.T)
    cloud.set_array(state.particles.history[0])
    axis.set_title(f"GIMP, gravity ramped over 0.5 s, t = {state.time:.2f} s", fontsize="small")
    figure.canvas.draw()
    pictures.append(Image.fromarray(np.array(figure.canvas.buffer_rgba())).convert("P", palette=Image.ADAPTIVE))
pictures[0].save(options.out / "failure.gif", save_all=True, append_images=pictures[1:], duration=80, loop=0)

# -- the answer -------------------------------------------------------------------------------------------------------

print("\nAt 10 cm of the toe: noise of the horizontal stress (% of unit weight x height) / largest plastic strain / "
      "energy balance (%)")
print(f"{'loading':8}" + "".join(f"{method:>19}" for method in methods))
for loading in EXPECTED:
    found = {m: fields[loading, m][1] for m in methods if (loading, m) in fields}
    print(f"{loading:8}" + "".join(f"{100 * found[m]['roughness']:7.1f} / {found[m]['eps_p_max']:.2f} /"
                                   f"{100 * found[m]['energy_balance']:5.1f}" if m in found else f"{'no failure':>19}"
                                   for m in methods))
for loading in EXPECTED:
    print(f"{loading}: " + words[loading].replace("\n", " ") + ".")
    rough = {m: fields[loading, m][1]["roughness"] if (loading, m) in fields else np.nan for m in methods}
    ordered = min(rough["gimp"], rough.get("gc", np.inf)) < rough["cmpm-c"] < rough["mpm"]
    print(f"{loading}: at 10 cm the order of noise, gc or gimp < cmpm-c < mpm, {'holds' if ordered else 'fails'}.")
print(f"Pictures and tables are in {options.out}.")
