"""Rows of a study, in memory and in files that are whole at every moment."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import time
from collections.abc import Iterable, Mapping
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ..output import write_text

PACKAGES = ("skfem-mpm", "numpy", "scipy", "scikit-fem", "numba")
TIMES = ("setup_s", "wall_s", "cpu_s")
Row = dict[str, Any]


@cache
def versions() -> dict[str, str | None]:
    """Of the packages that the last bits of a result depend on; ``None`` of one that is not installed."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


@cache
def source() -> str:
    """What tells versions of this library apart, installed or not: a short digest of its files."""
    digest = sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def machine() -> dict[str, Any]:
    """What seconds depend on: machine, versions, threads; and the date."""
    return {"date": time.strftime("%Y-%m-%d %H:%M"), "machine": platform.machine(), "processor": _processor(),
            "system": platform.system(), "cores": os.cpu_count(), "python": platform.python_version(),
            "versions": dict(versions()), "source": source(), "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS")}


def _processor() -> str:
    """Name of the processor, as far as the system says it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:                     # no Linux
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")


def summary(row: Row) -> Row:
    """A row as a table shows it: one number in each column, times as median, least and most of their runs."""
    flat = {name: value for name, value in row.items() if name not in ("choice", "errors", "times")}
    flat = {**row["choice"], **flat, **{f"error_{name}": value for name, value in row["errors"].items()}}
    times = row["times"]
    flat["repeats"] = len(times)
    for name in TIMES:
        seconds = [each[name] for each in times] or [np.nan]
        flat[name] = float(np.median(seconds))
        if name != "setup_s":
            flat[f"{name}_least"], flat[f"{name}_most"] = min(seconds), max(seconds)
    work = row.get("points", np.nan) * row.get("steps_done", np.nan)
    flat["point_steps_per_s"] = work / flat["wall_s"] if times else np.nan
    return flat


class Store:
    """Rows by their key, kept in ``NAME.json`` and ``NAME.csv`` of a folder.

    Files are written when a hundred times the time a writing takes has passed since the last one: what is lost if the
    process is killed took no longer than that, and writing takes no more than a hundredth of the time.
    """

    def __init__(self, folder: str | Path | None, name: str, about: Mapping[str, Any]):
        self.about = dict(about)
        self.rows: dict[str, Row] = {}
        self._path = None if folder is None else Path(folder) / f"{name}.json"
        self._due = 0.0
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._path.exists():
                self._resume(self._path)

    def _resume(self, path: Path) -> None:
        """Take what an earlier study of the same scene on the same machine has found."""
        about, rows = read(path)
        for name, value in self.about.items():
            if name != "date" and about.get(name, value) != value:
                raise ValueError(f"out: got {path}, made with {name}={about.get(name)!r}, expected "
                                 f"{value!r} as now, for rows that are compared; give another folder.")
        self.about, self.rows = {**self.about, **about}, rows

    def save(self, late: bool = False) -> None:
        """Write the files, if it is time to (or ``late`` enough to do it anyway)."""
        start = time.perf_counter()
        if self._path is None or not (late or start >= self._due):
            return
        document = {"about": self.about, "rows": [_json(row) for row in self.rows.values()]}
        write_text(self._path, json.dumps(document, allow_nan=False))
        write_text(self._path.with_suffix(".csv"), table(map(summary, self.rows.values())))
        end = time.perf_counter()
        self._due = end + 100 * (end - start)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Row]]:
    """What a study is about, and its rows by key, from its file."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return document["about"], {row["key"]: _numbers(row) for row in document["rows"]}
    except (json.JSONDecodeError, KeyError, TypeError) as failure:
        raise ValueError(f"out: got {path}, which is no file of a study ({failure!r}); give another folder.") from None


def _json(value: Any) -> Any:
    """As strict JSON has it: what is not a number is null, what is infinite a text."""
    if isinstance(value, Mapping):
        return {name: _json(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json(each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None if np.isnan(value) else str(float(value))
    return value


def _numbers(row: Row) -> Row:
    """A row of a file, its errors floats again."""
    errors = {name: np.nan if value is None else float(value) for name, value in row["errors"].items()}
    return {**row, "errors": errors}


def table(rows: Iterable[Row]) -> str:
    """Rows as CSV; columns in order of their first appearance."""
    rows = list(rows)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
