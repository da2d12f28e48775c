"""One run of a choice: untimed, for its errors and its peak memory; or timed, for nothing but its seconds."""

from __future__ import annotations

import gc
import multiprocessing
import pickle
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .choices import Choice, make_scene

# What a run that cannot go on raises: everything that the library says, what numpy and the machine add, and what Python
# says of a scene of the user's that has an error.
FAILURES = (ValueError, TypeError, RuntimeError, ArithmeticError, LookupError, AttributeError, AssertionError,
            MemoryError, ImportError, OSError)
MAKE = Callable[..., Any]


def measured(make: MAKE, choice: Choice) -> dict[str, Any]:
    """Errors and sizes of one run, and what it warned of: columns of a row.

    ``status`` is ``failed`` and ``reason`` says why if it stops.
    """
    last: list[Any] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            scene, options = make_scene(make, choice)
            found = _measure(scene, _watched(scene.run(**options), last))
            errors = {name: float(value) for name, value in found.items()}
            status = {"status": "done", "reason": ""}
        except FAILURES as failure:
            errors, status = {}, failed(failure)
    status["warnings"] = "; ".join(dict.fromkeys(str(each.message) for each in caught))
    return {**status, **(_sizes(last[0]) if last else {}), "errors": errors}


def _sizes(state: Any) -> dict[str, Any]:
    """Columns of a row that a state tells, if it is of a run of the library."""
    found = {"points": getattr(getattr(state, "particles", None), "n", None),
             "steps_done": getattr(state, "step", None), "engine_used": getattr(state, "engine", None)}
    return {name: value for name, value in found.items() if value is not None}


def failed(failure: BaseException) -> dict[str, Any]:
    """Columns of a row that say why it stopped."""
    return {"status": "failed", "reason": f"{type(failure).__name__}: {failure}"}


def _watched(states: Iterable[Any], last: list[Any]) -> Iterator[Any]:
    """The states as they come; the latest one is kept in ``last``."""
    for state in states:
        last[:] = [state]
        yield state


def _measure(scene: Any, states: Iterable[Any]) -> dict[str, float]:
    """Named errors of a run: the scene's own measure; or those of its last state, and of its worst one."""
    if not any(hasattr(scene, name) for name in ("measure", "errors", "error")):
        raise TypeError(f"scene: got a {type(scene).__name__} that measures nothing; expected one with "
                        "measure(states), errors(state) or error(state).")
    if hasattr(scene, "measure"):
        return scene.measure(states)
    history = [scene.errors(state) if hasattr(scene, "errors") else {"error": scene.error(state)} for state in states]
    if not history:
        raise ValueError("scene: got a run without states, expected one that yields at least one.")
    worst = {f"{name}_worst": max(errors[name] for errors in history) for name in history[-1]}
    return {**history[-1], **(worst if len(history) > 1 else {})}


def measured_apart(make: MAKE, choice: Choice) -> dict[str, Any]:
    """:func:`measured` in a process of its own, with ``memory_mb``: how far its memory grew, in megabytes.

    It is what the operating system counts, so the factors of a solver are in it, and a compiler where one is needed.

    Raises
    ------
    RuntimeError
        If no process can be started that has the scene.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_report, args=(theirs, make, dict(choice)))
    child.start()
    theirs.close()
    try:
        if _received(ours) is None:
            raise RuntimeError("memory: got no process of its own for a run, see its output above; in a script, put "
                               "what starts a study under `if __name__ == '__main__':`, or give memory=False.")
        found = _received(ours)
        child.join(1 if found else None)
        return found or {"status": "failed", "errors": {}, "reason": _death(child.exitcode)}
    finally:
        child.terminate()
        child.join()


def _received(pipe: Any) -> dict[str, Any] | None:
    """What a process sends next; ``None`` if it has ended."""
    try:
        return pipe.recv()
    except EOFError:
        return None


def _death(code: int | None) -> str:
    why = "an error that its output shows" if code == 1 else "want of memory perhaps"
    return f"its process ended with exit code {code}: {why}"


def _report(pipe: Any, make: MAKE, choice: Choice) -> None:
    _forget_peak()
    before = _peak()
    pipe.send({"memory_mb": before})                # it has started, and has the scene
    found = measured(make, choice)
    pipe.send({**found, "memory_mb": _peak() - before})
    pipe.close()


def _forget_peak() -> None:
    """Where the system allows it: what importing the library took for a moment does not hide a small run."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass


def _peak() -> float:
    """The most memory that this process has held so far, in megabytes; not a number where the system does not say."""
    try:                                # Linux: of this program alone; getrusage adds what its parent held at its start
        text = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(text.split("VmHWM:")[1].split()[0]) * 1.024e-3
    except (OSError, IndexError):
        pass
    try:
        import resource
    except ImportError:                 # no Unix
        return np.nan
    unit = 1e-6 if sys.platform == "darwin" else 1.024e-3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def timed(make: MAKE, choice: Choice) -> dict[str, float]:
    """Seconds of one run, nothing else done meanwhile: to make the scene, and by the clock and the processor to run."""
    start = time.perf_counter()
    scene, options = make_scene(make, choice)
    setup = time.perf_counter() - start
    gc.collect()
    wall, cpu = time.perf_counter(), time.process_time()
    deque(scene.run(**options), maxlen=0)
    return {"setup_s": setup, "wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


@contextmanager
def undisturbed() -> Iterator[None]:
    """For runs that are timed: nothing is warned of again, and collections of garbage are short.

    To look through all that is there before the first run takes longer than a small run.
    """
    gc.freeze()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        gc.unfreeze()


def compiled(make: MAKE, choice: Choice) -> float:
    """Seconds that a first state takes longer than the same once more: to import and compile what a run needs."""
    seconds = []
    for _ in range(2):
        scene, options = make_scene(make, choice)
        start = time.perf_counter()
        states = iter(scene.run(**options))
        next(states, None)
        seconds.append(time.perf_counter() - start)
    return max(seconds[0] - seconds[1], 0.0)


def check_sendable(make: MAKE, need: str) -> None:
    """Refuse a scene that no other process can be given."""
    try:
        pickle.dumps(make)
    except (pickle.PicklingError, AttributeError, TypeError) as failure:
        raise TypeError(f"scene: got {make!r}, which cannot be sent to another process ({failure}); expected a "
                        f"function at the top of a module. {need}") from None
