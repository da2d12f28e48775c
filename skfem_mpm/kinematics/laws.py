"""How laws are called, and what they may answer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray

Places = tuple[tuple[int, int], ...]

YIELD = 1e-6       # stress beyond yield as a share of strength: a return mapping that has converged is far below


def check_law(law: Any, *also: str) -> None:
    """Refuse what has not the four things that make a law, or lacks others that are needed here."""
    needed = ("kirchhoff", "history", "update", "tangent", *also)
    missing = [name for name in needed if not hasattr(law, name)]
    if isinstance(law, type):
        raise TypeError(f"material: got the class {law.__name__}, expected a law; give it numbers, as in "
                        "LinearElastic(E=1e6, nu=0.3).")
    if missing:
        raise TypeError(f"material: got {type(law).__name__}, without {', '.join(missing)}; expected a law with "
                        f"{', '.join(needed)}, such as LinearElastic(E=1e6, nu=0.3).")
    if not isinstance(law.history, tuple):
        raise TypeError(f"material: got {type(law).__name__} with the history {law.history!r}, expected a tuple of "
                        "names, one for each number that a point remembers; () for none.")


def memory(law: Any, history: ndarray | None, n: int) -> ndarray:
    """What the law remembers: nothing if it has no history, zeros if none is given."""
    names = law.history
    if history is None or not names:
        return np.zeros((len(names), n))
    if history.shape != (len(names), n):
        raise ValueError(f"history: got shape {history.shape}, expected {(len(names), n)}, one row for each of "
                         f"{', '.join(names)} of {type(law).__name__}; drop it with replace(particles, history=None) "
                         "if it is that of another law.")
    return history


def answer(law: Any, strain: ndarray, stress: ndarray, history: ndarray,
           components: Places) -> tuple[ndarray, ndarray]:
    """What a law answers to strain, refused if it is not stress and history of the shapes that they had."""
    name, given = f"{type(law).__name__}.update", [strain.view(), stress.view(), history.view()]
    for array in given:
        array.flags.writeable = False
    try:
        result = law.update(*given, components)
    except ValueError as error:
        if "read-only" not in str(error):
            raise
        raise ValueError(f"{name}: it changes its arguments in place, expected a pure function; write a = a + b "
                         "instead of a += b, or copy first.") from error
    if not (isinstance(result, tuple) and len(result) == 2):
        what = f"{len(result)} values" if isinstance(result, tuple) else f"one {type(result).__name__}"
        raise TypeError(f"{name}: got {what}, expected the pair (stress, history).")
    for what, array, before in zip(("stress", "history"), result, (stress, history)):
        if not isinstance(array, ndarray) or array.dtype.kind != "f":
            kind = f"an array of {array.dtype}" if isinstance(array, ndarray) else type(array).__name__
            raise TypeError(f"{name}: got {kind} for the {what}, expected an array of floats {before.shape}.")
        if array.shape != before.shape:
            raise ValueError(f"{name}: got shape {array.shape} for the {what}, expected {before.shape}, as it was "
                             "given: one row per component, one column per point.")
    own = [before if array is kept else np.require(array, float, ("C", "W"))
           for array, kept, before in zip(result, given[1:], (stress, history))]
    return own[0], own[1]


def moduli(law: Any, strain: ndarray, stress: ndarray, history: ndarray, places: Places) -> ndarray:
    """The tangent of a law, refused if it has not a row and a column for each place."""
    tangent, m, n = law.tangent(strain, stress, history, places), len(places), strain.shape[1]
    if np.shape(tangent) not in ((m, m, 1), (m, m, n)):
        raise ValueError(f"{type(law).__name__}.tangent: got shape {np.shape(tangent)}, expected {(m, m, n)}, or "
                         f"{(m, m, 1)} if it is the same for all points.")
    return tangent


def moduli_at_rest(law: Any, history: ndarray | None, ncomp: int, n: int, places: Places) -> ndarray:
    """The tangent of a law for ``n`` points without strain and stress."""
    zero = np.zeros((ncomp, n))
    return moduli(law, zero, zero, memory(law, history, n), places)


def beyond_yield(law: Any, sigma: ndarray, epsilon: ndarray | None, history: ndarray) -> ndarray | None:
    """How far the stress of points is beyond yield, as a share of strength ``(n,)``; ``None`` if the law does not say.

    Parameters
    ----------
    sigma, epsilon
        ``(ncomp, n)``; Cauchy stress and, where it is kept, elastic logarithmic strain.
    history
        ``(k, n)``.
    """
    if not hasattr(law, "excess"):
        return None
    stress = sigma if epsilon is None or not law.kirchhoff else sigma * np.exp(epsilon[:3].sum(axis=0))
    excess = np.asarray(law.excess(stress, history))
    if excess.shape != stress.shape[1:]:
        raise ValueError(f"{type(law).__name__}.excess: got shape {excess.shape}, expected {stress.shape[1:]}, one "
                         "number for each point.")
    return excess


def words_of_yield(law: Any, excess: float) -> tuple[str, str]:
    """What is wrong with a point whose stress is beyond yield, and with what."""
    name = type(law).__name__
    return (f"has a stress that is beyond yield by {excess:.3g} of the strength, expected at most {YIELD:g}",
            f"The return mapping of {name}.update has not converged, or {name}.excess is wrong.")
