"""What happens at the nodes of an explicit step: mirrors, light nodes, velocities, available sides.

Window arrays are small against those of points, so one thread does all of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import INLINE, OPTIONS

U = np.uint64


@njit(**INLINE)
def _fold(g, inside, outside, signs):
    for k in range(len(inside)):
        for j in range(g.shape[1]):
            g[inside[k], j] += signs[k, j] * g[outside[k], j]
            g[outside[k], j] = 0.0


@njit(**OPTIONS)
def classify(g, cutoff, offsets, active, lights):
    """Active nodes by their folded mass, and the light ones: those with mass that are not active.

    A node is active if it has more mass than the share ``cutoff`` of the largest one, on the grid or around it.
    ``offsets`` lead to the nodes around one: a row to those across faces, then across edges, then across corners,
    filled up with zeros; a light node itself is not active.
    """
    largest, count = 0.0, 0
    for i in range(len(g)):
        largest = max(largest, g[U(i), 0])
    least = cutoff * largest
    for i in range(len(g)):
        mass = g[U(i), 0]
        active[U(i)] = mass > least
        if mass > 0 and not mass > least:
            near = mass
            for offset in offsets.flat:
                near = max(near, g[i + offset, 0])
            active[i] = mass > cutoff * near
            lights[count] = i
            count += not mass > cutoff * near
    return count


@njit(**INLINE)
def _nearest(node, active, offsets):
    """How many active nodes are nearest to a light one, and in which row of the offsets."""
    for row in range(len(offsets)):
        around = 0
        for offset in offsets[row]:
            around += active[node + offset]
        if around:
            return around, row
    return 0, 0


@njit(**INLINE)
def _collect(g, active, lights, count, offsets):
    for k in range(count):
        node = lights[k]
        around, row = _nearest(node, active, offsets)
        if around:
            share = 1 / around
            for offset in offsets[row]:
                if active[node + offset]:
                    for j in range(g.shape[1]):
                        g[node + offset, j] += share * g[node, j]
            for j in range(g.shape[1]):
                g[node, j] = 0.0


@njit(**OPTIONS)
def fold(g, gravity, inside, outside, signs):
    """Add the weight of mass, column 0, to the last columns, then take what is behind planes to its mirror images."""
    first = g.shape[1] - len(gravity)
    for k in range(len(gravity)):
        for i in range(len(g)):
            g[i, first + k] += gravity[k] * g[i, 0]
    _fold(g, inside, outside, signs)


@njit(**OPTIONS)
def collect(g, active, lights, count, offsets):
    """Take what light nodes have to the active nodes around them."""
    _collect(g, active, lights, count, offsets)


@njit(**OPTIONS)
def gather(g, inside, outside, signs, offsets, active, lights, count):
    """Both, for further sums of the step."""
    _fold(g, inside, outside, signs)
    _collect(g, active, lights, count, offsets)


@njit(**INLINE)
def _spread(nodal, inside, outside, signs, offsets, active, lights, count):
    for k in range(count):
        node = lights[k]
        around, row = _nearest(node, active, offsets)
        for j in range(nodal.shape[1]):
            nodal[node, j] = 0.0
        for offset in offsets[row]:
            if active[node + offset]:
                for j in range(nodal.shape[1]):
                    nodal[node, j] += nodal[node + offset, j] / around
    for k in range(len(inside) - 1, -1, -1):
        for j in range(nodal.shape[1]):
            nodal[outside[k], j] = signs[k, j] * nodal[inside[k], j]


@njit(**OPTIONS)
def spread(nodal, inside, outside, signs, offsets, active, lights, count):
    """Numbers of light nodes, and of those behind planes."""
    _spread(nodal, inside, outside, signs, offsets, active, lights, count)


@njit(**OPTIONS)
def velocities(g, force, column, fixed, active, dt, damping, nodal, dims, inside, outside, signs, offsets, lights,
               count):
    """Velocity after the step and its change from mass, momentum and force; returns the work that damping takes."""
    work, dim = 0.0, len(dims)
    for q in range(len(g)):
        i = U(q)
        if not active[i]:
            for j in range(2 * len(dims)):
                nodal[i, j] = 0.0
            continue
        inverse = 1 / g[i, 0]
        for k in range(len(dims)):
            free = 1.0 - fixed[i, k]
            before = free * g[i, 1 + k] * inverse
            push, lost = free * force[i, column + k], 0.0
            if damping:
                lost = damping * abs(push) * np.sign(before)
            change = dt * (push - lost) * inverse
            work += lost * (before + change / 2)
            nodal[i, k] = before + change
            nodal[i, dim + k] = change
    _spread(nodal, inside, outside, signs, offsets, active, lights, count)
    return work


@njit(**OPTIONS)
def plain_velocities(g, momentum, column, fixed, active, nodal, dims, inside, outside, signs, offsets, lights, count):
    """Velocity from mass and momentum of active nodes."""
    for q in range(len(g)):
        i = U(q)
        inverse = 1 / g[i, 0] if active[i] else 0.0
        for k in range(len(dims)):
            nodal[i, k] = (1 - fixed[i, k]) * momentum[i, column + k] * inverse
    _spread(nodal, inside, outside, signs, offsets, active, lights, count)


@njit(**OPTIONS)
def available_sides(occupied, active, corners, faces, diagonals, usable, dropped, sides):
    """Twin of :func:`skfem_mpm.grid.available_sides`, for occupied cells.

    Cells are numbered by their first node; bit ``2 k`` of a cell in ``sides`` is its left neighbour along axis ``k``,
    the next bit the right one.  Cells near the ends of the window are empty.  Loops run over cells inside, branch-free
    on bytes, so many cells go at once.
    """
    reach = corners[-1]
    n0, n1 = reach, len(occupied) - reach
    usable[:], dropped[:], sides[:] = occupied, 0, 0
    for k in range(len(corners)):
        step = corners[k]
        for i in range(n0, n1):
            usable[U(i)] &= active[U(i + step)]
    for k in range(len(faces)):
        step, bit = faces[k], np.uint8(1 << k)
        for i in range(n0, n1):
            sides[U(i)] |= np.uint8(usable[U(i + step)] * bit)
    for k in range(len(diagonals)):
        step, involved = diagonals[k, 0], np.uint8(diagonals[k, 1])
        for i in range(n0, n1):
            missing = np.uint8((sides[U(i)] & involved) == involved) & (usable[U(i + step)] ^ np.uint8(1))
            dropped[U(i)] |= np.uint8(involved * missing)
    for i in range(n0, n1):
        sides[U(i)] &= ~dropped[U(i)]
