"""What is watched in a load step: what points answer, and whether their stress is within yield."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy import ndarray

from ..checks import NotConvergedError, whereabouts
from ..kinematics import YIELD, beyond_yield, words_of_yield


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
    point = int(np.flatnonzero(~(excess <= YIELD))[0])
    trouble, cause = words_of_yield(material, excess[point])
    text = f"{whereabouts(x, point)} {trouble}.  {cause}"
    if what == "stop":
        raise NotConvergedError(text)
    warnings.warn(f"step {step}: {text}", UserWarning, stacklevel=2)
