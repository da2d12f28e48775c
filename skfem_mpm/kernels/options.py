"""How kernels are compiled."""

from __future__ import annotations

CHUNKS = 8
TILE = 1024      # points handled at once: they stay in the cache
OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}}
INLINE = {"error_model": "numpy", "fastmath": {"contract"}, "forceinline": True}
