"""Linear systems with fixed components and multipliers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.linalg import qr
from scipy.sparse import block_array, csc_array, csr_array, issparse
from scipy.sparse.linalg import splu

from ..checks import NotConvergedError
from .state import Solver

BEND = 0.1    # how far walls that bend may be missed, as a share of the range of their displacement


def independent_rows(rows: csr_array, values: ndarray, owner: Sequence[Any]) -> tuple[ndarray, ndarray]:
    """Which constraint rows to keep, in order, and their values: walls may ask for more than the grid can obey.

    A rigid wall agrees with itself, whatever rows others imply.  One that bends in the step may not: linear functions
    cannot follow it to the last digit.  Rows that are kept then take the values that fit all rows best, in the sense of
    least squares.

    Parameters
    ----------
    rows, values
        Constraints ``rows u = values``.
    owner
        Whose each row is; rows of one owner that ask for different values bend.

    Raises
    ------
    ValueError
        If the best fit misses a value by more than a tenth of the range of values of its owner.
    """
    columns = np.unique(rows.indices)
    dense = rows[:, columns].toarray().T
    triangle, order = qr(dense, mode="r", pivoting=True)
    size = np.abs(np.diagonal(triangle))
    kept = np.sort(order[:int((size > 1e-8).sum())])
    if len(kept) == len(values):
        return kept, values
    implied = np.setdiff1d(np.arange(len(values)), kept)
    share = np.eye(len(values))[:, kept]
    share[implied] = np.linalg.lstsq(dense[:, kept], dense[:, implied], rcond=None)[0].T
    fitted = np.linalg.lstsq(share, values, rcond=None)[0]
    found = share @ fitted
    slack = 1e-8 * np.abs(values).max() + BEND * _ranges(values, owner)
    wrong = np.abs(found - values) > slack
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"wall: got a displacement of {values[row]:g} where other walls and planes allow only "
                         f"{found[row]:g}; expected walls that agree with each other and with the planes.")
    return kept, fitted


def _ranges(values: ndarray, owner: Sequence[Any]) -> ndarray:
    """Largest less smallest value of the owner of each row."""
    held: dict[Any, list[float]] = {}
    for who, value in zip(owner, values):
        held.setdefault(who, []).append(value)
    return np.array([np.ptp(held[who]) for who in owner])


def solve_constrained(solver: Solver, stiffness: csr_array, force: ndarray, rows: csr_array, values: ndarray,
                      free: ndarray) -> tuple[ndarray, ndarray]:
    """Displacements and multipliers of ``stiffness u + rows^T m = force``, ``rows u = values``.

    What is not free is zero.

    Raises
    ------
    NotConvergedError
        If the solver fails or its answer does not solve the system.
    """
    free = np.flatnonzero(free)
    matrix = csc_array(stiffness) if len(free) == stiffness.shape[0] else csc_array(stiffness)[:, free][free]
    scale = abs(matrix.diagonal()).mean() if len(values) else 1.0    # multipliers of the size of displacements
    rows = scale * rows[:, free]
    system = block_array([[matrix, rows.T], [rows, None]], format="csc") if len(values) else matrix
    rhs = np.concatenate([force[free], scale * values])
    try:
        solution = np.asarray(solver(system, rhs))
    except (RuntimeError, ArithmeticError, np.linalg.LinAlgError) as failure:
        raise NotConvergedError(f"solver: {failure}; some part of the body may be held by nothing: add a FixedPlane or "
                                "a Wall, keep the soft floor above zero, or use another solver.") from failure
    error = np.linalg.norm(system @ solution - rhs) if solution.shape == rhs.shape else np.inf
    if not error <= 1e-6 * np.linalg.norm(rhs):
        raise NotConvergedError(f"solver: got a linear residual of {error:.1e}, expected at most 1e-6 of "
                                f"{np.linalg.norm(rhs):.1e}; look for parts that nothing holds, or use another solver.")
    unknowns = np.zeros(stiffness.shape[0])
    unknowns[free] = solution[:len(free)]
    return unknowns, scale * solution[len(free):]


def solve_direct(matrix: Any, rhs: ndarray) -> ndarray:
    """SuperLU with minimum-degree ordering of the symmetric pattern.

    Raises
    ------
    RuntimeError
        If the matrix is singular.
    """
    matrix = csc_array(matrix) if not issparse(matrix) or matrix.format != "csc" else matrix
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True})
    return factor.solve(rhs)
