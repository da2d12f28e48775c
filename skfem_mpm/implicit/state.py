"""A snapshot of a run, and the choices it was made with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from numpy import ndarray

from ..basis import Method
from ..grid import Edges
from ..particles import Particles

Solver = Callable[[Any, ndarray], ndarray]


@dataclass(frozen=True, eq=False)
class State:
    """A snapshot: everything a run needs to go on, and what the last step found.

    Attributes
    ----------
    step
        Load steps done.
    particles
        The points.
    boundary
        Walls and planes where they are now.
    displacement
        ``(dim, nvertices)``; nodal displacement of the last step (of its last part if it was cut), on the mesh.
    reactions
        Force of each named wall and plane on the body, ``(dim,)``; per radian in axial symmetry.  The incremental
        scheme knows what each step adds, and reports the sum.
    residuals
        Relative residual after each Newton pass of the last step; empty for the incremental scheme.
    cuts
        How often the step had to be cut in two.
    scheme
        How the step was made.
    gravity
        Body force per mass that acts now.
    """

    step: int
    particles: Particles
    boundary: tuple[Any, ...]
    displacement: ndarray
    reactions: Mapping[str, ndarray]
    residuals: tuple[float, ...] = ()
    cuts: int = 0
    scheme: str = ""
    gravity: Any = None
    _recovery: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for array in (self.displacement, *self.reactions.values()):
            array.flags.writeable = False
        object.__setattr__(self, "reactions", MappingProxyType(dict(self.reactions)))

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled.
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self), tuple({**values, "reactions": dict(self.reactions)}.values())

    def recover(self, x: ndarray, length: ndarray | None = None) -> ndarray:
        """Stress increment of the last step at any positions in the body, ``(ncomp, n)``.

        Recovered as the method recovers strain at its points, from the grid as it was at the start of the step; after
        the first step from zero stress this is the stress.

        Parameters
        ----------
        x
            ``(dim, n)``; positions at the start of the step, in cells that held points then.
        length
            ``(dim, n)``; domains, for methods that recover strain with GIMP.

        Raises
        ------
        ValueError
            If there is no step to recover from, or a position is not in the body.
        """
        if self._recovery is None:
            raise ValueError("state: got one without a step behind it; take a state that implicit_steps has yielded.")
        return self._recovery(x, length)


@dataclass(frozen=True)
class Options:
    """The choices of a run, checked."""

    method: Method
    strain: str
    scheme: str
    weights: str
    integration: Any
    edges: Edges
    tangent: str
    floor: float
    tolerance: float
    solver: Solver
    domains: str = "fixed"
    radius: str = "point"
