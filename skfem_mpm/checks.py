"""What every door of the library uses to refuse bad input, and the errors it raises."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy import ndarray

ENGINES = ("auto", "numpy", "numba")
WHOLE: Any = Integral          # of types that mypy takes for any: it does not know that these can be compared
NUMBER: Any = Real
STRICT = {
    "finite": "nothing sensible follows from numbers that are not finite",
    "positive": "a point that is turned inside out has no volume to go on with",
    "inside": "a point without a cell has nothing to move with; in explicit runs leaving='remove' goes on without it",
}


class OutsideGridError(ValueError):
    """A point is outside the grid that it needs; the message names the point, its position and the grid."""


class _CarriesState(RuntimeError):
    """A run stopped; ``state`` is the last good snapshot (``None`` before the first)."""

    def __init__(self, message: str, state: Any = None):
        super().__init__(message)
        self.state = state


class NotConvergedError(_CarriesState):
    """A load step found no equilibrium; ``.state`` is the last good snapshot."""


class UnstableError(_CarriesState):
    """A run became unstable; ``.state`` is the last good snapshot."""


def check_array(name: str, value: Any, shape: tuple[int | None, ...]) -> ndarray:
    """Return ``value`` as a finite float array of the given shape (``None`` fits any length), or say what is wrong."""
    array = np.asarray(value)
    sizes = ", ".join("n" if size is None else str(size) for size in shape)
    wanted = f"({sizes},)" if len(shape) == 1 else f"({sizes})"
    if array.dtype.kind != "f":
        raise TypeError(f"{name}: got an array of {array.dtype}, expected floats; write {name}.astype(float) if that "
                        "is meant.")
    if array.ndim != len(shape) or any(want not in (None, got) for got, want in zip(array.shape, shape)):
        hint = "; transpose it: components come first, points last" if array.T.shape == shape else ""
        raise ValueError(f"{name}: got shape {array.shape}, expected {wanted}, components first and points last{hint}.")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}: got {array[index]} at index {index}, expected finite numbers; look at what made the "
                         "array.")
    return array.astype(float, copy=False)


def check_positive(name: str, value: Any) -> None:
    """Refuse entries that are zero, negative or not finite, naming the first one."""
    array = np.asarray(value)
    bad = ~((array > 0) & np.isfinite(array))
    if bad.any():
        if array.ndim == 0:
            raise ValueError(f"{name}: got {value}, expected a number above zero.")
        index = int(np.flatnonzero(bad)[0])
        raise ValueError(f"{name}: got {array.flat[index]} at point {index}, expected numbers above zero.")


def check_own(name: str, array: ndarray, n: int) -> None:
    """Refuse a state whose points are not as many as those that something else in it is of."""
    if array.shape[-1] != n:
        raise ValueError(f"{name}: got that of {array.shape[-1]} points in a state with {n}; a state goes on with its "
                         "own points.  Start anew from the particles.")


def check_counts(counts: Mapping[str, tuple[Any, int]]) -> None:
    """Refuse whole numbers that are too small; each comes with the least it may be."""
    for name, (count, least) in counts.items():
        if not (isinstance(count, WHOLE) and count >= least) or isinstance(count, bool):
            raise ValueError(f"{name}: got {count!r}, expected a whole number of at least {least}.")


def check_spans(spans: Mapping[str, Any]) -> None:
    """Refuse spans of time that are none."""
    for name, span in spans.items():
        if span is not None and not (isinstance(span, NUMBER) and np.isfinite(span) and span > 0):
            raise ValueError(f"{name}: got {span!r}, expected a time span above zero, or None.")


def position(x: ndarray, point: int) -> str:
    """Where a point is, in words."""
    return f"({', '.join(f'{value:g}' for value in x[:, point])})"


def whereabouts(x: ndarray, point: int) -> str:
    """A point and its position."""
    return f"point {point} at {position(x, point)}"


def check_choice(name: str, value: Any, choices: Iterable[str]) -> None:
    """Refuse a name that is not one of ``choices``, and list them."""
    choices = tuple(choices)
    if value not in choices:
        raise ValueError(f"{name}: got {value!r}, expected one of {', '.join(map(repr, choices))}.")


def check_guards(guards: Any, known: Mapping[str, tuple[str, ...]]) -> dict[str, str]:
    """What each guard does, by name: what is asked for, or else the first thing that it can do.

    Parameters
    ----------
    guards
        A mapping from names to ``stop``, ``warn`` or ``off``, or ``None``.
    known
        What each guard can do.

    Raises
    ------
    TypeError, ValueError
        If it is no mapping, a name is unknown or one of those that always hold, or all of them are off.
    """
    if not isinstance(guards, (Mapping, type(None))):
        raise TypeError(f"guards: got a {type(guards).__name__}, expected a mapping such as {{'energy': 'off'}}.")
    for name, what in (guards or {}).items():
        if name in STRICT:
            raise ValueError(f"guards: got {name!r}, which always holds: {STRICT[name]}.")
        check_choice("guards", name, known)
        check_choice(f"guards[{name!r}]", what, known[name])
    held = {name: (guards or {}).get(name, can[0]) for name, can in known.items()}
    if set(held.values()) == {"off"}:
        raise ValueError("guards: got all of them 'off', expected at least one that holds; relax only what is known to "
                         "be wrong here.")
    return held


def warn_of_relaxed(guards: Mapping[str, str], caller: int = 3) -> None:
    """Say once which guards are off; a warning points at the line ``caller`` frames up."""
    off = [repr(name) for name, what in guards.items() if what == "off"]
    if off:
        warnings.warn(f"guards: {', '.join(off)} off; what this would have stopped goes on without a word.",
                      UserWarning, stacklevel=caller)


def choose_engine(engine: str, pays: bool, caller: int = 4) -> str:
    """The engine that runs, ``numpy`` or ``numba``, where ``auto`` leaves the choice to whether numba ``pays``.

    A warning points at the line ``caller`` frames up.

    Raises
    ------
    ImportError
        If ``engine`` is ``numba`` and numba is not installed.
    """
    if engine == "numpy" or (engine == "auto" and not pays):
        return "numpy"
    if importlib.util.find_spec("numba") is not None:
        return "numba"
    if engine == "numba":
        raise ImportError("engine: got 'numba', which is not installed; install the extra with "
                          "pip install 'skfem-mpm[fast]', or use engine='numpy'.")
    warnings.warn("a run of this size is many times faster with numba: pip install 'skfem-mpm[fast]'.", UserWarning,
                  stacklevel=caller)
    return "numpy"
