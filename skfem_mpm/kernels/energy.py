"""What guards look at: energy of a linear elastic body about a mean velocity, and how many points are beyond yield."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..materials import ROUNDING
from .options import OPTIONS

U = np.uint64


@njit(**OPTIONS)
def inner(mass, velocity, mean, sigma, volume, lam, shear):
    """Elastic energy and motion about a mean velocity ``(dim,)``; all stress is elastic strain, at small strain."""
    total, share = 0.0, lam / (3 * lam + 2 * shear)
    for q in range(len(mass)):
        p, speed = U(q), 0.0
        for k in range(len(velocity)):
            own = velocity[k, p] - mean[k]
            speed += own * own
        if len(sigma) == 1:
            density = sigma[0, p] * sigma[0, p] / (lam + 2 * shear)
        else:
            trace, square = 0.0, 0.0
            for k in range(3):
                trace += sigma[k, p]
                square += sigma[k, p] * sigma[k, p]
            for k in range(3, len(sigma)):
                square += 2 * sigma[k, p] * sigma[k, p]
            density = (square - share * trace * trace) / (2 * shear)
        total += (mass[p] * speed + volume[p] * density) / 2
    return total


@njit(**OPTIONS)
def beyond_yield(sigma, eps_p, constants, tolerance):
    """How many points are beyond the yield surface of von Mises, or not known to be within."""
    _, shear, peak, residual, softening = constants
    count = 0
    for q in range(len(eps_p[0])):
        p = U(q)
        trace = sigma[0, p] + sigma[1, p] + sigma[2, p]
        square = 0.0
        for k in range(3):
            deviator = sigma[k, p] - trace / 3
            square += deviator * deviator
        for k in range(3, len(sigma)):
            square += 2 * sigma[k, p] * sigma[k, p]
        cohesion = max(residual, peak + softening * eps_p[0, p])
        cohesion += tolerance * (cohesion + ROUNDING * shear)
        count += not square / 2 <= cohesion * cohesion
    return count
