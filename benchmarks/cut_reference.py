"""The reference of the vertical cut, which has no closed form: ever finer grids, extrapolated, with an error estimate.

Runs both loadings on ever finer grids with the best choice, GIMP with B-bar, and with plain GIMP, which is cheaper and
reaches finer ones.  Extrapolates toe displacement over time, run-out, time of failure and plastic dissipation of both;
the value is that of the best choice, its error no less than what the two differ by.  Repeats two grids with half the
time step.  Writes all of it as JSON: where `VerticalCut.measure` reads it, if --out is not given.

    python benchmarks/cut_reference.py                          the reference, some 15 minutes; a line per run
    python benchmarks/cut_reference.py --quick --out FILE       three coarse grids, 20 s
    python benchmarks/cut_reference.py --compare                how the choices differ on the grids that they can afford
    python benchmarks/cut_reference.py --figure FILE            draw what is stored
    python benchmarks/cut_reference.py --bands FILE             draw where the soil fails, on three grids; 2 minutes
"""

import argparse
import datetime
import json
import os
import platform
import re
import time
import warnings
from importlib import metadata
from pathlib import Path

import numpy as np

from skfem_mpm.output import write_text
from skfem_mpm.scenes import vertical_cut
from skfem_mpm.scenes.richardson import richardson
from skfem_mpm.scenes.vertical_cut_reference import FAILED, FILE, QUANTITIES

SIZES = {"sudden": (0.1, 0.05, 0.025, 0.0125, 0.00625), "ramped": (0.1, 0.05, 0.025, 0.0125)}
FINER = (0.1, 0.05, 0.025, 0.0125, 0.00625)     # of plain GIMP
HALVED = (0.05, 0.025)                          # grids that are run with half the time step too
CHOICE = {"method": "gimp", "remedy": "bbar", "safety": 0.5, "engine": "numba"}
SECOND = {**CHOICE, "remedy": "none"}
OTHERS = {"gimp": {}, "gimp, B-bar": {"remedy": "bbar"}, "gimp, 3 x 3 points": {},
          "gimp, stretched": {"domains": "stretched"}, "dual": {"integration": "dual"},
          "twin2": {"integration": "twin2"}, "gc": {"method": "gc"}, "cmpm-c": {"method": "cmpm-c"},
          "mpm": {"method": "mpm"}}
PER_CELL = {"gimp, 3 x 3 points": 3}
ROOM = 1.5                                      # free grid in front of the face [m]; the toe stays within 1 m


def run(loading, h, choices, per_cell=2):
    """All that is kept of one run, and the times of its history."""
    scene = vertical_cut(h, loading=loading, room=ROOM, per_cell=per_cell)
    begin, states, rough = time.perf_counter(), [], []

    def kept():
        for state in scene.run(**choices):
            if not rough and scene.toe_displacement(state) >= FAILED:
                rough.append(scene.roughness(state))
            states[:] = [state]
            yield state

    history = scene.history(kept())
    times = np.round(np.arange(1, round(scene.until / 0.01) + 1) * 0.01, 2)
    row = {"h": h, "points": scene.particles.n, "steps": states[-1].step,
           "seconds": round(time.perf_counter() - begin, 1), **history.quantities(scene.until),
           "roughness": rough[0] if rough else scene.roughness(states[-1]),
           "balance": scene.energy_balance(states[-1]), "toe": history.toe_at(times).tolist()}
    print(f"{loading:7} h = {h:<8} {row['seconds']:7.1f} s {row['steps']:6} steps, "
          + ", ".join(f"{name} {row[name]:.4g}" for name in (*QUANTITIES, "roughness", "balance")), flush=True)
    return scene, times, row


def limit(name, *sequences):
    """Value, error and order of a quantity: of the first sequence, in view of the second."""
    first, second = (richardson([row[name] for row in rows], [row["h"] for row in rows]) for rows in sequences)
    found = first.beside(second)
    return {"value": np.asarray(found.value).tolist(), "error": np.asarray(found.error).tolist(),
            "order": None if np.isnan(found.order) else found.order}


def reference(loading, sizes, finer):
    """The part of the file for one loading."""
    runs = [run(loading, h, CHOICE) for h in sizes]
    scene, times, _ = runs[0]
    best, second = [row for *_, row in runs], [run(loading, h, SECOND)[2] for h in finer]
    halved = [run(loading, h, {**CHOICE, "safety": CHOICE["safety"] / 2})[2] for h in HALVED]
    found = {name: limit(name, best, second) for name in ("toe", *QUANTITIES)}
    for name, held in found.items():
        print(f"{loading:7} {name}: {np.ravel(held['value'])[-1]:.5g} +- {np.ravel(held['error'])[-1]:.2g}, "
              f"order {held['order']}")
    return {"until": scene.until, "times": times.tolist(), **found, "grids": best, "second": second,
            "half_step": halved}


def about(command):
    """What made the file."""
    return {"command": command, "date": datetime.date.today().isoformat(),
            "machine": {"processor": platform.machine(), "cores": os.cpu_count(), "system": platform.system()},
            "versions": {"python": platform.python_version()}
            | {name: metadata.version(name) for name in ("numpy", "scipy", "scikit-fem", "numba")},
            "choice": CHOICE, "second_choice": SECOND, "room": ROOM,
            "scene": "vertical_cut() with its default numbers; SI units, work per metre of cut"}


def write(path, content):
    """All or nothing, one line per grid, so that it can be read and compared."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_text(path, packed(json.dumps(rounded(content), indent=1, allow_nan=False)) + "\n")


def rounded(value):
    """Ten digits of every number."""
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return float(f"{value:.10g}") if isinstance(value, float) else value


def packed(text):
    """Lists of numbers on one line."""
    return re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", lambda found: "[" + " ".join(found[1].split()) + "]", text)


def compare(sizes):
    """Every choice, on the grids that it can afford."""
    for loading in SIZES:
        for name, choices in OTHERS.items():
            print(name)
            for h in sizes:
                run(loading, h, SECOND | choices, PER_CELL.get(name, 2))


def draw(path):
    """Toe displacement over time, on all grids and extrapolated; and what the quantities do."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    held = json.loads(FILE.read_text(encoding="utf-8"))
    figure, axes = plt.subplots(2, 4, figsize=(15, 7), layout="constrained")
    for line, loading in zip(axes, ("sudden", "ramped")):
        part = held[loading]
        times = np.array(part["times"])
        value, error = (100 * np.array(part["toe"][name]) for name in ("value", "error"))
        for k, row in enumerate(part["grids"]):
            line[0].plot(times, 100 * np.array(row["toe"]), color=plt.get_cmap("viridis_r")(0.2 + 0.2 * k),
                         label=f"h = {row['h']:g} m")
        line[0].plot(times, 100 * np.array(part["second"][-1]["toe"]), "k:",
                     label=f"plain GIMP, h = {part['second'][-1]['h']:g} m")
        line[0].fill_between(times, value - error, value + error, color="tab:red", alpha=0.2, linewidth=0)
        line[0].plot(times, value, color="tab:red", linestyle="--", label="reference and band")
        line[0].axhline(100 * FAILED, color="grey", linewidth=0.6)
        line[0].set(xlabel="time [s]", ylabel="displacement of the toe [cm]", title=f"{loading} gravity",
                    ylim=(0, None))
        line[0].legend(fontsize="small")
        for axis, name, unit in zip(line[1:], QUANTITIES, ("m", "s", "J/m")):
            for rows, style, label in ((part["grids"], "o-", "GIMP, B-bar"), (part["second"], "kx:", "plain GIMP")):
                axis.plot([row["h"] for row in rows], [row[name] for row in rows], style, label=label)
            found = part[name]
            axis.errorbar([0], [found["value"]], [found["error"]], fmt="s", color="tab:red", capsize=4, clip_on=False,
                          label="reference")
            order = "no order" if found["order"] is None else f"order {found['order']:.2f}"
            axis.set(xlabel="cell size [m]", ylabel=f"{name.replace('_', ' ')} [{unit}]", title=order,
                     xlim=(-0.004, 0.105))
            axis.grid(alpha=0.3)
        line[1].legend(fontsize="small")
    figure.savefig(path, dpi=80)


def bands(path):
    """Plastic strain under ramped gravity, with the toe 10 cm out and in the end."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(15, 5.5), sharex=True, sharey=True, layout="constrained")
    for column, h in zip(axes.T, (0.05, 0.025, 0.0125)):
        scene, shown = vertical_cut(h, loading="ramped", room=ROOM), 0
        for state in scene.run(**CHOICE):
            toe, last = scene.toe_displacement(state), state.time >= scene.until
            if last or (toe >= FAILED and not shown):
                points, axis = state.particles, column[shown]
                axis.scatter(*points.x, c=points.history[0], s=(h / 0.05) ** 2 * 16, vmin=0, vmax=(0.5, 2.0)[shown],
                             cmap="magma_r", linewidths=0)
                axis.set(aspect="equal", xlim=(0, 2.8), ylim=(0, 1.05))
                axis.set_title(f"h = {h:g} m, t = {state.time:.2f} s, toe {100 * toe:.0f} cm", fontsize="small")
                shown += 1
    figure.savefig(path, dpi=70)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three coarse grids, written to --out only")
    parser.add_argument("--out", type=Path, help="where the JSON goes; the package's own file if not given")
    parser.add_argument("--compare", action="store_true", help="print how other choices do instead")
    parser.add_argument("--figure", type=Path, help="draw what is stored instead")
    parser.add_argument("--bands", type=Path, help="draw plastic strain on three grids instead")
    options = parser.parse_args()
    if options.quick and not (options.out or options.compare):
        parser.error("--quick: give --out; the reference is not for three coarse grids.")
    warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")
    if options.figure:
        draw(options.figure)
    elif options.bands:
        bands(options.bands)
    elif options.compare:
        compare(FINER[:3 if options.quick else 4])
    else:
        line = "python benchmarks/cut_reference.py" + " --quick" * options.quick
        few = 3 if options.quick else None
        found = {loading: reference(loading, sizes[:few], FINER[:few]) for loading, sizes in SIZES.items()}
        write(options.out or FILE, about(line) | found)
