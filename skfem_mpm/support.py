"""Which nodes carry a body in a step, which are solved for, and which follow their neighbours."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array, csr_array, vstack

from .basis import Method, ParticleBasis
from .cover import Cover, reach_in_cells
from .grid import Edges, Grid, Stencil, available_sides, corner_nodes, whole_cells, wider
from .particles import Particles

CUTOFF = 1e-8    # a node is active if its lumped mass exceeds this share of the largest


class Support:
    """What a step of a solver knows of its grid; made at its start and kept through its Newton passes.

    Parameters
    ----------
    ring
        Whether the radius is part of the means over domains.

    Attributes
    ----------
    grid
        The part of the mesh around the body.  Nodes are numbered along its axes, the last one fastest.
    index
        ``(dim, n)``; host cell of each point.
    planes
        Fixed planes of the boundary.
    sides
        Which neighbours patches may reach into, see :func:`skfem_mpm.grid.available_sides`.
    solved
        ``(nnodes,)``; nodes that are unknown or fixed: active ones of occupied cells.  Others that points may read are
        slaved to them.
    number
        ``(dim, nnodes)``; place of each component among the unknowns of all solved and slaved nodes, -1 for none.
    transfer
        Sparse; from the components of solved nodes to those of solved and slaved ones.
    free
        Mask over the columns of ``transfer``: not fixed.
    sound
        Mask over the cells, one index per axis: all nodes are solved or slaved.
    """

    def __init__(self, mesh: Any, particles: Particles, method: Method, edges: Edges, boundary: Sequence[Any],
                 ring: bool = False, covers: bool = False):
        self.full = full = Grid.from_mesh(mesh)
        full.check_dim(particles.dim)
        self.method = method
        self.edges = edges
        self.particles = particles
        self.ring = ring
        self.grid = full.window(full.locate(particles.x), 2 + (reach_in_cells(full, particles) if covers else 0))
        self.index = self.grid.locate(particles.x)
        self.occupied = self.grid.occupied(self.index)
        self.planes = planes = [plane for plane in boundary if hasattr(plane, "fixes")]
        for plane in planes:
            plane.check(full, particles.x)
        fixed = [plane.fixes(self.grid) for plane in planes] or [np.zeros((full.dim, self.grid.nnodes))]
        behind = [plane.behind(self.grid) for plane in planes] or [np.zeros(self.grid.nnodes)]
        self.fixed = np.any(fixed, axis=0)

        self._stencils: dict[type, Stencil] = {}
        self.mapping = self.stencil(method.mass)
        self.mass = self.mapping.to_nodes(particles.mass)
        active = (self.mass > CUTOFF * self.mass.max()) & ~np.any(behind, axis=0)
        self.sides = available_sides(self.occupied, active.reshape(self.grid.vertices.shape))
        reached = self._touched(self.stencil(method.strain))
        self.solved = active & reached & corner_nodes(self.occupied).ravel()
        read = reached | self._touched(self.stencil(method.force)) | self._touched(self.mapping)
        if covers:
            self.cover = Cover(self.grid, self.index, particles, planes)
            read |= corner_nodes(self.cover.covered).ravel()
        self._slave(read | self._felt())
        self._check_known(read)

    def stencil(self, basis: type[ParticleBasis]) -> Stencil:
        """Stencil of a basis for the points, made once.

        The basis that maps mass sees the whole grid; any other one reads solved nodes only, so it keeps to available
        neighbours.
        """
        if basis not in self._stencils:
            points, sides = self.particles, self.sides_of(basis)
            self._stencils[basis] = basis.stencil_of(self.grid, points.x, self.index, points.length, self.edges, sides,
                                                     ring=self.ring)
        return self._stencils[basis]

    @property
    def motion(self) -> Stencil:
        """Stencil of the functions that move the points."""
        return self.stencil(self.method.motion or self.method.mass)

    def sides_of(self, basis: type[ParticleBasis]) -> ndarray | None:
        """To which neighbours a basis keeps; ``None`` for the one that maps mass."""
        return None if basis is self.method.mass else self.sides

    def _touched(self, stencil: Stencil) -> ndarray:
        """Nodes whose value or slope some point sees; on a node a point sees its neighbours by their slopes alone."""
        felt = (stencil.value() != 0) | (stencil.gradient() != 0).any(axis=0)
        return np.bincount(stencil.nodes()[felt], minlength=self.grid.nnodes) > 0

    def _felt(self) -> ndarray:
        """Nodes the mapping may read anywhere in the occupied cells: of these, and of their neighbours for domains."""
        if self.method.mass.reads_domains:
            return corner_nodes(wider(self.occupied)).ravel()
        return corner_nodes(self.occupied).ravel()

    # -- slaved nodes ------------------------------------------------------------------------------------------------

    def _slave(self, touched: ndarray) -> None:
        """Number the unknowns; nodes that points touch but nothing holds extrapolate the body along a straight line."""
        by_solved, known = _extrapolation(self.grid, self.solved, touched & ~self.solved)
        dim = self.grid.dim
        nodes = np.flatnonzero(known)
        self.number = np.full((dim, self.grid.nnodes), -1)
        self.number[:, nodes] = np.arange(dim * len(nodes)).reshape(len(nodes), dim).T
        self.known = known
        self.sound = whole_cells(known.reshape(self.grid.vertices.shape))
        self.solved_nodes = np.flatnonzero(self.solved)
        self.slaved = len(nodes) > len(self.solved_nodes)
        self.transfer = _per_component(by_solved[nodes][:, self.solved_nodes], dim)
        self.free = ~self.fixed[:, self.solved_nodes].T.ravel()

    def _check_known(self, read: ndarray) -> None:
        """Refuse bodies so thin that a node which points read has nothing to follow."""
        lost = np.flatnonzero(read & ~self.known)
        if len(lost):
            index = np.unravel_index(lost[0], self.grid.vertices.shape)
            place = ", ".join(f"{axis[i]:g}" for axis, i in zip(self.grid.axes, index))
            raise ValueError(f"particles: got points that read the node at ({place}), which carries no mass and has no "
                             "two nodes of the body in line to follow; expected a body that spans a cell.  Move the "
                             "grid against the points, or use smaller cells.")

    def spread(self, unknowns: ndarray) -> ndarray:
        """Nodal vectors ``(dim, nnodes)`` from the components of the solved nodes; nodes out of play stay zero."""
        out = np.zeros(self.number.shape)
        out[:, self.known] = (self.transfer @ unknowns).reshape(-1, len(out)).T
        return out

    def gather(self, nodal: ndarray) -> ndarray:
        """Forces ``(dim, nnodes)`` on the components of the solved nodes; slaved nodes hand theirs on."""
        return self.transfer.T @ nodal[:, self.known].T.ravel()

    def row(self, nodes: ndarray, value: ndarray, component: int) -> csr_array:
        """A constraint row over the components of the solved nodes; nodes out of play have the value zero."""
        nodes, value = nodes[value != 0], value[value != 0]
        columns = self.number[component, nodes]
        full = coo_array((value, (np.zeros_like(columns), columns)), shape=(1, self.transfer.shape[0]))
        return csr_array(full @ self.transfer)

    def holds(self, cell: ndarray) -> ndarray:
        """Which cells ``(dim, n)`` have only solved or slaved nodes."""
        return self.sound[tuple(cell)]


def _extrapolation(grid: Grid, solved: ndarray, wanted: ndarray) -> tuple[csr_array, ndarray]:
    """Rows that express solved nodes by themselves and ``wanted`` ones by them, and which nodes have such a row.

    A node is the mean over the axes of u_0 + r (u_0 - u_1), face nodes first, then those behind edges and corners; r is
    the ratio of the two cells' widths, 1 on equal cells.
    """
    size = solved.size
    known, left = solved.copy(), np.flatnonzero(wanted)
    itself = np.flatnonzero(solved)
    matrix = csr_array((np.ones(len(itself)), (itself, itself)), shape=(size, size))
    while len(left):
        near, far, ratio = _neighbour_pairs(grid, left)
        usable = (near >= 0) & (far >= 0) & known[near] & known[far]
        count = usable.sum(axis=0)
        if not count.any():
            break
        pick = np.nonzero(usable)
        share, beyond = 1 / count[pick[1]], ratio[pick]
        value = np.concatenate([share * (1 + beyond), -share * beyond])
        row = np.tile(left[pick[1]], 2)
        column = np.concatenate([near[pick], far[pick]])
        new = csr_array((value, (row, column)), shape=(size, size)) @ matrix
        matrix = matrix + new
        known[left[count > 0]] = True
        left = left[count == 0]
    return matrix, known


def _neighbour_pairs(grid: Grid, nodes: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """The next and next but one node of each node in all axis directions, ``(2 dim, n)``; -1 beyond the grid.

    Last how far the next one is, in distances of these two.
    """
    shape = grid.vertices.shape
    index = np.stack(np.unravel_index(nodes, shape))
    pairs: tuple[list[ndarray], ...] = ([], [], [])
    for axis, sign in itertools.product(range(len(shape)), (-1, 1)):
        ways = index[axis] + sign * np.arange(3)[:, None]
        inside = (ways >= 0) & (ways < shape[axis])
        ways = np.clip(ways, 0, shape[axis] - 1)
        for rows, way, there in zip(pairs, ways[1:], inside[1:]):
            other = index.copy()
            other[axis] = way
            rows.append(np.where(there, np.ravel_multi_index(tuple(other), shape), -1))
        own, near, far = grid.axes[axis][ways]
        pairs[2].append(np.divide(near - own, far - near, out=np.zeros(len(nodes)), where=inside[2]))
    near, far, ratio = (np.stack(rows) for rows in pairs)
    return near, far, ratio


def _per_component(scalar: csr_array, dim: int) -> csr_array:
    """The same rows for each component of a vector, components inner."""
    entries = coo_array(scalar)
    row, column = entries.coords
    shift = np.arange(dim)
    rows = (row[:, None] * dim + shift).ravel()
    columns = (column[:, None] * dim + shift).ravel()
    value = np.repeat(entries.data, dim)
    return csr_array((value, (rows, columns)), shape=(scalar.shape[0] * dim, scalar.shape[1] * dim))


def stack_rows(rows: Sequence[csr_array], width: int) -> csr_array:
    """Constraint rows as one matrix, also when there are none."""
    return csr_array(vstack(rows)) if rows else csr_array((0, width))
