"""Norms of stiffness blocks, of which the stable step is made, against the assembled stiffness."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import MAKE, every_motion

from skfem_mpm import METHODS, LinearElastic, Particles
from skfem_mpm.explicit.bound import block_norms
from skfem_mpm.explicit.nodes import Nodes
from skfem_mpm.grid import Grid
from skfem_mpm.integration import on_points


def layout(kinematics, dim, method, cells=4, per_cell=2):
    """Shaken points in no order, some cells fuller than others, on a graded mesh that is wider in one direction."""
    rng = np.random.default_rng(0)
    lines = np.linspace(1, 2, cells + 1) ** 1.2
    step = np.diff(lines)
    ghost = [lines[0] - step[0], *lines, lines[-1] + step[-1]]
    whole = Particles.fill(MAKE[dim](*[lines] * dim), kinematics, density=1.0, per_cell=per_cell)
    body = whole.where(rng.permutation(whole.n)[:max(2, whole.n * 3 // 4)])
    x = body.x + 0.05 * step.min() * rng.uniform(-1, 1, body.x.shape)
    chosen = METHODS[method]
    return Nodes(Grid.from_mesh(MAKE[dim](*[ghost] * (dim - 1), [*ghost, ghost[-1] + 1.0])), kinematics, x, body.mass,
                 body.length, chosen, "ghost", ()), body


def expected(nodes, moduli, volume):
    dim, size = nodes.grid.dim, nodes.grid.nnodes
    operator = on_points(nodes.kinematics, nodes.force.stencil, nodes.strain.stencil, volume, nodes.x[0])
    number = np.arange(dim * size).reshape(size, dim).T
    blocks = operator.tangent(moduli, number, dim * size).toarray().reshape(size, dim, size, dim)
    return np.sqrt((blocks ** 2).sum(axis=(1, 3)))


@pytest.mark.parametrize("cells, per_cell", [(1, 2), (4, 2), (2, 5)])
@every_motion
@pytest.mark.parametrize("method", METHODS)
def test_norms_are_those_of_the_assembled_stiffness(method, kinematics, dim, cells, per_cell):
    nodes, body = layout(kinematics, dim, method, cells, per_cell)
    zero = np.zeros((kinematics.ncomp, body.n))
    same = LinearElastic(E=1e3, nu=0.3).tangent(zero, zero, zero[:0], kinematics.rows(dim))
    unequal = same * np.random.default_rng(1).uniform(0.5, 2.0, body.n)
    for moduli in (same, same * np.ones(body.n), unequal):
        want = expected(nodes, moduli, body.volume)
        got = block_norms(nodes, moduli, body.volume).toarray()
        assert_allclose(got, want, atol=1e-13 * want.max())
