"""The tables of docs/cylinder.md about the cylinder, as Markdown: errors, orders, reactions, Newton's method, choices.

    python benchmarks/cylinder_tables.py            all tables, some minutes on 2 cores
    python benchmarks/cylinder_tables.py --quick    smaller ones, a few seconds
    python benchmarks/cylinder_tables.py --only newton floor

Uses the library alone, on the line version of the scene (dim=1), which is the same problem as the quads.
"""

import argparse
import platform
import time

import numpy as np

from skfem_mpm import METHODS, Hencky, NotConvergedError, support
from skfem_mpm.grid import EDGES
from skfem_mpm.kinematics import DOMAINS, RADII
from skfem_mpm.scenes import cylinder
from skfem_mpm.scenes.cylinder_reference import deviatoric, lame, reaction_lame
from skfem_mpm.weights import WEIGHTS

TANGENTS = [(method, "exact") for method in METHODS] + [("cmpm", "conjugate"), ("gc", "conjugate")]


def table(title, head, rows):
    """Print a Markdown table."""
    print(f"\n### {title}\n")
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(str(entry) for entry in row) + " |")


def percent(value):
    return "-" if value is None or not np.isfinite(value) else f"{100 * value:.3g} %"


def last(scene, method, steps, **choices):
    """The last state of a run, or None and the step that failed."""
    state = None
    try:
        for state in scene.run(method, steps=steps, **choices):
            pass
    except NotConvergedError as failure:
        return failure.state, True
    return state, False


# -- one step ---------------------------------------------------------------------------------------------------------

def one_step(cells, method, edges):
    """Error of recovered radial stress over ``|sigma_r(r_i)|``: max and rms inside, max in the two end cells."""
    scene = cylinder(cells, dim=1, edges=edges)
    h = (scene.outer - scene.inner) / cells
    r = (np.arange(cells)[:, None] + np.linspace(1e-6, 1 - 1e-6, 41)).ravel() * h + scene.inner
    exact = lame(r, scene.material.E, scene.material.nu, scene.inner, scene.outer, scene.increment)[1][0]
    state = next(scene.run(method, steps=1, strain="small"))
    found = state.recover(r[None], length=np.full((1, r.size), h / 2))[0]
    error = np.abs(found - exact) / np.abs(exact).max()
    inside = (r > scene.inner + h) & (r < scene.outer - h)
    return error[inside].max(), np.sqrt((error[inside] ** 2).mean()), error[~inside].max()


def table_one(quick):
    rows = []
    for method in METHODS:
        found = {edges: one_step(20, method, edges) for edges in EDGES}
        rows.append([method, *map(percent, found["ghost"][:2]), *(percent(found[edges][2]) for edges in EDGES)])
    table("One step, h = 0.1: error of the recovered radial stress over its largest value",
          ["method", "max inside", "rms inside", *(f"max in the two end cells, {edges}" for edges in EDGES)], rows)


def table_orders(quick):
    cells = [10, 20] if quick else [10, 20, 40, 80]
    rows = []
    for method in METHODS:
        for k, name in [(0, "max"), (1, "rms"), (2, "ends")]:
            error = np.array([one_step(n, method, "ghost")[k] for n in cells])
            orders = ", ".join(f"{order:.2f}" for order in np.log2(error[:-1] / error[1:]))
            rows.append([method, name, *map(percent, error), orders])
    table("The same under refinement", ["method", "error", *(f"{n} cells" for n in cells), "orders"], rows)


# -- the wall ---------------------------------------------------------------------------------------------------------

def table_reaction(quick):
    rows = []
    for method in METHODS:
        ratio = []
        for offset in np.arange(5 if quick else 21) / (5 if quick else 21):
            scene = cylinder(dim=1, offset=float(offset), increment=1e-6)
            exact = reaction_lame(scene.material.E, scene.material.nu, scene.inner, scene.outer, scene.increment)
            ratio.append(next(scene.run(method, steps=1)).reactions["inner"][0] / exact)
        rows.append([method, f"{min(ratio):.4f}", f"{max(ratio):.4f}"])
    table(f"Reaction of the wall over Lame's, {len(ratio)} positions of the wall in its cell",
          ["method", "least", "most"], rows)


# -- Newton's method --------------------------------------------------------------------------------------------------

def table_newton(quick):
    rows = []
    for method, tangent in TANGENTS:
        for increment, step in [(0.015, 1), (0.015, 10), (0.15, 1), (0.15, 3)]:
            state, failed = last(cylinder(dim=1, increment=increment), method, step, tangent=tangent)
            name = method if tangent == "exact" else f"{method}, conjugate"
            residuals = ", ".join(f"{residual:.0e}" for residual in state.residuals[:9])
            residuals += f", ... ({len(state.residuals)} passes)" if len(state.residuals) > 9 else ""
            rows.append([name, f"{100 * increment:g} cm", step, "stopped" if failed else state.cuts, residuals])
    table("Relative residual after each Newton pass", ["method, tangent", "step", "number", "cuts", "residuals"], rows)


# -- fifty steps ------------------------------------------------------------------------------------------------------

def table_references(quick):
    scene = cylinder(dim=1)
    start = scene.particles.x[0]
    steps = [1, 10, 25, 50]
    rows = []
    for name in ("lame", "incremental", "cauchy", "kirchhoff"):
        q = deviatoric(scene.reference(name, 50).stress)[[n - 1 for n in steps]][:, scene.followed] / 1e3
        rows.append([name, *(f"{value:.1f}" for value in q)])
    table(f"Reference q of the followed point (R = {start[scene.followed]:g} m), kPa",
          ["reference", *(f"step {n}" for n in steps)], rows)


def table_history(quick):
    marks = [1, 10] if quick else [1, 5, 10, 20, 30, 40, 50]
    rows = []
    for weights in (["one"] if quick else ["one", "interior", "overlap"]):
        for method in METHODS:
            scene = cylinder(dim=1)
            try:
                found = [scene.errors(state) for state in scene.run(method, steps=marks[-1], weights=weights)]
                rows.append([method, weights, *(percent(found[n - 1]["all"]) for n in marks),
                             percent(max(entry["all"] for entry in found)),
                             percent(max(entry["point"] for entry in found))])
            except NotConvergedError as failure:
                rows.append([method, weights, f"stopped after {failure.state.step}"] + ["-"] * (len(marks) + 1))
    table("q in the equilibrated scheme against the reference cauchy: rms of all points",
          ["method", "weights", *(f"step {n}" for n in marks), "worst step", "worst step, followed point"], rows)


def table_incremental(quick):
    steps = 10 if quick else 50
    rows = []
    for method in METHODS:
        for weights in WEIGHTS:
            scene = cylinder(dim=1)
            point = []
            for state in scene.run(method, steps=steps, weights=weights, scheme="incremental", strain="small"):
                point.append(scene.errors(state)["point"])
            rows.append([method, weights, percent(max(point)), percent(scene.error(state)),
                         percent(scene.error(state, "cauchy"))])
    table(f"Incremental scheme, {steps} steps", ["method", "weights", "followed point, worst step", "all points, end",
                                                 "all points, end, against equilibrium"], rows)


def table_floor(quick):
    steps = 10 if quick else 50
    rows = []
    for method in METHODS:
        q = []
        for floor in (1e-4, 1e-6, 1e-8):
            scene = cylinder(dim=1)
            state, failed = last(scene, method, steps, floor=floor)
            q.append(np.nan if failed else deviatoric(state.particles.sigma)[scene.followed])
        rows.append([method, f"{q[1] / 1e3:.3f}", *("stopped" if np.isnan(value) else f"{value / q[1] - 1:+.1e}"
                                                    for value in (q[0], q[2]))])
    table(f"Soft floor: q of the followed point at step {steps}", ["method", "q with 1e-6, kPa", "1e-4", "1e-8"], rows)


def compare(title, scenes, quick):
    """Errors at the last step for several variants of the scene."""
    steps = 10 if quick else 50
    rows = []
    for method in METHODS:
        row = [method]
        for _, make, choices in scenes:
            scene = make()
            state, failed = last(scene, method, steps, **choices)
            found = scene.errors(state)
            row.append(f"stopped after {state.step}" if failed else
                       f"{percent(found['point'])} / {percent(found['all'])} / {percent(found['inner'])}")
        rows.append(row)
    table(f"{title}, step {steps}: followed point / all / inner", ["method", *(name for name, _, _ in scenes)], rows)


def table_grid(quick):
    compare("Grid fixed in space or following the wall", [
        ("fixed", lambda: cylinder(dim=1), {}), ("following", lambda: cylinder(dim=1, follow=True), {}),
        ("fixed, overlap", lambda: cylinder(dim=1), {"weights": "overlap"}),
        ("following, overlap", lambda: cylinder(dim=1, follow=True), {"weights": "overlap"})], quick)


def table_domains(quick):
    """Domains of GIMP of fixed size or stretched, with the radius at the point or part of the means."""
    marks, grids, rows = [1, 5, 10] if quick else [1, 10, 50], (20,) if quick else (20, 40, 80), []
    for method in ("gimp", "gc"):
        for cells, offset in [(cells, offset) for cells in grids for offset in (0, 0.37)]:
            for radius in RADII:
                found = []
                for domains in DOMAINS:
                    scene = cylinder(cells, dim=1, offset=offset)
                    states = list(scene.run(method, steps=marks[-1], domains=domains, radius=radius))
                    found += [percent(scene.error(states[n - 1])) for n in marks]
                rows.append([method, cells, offset, radius, *found])
    table("Domains of GIMP", ["method", "cells", "offset", "radius",
                              *(f"{domains}, step {n}" for domains in DOMAINS for n in marks)], rows)


def table_solved(quick):
    """Nodes solved for, by cells and by mass; domains of GIMP of fixed size or stretched."""
    marks = [1, 5, 10] if quick else [1, 10, 20, 30, 40, 50]
    rows, cutoff, corners = [], support.CUTOFF, support.corner_nodes

    def every_node(cells):          # in place of those of occupied cells; both methods map by domains
        return np.ones_like(corners(cells))

    for method in ("gimp", "gc"):
        for solved, chosen in [("of occupied cells", corners), ("all active", every_node)]:
            for share in (cutoff, 1e-2):
                support.CUTOFF, support.corner_nodes = share, chosen
                for domains in DOMAINS:
                    scene = cylinder(dim=1)
                    found = [scene.error(state) for state in scene.run(method, steps=marks[-1], domains=domains)]
                    rows.append([method, solved, f"{share:.0e}", domains,
                                 *(percent(found[n - 1]) for n in marks), percent(max(found))])
    support.CUTOFF, support.corner_nodes = cutoff, corners
    table("Solved nodes and domains of GIMP", ["method", "solved nodes", "active above", "domains",
                                               *(f"step {n}" for n in marks), "worst step"], rows)


def table_law(quick):
    law = Hencky(E=25e6, nu=0.3)
    compare("Hencky's law (reference: kirchhoff)", [
        ("one", lambda: cylinder(dim=1, material=law), {}),
        ("interior", lambda: cylinder(dim=1, material=law), {"weights": "interior"}),
        ("overlap", lambda: cylinder(dim=1, material=law), {"weights": "overlap"})], quick)


def table_double(quick):
    """Double mapping, in equilibrium and in the incremental scheme."""
    marks, rows = [1, 5] if quick else [1, 10, 50], []
    for method in METHODS:
        for integration in ("points", "dm", "dm-g", "dm-stress", "dm-g-stress"):
            row = []
            for choices in ({}, {"scheme": "incremental", "strain": "small"}):
                scene = cylinder(dim=1)
                try:
                    states = list(scene.run(method, steps=marks[-1], integration=integration, **choices))
                except NotConvergedError as failure:
                    row += [f"stopped after {failure.state.step}"] + ["-"] * len(marks)
                    continue
                row += [percent(scene.error(states[n - 1])) for n in marks]
                passes = [len(state.residuals) for state in states]
                row.append(f"{np.median(passes):g}, {max(passes)}")
            rows.append([method, integration, *row[:-1]])
    table("Double mapping: rms of all points", ["method", "integration", *(f"step {n}" for n in marks),
                                                "passes: median, most",
                                                *(f"incremental, step {n}" for n in marks)], rows)


def table_edges(quick):
    compare("Edge of the grid",
            [(edges, lambda edges=edges: cylinder(dim=1, edges=edges), {}) for edges in EDGES], quick)


TABLES = {"one": table_one, "orders": table_orders, "reaction": table_reaction, "newton": table_newton,
          "references": table_references, "history": table_history, "incremental": table_incremental,
          "floor": table_floor, "grid": table_grid, "law": table_law, "edges": table_edges, "domains": table_domains,
          "solved": table_solved, "double": table_double}

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--quick", action="store_true", help="fewer cells, positions and steps")
parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE",
                    help="which tables: " + ", ".join(TABLES))
options = parser.parse_args()

begin = time.perf_counter()
print(f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}, {time.strftime('%Y-%m-%d')}")
for name in options.only:
    TABLES[name](options.quick)
print(f"\n{time.perf_counter() - begin:.0f} s")
