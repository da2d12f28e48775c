"""How kernels are compiled."""

from __future__ import annotations

from typing import Any

CHUNKS = 8
TILE = 1024      # points handled at once: they stay in the cache
OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}}
INLINE: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "forceinline": True}
