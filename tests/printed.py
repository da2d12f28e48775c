r"""Shape functions as Gonzalez Acosta et al. (2017) print them, to check ours against; nothing here uses the package.

Eq. (6) counts :math:`\xi` in cells from the node.  Eqs. (7) and (8) have :math:`\xi \in [-1, 1]` in the cell, its
neighbours' far nodes at -3 and 3.  The formulas take complex numbers too, so a slope is an exact complex step.
"""

import numpy as np


def eq6(xi):
    """GIMP, two points per cell; the second and third branch are meant for the absolute value (a misprint, mended)."""
    return eq6_as_printed(abs(xi))


def eq6_as_printed(xi):
    """GIMP as printed: the cases ask for the absolute value of xi, the second and third branch do not take it."""
    return np.select([abs(xi) <= 0.25, abs(xi) <= 0.75, abs(xi) <= 1.25],
                     [(7 - 16 * xi**2) / 8, 1 - xi, (5 - 4 * xi) ** 2 / 16], 0.0)


def gimp(xi, l):
    """GIMP for domains of any half length l <= 1/2 on equal cells; Eq. (6) is l = 1/4."""
    r = abs(xi)
    return np.select([r < l, r <= 1 - l, r <= 1 + l],
                     [1 - (xi**2 + l**2) / (2 * l), 1 - r, (1 + l - r) ** 2 / (4 * l)], 0.0)


def gimp_slope(xi, l):
    """Derivative of :func:`gimp` by xi."""
    r, sign = abs(xi), np.sign(xi)
    return np.select([r < l, r <= 1 - l, r <= 1 + l], [-xi / l, -sign, -sign * (1 + l - r) / (2 * l)], 0.0)


def eq7(xi):
    """CMPM, no neighbour on the left: nodes at -1, 1, 3."""
    return np.stack([(xi - 1) * (xi - 3) / 8, -(xi + 1) * (xi - 3) / 4, (xi + 1) * (xi - 1) / 8])


def eq7_mirrored(xi):
    """CMPM, no neighbour on the right: nodes at -3, -1, 1.  (Not printed: Eq. (7) seen in a mirror.)"""
    return eq7(-xi)[::-1]


def eq8(xi):
    """CMPM with both neighbours: nodes at -3, -1, 1, 3."""
    return np.stack([-(xi**3 - 3 * xi**2 - xi + 3) / 3, xi**3 - xi**2 - 9 * xi + 9,
                     -(xi**3 + xi**2 - 9 * xi - 9), (xi**3 + 3 * xi**2 - xi - 3) / 3]) / 16


def slope(equation, xi):
    """Derivative of a polynomial by xi, exact to round-off."""
    step = 1e-30
    return equation(xi + 1j * step).imag / step
