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
  flutter_stress.png               stress of cmpm just before it stops, beside that of cmpm-c at the same time
  remedies.csv                     growth with remedies: of a layout, and over many steps

Cells have the size h = 1, and pressure waves the speed c = 1: frequencies and growth rates are in c/h, times in h/c.
"""

import argparse
import csv
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
from skfem_mpm.integration import PointIntegration

warnings.filterwarnings("ignore", message="the strain of this method is not conjugate")     # that is the question
COLOURS = dict(zip(METHODS, ["tab:red", "tab:blue", "tab:green", "tab:cyan", "tab:purple", "tab:orange"]))
SYMMETRIC = [name for name, method in METHODS.items() if method.strain is method.force]
MAKE = {1: MeshLine, 2: MeshQuad.init_tensor}
MOTION = {1: uniaxial, 2: plane_strain}
LAW = {1: LinearElastic(E=1.0, nu=0.0), 2: LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3)}       # pressure waves of speed 1

# -- options ----------------------------------------------------------------------------------------------------------

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--quick", action="store_true", help="fewer shifts, a smaller block and fewer steps")
parser.add_argument("--out", type=Path, default=Path("results/flutter"), help="where pictures and tables go")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
shifts = {1: np.linspace(0, 1, 26 if options.quick else 201), 2: np.linspace(0, 1, 11 if options.quick else 51)}
seeds = 2 if options.quick else 20
cells, steps, every = (5, 400, 10) if options.quick else (16, 50_000, 50)
passes = 6 if options.quick else 24


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


# -- eigenvalues of the step on frozen layouts --------------------------------------------------------------------------


def operators(mesh, body, method):
    """The nodes of a step, and stiffness and consistent mass over their components (component fastest)."""
    nodes = Nodes(Grid.from_mesh(mesh), body.kinematics, body.x, body.mass, body.length, METHODS[method], "ghost", ())
    points = PointIntegration(body.kinematics, nodes.force.stencil, nodes.strain.stencil, body.volume, body.x[0])
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


def growth_of_waves(mesh, body, method, count=24):
    """The same of an infinite body with this layout in every cell, from plane waves at a node in its middle."""
    nodes, stiffness, mass = operators(mesh, body, method)
    dim, shape = body.dim, nodes.grid.vertices.shape
    place = np.indices(shape).reshape(dim, -1)
    middle = np.ravel_multi_index([size // 2 for size in shape], shape)
    away = place - place[:, [middle]]
    numbers = np.stack(np.meshgrid(*[2 * np.pi * np.arange(count) / count] * dim)).reshape(dim, -1)
    waves = np.exp(1j * numbers.T @ away)                                   # (waves, nodes)
    rows = slice(dim * middle, dim * middle + dim)

    def symbol(matrix):
        blocks = csr_array(matrix)[rows].toarray().reshape(dim, -1, dim)
        return np.einsum("wn,inj->wij", waves, blocks) / nodes.mass[middle]

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
    return np.array([row[column] for row in growth if (row["dim"], row["body"], row["method"]) == (dim, extent, method)])


# -- energy of a free block over many steps -----------------------------------------------------------------------------

SPEED = 1e-3
DRIFT = {"points that stay": (0.0, 0.0), "points that drift": (SPEED, 0.6 * SPEED)}


def block_of(case, size=cells, shift=0.24):
    """A block with small random velocities; one that stays has so small ones that no point changes its place."""
    mesh, body = body_of(2, size, shift, room=0 if case == "points that stay" else 32)
    noise = np.random.default_rng(7).uniform(-1, 1, body.x.shape)
    noise -= noise.mean(axis=1, keepdims=True)
    common = np.array(DRIFT[case])[:, None]
    return mesh, replace(body, velocity=common + (SPEED if common.any() else 1e-3 * SPEED) * noise)


def energies(case, method, state=None, **choices):
    """Steps, times and energies (without that of the drift, relative to the start), the last snapshot, the stop."""
    mesh, body = block_of(case)
    drift = body.mass.sum() * np.sum(np.square(DRIFT[case])) / 2
    start = (body.mass * (body.velocity ** 2).sum(axis=0)).sum() / 2 - drift
    found, stopped = [(0, 0.0, 1.0)], None
    try:
        for state in explicit_steps(mesh, body, LAW[2], steps=steps, every=every, method=method, **choices):
            stored = state.energy["kinetic"] + state.energy["elastic"] - drift
            found.append((state.step, state.time, stored / start))
    except UnstableError as failure:
        stopped = int(str(failure).split(":")[0].removeprefix("step "))
    return np.array(found), state, stopped


runs = {(case, method): energies(case, method) for case in DRIFT for method in tqdm(METHODS, desc=case, leave=False)}
write("energy.csv", [{"case": case, "method": method, "step": int(step), "time": time, "energy": energy,
                      "stopped": stopped or ""}
                     for (case, method), (found, _, stopped) in runs.items() for step, time, energy in found])

# -- remedies -----------------------------------------------------------------------------------------------------------

REMEDIES = [("cmpm", {}), ("cmpm", {"safety": 0.4}), ("cmpm", {"safety": 0.1}), ("cmpm", {"integrator": "usf"}),
            ("cmpm", {"integrator": "usl"}), ("cmpm", {"damping": 0.05}), ("cmpm", {"flip": 0.95}),
            ("cmpm", {"xpic": 2}), ("cmpm", {"xpic": 5}), ("gc", {}), ("cmpm-c", {}), ("gimp", {}),
            ("gimp", {"flip": 0.95}), ("gimp", {"xpic": 5})]


def growth_of_step(method, choices, piece=25):
    """Growth rate by power iteration with the real step: pieces of a run, scaled back to the layout and the size."""
    mesh, body = block_of("points that stay", 6)
    start, taken = body, []
    for _ in range(passes):
        *_, state = explicit_steps(mesh, body, LAW[2], steps=piece, every=piece, method=method, **choices)
        size = np.sqrt((state.energy["kinetic"] + state.energy["elastic"]) / 1e-12)
        taken.append((np.log(size), state.time))
        points = state.particles
        body = replace(start, velocity=points.velocity / size, sigma=points.sigma / size)
    logs, times = np.transpose(taken[passes // 2:])
    return logs.sum() / times.sum()


remedies = []
for method, choices in tqdm(REMEDIES, desc="remedies", leave=False):
    found, _, stopped = (runs["points that drift", method] if not choices else
                         energies("points that drift", method, **choices))
    remedies.append({"method": method, "choices": " ".join(f"{k}={v}" for k, v in choices.items()),
                     "growth": growth_of_step(method, choices), "stopped": stopped or "",
                     "steps": stopped or int(found[-1, 0]), "time": found[-1, 1], "energy": found[-1, 2]})
write("remedies.csv", remedies)

# -- pictures -----------------------------------------------------------------------------------------------------------


def panel_of_growth(axis, dim, title):
    for method in METHODS:
        for extent, style in [("free", "-"), ("infinite", ":")]:
            label = method if extent == "free" else None
            axis.plot(shifts[dim], along(dim, extent, method, "mapped"), style, color=COLOURS[method], label=label)
    axis.plot([], [], "k:", label="infinite body")
    axis.set(title=title, xlabel="shift of all points s [h]", ylabel="largest growth rate Im ω [c/h]", ylim=(-0.004, 0.2))
    axis.legend(fontsize="small", ncols=2)
    axis.grid(alpha=0.3)


def panel_of_energy(axis, case, title):
    for method in METHODS:
        found, _, stopped = runs[case, method]
        axis.plot(found[:, 0], found[:, 2], color=COLOURS[method], label=method)
        if stopped:
            axis.plot(*found[-1, [0, 2]], "x", color=COLOURS[method], markersize=9)
    axis.plot([], [], "kx", label="stopped (UnstableError)")
    axis.set(title=title, xlabel="step", ylabel="energy / energy at the start", xscale="log", yscale="log")
    axis.legend(fontsize="small", loc="upper right")
    axis.grid(alpha=0.3)


figure, axes = plt.subplots(1, 3, figsize=(16, 5), layout="constrained")
panel_of_growth(axes[0], 1, "(a) frozen bar, 20 cells")
panel_of_growth(axes[1], 2, "(b) frozen block, 6 x 6 cells, shifted along the diagonal")
panel_of_energy(axes[2], "points that drift", f"(c) free block of {cells} x {cells} cells that drifts")
figure.savefig(options.out / "flutter.png", dpi=100)
