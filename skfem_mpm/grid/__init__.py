"""The axis-aligned view of a scikit-fem mesh: where points are, which cells they occupy, and the stencil table."""

from .gauss import PLACES, gauss_points, gauss_rule
from .grid import EDGES, Edges, Grid
from .masks import available_sides, cell_mask, corner_nodes, touched_cells, whole_cells, wider
from .stencil import Stencil, chunks, outer, scatter_add

__all__ = [
    "EDGES", "PLACES", "Edges", "Grid", "Stencil", "available_sides", "cell_mask", "chunks", "corner_nodes",
    "gauss_points", "gauss_rule", "outer", "scatter_add", "touched_cells", "whole_cells", "wider",
]
