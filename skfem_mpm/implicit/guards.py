"""What is watched in a load step: what points answer, and whether their stress is within yield."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy import ndarray

from ..checks import NotConvergedError
from ..kinematics import beyond_yield

YIELD = 1e-6         # stress beyond yield as a share of strength: a return mapping that has converged is far below


def respond(motion: Any, gradient: ndarray, x: ndarray) -> tuple[Any, str]:
    """What points at ``x`` answer to a displacement gradient; and what is wrong with it, naming the first such point.

    Returns
    -------
    response, trouble
        The response is ``None`` where there is trouble.
    """
    stretch = motion.stretch(gradient)
    wrong = ~((stretch > 0) & (stretch < np.inf))
    if wrong.any():
        point = int(np.flatnonzero(wrong)[0])
        return None, (f"{whereabouts(x, point)} turned inside out: its volume ratio is {stretch[point]:.3g}, expected "
                      "more than zero")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):     # what is not finite is told below
        response = motion.respond(gradient)
    for name in ("history", "sigma", "epsilon"):
        array = getattr(response, name)
        wrong = ~np.isfinite(array).all(axis=0) if array is not None else wrong
        if wrong.any():
            point = int(np.flatnonzero(wrong)[0])
            return None, (f"{whereabouts(x, point)} has a {name} that is not finite: {array[:, point]}, which its law "
                          "has returned")
    return response, ""


def check_yield(material: Any, response: Any, x: ndarray, step: int, what: str) -> None:
    """Stop where the return mapping has left a stress beyond yield, or warn.

    Raises
    ------
    NotConvergedError
        If a stress is beyond yield and this is to ``stop`` the run.
    """
    excess = beyond_yield(material, response.sigma, response.epsilon, response.history) if what != "off" else None
    if excess is None or (excess <= YIELD).all():
        return
    point, name = int(np.flatnonzero(~(excess <= YIELD))[0]), type(material).__name__
    text = (f"{whereabouts(x, point)} has a stress that is beyond yield by {excess[point]:.3g} of the strength, "
            f"expected at most {YIELD:g}; the return mapping of {name}.update has not converged, or {name}.excess is "
            "wrong")
    if what == "stop":
        raise NotConvergedError(f"{text}.")
    warnings.warn(f"step {step}: {text}.", UserWarning, stacklevel=2)


def whereabouts(x: ndarray, point: int) -> str:
    """A point and its position."""
    return f"point {point} at ({', '.join(f'{value:g}' for value in x[:, point])})"
