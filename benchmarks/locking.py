"""What does volumetric locking do to implicit steps, and does a mean dilation of cells cure it?

    python benchmarks/locking.py                        all tables as Markdown
    python benchmarks/locking.py --quick                coarse grids only
    python benchmarks/locking.py --csv all.csv          every number in a file
    python benchmarks/locking.py --figure locking.png   and a figure
    python benchmarks/locking.py --only cavity block    some of the scenes

Scenes: "cavity", a thick cylinder, radii 1 and 3, free outside, whose inner wall moves by 1e-6 (axial symmetry, nu =
0.4999, small strain, exact solution by Lame); "block", one of 2 x 2 between rough plates that approach by 2e-6 (plane
strain, nu = 0.4999, small strain; reference: Taylor-Hood finite elements); "strip", a rough rigid strip of width 1 that
is pressed 0.2 into perfectly plastic soil (plane strain, nu = 0.49, E / c = 200, logarithmic strain, 20 steps).
"""

import argparse
import csv
import itertools
import time

import numpy as np
import skfem
from skfem import MeshQuad
from skfem.helpers import ddot, div, sym_grad

from skfem_mpm import LinearElastic, NotConvergedError, Particles, VonMises, axisymmetric, implicit_steps, plane_strain
from skfem_mpm.boundary import FixedPlane, Wall

CHOICES = {"mpm": {"method": "mpm"}, "gimp": {"method": "gimp"}, "cmpm-c": {"method": "cmpm-c"},
           "twin": {"method": "mpm", "integration": "twin"}}
PRESSED = ("mpm", "gimp", "twin")
REMEDIES = ("none", "bbar")
STIFF = LinearElastic(E=1.0, nu=0.4999)
SOIL = VonMises(E=200.0, nu=0.49, peak=1.0, residual=1.0)
CELLS = {"cavity": (5, 10, 20, 40), "block": (4, 8, 16, 32), "strip": (4, 8, 16)}      # per unit in the last one
QUICK = {"cavity": (5, 10), "block": (4, 8), "strip": (4,)}
PUSH = 1e-6


def first(*scene, **choices):
    return next(implicit_steps(*scene, steps=1, strain="small", floor=1e-10, **choices))


# -- elastic bodies ---------------------------------------------------------------------------------------------------

def cavity(cells, choices):
    """Errors in % of the pressure of the inner wall, and of the radial stress over all points (rms)."""
    h = 2 / cells
    mesh = MeshQuad.init_tensor(1 + h * np.arange(-1, cells + 2), h * np.arange(-1, 3))
    body = Particles.fill(mesh, axisymmetric, where=lambda x: (x[0] > 1) & (x[0] < 3) & (x[1] > 0) & (x[1] < h))
    wall = Wall(np.array([[1.0, 1.0], [0.0, h]]), (PUSH, None), name="inner")
    state = first(mesh, body, STIFF, [FixedPlane(1, 0.0, -1), FixedPlane(1, h, 1), wall], **choices)
    # u = a r + b / r, free of stress at r = 3
    lam, G = STIFF.lam, STIFF.G
    a, b = np.linalg.solve([[1, 1], [2 * (lam + G), -2 * G / 9]], [PUSH, 0])
    pressure = -(2 * (lam + G) * a - 2 * G * b)
    exact = 2 * (lam + G) * a - 2 * G * b / body.x[0] ** 2
    error = np.sqrt(((state.particles.sigma[0] - exact) ** 2).mean()) / pressure
    return {"load": 100 * (state.reactions["inner"][0] / (h * pressure) - 1), "stress": 100 * error}


def block(cells, choices, known):
    """Error in % of the force between the plates; a quarter of the block, ``cells`` per edge."""
    h = 1 / cells
    axis = h * np.arange(-1, cells + 3)
    mesh = MeshQuad.init_tensor(axis, axis)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    along = np.linspace(0, 1, cells + 1)
    plate = Wall(np.stack([along, 1 + 0 * along]), (0.0, -PUSH), name="plate")
    state = first(mesh, body, STIFF, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1), plate], **choices)
    return {"load": 100 * (-state.reactions["plate"][1] / known - 1)}


def taylor_hood(cells=128):
    """Force between the plates by elements of second order for displacement and first order for pressure.

    The mesh is graded towards the corner.
    """
    axis = 1 - np.linspace(1, 0, cells + 1) ** 2
    mesh = MeshQuad.init_tensor(axis, axis)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=4)
    other = basis.with_element(skfem.ElementQuad1())
    A = skfem.BilinearForm(lambda u, v, w: 2 * STIFF.G * ddot(sym_grad(u), sym_grad(v))).assemble(basis)
    B = skfem.BilinearForm(lambda u, p, w: div(u) * p).assemble(basis, other)
    C = skfem.BilinearForm(lambda p, q, w: p * q / STIFF.lam).assemble(other)
    K = skfem.utils.bmat([[A, B.T], [B, -C]], format="csc")
    top = basis.get_dofs(lambda x: x[1] == 1)
    x = np.zeros(K.shape[0])
    x[top.all("u^2")] = -PUSH
    fixed = np.concatenate([top.all(), basis.get_dofs(lambda x: x[0] == 0).all("u^1"),
                            basis.get_dofs(lambda x: x[1] == 0).all("u^2")])
    x = skfem.solve(*skfem.condense(K, np.zeros(len(x)), x=x, D=np.unique(fixed)))
    return -(K @ x)[top.all("u^2")].sum()


# -- the strip --------------------------------------------------------------------------------------------------------

def strip(per_unit, choices, depth=0.2, steps=20):
    """Yields the depth and the load over width and cohesion; half of the strip, on soil 3 wide and 2 deep.

    The width counts half a cell beyond each of its last nodes, which is what the functions press.
    """
    h = 1 / per_unit
    mesh = MeshQuad.init_tensor(h * np.arange(-1, 3 * per_unit + 2), h * np.arange(-2 * per_unit - 1, 4))
    body = Particles.fill(mesh, plane_strain, where=lambda x: (x[0] > 0) & (x[0] < 3) & (x[1] > -2) & (x[1] < 0))
    along = np.linspace(0, 0.5, per_unit + 1)
    foot = Wall(np.stack([along, 0 * along]), (0.0, -depth / steps), name="strip")
    boundary = [FixedPlane(0, 0.0, -1), FixedPlane(0, 3.0, 1), FixedPlane(1, -2.0, -1, (0, 1)), foot]
    for state in implicit_steps(mesh, body, SOIL, boundary, steps=steps, ghost=0.1, tolerance=1e-8, **choices):
        yield state.step * depth / steps, -state.reactions["strip"][1] / ((0.5 + h / 2) * SOIL.peak), state


def penetration(cells, choices):
    """Depths, loads, and the noise of the pressure below the strip in the end."""
    rows, begin = [], time.process_time()
    try:
        for depth, load, state in strip(cells, choices):
            rows.append((depth, load))
    except NotConvergedError as failure:
        print(f"<!-- {choices} {cells}: {failure} -->", flush=True)
    if rows:
        sigma = state.particles.sigma
        below = (state.particles.x[0] < 0.5) & (state.particles.x[1] > -1)
        pressure = -sigma[:3, below].mean(axis=0)
        near = np.abs(state.particles.x[:, below, None] - state.particles.x[:, None, below]).max(axis=0) < 1 / cells
        noise = np.sqrt(((pressure - near @ pressure / near.sum(axis=1)) ** 2).mean())
    return rows, float(noise), time.process_time() - begin


# -- tables -----------------------------------------------------------------------------------------------------------

def markdown(title, head, rows):
    print(f"\n### {title}\n\n| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def heading(cells):
    return ["method", "remedy", *(str(count) for count in cells)]


def elastic(name, cells, found):
    """Tables of an elastic scene: one row for each choice."""
    known = [taylor_hood()] if name == "block" else []
    scene, rows = {"cavity": cavity, "block": block}[name], []
    for (method, choice), remedy in itertools.product(CHOICES.items(), REMEDIES):
        errors = [scene(count, {**choice, "remedy": remedy}, *known) for count in cells]
        for count, here in zip(cells, errors):
            found += [{"scene": name, "method": method, "remedy": remedy, "cells": count, "depth": "", "what": what,
                       "value": value} for what, value in here.items()]
        rows.append([method, remedy, *(" / ".join(f"{value:.2f}" for value in here.values()) for here in errors)])
    what = {"cavity": "error of the wall's pressure / of radial stress (rms, relative to that pressure), %",
            "block": "error of load, %"}[name]
    markdown(f"{name}: {what}, for so many cells", heading(cells), rows)


def plastic(name, cells, found):
    """The table of the strip."""
    rows = []
    for method, remedy in itertools.product(PRESSED, REMEDIES):
        row = [method, remedy]
        for count in cells:
            curve, noise, seconds = penetration(count, {**CHOICES[method], "remedy": remedy})
            found += [{"scene": name, "method": method, "remedy": remedy, "cells": count, "depth": depth,
                       "what": "load", "value": load} for depth, load in curve]
            found.append(found[-1] | {"what": "noise", "value": noise})
            row.append(f"{curve[len(curve) // 2 - 1][1]:.2f} / {curve[-1][1]:.2f} / {noise:.2f}")
            if len(curve) < 20:
                row[-1] += f" (step {len(curve)})"
            print(f"<!-- {method} {remedy} {count}: {seconds:.0f} s of the processor -->", flush=True)
        rows.append(row)
    markdown(f"{name}: load / (width c) half way / at the end / noise of the pressure, for so many cells per unit",
             heading(cells), rows)


def draw(found, path):
    """Errors of the elastic scenes over the cells, and load over depth."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.5), layout="constrained")
    styles, colors = {"none": "--", "bbar": "-"}, dict(zip(CHOICES, ("C0", "C1", "C2", "C3")))
    for panel, (name, what) in zip(axes[0], [("cavity", "load"), ("cavity", "stress"), ("block", "load")]):
        for method, remedy in itertools.product(CHOICES, REMEDIES):
            here = [row for row in found if (row["scene"], row["what"], row["method"], row["remedy"])
                    == (name, what, method, remedy)]
            panel.loglog([row["cells"] for row in here], [abs(row["value"]) for row in here], styles[remedy],
                         color=colors[method], marker="o", ms=3, label=f"{method}, {remedy}")
        panel.set(title=f"{name}: error of {'load' if what == 'load' else 'stress'}, %", xlabel="cells")
        panel.grid(alpha=0.3)
        panel.set_xticks(CELLS[name], CELLS[name])
        panel.set_xticks([], minor=True)
    axes[0, 0].legend(fontsize=7, ncols=2, loc="center left")
    for panel, method in zip(axes[1], PRESSED):
        for remedy, (k, count) in itertools.product(REMEDIES, enumerate(CELLS["strip"])):
            here = [row for row in found if (row["scene"], row["method"], row["remedy"], row["cells"])
                    == ("strip", method, remedy, count) and row["what"] == "load"]
            panel.plot([row["depth"] for row in here], [row["value"] for row in here], styles[remedy], color=f"C{k}",
                       label=f"h = 1/{count}, {remedy}")
        panel.axhline(2 + np.pi, color="0.5", lw=0.8)            # Prandtl, at no depth
        panel.set(title=f"strip, {method}", xlabel="depth", ylabel="load / (width c)", ylim=(0, 12))
        panel.set_xticks([0.05, 0.1, 0.15, 0.2])
        panel.grid(alpha=0.3)
    axes[1, 0].legend(fontsize=7, ncols=2, loc="lower right")
    figure.savefig(path, dpi=110)


def main(only, quick, table, figure):
    found = []
    for name in only:
        (plastic if name == "strip" else elastic)(name, (QUICK if quick else CELLS)[name], found)
    if table:
        with open(table, "w", newline="") as file:
            writer = csv.DictWriter(file, found[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(found)
    if figure:
        draw(found, figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse grids only")
    parser.add_argument("--only", nargs="+", choices=CELLS, default=list(CELLS))
    parser.add_argument("--csv", help="file for all numbers")
    parser.add_argument("--figure", help="file for the figure")
    options = parser.parse_args()
    main(options.only, options.quick, options.csv, options.figure)
