"""What many tests share: meshes, elements and motions by dimension, methods by kind, and a block that moves."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from skfem import ElementHex1, ElementLineP1, ElementQuad1, MeshHex, MeshLine, MeshQuad

from skfem_mpm import METHODS, Particles, axisymmetric, plane_strain, solid, uniaxial
from skfem_mpm.boundary import FixedPlane

MAKE = {1: MeshLine, 2: MeshQuad.init_tensor, 3: MeshHex.init_tensor}
ELEMENT = {1: ElementLineP1, 2: ElementQuad1, 3: ElementHex1}
MOTION = {1: uniaxial, 2: plane_strain, 3: solid}
MOTIONS = [(uniaxial, 1), (plane_strain, 2), (axisymmetric, 1), (axisymmetric, 2), (solid, 3)]
SYMMETRIC = [name for name, method in METHODS.items() if method.conjugate]
FLUTTERING = [name for name in METHODS if name not in SYMMETRIC]
FASTEST = "numba" if find_spec("numba") else "numpy"         # for long runs; test_engines says that they agree

compiled = pytest.mark.skipif(not find_spec("numba"), reason="numba is an extra")
both_engines = pytest.mark.parametrize("engine", ["numpy", pytest.param("numba", marks=compiled)])
every_method = pytest.mark.parametrize("method", METHODS)
symmetric_methods = pytest.mark.parametrize("method", SYMMETRIC)
every_motion = pytest.mark.parametrize("kinematics, dim", MOTIONS, ids=lambda value: getattr(value, "name", value))


def block(dim, kinematics, cells=4, axes=None):
    """A block with random velocities on a rough floor, rising and tilting so that points cross cells."""
    h, start = 1 / cells, 2.0 if kinematics.hoop else 0.0
    lines, axis = np.linspace(0, 1, cells + 1), h * np.arange(-1, cells + 4)
    inner, outer = [lines + start, lines, lines][:dim], axes or [axis + start, axis, axis][:dim]
    particles = Particles.fill(MAKE[dim](*inner), kinematics, density=1.0)
    rng = np.random.default_rng(0)
    particles = replace(particles, x=particles.x + 0.03 * h * rng.uniform(-1, 1, particles.x.shape),
                        velocity=0.3 + 0.1 * rng.uniform(-1, 1, particles.x.shape))
    floor = FixedPlane(dim - 1, start if dim == 1 else 0.0, -1, tuple(range(dim)), name="floor")
    planes = [floor] + ([FixedPlane(0, start, -1, name="left")] if dim > 1 else [])
    return MAKE[dim](*outer), particles, planes
