"""Which engine runs: decided once, at the start, from what there is to do and never from a clock."""

from __future__ import annotations

from typing import Any

from skfem import Mesh

from ..basis import CMPMBasis, GIMPBasis, ParticleBasis
from ..checks import choose_engine
from .run import Run
from .state import Choices, ExplicitState

# Points from which numba pays, by dimension and number of nodes per axis of the widest stencil: below, a run of some
# hundred steps takes less time than numba takes to load.
WORTHWHILE = {(1, 2): 2000, (1, 4): 2000, (2, 2): 300, (2, 4): 200, (3, 2): 100, (3, 4): 50}
COMPILED = {ParticleBasis, GIMPBasis, CMPMBasis}


def make_run(engine: str, threads: int, mesh: Mesh, start: ExplicitState, material: Any,
             choices: Choices) -> Run:
    """The run of the chosen engine.

    Raises
    ------
    ImportError
        If ``engine`` is ``numba`` and numba is not installed.
    ValueError
        If ``engine`` is ``numba`` and the method has a basis of the user's own.
    """
    method = choices.method
    known = {method.mass, method.strain, method.force} <= COMPILED
    if engine == "numba" and not known:
        raise ValueError("engine: got 'numba' with a basis of your own, which has no compiled stencil; use "
                         "engine='numpy'.")
    if choose_engine(engine, known and _pays(start, choices), caller=5) == "numpy":
        return Run(mesh, start, material, choices)
    from .compiled import CompiledRun  # numba is slow to import
    return CompiledRun(mesh, start, material, choices, threads)


def _pays(start: ExplicitState, choices: Choices) -> bool:
    """Whether numba pays; a run that goes on keeps its engine."""
    if start.step:
        return start.engine == "numba"
    particles, method = start.particles, choices.method
    narrow = {method.mass, method.strain, method.force} == {ParticleBasis} and not choices.integration.covers
    width = 2 if narrow else 4
    return particles.n >= WORTHWHILE[particles.dim, width]
