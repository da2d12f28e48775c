"""The state of all material points, and how to make them: fill the cells of a mesh, or a meshio body."""

from .state import Particles

__all__ = ["Particles"]
