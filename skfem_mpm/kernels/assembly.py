"""Twins of :class:`~skfem_mpm.integration.Pair`: displacement gradients, internal force and its tangent.

Points are handled in pieces.  ``base (dim, n)`` is the first node of each point, ``index (dim, N)`` the places of its
``N`` nodes from there, ``tables`` a tuple of arrays ``(N, n)``: slopes along the axes, then in axial symmetry value by
radius.  Row ``i * dim + l`` of a gradient takes component ``i`` through table ``l``, the hoop row the first component
through the last table.  Nodal arrays are node-major ``(nnodes, dim)``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import INLINE, OPTIONS

U = np.uint64


@njit(**INLINE)
def _find(base, index, shape, p, nodes):
    """Nodes of a point; those off the grid, which have no weight, repeat one on it."""
    for a in range(index.shape[1]):
        node = 0
        for k in range(len(shape)):
            node = node * shape[k] + min(max(base[k, p] + index[k, a], 0), shape[k] - 1)
        nodes[a] = node


@njit(**INLINE)
def _find_all(base, index, shape, a, nodes):
    """Node ``a`` of all points."""
    for p in range(len(nodes)):
        nodes[p] = 0
    for k in range(len(shape)):
        shift, most = index[k, a], shape[k] - 1
        for p in range(len(nodes)):
            nodes[p] = nodes[p] * shape[k] + min(max(base[k, p] + shift, 0), most)


@njit(**OPTIONS)
def gradient(base, index, shape, tables, nodal, first, out):
    """Displacement gradient of the points, ``(m, n)`` from the column ``first``."""
    n, dim = base.shape[1], len(shape)
    nodes, local = np.empty(n, dtype=np.int64), np.empty(n)
    for q in range(len(out)):
        for p in range(n):
            out[q, first + p] = 0.0
    for a in range(index.shape[1]):
        _find_all(base, index, shape, a, nodes)
        for i in range(dim):
            for p in range(n):
                local[p] = nodal[U(nodes[p]), U(i)]
            for l in range(len(tables) if i == 0 else dim):     # the hoop row has the first component only
                table, row = tables[l][a], out[i * dim + l if l < dim else dim * dim]
                for p in range(n):
                    row[U(first + p)] += table[U(p)] * local[U(p)]


@njit(**OPTIONS)
def force(base, index, shape, tables, piola, volume, out):
    """Add the internal force of point stress ``(m, n)``."""
    n, dim = base.shape[1], len(shape)
    nodes, local = np.empty(n, dtype=np.int64), np.empty(n)
    for a in range(index.shape[1]):
        _find_all(base, index, shape, a, nodes)
        for i in range(dim):
            for p in range(n):
                local[p] = 0.0
            for l in range(len(tables) if i == 0 else dim):
                table, row = tables[l][a], piola[i * dim + l if l < dim else dim * dim]
                for p in range(n):
                    local[U(p)] += table[U(p)] * row[U(p)]
            for p in range(n):
                out[U(nodes[p]), U(i)] += volume[p] * local[p]


@njit(**INLINE)
def _modulus(moduli, volume, p, dim, hoop, out):
    """Moduli of a point times its volume, ``(k, i, l, l')``: what component ``k`` does to row ``i * dim + l``."""
    q = p if moduli.shape[2] > 1 else 0
    last = dim * dim
    for k in range(dim):
        for i in range(dim):
            for l in range(dim + hoop):
                for j in range(dim + hoop):
                    row, column = i * dim + l if l < dim else last, k * dim + j if j < dim else last
                    there = (l < dim or i == 0) and (j < dim or k == 0)
                    out[k, i, l, j] = volume[p] * moduli[row, column, q] if there else 0.0


@njit(**INLINE)
def _copy(tables, p, out):
    for l in range(len(tables)):
        for a in range(out.shape[1]):
            out[l, a] = tables[l][a, p]


@njit(**INLINE)
def _add(ours, stress, block, there, shift):
    """Add what a column node does to all row nodes; four sums at a time are what processors like best."""
    count, width = stress.shape
    if width == 4:
        s0, s1, s2, s3 = stress[0, 0], stress[0, 1], stress[0, 2], stress[0, 3]
        t0, t1, t2, t3 = stress[1, 0], stress[1, 1], stress[1, 2], stress[1, 3]
        for a in range(len(there)):
            line, s, t = block[U(shift + there[a])], ours[0, U(a)], ours[1, U(a)]
            v0 = line[0] + s * s0 + t * t0
            v1 = line[1] + s * s1 + t * t1
            v2 = line[2] + s * s2 + t * t2
            v3 = line[3] + s * s3 + t * t3
            line[0], line[1], line[2], line[3] = v0, v1, v2, v3
        first = 2
    else:
        first = 0
    if count > first:
        for a in range(len(there)):
            line = block[shift + there[a]]
            for e in range(width):
                total = line[e]
                for l in range(first, count):
                    total += ours[l, a] * stress[l, e]
                line[e] = total


@njit(**OPTIONS)
def tangent(bases, indices, shape, compact, reach, tables, others, moduli, volume, out):
    """Add the tangent of some points to the table ``(column node, offset of row node, k, i)``.

    ``bases`` and ``indices`` are those of force and strain, ``tables`` and ``others`` their tables.  ``compact`` has
    the places of column nodes; other nodes have the last number, which is no place in the table.
    """
    (base, source), (rows, columns) = bases, indices
    dim, count, hoop = len(shape), len(tables), len(tables) - len(shape)
    factor = np.empty((dim, dim, count, count))
    ours, theirs = np.empty((count, rows.shape[1])), np.empty((count, columns.shape[1]))
    stress = np.empty((count, dim * dim))
    nodes = np.empty(columns.shape[1], dtype=np.int64)
    there, back = np.zeros(rows.shape[1], dtype=np.int64), np.zeros(columns.shape[1], dtype=np.int64)
    for k in range(dim):
        for a in range(len(there)):
            there[a] = there[a] * (2 * reach + 1) + rows[k, a]
        for a in range(len(back)):
            back[a] = back[a] * (2 * reach + 1) + columns[k, a]
    for p in range(base.shape[1]):
        _find(source, columns, shape, p, nodes)
        _modulus(moduli, volume, p, dim, hoop, factor)
        _copy(tables, p, ours)
        _copy(others, p, theirs)
        shift = 0
        for k in range(dim):
            shift = shift * (2 * reach + 1) + base[k, p] - source[k, p] + reach
        for b in range(len(nodes)):
            column = compact[nodes[b]]
            if column == len(out):
                continue
            for k in range(dim):
                for i in range(dim):
                    for l in range(count):
                        total = 0.0
                        for j in range(count):
                            total += factor[k, i, l, j] * theirs[j, b]
                        stress[l, k * dim + i] = total
            _add(ours, stress, out[column], there, shift - back[b])


@njit(**INLINE)
def _around(node, shape, reach, number, rows):
    """Rows of the nodes around a node, ``(offsets, dim)``; -1 for none."""
    span, dim = 2 * reach + 1, len(shape)
    for a in range(len(rows)):
        rest, power, stride, place, other, inside = a, len(rows), len(number), node, 0, True
        for k in range(dim):
            power, stride = power // span, stride // shape[k]
            along = place // stride + rest // power - reach
            place, rest = place % stride, rest % power
            inside = inside and 0 <= along < shape[k]
            other += along * stride
        for i in range(dim):
            rows[a, i] = number[other, i] if inside else -1


@njit(**OPTIONS)
def compress(table, known, number, shape, reach, start, row, value):
    """The entries of a table that are not zero, by columns; ``start`` takes where each begins, and their number."""
    dim, filled, last = len(shape), 0, -1
    rows = np.empty((table.shape[1], dim), dtype=np.int64)
    for c in range(len(known)):
        _around(known[c], shape, reach, number, rows)
        for k in range(dim):
            column = number[known[c], k]
            for gap in range(last, column):
                start[gap + 1] = filled
            last = max(last, column)
            if column >= 0:
                for a in range(len(rows)):
                    for i in range(dim):
                        entry, place = table[c, U(a), U(k * dim + i)], rows[U(a), U(i)]
                        row[U(filled)], value[U(filled)] = place, entry
                        filled += (entry != 0) & (place >= 0)
    for gap in range(last + 1, len(start)):
        start[gap] = filled
