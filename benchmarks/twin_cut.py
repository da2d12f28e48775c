"""Is stress smoother, and the band sharper, where it is a field?  The vertical cut with points and with the twin.

Every case runs to 10 cm of displacement at the toe, and if asked for to run-out at 50 cm.  Prints, as a table, steps,
noise of the horizontal stress (rms, % of unit weight times height), median deviation of mean stress from a plane
through the 16 nearest points [kPa], largest plastic strain, energy balance, and time per point and step.

    python benchmarks/twin_cut.py                           both loadings at h = 0.1, all methods
    python benchmarks/twin_cut.py --h 0.05 --loading ramped
    python benchmarks/twin_cut.py --h 0.05 --loading ramped --figure docs/figures/twin_cut.png
"""

import argparse
import time

import numpy as np
from scipy.spatial import cKDTree

from skfem_mpm.scenes import vertical_cut

CASES = {"mpm": {"method": "mpm"}, "gimp": {"method": "gimp"}, "cmpm-c": {"method": "cmpm-c"},
         "twin": {"integration": "twin"}, "twin2": {"integration": "twin2"}, "dual": {"integration": "dual"},
         "dual, gimp": {"method": "gimp", "integration": "dual"}}
SHOWN = {"gimp": CASES["gimp"], "twin2": CASES["twin2"], "gimp, B-bar": CASES["gimp"] | {"remedy": "bbar"},
         "twin2, B-bar": CASES["twin2"] | {"remedy": "bbar"}}
MARKS = {"10 cm": 0.10, "run-out (50 cm)": 0.50}


def deviations(state, kind=np.median):
    """Deviation of mean stress from a least-squares plane through the 16 nearest points."""
    x, mean = state.particles.x, state.particles.sigma[:3].mean(axis=0)
    _, near = cKDTree(x.T).query(x.T, k=16)
    basis = np.concatenate([np.ones((1, *near.shape)), x[:, near] - x[:, :, None]]).transpose(1, 2, 0)
    plane = np.linalg.pinv(basis) @ mean[near][:, :, None]
    return kind(abs(mean - plane[:, 0, 0]))


def states(h, loading, choices, marks):
    """States at the marks, and the time per point and step that it took to get there."""
    scene, marks, begin = vertical_cut(h=h, loading=loading, room=3.0), list(marks), time.perf_counter()
    for state in scene.run(steps=100_000, **choices):
        if scene.toe_displacement(state) >= marks[0]:
            yield scene, state, (time.perf_counter() - begin) / (state.step * scene.particles.n) * 1e6
            marks.pop(0)
        if not marks:
            return


def table(h, loading):
    print(f"\nh = {h}, {loading}\n{'':14}{'steps':>7}{'noise %':>9}{'median kPa':>12}{'plastic':>9}{'balance %':>11}"
          f"{'us':>7}")
    for name, choices in (CASES | SHOWN).items():
        for scene, state, cost in states(h, loading, choices, [MARKS["10 cm"]]):
            print(f"{name:14}{state.step:7}{100 * scene.roughness(state):9.2f}{deviations(state) / 1e3:12.4f}"
                  f"{state.particles.history.max():9.3f}{100 * scene.energy_balance(state):11.2f}{cost:7.1f}",
                  flush=True)


def draw(h, loading, path):
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2 * len(MARKS), len(SHOWN), figsize=(20, 8.4), layout="constrained")
    for column, (name, choices) in enumerate(SHOWN.items()):
        for k, (mark, (scene, state, _)) in enumerate(zip(MARKS, states(h, loading, choices, MARKS.values()))):
            p, late = state.particles, mark != "10 cm"
            fields = [("mean stress [kPa]", p.sigma[:3].mean(axis=0) / 1e3, (-15, 5), "viridis"),
                      ("plastic strain", p.history[0], (0, 2.0 if late else 0.5), "magma_r")]
            for axis, (title, value, limits, colours) in zip(axes[2 * k:2 * k + 2, column], fields):
                cloud = axis.scatter(*p.x, c=value, s=(h / 0.05) ** 2 * 14, marker="s", linewidths=0, cmap=colours,
                                     vmin=limits[0], vmax=limits[1])
                axis.set(aspect="equal", xlim=(0, 3.0 if late else 2.2), ylim=(0, 1.05))
                axis.set_title(f"{name}, {mark}: {title}", fontsize="small")
                figure.colorbar(cloud, ax=axis, shrink=0.8)
            print(f"{name:14}{mark:16} median {deviations(state) / 1e3:.4f} kPa, sigma_xx {p.sigma[0].min() / 1e3:.0f} "
                  f"to {p.sigma[0].max() / 1e3:.0f} kPa, mean stress in the band (plastic strain > 0.3) "
                  f"{band(state):.2f} kPa rough, plastic {p.history.max():.2f}", flush=True)
    figure.savefig(path, dpi=75)


def band(state):
    """Median deviation of mean stress in the band [kPa]."""
    chosen = state.particles.history[0] > 0.3
    return deviations(state, lambda off: np.median(off[chosen])) / 1e3 if chosen.any() else np.nan


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--h", type=float, default=0.1, help="cell size")
    parser.add_argument("--loading", nargs="+", default=["ramped", "sudden"], help="ramped, sudden or both")
    parser.add_argument("--figure", help="draw into this file instead, for the first loading")
    options = parser.parse_args()
    if options.figure:
        draw(options.h, options.loading[0], options.figure)
    else:
        for loading in options.loading:
            table(options.h, loading)
