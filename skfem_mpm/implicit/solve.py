"""Linear systems with fixed components and multipliers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.linalg import qr
from scipy.sparse import block_array, csc_array, csr_array, issparse
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from ..checks import NotConvergedError
from .state import Solver

ACCURACY = 1e-12    # of iterative solvers: residual relative to the right-hand side
PATIENCE = 40       # iterations after which it is better to factorise
SMALL = 2000        # unknowns up to which it is quicker to factorise each time
BEND = 0.1          # how far walls that bend may be missed, as a share of the range of their displacement


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


def bordered(stiffness: csr_array, rows: csr_array, free: ndarray, columns: csr_array) -> tuple[csc_array, float]:
    """The stiffness of what is free, bordered by constraint rows and columns, and the scale of these."""
    free = np.flatnonzero(free)
    matrix = csc_array(stiffness) if len(free) == stiffness.shape[0] else csc_array(stiffness)[:, free][free]
    if not rows.shape[0]:
        return matrix, 1.0
    scale = float(abs(matrix.diagonal()).mean())      # multipliers of the size of displacements
    columns = scale * columns[free]
    rows = scale * rows[:, free]
    return block_array([[matrix, columns], [rows, None]], format="csc"), scale


def solve_constrained(solver: Solver, stiffness: csr_array, force: ndarray, rows: csr_array, values: ndarray,
                      free: ndarray, columns: csr_array) -> tuple[ndarray, ndarray]:
    """Displacements and multipliers of ``stiffness u + columns m = force``, ``rows u = values``.

    What is not free is zero.  Entries of ``rows`` and ``columns`` should be of the size of one.

    Raises
    ------
    NotConvergedError
        If the solver fails or its answer does not solve the system.
    """
    system, scale = bordered(stiffness, rows, free, columns)
    free = np.flatnonzero(free)
    rhs = np.concatenate([force[free], scale * values])
    try:
        solution = np.asarray(solver(system, rhs))
    except (RuntimeError, ArithmeticError, ValueError) as failure:        # LinAlgError is a ValueError
        raise NotConvergedError(f"solver: {failure}; some part of the body may be held by nothing: add a FixedPlane or "
                                "a Wall, keep the soft floor above zero, or use another solver.") from failure
    error = np.linalg.norm(system @ solution - rhs) if solution.shape == rhs.shape else np.inf
    if not error <= 1e-6 * np.linalg.norm(rhs):
        raise NotConvergedError(f"solver: got a linear residual of {error:.1e}, expected at most 1e-6 of "
                                f"{np.linalg.norm(rhs):.1e}; look for parts that nothing holds, or use another solver.")
    unknowns = np.zeros(stiffness.shape[0])
    unknowns[free] = solution[:len(free)]
    return unknowns, scale * solution[len(free):]


def factorised(matrix: Any) -> SuperLU:
    """SuperLU with minimum-degree ordering of the symmetric pattern."""
    matrix = csc_array(matrix) if not issparse(matrix) or matrix.format != "csc" else matrix
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True})


def solve_direct(matrix: Any, rhs: ndarray) -> ndarray:
    """SuperLU with minimum-degree ordering of the symmetric pattern.

    Raises
    ------
    RuntimeError
        If the matrix is singular.
    """
    return factorised(matrix).solve(rhs)


def solve_cg(matrix: Any, rhs: ndarray) -> ndarray:
    """Conjugate gradients with the diagonal as preconditioner, for symmetric positive definite matrices.

    Good where inertia dominates, or for memory in large three-dimensional bodies; not for walls, whose multipliers make
    the matrix indefinite, nor for methods whose strain is not conjugate to force.

    Raises
    ------
    RuntimeError
        If the diagonal is not positive, or the residual does not fall to 1e-12 of the right-hand side.

    Examples
    --------
    >>> from scipy.sparse import diags_array
    >>> A = diags_array([-1.0, 4.0, -1.0], offsets=[-1, 0, 1], shape=(5, 5))
    >>> x = solve_cg(A, A @ np.arange(5.0))
    >>> print(round(float(x[4]), 12))
    4.0
    """
    diagonal = matrix.diagonal()
    if not (diagonal > 0).all():
        raise RuntimeError("conjugate gradients need a positive diagonal, which walls and parts held by nothing do not "
                           "have")
    jacobi = LinearOperator(matrix.shape, lambda v: v.ravel() / diagonal, dtype=float)
    solution, failed = cg(matrix, rhs, rtol=ACCURACY, maxiter=10 * len(rhs), M=jacobi)
    if failed:
        raise RuntimeError("conjugate gradients did not converge; the matrix may not be positive definite")
    return solution


class Factors:
    """Solves the systems of a load step with one factorisation, and GMRES for what has changed since it was made.

    It is that of the first matrix, or of one near it that costs less.  Small systems are factorised each time.  Nothing
    is kept from one step to the next, so a run that goes on from a state is the uninterrupted one.
    """

    def __init__(self) -> None:
        self.factor: SuperLU | None = None

    def solver(self, near: Callable[[], Any]) -> Solver:
        """A solver for a matrix that is close to what ``near`` makes."""
        return partial(self._solve, near)

    def _solve(self, near: Callable[[], Any], matrix: Any, rhs: ndarray) -> ndarray:
        if len(rhs) <= SMALL:
            return solve_direct(matrix, rhs)
        for attempt in (self._kept, partial(self._made, near), partial(self._made, lambda: matrix)):
            factor = attempt()
            solution = None if factor is None else gmres(matrix, rhs, factor.solve)
            if solution is not None:
                return solution
        return solve_direct(matrix, rhs)

    def _kept(self) -> SuperLU | None:
        return self.factor

    def _made(self, near: Callable[[], Any]) -> SuperLU | None:
        """A new factorisation; none if there is none."""
        try:
            self.factor = factorised(near())
        except RuntimeError:
            self.factor = None
        return self.factor


def gmres(matrix: Any, rhs: ndarray, precondition: Callable[[ndarray], ndarray]) -> ndarray | None:
    """The solution by Saad and Schultz's GMRES, preconditioned from the right; ``None`` if it takes too long.

    Sums do not go through BLAS, whose order of summation may depend on the number of threads.
    """
    start = np.sqrt(_dot(rhs, rhs))
    if start == 0:
        return np.zeros_like(rhs)
    basis, hessenberg = [rhs / start], np.zeros((PATIENCE + 1, PATIENCE))
    wanted = start * np.eye(1, PATIENCE + 1)[0]
    for j in range(PATIENCE):
        vector = matrix @ precondition(basis[j])
        for _ in range(2):                              # twice is enough, says Kahan, for it to be orthogonal
            for i, other in enumerate(basis):
                share = _dot(other, vector)
                hessenberg[i, j] += share
                vector -= share * other
        size = hessenberg[j + 1, j] = np.sqrt(_dot(vector, vector))
        if not np.isfinite(size):
            return None
        small = hessenberg[:j + 2, :j + 1]
        weight = np.linalg.lstsq(small, wanted[:j + 2])[0]
        left = np.linalg.norm(small @ weight - wanted[:j + 2])
        if left <= ACCURACY * start or size == 0:
            solution = precondition(sum(share * other for share, other in zip(weight, basis)))
            error = matrix @ solution - rhs
            return solution if np.sqrt(_dot(error, error)) <= 10 * ACCURACY * start else None
        basis.append(vector / size)
    return None


def _dot(one: ndarray, other: ndarray) -> float:
    return float(np.einsum("n,n->", one, other))
