"""Points as a scikit-fem basis: each point is an element with one quadrature point.

All that is taken from scikit-fem's inside (which attributes a form reads of a basis, and what it compares before it
assembles) stands in two modules of this folder, ``particle`` and ``points``; the others build on these.
"""

from .grid_bases import CMPMBasis, CubicBasis, GIMPBasis
from .method import METHODS, Method, find_method
from .particle import ParticleBasis

__all__ = ["METHODS", "CMPMBasis", "CubicBasis", "GIMPBasis", "Method", "ParticleBasis", "find_method"]
