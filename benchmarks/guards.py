"""What share of an explicit step do the guards take?

One run of a block goes on for 50 steps with the checks and 50 without them, in turn: what is looked at before every
step, and energy and yield every 50 steps.  The first number is by how much the former took longer.  It is the
difference of two large ones, so the second times the same checks by themselves, as a share of the steps.

The kernels' own checks (finite velocities, how far points move, where they are) cannot be left out, as what they find
says which part of the grid a step needs; the third number is the share of their loop, timed by itself.  Seconds are
those of the processor.  Prints medians over the turns, and smallest and largest.

    python benchmarks/guards.py
    python benchmarks/guards.py --points 40000 --turns 31 --methods mpm gimp
"""

import argparse
import os
import time
from dataclasses import replace

import numpy as np
from skfem import MeshQuad

from skfem_mpm import LinearElastic, Particles, VonMises, plane_strain
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.explicit import run_before_its_start
from skfem_mpm.explicit.engine import make_run
from skfem_mpm.explicit.guards import LOOK_EVERY

LAWS = {"elastic": LinearElastic(E=1e3, nu=0.3),
        "von-mises": VonMises(E=1e3, nu=0.3, peak=1.0, residual=0.3, softening=-10.0)}


def block(points):
    """A unit block in motion, four points in a cell, on a floor."""
    cells = round(points ** 0.5 / 2)
    axis = np.arange(-1, cells + 3) / cells
    body = Particles.fill(MeshQuad.init_tensor(*[axis[1:-2]] * 2), plane_strain)
    velocity = 0.05 * np.sin(2 * np.pi * body.x[::-1])
    return MeshQuad.init_tensor(axis, axis), replace(body, velocity=velocity), [FixedPlane(1, 0.0, -1, (0, 1))]


class Off:
    """Checks that look at nothing."""

    def _check_start(self):
        pass

    _watch = _check_start


def guarded(run, on):
    """Switch the checks on or off."""
    run._check_start, run._watch = (getattr(type(run) if on else Off, name).__get__(run)
                                    for name in ("_check_start", "_watch"))


def seconds(run, steps, on=True):
    """Seconds of some steps, with the checks or without."""
    guarded(run, on)
    begin = time.process_time()
    for _ in range(steps):
        run.advance()
    return time.process_time() - begin


def alone(run):
    """Seconds that the checks of so many steps take by themselves."""
    guarded(run, True)
    begin = time.process_time()
    for _ in range(LOOK_EVERY):
        run._check_start()
    run._watch()
    return time.process_time() - begin


def in_kernels(run):
    """Seconds that the survey of a step takes by itself."""
    from skfem_mpm.kernels import chunks
    tables, limits = run.tables, run.tables.limits.copy()
    begin = time.process_time()
    for _ in range(LOOK_EVERY):
        chunks.measure_all(run.x, run.x, run.velocity, limits)
        tables.survey()
    return time.process_time() - begin


def shares(engine, method, law, points, turns):
    mesh, body, planes = block(points)
    run = run_before_its_start(mesh, body, LAWS[law], planes, method=method, gravity=(0.0, -1.0))
    run = make_run(engine, 1, mesh, run.last, LAWS[law], run.choices)
    seconds(run, 2)                                                       # compiles
    found, checks, kernels = [], [], []
    for turn in range(turns):
        took = {on: seconds(run, LOOK_EVERY, on) for on in ((True, False), (False, True))[turn % 2]}
        found.append(took[True] / took[False] - 1)
        checks.append(alone(run) / took[True])
        if engine == "numba":
            kernels.append(in_kernels(run) / took[True])
    return body.n, found, checks, kernels


def percent(values):
    return f"{np.median(values):6.2%} ({min(values):.2%} to {max(values):.2%})" if values else "   -"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=40_000)
    parser.add_argument("--turns", type=int, default=21)
    parser.add_argument("--engines", nargs="+", default=["numba", "numpy"])
    parser.add_argument("--methods", nargs="+", default=["mpm"])
    parser.add_argument("--materials", nargs="+", default=["elastic", "von-mises"])
    options = parser.parse_args()
    print(f"{os.cpu_count()} processors; shares of a step: guards on less off, guards alone, kernels' own checks alone")
    for engine in options.engines:
        for method in options.methods:
            for law in options.materials:
                turns = options.turns if engine == "numba" else max(3, options.turns // 5)
                n, *found = shares(engine, method, law, options.points, turns)
                print(f"{engine:6} {method:7} {law:10} {n:7} points", *map(percent, found), sep="   ", flush=True)


if __name__ == "__main__":
    main()
