"""A row of the stability map: one extreme, what is measured there for a method, and when that holds."""

import math
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

from skfem_mpm import METHODS, NotConvergedError, OutsideGridError, UnstableError

MUST = ("mpm", "gimp", "cmpm-c")            # these have to hold where a row says so
VERDICTS = ("holds", "degrades", "stops", "wrong")                # from the best to the worst
STOPS = (UnstableError, NotConvergedError, OutsideGridError, ValueError)

# What can be chosen beside a method, by the name that tables give it.
REMEDIES = {
    "": {},
    # explicit steps
    "usl": {"integrator": "usl"},
    "usf": {"integrator": "usf"},
    "usavg": {"integrator": "usavg"},
    "pic 1 %": {"flip": 0.99},
    "xpic 2": {"xpic": 2},
    "tpic": {"tpic": True, "flip": 0.0},
    # both solvers
    "b-bar": {"remedy": "bbar"},
    "twin": {"integration": "twin"},
    "dual": {"integration": "dual"},
    "stretched domains": {"domains": "stretched"},
    "ring domains": {"radius": "domain"},
    # implicit steps
    "eq10": {"weights": "eq10"},
    "interior": {"weights": "interior"},
    "overlap": {"weights": "overlap"},
    "field": {"integration": "field"},
    "field2": {"integration": "field2"},
    "cubic": {"integration": "cubic"},
    "dm, ghost": {"integration": "dm", "ghost": 0.1},
    "no floor": {"floor": 0.0},
    "ghost": {"ghost": 0.1},
}


@dataclass(frozen=True)
class Row:
    """An extreme.

    ``measure(choices, quick)`` does what the row is about with ``choices``, such as ``{"method": "gimp"}``, which are
    for ``explicit_steps`` or ``implicit_steps``.  It returns a number, the smaller the better, or ``None`` where the
    question makes no sense.  Errors of the library that it raises are stops; any other error is a defect.

    Attributes
    ----------
    name
        As the table prints it; unique.
    says
        A sentence or two: what is done, and what is measured.
    holds
        Up to this number the row holds.
    useless
        Beyond this number an answer is wrong, unless the library has warned of it; in between it degrades.
    warns
        Part (a pattern) of the warning that excuses a useless answer here.
    methods, remedies
        Which columns there are; remedies are of ``REMEDIES``.
    must
        Whether ``MUST`` have to hold.
    stops
        Part (a pattern) of the message with which a run may stop here; any other is wrong.
    """

    name: str
    says: str
    measure: Callable[[dict, bool], float | None]
    holds: float
    useless: float
    methods: tuple[str, ...] = tuple(METHODS)
    remedies: tuple[str, ...] = ()
    must: bool = False
    stops: str = ""
    warns: str = ""

    def cells(self, quick):
        """Method and remedy of each cell; the quick map has no remedies."""
        return [(method, remedy) for remedy in ("", *(() if quick else self.remedies)) for method in self.methods]


def evaluate(row, method, remedy, quick):
    """What a cell says: verdict, value, what the library warned of, the message of a stop, and the seconds taken."""
    start = time.perf_counter()
    value, message = None, ""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            value = row.measure({"method": method, **REMEDIES[remedy]}, quick)
        except STOPS as stop:
            message = f"{type(stop).__name__}: {stop}"
    warned = sorted({str(each.message) for each in heard
                     if row.warns and each.category is UserWarning and re.search(row.warns, str(each.message))})
    return {"verdict": judge(row, value, message, warned), "value": None if value is None else float(f"{value:.2g}"),
            "message": message, "warnings": warned, "seconds": round(time.perf_counter() - start, 2)}


def judge(row, value, message, warned):
    """One of ``VERDICTS``, or nothing where the question makes no sense."""
    if message:                                                  # for another reason than it should is no answer
        return "stops" if row.stops and re.search(row.stops, message) else "wrong"
    if value is None:
        return ""
    if value <= row.holds:
        return "holds"
    if value <= row.useless or (warned and not math.isnan(value)):
        return "degrades"
    return "wrong"
