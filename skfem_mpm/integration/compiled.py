"""The compiled twin of a pair of operators."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy import ndarray
from scipy.sparse import csc_array

from ..kernels import assembly
from .pair import Functions, Pair

PIECE = 2048    # points handled at once: their tables stay in the cache

Tables = tuple[ndarray, ...]


class CompiledPair(Pair):
    """The same operators as those of a :class:`Pair`, by numba; one thread, so sums are always in one order."""

    def __init__(self, pair: Pair):
        vars(self).update(vars(pair))
        self.same = self.strain_functions is self.force_functions
        self.shape = tuple(int(size) for size in self.force_functions.shape)

    def _places(self, functions: Functions) -> ndarray:
        """Places of the nodes of a point from its first one, ``(dim, K**dim)``."""
        return np.indices((functions.width,) * self.dim).reshape(self.dim, -1)

    def _each(self, functions: Functions) -> Iterator[tuple[slice, ndarray, Tables]]:
        """Pieces of the points, their first nodes and tables."""
        for start in range(0, self.volume.size, PIECE):
            part = slice(start, start + PIECE)
            yield part, _rows(functions.base[:, part]), _tables(functions, part)

    def gradient(self, u: ndarray) -> ndarray:
        """:math:`G u`: displacement gradient at the points, ``(m, n)``."""
        out, nodal = np.empty((len(self.rows), self.volume.size)), np.ascontiguousarray(u.T)
        index = self._places(self.strain_functions)
        for part, base, tables in self._each(self.strain_functions):
            assembly.gradient(base, index, self.shape, tables, nodal, part.start, out)
        return out

    def force(self, piola: ndarray) -> ndarray:
        r""":math:`L \Pi`: internal force, ``(dim, nnodes)``, from point stress ``(m, n)``."""
        out = np.zeros((int(np.prod(self.shape)), self.dim))
        index = self._places(self.force_functions)
        for part, base, tables in self._each(self.force_functions):
            assembly.force(base, index, self.shape, tables, _solid(piola[:, part]), self.volume[part], out)
        return np.ascontiguousarray(out.T)

    def tangent(self, moduli: ndarray, number: ndarray, size: int) -> csc_array:
        r""":math:`L\,\mathbb A\,G` as a sparse matrix, see :meth:`Pair.tangent`."""
        reach, known, compact = self._reach(), *self._known(number)
        out = np.zeros((len(known), (2 * reach + 1) ** self.dim, self.dim ** 2))
        functions = self.force_functions, self.strain_functions
        indices = tuple(self._places(each) for each in functions)
        for part, base, tables in self._each(self.force_functions):
            others = tables if self.same else _tables(self.strain_functions, part)
            source = base if self.same else _rows(self.strain_functions.base[:, part])
            here = _solid(moduli if moduli.shape[2] == 1 else moduli[:, :, part])
            assembly.tangent((base, source), indices, self.shape, compact, reach, tables, others, here,
                             self.volume[part], out)
        return self._compressed(out, known, number, size, reach)

    def _compressed(self, table: ndarray, known: ndarray, number: ndarray, size: int, reach: int) -> csc_array:
        """The table ``(column node, offset, k * dim + i)`` without its zeros, as a sparse matrix."""
        most = table.size + 1       # memory that is never written to costs nothing
        start, row, value = np.empty(size + 1, dtype=np.int32), np.empty(most, dtype=np.int32), np.empty(most)
        assembly.compress(table, known, np.ascontiguousarray(number.T), self.shape, reach, start, row, value)
        return csc_array((value[:start[-1]], row[:start[-1]], start), shape=(size, size))


def _solid(array: ndarray) -> ndarray:
    """The array in one piece of memory: else kernels would be compiled for both kinds."""
    return np.ascontiguousarray(array, dtype=float)


def _rows(base: ndarray) -> ndarray:
    """First nodes as kernels take them."""
    return np.ascontiguousarray(base, dtype=np.int64)


def _tables(functions: Functions, part: slice) -> Tables:
    """Tables as kernels take them."""
    return tuple(_solid(table) for table in functions.tables(part))
