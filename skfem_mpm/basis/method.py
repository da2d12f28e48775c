"""Which basis maps, which recovers strain and which carries force: a method is data."""

from __future__ import annotations

from dataclasses import dataclass

from .grid_bases import CMPMBasis, GIMPBasis
from .particle import ParticleBasis


@dataclass(frozen=True)
class Method:
    """A method is data: which basis maps mass and motion, which recovers strain, which carries internal force.

    Examples
    --------
    >>> from skfem_mpm import METHODS
    >>> METHODS["cmpm"] == Method(mass=ParticleBasis, strain=CMPMBasis, force=ParticleBasis)
    True
    """

    mass: type[ParticleBasis]
    strain: type[ParticleBasis]
    force: type[ParticleBasis]

    def __post_init__(self) -> None:
        if self.mass is CMPMBasis:
            raise ValueError("mass: got CMPMBasis, whose functions take negative values; map mass with ParticleBasis "
                             "or GIMPBasis.")


METHODS = {
    "mpm": Method(ParticleBasis, ParticleBasis, ParticleBasis),
    "gimp": Method(GIMPBasis, GIMPBasis, GIMPBasis),
    "cmpm": Method(ParticleBasis, CMPMBasis, ParticleBasis),
    "fe-gimp": Method(ParticleBasis, GIMPBasis, ParticleBasis),
    "gc": Method(GIMPBasis, CMPMBasis, GIMPBasis),
    "cmpm-c": Method(ParticleBasis, CMPMBasis, CMPMBasis),
}
