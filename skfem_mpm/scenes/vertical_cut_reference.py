"""What the vertical cut does on ever finer grids: histories of runs, and the stored reference they are held against."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from .richardson import Extrapolated

FILE = Path(__file__).with_name("vertical_cut.json")
FAILED = 0.10           # displacement of the toe [m] at which the cut has failed, the paper's instant
QUANTITIES = ("run_out", "failure_time", "dissipation")


class Moment(NamedTuple):
    """One instant of a run: time, displacement of the toe, that of the foremost point, plastic work so far."""

    time: float
    toe: float
    run_out: float
    plastic: float


@dataclass(frozen=True, eq=False)
class CutHistory:
    """What a run has shown, from rest to its last state.

    Attributes
    ----------
    time, toe, run_out, plastic
        ``(n,)`` each, zero at first: time [s], displacement of the toe and of the foremost point [m], plastic
        dissipation [J per metre of cut].
    """

    time: ndarray
    toe: ndarray
    run_out: ndarray
    plastic: ndarray

    @classmethod
    def of(cls, moments: Iterable[Moment]) -> CutHistory:
        """Collect the moments of a run that starts from rest."""
        return cls(*np.array([Moment(0.0, 0.0, 0.0, 0.0), *moments]).T)

    def toe_at(self, times: Any) -> ndarray:
        """Displacement of the toe at given times, along straight lines; not a number beyond the end."""
        return np.interp(times, self.time, self.toe, right=np.nan)

    def quantities(self, until: float) -> dict[str, float]:
        """The numbers that an engineer would ask for, at the time ``until``.

        Returns
        -------
        dict
            ``run_out`` and ``dissipation`` at that time; ``failure_time``, when the toe has moved 10 cm, and if it has
            not by then, ``until``.  All are not a number if the run ended earlier.
        """
        if not self.time[-1] >= until:
            return dict.fromkeys(QUANTITIES, np.nan)
        return {"run_out": float(np.interp(until, self.time, self.run_out)),
                "failure_time": min(self.failure_time(), until),
                "dissipation": float(np.interp(until, self.time, self.plastic))}

    def failure_time(self) -> float:
        """When the toe has first moved 10 cm; infinite if it never has."""
        beyond = np.flatnonzero(self.toe >= FAILED)
        if not beyond.size:
            return np.inf
        pair = slice(beyond[0] - 1, beyond[0] + 1)
        return float(np.interp(FAILED, self.toe[pair], self.time[pair]))


@dataclass(frozen=True, eq=False)
class CutReference:
    """The limit of a sequence of grids, for one loading; see :func:`cut_reference`.

    Attributes
    ----------
    until
        Time at which it ends [s].
    times
        ``(n,)``; when the displacement of the toe is known [s].
    toe
        Its history, ``value`` and ``error`` ``(n,)`` [m].
    run_out, failure_time, dissipation
        ``value``, ``error`` and ``order`` each, in m, s, and J per metre of cut.
    """

    until: float
    times: ndarray
    toe: Extrapolated
    run_out: Extrapolated
    failure_time: Extrapolated
    dissipation: Extrapolated

    def errors(self, history: CutHistory) -> dict[str, float]:
        """Relative errors of a run.

        Returns
        -------
        dict
            ``toe``: rms over time of the displacement's error, relative to the final displacement; ``run_out``,
            ``failure_time`` and ``dissipation``: relative.  Not a number if the run ended earlier than the reference.
        """
        errors = {"toe": self._share(history.toe_at(self.times) - self.toe.value)}
        for name, value in history.quantities(self.until).items():
            exact = getattr(self, name).value
            errors[name] = float(abs(value - exact) / exact)
        return errors

    def uncertainty(self) -> dict[str, float]:
        """How far the reference may itself be off, in the measures of :meth:`errors`; no run can be judged any closer.

        Examples
        --------
        >>> cut_reference("sudden").uncertainty()["failure_time"] < 0.2
        True
        """
        found = {name: getattr(self, name) for name in QUANTITIES}
        return {"toe": self._share(self.toe.error)} | {name: float(one.error / one.value)
                                                       for name, one in found.items()}

    def _share(self, off: ndarray) -> float:
        """Root mean square over time, as a share of the final displacement."""
        return float(np.sqrt((off ** 2).mean()) / self.toe.value[-1])


@cache
def stored() -> dict[str, Any]:
    """The file of the reference, as it was written: command, date, machine, versions, choice, every grid."""
    return json.loads(FILE.read_text(encoding="utf-8"))


@cache
def cut_reference(loading: str) -> CutReference:
    """The stored reference of the cut of :func:`vertical_cut` with its default numbers.

    Parameters
    ----------
    loading
        ``sudden`` or ``ramped``.

    Returns
    -------
    CutReference
        Values with estimates of their errors, made by ``benchmarks/cut_reference.py``.

    Raises
    ------
    KeyError
        If there is no such loading.

    Examples
    --------
    >>> found = cut_reference("sudden")
    >>> 0 < found.failure_time.value < found.until, len(found.times) == len(found.toe.value)
    (True, True)
    """
    held = stored()[loading]
    return CutReference(held["until"], np.array(held["times"]), _extrapolated(held["toe"]),
                        *(_extrapolated(held[name]) for name in QUANTITIES))


def _extrapolated(held: dict[str, Any]) -> Extrapolated:
    """Numbers or lists of a file; JSON has null where there is no order."""
    value, error = (np.array(held[name]) if isinstance(held[name], list) else held[name] for name in ("value", "error"))
    return Extrapolated(value, error, np.nan if held["order"] is None else held["order"])
