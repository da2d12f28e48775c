"""How kernels are compiled."""

from __future__ import annotations

CHUNKS = 8
OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}}
INLINE = {"error_model": "numpy", "fastmath": {"contract"}, "forceinline": True}
