r"""Eigenvalues of an explicit step on a frozen layout: which steps are stable, and how fast the others grow.

With :math:`V` the grid's velocity of what points carry, :math:`g = \Delta t\, M^{-1} f`, and the scaled operators of
:class:`Layout`, ``musl`` does

.. math:: V' = F V - C g, \qquad g' = g + \Delta t^2 K V', \qquad
          F = \alpha \big(1 - (1 - C)^m\big) + (1 - \alpha)\, C ,

where :math:`\alpha` is ``flip``, :math:`m` the order of XPIC, and :math:`F = \alpha + (1 - \alpha) C` without it.
``usf`` and ``usavg`` do the same from another start, and ``usl`` has :math:`g' = g + \Delta t^2 K (V - g)`.

With TPIC there is :math:`W' = H (V + W - g)` too, and strain sees :math:`V' + W'`.  Without FLIP their sum is all that
counts, and :math:`C + H`, a projection at each point, takes the place of :math:`C`: what follows holds for it, with
:math:`X \le 1/2`.  With FLIP, :math:`K (1 - H)^{-1} C` is left as the step vanishes, which is not symmetric unless
:math:`C` and :math:`H` commute: waves may then grow at any step.

Where :math:`K` is symmetric, eigenvalues leave the unit circle at -1 only, since :math:`C \le F \le 1`.  There

.. math:: \Delta t^2 = \frac{2}{\lambda_{\max}(K X)}, \qquad X = \frac{C}{1 + F} \quad\text{or with ``usl``}\quad
          X = 1 - \frac{C}{1 + F} .

With FLIP, all but ``usl`` are a leapfrog: eigenvalues solve :math:`z^2 - (2 - \Delta t^2 \mu) z + 1 = 0` with
:math:`\mu` of :math:`C K`.  Where these are complex, which takes an unsymmetric :math:`K`, waves grow at any step.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from .layout import Layout

ZERO = 1e-12        # squared frequencies below this share of a bound of theirs are rounding
SLOW = 1e-5         # so are rates of growth below this share of the highest frequency
GROWN = 1e-7        # so is growth below this in one step, where eigenvalues are double
SHORT = 0.02        # of a step beyond every limit: one that is short
TRIED = 32          # steps tried before bisection
HALVINGS = 30       # of the interval that these leave


class Spectrum:
    """Eigenvalues of the step of a layout.

    Parameters
    ----------
    layout
        The layout; its operators become dense.
    """

    def __init__(self, layout: Layout):
        choices, free = layout.choices, layout.free
        self.flip, self.order, self.last = choices.flip, choices.xpic, choices.integrator == "usl"
        self.half: ndarray = np.linalg.qr(layout.half[:, free].toarray(), mode="r")    # type: ignore[assignment]
        self.stiffness, self.slope = _dense(layout.stiffness, free), None
        if choices.tpic and choices.flip:
            self.slope = _dense(layout.slope, free)
        self.symmetric, self.rounding = layout.symmetric, ZERO * layout.fastest ** 2

    @property
    def leapfrog(self) -> bool:
        """Whether the step is a leapfrog: FLIP, and not ``usl``."""
        return self.flip == 1 and not (self.order or self.last or self.slope is not None)

    def _eigenvalues(self, root: ndarray) -> ndarray:
        """Eigenvalues of the stiffness times an operator, from its root."""
        found = (np.linalg.eigvalsh if self.symmetric else np.linalg.eigvals)(root @ self.stiffness @ root.T)
        return np.where(np.abs(found) > self.rounding, found, 0)

    # -- what the layout does by itself ------------------------------------------------------------------------------

    @cached_property
    def squares(self) -> ndarray:
        """Squared frequencies of the layout with FLIP, as the time step vanishes."""
        return self._eigenvalues(self.half)

    @cached_property
    def highest(self) -> float:
        """Size of the highest frequency; above zero."""
        return float(np.sqrt(np.abs(self.squares).max(initial=self.rounding)))

    @cached_property
    def flutter(self) -> float:
        """Largest rate of growth as the time step vanishes; 0 if it is rounding."""
        rate = np.abs(np.sqrt(self.squares.astype(complex)).imag).max(initial=0)
        return float(rate) if rate > SLOW * self.highest else 0.0

    @property
    def flutters(self) -> bool:
        """Whether waves grow at steps below the limit: because of the layout, of TPIC, or of both.

        Where the stiffness is not symmetric, what a transfer damps may make waves grow that did not by themselves.
        """
        if self.flutter > 0 or self.limit == 0:
            return True
        if self.leapfrog or not np.isfinite(self.limit) or (self.symmetric and self.slope is None):
            return False
        dt = self.limit * (0.5 if self.slope is None else SHORT)
        return self.rate(dt) > self.noise(dt)

    @cached_property
    def _modes(self) -> tuple[ndarray, ndarray]:
        """Eigenvalues of the inertia, shares that the points keep of a velocity, and its vectors in columns."""
        _, root, modes = np.linalg.svd(self.half)
        return np.append(root, np.zeros(len(modes) - len(root))) ** 2, modes.T

    @property
    def _kept(self) -> ndarray:
        """:math:`F` of the shares: what a step leaves of the velocities that points carry."""
        shares, _ = self._modes
        seen = 1 - (1 - shares) ** self.order if self.order else np.ones_like(shares)
        return self.flip * seen + (1 - self.flip) * shares

    # -- steps -------------------------------------------------------------------------------------------------------

    @cached_property
    def limit(self) -> float:
        """The largest stable step; where waves flutter, the one from which the step makes them grow too."""
        if self.slope is not None:
            return self._found_limit()
        if self.leapfrog:
            return _step(4, self.squares)
        shares, modes = self._modes
        operator = shares / (1 + self._kept)
        operator = 1 - operator if self.last else operator
        return _step(2, self._eigenvalues(np.sqrt(np.maximum(operator, 0))[:, None] * modes.T))

    def _found_limit(self) -> float:
        """By bisection: up to where waves grow at most twice as fast as they do anyway; 0 if there is no such step."""
        high = _step(8, np.linalg.eigvals(self.stiffness))
        if not np.isfinite(high):
            return high
        anyway = 2 * max(self.flutter, self.rate(SHORT * high))

        def stable(dt: float) -> bool:
            return not self.rate(dt) > anyway + self.noise(dt)

        tried = high * np.linspace(0, 1, TRIED + 1)[1:]
        first = next((place for place, dt in enumerate(tried) if not stable(dt)), TRIED - 1)
        low, high = (tried[first - 1] if first else 0.0), tried[first]
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if stable(middle) else (low, middle)
        return float(low) if low > high / 2 else 0.0

    def radius(self, dt: float) -> float:
        """Spectral radius of a step of this length."""
        if self.leapfrog:
            half = dt ** 2 * self.squares.astype(complex) / 2
            root = np.sqrt(half ** 2 - 2 * half)
            return float(np.abs([1 - half + root, 1 - half - root]).max(initial=1))
        return float(np.abs(np.linalg.eigvals(self.step(dt))).max(initial=1))

    def rate(self, dt: float) -> float:
        """Rate of growth with a step of this length."""
        return float(np.log(self.radius(dt)) / dt)

    def noise(self, dt: float) -> float:
        """Rate of growth that may be rounding, with a step of this length."""
        return SLOW * self.highest + GROWN / dt

    def step(self, dt: float) -> ndarray:
        """The step as a matrix of :math:`V` and :math:`g` (and :math:`W`)."""
        (_, modes), zero = self._modes, np.zeros_like(self.stiffness)
        c, k, one = self.half.T @ self.half, dt ** 2 * self.stiffness, np.eye(len(zero))
        kept, basis = (modes * self._kept) @ modes.T, self._forces
        h = zero if self.slope is None else self.slope
        moved = np.block([[kept, -c @ basis, (1 - self.flip) * c], [h, -h @ basis, h]])
        if self.last:
            seen = np.block([one, -basis, one])
        else:
            seen = moved[:len(c)] + moved[len(c):]
        forces = basis.T @ k @ seen
        forces[:, len(c):-len(c)] += np.eye(basis.shape[1])
        found = np.vstack([moved[:len(c)], forces, moved[len(c):]])
        return found if self.slope is not None else found[:-len(c), :-len(c)]

    @cached_property
    def _forces(self) -> ndarray:
        """Orthogonal forces that motions make, in columns; others would push the body on for ever."""
        vectors, size, _ = np.linalg.svd(self.stiffness)
        return vectors[:, size > ZERO * size.max(initial=0)]


def _dense(matrix: csr_array, free: ndarray) -> ndarray:
    return matrix[free][:, free].toarray()


def _step(factor: float, squares: ndarray) -> float:
    r""":math:`\sqrt{k / \lambda_{\max}}`, endless if nothing swings."""
    largest = np.abs(squares).max(initial=0)
    return float(np.sqrt(factor / largest)) if largest > 0 else np.inf
