"""What does an implicit Newton pass cost, and where does the time go?

A block of 2-D points (4 per cell, plane strain, logarithmic strain) under its own weight.  Prints one JSON line per
method and size: medians of the repeats in seconds, with their smallest and largest, per-point nanoseconds, and memory.

    python benchmarks/implicit.py                       100k points, mpm, gimp, cmpm
    python benchmarks/implicit.py --points 10000 100000 1000000 --methods mpm --no-solve
    python benchmarks/implicit.py --empty 10            ten times more empty mesh around the same body
"""

import argparse
import json
import platform
import resource
import time
from dataclasses import replace

import numpy as np
import scipy
import skfem
from skfem import MeshQuad

from skfem_mpm import METHODS, LinearElastic, Particles, plane_strain
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.grid import Grid
from skfem_mpm.implicit import State, solve_direct
from skfem_mpm.implicit.state import Options
from skfem_mpm.implicit.step import Step, _Problem
from skfem_mpm.support import stack_rows


def median(work, repeats):
    """Result of ``work``, and median, smallest and largest of its seconds."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - begin)
    return result, [float(value) for value in (np.median(seconds), min(seconds), max(seconds))]


def block(points, empty):
    """A unit block of jittered points on a grid with a spare layer, and ``empty`` times its cells around it."""
    cells = max(2, round((points / 4) ** 0.5))
    lines = np.linspace(0, 1, cells + 1)
    spare = max(1, round(cells * ((1 + empty) ** 0.5 - 1) / 2))
    beyond = np.arange(1, spare + 1) / cells
    axis = np.concatenate([-beyond[::-1], lines, 1 + beyond])
    particles = Particles.fill(MeshQuad.init_tensor(lines, lines), plane_strain, density=1.0)
    jitter = 0.05 / cells * np.random.default_rng(0).uniform(-1, 1, particles.x.shape)
    return MeshQuad.init_tensor(axis, axis), replace(particles, x=particles.x + jitter)


def measure(method, points, empty, repeats, solve):
    mesh, particles = block(points, empty)
    boundary = (FixedPlane(1, 0.0, -1, (0, 1), name="base"), FixedPlane(0, 0.0, -1, name="left"),
                FixedPlane(0, 1.0, 1, name="right"))
    law = LinearElastic(E=1e3, nu=0.3)
    options = Options(METHODS[method], "logarithmic", "equilibrated", "one", "points", "ghost", "exact", 1e-6, 1e-11,
                      solve_direct)
    state = State(0, particles, boundary, np.zeros((2, 0)), {})

    grid = Grid.from_mesh(mesh)
    index, locate = median(lambda: grid.locate(particles.x), repeats)
    step, setup = median(lambda: Step(mesh, state, law, options), repeats)
    support = step.support
    chosen = {METHODS[method].mass, METHODS[method].strain, METHODS[method].force}

    def stencils():
        support._stencils.clear()
        return [support.stencil(basis) for basis in chosen]

    _, stencil = median(stencils, repeats)
    unknowns = np.zeros(support.transfer.shape[1])
    nothing, external = stack_rows([], len(unknowns)), step._weight((0.0, -1e-3))
    problem = _Problem(external, nothing, np.zeros(0))
    start, residual = median(lambda: step._iterate(problem, unknowns, np.zeros(0)), repeats)
    moduli, tangent = median(start.response.tangent, repeats)
    stiffness, assemble = median(lambda: step._stiffness(moduli), repeats)
    row = {"method": method, "points": particles.n, "dofs": int(support.free.sum()), "nonzeros": int(stiffness.nnz),
           "mesh_cells": mesh.nelements, "setup_of_step": setup, "locate": locate, "stencil": stencil,
           "residual": residual, "moduli": tangent, "assemble": assemble}
    whole = residual[0] + tangent[0] + assemble[0]
    row["tangent_and_residual"] = whole
    row["ns_per_point"] = {name: round(1e9 * row[name][0] / particles.n) for name in ("locate", "stencil", "assemble")}
    if solve:
        _, row["solve"] = median(lambda: step._linear_solve(stiffness, external - start.force, nothing, np.zeros(0)),
                                 min(3, repeats))
        row["newton_pass"] = whole + row["solve"][0]
    return row


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--points", type=int, nargs="+", default=[100_000])
parser.add_argument("--methods", nargs="+", default=["mpm", "gimp", "cmpm"], choices=METHODS)
parser.add_argument("--empty", type=float, default=0.0, help="empty cells around the body, as a multiple of its own")
parser.add_argument("--repeats", type=int, default=5)
parser.add_argument("--no-solve", action="store_true", help="leave the linear solve out (it does not scale linearly)")
options = parser.parse_args()

print(json.dumps({"machine": platform.processor() or platform.machine(), "python": platform.python_version(),
                  "numpy": np.__version__, "scipy": scipy.__version__, "scikit-fem": skfem.__version__,
                  "date": time.strftime("%Y-%m-%d")}))
for count in options.points:
    for name in options.methods:
        found = measure(name, count, options.empty, options.repeats, not options.no_solve)
        found["peak_memory_MB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        print(json.dumps(found), flush=True)
