"""What functions are called in files, the same in every process."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np


def name_of(function: Any) -> str:
    """Name of a function with the arguments it was given, the same in every process."""
    if isinstance(function, partial):
        with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
            given = [repr(value) for value in function.args]
            given += [f"{name}={value!r}" for name, value in sorted(function.keywords.items())]
        return f"{name_of(function.func)}({', '.join(given)})"
    if not hasattr(function, "__qualname__") or hasattr(function, "__self__"):
        return repr(function)
    module = sys.modules.get(function.__module__)
    script = getattr(module, "__file__", None) if function.__module__ == "__main__" else None
    return f"{Path(script).stem if script else function.__module__}.{function.__qualname__}"
