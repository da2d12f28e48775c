"""Functions for ensembles: worker processes import them, so they are in a light module of their own."""

import os
import time
from pathlib import Path

import numpy as np

from skfem_mpm import NotConvergedError, OutsideGridError, UnstableError


def draw(number, rng):
    return {"first": rng.normal(), "second": rng.random()}


def scaled(number, rng, factor, by=0.0):
    return {"value": np.sum(factor) * rng.random() + by}


def slow(number, rng, folder, seconds=0.02):
    """Leaves a mark in a folder each time that it is evaluated to the end."""
    time.sleep(seconds)
    with open(Path(folder) / f"{number}-{os.getpid()}-{time.time_ns()}", "w"):
        pass
    return draw(number, rng)


def stops(number, rng):
    """Ends in another way for each number."""
    kinds = [NotConvergedError, UnstableError, OutsideGridError, ZeroDivisionError, FloatingPointError]
    if number < len(kinds):
        raise kinds[number](f"at {number},\nand \"so\" on")
    return draw(number, rng)


def wrong(number, rng):
    return {}["nothing"] if number == 3 else draw(number, rng)


def gives(number, rng, what):
    return what


def kills_once(number, rng, folder, which=2):
    """The worker of one realisation dies the first time."""
    mark = Path(folder) / "died"
    if number == which and not mark.exists():
        mark.touch()
        os._exit(3)
    return slow(number, rng, folder)


def kills_always(number, rng, which=2):
    if number == which:
        os._exit(3)
    return draw(number, rng)


def notes_its_worker(number, rng, folder, seconds=0.1):
    """Writes down its worker's process before it begins."""
    (Path(folder) / f"pid-{number}-{os.getpid()}").touch()
    return slow(number, rng, folder, seconds)
