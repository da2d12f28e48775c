"""1-D, plane strain, axisymmetric and 3-D motion: which strains there are, how they are stored, what a volume is.

A *gradient row* is one component of the displacement gradient that the kinematics keeps.  Its place is a pair
``(i, j)`` of the 3 x 3 tensor; ``(2, 2)`` in axial symmetry is the hoop stretch :math:`u_r / r`.  Stress and strain are
stored packed, ``(ncomp, n)``, shear as the tensor component.
"""

from .domains import DOMAINS, RADII, carried, stretched
from .laws import YIELD, beyond_yield, check_law, moduli_at_rest, words_of_yield
from .motion import Kinematics, axisymmetric, plane_strain, solid, uniaxial
from .strains import RATES, STRAINS, Logarithmic, Objective, Response, Small

__all__ = ["DOMAINS", "RADII", "RATES", "STRAINS", "YIELD", "Kinematics", "Logarithmic", "Objective", "Response",
           "Small", "axisymmetric", "beyond_yield", "carried", "check_law", "moduli_at_rest", "plane_strain", "solid",
           "stretched", "uniaxial", "words_of_yield"]
