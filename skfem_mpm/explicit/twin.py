r"""The symmetric twin of field integration in explicit steps.

Stress is a field fitted to the points, force its integral over the cells that hold points, and strain is conjugate:

.. math:: f_I = -\sum_p \sigma_p L_{Ip}, \qquad \nabla v_p = \sum_I v_I \otimes L_{Ip} / V^*_p

Mass, momentum and motion are those of the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array

from ..basis import Method
from ..grid import Edges, Grid
from ..integration import OfTable, Twin
from ..kinematics import Kinematics
from .boxes import BoxCover, Boxes
from .nodes import Nodes
from .operators import Operators


class TableOperators(Operators):
    """Gradient and force of functions that are no products over the axes.

    Parameters
    ----------
    kinematics
        Which gradient rows there are.
    functions
        Slopes along the axes, then in axial symmetry value over radius.
    """

    def __init__(self, kinematics: Kinematics, functions: OfTable):
        self.functions, self.base, self.width, self.shape = functions, functions.base, functions.width, functions.shape
        self._take_rows(kinematics)

    @cached_property
    def places(self) -> ndarray:
        """Nodes of each point, ``(n, K**dim)``."""
        return np.ascontiguousarray(self.functions.nodes(slice(None)).T.astype(np.int32))

    @cached_property
    def matrices(self) -> list[csr_array]:
        """What a gradient is made of, ``(n, nnodes)`` each."""
        return [self._matrix(np.ascontiguousarray(table.T)) for table in self.functions.tables(slice(None))]


class TwinNodes(Nodes):
    """What an explicit step with the twin knows of its grid.

    Parameters
    ----------
    points
        The points and their boxes.
    twin
        Which fit.

    Attributes
    ----------
    volume
        ``(n,)``; :math:`V^*`.
    """

    def __init__(self, full: Grid, kinematics: Kinematics, x: ndarray, mass: ndarray, length: ndarray | None,
                 method: Method, edges: Edges, planes: Sequence[Any], ring: bool, points: Boxes, twin: Twin):
        super().__init__(full, kinematics, x, mass, length, method, edges, planes, ring)
        self.particles, self.cover = points, BoxCover(self.grid, self.index, points, planes)
        pair = twin.pair(self, method.force, method.strain, np.ones(points.n))
        self.volume = pair.volume
        self.strain = self.force = TableOperators(kinematics, pair.force_functions)    # type: ignore[arg-type]

    def integrated(self, volume: ndarray) -> ndarray:
        """What stress is multiplied with: :math:`V^*` instead of the volumes of the points."""
        return self.volume


def conjugate(method: Method) -> Method:
    """The method whose bases the twin reads: those for mass."""
    return Method(method.mass, method.mass, method.mass)
