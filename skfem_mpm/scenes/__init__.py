"""The paper's problems as plain data, with their references."""

from .cylinder import Cylinder, cylinder

__all__ = ["Cylinder", "cylinder"]
