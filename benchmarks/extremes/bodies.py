"""Bodies and grids that several families of extremes share."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
from skfem import MeshHex, MeshLine, MeshQuad

from skfem_mpm import LinearElastic, Particles, plane_strain, solid, uniaxial
from skfem_mpm.boundary import FixedPlane

MAKE = {1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}
MOTION = {1: uniaxial, 2: plane_strain, 3: solid}
LAW = {1: LinearElastic(E=1.0, nu=0.0), 2: LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3),
       3: LinearElastic(E=1.3 * 0.4 / 0.7, nu=0.3)}              # pressure waves of speed 1, with density 1
FASTEST = "numba" if find_spec("numba") else "numpy"             # for long runs


def grid_of(dim, cells, spare=4):
    """Cells of size 1 around a body of ``cells`` cells an axis that starts at 0."""
    return MAKE[dim](*[np.arange(-float(spare), cells + spare + 1)] * dim)


def block(dim, cells, per_cell=2, shift=0.0, density=1.0):
    """A body of ``cells`` cells of size 1 an axis, moved by ``shift`` against the grid."""
    body = Particles.fill(MAKE[dim](*[np.arange(cells + 1.0)] * dim), MOTION[dim], per_cell=per_cell, density=density)
    return replace(body, x=body.x + np.broadcast_to(np.asarray(shift, dtype=float), (dim,))[:, None])


def with_noise(body, size, seed=7):
    """The body with random velocities that have no mean."""
    noise = np.random.default_rng(seed).uniform(-1, 1, body.x.shape)
    mean = (body.mass * noise).sum(axis=1, keepdims=True) / body.mass.sum()
    return replace(body, velocity=size * (noise - mean))


def last(states):
    """The last of some states."""
    *_, state = states
    return state


def worst_of(*values):
    """The largest of some numbers, or of those that one iterable has; no number if one is none, which ``max`` hides."""
    return float(np.max([*values[0]] if len(values) == 1 else values))


def until(time, states):
    """The first of some states that is at a time, or past it."""
    return next(state for state in states if state.time >= time * (1 - 1e-9))


def mechanical(state):
    """Kinetic and elastic energy."""
    return state.energy["kinetic"] + state.energy["elastic"]


def pull(dim, size=1e-3):
    """Gravity down the last axis."""
    return (0.0,) * (dim - 1) + (-size,)


def low_planes(dim):
    """Rollers at zero along every axis; the one that carries weight is the base."""
    return [FixedPlane(k, 0.0, -1, name="base" if k == dim - 1 else f"side {k}") for k in range(dim)]


def rms(values):
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def misfit(found, exact):
    """Rms error relative to the rms of what is exact."""
    return np.sqrt(((found - exact) ** 2).mean() / (exact ** 2).mean())
