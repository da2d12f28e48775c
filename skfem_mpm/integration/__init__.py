"""How point stress becomes nodal force: one exchangeable choice, apart from method and weights.

A choice makes the :class:`Pair` of operators of a step from what is known of its grid.
"""

from __future__ import annotations

from typing import Any

from ..basis import CubicBasis
from ..checks import check_choice
from .double import DoubleMapping, MappedModuli
from .field import Field, Twin
from .pair import OfStencil, OfTable, Pair, on_points
from .points import Integration, Points

__all__ = [
    "INTEGRATIONS", "DoubleMapping", "Field", "Integration", "MappedModuli", "OfStencil", "OfTable", "Pair", "Points",
    "Twin", "find_integration", "on_points",
]

INTEGRATIONS = {
    "points": Points(),
    "field": Field(), "field2": Field(order=2), "cubic": Field(order=2, reach=2, recover=CubicBasis),
    "twin": Twin(), "twin2": Twin(order=2, kappa=1.5), "dual": Twin(kappa=None),
    "dm": DoubleMapping(), "dm-g": DoubleMapping("gimp"),
    "dm-stress": DoubleMapping(stress=True), "dm-g-stress": DoubleMapping("gimp", stress=True),
}


def find_integration(integration: Any) -> Any:
    """A choice by its name in ``INTEGRATIONS``, or an object that is one."""
    if hasattr(integration, "pair"):
        return integration
    check_choice("integration", integration, INTEGRATIONS)
    return INTEGRATIONS[integration]
