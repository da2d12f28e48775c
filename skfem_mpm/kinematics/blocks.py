"""Tensors of many points: blocks ``(d, d, n)``, packed stress and gradient rows."""

from __future__ import annotations

import numpy as np
from numpy import ndarray


def deformation(gradient: ndarray, dim: int) -> ndarray:
    """In-plane block of the deformation gradient over the step, ``(dim, dim, n)``."""
    return np.eye(dim)[:, :, None] + gradient[:dim * dim].reshape(dim, dim, -1)


def volume_ratio(gradient: ndarray, dim: int) -> ndarray:
    """Volume ratio; a negative sign marks any inverted stretch, even an inverted pair."""
    in_plane = in_plane_ratio(gradient, dim)
    if len(gradient) == dim * dim:
        return in_plane
    hoop = 1 + gradient[-1]
    return np.where(hoop > 0, hoop * in_plane, -np.abs(hoop * in_plane))


def in_plane_ratio(gradient: ndarray, dim: int) -> ndarray:
    """Volume ratio without the hoop part: determinant of the in-plane block of the deformation gradient."""
    if dim == 1:
        return 1 + gradient[0]
    if dim == 2:
        xx, xy, yx, yy = gradient[:4]
        return (1 + xx) * (1 + yy) - xy * yx
    xx, xy, xz, yx, yy, yz, zx, zy, zz = gradient
    return ((1 + xx) * ((1 + yy) * (1 + zz) - yz * zy) - xy * (yx * (1 + zz) - yz * zx)
            + xz * (yx * zy - (1 + yy) * zx))


def turned_in_plane(sigma: ndarray, gradient: ndarray) -> ndarray:
    """Packed stress turned in the plane, about z."""
    a = (gradient[1] - gradient[2]) / 4
    sine = 2 * a / (1 + a * a)
    cosine = 1 - a * sine
    difference, shear = sigma[0] - sigma[1], 2 * sigma[3]
    turned = sigma.copy()
    change = sine * (cosine * shear - sine * difference)
    turned[0] += change
    turned[1] -= change
    turned[3] -= sine * (cosine * difference + sine * shear)
    return turned


def turned_in_space(sigma: ndarray, gradient: ndarray) -> ndarray:
    """Packed stress turned in space."""
    index = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]])
    block = gradient.reshape(3, 3, -1)
    a = (block - block.transpose(1, 0, 2)) / 4
    turn = 2 / (1 + a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2) * (a + product(a, a))     # less the unit tensor
    half = sigma[index]
    half += product(turn, half)
    half += product(half, turn.transpose(1, 0, 2))
    return half[(0, 1, 2, 0, 1, 0), (0, 1, 2, 1, 2, 2)]


def determinant(a: ndarray) -> ndarray:
    """Determinant of each block ``(d, d, n)``, d up to 3, from products: numpy's own goes through a logarithm."""
    if len(a) == 1:
        return a[0, 0]
    if len(a) == 2:
        return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = a
    return xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)


def inverse(F: ndarray) -> ndarray:
    """Inverse of each block."""
    if len(F) == 1:
        return 1 / F
    if len(F) == 2:
        return np.array([[F[1, 1], -F[0, 1]], [-F[1, 0], F[0, 0]]]) / (F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0])
    return np.linalg.inv(F.transpose(2, 0, 1)).transpose(1, 2, 0)


def eigen(a: ndarray) -> tuple[ndarray, ndarray]:
    """Eigenvalues ``(d, n)`` and vectors ``(d, d, n)`` (second index: which) of symmetric blocks ``(d, d, n)``."""
    if len(a) == 1:
        return a[0], np.ones_like(a)
    if len(a) == 2:
        middle, half = (a[0, 0] + a[1, 1]) / 2, (a[0, 0] - a[1, 1]) / 2
        radius = np.hypot(half, a[0, 1])
        angle = np.arctan2(a[0, 1], half) / 2
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([middle + radius, middle - radius]), np.array([[c, -s], [s, c]])
    value, vector = np.linalg.eigh(a.transpose(2, 0, 1))
    return value.T, vector.transpose(1, 2, 0)


def compose(value: ndarray, vector: ndarray) -> ndarray:
    """Symmetric blocks with these eigenvalues and vectors."""
    return product(value * vector, vector.transpose(1, 0, 2))


def product(a: ndarray, b: ndarray) -> ndarray:
    """Matrix product of blocks ``(d, d, n)``."""
    return np.einsum("ijn,jkn->ikn", a, b)


def strain_rate(value: ndarray, vector: ndarray) -> ndarray:
    r"""Derivative of logarithmic strain by the velocity gradient, ``(d*d, d*d, n)``, from principal strains.

    In principal axes :math:`d\varepsilon_{aa} = dL_{aa}` and
    :math:`d\varepsilon_{ab} = \frac{\varepsilon_a-\varepsilon_b}{b_a-b_b} (b_b dL_{ab} + b_a dL_{ba})`.
    """
    d = len(value)

    def dyad(a: int, b: int) -> ndarray:
        return (vector[:, None, a] * vector[None, :, b]).reshape(d * d, -1)

    total = sum(dyad(a, a)[:, None] * dyad(a, a) for a in range(d))
    for a in range(d):
        for b in range(a + 1, d):
            x = 2 * (value[a] - value[b])
            near = np.abs(x) < 1e-12
            forward = np.where(near, 1.0, x / np.expm1(np.where(near, 1.0, x))) / 2
            backward = forward + x / 2
            total += (dyad(a, b) + dyad(b, a))[:, None] * (forward * dyad(a, b) + backward * dyad(b, a))
    return total


def pull_back(spatial: ndarray, inverse: ndarray, hoop: ndarray | None) -> ndarray:
    """Take both legs of a spatial tangent ``(m, m, n)`` back to the start of the step."""
    dim = len(inverse)
    for leg in range(2):
        turned = spatial.copy()
        for i in range(dim):
            for j in range(dim):
                turned[i * dim + j] = sum(inverse[j, p] * spatial[i * dim + p] for p in range(dim))
        if hoop is not None:
            turned[-1] = hoop * spatial[-1]
        spatial = turned.transpose(1, 0, 2)
    return spatial
