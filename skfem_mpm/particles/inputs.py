"""What the points accept; anything else is refused with what was got, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy import ndarray

from ..checks import check_array, check_positive
from ..kinematics import Kinematics

ARRAYS = ("x", "volume", "mass", "length", "spans", "sigma", "epsilon", "velocity", "history")
# What scikit-fem puts into the ``w`` of a form, then what we hold or put there.
RESERVED = ("x", "h", "n", "idx") + ARRAYS + ("stress", "strain", "kinematics", "fields", "dim")


def check_kinematics(kinematics: Any) -> None:
    """Refuse what is no kinematics object."""
    if not isinstance(kinematics, Kinematics):
        raise TypeError(f"kinematics: got {kinematics!r}, expected one of skfem_mpm's uniaxial, plane_strain, "
                        "axisymmetric, solid.")


def check_positions(x: Any, kinematics: Kinematics) -> ndarray:
    """Positions ``(dim, n)`` of at least one point, in axial symmetry off the axis."""
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


def check_history(history: Any, n: int) -> ndarray:
    """What the law remembers, ``(k, n)``; the law itself checks ``k``."""
    shape = np.shape(history)
    if len(shape) != 2 or shape[1] != n:
        hint = ""
        if shape[:1] == (n,):
            hint = "; transpose it" if len(shape) == 2 else "; write history[None, :] if the law remembers one number"
        raise ValueError(f"history: got shape {shape}, expected (k, {n}), one row for each name in the law's "
                         f"history{hint}.")
    return check_array("history", history, shape)


def check_fields(fields: Any, n: int) -> dict[str, ndarray]:
    """The user's own fields ``(..., n)``, read-only, under names that a form can use."""
    if not isinstance(fields, Mapping):
        raise TypeError(f"fields: got {type(fields).__name__}, expected a dict of arrays by name.")
    held = {}
    for name, value in fields.items():
        _check_name(name)
        shape = np.shape(value)
        if shape[-1:] != (n,):
            hint = "; transpose it: components come first, points last" if n in shape else ""
            raise ValueError(f"fields[{name!r}]: got shape {shape}, expected (..., {n}){hint}.")
        held[name] = frozen(check_array(f"fields[{name!r}]", value, shape))
    return held


def _check_name(name: Any) -> None:
    if not isinstance(name, str):
        raise TypeError(f"fields: got the name {name!r}, expected a string.")
    # Forms read fields as attributes of ``w``, which is a dict: ``w.values`` would be its method.
    if name in RESERVED or hasattr(dict, name):
        raise ValueError(f"fields: got the name {name!r}, which means something else in a form; choose another.")
    if not name.isidentifier():
        raise ValueError(f"fields: got the name {name!r}, expected one that can be written as w.name in a form.")


def check_chosen(which: Any, n: int) -> ndarray:
    """Numbers of some of ``n`` points, each at most once, from a mask or such numbers."""
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


def frozen(array: ndarray) -> ndarray:
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
