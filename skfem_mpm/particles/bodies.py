"""Bodies that meshio holds or reads, as scikit-fem meshes."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from skfem import Mesh

if TYPE_CHECKING:
    import meshio

MESHIO_CELLS = ("line", "triangle", "quad", "tetra", "hexahedron")


def mesh_of(body: Any) -> Mesh:
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
