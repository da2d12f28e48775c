"""How far a state is from an exact one, point by point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray

from ..particles import Particles


def point_errors(particles: Particles, x: ndarray, stress: ndarray, inner: ndarray, size: float) -> dict[str, float]:
    """Root mean square errors over points.

    Parameters
    ----------
    particles
        The points of a state.
    x, stress
        ``(dim, n)`` and ``(3, 3, n)``; where they should be, and the Cauchy stress they should carry.
    inner
        ``(n,)``; which of them are far from the surfaces of the body.
    size
        Size of the body, by which errors of position are measured.

    Returns
    -------
    dict
        ``all`` and ``inner``: Frobenius norm of the error of stress, relative to the largest exact one, over all and
        over inner points (not a number if there are none); ``position``: distance, relative to the size.

    Raises
    ------
    ValueError
        If the points carry no stress, or are not those of the scene.
    """
    if particles.sigma is None:
        raise ValueError("state: got one without stress; take a state that run() has yielded.")
    if particles.x.shape != x.shape:
        raise ValueError(f"state: got {particles.n} points, expected the {x.shape[1]} of this scene.")
    off = ((particles.stress - stress) ** 2).sum(axis=(0, 1)) / (stress ** 2).sum(axis=(0, 1)).max()
    away = ((particles.x - x) ** 2).sum(axis=0) / size ** 2
    return {"all": _rms(off), "inner": _rms(off[inner]), "position": _rms(away)}


def _rms(squares: ndarray) -> float:
    return float(np.sqrt(squares.mean())) if squares.size else np.nan


def normal_stress(value: ndarray, direction: Any) -> ndarray:
    """The stress tensor ``(3, 3, n)`` of normal stress ``value (n,)`` along unit vectors ``(dim, n)``."""
    direction = np.asarray(direction)
    full = np.zeros((3, 3, value.size))
    full[:len(direction), :len(direction)] = value * direction[:, None] * direction
    return full
