"""Scenes that compute nothing: errors and failures as they are told, for the tests of studies."""

import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from skfem_mpm import NotConvergedError

FACTORS = {"mpm": 1 / 3, "gimp": 1 / 7, "gc": 1 / 30}


class Clock:
    """A clock that goes on when it is told; it stands for the module ``time``."""

    def __init__(self):
        self.now = 1.0

    def perf_counter(self):
        return self.now

    process_time = perf_counter

    def strftime(self, form):
        return "today"


CLOCK = Clock()


@dataclass
class Scene:
    """``error(state)`` falls with the square of the cells, and with the method; ``how`` says what goes wrong."""

    cells: int
    per_cell: int
    how: str
    log: str | None
    pause: float
    held: list = field(default_factory=list)

    def run(self, method="mpm", steps=3):
        if self.log is not None:
            with Path(self.log).open("a") as file:
                file.write(f"{method} {self.cells}\n")
        time.sleep(self.pause)
        for step in range(1, steps + 1):
            if step == 2:
                self.go_wrong()
            particles = SimpleNamespace(n=self.cells * self.per_cell)
            yield SimpleNamespace(step=step, particles=particles, engine="fake", method=method)

    def go_wrong(self):
        if self.how == "stops":
            raise NotConvergedError("no equilibrium in step 2; take smaller steps")
        if self.how == "dies":
            os._exit(7)
        if self.how == "has a bug":
            raise KeyError("no such thing")
        if self.how == "is large":
            self.held.append(np.ones(25_000_000))               # 200 MB

    def error(self, state):
        return FACTORS.get(state.method, 1.0) * state.step / self.cells**2


def make(cells=10, per_cell=1, how="is well", log=None, pause=0.0):
    """A :class:`Scene`."""
    if how == "is refused":
        raise ValueError("how: got a scene that cannot be; take another one")
    return Scene(cells, per_cell, how, log, pause)


class Measured(Scene):
    """Has named errors of a whole run, one of which it does not always know."""

    def measure(self, states):
        last = list(states)[-1]
        return {"stress": np.float32(self.error(last)), "run-out": np.nan if self.cells < 10 else 0.25}


def make_measured(cells=10, per_cell=1):
    """A :class:`Measured`."""
    return Measured(cells, per_cell, "is well", None, 0.0)


class Slow(Scene):
    """Takes 100 s to make, 1000 s more for its first state ever, and 1 s a step, by ``CLOCK``."""

    known: set = set()

    def run(self, method="mpm", steps=3):
        if method not in self.known:
            self.known.add(method)
            CLOCK.now += 1000
        for state in super().run(method, steps):
            CLOCK.now += 1
            yield state


def make_slow(cells=10):
    """A :class:`Slow`."""
    CLOCK.now += 100
    return Slow(cells, 2, "is well", None, 0.0)
