"""Which basis maps, which recovers strain and which carries force: a method is data."""

from __future__ import annotations

from dataclasses import dataclass

from ..checks import check_choice
from .grid_bases import CMPMBasis, GIMPBasis
from .particle import ParticleBasis


@dataclass(frozen=True)
class Method:
    """A method is data: which basis maps mass and motion, which recovers strain, which carries internal force.

    Points move by the functions that map mass, unless ``motion`` names others (implicit steps only); walls then hold
    the body by these too.

    Examples
    --------
    >>> from skfem_mpm import METHODS
    >>> METHODS["cmpm"] == Method(mass=ParticleBasis, strain=CMPMBasis, force=ParticleBasis)
    True
    """

    mass: type[ParticleBasis]
    strain: type[ParticleBasis]
    force: type[ParticleBasis]
    motion: type[ParticleBasis] | None = None

    @property
    def conjugate(self) -> bool:
        """Whether force is carried by the functions that recover strain, which makes the operator symmetric."""
        return self.strain is self.force

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


def find_method(method: str | Method) -> Method:
    """A method by its name in ``METHODS``, or a method as it is."""
    if isinstance(method, Method):
        return method
    check_choice("method", method, METHODS)
    return METHODS[method]
