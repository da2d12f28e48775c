"""How badly conditioned is the stiffness when the body only just reaches into a cell, and what helps?

Bodies with two points per cell and direction are moved over the grid until their outermost points (cut "points"), or
the outer edge of their domains ("edge"), lie a given part of a cell beyond a grid line.  For each the condition number
of the stiffness, as it is and scaled by its diagonal, from singular values.

    python benchmarks/conditioning.py                       largest condition number of each sweep, as Markdown
    python benchmarks/conditioning.py --csv all.csv         and every one of them in a file
    python benchmarks/conditioning.py --accuracy            errors of two scenes with the same choices instead

Bodies: "line", 8 cells; "block", 6 x 6 cells in plane strain; "turned", the block turned by 20 degrees.  Nothing holds
them; rigid modes are left out.  "gimp gaps" and "gimp tiled" (gc alike) are bodies that have been stretched by a
quarter with domains that kept their size, or were stretched with them.
"""

import argparse
import csv
import itertools
from dataclasses import replace

import numpy as np
from skfem import MeshLine, MeshQuad

from skfem_mpm import METHODS, LinearElastic, NotConvergedError, Particles, implicit_steps, plane_strain, uniaxial
from skfem_mpm.boundary import Wall
from skfem_mpm.implicit import State, _check
from skfem_mpm.implicit.step import Step
from skfem_mpm.scenes import cylinder

LAW = LinearElastic(E=1.0, nu=0.3)
DELTAS = [1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5]
BODIES = {"line": 1, "block": 2, "turned": 2}
VARIANTS = {method: (method, 1.0, True) for method in METHODS}
for name in ("gimp", "gc"):
    VARIANTS |= {f"{name} gaps": (name, 1.25, False), f"{name} tiled": (name, 1.25, True)}


def scene(body, delta, cut, stretch=1.0, tiled=True):
    """Mesh and points; the grid is 1 wide per cell."""
    dim = BODIES[body]
    cells = 8 if dim == 1 else 6
    axes = [np.arange(-4.0, 2 * cells + 5)] * dim
    mesh = MeshLine(axes[0]) if dim == 1 else MeshQuad.init_tensor(*axes)
    inside = Particles.fill(mesh, uniaxial if dim == 1 else plane_strain, density=1.0,
                            where=lambda x: ((x > 0) & (x < cells)).all(axis=0))
    x, length = stretch * inside.x, (stretch if tiled else 1.0) * inside.length
    if body == "turned":
        angle = np.radians(20)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        x = turn @ (x - cells / 2) + cells / 2
    ahead = length[:, :1] / 2 if cut == "edge" else 0.0
    end = x.max(axis=1, keepdims=True) + ahead
    x = x + np.ceil(end - 1e-9) - end + delta
    return mesh, replace(inside, x=x, length=length, volume=stretch ** dim * inside.volume)


def stiffness(mesh, body, method, **choices):
    """The first stiffness of a step."""
    given = dict(method=method, strain="logarithmic", scheme="equilibrated", weights="one", integration="points",
                 edges="ghost", tangent=None, tolerance=1e-11, solver=None)
    state = State(0, body, (), np.zeros((body.dim, 0)), {})
    step = Step(mesh, state, LAW, _check(**given, **choices))
    return step._stiffness(step._elastic()).toarray()


def condition(matrix, rigid):
    """Largest over smallest singular value, but for rigid modes."""
    size = np.linalg.svd(matrix, compute_uv=False)[:len(matrix) - rigid]
    return size[0] / size[-1] if size[-1] > 1e-17 * size[0] else np.inf


def conditions(matrix, rigid):
    """Condition numbers of a matrix as it is, and scaled by its diagonal."""
    diagonal = np.abs(matrix.diagonal())
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return condition(matrix, rigid), condition(matrix / scale / scale[:, None], rigid)


def sweep(body, variant, helps, deltas=DELTAS):
    """One row for each cut and choice."""
    method, stretch, tiled = VARIANTS[variant]
    for cut, delta, (floor, ghost) in itertools.product(("points", "edge"), deltas, helps):
        here = scene(body, delta, cut, stretch, tiled)
        matrix = stiffness(*here, method, floor=floor, ghost=ghost)
        plain, scaled = conditions(matrix, {1: 1, 2: 3}[BODIES[body]])
        yield {"body": body, "method": variant, "cut": cut, "delta": delta, "floor": floor, "ghost": ghost,
               "condition": plain, "scaled": scaled}


def heading(helps):
    return [f"floor {floor:g}, ghost {ghost:g}" for floor, ghost in helps]


def markdown(title, head, rows):
    print(f"\n### {title}\n\n| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def conditioning(helps, path):
    found = []
    for body in BODIES:
        rows = {"condition": [], "scaled": []}
        for variant in VARIANTS:
            here = list(sweep(body, variant, helps))
            found += here
            for kind in rows:
                worst = [max(row[kind] for row in here if (row["floor"], row["ghost"]) == choice) for choice in helps]
                rows[kind].append([variant, *(f"{value:.1e}" for value in worst)])
        for kind in rows:
            markdown(f"{body}, {kind}: largest of the sweep", ["method", *heading(helps)], rows[kind])
    if path:
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, found[0])
            writer.writeheader()
            writer.writerows(found)


# -- accuracy ---------------------------------------------------------------------------------------------------------

def errors(method, offset, **choices):
    """Errors of the cylinder, all points, after 1 and 50 steps; the step that failed instead of the latter."""
    # 20 cells across the wall: h = 0.1
    drive, found = cylinder(20, dim=1, offset=offset), {}
    try:
        for state in drive.run(method, steps=50, **choices):
            if state.step in (1, 50):
                found[state.step] = f"{100 * drive.errors(state)['all']:.3g}"
    except (NotConvergedError, ValueError) as failure:
        found[50] = str(failure).split(":")[0]
    return f"{found.get(1, '-')} / {found[50]}"


def sliding(method, cells=10, steps=20, **choices):
    """Errors of stress, all points, of a turned block that slides by half its width while its weight grows.

    Without lateral contraction the exact stress is the weight above, along the block, whatever its stretch.
    """
    angle, weight = np.radians(20), 0.3
    along, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    flat = np.linspace(0.0, 1.0, cells + 1)
    fill = Particles.fill(MeshQuad.init_tensor(flat, flat), plane_strain, density=1.0)
    body = replace(fill, x=np.stack([along, up], axis=1) @ fill.x)
    axis = np.arange(-1.0, 2.0 + 1e-9, 1 / cells) + 0.0371 / cells
    wall = Wall(along[:, None] * flat, tuple(0.5 / steps * along), name="base")
    exact, found = -weight * (1 - fill.x[1]) * np.multiply.outer(up, up)[:, :, None], {}
    try:
        for state in implicit_steps(MeshQuad.init_tensor(axis, axis), body, LinearElastic(E=1.0, nu=0.0), [wall],
                                    steps=steps, method=method, gravity=lambda n: -weight * n / steps * up, **choices):
            if state.step in (1, steps):
                error = state.particles.stress[:2, :2] - state.step / steps * exact
                size = weight * state.step / steps
                found[state.step] = f"{100 * np.sqrt((error ** 2).sum(axis=(0, 1)).mean()) / size:.3g}"
    except (NotConvergedError, ValueError) as failure:
        found[steps] = str(failure).split(":")[0]
    return f"{found.get(1, '-')} / {found[steps]}"


def accuracy(helps):
    def row(work, method, where):
        return [method, *(work(method, where, floor=floor, ghost=ghost) for floor, ghost in helps)]

    for cells in (10, 20):
        rows = [row(sliding, method, cells) for method in METHODS]
        markdown(f"sliding block, {cells} cells: error of stress over all points after 1 / 20 steps, %",
                 ["method", *heading(helps)], rows)
    for offset in (0.0, 0.37):
        rows = [row(errors, method, offset) for method in ("mpm", "gimp", "gc", "cmpm", "cmpm-c")]
        markdown(f"cylinder, offset {offset}: error of q over all points after 1 / 50 steps, %",
                 ["method", *heading(helps)], rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", help="file for all condition numbers")
    parser.add_argument("--accuracy", action="store_true", help="errors of the cylinder and of a sliding block instead")
    parser.add_argument("--floor", type=float, nargs="+", default=[0.0, 1e-6])
    parser.add_argument("--ghost", type=float, nargs="+", default=[0.0, 0.01, 0.1, 1.0])
    options = parser.parse_args()
    chosen = list(itertools.product(options.floor, options.ghost))
    accuracy(chosen) if options.accuracy else conditioning(chosen, options.csv)
