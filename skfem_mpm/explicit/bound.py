r"""The longest stable time step of a layout of points.

On a frozen layout, displacements of nodes move by :math:`\ddot u = -M^{-1} K u` with lumped masses.  The largest
eigenvalue is no larger than the spectral radius of the non-negative matrix :math:`B_{IJ} = \lVert K_{IJ} \rVert /
\sqrt{m_I m_J}`, hence than :math:`\max_I (B x)_I / x_I` for any positive :math:`x` (Collatz and Wielandt).  A few power
iterations make that tight.

``musl`` and ``usf`` take strain from velocities that were mapped to the points and back.  That makes the operator
:math:`M^{-1} C M^{-1} K` with the consistent mass :math:`C_{IJ} = \sum_p m_p N_I N_J`, and the bound that of the
product of two non-negative matrices.  It does not collapse when a point has just entered an empty cell, for a light far
node then has as little say in :math:`C` as it has mass.  The step is :math:`2 / \omega`.

``usl`` uses velocities straight from the nodes: with a node of which the points keep the share :math:`r` it is stable
to :math:`2 / (\omega \sqrt{2 - r})`, at worst :math:`\sqrt 2 / \omega`, and the step does collapse.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray
from scipy.sparse import dia_array

from ..grid import chunks
from .couplings import Couplings
from .nodes import Nodes
from .state import Choices, remaps

ITERATIONS = 10


def stable_step(nodes: Nodes, moduli: ndarray, volume: ndarray, mass: ndarray, remaps: bool, last: bool) -> float:
    """A time step that is stable for sure on a frozen layout.

    Parameters
    ----------
    moduli
        ``(m, m, n)`` or ``(m, m, 1)``; derivative of stress by the gradient, of the stiffest state.
    volume, mass
        ``(n,)``; of the points.
    remaps
        Whether strain comes from velocities that were mapped to the points and back.
    last
        Whether stress follows the velocities of the step's end without that.
    """
    stiffness = block_norms(nodes, moduli, volume)
    scale, unit = root_scale(nodes.mass, nodes.active)

    def over_nodes(x: ndarray, matrix: Callable[[ndarray], ndarray]) -> ndarray:
        full = nodes.spread((scale * x)[None], signed=False)[0]
        return scale / unit * nodes.gather(matrix(full)[None], signed=False)[0]

    def multiply(x: ndarray) -> ndarray:
        if remaps:
            value = nodes.mapping.value
            x = over_nodes(x, lambda full: value.T @ (mass * (value @ full)))
        return over_nodes(x, lambda full: stiffness @ full)

    return np.sqrt(2.0 if last else 4.0) / power_bound(multiply, nodes.active)


def root_scale(mass: ndarray, active: ndarray) -> tuple[ndarray, float]:
    """One over the roots of active masses, and the power of two, no less than the largest, that these are measured in.

    The root of an odd power of two rounds: with masses in units of their own size, those of the user change no bit.
    """
    unit = float(np.ldexp(1.0, np.frexp(mass.max())[1]))
    return np.divide(1.0, np.sqrt(mass / unit), out=np.zeros_like(mass), where=active), unit


def share_of_flip(choices: Choices) -> float:
    r"""How long a step is stable for sure, where points do not keep what the grid does not change.

    A wave of which the mapping to the points and back leaves the share :math:`c`, and the transfer the share :math:`F`,
    is stable up to :math:`\Delta t^2 \omega^2 = 2 (1 + F)`: with a share :math:`\alpha` of FLIP :math:`F` is at least
    :math:`\alpha`, with XPIC at least 0.  Where strain comes from the nodes themselves, filters only help.
    """
    if not remaps(choices.integrator, choices.tpic):
        return 1.0
    return float(np.sqrt((1 + (0.0 if choices.xpic else choices.flip)) / 2))


def chosen_step(stable: float, choices: Choices) -> float:
    """The step that a run takes, knowing the one that is stable with FLIP."""
    return float(choices.dt or min(choices.safety, share_of_flip(choices)) * stable)


def block_norms(nodes: Nodes, moduli: ndarray, volume: ndarray) -> dia_array:
    """Norms of the blocks of the stiffness, ``(nnodes, nnodes)``."""
    if moduli.shape[2] > 1 and (moduli == moduli[:, :, :1]).all():
        moduli = moduli[:, :, :1]
    pairs, terms, dim = Couplings(nodes.force, nodes.strain), nodes.force.terms, nodes.grid.dim
    ours, theirs = nodes.force.tables, nodes.strain.tables
    places = [(i * dim + k, q, j, r, l) for i, rows in enumerate(terms) for k, columns in enumerate(terms)
              for q, j in rows for r, l in columns]
    if moduli.shape[2] > 1:
        blocks = np.zeros((dim ** 2, pairs.size))
        for ik, q, j, r, l in places:
            blocks[ik] += pairs.sums(volume * moduli[q, r], [ours[j]], [theirs[l]])[0, 0]
        return pairs.matrix(np.sqrt((blocks ** 2).sum(axis=0)))
    factor, norms = np.zeros((dim ** 2, len(ours), len(theirs))), np.empty(pairs.size)
    for ik, q, j, r, l in places:
        factor[ik, j, l] += moduli[q, r, 0]
    sums = pairs.sums(volume, ours, theirs).reshape(-1, pairs.size)
    for part in chunks(pairs.size):
        norms[part] = np.sqrt(((factor.reshape(dim ** 2, -1) @ sums[:, part]) ** 2).sum(axis=0))
    return pairs.matrix(norms)


def power_bound(multiply: Callable[[ndarray], ndarray], active: ndarray) -> float:
    """Root of an upper bound of the spectral radius of a non-negative matrix, from its products with a vector.

    Parameters
    ----------
    multiply
        Product of the matrix with a vector; zero where not ``active``.
    active
        ``(n,)``; which rows and columns count.
    """
    x, best = active.astype(float), np.inf
    for _ in range(ITERATIONS):
        y = multiply(x)
        best = min(best, float((y[active] / x[active]).max()))
        x = np.where(active, np.maximum(y / y.max(), 1e-3), 0.0)   # stays positive, so each pass is a bound by itself
    return float(np.sqrt(best))
