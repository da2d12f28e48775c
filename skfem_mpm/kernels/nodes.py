"""What happens at the nodes of an explicit step: sums, mirrors, light nodes, velocities, available sides."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import CHUNKS, OPTIONS

U = np.uint64


@njit(**OPTIONS)
def _sum_bands(copies, bands, g, gravity, n0, n1):
    flat, columns = g.ravel(), g.shape[1]
    for i in range(n0 * columns, n1 * columns):
        flat[U(i)] = 0.0
    for c in range(CHUNKS):
        low, high = bands[c, 0], bands[c, 1]
        low, high = n0 if low < n0 else low, n1 if high > n1 else high
        copy = copies[c].ravel()
        for i in range(low * columns, high * columns):
            flat[U(i)] += copy[U(i)]
    for k in range(len(gravity)):
        for i in range(n0, n1):
            g[i, 1 + len(gravity) + k] += gravity[k] * g[i, 0]


@njit(parallel=True, **OPTIONS)
def sum_bands(copies, bands, g, gravity):
    """Sum the chunks' grids in a fixed order; adds the weight to the force, unless ``gravity`` is empty."""
    n = len(g)
    for c in prange(CHUNKS):
        _sum_bands(copies, bands, g, gravity, n * c // CHUNKS, n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def _fold(g, inside, outside, signs):
    for k in range(len(inside)):
        for j in range(g.shape[1]):
            g[inside[k], j] += signs[k, j] * g[outside[k], j]
            g[outside[k], j] = 0.0


@njit(**OPTIONS)
def _classify(g, cutoff, active, lights):
    largest = 0.0
    for i in range(len(g)):
        largest = max(largest, g[i, 0])
    least, count = cutoff * largest, 0
    for i in range(len(g)):
        mass = g[i, 0]
        active[i] = mass > least
        if mass > 0 and mass <= least:
            lights[count] = i
            count += 1
    return count


@njit(**OPTIONS)
def _collect(g, active, lights, count, offsets):
    for k in range(count):
        node, around = lights[k], 0
        for offset in offsets:
            around += active[node + offset]
        if around:
            share = 1 / around
            for offset in offsets:
                if active[node + offset]:
                    for j in range(g.shape[1]):
                        g[node + offset, j] += share * g[node, j]
            for j in range(g.shape[1]):
                g[node, j] = 0.0


@njit(**OPTIONS)
def gather_first(g, cutoff, inside, outside, signs, offsets, active, lights):
    """Fold what is behind planes, tell active and light nodes by mass, and hand on what light ones have."""
    _fold(g, inside, outside, signs)
    count = _classify(g, cutoff, active, lights)
    _collect(g, active, lights, count, offsets)
    return count


@njit(**OPTIONS)
def gather(g, inside, outside, signs, offsets, active, lights, count):
    """The same for further sums of the step."""
    _fold(g, inside, outside, signs)
    _collect(g, active, lights, count, offsets)


@njit(**OPTIONS)
def _velocities(g, force, column, fixed, active, dt, damping, nodal, dims, n0, n1):
    work, dim = 0.0, len(dims)
    for q in range(n0, n1):
        i = U(q)
        if not active[i]:
            for j in range(2 * len(dims)):
                nodal[i, j] = 0.0
            continue
        inverse = 1 / g[i, 0]
        for k in range(len(dims)):
            free = 1.0 - fixed[i, k]
            before = free * g[i, 1 + k] * inverse
            push = free * force[i, column + k]
            if damping:
                lost = damping * abs(push) * np.sign(before)
                work += lost * before
                push -= lost
            change = dt * push * inverse
            nodal[i, k] = before + change
            nodal[i, dim + k] = change
    return work


@njit(parallel=True, **OPTIONS)
def velocities(g, force, column, fixed, active, dt, damping, nodal, work, dims):
    """Velocity after the step and its change from mass, momentum and force; ``work`` takes what damping takes."""
    n = len(g)
    for c in prange(CHUNKS):
        work[c] = _velocities(g, force, column, fixed, active, dt, damping, nodal, dims, n * c // CHUNKS,
                              n * (c + 1) // CHUNKS)


@njit(**OPTIONS)
def plain_velocities(g, fixed, active, nodal):
    """Velocity from mass and momentum, its change zero."""
    dim = fixed.shape[1]
    for i in range(len(g)):
        inverse = 1 / g[i, 0] if active[i] else 0.0
        for k in range(dim):
            nodal[i, k] = (1 - fixed[i, k]) * g[i, 1 + k] * inverse
            nodal[i, dim + k] = 0.0


@njit(**OPTIONS)
def spread(nodal, inside, outside, signs, offsets, active, lights, count):
    """Velocities of light nodes, and of those behind planes."""
    for k in range(count):
        node, around = lights[k], 0
        for offset in offsets:
            around += active[node + offset]
        for offset in offsets:
            if active[node + offset]:
                for j in range(nodal.shape[1]):
                    nodal[node, j] += nodal[node + offset, j] / around
    for k in range(len(inside) - 1, -1, -1):
        for j in range(nodal.shape[1]):
            nodal[outside[k], j] = signs[k, 1 + j] * nodal[inside[k], j]


@njit(**OPTIONS)
def _usable(occupied, active, corners, n0, n1, usable):
    for i in range(n0, n1):
        usable[i] = occupied[i]
        if occupied[i]:
            for corner in corners:
                usable[i] &= active[i + corner]


@njit(**OPTIONS)
def _sides(occupied, usable, faces, diagonals, n0, n1, sides):
    for i in range(n0, n1):
        if not occupied[i]:
            continue
        first, dropped = 0, 0
        for k in range(len(faces)):
            first |= usable[i + faces[k]] << k
        for k in range(len(diagonals)):
            step, involved = diagonals[k]
            if first & involved == involved and not usable[i + step]:
                dropped |= involved
        sides[i] = first & ~dropped


@njit(parallel=True, **OPTIONS)
def available_sides(occupied, active, corners, faces, diagonals, usable, sides):
    """Twin of :func:`skfem_mpm.grid.available_sides`, for occupied cells.

    Cells are numbered by their first node; bit ``2 k`` of a cell in ``sides`` is its left neighbour along axis ``k``,
    the next bit the right one.
    """
    n = len(occupied)
    for c in prange(CHUNKS):
        _usable(occupied, active, corners, n * c // CHUNKS, n * (c + 1) // CHUNKS, usable)
    for c in prange(CHUNKS):
        _sides(occupied, usable, faces, diagonals, n * c // CHUNKS, n * (c + 1) // CHUNKS, sides)
