"""Many realisations of a random scene, on any executor: each exactly once, the same numbers wherever it runs."""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np

from ..checks import check_counts
from .ledger import Ledger, Row
from .names import name_of
from .processes import DIED, Processes, answers, cores
from .store import versions

Function = Callable[[int, np.random.Generator], Mapping[str, float]]
FAILURES = (ValueError, RuntimeError, ArithmeticError)      # of a realisation: the solvers' own errors are among them
OWN = ("number", "status")                                  # what every row has
FINISHED = "finished"


def ensemble(function: Function, count: int, *, seed: int = 0, out: str | os.PathLike | None = None,
             executor: Executor | None = None, workers: int | None = None, ahead: int | None = None,
             progress: Callable[[int, int], Any] | None = None) -> list[Row]:
    """Evaluate ``function(number, rng)`` for the numbers 0 to ``count - 1``, each exactly once.

    Realisation ``k`` draws from child ``k`` of ``numpy.random.SeedSequence(seed)``: its numbers depend neither on
    workers nor on what was done before.

    A realisation that ends in a ``ValueError``, ``RuntimeError`` or ``ArithmeticError``, such as
    :class:`~skfem_mpm.UnstableError`, is a row that says why.  Any other error is one of the program and ends the
    ensemble.  A realisation under which a worker dies is done again: by Dask itself, or by new processes.  If one
    still dies when it is done alone, it is a row that says so.

    Parameters
    ----------
    function
        Gives a dict of numbers.  For processes it is a function of a module, or a ``functools.partial`` of one.
    count
        How many realisations.
    seed
        A whole number.
    out
        A file of JSON lines that rows are appended to as they come.  An ensemble that was interrupted, at any moment,
        goes on from it, and one that was finished can be given a larger ``count``.  The file belongs to the function
        with its arguments (as ``repr`` shows them), the seed and the versions of packages.  One ensemble at a time
        writes to it.
    executor
        Any ``concurrent.futures.Executor``; for Dask ``distributed.Client(...).get_executor()``.  It stays open.  If
        not given, processes are spawned, and stopped at the end.
    workers
        How many of these; one per core if not given.
    ahead
        How many realisations are handed out at once: twice the number of processes, or 1000 to an executor.
    progress
        Called as ``progress(done, count)``, at the start and after each realisation.

    Returns
    -------
    list of dict
        In order of ``number``; ``status`` is ``finished`` or the reason why not, the rest is what the function gave.

    Raises
    ------
    TypeError
        If an argument is of the wrong type, the function cannot be sent to processes, or does not give numbers.
    ValueError
        If a number is out of range, or ``out`` belongs to another function, seed or version.
    RuntimeError
        If processes do not start, or those of a given executor have died.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> def mean(number, rng):
    ...     return {"mean": rng.normal(size=100).mean()}
    >>> with ThreadPoolExecutor() as threads:
    ...     rows = ensemble(mean, 3, seed=1, executor=threads)
    >>> [row["number"] for row in rows], rows[0]["status"], abs(rows[0]["mean"]) < 0.5
    ([0, 1, 2], 'finished', True)
    """
    _check(function, count, seed, executor, workers, ahead, progress)
    name = name_of(function)
    if out is not None and re.search(" at 0x[0-9a-fA-F]+", name):
        raise ValueError(f"function: got {name}, which has another name next time, so a file cannot say whose rows it "
                         "has; expected a function, or a functools.partial with arguments that their repr shows.")
    if executor is None or isinstance(executor, ProcessPoolExecutor):
        function = _Pickled.of(function)
    owner = {"function": name, "seed": int(seed), "versions": {"python": python_version(), **versions()}}
    ledger = Ledger(None if out is None else Path(out), owner)
    missing = [number for number in range(count) if number not in ledger.rows]
    report = progress or (lambda done, count: None)
    try:
        report(count - len(missing), count)
        task = partial(_realise, function, int(seed))
        with (_open(executor, workers, missing) as pool,
              closing(answers(pool, task, missing, ahead or _ahead(pool))) as found):
            for done, (number, row) in enumerate(found, start=count - len(missing) + 1):
                ledger.add(row or {"number": number, "status": DIED})
                report(done, count)
    finally:
        ledger.release()
    ledger.sort()
    return [ledger.rows[number] for number in range(count)]


def generator(seed: int, number: int) -> np.random.Generator:
    """The random generator of one realisation of an ensemble, to look at that one again.

    It is that of child ``number`` of ``SeedSequence(seed).spawn(...)``.

    Examples
    --------
    >>> spawned = np.random.SeedSequence(3).spawn(8)[7]
    >>> generator(3, 7).random() == np.random.default_rng(spawned).random()
    True
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


# -- what runs where --------------------------------------------------------------------------------------------------

def _open(executor: Executor | None, workers: int | None, missing: list[int]) -> AbstractContextManager[Any]:
    """The executor, which stays open, or processes, which do not; none of them for nothing to do."""
    if executor is not None or not missing:
        return nullcontext(executor)
    return Processes(min(workers or cores(), len(missing)))


def _ahead(executor: Executor | None) -> int:
    return 2 * executor.workers if isinstance(executor, Processes) else 1000


def _realise(function: Function, seed: int, number: int, alone: bool = False) -> Row:
    """One row.  ``alone`` makes it another call: Dask answers one that it remembers with what it remembers."""
    try:
        values = function(number, generator(seed, number))
    except FAILURES as failure:
        return {"number": number, "status": f"{type(failure).__name__}: {failure}"}
    if not isinstance(values, Mapping):
        raise TypeError(f"function: got a {type(values).__name__} from it, expected a dict of numbers.")
    return {"number": number, "status": FINISHED, **{name: _number(name, value) for name, value in values.items()}}


def _number(name: Any, value: Any) -> float:
    if not isinstance(name, str) or name in OWN:
        raise TypeError(f"function: got the name {name!r} from it, expected a string other than {' and '.join(OWN)}.")
    if np.ndim(value) or np.asarray(value).dtype.kind not in "fiub":
        raise TypeError(f"function: got {value!r} as {name} from it, expected a number.")
    return float(value)


@dataclass(frozen=True)
class _Pickled:
    """A function as other processes get it."""

    text: bytes

    @classmethod
    def of(cls, function: Function) -> _Pickled:
        """Refuse here what would break a worker there."""
        try:
            return cls(pickle.dumps(function))
        except (pickle.PicklingError, AttributeError, TypeError) as failure:
            raise TypeError(f"function: got {function!r}, which cannot be sent to processes ({failure}); expected a "
                            "function of a module, or a functools.partial of one; or give executor a "
                            "ThreadPoolExecutor.") from None

    def __call__(self, number: int, rng: np.random.Generator) -> Mapping[str, float]:
        try:
            function = pickle.loads(self.text)
        except (AttributeError, ImportError) as failure:
            raise TypeError(f"function: a worker process cannot import it ({failure}); expected a function in a module "
                            "or a script that is a file.") from None
        return function(number, rng)


# -- what is asked ----------------------------------------------------------------------------------------------------

def _check(function: Any, count: Any, seed: Any, executor: Any, workers: Any, ahead: Any, progress: Any) -> None:
    """Refuse what makes no sense."""
    if not callable(function):
        raise TypeError(f"function: got {function!r}, expected a function of a number and a random generator.")
    check_counts({"count": (count, 1), "seed": (seed, 0)})
    check_counts({name: (number, 1) for name, number in {"workers": workers, "ahead": ahead}.items()
                  if number is not None})
    if executor is not None and not isinstance(executor, Executor):
        raise TypeError(f"executor: got a {type(executor).__name__}, expected a concurrent.futures.Executor; of a Dask "
                        "client give client.get_executor().")
    if executor is not None and workers is not None:
        raise ValueError(f"workers: got {workers} with an executor, which has its own; leave it out.")
    if progress is not None and not callable(progress):
        raise TypeError(f"progress: got {progress!r}, expected a function of the numbers done and to do.")
