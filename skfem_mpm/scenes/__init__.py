"""The paper's problems as plain data, with their references."""

from .cylinder import Cylinder, cylinder
from .vertical_cut import VerticalCut, vertical_cut

__all__ = ["Cylinder", "VerticalCut", "cylinder", "vertical_cut"]
