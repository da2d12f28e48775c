"""What a thick-walled cylinder does when its inner wall is pushed outwards: its references, none of them with points.

Plane strain along the axis, outer face fixed, elastic.  :func:`lame` is the closed form for small displacements,
:func:`incremental` adds it up step by step on the moving geometry, and :func:`finite` is in equilibrium in the deformed
cylinder.  Stress is packed as everywhere for axial symmetry: rr, zz, hoop, rz; tension positive; SI or any consistent
units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from ..checks import NotConvergedError, check_array, check_choice, check_positive

MEASURES = ("cauchy", "kirchhoff")


@dataclass(frozen=True)
class CylinderState:
    """Where points of the cylinder are and what they carry; with a history, steps come before points.

    Attributes
    ----------
    position : (n,) or (steps, n)
        Current radii.
    stress : (4, n) or (4, steps, n)
        Cauchy stress at these points: rr, zz, hoop, rz.
    pressure : () or (steps,)
        Pressure that the driven wall feels: minus the radial stress there.
    reaction : () or (steps,)
        Force on the driven wall per radian and unit height: the pressure times the current radius of the wall.
    """

    position: ndarray
    stress: ndarray
    pressure: ndarray
    reaction: ndarray


def lame(r: ndarray, E: float, nu: float, inner: float, outer: float, displacement: float) -> tuple[ndarray, ndarray]:
    r"""Displacement and stress for a small displacement of the inner wall.

    :math:`u = a r + b / r` with :math:`u(r_i)` given and :math:`u(r_e) = 0`;
    :math:`\sigma_{r, \theta} = 2 (\lambda + G) a \mp 2 G b / r^2`, :math:`\sigma_z = 2 \lambda a`.

    Parameters
    ----------
    r : (n,)
        Radii, from ``inner`` to ``outer``.
    E, nu
        Young's modulus and Poisson's ratio.
    inner, outer
        Radii of the cylinder.
    displacement
        Of the inner wall, positive outwards.

    Returns
    -------
    displacement : (n,)
        Radial displacement.
    stress : (4, n)
        rr, zz, hoop, rz.

    Raises
    ------
    ValueError
        If the material, the radii or the displacement make no sense, or a point is outside the wall.
    TypeError
        If ``r`` holds no floats.

    References
    ----------
    Lame's solution; Gonzalez Acosta et al. (2017), section 3, uses it as reference.

    Examples
    --------
    >>> u, stress = lame(np.array([1.0, 3.0]), E=25e6, nu=0.3, inner=1.0, outer=3.0, displacement=0.015)
    >>> print(u.round(6), (stress[0] / 1e3).round(2))
    [0.015 0.   ] [-414.66 -126.2 ]
    """
    _check_cylinder(E, nu, inner, outer, displacement)
    return _lame(_check_radii("r", r, inner, outer), E, nu, inner, outer, displacement)


def reaction_lame(E: float, nu: float, inner: float, outer: float, displacement: float) -> float:
    r"""Force that the inner wall feels, per radian and unit height: :math:`-\sigma_r(r_i) r_i` of Lame's solution.

    Parameters and exceptions are those of :func:`lame`; the unit is stress times length.

    Examples
    --------
    >>> print(round(reaction_lame(E=25e6, nu=0.3, inner=1.0, outer=3.0, displacement=0.015)))
    414663
    """
    _, stress = lame(np.array([float(inner)]), E, nu, inner, outer, displacement)
    return float(-stress[0, 0] * inner)


def incremental(R: ndarray, E: float, nu: float, inner: float, outer: float, increment: float,
                steps: int) -> CylinderState:
    """Lame's solution added up over equal steps, each on the geometry that the step before has left.

    In every step Lame's increments of displacement and stress are taken at the points' positions *before* the step, for
    a cylinder whose inner radius is the one *before* the step; the stress is added and the points are moved.  A point
    on the wall stays on it.

    This is no equilibrium, however short the steps: as the wall moves, the stress that it already carries goes out of
    balance, and nothing puts it back.  With radii 1 and 3, nu = 0.3 and 50 steps of 0.015, the deviatoric stress ends
    7.5 % above that of :func:`finite` at the inner face, 1.0 % above at R = 1.525 and 7.5 % below at the outer face.

    Parameters
    ----------
    R : (n,)
        Initial radii of the points.
    E, nu, inner, outer
        As in :func:`lame`, before the first step.
    increment
        Displacement of the inner wall per step, positive outwards.
    steps
        How many.

    Returns
    -------
    CylinderState
        After each step: ``position`` (steps, n), ``stress`` (4, steps, n), ``pressure`` and ``reaction`` (steps,).

    Raises
    ------
    ValueError, TypeError
        As :func:`lame`, for the displacement of all steps together; or if ``steps`` is not an integer above zero.

    References
    ----------
    Lame's solution per step, in the spirit of Gonzalez Acosta et al. (2017), section 3 (50 steps of 1.5 cm); the paper
    does not print how its reference was updated, so the rule above is ours.

    Examples
    --------
    >>> history = incremental(np.array([1.525]), 25e6, 0.3, inner=1.0, outer=3.0, increment=0.015, steps=50)
    >>> print((deviatoric(history.stress)[[0, 9, 24, 49], 0] / 1e3).round(1))
    [  244.4  2530.7  6661.1 14439. ]
    """
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)):
        raise TypeError(f"steps: got {steps!r}, expected an integer; write int(steps) if that is meant.")
    check_positive("steps", steps)
    _check_cylinder(E, nu, inner, outer, increment * steps, name="increment * steps")
    r = np.append(_check_radii("R", R, inner, outer), inner)
    position, stress = np.empty((steps, r.size)), np.empty((4, steps, r.size))
    total = np.zeros((4, r.size))
    for step in range(steps):
        u, change = _lame(r, E, nu, inner + step * increment, outer, increment)
        total, r = total + change, r + u
        position[step], stress[:, step] = r, total
    return _drop_wall(position, stress)


def finite(R: ndarray, E: float, nu: float, inner: float, outer: float, displacement: float,
           measure: str = "cauchy") -> CylinderState:
    r"""Equilibrium of the deformed cylinder, with logarithmic strain; good for displacements of any size.

    Solves :math:`d\sigma_r / dr + (\sigma_r - \sigma_\theta) / r = 0` in the deformed radius r with
    :math:`\varepsilon_r = \ln(dr/dR)`, :math:`\varepsilon_\theta = \ln(r/R)`, :math:`\varepsilon_z = 0`, to about ten
    digits.  At large strain the two measures are two different materials: always name the one that is used.

    Parameters
    ----------
    R : (n,)
        Initial radii of the points.
    E, nu, inner, outer
        As in :func:`lame`, undeformed.
    displacement
        Of the inner wall, outwards: zero or more, less than the thickness of the wall.
    measure
        ``"cauchy"``: Cauchy stress is linear in the logarithmic strain.  ``"kirchhoff"``: Kirchhoff stress is, and
        Cauchy stress is that divided by the volume ratio (Hencky's material).

    Returns
    -------
    CylinderState
        ``position`` (n,), ``stress`` (4, n), always Cauchy stress, ``pressure`` and ``reaction`` ().

    Raises
    ------
    ValueError, TypeError
        As :func:`lame`; also for a negative displacement and an unknown ``measure``.
    NotConvergedError
        If the boundary value problem could not be solved.

    Examples
    --------
    >>> R = np.array([1.0, 2.0])
    >>> for measure in MEASURES:
    ...     state = finite(R, 25e6, 0.3, inner=1.0, outer=2.0, displacement=0.5, measure=measure)
    ...     print(measure, state.position.round(6), (deviatoric(state.stress) / 1e6).round(1))
    cauchy [1.5 2. ] [21.9 10.9]
    kirchhoff [1.5 2. ] [36.9 18.6]
    """
    history = finite_history(R, E, nu, inner, outer, np.array([float(displacement)]), measure)
    return CylinderState(history.position[0], history.stress[:, 0], history.pressure[0], history.reaction[0])


def finite_history(R: ndarray, E: float, nu: float, inner: float, outer: float, displacements: ndarray,
                   measure: str = "cauchy") -> CylinderState:
    """Solve :func:`finite` for many displacements of the wall at once, at little more than the price of one.

    Parameters
    ----------
    R, E, nu, inner, outer, measure
        As in :func:`finite`.
    displacements : (steps,)
        Of the inner wall, from its undeformed place, in any order.

    Returns
    -------
    CylinderState
        ``position`` (steps, n), ``stress`` (4, steps, n), ``pressure`` and ``reaction`` (steps,).

    Raises
    ------
    ValueError, TypeError, NotConvergedError
        As :func:`finite`.

    Examples
    --------
    >>> history = finite_history(np.array([1.525]), 25e6, 0.3, 1.0, 3.0, 0.015 * np.arange(1, 51))
    >>> print((deviatoric(history.stress)[[0, 9, 24, 49], 0] / 1e3).round(1))
    [  245.5  2546.9  6680.8 14288.6]
    """
    check_choice("measure", measure, MEASURES)
    displacements = check_array("displacements", displacements, (None,))
    if not displacements.size:
        raise ValueError("displacements: got none, expected at least one; np.array([0.0]) is the undeformed cylinder.")
    _check_cylinder(E, nu, inner, outer, displacements.max())
    if displacements.min() < 0:
        raise ValueError(f"displacement: got {displacements.min()}, expected zero or more; finite pushes outwards.")
    R = np.append(_check_radii("R", R, inner, outer).clip(inner, outer), inner)
    y, w = _shoot_to_wall(np.log(outer / R), np.log1p(displacements / inner), nu, measure)
    return _drop_wall(R * np.exp(y), _finite_stress(y, w, E, nu, measure))


def finite_free(R: ndarray, E: float, nu: float, inner: float, outer: float, displacement: float,
                measure: str = "kirchhoff") -> CylinderState:
    r"""The cylinder of :func:`finite` with a free outer face: :math:`\sigma_r(r_e) = 0`.

    Parameters, results and exceptions are those of :func:`finite`.

    Examples
    --------
    >>> state = finite_free(np.array([1.0, 2.0]), 25e6, 0.3, inner=1.0, outer=2.0, displacement=0.5)
    >>> print(state.position.round(4), abs(state.stress[0, 1]) < 1e-3)
    [1.5    2.3604] True
    """
    check_choice("measure", measure, MEASURES)
    _check_cylinder(E, nu, inner, outer, displacement)
    if displacement < 0:
        raise ValueError(f"displacement: got {displacement}, expected zero or more; finite_free pushes outwards.")
    R = np.append(_check_radii("R", R, inner, outer).clip(inner, outer), inner)
    slope, span, wall = _slope(nu, measure), np.log(outer / inner), np.log1p(displacement / inner)

    def from_face(y: float, dense: bool = False) -> Any:
        return _shoot(slope, np.array([-y / (1 - nu)]), span, dense, np.array([y]))    # radial stress is zero there

    face = brentq(lambda y: from_face(y).y[0, -1] - wall, 0.0, wall, xtol=1e-15, rtol=1e-14) if wall else 0.0
    y, w = from_face(face, dense=True).sol(np.log(outer / R))
    found = _drop_wall(R * np.exp(y)[None], _finite_stress(y, w, E, nu, measure)[:, None])
    return CylinderState(found.position[0], found.stress[:, 0], found.pressure[0], found.reaction[0])


def deviatoric(stress: ndarray) -> ndarray:
    r"""Deviatoric stress :math:`q = \sqrt{3 J_2}` of packed stress, shear included.

    Parameters
    ----------
    stress : (4, ...)
        xx, yy, zz, xy or, in axial symmetry, rr, zz, hoop, rz.

    Returns
    -------
    q : (...)
        Zero or more, in the unit of the stress.

    Raises
    ------
    ValueError, TypeError
        If ``stress`` is no array of finite floats with four rows.

    Examples
    --------
    >>> print(deviatoric(np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])).round(4))
    [1.     1.7321]
    """
    stress = check_array("stress", stress, (4,) + (None,) * (np.ndim(stress) - 1))
    x, y, z, shear = stress
    return np.sqrt(((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / 2 + 3 * shear**2)


def _check_cylinder(E: float, nu: float, inner: float, outer: float, displacement: float,
                    name: str = "displacement") -> None:
    """Refuse material, radii and displacement outside what the formulas can take."""
    for label, value in (("E", E), ("nu", nu), ("inner", inner), ("outer", outer), (name, displacement)):
        if not np.isfinite(value):
            raise ValueError(f"{label}: got {value}, expected a finite number; look at what made it.")
    check_positive("E", E)
    check_positive("inner", inner)
    if not -1 < nu < 0.5:
        raise ValueError(f"nu: got {nu}, expected -1 < nu < 0.5; take 0.499 for a nearly incompressible wall.")
    if not outer > inner:
        raise ValueError(f"outer: got {outer}, expected more than inner = {inner}; swap the two if they are mixed up.")
    if not -inner < displacement < outer - inner:
        raise ValueError(f"{name}: got {displacement}, expected more than {-inner} (the wall on the axis) and less "
                         f"than {outer - inner} (the wall on the fixed face); take a smaller one.")


def _check_radii(name: str, r: Any, inner: float, outer: float) -> ndarray:
    """Return radii as floats, refusing those outside the wall by more than rounding."""
    r = check_array(name, r, (None,))
    slack = 1e-9 * (outer - inner)
    bad = np.flatnonzero((r < inner - slack) | (r > outer + slack))
    if bad.size:
        raise ValueError(f"{name}: got {r[bad[0]]} at point {bad[0]}, expected radii from inner = {inner} to "
                         f"outer = {outer}; give undeformed radii of points in the wall.")
    return r


def _lame(r: ndarray, E: float, nu: float, inner: float, outer: float, displacement: float) -> tuple[ndarray, ndarray]:
    """Lame's solution without the checks."""
    lam, G = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    a = -displacement * inner / (outer**2 - inner**2)
    b = -a * outer**2
    shift, swing, one = 2 * (lam + G) * a, 2 * G * b / r**2, np.ones_like(r)
    return a * r + b / r, np.stack([shift - swing, 2 * lam * a * one, shift + swing, 0 * one])


def _drop_wall(position: ndarray, stress: ndarray) -> CylinderState:
    """Read pressure and reaction from the last point, which sits on the driven wall, and leave it out."""
    pressure = -stress[0, :, -1]
    return CylinderState(position[:, :-1], stress[:, :, :-1], pressure, pressure * position[:, -1])


# The boundary value problem of `finite`.  A cylinder twice as large has the same strains, so with s = ln(outer / R)
# nothing depends on s itself.  Unknowns: y = ln(r / R), the hoop strain, and w = ln(dr/dR) - y, radial minus hoop
# strain.  Then dy/ds = 1 - exp(w), and equilibrium gives dw/ds.  At the outer face y = 0 and w is unknown; it is found
# by shooting at the driven wall, for all displacements together.


def _slope(nu: float, measure: str) -> Callable[[float, ndarray], ndarray]:
    """Return d(y, w)/ds; y and w follow each other in one vector."""
    k, c = (1 - 2 * nu) / (1 - nu), 1 / (1 - nu)    # 2 G and lambda + M, over M = lambda + 2 G

    def cauchy(s: float, yw: ndarray) -> ndarray:
        w = yw[yw.size // 2:]
        e = np.expm1(w)
        return np.concatenate([-e, k * w * (1 + e) + c * e])

    def kirchhoff(s: float, yw: ndarray) -> ndarray:
        y, w = yw.reshape(2, -1)
        e, tau = np.expm1(w), w + c * y             # radial Kirchhoff stress over M, never above zero
        return np.concatenate([-e, (k * w * (1 + e) + (c - 2 * tau) * e) / (1 - tau)])

    return cauchy if measure == "cauchy" else kirchhoff


def _shoot(slope: Callable, start: ndarray, span: float, dense: bool = False, hoop: ndarray | float = 0.0) -> Any:
    """Integrate from the outer face, where y = ``hoop`` and w = ``start``, over ``span`` in s."""
    # Dense output is of lower order than the steps, so it gets short ones.
    result = solve_ivp(slope, (0.0, span), np.concatenate([0 * start + hoop, start]), method="DOP853", rtol=1e-13,
                       atol=1e-14 * np.abs(np.tile(start, 2)) + 1e-200, dense_output=dense,
                       max_step=span / 24 if dense else np.inf)
    if not result.success:
        raise NotConvergedError(f"finite: {result.message} Take a smaller displacement.")
    return result


def _shoot_to_wall(s: ndarray, wall: ndarray, nu: float, measure: str) -> tuple[ndarray, ndarray]:
    """Return y and w, both (steps, n), at the places ``s``; the last one is the wall, where y is ``wall`` (steps,)."""
    slope, span, moved = _slope(nu, measure), s[-1], wall > 0
    start = np.zeros_like(wall)
    if moved.any():
        start[moved] = -np.exp(_secant(slope, span, wall[moved]))
    yw = _shoot(slope, start, span, dense=True).sol(s)
    return yw[:wall.size], yw[wall.size:]


def _secant(slope: Callable, span: float, wall: ndarray, passes: int = 40) -> ndarray:
    """Return p = ln(-w) at the outer face such that y at the wall is ``wall``."""
    # In the measure g the answer is a straight line of slope one if w is uniform, and never far from one.
    def measure_of(y: ndarray) -> ndarray:
        return np.log(-np.log1p(-y / span))

    target = measure_of(wall)
    p, rate, step, before = target.copy(), np.ones_like(target), np.zeros_like(target), target
    for _ in range(passes):
        miss = target - measure_of(_shoot(slope, -np.exp(p), span).y[:wall.size, -1])
        far = np.abs(step) > 1e-6                   # below that the difference quotient is noise
        rate[far] = ((before - miss)[far] / step[far]).clip(0.02, 5)
        before, step = miss, miss / rate
        p = p + step
        if np.abs(miss).max() < 1e-10:              # the step just taken makes it far smaller
            return p
    raise NotConvergedError(f"finite: the wall is missed by {np.abs(miss).max():.1e} after {passes} passes; "
                            "take a smaller displacement.")


def _finite_stress(y: ndarray, w: ndarray, E: float, nu: float, measure: str) -> ndarray:
    """Return Cauchy stress (4, ...) from hoop strain y and radial minus hoop strain w."""
    lam, G = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    mean = lam * (w + 2 * y)
    stress = np.stack([mean + 2 * G * (w + y), mean, mean + 2 * G * y, 0 * y])
    return stress if measure == "cauchy" else stress * np.exp(-w - 2 * y)
