"""How far a set-up is from the edge: stable steps, growth of waves, and diagnostics of points and grid."""

from ..scenes.roughness import roughness
from .diagnosis import Diagnosis, diagnose
from .edge import Growth, StepLimit, critical_step, growth
from .ledger import Crossings, Ledger, crossings, ledger

__all__ = ["Crossings", "Diagnosis", "Growth", "Ledger", "StepLimit", "critical_step", "crossings", "diagnose",
           "growth", "ledger", "roughness"]
