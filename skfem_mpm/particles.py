"""The state of all material points, and how to make them: fill the cells of a mesh, or a meshio body."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from numbers import Integral
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray
from numpy.polynomial.legendre import leggauss
from skfem import ElementHex1, ElementLineP1, ElementQuad1, ElementTetP1, ElementTriP1, Mesh
from skfem.element import Element
from skfem.quadrature import get_quadrature

from .checks import check_array, check_choice, check_positive
from .kinematics import Kinematics

if TYPE_CHECKING:
    import meshio

TENSOR = (ElementLineP1, ElementQuad1, ElementHex1)
SIMPLEX = (ElementTriP1, ElementTetP1)
RULES = ("quarter", "gauss")
MESHIO_CELLS = ("line", "triangle", "quad", "tetra", "hexahedron")

ARRAYS = ("x", "volume", "mass", "length", "sigma", "epsilon")
OPTIONAL = ("length", "sigma", "epsilon")
# What scikit-fem puts into the ``w`` of a form, then what we hold or put there.
RESERVED = ("x", "h", "n", "idx") + ARRAYS + ("stress", "strain", "kinematics", "fields", "dim")

Rule = tuple[ndarray, list[tuple[ndarray, ndarray]]]


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
        Edges ``(dim, n)`` of the points' domains, which GIMP needs.
    sigma
        Packed Cauchy stress ``(ncomp, n)``, tension positive; ``None`` is a body free of stress.
    epsilon
        Packed elastic logarithmic strain ``(ncomp, n)``; finite strain only.
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
    sigma: ndarray | None = None
    epsilon: ndarray | None = None
    fields: Mapping[str, ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_kinematics(self.kinematics)
        held = {"x": _check_positions(self.x, self.kinematics)}
        dim, n = held["x"].shape
        ncomp = self.kinematics.ncomp
        shapes = {"volume": (n,), "mass": (n,), "length": (dim, n), "sigma": (ncomp, n), "epsilon": (ncomp, n)}
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None or name not in OPTIONAL:
                held[name] = check_array(name, value, shape)
        for name in ("volume", "mass", "length"):
            for row in np.atleast_2d(held.get(name, 1.0)):
                check_positive(name, row)
        for name, array in held.items():
            object.__setattr__(self, name, _frozen(array))
        object.__setattr__(self, "fields", MappingProxyType(_check_fields(self.fields, n)))

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled, and unpickled arrays are writable unless they go through __post_init__.
        return type(self), (self.x, self.volume, self.mass, self.kinematics,
                            self.length, self.sigma, self.epsilon, dict(self.fields))

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
        """Some of the points, with all that they hold.

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
        chosen = _check_chosen(which, self.n)
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
            cube of the point's area or volume.

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
        _check_mesh(mesh, kinematics)
        points, parts = _rule(mesh.elem, per_cell, rule)
        corners = mesh.p[:, mesh.t]
        x = _positions(mesh.elem, corners, points)
        keep = _keep(where, x)
        cells = np.flatnonzero(keep.any(axis=1))
        x, keep, corners = x[:, keep], keep[cells], corners[:, :, cells]
        area, volume = _measure(mesh.elem, corners, parts, kinematics.hoop, cells)
        length = _length(corners, area, per_cell)[:, keep]
        volume = volume[keep]
        return cls(x, volume, _density(density, len(volume)) * volume, kinematics, length)

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
        return cls.fill(_mesh_of(body), kinematics, density, per_cell, rule, where)


# Checks of one argument each.

def _check_kinematics(kinematics: Any) -> None:
    if not isinstance(kinematics, Kinematics):
        raise TypeError(f"kinematics: got {kinematics!r}, expected one of skfem_mpm's uniaxial, plane_strain, "
                        "axisymmetric, solid.")


def _check_positions(x: Any, kinematics: Kinematics) -> ndarray:
    shape = np.shape(x)
    if len(shape) != 2:
        raise ValueError(f"x: got shape {shape}, expected (dim, n); write x[None, :] for points on a line.")
    if shape[0] not in kinematics.dims and shape[1] in kinematics.dims:
        raise ValueError(f"x: got shape {shape}, expected (dim, n); transpose it: components come first, points last.")
    kinematics.check_dim(shape[0])
    if shape[1] == 0:
        raise ValueError(f"x: got no points, shape {shape}, expected at least one; look at what selected them.")
    x = check_array("x", x, shape)
    if kinematics.hoop:
        check_positive("x[0] (the radius)", x[0])
    return x


def _check_fields(fields: Any, n: int) -> dict[str, ndarray]:
    if not isinstance(fields, Mapping):
        raise TypeError(f"fields: got {type(fields).__name__}, expected a dict of arrays by name.")
    return {_check_name(name): _frozen(_check_field(name, value, n)) for name, value in fields.items()}


def _check_name(name: Any) -> str:
    if not isinstance(name, str):
        raise TypeError(f"fields: got the name {name!r}, expected a string.")
    # Forms read fields as attributes of ``w``, which is a dict: ``w.values`` would be its method.
    if name in RESERVED or hasattr(dict, name):
        raise ValueError(f"fields: got the name {name!r}, which means something else in a form; choose another.")
    if not name.isidentifier():
        raise ValueError(f"fields: got the name {name!r}, expected one that can be written as w.name in a form.")
    return name


def _check_field(name: str, value: Any, n: int) -> ndarray:
    shape = np.shape(value)
    if shape[-1:] != (n,):
        hint = "; transpose it: components come first, points last" if n in shape else ""
        raise ValueError(f"fields[{name!r}]: got shape {shape}, expected (..., {n}){hint}.")
    return check_array(f"fields[{name!r}]", value, shape)


def _check_chosen(which: Any, n: int) -> ndarray:
    which = np.asarray(which)
    if which.dtype.kind not in "biu" and which.size:
        raise TypeError(f"which: got an array of {which.dtype}, expected a mask of bools or point numbers.")
    if which.ndim != 1 or (which.dtype.kind == "b" and which.shape != (n,)):
        raise ValueError(f"which: got shape {which.shape}, expected a mask ({n},) or a row of point numbers.")
    chosen = np.flatnonzero(which) if which.dtype.kind == "b" else which.astype(np.int64)
    if chosen.size == 0:
        raise ValueError(f"which: keeps no points of {n}, expected at least one.")
    if chosen.min() < 0 or chosen.max() >= n:
        raise ValueError(f"which: got point numbers {chosen.min()} to {chosen.max()}, expected 0 to {n - 1}.")
    if np.bincount(chosen).max() > 1:
        raise ValueError(f"which: got point {np.bincount(chosen).argmax()} more than once, expected each at most once.")
    return chosen


def _check_mesh(mesh: Any, kinematics: Any) -> None:
    _check_kinematics(kinematics)
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: got {type(mesh).__name__}, expected a scikit-fem mesh; "
                        "meshio bodies go through Particles.from_meshio.")
    if mesh.elem not in TENSOR + SIMPLEX:
        raise ValueError(f"mesh: got {type(mesh).__name__}, expected MeshLine1, MeshTri1, MeshQuad1, MeshTet1 or "
                         "MeshHex1; straighten a mesh of higher order with e.g. MeshTri1.from_mesh(mesh).")
    kinematics.check_dim(mesh.dim())


def _density(density: Any, n: int) -> ndarray:
    density = np.asarray(density)
    if density.ndim == 0 and density.dtype.kind in "iu":
        density = density.astype(float)
    density = check_array("density", density, (n,) if density.ndim else ())
    check_positive("density", density)
    return density


def _keep(where: Any, x: ndarray) -> ndarray:
    """Which points, ``(cells, points of a cell)``, the predicate keeps."""
    if where is None:
        keep = np.ones(x[0].size, dtype=bool)
    elif not callable(where):
        raise TypeError(f"where: got {type(where).__name__}, expected a function such as lambda x: x[0] < 1.")
    else:
        keep = np.asarray(where(x.reshape(len(x), -1)))
    if keep.dtype != bool or keep.shape != (x[0].size,):
        raise ValueError(f"where: got {keep.dtype} of shape {keep.shape} from the function, "
                         f"expected bool of shape ({x[0].size},); it is called once, with all positions.")
    if not keep.any():
        raise ValueError(f"where: keeps no points of {keep.size}; look at the function and at the extent of the mesh.")
    return keep.reshape(x[0].shape)


def _frozen(array: ndarray) -> ndarray:
    """``array`` itself if nobody can write to it, else a read-only copy."""
    if _writable(array):
        array = array.copy()
        array.flags.writeable = False
    return array


def _writable(array: Any) -> bool:
    """Whether the memory can be written to through the array or what it is a view of."""
    if array is None:
        return False
    return not isinstance(array, ndarray) or array.flags.writeable or _writable(array.base)


# Where the points of a cell are, in its reference coordinates, and what each of them integrates.

def _rule(elem: type[Element], per_cell: Any, rule: Any) -> Rule:
    """Points ``(dim, q)`` of the reference cell, and a list of (points, weights) that sum up each one's part of it."""
    check_choice("rule", rule, RULES)
    if not isinstance(per_cell, Integral) or isinstance(per_cell, bool):
        raise TypeError(f"per_cell: got {per_cell!r}, expected an integer, the points per direction in a cell.")
    if per_cell < 1:
        raise ValueError(f"per_cell: got {per_cell}, expected at least 1, the points per direction in a cell.")
    dim, n = elem.refdom.dim(), int(per_cell)
    if elem in TENSOR:
        return _tensor_rule(dim, *_line_rule(n, rule))
    points, weights = _simplex_centroids(dim, n) if rule == "quarter" else _simplex_gauss(elem, n)
    return points, [(points, weights)]


def _line_rule(n: int, rule: str) -> tuple[ndarray, ndarray, ndarray]:
    """Points ``(n,)`` of [0, 1], with points and weights ``(s, n)`` that sum up each one's part."""
    # A single Gauss point is the middle, but its own weight is not exact for what distorted cells integrate.
    if rule == "gauss" and n > 1:
        xi, weights = leggauss(n)
        points = (1 + xi) / 2
        return points, points[None], weights[None] / 2
    points = (np.arange(n) + 0.5) / n
    offset = np.array([[-1.0], [1.0]]) / (2 * n * np.sqrt(3))
    return points, points + offset, np.full((2, n), 0.5 / n)


def _tensor_rule(dim: int, points: ndarray, parts: ndarray, weights: ndarray) -> Rule:
    return _grid([points] * dim), [
        (_grid(parts[list(k)]), _grid(weights[list(k)]).prod(axis=0)) for k in product(range(len(parts)), repeat=dim)]


def _grid(axes: Iterable[ndarray]) -> ndarray:
    """All points ``(dim, q)`` whose coordinates are taken from the axes."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"))
    return grid.reshape(len(grid), -1)


def _simplex_centroids(dim: int, n: int) -> tuple[ndarray, ndarray]:
    """Middles of the ``n**dim`` equal parts of the reference simplex, which are Kuhn simplices.

    In the coordinates ``1 > y_1 > ... > y_dim > 0`` the simplex is itself a Kuhn simplex of the unit cube, so those of
    the ``n**dim`` small cubes, one per order of the coordinates, either lie in it or outside.
    """
    orders = np.array(list(permutations(range(1, dim + 1)))).T / (dim + 1)
    y = (_grid([np.arange(n)] * dim)[:, :, None] + orders[:, None]).reshape(dim, -1) / n
    y = y[:, (np.diff(y, axis=0) < 0).all(axis=0)]
    points = -np.diff(y, axis=0, append=0)
    return points, _share_out(np.ones(n**dim), dim)


def _simplex_gauss(elem: type[Element], n: int) -> tuple[ndarray, ndarray]:
    """scikit-fem's first rule of order ``2 n - 1`` or more that gives every point a positive volume."""
    try:
        for order in range(2 * n - 1, 2 * n + 2):
            points, weights = get_quadrature(elem.refdom, order)
            if weights.min() > 0:
                return points, _share_out(weights, elem.refdom.dim())
    except NotImplementedError:
        pass
    raise ValueError(f"per_cell: got {n}, but scikit-fem has no Gauss rule of order {2 * n - 1} with positive weights "
                     f"for this cell ({elem.refdom.name}); use rule='quarter' or fewer points.")


def _share_out(weights: ndarray, dim: int) -> ndarray:
    """``weights`` scaled to the volume of the reference simplex."""
    return weights / weights.sum() / np.prod(np.arange(1, dim + 1))


# From the reference cell to the cells of a mesh; ``corners`` is (dim, corners of a cell, cells).

def _positions(elem: type[Element], corners: ndarray, points: ndarray) -> ndarray:
    """Positions ``(dim, cells, q)`` of reference points."""
    first = corners[:, 0, :, None]
    value = np.array([elem().lbasis(points, i)[0] for i in range(corners.shape[1])])
    return first + np.einsum("ivc,vq->icq", corners - corners[:, :1], value)


def _determinant(elem: type[Element], corners: ndarray, points: ndarray) -> ndarray:
    """Jacobian determinants ``(cells, q)`` at reference points."""
    slope = np.array([elem().lbasis(points, i)[1] for i in range(corners.shape[1])])
    return np.linalg.det(np.einsum("ivc,vjq->cqij", corners - corners[:, :1], slope))


def _measure(elem: type[Element], corners: ndarray, parts: list[tuple[ndarray, ndarray]], hoop: bool,
             cells: ndarray) -> tuple[ndarray, ndarray]:
    """Geometric area and volume ``(cells, q)`` of every point; they differ in axial symmetry."""
    if hoop:
        _check_axis(corners[0], cells)
    area = ring = np.zeros(1)
    sign = np.sign(_determinant(elem, corners, parts[0][0])[:, :1])
    for points, weights in parts:
        part = sign * _determinant(elem, corners, points) * weights
        if (part <= 0).any():
            cell = cells[np.flatnonzero((part <= 0).any(axis=1))[0]]
            raise ValueError(f"mesh: cell {cell} is folded or has no volume; expected valid cells, repair the mesh.")
        area = area + part
        if hoop:
            ring = ring + part * _positions(elem, corners, points)[0]
    return area, ring if hoop else area


def _check_axis(radius: ndarray, cells: ndarray) -> None:
    low = radius.min(axis=0)
    beyond = low < -1e-9 * np.ptp(radius, axis=0)
    if beyond.any():
        cell = np.flatnonzero(beyond)[0]
        raise ValueError(f"mesh: cell {cells[cell]} reaches to the radius {low[cell]}, expected none below zero; "
                         "end the mesh at the axis, or leave such cells out with where=.")


def _length(corners: ndarray, area: ndarray, per_cell: int) -> ndarray:
    """Edges ``(dim, cells, q)`` of the points' domains."""
    dim = len(corners)
    edges = np.ptp(corners, axis=1)
    box = np.isclose(area.sum(axis=1), edges.prod(axis=0), rtol=1e-8, atol=0)
    return np.where(box[:, None], edges[:, :, None] / per_cell, area ** (1 / dim))


# Bodies of meshio.

def _mesh_of(body: Any) -> Mesh:
    """The scikit-fem mesh of a meshio body or file."""
    import meshio
    from skfem.io.meshio import from_meshio

    if isinstance(body, (str, PathLike)):
        body = _read(Path(fspath(body)))
    if not isinstance(body, meshio.Mesh):
        raise TypeError(f"body: got {type(body).__name__}, expected a meshio.Mesh or the path of a file.")
    kind = _kind(body)
    mesh = from_meshio(meshio.Mesh(body.points, {kind: body.cells_dict[kind]}))
    # A mesh of lower dimension keeps the leading coordinates only; scikit-fem drops the others without a word.
    used = body.points[np.unique(mesh.t)]
    if np.ptp(used[:, mesh.dim():], axis=0).max(initial=0) > 1e-9 * np.ptp(used, axis=0).max():
        raise ValueError(f"body: got {kind} cells that leave the first {mesh.dim()} coordinate(s), expected a body at "
                         "constant further coordinates; rotate it.")
    return mesh


def _read(path: Path) -> meshio.Mesh:
    import meshio

    if not path.exists():
        raise FileNotFoundError(f"body: got {str(path)!r}, but there is no such file; check the path.")
    try:
        return meshio.read(path)
    except (meshio.ReadError, SystemExit) as error:    # meshio exits on a file that no reader takes
        raise ValueError(f"body: meshio cannot read {str(path)!r} ({error}); check its format and ending.") from error


def _kind(body: meshio.Mesh) -> str:
    """The one kind of cells of the highest dimension."""
    blocks = [block for block in body.cells if len(block)]
    kinds = sorted({block.type for block in blocks if block.dim == max(other.dim for other in blocks)})
    if not set(kinds) & set(MESHIO_CELLS):
        raise ValueError(f"body: got no usable cells ({', '.join(kinds) or 'none at all'}), "
                         f"expected one of {', '.join(MESHIO_CELLS)}.")
    if len(kinds) > 1:
        raise ValueError(f"body: got several kinds of cells ({', '.join(kinds)}), expected one; "
                         "filling only some would lose part of the body.")
    return kinds[0]
