"""How likely is it that a vertical cut fails whose cohesion varies from place to place?

The cut of skfem_mpm.scenes.vertical_cut (1 m high, softening soil, smooth base) with a cohesion that is a lognormal
random field, many times over, on any number of workers; the answer has a 95 % confidence interval (Clopper and
Pearson).  Writes, under results/random_cut/ or --out,

  random_cut.png          a realisation that fails and one that stands, and the estimate over the number of realisations
  random_cut.csv          a row for each realisation
  realisations.jsonl      the same as they came; --resume goes on from it

Cohesion is sampled at the middles of cells, where its logarithm is Gaussian with correlation exp(-2 |dx| / lx
- 2 |dy| / ly): the Cholesky factor of the correlation matrix times independent normal numbers, exact at the middles.
The points of a cell share its cohesion c.  VonMises has one peak for the whole body; points start with the plastic
strain (c - peak) / softening, negative where c is above the peak, and so at c on their own softening line.

All numbers of the field, of gravity (ramped over 0.5 s) and of the grid are ours.  The mean of 9 kPa was chosen such
that the uniform cut stands (on this grid it fails at 7.25 kPa and stands at 7.5; one of rigid, perfectly plastic soil
stands from 20 / 3.776 = 5.3 kPa on) and that chance decides.  A cut has failed when its toe is 10 cm out, where elastic
strain takes it 3 to 4 cm, or if after 2.5 s it still moves on by more than 0.5 cm in 0.25 s.
"""

import argparse
import csv
import warnings
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from skfem_mpm import VonMises
from skfem_mpm.scenes import vertical_cut
from skfem_mpm.study import ensemble, generator

SOIL = VonMises(E=400e3, nu=0.35, peak=9e3, residual=1e3, softening=-25e3)          # its peak is the mean cohesion
FIELD = {"variation": 0.3, "lengths": (2.0, 0.5)}       # coefficient of variation, scales of fluctuation (x, y) [m]
OUT, SPAN, MOVES, END = 0.1, 0.25, 0.005, 2.5           # what failure is [m, s, m], and how long a cut is watched [s]

# -- one realisation --------------------------------------------------------------------------------------------------


def cohesion(x, h, rng, variation, lengths):
    """Lognormal cohesion at points ``x`` in cells of size ``h``; mean is the peak of the soil."""
    middles, cell = np.unique(np.floor(x / h) * h + h / 2, axis=1, return_inverse=True)
    apart = np.abs(middles[:, :, None] - middles[:, None, :])
    correlation = np.exp(-2 * sum(along / length for along, length in zip(apart, lengths)))
    spread = np.log(1 + variation ** 2)                 # variance of the logarithm
    normal = np.linalg.cholesky(correlation) @ rng.standard_normal(middles.shape[1])
    return (SOIL.peak * np.exp(np.sqrt(spread) * normal - spread / 2))[cell.ravel()]


def cut(rng, h, **field):
    """The scene with a cohesion of its own at each point, and that cohesion."""
    scene = vertical_cut(h, loading="ramped", material=SOIL)
    c = cohesion(scene.particles.x, h, rng, **field)
    history = ((c - SOIL.peak) / SOIL.softening)[None, :]
    return replace(scene, particles=replace(scene.particles, history=history)), c


def watched(scene):
    """Displacements of the toe, and the last state."""
    toe = [0.0]
    for state in scene.run("gimp", steps=100_000, every_seconds=SPAN / 5):
        toe.append(scene.toe_displacement(state))
        if toe[-1] > OUT or state.time > END:
            return toe, state


def realisation(number, rng, h, **field):
    """Whether the cut fails, and what goes with it."""
    scene, c = cut(rng, h, **field)
    toe, state = watched(scene)
    failed = toe[-1] > OUT or toe[-1] - toe[-6] > MOVES
    return {"failed": failed, "toe": toe[-1], "time": state.time, "cohesion_mean": c.mean(), "cohesion_min": c.min(),
            "eps_p_max": (state.particles.history - scene.particles.history).max()}


# -- all of them ------------------------------------------------------------------------------------------------------

def options():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="12 realisations")
    parser.add_argument("--out", type=Path, default=Path("results/random_cut"), help="where picture and table go")
    parser.add_argument("--count", type=int, help="number of realisations (200)")
    parser.add_argument("--seed", type=int, default=1, help="of the random fields (%(default)s)")
    parser.add_argument("--workers", type=int, help="number of processes (one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead")
    parser.add_argument("--resume", action="store_true", help="go on with the realisations that are in the folder")
    chosen = parser.parse_args()
    if chosen.count is None:
        chosen.count = 12 if chosen.quick else 200
    return chosen


def dask(address):
    """A client of a Dask cluster (the extra `cluster`), or nothing."""
    if address is None:
        return nullcontext()
    from distributed import Client

    return Client(address)


def run(chosen, function):
    """The rows of all realisations, with a bar."""
    from tqdm import tqdm

    kept = chosen.out / "realisations.jsonl"
    if not chosen.resume:
        kept.unlink(missing_ok=True)
    with dask(chosen.scheduler) as client, tqdm(total=chosen.count, unit=" cuts", leave=False, disable=None) as bar:
        return ensemble(function, chosen.count, seed=chosen.seed, out=kept, workers=chosen.workers,
                        executor=client and client.get_executor(), progress=lambda done, _: bar.update(done - bar.n))


def estimates(failed):
    """Share of failures after each realisation, with its confidence interval: three arrays."""
    from scipy.stats import binomtest

    found = []
    for count, failures in enumerate(np.cumsum(failed), start=1):
        test = binomtest(int(failures), count)
        found.append((failures / count, *test.proportion_ci(0.95, method="exact")))
    return np.array(found).T


# -- the picture ------------------------------------------------------------------------------------------------------

def shown(figure, axes, chosen, row, h):
    """Cohesion and plastic strain of a realisation at its end."""
    scene, c = cut(generator(chosen.seed, row["number"]), h, **FIELD)
    _, state = watched(scene)
    slip = (state.particles.history - scene.particles.history)[0]
    word = "fails" if row["failed"] else "stands"
    for axis, value, limits, colours, label in [(axes[0], c / 1e3, (4, 14), "viridis", "cohesion at first yield [kPa]"),
                                                (axes[1], slip, (0, 0.2), "magma_r", "plastic strain")]:
        cloud = axis.scatter(*state.particles.x, c=value, s=17, marker="s", linewidths=0, cmap=colours, vmin=limits[0],
                             vmax=limits[1])
        axis.plot([0, 2, 2], [1, 1, 0], "k:", linewidth=0.8)
        axis.set(aspect="equal", xlim=(-0.05, 2.3), ylim=(-0.05, 1.08), xlabel="x [m]", ylabel="y [m]")
        axis.set_title(f"realisation {row['number']} {word}: t = {state.time:.2f} s, toe {100 * row['toe']:.1f} cm out",
                       fontsize="medium")
        figure.colorbar(cloud, ax=axis, label=label, extend="both" if limits[0] else "max")


def picture(chosen, rows, h):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplot_mosaic([["a", "b"], ["c", "d"], ["e", "e"]], height_ratios=[1, 1, 1.1])
    for failed, pair in [(1, "ab"), (0, "cd")]:
        row = next((row for row in rows if row["failed"] == failed), None)
        if row:
            shown(figure, [axes[name] for name in pair], chosen, row, h)
        else:
            for name in pair:
                axes[name].text(0.5, 0.5, "none fails" if failed else "none stands", ha="center")
                axes[name].set_axis_off()
    share, low, high = 100 * estimates([row["failed"] for row in rows])
    count = np.arange(1, len(rows) + 1)
    axes["e"].fill_between(count, low, high, alpha=0.25, label="95 % confidence interval (Clopper and Pearson)")
    axes["e"].plot(count, share, label="share of cuts that failed")
    axes["e"].set(xlabel="realisations", ylabel="probability of failure [%]", ylim=(0, 100), xlim=(1, len(rows)))
    axes["e"].legend()
    axes["e"].grid(alpha=0.3)
    figure.savefig(chosen.out / "random_cut.png", dpi=100)


# -- the answer -------------------------------------------------------------------------------------------------------

def main():
    chosen, h = options(), 0.1
    chosen.out.mkdir(parents=True, exist_ok=True)
    rows = run(chosen, partial(realisation, h=h, **FIELD))
    with open(chosen.out / "random_cut.csv", "w", newline="") as file:
        table = csv.DictWriter(file, ["number", "status", "failed", "toe", "time", "cohesion_mean", "cohesion_min",
                                      "eps_p_max"])
        table.writeheader()
        table.writerows(rows)
    decided = [row for row in rows if row["status"] == "finished"]
    if len(decided) < len(rows):
        warnings.warn(f"{len(rows) - len(decided)} realisations ended in an error and are left out, see the table.")
    if not decided:
        raise SystemExit("No realisation finished; the table says why.")
    picture(chosen, decided, h)
    share, low, high = 100 * estimates([row["failed"] for row in decided])[:, -1]
    failures = int(sum(row["failed"] for row in decided))
    print(f"{failures} of {len(decided)} cuts failed (seed {chosen.seed}).")
    print(f"The probability of failure is {share:.1f} %, with 95 % confidence between {low:.1f} and {high:.1f} %.")
    print(f"Picture and table are in {chosen.out}.")


if __name__ == "__main__":
    main()
