"""Material points for scikit-fem: MPM, GIMP and CMPM on fixed background grids."""

from .basis import METHODS, CMPMBasis, CubicBasis, GIMPBasis, Method, ParticleBasis
from .checks import NotConvergedError, OutsideGridError, UnstableError
from .elements import (
    ElementHexCMPM,
    ElementHexGIMP,
    ElementLineCMPM,
    ElementLineGIMP,
    ElementQuadCMPM,
    ElementQuadGIMP,
    patch_dofs,
)
from .explicit import explicit_steps
from .implicit import Control, implicit_steps
from .kinematics import axisymmetric, plane_strain, solid, uniaxial
from .materials import Hencky, LinearElastic, VonMises
from .particles import Particles

__all__ = [
    "CMPMBasis", "Control", "CubicBasis", "ElementHexCMPM", "ElementHexGIMP", "ElementLineCMPM", "ElementLineGIMP",
    "ElementQuadCMPM", "ElementQuadGIMP", "GIMPBasis", "Hencky", "LinearElastic", "METHODS", "Method",
    "NotConvergedError", "OutsideGridError", "ParticleBasis", "Particles", "UnstableError", "VonMises", "axisymmetric",
    "explicit_steps", "implicit_steps", "patch_dofs", "plane_strain", "solid", "uniaxial",
]
