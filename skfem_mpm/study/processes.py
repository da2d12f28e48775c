"""Worker processes of a study: replaced when one dies, gone when the study is."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any


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
