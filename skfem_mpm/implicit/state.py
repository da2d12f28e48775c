"""A snapshot of a run, and the choices it was made with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from numpy import ndarray

from ..basis import Method
from ..checks import check_own
from ..grid import Edges
from ..particles import Particles

Solver = Callable[[Any, ndarray], ndarray]
NO_STEP = "state: got one without a step behind it; take a state that implicit_steps has yielded."


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
    factor
        What a :class:`Control` scaled gravity by in the last step; 1 without one.
    control
        The control where its place is now; ``None`` without one.
    time
        Time passed in steps of dynamics.
    acceleration
        ``(dim, n)``; of the points, in steps of dynamics; ``None`` after a load step.
    engine
        What assembled it, ``numpy`` or ``numba``.
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
    factor: float = 1.0
    control: Any = None
    time: float = 0.0
    acceleration: ndarray | None = None
    engine: str = "numpy"
    _recovery: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.acceleration is not None:
            check_own("acceleration", self.acceleration, self.particles.n)
        for array in (self.displacement, *self.reactions.values(), self.acceleration):
            if array is not None:
                array.flags.writeable = False
        object.__setattr__(self, "reactions", MappingProxyType(dict(self.reactions)))

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled.
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self), tuple({**values, "reactions": dict(self.reactions)}.values())

    @property
    def energy(self) -> dict[str, float]:
        """Energy of the points, ``kinetic`` and ``elastic``; the latter is not a number if the law has no energy.

        In axial symmetry per radian.

        Raises
        ------
        ValueError
            If there is no step behind the state, and so no law.
        """
        if self._recovery is None:
            raise ValueError(NO_STEP)
        points, law = self.particles, self._recovery.material
        kinetic = 0.0 if points.velocity is None else float((points.mass * points.velocity ** 2).sum() / 2)
        if not hasattr(law, "energy_density"):
            return {"kinetic": kinetic, "elastic": float("nan")}
        density = law.energy_density(points.sigma, points.epsilon, points.kinematics.components)
        return {"kinetic": kinetic, "elastic": float(density @ points.volume)}

    def recover(self, x: ndarray, length: ndarray | None = None) -> ndarray:
        """Stress increment of the last step at any positions in the body, ``(ncomp, n)``.

        Recovered as the method recovers strain at its points, from the grid as it was at the start of the step, and
        answered by the material without stress and history; after the first step from zero stress this is the stress.
        Twins of field integration know no strain between the points, and refuse.

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
            raise ValueError(NO_STEP)
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
    ghost: float
    tolerance: float
    solver: Solver | None
    domains: str = "fixed"
    radius: str = "point"
    dt: float = 0.0                         # without inertia
    numerical_damping: float = 0.0
    engine: str = "numpy"
    remedy: str = "none"
    yields: str = "stop"                    # what to do with stress beyond yield
    lenient: bool = False                   # whether the best of an iteration that does not converge will do
