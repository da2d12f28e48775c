"""How a body may move: what is packed, which gradient rows there are, what strain is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from skfem.helpers import sym_grad

PLANE = ((0, 0), (1, 1), (2, 2), (0, 1))
SPACE = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class Kinematics:
    """How a body may move; use the four instances ``uniaxial``, ``plane_strain``, ``axisymmetric`` and ``solid``.

    Attributes
    ----------
    name
        What it is called in messages and files.
    dims
        Dimensions of the meshes it lives on; ``axisymmetric`` takes quads (r, z) and lines (r only).
    components
        Places ``(i, j)`` of the packed components; their number is ``ncomp``.

    Examples
    --------
    >>> from skfem_mpm import axisymmetric
    >>> axisymmetric.ncomp, axisymmetric.rows(2)
    (4, ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2)))
    """

    name: str
    dims: tuple[int, ...]
    components: tuple[tuple[int, int], ...]

    @property
    def ncomp(self) -> int:
        """Number of packed components."""
        return len(self.components)

    @property
    def hoop(self) -> bool:
        """Whether there is a hoop strain, and volumes are ring volumes per radian."""
        return self.name == "axisymmetric"

    def check_dim(self, dim: int) -> None:
        """Refuse a mesh of a dimension that this kinematics does not live on."""
        if dim not in self.dims:
            raise ValueError(
                f"kinematics: got {self.name} in {dim} dimension(s), expected {' or '.join(map(str, self.dims))}; "
                "uniaxial is for lines, plane_strain for quads, axisymmetric for lines and quads, solid for hexes.")

    def rows(self, dim: int) -> tuple[tuple[int, int], ...]:
        """Places of the gradient rows on a mesh of dimension ``dim``, the hoop row last."""
        self.check_dim(dim)
        return tuple((i, j) for i in range(dim) for j in range(dim)) + (((2, 2),) if self.hoop else ())

    def packed_index(self, place: tuple[int, int]) -> int:
        """Which packed component stands at ``place`` (of the symmetric tensor)."""
        return self.components.index((min(place), max(place)))

    def tensor(self, packed: ndarray) -> ndarray:
        """The ``(3, 3, ...)`` view of packed components ``(ncomp, ...)``.

        >>> from skfem_mpm import uniaxial
        >>> import numpy as np
        >>> uniaxial.tensor(np.array([[5.0]]))[:, :, 0].tolist()
        [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
        """
        full = np.zeros((3, 3) + packed.shape[1:])
        for value, (i, j) in zip(packed, self.components):
            full[i, j] = full[j, i] = value
        return full

    def strain(self, u: Any, w: Any) -> ndarray:
        """Small strain of the field ``u`` in a form, ``(3, 3, ...)``; ``w.x[0]`` is the radius in axial symmetry.

        ``ddot(w.stress, kinematics.strain(v, w))`` is the internal virtual work in every kinematics.
        """
        if np.shape(u.grad)[0] != np.shape(u.grad)[1] or np.ndim(u.grad) != 4:
            raise ValueError(f"u: got a field with a gradient of shape {np.shape(u.grad)}, expected a vector field; "
                             "use ElementVector(...).")
        small = sym_grad(u)
        dim = small.shape[0]
        full = np.zeros((3, 3) + small.shape[2:])
        full[:dim, :dim] = small
        if self.hoop:
            full[2, 2] = np.asarray(u)[0] / np.asarray(w.x)[0]
        return full


uniaxial = Kinematics("uniaxial", (1,), ((0, 0),))
plane_strain = Kinematics("plane strain", (2,), PLANE)
axisymmetric = Kinematics("axisymmetric", (1, 2), PLANE)
solid = Kinematics("solid", (3,), SPACE)
