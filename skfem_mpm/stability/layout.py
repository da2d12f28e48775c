r"""The operators of an explicit step on a layout of points that does not move, over the unknowns of the grid.

A step needs three things of the points: the grid's velocity :math:`v = M^{-1} N^T m\, v_p` of what they carry, the
nodal force :math:`f = L V \sigma`, and with TPIC the velocity that their slopes hand on.  What it does to these is
linear where the body is at rest and free of stress, and needs no more of the points than

.. math:: C = N^T m N, \qquad K = L\, V D\, G, \qquad
          H = \textstyle\sum_l (x_I - x)_l N^T \frac{m}{\kappa_l} N (x_I - x)_l , \quad
          \kappa_l = \sum_I N_I (x_I - x)_l^2 ,

each between the velocities of the active nodes; light and mirrored nodes follow as in the step.  All are scaled by
:math:`M^{-1/2}` from both sides, with the lumped masses :math:`M`.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.sparse import block_array, csr_array, diags_array, eye_array, kron, vstack

from ..explicit.bound import chosen_step, stable_step
from ..explicit.dilation import CellMeans
from ..explicit.nodes import Nodes
from ..explicit.operators import Operators
from ..explicit.run import Run
from ..explicit.state import remaps

SYMMETRIC = 1e-10   # share of the largest entry by which a symmetric stiffness may miss


class Layout:
    """A layout of points as an explicit step sees it.

    Parameters
    ----------
    run
        An explicit run, before a step.

    Attributes
    ----------
    dim
        Components of a velocity; unknowns are numbered node by node.
    free
        Mask of the unknowns that are not held by a plane.
    choices
        Those of the run.
    nodes
        The grid of the step.
    moduli, volume
        Stiffness of the law at rest, ``(m, m, n)`` or ``(m, m, 1)``, and what stress is multiplied with, ``(n,)``.
    mass
        ``(n,)``; of the points.
    """

    def __init__(self, run: Run):
        self.nodes, self.choices, self.mass = run._nodes(), run.choices, run.mass
        nodes, self.dim = self.nodes, run.dim
        self.moduli = run.moduli_at_rest()
        if run.material.kirchhoff:           # what is linear in strain is Cauchy stress times the volume ratio
            self.moduli = self.moduli * np.exp(-run.epsilon[:3].sum(axis=0))
        self.volume = nodes.integrated(run.volume)
        held = nodes.fixed[:, nodes.active].T.ravel()
        self.free = ~held
        scale = diags_array(np.where(held, 0.0, np.repeat(nodes.mass[nodes.active] ** -0.5, self.dim)))
        self._spread = csr_array(spreading(nodes) @ scale)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.free.sum())

    def _stable_step(self, remapped: bool, last: bool) -> float:
        return float(stable_step(self.nodes, self.moduli, self.volume, self.mass, remapped, last))

    @cached_property
    def usual_step(self) -> float:
        """The step that a run takes for stable."""
        integrator, tpic = self.choices.integrator, self.choices.tpic
        return self._stable_step(remaps(integrator, tpic), integrator == "usl")

    @property
    def first_step(self) -> float:
        """The step that a run takes at its start."""
        return chosen_step(self.usual_step, self.choices)

    @property
    def fastest(self) -> float:
        """A bound of the frequencies that the layout has where velocities are mapped to the points and back."""
        usual = remaps(self.choices.integrator, self.choices.tpic)
        return 2 / (self.usual_step if usual else self._stable_step(True, False))

    @cached_property
    def half(self) -> csr_array:
        r""":math:`m^{1/2} N M^{-1/2}`, a root of the inertia; with ``tpic`` and ``flip=0`` one of :math:`C + H`."""
        value = self._weighted(self.mass, self.nodes.mapping.value)
        return csr_array(vstack([value, self.tilt])) if self.choices.tpic and not self.choices.flip else value

    @cached_property
    def tilt(self) -> csr_array:
        r"""A root of :math:`M^{-1/2} H M^{-1/2}`, ``(dim * dim * n, unknowns)``."""
        moments, slopes = self.mass * self.nodes.moments(), self.nodes.fitted.slopes
        return csr_array(vstack([self._weighted(*each) for each in zip(moments, slopes)]))

    def _weighted(self, weights: ndarray, operator: csr_array) -> csr_array:
        """An operator on each component, times the roots of weights of the points, from scaled unknowns."""
        value = kron(operator, eye_array(self.dim)) @ self._spread
        return csr_array(diags_array(np.repeat(np.sqrt(weights), self.dim)) @ value)

    @property
    def inertia(self) -> csr_array:
        r""":math:`M^{-1/2} C M^{-1/2}`; its eigenvalues are shares, from 0 to 1."""
        return csr_array(self.half.T @ self.half)

    @cached_property
    def stiffness(self) -> csr_array:
        r""":math:`M^{-1/2} K M^{-1/2}`."""
        strain, force = (gradients(each) @ self._spread for each in (self.nodes.strain, self.nodes.force))
        rows, n = range(len(self.moduli)), len(self.volume)
        moduli = block_array([[diags_array(np.broadcast_to(self.moduli[q, r], n)) for r in rows] for q in rows])
        if self.choices.remedy == "bbar":
            mean = averaging(CellMeans(self.nodes.grid, self.nodes.mapping, self.volume), len(rows))
            moduli = mean @ moduli @ mean
        return csr_array(force.T @ diags_array(np.tile(self.volume, len(rows))) @ moduli @ strain)

    @cached_property
    def symmetric(self) -> bool:
        """Whether the stiffness is symmetric: nothing then flutters."""
        return bool(abs(self.stiffness - self.stiffness.T).max() <= SYMMETRIC * abs(self.stiffness).max())

    @property
    def slope(self) -> csr_array:
        r""":math:`M^{-1/2} H M^{-1/2}`: velocity that points' slopes hand on to the nodes they were taken from."""
        return csr_array(self.tilt.T @ self.tilt)


def spreading(nodes: Nodes) -> csr_array:
    """Velocities wherever points may read from those of active nodes, component fastest: what ``Nodes.spread`` does."""
    dim, size = nodes.grid.dim, nodes.grid.nnodes
    gathered, parts = _replaced(eye_array(size).tocsr(), nodes.light, nodes.share), []
    for i in range(dim):
        matrix = gathered
        for inside, outside, signs in nodes.mirrors[::-1]:
            matrix = _replaced(matrix, outside, float(signs[i, 0]) * matrix[inside])
        unit = csr_array(([1.0], ([i], [i])), shape=(dim, dim))
        parts.append(kron(matrix[:, np.flatnonzero(nodes.active)], unit))
    return csr_array(sum(parts))


def _replaced(matrix: csr_array, rows: ndarray, others: csr_array) -> csr_array:
    """A matrix with some of its rows replaced."""
    kept, place = np.ones(matrix.shape[0]), np.arange(len(rows))
    kept[rows] = 0
    into = csr_array((np.ones(len(rows)), (rows, place)), shape=(matrix.shape[0], len(rows)))
    return csr_array(diags_array(kept) @ matrix + into @ others)


def gradients(operators: Operators) -> csr_array:
    """Gradient rows at the points, one row after the other, from nodal velocities, component fastest."""
    rows: dict[int, csr_array] = {}
    for i, terms in enumerate(operators.terms):
        unit = csr_array(([1.0], ([0], [i])), shape=(1, operators.dim))
        rows |= {q: kron(operators.matrices[l], unit) for q, l in terms}
    return csr_array(vstack([rows[q] for q in range(len(rows))]))


def averaging(means: CellMeans, nrows: int) -> csr_array:
    """What :meth:`CellMeans.smooth` does to gradient rows, as a matrix."""
    n, direct = len(means.volume), means.rows
    share = np.divide(1.0, means.held, out=np.zeros_like(means.held), where=means.held > 0)
    lack = means.shares @ diags_array(share) @ means.shares.T @ diags_array(means.volume) - eye_array(n)
    both = np.zeros((nrows, nrows))
    both[np.ix_(direct, direct)] = 1 / len(direct)
    return csr_array(eye_array(nrows * n) + kron(csr_array(both), lack))
