"""Tasks on any executor, whatever becomes of its workers; and worker processes that are gone when the study is."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

DIED = "its worker died, also when it was done alone; it may need more memory than there is"


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Processes(Executor):
    """A ``ProcessPoolExecutor`` of spawned processes that is made anew after a worker has died.

    Workers hold one end of a line whose other end is the study's.  They stop when it is closed: by the study, or by the
    system when the study was killed.

    Raises
    ------
    RuntimeError
        If worker processes do not start.
    """

    def __init__(self, workers: int):
        self.workers = workers
        self._open()

    def _open(self) -> None:
        context = get_context("spawn")
        theirs, self._line = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(self.workers, context, _follow, (theirs,))
        try:
            self._pool.submit(os.getpid).result()       # a script without a guard, say, breaks each worker at its start
        except BrokenExecutor:
            self._close()
            raise RuntimeError("executor: worker processes do not start, for the reason that they print; a script that "
                               "starts them does so below `if __name__ == \"__main__\":`, and is a file.") from None
        except KeyboardInterrupt:
            self._close()
            raise

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Have a function called by a worker; futures of a pool whose worker dies end in ``BrokenExecutor``."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenExecutor:
            self._close()
            self._open()
        return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let workers go: after what they do if ``wait``, else at once."""
        if wait:
            self._pool.shutdown(cancel_futures=cancel_futures)
        self._close()

    def _close(self) -> None:
        self._line.close()
        self._pool.shutdown(cancel_futures=True)

    def __exit__(self, kind: Any, *rest: Any) -> None:
        """Wait for nothing if the study has failed or was interrupted."""
        self.shutdown(wait=kind is None)


def _follow(line: Connection) -> None:
    """Called first by every worker: live as long as the line, and leave Ctrl-C to the study."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_stop_at_end, args=(line,), daemon=True).start()


def _stop_at_end(line: Connection) -> None:
    try:
        line.recv()
    except (EOFError, OSError):
        os._exit(1)


def answers(executor: Executor, task: Callable[..., Any], numbers: Sequence[int],
            ahead: int) -> Generator[tuple[int, Any], None, None]:
    """``task(number)`` of every number with the number, as they come; ``None`` if it kills every worker.

    Nobody knows which task a worker died of: all that may have been in its hands are done again when the others are
    done, one at a time as ``task(number, True)``, and then it is known.  That makes it another call: Dask answers one
    that it remembers with what it remembers.

    Raises
    ------
    RuntimeError
        If the executor is broken for good.
    """
    suspects = []
    try:
        for number, future in _ended(executor, task, numbers, ahead):
            if _worker_died(future):
                suspects.append(number)
            else:
                yield number, future.result()
        for number in sorted(suspects):
            future = executor.submit(task, number, True)
            yield number, None if _worker_died(future) else future.result()
    except BrokenExecutor as failure:
        raise RuntimeError("executor: it is broken, for one of its workers died; go on with a new one, or without: own "
                           "processes are replaced.") from failure


def _ended(executor: Executor, task: Callable[..., Any], numbers: Sequence[int],
           ahead: int) -> Iterator[tuple[int, Future]]:
    """Futures by number as they end; so many are handed out ``ahead``."""
    waiting = iter(numbers)
    flying: dict[Future, int] = {}
    ended: SimpleQueue[Future] = SimpleQueue()
    try:
        while True:
            for number in islice(waiting, ahead - len(flying)):
                future = executor.submit(task, number)
                flying[future] = number
                future.add_done_callback(ended.put)
            if not flying:
                return
            future = ended.get()
            yield flying.pop(future), future
    finally:
        for future in flying:
            future.cancel()


def _worker_died(future: Future) -> bool:
    """Whether a future ended with its worker: Dask gives up after some deaths, a pool of processes at once."""
    dask: Any = sys.modules.get("distributed")
    return isinstance(future.exception(), (BrokenExecutor, dask.KilledWorker) if dask else BrokenExecutor)
