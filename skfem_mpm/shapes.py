r"""The three 1-D shape functions, value and slope, vectorised over points.

Grids of two and three dimensions multiply them.

``x (n,)`` are coordinates along one axis.  ``knots (4, n)`` are the nodes around each point: the ends of its host cell
are ``knots[1]`` and ``knots[2]``, the far ends of the neighbour cells ``knots[0]`` and ``knots[3]``.  Masks ``left``
and ``right`` say whether a neighbour is available; knots of missing ones may be anything but coinciding.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy import ndarray

Mask = ndarray | bool


def linear(x: ndarray, knots: ndarray) -> tuple[ndarray, ndarray]:
    """Linear finite element functions of the host cell's two nodes.

    Returns
    -------
    value, slope
        ``(2, n)`` each.

    Examples
    --------
    >>> value, slope = linear(np.array([0.25]), np.array([[-1.0], [0.0], [1.0], [2.0]]))
    >>> value[:, 0].tolist(), slope[:, 0].tolist()
    ([0.75, 0.25], [-1.0, 1.0])
    """
    width = knots[2] - knots[1]
    t = (x - knots[1]) / width
    return np.stack([1 - t, t]), np.stack([-1 / width, 1 / width])


def gimp(x: ndarray, half: ndarray, knots: ndarray, left: Mask = True, right: Mask = True) -> tuple[ndarray, ndarray]:
    r"""GIMP: the mean of the linear functions over the domain :math:`[x-l, x+l]`, with ``half`` :math:`= l`.

    For cells of equal width :math:`h` and :math:`l = h/4` this is Eq. (6) of Gonzalez Acosta et al. (2017), whose
    second and third branch are meant for :math:`|\xi|`:

    .. math:: S = (7-16\xi^2)/8,\quad 1-|\xi|,\quad (5-4|\xi|)^2/16 \qquad
              (|\xi| \le 1/4,\ \le 3/4,\ \le 5/4)

    Here it is integrated cell by cell, where the functions are straight and the mean is the value at the middle of the
    piece; so it holds for any :math:`l` that stays within the neighbours, on graded grids, and sums to one by
    construction.  A piece in a missing neighbour is cut off and the rest counts in full.

    Returns
    -------
    value, slope
        ``(4, n)`` each, for the nodes at the four knots.

    Examples
    --------
    >>> value, slope = gimp(np.array([0.0]), np.array([0.25]), np.array([[-1.0], [0.0], [1.0], [2.0]]))
    >>> value[:, 0].tolist()
    [0.0625, 0.875, 0.0625, 0.0]
    """
    share, second = cell_shares(x, half, knots, left, right)
    return _joined(share, second, knots[1:] - knots[:-1])


def ring_gimp(x: ndarray, half: ndarray, knots: ndarray, left: Mask = True,
              right: Mask = True) -> tuple[ndarray, ndarray, ndarray]:
    r"""GIMP along a radius: means over a ring, where :math:`r` is part of the integral.

    .. math:: S = \frac{\int N r\,dr}{\int r\,dr},\quad S' = \frac{\int N' r\,dr}{\int r\,dr},\quad
              \bar S = \frac{\int N\,dr}{\int dr}

    The hoop strain needs the mean of :math:`N/r` over the ring: that is :math:`\bar S` over the middle radius.

    Returns
    -------
    value, slope, plain
        ``(4, n)`` each: :math:`S`, :math:`S'`, :math:`\bar S`.

    Examples
    --------
    >>> knots = np.array([[0.0], [1.0], [2.0], [3.0]])
    >>> value, slope, plain = ring_gimp(np.array([1.5]), np.array([0.5]), knots)
    >>> (18 * value[:, 0]).round(12).tolist(), plain[:, 0].tolist()
    ([0.0, 8.0, 10.0, 0.0], [0.0, 0.5, 0.5, 0.0])
    """
    width = knots[1:] - knots[:-1]
    value, slope = _joined(*ring_cell_shares(x, half, knots, left, right), width)
    return value, slope, _joined(*cell_shares(x, half, knots, left, right), width)[0]


def cell_shares(x: ndarray, half: ndarray, knots: ndarray, left: Mask = True,
                right: Mask = True) -> tuple[ndarray, ndarray]:
    r"""What GIMP is made of, cell by cell: :math:`\frac1{V_p} \int_{\Omega_p \cap \Omega_e} N\,dx` in three cells.

    Returns
    -------
    share
        ``(3, n)``; both nodes of the left neighbour, the host and the right one together; sums to one.
    second
        ``(3, n)``; the second node of each cell alone.
    """
    share, middle = pieces(x, half, knots, left, right)
    return share, share * middle


def ring_cell_shares(x: ndarray, half: ndarray, knots: ndarray, left: Mask = True,
                     right: Mask = True) -> tuple[ndarray, ndarray]:
    """The same along a radius, which is then part of the integrals."""
    width = knots[1:] - knots[:-1]
    length, middle = _cut(x, half, knots, left, right)
    share = length / length.sum(axis=0)
    radius = knots[:-1] + middle * width
    whole = (share * radius).sum(axis=0)
    weight = share * radius / whole
    # In a piece the function and the radius are straight: their product is that in the middle, and a term of moment.
    return weight, weight * middle + share * length ** 2 / (12 * width * whole)


def _joined(share: ndarray, second: ndarray, width: ndarray) -> tuple[ndarray, ndarray]:
    """Value and slope at the four knots, from the share of each piece and the part of it that its second node takes."""
    tilt, first = share / width, share - second
    value = np.stack([first[0], second[0] + first[1], second[1] + first[2], second[2]])
    return value, np.stack([-tilt[0], tilt[0] - tilt[1], tilt[1] - tilt[2], tilt[2]])


def pieces(x: ndarray, half: ndarray, knots: ndarray, left: Mask = True, right: Mask = True) -> tuple[ndarray, ndarray]:
    """Cut domains at the cell faces: the share of each that lies in the left neighbour, the host and the right one.

    Returns
    -------
    share
        ``(3, n)``; sums to one.
    middle
        ``(3, n)``; middle of each piece in local coordinates of its cell, from 0 to 1.
    """
    length, middle = _cut(x, half, knots, left, right)
    return length / length.sum(axis=0), middle


def _cut(x: ndarray, half: ndarray, knots: ndarray, left: Mask, right: Mask) -> tuple[ndarray, ndarray]:
    """Lengths of the three pieces, and their middles in local coordinates."""
    width = knots[1:] - knots[:-1]
    start, end = (x - knots[1]) - half, (x - knots[1]) + half        # measured from the host's first node
    length = np.stack([np.maximum(-start, 0) * left,
                       np.minimum(end, width[1]) - np.maximum(start, 0),
                       np.maximum(end - width[1], 0) * right])
    middle = np.stack([1 + np.minimum(start, 0) / (2 * width[0]),
                       (np.minimum(end, width[1]) + np.maximum(start, 0)) / (2 * width[1]),
                       np.maximum(end - width[1], 0) / (2 * width[2])])
    return length, middle


def cmpm(x: ndarray, knots: ndarray, left: Mask = True, right: Mask = True) -> tuple[ndarray, ndarray]:
    r"""CMPM: Lagrange polynomials through the host's nodes and one node of each available neighbour.

    Cubic with both neighbours, Eq. (8) of Gonzalez Acosta et al. (2017) where cells are equal; quadratic with one,
    Eq. (7) and its mirror image; linear when alone.  They are built in physical coordinates: on graded grids the
    printed local forms would not reproduce even linear fields.

    Returns
    -------
    value, slope
        ``(4, n)`` each, for the nodes at the four knots; zero for missing ones.

    Examples
    --------
    >>> value, slope = cmpm(np.array([0.5]), np.array([[-1.0], [0.0], [1.0], [2.0]]))
    >>> (16 * value[:, 0]).tolist()
    [-1.0, 9.0, 9.0, -1.0]
    """
    here = np.ones(len(x), dtype=bool)
    there = [here & left, here, here, here & right]
    scale = knots[2] - knots[1]
    t = (x - knots[1]) / scale                                # in host widths, so products neither over- nor underflow
    nodes = (knots - knots[1]) / scale
    inverse, distance = {}, t - nodes
    for j, m in itertools.combinations(range(4), 2):
        apart = 1 / (nodes[j] - nodes[m])
        inverse[j, m], inverse[m, j] = there[m] * apart, there[j] * -apart
    value, slope = np.empty((2, 4, len(x)))
    for j in range(4):
        product, derivative = there[j].astype(float), np.zeros(len(x))
        for m in range(4):
            if m != j:
                factor = distance[m] * inverse[j, m] + ~there[m]      # 1 for a missing node
                derivative = derivative * factor + product * inverse[j, m]  # the product rule, one factor at a time
                product = product * factor
        value[j], slope[j] = product, derivative / scale
    return value, slope
