"""How many point-steps per second does an explicit run do, and what share of the memory bound is that?

A block of jittered points in motion (4 per cell in 2-D, 8 in 3-D, small strain), driver and checks included, no
snapshot but the last.  The stable step is found every 50 steps, with USL too (whose default is every step).  Prints one
JSON line per case: median, smallest and largest of the repeats; the bytes of points and stencils that a step moves at
least; and their share of what a triad over arrays beyond the cache moves in the same run.

    python benchmarks/explicit.py                                     100k points, 2-D, elastic, mpm, gimp and cmpm
    python benchmarks/explicit.py --dim 3 --points 10000 100000 --threads 1 2
    python benchmarks/explicit.py --methods mpm --engines numpy numba --material von-mises --json
"""

import argparse
import json
import os
import platform
import time
import warnings
from dataclasses import replace

import numpy as np
from skfem import MeshHex, MeshLine, MeshQuad

from skfem_mpm import METHODS, LinearElastic, Particles, VonMises, explicit_steps, plane_strain, solid, uniaxial
from skfem_mpm.basis import CMPMBasis, GIMPBasis, ParticleBasis
from skfem_mpm.boundary import FixedPlane

KINEMATICS = {1: uniaxial, 2: plane_strain, 3: solid}
LAWS = {"elastic": LinearElastic(E=1e3, nu=0.3),
        "von-mises": VonMises(E=1e3, nu=0.3, peak=1.0, residual=0.3, softening=-10.0)}
WIDTH = {ParticleBasis: 2, GIMPBasis: 3, CMPMBasis: 4}


def mesh_of(dim, *axes):
    return {1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}[dim](*axes)


def block(points, dim):
    """A unit block of jittered points on a grid with a spare layer, floor and side walls."""
    cells = max(2, round((points / 2 ** dim) ** (1 / dim)))
    lines = np.linspace(0, 1, cells + 1)
    axis = np.concatenate([[-1 / cells], lines, 1 + np.arange(1, 3) / cells])
    particles = Particles.fill(mesh_of(dim, *[lines] * dim), KINEMATICS[dim], density=1.0)
    rng = np.random.default_rng(0)
    jitter = 0.05 / cells * rng.uniform(-1, 1, particles.x.shape)
    velocity = np.sin(2 * np.pi * particles.x[::-1]) * 0.05
    planes = [FixedPlane(dim - 1, 0.0, -1, tuple(range(dim)), name="base")]
    planes += [FixedPlane(k, float(at), side) for k in range(dim - 1) for at, side in ((0, -1), (1, 1))]
    return mesh_of(dim, *[axis] * dim), replace(particles, x=particles.x + jitter, velocity=velocity), planes


def triad(threads):
    """GB/s of a triad beyond the cache, write-allocate not counted."""
    from numba import get_num_threads, njit, prange, set_num_threads

    @njit(fastmath={"contract"})
    def part(a, b, c, low, high):
        for i in range(low, high):
            a[i] = b[i] + 0.5 * c[i]

    @njit(parallel=True)
    def whole(a, b, c):
        n = len(a)
        for k in prange(64):
            part(a, b, c, n * k // 64, n * (k + 1) // 64)

    before = get_num_threads()
    set_num_threads(threads)
    arrays = [np.ones(20_000_000) for _ in range(3)]
    whole(*arrays)
    seconds = []
    for _ in range(7):
        begin = time.perf_counter()
        whole(*arrays)
        seconds.append(time.perf_counter() - begin)
    set_num_threads(before)
    return 24 * len(arrays[0]) / np.median(seconds) / 1e9


def bytes_per_point(method, dim, ncomp, history, integrator):
    """What a step reads and writes of points and stencils at least, write-allocate included."""
    state = 2 * 8 * (2 * dim + ncomp + 1 + history) + 8                  # x, v, stress, volume, history; mass
    gradient = 8 * dim * dim * 4
    passes = {"usl": 2, "musl": 4, "usf": 4}[integrator]
    chosen = METHODS[method]
    total = state + gradient + 8 * (dim + dim + ncomp)                    # state read again by the map to the grid
    for basis in {chosen.mass, chosen.strain, chosen.force}:
        size = 8 * dim * 2 * WIDTH[basis] + 4 * dim
        total += size * (2 + (passes if basis is chosen.mass else 1))
    return total


def measure(engine, method, points, dim, threads, integrator, material, steps, repeats, refresh, bandwidth):
    mesh, particles, planes = block(points, dim)
    law = LAWS[material]
    options = dict(method=method, integrator=integrator, gravity=(0.0,) * (dim - 1) + (-1.0,), engine=engine,
                   threads=threads, flip=0.99, refresh=refresh)
    state = next(explicit_steps(mesh, particles, law, planes, steps=2, every=2, **options))        # compiles
    rates = []
    for _ in range(repeats):
        begin = time.perf_counter()
        for state in explicit_steps(mesh, state, law, planes, steps=steps, every=steps, **options):
            pass
        rates.append(particles.n * steps / (time.perf_counter() - begin))
    size = bytes_per_point(method, dim, KINEMATICS[dim].ncomp, len(law.history), integrator)
    rate = float(np.median(rates))
    return {"engine": state.engine, "method": method, "dim": dim, "points": particles.n, "threads": threads,
            "integrator": integrator, "material": material, "refresh": refresh, "steps": steps,
            "point_steps_per_s": round(rate), "min": round(min(rates)), "max": round(max(rates)),
            "bytes_per_point": size,
            "triad_GB_per_s": round(bandwidth, 1), "bandwidth_share": round(rate * size / bandwidth / 1e9, 3)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[100_000])
    parser.add_argument("--methods", nargs="+", default=["mpm", "gimp", "cmpm"], choices=METHODS)
    parser.add_argument("--dim", type=int, nargs="+", default=[2], choices=(1, 2, 3))
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument("--engines", nargs="+", default=["numba"], choices=("numpy", "numba"))
    parser.add_argument("--integrator", default="usl", choices=("musl", "usl", "usf"))
    parser.add_argument("--material", default="elastic", choices=LAWS)
    parser.add_argument("--steps", type=int, help="steps per repeat; about two seconds' worth if not given")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--refresh", type=int, default=50, help="after how many steps the stable step is found again")
    parser.add_argument("--json", action="store_true", help="print JSON lines (it always does)")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    print(json.dumps({"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version(),
                      "numpy": np.__version__, "date": time.strftime("%Y-%m-%d")}))
    for threads in chosen.threads:
        bandwidth = triad(threads)
        for dim in chosen.dim:
            for points in chosen.points:
                for method in chosen.methods:
                    for engine in chosen.engines if threads == chosen.threads[0] else set(chosen.engines) - {"numpy"}:
                        guess = {"numpy": 2e6, "numba": 60e6 / dim}[engine]
                        steps = chosen.steps or int(np.clip(guess / points, 4, 1000))
                        print(json.dumps(measure(engine, method, points, dim, threads, chosen.integrator,
                                                 chosen.material, steps, chosen.repeats,
                                                 chosen.refresh, bandwidth)), flush=True)


main()
