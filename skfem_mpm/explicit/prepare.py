"""From the arguments of an explicit run to the run: what does not fit is refused here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from skfem import Mesh

from ..basis import Method, find_method
from ..checks import ENGINES, NUMBER, check_array, check_choice, check_counts, check_guards, check_spans
from ..grid import EDGES, Edges
from ..integration import Points, Twin, find_integration
from ..kinematics import DOMAINS, RADII, RATES
from ..particles import Particles
from .engine import make_run
from .run import Run
from .state import GUARDS, LEDGER, Choices, ExplicitState, remaps
from .twin import conjugate

INTEGRATORS = ("musl", "usl", "usf", "usavg")
REMEDIES = ("none", "bbar")
LEAVING = ("error", "remove")


def prepare(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: Sequence[Any] | None, *,
            method: str | Method, strain: str, integrator: str, edges: Edges, domains: str | None, radius: str,
            integration: Any, flip: float, xpic: int, tpic: bool, remedy: str, damping: float, gravity: Any,
            ramp: float, dt: float | None, safety: float, refresh: int | None, leaving: str, engine: str,
            threads: int, guards: Any) -> Run:
    """A run that has not begun; arguments and what is raised are those of :func:`skfem_mpm.explicit_steps`."""
    method, integration = _integration(find_method(method), integration)
    domains = domains or ("stretched" if integration.covers else "fixed")
    for name, value, names in [("strain", strain, RATES), ("integrator", integrator, INTEGRATORS),
                               ("edges", edges, EDGES), ("domains", domains, DOMAINS), ("radius", radius, RADII),
                               ("remedy", remedy, REMEDIES), ("leaving", leaving, LEAVING),
                               ("engine", engine, ENGINES)]:
        check_choice(name, value, names)
    refresh = refresh if refresh is not None else 50 if remaps(integrator, tpic) else 1
    check_counts({"refresh": (refresh, 1), "xpic": (xpic, 0), "threads": (threads, 1)})
    _check_shares({"flip": flip, "damping": damping, "safety": safety})
    check_spans({"dt": dt})
    if not isinstance(tpic, (bool, np.bool_)):
        raise TypeError(f"tpic: got {tpic!r}, expected True or False.")
    if not isinstance(start, (Particles, ExplicitState)):
        raise TypeError(f"start: got a {type(start).__name__}, expected Particles or a state of an explicit run; of an "
                        "implicit state give its particles.")
    if not isinstance(boundary, (list, tuple, type(None))):
        raise TypeError(f"boundary: got a {type(boundary).__name__}, expected a list of fixed planes.")
    if remedy == "bbar" and edges == "truncate":
        raise ValueError("remedy: got 'bbar' with edges='truncate', where nodes are missing that say how much of a "
                         "domain is in which cell; use edges='ghost' or 'clip'.")
    load = _load(gravity, ramp, start.particles.dim if isinstance(start, ExplicitState) else start.dim)
    choices = Choices(method, strain, integrator, edges, flip, xpic, bool(tpic), damping, load, dt, safety,
                      int(refresh), remedy, leaving, domains, radius, integration, check_guards(guards, GUARDS))
    return make_run(engine, int(threads), mesh, _start(start, boundary, int(refresh)), material, choices)


def _integration(method: Method, integration: Any) -> tuple[Method, Any]:
    """How stress becomes force, and the method whose bases a step then reads."""
    found = find_integration(integration)
    if type(found) not in (Points, Twin):
        raise ValueError(f"integration: got {integration!r}, which is for implicit steps; expected 'points', 'twin', "
                         "'twin2', 'dual' or a Twin, whose strain is conjugate to their forces.")
    if method.motion is not None:
        raise ValueError(f"method: got one that moves points by {method.motion.__name__}, which is for implicit steps; "
                         "expected motion=None, the functions that map mass.")
    return (conjugate(method) if found.covers else method), found


def _check_shares(shares: dict[str, Any]) -> None:
    """Refuse shares beyond 0 and 1; one of the stable step must be above 0."""
    for name, number in shares.items():
        above = ", above 0" * (name == "safety")
        if not (isinstance(number, NUMBER) and 0 <= number <= 1 and (number > 0 or not above)):
            raise ValueError(f"{name}: got {number!r}, expected a share from 0 to 1{above}.")


def _load(gravity: Any, ramp: float, dim: int) -> Callable[[float], Any]:
    """Body force per mass over time."""
    if not (isinstance(ramp, NUMBER) and np.isfinite(ramp) and ramp >= 0):
        raise ValueError(f"ramp: got {ramp!r}, expected a time of zero or more.")
    if gravity is None:
        return lambda time: None
    try:
        numbers = np.asarray(gravity, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"gravity: got {gravity!r}, expected {dim} number(s), the body force per mass.") from None
    full = check_array("gravity", numbers, (dim,))
    if not ramp:
        return lambda time: full
    return lambda time: full * min(time / ramp, 1.0)


def _start(start: Particles | ExplicitState, boundary: Sequence[Any] | None, refresh: int) -> ExplicitState:
    """The state to start from; its time step is found at once."""
    if isinstance(start, Particles):
        return ExplicitState(0, 0.0, 0.0, -refresh, start, tuple(boundary or ()), dict.fromkeys(LEDGER, 0.0))
    return start if boundary is None else replace(start, boundary=tuple(boundary))
