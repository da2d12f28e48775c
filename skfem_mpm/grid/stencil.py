"""For each point the nodes it sees, with value and slope, and sums over them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

CHUNK = 8192    # points handled at once: what they need then stays in the cache, and cost per point does not grow


def chunks(n: int) -> Iterator[slice]:
    """Cut ``n`` points into pieces that fit the cache."""
    return (slice(start, min(start + CHUNK, n)) for start in range(0, n, CHUNK))


def scatter_add(out: ndarray, index: ndarray, values: ndarray) -> None:
    """Add ``values`` to ``out`` at ``index``, repeated entries included; touches only the range that occurs."""
    low = index.min()
    sums = np.bincount((index - low).ravel(), weights=values.ravel())
    out[low:low + len(sums)] += sums


@dataclass(frozen=True, eq=False)
class Stencil:
    """For each point the nodes it sees, with value and slope, as one factor per axis.

    Nodes are numbered along the axes of the grid, the last axis fastest.

    Attributes
    ----------
    base
        ``(dim, n)``; first node of each point along each axis.
    w
        ``(dim, 2, K, n)``; value (0) and slope (1) of its ``K`` nodes along each axis.  On rings ``(dim, 3, K, n)``:
        the first two are means weighted by the radius, the third (2) are plain means of the value.
    shape
        Number of nodes along each axis.
    """

    base: ndarray
    w: ndarray
    shape: tuple[int, ...]

    @property
    def n(self) -> int:
        """Number of points."""
        return self.base.shape[1]

    def nodes(self, part: slice = slice(None), out: ndarray | None = None) -> ndarray:
        """Nodes seen by the points, ``(K**dim, n)``; nodes off the grid have zero weight and repeat one on it."""
        base, dim, width = self.base[:, part], len(self.shape), self.w.shape[2]
        stride = np.cumprod((1, *self.shape[:0:-1]))[::-1]
        if self._inside:
            first = sum(base[k] * stride[k] for k in range(dim))
            return np.add(first, (stride @ np.indices((width,) * dim).reshape(dim, -1))[:, None], out=out,
                          dtype=None if out is None else out.dtype, casting="same_kind")
        index = np.zeros((1, base.shape[1]), dtype=np.int64)
        for k, size in enumerate(self.shape):
            along = np.clip(base[k] + np.arange(width)[:, None], 0, size - 1) * stride[k]
            index = (index[:, None] + along).reshape(-1, base.shape[1])
        if out is None:
            return index
        out[:] = index
        return out

    @cached_property
    def _inside(self) -> bool:
        """Whether all the nodes exist."""
        far = np.array(self.shape) - self.w.shape[2]
        return bool((self.base >= 0).all() and (self.base.max(axis=1, initial=0) <= far).all())

    @property
    def plain(self) -> int:
        """Which row of a factor holds plain means of the value: that of the value, but on rings."""
        return 2 if self.w.shape[1] == 3 else 0

    def value(self, part: slice = slice(None), plain: bool = False) -> ndarray:
        """Shape functions, ``(K**dim, n)``; on rings weighted by the radius, or ``plain`` means."""
        row = self.plain if plain else 0
        return outer([self.w[k, row, :, part] for k in range(len(self.shape))])

    def gradient(self, part: slice = slice(None)) -> ndarray:
        """Their gradients, ``(dim, K**dim, n)``."""
        dim = len(self.shape)
        return np.stack([outer([self.w[k, int(k == axis), :, part] for k in range(dim)]) for axis in range(dim)])

    def to_nodes(self, amount: ndarray) -> ndarray:
        """Share point amounts ``(n,)`` among the nodes by their functions, ``(nnodes,)``: lumped mass from mass."""
        out = np.zeros(int(np.prod(self.shape)))
        for part in chunks(self.n):
            scatter_add(out, self.nodes(part), self.value(part) * amount[part])
        return out

    def to_points(self, nodal: ndarray, plain: bool = False) -> ndarray:
        """Interpolate nodal vectors ``(dim, nnodes)`` to the points, ``(dim, n)``; on rings perhaps by ``plain`` means.

        Plain means move the middles of domains with a linear field as it moves their ends.
        """
        out = np.empty((len(nodal), self.n))
        for part in chunks(self.n):
            nodes, value = self.nodes(part), self.value(part, plain)
            for i, row in enumerate(nodal):
                out[i, part] = np.einsum("kn,kn->n", value, row[nodes])
        return out


def outer(factors: Sequence[ndarray], out: ndarray | None = None) -> ndarray:
    """Products of one factor ``(K, n)`` per axis, ``(K**dim, n)``, the last axis fastest."""
    *others, last = factors
    first = outer(others) if others else np.ones((1, 1))
    if out is not None:                 # a transposed table; a view of it by axes is no copy, as its points come first
        out = out.T.reshape(last.shape[1], len(first), len(last)).transpose(1, 2, 0)
    product = np.multiply(first[:, None], last, out=out)
    return product.reshape(-1, last.shape[1])
