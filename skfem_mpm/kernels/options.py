"""How kernels are compiled."""

from __future__ import annotations

from typing import Any

CHUNKS = 8
TILE = 1024      # points handled at once: they stay in the cache
# Numba's disk cache looks at the file of a function only, not at those of the functions that it calls: after a change
# to a helper (all that is marked INLINE, SUMS or APART), delete kernels/__pycache__.
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
INLINE: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "forceinline": True}
SUMS: dict[str, Any] = INLINE | {"fastmath": {"contract", "reassoc", "nsz"}}   # sums may be taken in any fixed order
APART: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}   # loops best compiled on their own
