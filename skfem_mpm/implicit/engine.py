"""Which engine assembles: decided once, at the start, from what there is to do and never from a clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..basis import Method, ParticleBasis
from ..checks import ENGINES, check_choice, choose_engine
from ..integration import MappedModuli, Pair
from .state import State

# Points from which numba pays, by dimension and nodes per axis of the widest stencil: below, a run of some tens of
# steps spends less time on assembly than numba takes to load.
WORTHWHILE = {(1, 2): 200_000, (1, 4): 100_000, (2, 2): 10_000, (2, 4): 2000, (3, 2): 1000, (3, 4): 200}


def engine_of(engine: str, start: State, method: Method) -> str:
    """The engine of a run; one that goes on keeps its engine.

    Raises
    ------
    ImportError
        If ``engine`` is ``numba`` and numba is not installed.
    """
    check_choice("engine", engine, ENGINES)
    width = 2 if {method.mass, method.strain, method.force} == {ParticleBasis} else 4
    many = start.particles.n >= WORTHWHILE[start.particles.dim, width]
    return choose_engine(engine, start.engine == "numba" if start.step else many)


def made_for(engine: str, pair: Any) -> Any:
    """Operators as the engine has them; those that are no plain :class:`Pair` stay as they are."""
    if isinstance(pair, MappedModuli):
        return replace(pair, pair=made_for(engine, pair.pair))
    if engine == "numpy" or type(pair) is not Pair:
        return pair
    from ..integration.compiled import CompiledPair  # numba is slow to import
    return CompiledPair(pair)
