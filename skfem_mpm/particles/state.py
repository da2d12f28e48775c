"""The state of all material points, as a frozen snapshot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray
from skfem import Mesh

from ..checks import check_array, check_positive
from ..kinematics import Kinematics
from ..kinematics.blocks import determinant
from .bodies import mesh_of
from .fill import points_of_cells
from .inputs import ARRAYS, check_chosen, check_fields, check_history, check_kinematics, check_positions, frozen

if TYPE_CHECKING:
    import meshio

OPTIONAL = ("length", "spans", "sigma", "epsilon", "velocity", "history")


@dataclass(frozen=True, eq=False, repr=False)
class Particles:
    """All material points of a body, as a frozen snapshot.

    Components come first, points last, in any consistent units.  Every array is read-only: a writable array is copied,
    a read-only one is shared, so nobody can change a snapshot afterwards and ``dataclasses.replace`` copies only what
    is new.  To hand over a fresh array without a copy, set its ``flags.writeable`` to ``False`` first.

    Parameters
    ----------
    x
        Positions ``(dim, n)``; ``x[0]`` is the radius in axial symmetry.
    volume
        Length, area or volume ``(n,)``; in axial symmetry the ring volume per radian.
    mass
        Mass ``(n,)``, of the same measure as ``volume``.
    kinematics
        One of ``uniaxial``, ``plane_strain``, ``axisymmetric``, ``solid``.
    length
        Edges ``(dim, n)`` of the points' domains, which GIMP needs: boxes along the axes.
    spans
        Edges ``(dim, dim, n)`` of the points' domains as parallelograms, ``spans[i, j]`` being component i of edge j;
        field integration needs them, and starts from ``length`` if there are none.
    sigma
        Packed Cauchy stress ``(ncomp, n)``, tension positive; ``None`` is a body free of stress.
    epsilon
        Packed elastic logarithmic strain ``(ncomp, n)``; finite strain only.
    velocity
        ``(dim, n)``; explicit runs only, at rest if there is none.
    history
        What the law remembers, ``(k, n)``, a row for each name in ``law.history``; laws with a history only.
    fields
        The user's own fields by name, ``(..., n)``; forms see them as ``w.name``.

    Raises
    ------
    TypeError
        If an array does not hold floats, or ``kinematics`` or ``fields`` is of the wrong type.
    ValueError
        If a shape is wrong, there are no points, a number is not finite, a volume, mass, length or (in axial symmetry)
        radius is not above zero, or an own field takes a name that means something else.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from skfem import MeshQuad
    >>> from skfem_mpm import plane_strain
    >>> from skfem_mpm.particles import Particles
    >>> body = Particles.fill(MeshQuad().refined(1), plane_strain, density=2000.0)
    >>> body
    <skfem_mpm Particles(plane strain) object>
      Number of points: 16
      Dimension: 2
      Arrays: x, volume, mass, length
    >>> replace(body, x=body.x + 0.5).x.min().item()
    0.625
    """

    x: ndarray
    volume: ndarray
    mass: ndarray
    kinematics: Kinematics
    length: ndarray | None = None
    spans: ndarray | None = None
    sigma: ndarray | None = None
    epsilon: ndarray | None = None
    velocity: ndarray | None = None
    history: ndarray | None = None
    fields: Mapping[str, ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_kinematics(self.kinematics)
        held = {"x": check_positions(self.x, self.kinematics)}
        dim, n = held["x"].shape
        ncomp = self.kinematics.ncomp
        shapes = {"volume": (n,), "mass": (n,), "length": (dim, n), "spans": (dim, dim, n), "sigma": (ncomp, n),
                  "epsilon": (ncomp, n), "velocity": (dim, n)}
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None or name not in OPTIONAL:
                held[name] = check_array(name, value, shape)
        if self.history is not None:
            held["history"] = check_history(self.history, n)
        for name in ("volume", "mass", "length"):
            for row in np.atleast_2d(held.get(name, 1.0)):
                check_positive(name, row)
        if "spans" in held:
            check_positive("spans (their determinant)", determinant(held["spans"]))
        for name, array in held.items():
            object.__setattr__(self, name, frozen(array))
        object.__setattr__(self, "fields", MappingProxyType(check_fields(self.fields, n)))

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled, and unpickled arrays are writable unless they go through __post_init__.
        return type(self), (self.x, self.volume, self.mass, self.kinematics,
                            self.length, self.spans, self.sigma, self.epsilon, self.velocity, self.history,
                            dict(self.fields))

    def __len__(self) -> int:
        return self.n

    def __repr__(self) -> str:
        held = [name for name in ARRAYS if getattr(self, name) is not None]
        return (f"<skfem_mpm {type(self).__name__}({self.kinematics.name}) object>\n"
                f"  Number of points: {self.n}\n"
                f"  Dimension: {self.dim}\n"
                f"  Arrays: {', '.join(held)}"
                + (f"\n  Own fields: {', '.join(self.fields)}" if self.fields else ""))

    @property
    def n(self) -> int:
        """Number of points."""
        return self.x.shape[1]

    @property
    def dim(self) -> int:
        """Dimension of the space that the points move in."""
        return self.x.shape[0]

    @property
    def stress(self) -> ndarray:
        """Cauchy stress ``(3, 3, n)``, unpacked from ``sigma``; zeros if there is none."""
        return self._tensor(self.sigma)

    @property
    def strain(self) -> ndarray:
        """Elastic logarithmic strain ``(3, 3, n)``, unpacked from ``epsilon``; zeros if there is none."""
        return self._tensor(self.epsilon)

    def _tensor(self, packed: ndarray | None) -> ndarray:
        return np.zeros((3, 3, self.n)) if packed is None else self.kinematics.tensor(packed)

    def arrays(self) -> dict[str, ndarray]:
        """Every array that the points hold, by name; own fields last.

        >>> import numpy as np
        >>> from skfem_mpm import uniaxial
        >>> from skfem_mpm.particles import Particles
        >>> list(Particles(np.array([[0.5]]), np.array([1.0]), np.array([2.0]), uniaxial).arrays())
        ['x', 'volume', 'mass']
        """
        held = {name: getattr(self, name) for name in ARRAYS}
        return {name: array for name, array in held.items() if array is not None} | dict(self.fields)

    def where(self, which: ndarray) -> Particles:
        """Some of the points, with all that they hold: without those that have left the mesh, say.

        Parameters
        ----------
        which
            A mask ``(n,)`` of bools, or point numbers, each at most once; their order is kept.

        Returns
        -------
        Particles
            Only these points.

        Raises
        ------
        TypeError
            If ``which`` holds neither bools nor integers.
        ValueError
            If ``which`` has the wrong shape, names a point twice or one that is not there, or leaves no points.

        Examples
        --------
        >>> from skfem import MeshLine
        >>> from skfem_mpm import uniaxial
        >>> from skfem_mpm.particles import Particles
        >>> bar = Particles.fill(MeshLine(), uniaxial)
        >>> bar.where(bar.x[0] > 0.5).x.tolist()
        [[0.75]]
        """
        chosen = check_chosen(which, self.n)
        picked: dict[str, Any] = {name: array[..., chosen] for name, array in self.arrays().items()}
        own = {name: picked.pop(name) for name in self.fields}
        return replace(self, fields=own, **picked)

    @classmethod
    def fill(cls, mesh: Mesh, kinematics: Kinematics, density: float | ndarray = 1.0, per_cell: int = 2,
             rule: str = "quarter", where: Callable[[ndarray], ndarray] | None = None) -> Particles:
        """Points in the cells of a mesh, cell by cell, in the order of the mesh.

        With ``rule="quarter"`` each cell is cut into ``per_cell**dim`` equal parts and a point put into the middle of
        each (two per direction: at 1/4 and 3/4); its volume is the exact integral over its part.  With ``"gauss"`` the
        points are those of Gauss quadrature, on triangles and tetrahedra of scikit-fem's first rule with positive
        weights that is exact to order ``2*per_cell - 1``.  Either way the volumes add up to the body's.

        Parameters
        ----------
        mesh
            Lines, triangles, quads, tetrahedra or hexes, first order.
        kinematics
            How the body may move; in axial symmetry volumes are ring volumes per radian.
        density
            Mass per volume, one number or one per point ``(n,)``.
        per_cell
            Points per direction in a cell.
        rule
            ``"quarter"`` or ``"gauss"``.
        where
            Keeps the points at which ``where(x)``, ``x`` of shape ``(dim, n)``, is true.  Points are kept or left out
            whole: the body's edge is then that of the points' parts.

        Returns
        -------
        Particles
            With ``length``: in boxes along the axes the cell's edges over ``per_cell``, in other cells the edge of the
            cube of the point's area or volume.  Quads and hexes that are not all such boxes have ``spans`` too: the
            columns of the Jacobian at the points, scaled to the points' areas.

        Raises
        ------
        TypeError
            If ``mesh`` is not a scikit-fem mesh, ``per_cell`` is not an integer, or ``where`` is not a function.
        ValueError
            If the mesh is of higher order, does not fit the kinematics, has a folded cell or, in axial symmetry, one
            across the axis; if ``where`` leaves no points; if ``density``, ``per_cell`` or ``rule`` is out of range.

        Examples
        --------
        >>> from skfem import MeshQuad
        >>> from skfem_mpm import axisymmetric
        >>> from skfem_mpm.particles import Particles
        >>> ring = Particles.fill(MeshQuad().translated((1.0, 0.0)), axisymmetric, where=lambda x: x[0] < 1.5)
        >>> ring.x.tolist(), ring.volume.sum().item()      # (1.5**2 - 1) / 2 per radian
        ([[1.25, 1.25], [0.25, 0.75]], 0.625)
        """
        return cls(kinematics=kinematics, **points_of_cells(mesh, kinematics, density, per_cell, rule, where))

    @classmethod
    def from_meshio(cls, body: meshio.Mesh | str | PathLike, kinematics: Kinematics, density: float | ndarray = 1.0,
                    per_cell: int = 1, rule: str = "quarter",
                    where: Callable[[ndarray], ndarray] | None = None) -> Particles:
        """Points in the cells of a meshio body; see :meth:`fill`.

        Parameters
        ----------
        body
            A ``meshio.Mesh``, or the path of a file that meshio reads.  Its cells of the highest dimension, all of one
            kind, are filled; boundary cells and unused points are passed over.
        kinematics, density, per_cell, rule, where
            As in :meth:`fill`.

        Returns
        -------
        Particles
            As from :meth:`fill`.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        TypeError
            If ``body`` is neither a ``meshio.Mesh`` nor a path; and as in :meth:`fill`.
        ValueError
            If meshio cannot read the file, if it has no usable cells or several kinds of them, or if a plane or line
            body is bent into the coordinates that would be dropped; and as in :meth:`fill`.

        Examples
        --------
        >>> import meshio
        >>> from skfem_mpm import plane_strain
        >>> from skfem_mpm.particles import Particles
        >>> body = meshio.Mesh([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], [("triangle", [[0, 1, 2]])])
        >>> body = Particles.from_meshio(body, plane_strain)
        >>> body.x.round(12).tolist(), body.volume.round(12).tolist()
        ([[1.0], [1.0]], [4.5])
        """
        return cls.fill(mesh_of(body), kinematics, density, per_cell, rule, where)
