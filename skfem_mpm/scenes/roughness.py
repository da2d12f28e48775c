"""How rough a field of the points is."""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from ..checks import check_array, check_counts
from ..particles import Particles


def roughness(points: Particles, values: ndarray, neighbours: int = 16) -> float:
    """What is left of a field of the points, as rms, after taking off its plane around each point.

    The plane is that of least squares through the nearest points; a linear field has none of it, a checkerboard is
    left as it is.

    Parameters
    ----------
    points
        The points.
    values
        ``(n,)``; one number per point, a stress component say.
    neighbours
        How many of the nearest points the plane goes through, the point itself included; all if there are fewer.

    Raises
    ------
    TypeError, ValueError
        If the numbers are not one per point, or the neighbours no whole number above zero.

    Examples
    --------
    >>> from skfem import MeshQuad
    >>> from skfem_mpm import plane_strain
    >>> from skfem_mpm.stability import roughness
    >>> points = Particles.fill(MeshQuad().refined(3), plane_strain)
    >>> print(roughness(points, 3 * points.x[0] - points.x[1]) < 1e-12)
    True
    """
    from scipy.spatial import cKDTree  # slow to import
    x, values = points.x, check_array("values", values, (points.n,))
    check_counts({"neighbours": (neighbours, 1)})
    distance, near = cKDTree(x.T).query(x.T, k=list(range(1, min(int(neighbours), points.n) + 1)))
    offset = (x[:, near] - x[:, :, None]) / np.maximum(distance.max(axis=1), np.finfo(float).tiny)[:, None]
    basis = [np.ones(near.shape), *offset]
    normal = np.array([[(a * b).sum(axis=1) for b in basis] for a in basis]).transpose(2, 0, 1)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)            # points may lie on a line
    plane = sum(inverse[:, 0, i] * (a * values[near]).sum(axis=1) for i, a in enumerate(basis))
    return float(np.sqrt(((values - plane) ** 2).mean()))
