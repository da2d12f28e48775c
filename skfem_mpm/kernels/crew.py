"""Threads that share the chunks of a kernel."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from .options import CHUNKS


class Crew:
    """Runs kernels that take a range of chunks as their last two arguments.

    Kernels let go of Python's lock, so plain threads do: they need no threading layer, no parallel variants that take
    seconds to compile, and one thread pays for none of it.
    """

    def __init__(self, threads: int):
        self.threads = min(threads, CHUNKS)
        cuts = [CHUNKS * k // self.threads for k in range(self.threads + 1)]
        self.ranges = list(zip(cuts, cuts[1:]))
        self.pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def __call__(self, kernel: Callable[..., None], *arguments: Any) -> None:
        """Run a kernel on all chunks."""
        if self.pool is None:
            kernel(*arguments, 0, CHUNKS)
            return
        others = [self.pool.submit(kernel, *arguments, *part) for part in self.ranges[1:]]
        kernel(*arguments, *self.ranges[0])
        for other in others:
            other.result()
