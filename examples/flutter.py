"""Which methods make elastic waves grow in an explicit run, how fast, and what helps?

In the paper's CMPM (Gonzalez Acosta, Vardon and Hicks 2017) strain is recovered by wider functions than those that
carry the force.  The operator of an explicit step is then unsymmetric; where its eigenvalues, the squares of
frequencies, are complex, waves grow at any time step.  Here are these eigenvalues, for every method, on frozen layouts
in 1-D and 2-D, in a free body and in an infinite one; the energy of a free elastic block over many steps, once with
points that stay and once with points that drift through cells; and what remedies do.  Writes, under results/flutter/ or
--out,

  flutter.png, growth.csv          largest growth over the shift of the points, energy over steps
  jitter.csv                       largest growth with points moved at random
  energy.csv                       energy over steps
  flutter_stress.png               stress of cmpm when its energy has grown threefold, and of cmpm-c at that time
  remedies.csv                     growth with remedies: of a layout, and over many steps

Cells have the size h = 1, and pressure waves the speed c = 1: frequencies and growth rates are in c/h, times in h/c.
"""

import argparse
import csv
import importlib.util
import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron
from skfem import MeshLine, MeshQuad
from tqdm import tqdm

from skfem_mpm import METHODS, LinearElastic, Particles, UnstableError, explicit_steps, plane_strain, uniaxial
from skfem_mpm.explicit.nodes import Nodes
from skfem_mpm.grid import Grid
from skfem_mpm.integration import on_points

warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")     # that is the question
warnings.filterwarnings("ignore", message="guards: ")
COLOURS = dict(zip(METHODS, ["tab:red", "tab:blue", "tab:green", "tab:cyan", "tab:purple", "tab:orange"]))
SYMMETRIC = [name for name, method in METHODS.items() if method.strain is method.force]
MAKE = {1: MeshLine, 2: MeshQuad.init_tensor}
MOTION = {1: uniaxial, 2: plane_strain}
LAW = {1: LinearElastic(E=1.0, nu=0.0), 2: LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3)}       # pressure waves of speed 1

SAFETY = 0.8        # time steps as a share of the stable one: long ones, for 50 000 of them

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="fewer shifts, a smaller block and fewer steps")
parser.add_argument("--out", type=Path, default=Path("results/flutter"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
shifts = {1: np.linspace(0, 1, 13 if options.quick else 41), 2: np.linspace(0, 1, 5 if options.quick else 41)}
seeds, waves = (1, 12) if options.quick else (10, 24)
cells, steps, every, passes = (4, 200, 10, 4) if options.quick else (10, 50_000, 25, 60)
# In the full run steps are so many that numba pays far below the size from which `auto` takes it.
engine = "numba" if importlib.util.find_spec("numba") and not options.quick else "auto"


def write(name, rows):
    with open(options.out / name, "w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


def body_of(dim, cells, shift=0.0, jitter=0.0, seed=0, room=0):
    """A free body of cells with two points per direction, in an empty grid; its points shifted, or moved at random."""
    body = Particles.fill(MAKE[dim](*[np.arange(cells + 1.0)] * dim), MOTION[dim])
    noise = np.random.default_rng(seed).uniform(-1, 1, body.x.shape)
    return MAKE[dim](*[np.arange(-4.0, cells + room + 5)] * dim), replace(body, x=body.x + shift + jitter * noise)


# -- eigenvalues of the step on frozen layouts ------------------------------------------------------------------------


def operators(mesh, body, method):
    """The nodes of a step, and stiffness and consistent mass over their components (component fastest)."""
    nodes = Nodes(Grid.from_mesh(mesh), body.kinematics, body.x, body.mass, body.length, METHODS[method], "ghost", ())
    points = on_points(body.kinematics, nodes.force.stencil, nodes.strain.stencil, body.volume, body.x[0])
    dim, size = body.dim, nodes.grid.nnodes
    moduli = LAW[dim].tangent(None, None, None, body.kinematics.rows(dim))
    stiffness = points.tangent(moduli, np.arange(dim * size).reshape(size, dim).T, dim * size)
    value = nodes.mapping.value
    return nodes, stiffness, kron(value.T @ diags_array(body.mass) @ value, eye_array(dim))


def rate(eigenvalues):
    """Largest growth rate: of the frequencies, the imaginary part."""
    return abs(np.sqrt(eigenvalues.astype(complex)).imag).max()


def growth_of_body(mesh, body, method):
    """Growth rates of a free body: strain from nodal velocities as they are, and mapped to the points and back."""
    nodes, stiffness, mass = operators(mesh, body, method)
    spread = nodes.spread(np.eye(nodes.grid.nnodes)[nodes.active])          # light nodes follow active ones
    spread = kron(csr_array(spread), eye_array(body.dim))
    scale = diags_array(np.repeat(nodes.mass[nodes.active], body.dim) ** -0.5)
    once = (scale @ spread @ stiffness @ spread.T @ scale).toarray()
    return (rate(np.linalg.eigvals(once)),
            rate(np.linalg.eigvals((scale @ spread @ mass @ spread.T @ scale).toarray() @ once)))


def growth_of_waves(mesh, body, method):
    """The same of an infinite body with this layout in every cell, from plane waves at a node in its middle."""
    nodes, stiffness, mass = operators(mesh, body, method)
    dim, shape = body.dim, nodes.grid.vertices.shape
    place = np.indices(shape).reshape(dim, -1)
    middle = np.ravel_multi_index([size // 2 for size in shape], shape)
    away = place - place[:, [middle]]
    numbers = np.stack(np.meshgrid(*[2 * np.pi * np.arange(waves) / waves] * dim)).reshape(dim, -1)
    phases = np.exp(1j * numbers.T @ away)                                  # (waves, nodes)
    rows = slice(dim * middle, dim * middle + dim)

    def symbol(matrix):
        blocks = csr_array(matrix)[rows].toarray().reshape(dim, -1, dim)
        return np.einsum("wn,inj->wij", phases, blocks) / nodes.mass[middle]

    once, mapped = symbol(stiffness), symbol(mass)
    return rate(np.linalg.eigvals(once)), rate(np.linalg.eigvals(mapped @ once))


growth, jitter = [], []
for dim, size in [(1, 20), (2, 6)]:
    for method in tqdm(METHODS, desc=f"eigenvalues in {dim}-D", leave=False):
        for shift in shifts[dim]:
            for extent, found, n in [("free", growth_of_body, size), ("infinite", growth_of_waves, 9)]:
                direct, mapped = found(*body_of(dim, n, shift), method)
                growth.append({"dim": dim, "body": extent, "method": method, "shift": shift, "direct": direct,
                               "mapped": mapped})
        for amount in (0.02, 0.1, 0.25):
            found = np.array([growth_of_body(*body_of(dim, size, jitter=amount, seed=seed), method)
                              for seed in range(seeds)])
            jitter.append({"dim": dim, "method": method, "jitter": amount, "direct": found[:, 0].max(),
                           "mapped": found[:, 1].max(), "mapped_median": np.median(found[:, 1])})
write("growth.csv", growth)
write("jitter.csv", jitter)


def along(dim, extent, method, column):
    """Growth over the shift."""
    wanted = (dim, extent, method)
    return np.array([row[column] for row in growth if (row["dim"], row["body"], row["method"]) == wanted])


# -- energy of a free block over many steps ---------------------------------------------------------------------------

STAY, DRIFT, HALVED = "points that stay", "points that drift", "points that drift, half the time step"
CASES = {STAY: (0.0, 0.0), DRIFT: (1e-3, 0.6e-3)}           # common velocity
SPEED = {STAY: 1e-6, DRIFT: 1e-3}                           # of the waves; at 1e-6 no point changes its place
SHIFT = {STAY: 0.24, DRIFT: 0.0}                            # of the points at the start


if options.quick:
    del CASES[DRIFT]                                        # in a few steps nothing gets anywhere
shown = list(CASES)[-1]


def block_of(case, size=cells):
    """A block that rings in its lowest modes, with a tenth of random velocities on top."""
    shift = SHIFT[case]
    mesh, body = body_of(2, size, shift, room=0 if case == STAY else 40)
    noise = np.random.default_rng(7).uniform(-1, 1, body.x.shape)
    wave = np.cos(np.pi * (body.x - shift) / size) + 0.1 * noise
    wave -= wave.mean(axis=1, keepdims=True)
    return mesh, replace(body, velocity=np.array(CASES[case])[:, None] + SPEED[case] * wave)


def ringing(case, method, steps=steps, every=every, **choices):
    """Snapshots, each with its energy relative to the start; that of the drift, which no method changes, left out."""
    mesh, body = block_of(case)
    drift = body.mass.sum() * np.sum(np.square(CASES[case])) / 2
    start = (body.mass * (body.velocity ** 2).sum(axis=0)).sum() / 2 - drift
    for state in explicit_steps(mesh, body, LAW[2], steps=steps, every=every, method=method, engine=engine,
                                **{"safety": SAFETY} | choices):
        yield state, (state.energy["kinetic"] + state.energy["elastic"] - drift) / start


def energies(case, method, **choices):
    """Steps, times and energies, and the step at which the run was stopped, if it was."""
    found, stopped = [(0, 0.0, 1.0)], None
    try:
        for state, energy in ringing(case, method, **choices):
            found.append((state.step, state.time, energy))
    except UnstableError as failure:
        stopped = int(str(failure).split(":")[0].removeprefix("step "))
    return np.array(found), stopped


runs = {(case, method): energies(case, method) for case in CASES for method in tqdm(METHODS, desc=case, leave=False)}
if not options.quick:
    runs |= {(HALVED, method): energies(DRIFT, method, safety=0.4) for method in ("mpm", "cmpm-c")}
write("energy.csv", [{"case": case, "method": method, "step": int(step), "time": time, "energy": energy,
                      "stopped": stopped or ""}
                     for (case, method), (found, stopped) in runs.items() for step, time, energy in found
                     if step <= 1000 or step % 500 == 0])

# -- remedies ---------------------------------------------------------------------------------------------------------

REMEDIES = [("cmpm", {}), ("cmpm", {"safety": 0.4}), ("cmpm", {"safety": 0.1}), ("cmpm", {"integrator": "usf"}),
            ("cmpm", {"integrator": "usl"}), ("cmpm", {"integrator": "usl", "safety": 0.1}),
            ("cmpm", {"damping": 0.05}), ("cmpm", {"flip": 0.95}), ("cmpm", {"xpic": 2}), ("cmpm", {"xpic": 5}),
            ("gc", {}), ("cmpm-c", {}), ("gimp", {}), ("gimp", {"integrator": "usl"}),
            ("gimp", {"flip": 0.95}), ("gimp", {"xpic": 2})]
if options.quick:
    REMEDIES = [("cmpm", {}), ("cmpm", {"damping": 0.05}), ("cmpm", {"flip": 0.95}), ("cmpm-c", {})]


def growth_of_step(method, choices):
    """Growth rate by power iteration with the real step: pieces of a run, scaled back to the layout and the size."""
    mesh, body = block_of(STAY, 6)
    start, taken = body, []
    piece = round(20 / choices.get("safety", SAFETY))
    for _ in range(passes):
        *_, state = explicit_steps(mesh, body, LAW[2], steps=piece, every=piece, method=method,
                                   engine=engine, guards={"energy": "off"}, **{"safety": SAFETY} | choices)
        size = np.sqrt((state.energy["kinetic"] + state.energy["elastic"]) / 1e-12)
        taken.append((np.log(size), state.time))
        points = state.particles
        body = replace(start, velocity=points.velocity / size, sigma=points.sigma / size)
    logs, times = np.transpose(taken[2 * passes // 3:])
    return logs.sum() / times.sum()


remedies = []
for method, choices in tqdm(REMEDIES, desc="remedies", leave=False):
    found, stopped = energies(shown, method, steps=min(steps, 5000), **choices)
    remedies.append({"method": method, "choices": " ".join(f"{k}={v}" for k, v in choices.items()),
                     "growth": growth_of_step(method, choices), "stopped": stopped or "",
                     "steps": stopped or int(found[-1, 0]), "time": found[-1, 1], "energy": found[-1, 2]})
write("remedies.csv", remedies)

# -- pictures ---------------------------------------------------------------------------------------------------------


def panel_of_growth(axis, dim, title):
    for method in METHODS:
        for extent, style in [("free", "-"), ("infinite", ":")]:
            axis.plot(shifts[dim], along(dim, extent, method, "mapped"), style, color=COLOURS[method])
    axis.text(0.5, 0.1, ",\n".join(SYMMETRIC) + ":\nzero", ha="center")
    axis.set(title=title, xlabel="shift of all points from quarter points [$h$]",
             ylabel=r"largest growth rate Im $\omega$ [$c/h$]", ylim=(-0.006, 0.21))
    axis.grid(alpha=0.3)


def panel_of_energy(axis, case, title):
    for method in METHODS:
        found, stopped = runs[case, method]
        axis.plot(found[1:, 0], found[1:, 2], color=COLOURS[method], label=method)
        if stopped:
            axis.plot(*found[-1, [0, 2]], "x", color=COLOURS[method], markersize=9)
    axis.set(title=title, xlabel="step", ylabel="energy / energy at the start", xscale="log", yscale="log")
    axis.grid(alpha=0.3)


figure, axes = plt.subplots(1, 3, figsize=(16, 5.4), layout="constrained")
panel_of_growth(axes[0], 1, "(a) bar of 20 cells, frozen")
panel_of_growth(axes[1], 2, "(b) block of 6 x 6 cells, shifted along its diagonal, frozen")
panel_of_energy(axes[2], shown, f"(c) free block of {cells} x {cells} cells, {shown}")
axes[2].plot([], [], "k-", label="free body")
axes[2].plot([], [], "k:", label="infinite body")
axes[2].plot([], [], "kx", label="stopped by UnstableError")
figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=9)
figure.savefig(options.out / "flutter.png", dpi=100)

# Stress of cmpm when it has three times its energy, and of cmpm-c at the same time.

for failing, energy in ringing(shown, "cmpm", every=1):
    if energy > 3:
        break
for fine, _ in ringing(shown, "cmpm-c", every=1):
    if fine.time >= failing.time:
        break
figure, axes = plt.subplots(1, 2, figsize=(10, 5), sharex=True, sharey=True, layout="constrained")
limit = 1e3 * np.quantile(abs(failing.particles.sigma[0]), 0.98)
for axis, name, state in zip(axes, ("cmpm", "cmpm-c"), (failing, fine)):
    cloud = axis.scatter(*state.particles.x, c=1e3 * state.particles.sigma[0], s=(10 / cells) ** 2 * 110, marker="s",
                         linewidths=0, vmin=-limit, vmax=limit, cmap="coolwarm")
    axis.set(title=f"{name}, step {state.step}, $t$ = {state.time:.0f} $h/c$", aspect="equal", xlabel="$x$ [$h$]",
             ylabel="$y$ [$h$]")
figure.colorbar(cloud, ax=axes, extend="both", label=r"horizontal stress [$10^{-3} \rho c^2$]")
figure.savefig(options.out / "flutter_stress.png", dpi=90)

# -- the answer -------------------------------------------------------------------------------------------------------

print("\nLargest growth rate Im omega over all shifts of a frozen layout [c/h]; strain from velocities as they are at "
      "the nodes (direct), or mapped to the points and back (mapped: musl, usf)")
print(f"{'':34}" + "".join(f"{method:>10}" for method in METHODS))
for dim, title in [(1, "bar"), (2, "block")]:
    for extent in ("free", "infinite"):
        for column in ("direct", "mapped"):
            print(f"{f'{dim}-D, {extent} {title}, {column}':34}"
                  + "".join(f"{along(dim, extent, method, column).max():10.4f}" for method in METHODS))
print("Free bar shifted by 0.24 h: " + ", ".join("{} {:.4f} (mapped {:.4f})".format(
    method, *growth_of_body(*body_of(1, 20, SHIFT[STAY]), method)) for method in METHODS if method not in SYMMETRIC))
print("Free block shifted by 0.24 h: " + ", ".join("{} {:.4f} (mapped {:.4f})".format(
    method, *growth_of_body(*body_of(2, 6, SHIFT[STAY]), method)) for method in METHODS if method not in SYMMETRIC))
end = min(found[-1, 1] for found, stopped in runs.values() if not stopped)
for case in dict.fromkeys(case for case, _ in runs):
    print(f"\nFree block of {cells} x {cells} cells, {case}, energy relative to the start:")
    for (_, method), (found, stopped) in [(key, run) for key, run in runs.items() if key[0] == case]:
        till = f"stopped at step {stopped}" if stopped else f"step {int(found[-1, 0])}"
        common = "" if stopped else f"; at t = {end:.0f} h/c {np.interp(end, *found[:, 1:].T):.4f}"
        print(f"  {method:8} {found[-1, 2]:8.4f} at the end, {found[:, 2].max():8.4f} at most, {till}{common}")
print("\nRemedies: growth of the real step, block of 6 x 6 cells frozen at a shift of 0.24 h [c/h]; and a free block:")
for row in remedies:
    end = "stopped at step" if row["stopped"] else f"energy {row['energy']:.3g} after step"
    print(f"  {row['method']:8}{row['choices']:30}{row['growth']:10.4f}   {end} {row['steps']}")
print(f"Pictures and tables are in {options.out}.")
