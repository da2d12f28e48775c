"""Error against cost, and many runs of the same kind."""

from .ensemble import ensemble, generator

__all__ = ["ensemble", "generator"]
