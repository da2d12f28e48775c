"""Empty mesh costs nothing: what a step makes, and what a run holds, do not depend on the mesh around the body."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from shared import MAKE

from skfem_mpm import METHODS, LinearElastic, Particles, explicit_steps, plane_strain, solid, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.explicit.couplings import Couplings
from skfem_mpm.explicit.nodes import Nodes
from skfem_mpm.grid import Grid

KINEMATICS = {1: uniaxial, 2: plane_strain, 3: solid}
LAW = LinearElastic(E=1e3, nu=0.3)
CELLS = {1: 40, 2: 20, 3: 4}                                       # of the body, along each axis
TENFOLD = {1: (9 * 40,), 2: (180, 0), 3: (36, 0, 0)}               # cells more, along each axis
every_dim = pytest.mark.parametrize("dim", [1, 2, 3])


def scene(dim, more=None):
    """A block of points with a margin of two cells, on a floor, and maybe much empty mesh behind it."""
    cells, more = CELLS[dim], more or (0,) * dim
    lines = np.arange(cells + 1) / cells
    body = Particles.fill(MAKE[dim](*[lines] * dim), KINEMATICS[dim], density=1.0)
    body = replace(body, velocity=0.05 * np.sin(2 * np.pi * body.x))
    axes = [np.arange(-2, cells + 3 + extra) / cells for extra in more]
    return MAKE[dim](*axes), body, [FixedPlane(dim - 1, 0.0, -1)]


def run(mesh, body, planes, steps, **choices):
    gravity = (0.0,) * (body.dim - 1) + (-1.0,)
    given = {"engine": "numpy", "gravity": gravity, "every": steps} | choices
    return explicit_steps(mesh, body, LAW, planes, steps=steps, **given)


def nodes_of(mesh, body, planes, method):
    chosen = METHODS[method]
    return Nodes(Grid.from_mesh(mesh), body.kinematics, body.x, body.mass, body.length, chosen, "ghost", planes)


def sizes(nodes):
    """Sizes of all arrays of a step."""
    found = {name: value.size for name, value in vars(nodes).items() if isinstance(value, np.ndarray)}
    for name in ("mapping", "strain", "force"):
        operators = getattr(nodes, name)
        found |= {(name, k): (table.nnz, table.shape) for k, table in enumerate([operators.value, *operators.slopes])}
    couplings = Couplings(nodes.force, nodes.strain)
    return found | {"grid": nodes.grid.nnodes, "couplings": couplings.size}


@every_dim
@pytest.mark.parametrize("method", METHODS)
def test_what_a_step_makes_does_not_depend_on_the_mesh(method, dim):
    (small, *given), (large, *_) = scene(dim), scene(dim, TENFOLD[dim])
    assert large.nelements > 4 * small.nelements
    assert sizes(nodes_of(small, *given, method)) == sizes(nodes_of(large, *given, method))


@every_dim
@pytest.mark.filterwarnings("ignore:the strain of this method")
@pytest.mark.parametrize("method", METHODS)
def test_results_do_not_depend_on_the_mesh(method, dim):
    (small, *given), (large, *_) = scene(dim), scene(dim, TENFOLD[dim])
    near, far = ([*run(mesh, *given, 5, method=method)][-1] for mesh in (small, large))
    assert near.dt == far.dt
    for name in ("x", "velocity", "sigma"):
        assert_array_equal(getattr(near.particles, name), getattr(far.particles, name))


def peak_of(mesh, body, planes, **choices):
    """Largest memory of a run beyond its mesh, points and the view of the mesh, and what the view holds."""
    tracemalloc.start()
    grid = Grid.from_mesh(mesh)
    view = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    for _ in run(mesh, body, planes, 3, **choices):
        pass
    peak = tracemalloc.get_traced_memory()[1] - view
    tracemalloc.stop()
    return peak, view, grid


@pytest.mark.parametrize("choices", [{}, {"integrator": "usl"}, {"method": "gimp"}, {"remedy": "bbar"}], ids=str)
def test_a_run_takes_no_more_memory_on_ten_times_the_mesh(choices):
    (small, *given), (large, *_) = scene(2), scene(2, (0, 9 * 24))
    assert large.nelements == 10 * small.nelements
    next(run(small, *given, 1, **choices))                              # what is made once is made now
    peak, _, _ = peak_of(small, *given, **choices)
    more, _, _ = peak_of(large, *given, **choices)
    assert more < 1.05 * peak + 20_000                                  # and axes, which are long


@every_dim
def test_the_view_of_a_mesh_is_two_short_integers_per_cell(dim):
    mesh, *_ = scene(dim, {1: (30_000,), 2: (300, 100), 3: (36, 12, 12)}[dim])
    tracemalloc.start()
    grid = Grid.from_mesh(mesh)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    tables = grid.cells.nbytes + grid.vertices.nbytes
    assert tables == 4 * (mesh.nelements + mesh.nvertices)
    assert held < tables + 100 * sum(len(axis) for axis in grid.axes) + 20_000
    assert peak < held + (4 * dim + 3) * mesh.nvertices + 3_000_000     # places of nodes along the axes, and chunks
