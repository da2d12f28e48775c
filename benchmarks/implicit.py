"""What does an implicit Newton pass cost, and where does the time go?

A block of 2-D points (4 per cell, plane strain, logarithmic strain) under its own weight.  Prints one JSON line per
method and size.  Seconds are ``[smallest, median, largest]`` of the repeats; both engines take turns in one run, and
``ratio`` is how many times faster numba is, by the smallest.  ``table`` is a pair with 16 nodes per point and a number
of its own for each.  ``field`` and ``field2`` (with cmpm), ``twin``, ``twin2`` and ``dual`` (with mpm) are choices of
integration; their operators are part of ``setup_of_step``, done once per step.  A pass is respond, gradient_force,
moduli, tangent and one solve: the direct one, or ``first`` and ``later`` solve of a step that keeps its factorisation.

    python benchmarks/implicit.py                       100k points, mpm, gimp, cmpm, table
    python benchmarks/implicit.py --methods field field2 twin dual
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
from skfem_mpm.implicit.step import Step
from skfem_mpm.integration import OfTable, Pair, Points, find_integration
from skfem_mpm.support import stack_rows

LAW = LinearElastic(E=1e3, nu=0.3)
BOUNDARY = (FixedPlane(1, 0.0, -1, (0, 1), name="base"), FixedPlane(0, 0.0, -1, name="left"),
            FixedPlane(0, 1.0, 1, name="right"))


FIELDS = {"field": "cmpm", "field2": "cmpm", "twin": "mpm", "twin2": "mpm", "dual": "mpm"}


class Table(Points):
    """Points are the quadrature, but the pair is told so number by number: 16 nodes per point."""

    def pair(self, support, force, strain, weight):
        stencil = support.stencil(METHODS["cmpm"].strain)
        points = support.particles
        functions = OfTable(stencil.base, np.ascontiguousarray(stencil.gradient()), stencil.shape)
        return Pair(points.kinematics, functions, functions, weight * points.volume)


def seconds(works, repeats):
    """Results of some works, which take turns, and smallest, median and largest of the seconds of each."""
    taken = [[] for _ in works]
    results = [work() for work in works]        # kernels are compiled, caches filled
    for _ in range(repeats):
        for k, work in enumerate(works):
            begin = clock()
            results[k] = work()
            taken[k].append(clock() - begin)
    return results, [[round(float(f(each)), 5) for f in (np.min, np.median, np.max)] for each in taken]


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


def steps_of(method, mesh, particles):
    """The step with either engine."""
    state = State(0, particles, BOUNDARY, np.zeros((2, 0)), {})
    integration = Table() if method == "table" else find_integration(method if method in FIELDS else "points")
    base = METHODS[{"table": "cmpm-c", **FIELDS}.get(method, method)]
    options = Options(integration.method(base), "logarithmic", "equilibrated", "one", integration, "ghost", "exact",
                      floor=1e-6, ghost=0.0, tolerance=1e-11, solver=None)
    return [Step(mesh, state, LAW, replace(options, engine=engine)) for engine in ("numpy", "numba")]


def measure(method, points, empty, repeats, solve):
    mesh, particles = block(points, empty)
    grid = Grid.from_mesh(mesh)
    row = {"method": method, "points": particles.n, "mesh_cells": mesh.nelements}
    _, (row["locate"],) = seconds([lambda: grid.locate(particles.x)], repeats)
    _, (row["setup_of_step"],) = seconds([lambda: steps_of(method, mesh, particles)[1]], repeats)
    steps = steps_of(method, mesh, particles)
    slow, fast = steps
    u = slow.support.spread(np.zeros(slow.support.transfer.shape[1]))
    gradient = slow.operator.gradient(u)
    (response,), (row["respond"],) = seconds([lambda: slow.motion.respond(gradient)], repeats)
    (moduli,), (row["moduli"],) = seconds([response.tangent], repeats)

    def both(name, work):
        results, (row[f"{name}_numpy"], row[name]) = seconds([lambda step=step: work(step) for step in steps], repeats)
        row[f"{name}_ratio"] = round(row[f"{name}_numpy"][0] / row[name][0], 1)
        return results

    both("gradient_force", lambda step: (step.operator.gradient(u), step.operator.force(response.piola)))
    both("tangent", lambda step: step.tangent_operator.tangent(moduli, step.support.number, step.soft.shape[0]))
    stiffness = both("stiffness", lambda step: step._stiffness(moduli))[1]     # with the soft floor and slaved nodes
    row |= {"dofs": int(fast.support.free.sum()), "nonzeros": int(stiffness.nnz)}
    if solve:
        row |= solves(fast, stiffness, moduli, min(3, repeats))
        rest = sum(row[name][0] for name in ("respond", "moduli", "gradient_force", "stiffness"))
        row |= {f"{name}_pass": round(rest + row[name][0], 3) for name in ("direct", "first", "later")}
    return row


def solves(step, stiffness, moduli, repeats):
    """Seconds of factorising the matrix itself; of the first solve of a step; of a later one, moduli 2 % different."""
    force, none = step._weight((0.0, -1.0)), stack_rows([], stiffness.shape[0])
    shaken = np.random.default_rng(1).uniform(0.98, 1.02, step.particles.n)
    other = step._stiffness(moduli * shaken)

    def first():
        step.factors.factor = None
        return step._linear_solve(stiffness, force, none, np.zeros(0))

    later = seconds([first, lambda: step._linear_solve(other, force, none, np.zeros(0))], repeats)[1]
    step.options = replace(step.options, solver=solve_direct)
    (direct,) = seconds([lambda: step._linear_solve(stiffness, force, none, np.zeros(0))], repeats)[1]
    return {"direct": direct, "first": later[0], "later": later[1]}


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--points", type=int, nargs="+", default=[100_000])
parser.add_argument("--methods", nargs="+", default=["mpm", "gimp", "cmpm", "table"],
                    choices=[*METHODS, "table", *FIELDS])
parser.add_argument("--empty", type=float, default=0.0, help="empty cells around the body, as a multiple of its own")
parser.add_argument("--repeats", type=int, default=5)
parser.add_argument("--processor", action="store_true", help="count seconds of the processor: for a busy machine")
parser.add_argument("--no-solve", action="store_true", help="leave the linear solve out (it does not scale linearly)")
options = parser.parse_args()
clock = time.process_time if options.processor else time.perf_counter

print(json.dumps({"machine": platform.processor() or platform.machine(), "python": platform.python_version(),
                  "numpy": np.__version__, "scipy": scipy.__version__, "scikit-fem": skfem.__version__,
                  "date": time.strftime("%Y-%m-%d")}))
for count in options.points:
    for name in options.methods:
        found = measure(name, count, options.empty, options.repeats, not options.no_solve)
        found["peak_memory_MB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        print(json.dumps(found), flush=True)
