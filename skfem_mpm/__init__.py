"""Material points for scikit-fem: MPM, GIMP and CMPM on fixed background grids."""

from .kinematics import axisymmetric, plane_strain, solid, uniaxial

__all__ = ["axisymmetric", "plane_strain", "solid", "uniaxial"]
