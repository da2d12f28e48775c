"""What a study runs: choices, plain dictionaries of arguments of a scene and of its run."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product as cartesian
from typing import Any

import numpy as np

Choice = Mapping[str, Any]
SIZES = ("cells", "per_cell", "steps")            # what makes a run dearer, whatever the way to compute


def product(**axes: Sequence[Any] | None) -> list[dict[str, Any]]:
    """Every combination of the values of some arguments.

    Parameters
    ----------
    axes
        Sequences of values by the name of the argument; one without values (``None``) is left out.

    Raises
    ------
    TypeError, ValueError
        If an axis is no sequence, or an empty one.

    Examples
    --------
    >>> product(method=("mpm", "gimp"), cells=[10])
    [{'method': 'mpm', 'cells': 10}, {'method': 'gimp', 'cells': 10}]
    """
    given = {name: _listed(name, values) for name, values in axes.items() if values is not None}
    return [dict(zip(given, values)) for values in cartesian(*given.values())]


def _listed(name: str, values: Any) -> list[Any]:
    if isinstance(values, (str, Mapping)) or not isinstance(values, Iterable):
        raise TypeError(f"{name}: got {values!r}, expected a sequence of values such as [{values!r}].")
    found = list(values)
    if not found:
        raise ValueError(f"{name}: got no values, expected at least one.")
    return found


def crossed(choices: Iterable[Choice], **axes: Sequence[Any] | None) -> list[dict[str, Any]]:
    """Every choice with every combination of the axes; what a choice says itself stands."""
    others = product(**axes)
    found = [{**more, **choice} for choice in _ways(choices) for more in others]
    return distinct(found)


def _ways(choices: Any) -> list[Choice]:
    found = _listed("choices", choices)
    for choice in found:
        if not isinstance(choice, Mapping):
            raise TypeError(f"choices: got {choice!r}, expected dictionaries of arguments such as "
                            "{'method': 'gimp'}.")
    return found


def distinct(choices: Iterable[Choice]) -> list[dict[str, Any]]:
    """The choices in their order, each of them once."""
    return list({key(choice): dict(choice) for choice in choices}.values())


def key(choice: Choice) -> str:
    """A text that tells choices apart, the same in every process."""
    return json.dumps({name: plain(value) for name, value in sorted(choice.items())}, sort_keys=True)


def plain(value: Any) -> Any:
    """A value as a file can hold it: numbers and texts as they are, other objects as what they say of themselves.

    Raises
    ------
    TypeError
        If an object says no more than where it lies in memory.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        return value.item()
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(each) for each in value]
    if isinstance(value, (set, frozenset)):
        return sorted(map(plain, value), key=repr)              # its own order is another one in every process
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        text = repr(value)                                      # arrays inside in full, or two would look the same
    if " at 0x" in text:
        raise TypeError(f"choices: got {text}, which says nothing that a table could hold; expected a name, a number, "
                        "or an object with a repr of its own, such as a dataclass.")
    return text


def label(choice: Choice) -> str:
    """A choice in a few words, such as ``gc, domains=stretched``; without the sizes.

    Examples
    --------
    >>> label({"method": "cmpm", "integration": "field", "cells": 20})
    'cmpm, integration=field'
    """
    rest = {name: plain(value) for name, value in choice.items() if name not in SIZES}
    words = [str(rest.pop("method"))] if "method" in rest else []
    return ", ".join(words + [f"{name}={value}" for name, value in rest.items()]) or "as it is"


def make_scene(make: Callable[..., Any], choice: Choice) -> tuple[Any, dict[str, Any]]:
    """The scene of a choice, and the arguments that are left for its run."""
    known = inspect.signature(make).parameters
    scene = make(**{name: value for name, value in choice.items() if name in known})
    return scene, {name: value for name, value in choice.items() if name not in known}


def changes(make: Callable[..., Any], choice: Choice, change: Choice) -> bool:
    """Whether a change of a choice makes another scene or run, defaults of the scene taken into account."""
    defaults = {name: each.default for name, each in inspect.signature(make).parameters.items()}
    return any(plain(choice.get(name, defaults.get(name))) != plain(value) for name, value in change.items()
               if value is not None or name in choice)
