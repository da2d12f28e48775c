"""Problems as plain data, with their references: the paper's two, and ones with exact solutions."""

from .bar import Bar, bar
from .cantilever import Cantilever, cantilever
from .cylinder import Cylinder, cylinder
from .ring import Ring, ring
from .self_weight import SelfWeight, block, column
from .vertical_cut import VerticalCut, vertical_cut

__all__ = ["Bar", "Cantilever", "Cylinder", "Ring", "SelfWeight", "VerticalCut", "bar", "block", "cantilever", "column",
           "cylinder", "ring", "vertical_cut"]
