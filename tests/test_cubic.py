"""Cubic patches: cubic wherever the body is three cells wide, and never a node that the body does not hold."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from shared import ELEMENT
from test_cover import AXES, MAKE, MOTION, grid_of

from skfem_mpm import CMPMBasis, Particles
from skfem_mpm.basis import CubicBasis
from skfem_mpm.grid import available_sides, corner_nodes

every_dim = pytest.mark.parametrize("dim", [1, 2, 3])


def points_in(grid, mask, seed=0, each=3):
    """Random points in the marked cells."""
    random = np.random.default_rng(seed)
    index = np.repeat(np.stack(np.nonzero(mask)), each, axis=1)
    low = np.stack([axis[i] for axis, i in zip(grid.axes, index)])
    step = np.stack([width[i] for width, i in zip(grid.steps, index)])
    x = low + step * random.uniform(0.02, 0.98, low.shape)
    return x, grid.locate(x)


def read_nodes(stencil):
    felt = (stencil.value() != 0) | (stencil.gradient() != 0).any(axis=0)
    return np.unique(stencil.nodes()[felt])


def nodal(grid, function):
    return function(np.stack(np.meshgrid(*grid.axes, indexing="ij"))).ravel()[None]


def box(grid, low, high):
    mask = np.zeros(grid.cells.shape, dtype=bool)
    mask[tuple(slice(a, b) for a, b in zip(low, high))] = True
    return mask


def recovered(grid, mask, function, seed=0):
    x, index = points_in(grid, mask, seed)
    stencil = grid.cubic(x, index, available_sides(mask))
    field = nodal(grid, function)[0]
    slopes = np.einsum("ikn,kn->in", stencil.gradient(), field[stencil.nodes()])
    return x, stencil.to_points(field[None])[0], slopes


def derivative(function, x, k, step=1e-30):
    y = x.astype(complex)
    y[k] += 1j * step
    return function(y).imag / step


@every_dim
@pytest.mark.parametrize("width", [3, 4, 5])
def test_cubics_are_reproduced_to_the_edge_of_a_body_three_cells_wide(dim, width):
    grid = grid_of(*AXES[:dim])
    mask = box(grid, (1,) * dim, (1 + width,) * dim)
    for power in itertools.product(range(4), repeat=dim):
        def function(x, power=power):
            return np.prod([(row - 1.5) ** a for row, a in zip(x, power)], axis=0)

        x, value, slopes = recovered(grid, mask, function)
        assert_allclose(value, function(x), atol=1e-11)
        for k in range(dim):
            assert_allclose(slopes[k], derivative(function, x, k), atol=1e-10)


@every_dim
def test_cubics_are_reproduced_in_a_body_that_fills_the_grid(dim):
    grid = grid_of(*[axis[:4] for axis in AXES[:dim]])
    x, value, _ = recovered(grid, np.ones((3,) * dim, dtype=bool), lambda x: ((x - 1.2) ** 3).prod(axis=0))
    assert_allclose(value, ((x - 1.2) ** 3).prod(axis=0), atol=1e-12)


@every_dim
@pytest.mark.parametrize("width", [1, 2])
def test_thin_bodies_fall_back_to_cmpm(dim, width):
    grid = grid_of(*AXES[:dim])
    mask = box(grid, (2,) * dim, (2 + width,) * dim)
    x, index = points_in(grid, mask)
    sides = available_sides(mask)
    cubic, cmpm = grid.cubic(x, index, sides), grid.cmpm(x, index, sides)
    field = np.random.default_rng(0).normal(size=(1, grid.nnodes))
    assert_allclose(cubic.to_points(field), cmpm.to_points(field), atol=1e-13)
    assert np.isin(read_nodes(cubic), np.flatnonzero(corner_nodes(mask))).all()


@every_dim
def test_inside_it_is_cmpm(dim):
    grid = grid_of(*AXES[:dim])
    mask = np.ones(grid.cells.shape, dtype=bool)
    x, index = points_in(grid, box(grid, (1,) * dim, [n - 1 for n in grid.cells.shape]))
    sides = available_sides(mask)
    cubic, cmpm = grid.cubic(x, index, sides), grid.cmpm(x, index, sides)
    assert_array_equal(cubic.base, cmpm.base)
    assert_array_equal(cubic.w, cmpm.w)


def missing_corner(dim):
    """A body of three cells along each axis without one far corner."""
    mask = np.ones((3,) * dim, dtype=bool)
    mask[(2,) * dim] = False
    return np.pad(mask, 1)


@pytest.mark.parametrize("dim", [2, 3])
def test_at_a_corner_the_far_corner_of_the_patch_is_looked_at_too(dim):
    mask = missing_corner(dim)
    grid = grid_of(*[axis[:6] for axis in AXES[:dim]])
    x, index = points_in(grid, mask)
    assert np.isin(read_nodes(grid.cubic(x, index, available_sides(mask))), np.flatnonzero(corner_nodes(mask))).all()


@settings(max_examples=80)
@given(st.integers(0, 10 ** 6), st.integers(1, 3), st.floats(0.4, 0.98))
def test_no_body_whatever_its_shape_is_read_where_it_is_not(seed, dim, share):
    """Only nodes of occupied, active cells, sums to one, reproduces linear fields."""
    random = np.random.default_rng(seed)
    grid = grid_of(*[axis[:6] for axis in AXES[:dim]])
    mask = random.uniform(size=grid.cells.shape) < share
    active = random.uniform(size=grid.vertices.shape) < 0.97
    mask.ravel()[0] = True
    usable = mask & active_cells(active)
    x, index = points_in(grid, mask, seed)
    stencil = grid.cubic(x, index, available_sides(mask, active))
    allowed = corner_nodes(usable)
    hosts = np.unique(np.concatenate([np.ravel_multi_index(tuple(index + np.array(c)[:, None]), grid.vertices.shape)
                                      for c in itertools.product((0, 1), repeat=dim)]))
    assert np.isin(read_nodes(stencil), np.union1d(np.flatnonzero(allowed), hosts)).all()
    assert_allclose(stencil.value().sum(axis=0), 1, atol=1e-12)
    for k in range(dim):
        field = nodal(grid, lambda x, k=k: x[k])
        assert_allclose(stencil.to_points(field)[0], x[k], atol=1e-12)
        slopes = np.einsum("ikn,kn->in", stencil.gradient(), field[0][stencil.nodes()])
        assert_allclose(slopes, np.eye(dim)[k][:, None] * np.ones(x.shape[1]), atol=1e-10)


def active_cells(active):
    cells = np.ones([n - 1 for n in active.shape], dtype=bool)
    for corner in itertools.product((0, 1), repeat=active.ndim):
        cells &= active[tuple(slice(c, c + n) for c, n in zip(corner, cells.shape))]
    return cells


@settings(max_examples=30)
@given(st.integers(0, 10 ** 6), st.integers(2, 3), st.floats(0.5, 0.98))
def test_swapped_axes_and_mirrors_make_no_difference(seed, dim, share):
    random = np.random.default_rng(seed)
    axes = [axis[:6] for axis in AXES[:dim]]
    grid = grid_of(*axes)
    mask = random.uniform(size=grid.cells.shape) < share
    mask.ravel()[0] = True
    x, index = points_in(grid, mask, seed)
    field = random.normal(size=grid.vertices.shape)
    one = grid.cubic(x, index, available_sides(mask)).to_points(field.ravel()[None])
    order = list(range(dim))[::-1]
    other = grid_of(*[axes[k] for k in order])
    swapped = other.cubic(x[order], index[order], available_sides(mask.transpose(order)))
    assert_allclose(swapped.to_points(field.transpose(order).ravel()[None]), one, atol=1e-10)
    mirror = grid_of(-axes[0][::-1], *axes[1:])
    y = np.concatenate([-x[:1], x[1:]])
    mirrored = mirror.cubic(y, mirror.locate(y), available_sides(mask[::-1]))
    assert_allclose(mirrored.to_points(field[::-1].ravel()[None]), one, atol=1e-10)


def test_an_l_shape_keeps_its_patches_in_its_arms():
    mask = np.pad(np.ones((6, 4), dtype=bool), 1)
    mask[4:, 3:] = False                                # arms of two and of three cells
    grid = grid_of(np.arange(9.0), np.arange(7.0))
    x, index = points_in(grid, mask)
    stencil = grid.cubic(x, index, available_sides(mask))
    assert np.isin(read_nodes(stencil), np.flatnonzero(corner_nodes(mask))).all()
    wide = ((stencil.w[:, 0] != 0).sum(axis=1) == 4).all(axis=0)
    assert wide.any() and not wide.all()


@every_dim
def test_the_basis_is_the_stencil_of_occupied_cells(dim):
    mesh = MAKE[dim](*AXES[:dim])
    body = Particles.fill(mesh, MOTION[dim], where=lambda x: np.all(
        [(row > axis[1]) & (row < axis[-2]) for row, axis in zip(x, AXES)], axis=0))
    x = body.x
    basis = CubicBasis(mesh, ELEMENT[dim](), body)
    cubic = ((mesh.p - 1) ** 3).sum(axis=0)
    assert_allclose(basis.interpolate(cubic).grad[..., 0], 3 * (x - 1) ** 2, atol=1e-10)
    cmpm = CMPMBasis(mesh, ELEMENT[dim](), body).interpolate(cubic).grad[..., 0]
    assert np.abs(cmpm - 3 * (x - 1) ** 2).max() > 1e-3
