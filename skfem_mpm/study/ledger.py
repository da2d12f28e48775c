"""Rows by their number, and the file that keeps them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TextIO

from ..output import write_text

Row = dict[str, Any]


class Ledger:
    """Rows by number, kept as lines of JSON if there is a file.

    The first line says whose rows they are.  Rows are appended as they come, and a last line that was cut off is taken
    away when the file is opened again: whatever moment a study is killed at, every row that stood in the file is whole.
    :meth:`sort` puts them into the order of their numbers.

    Parameters
    ----------
    path
        The file, or ``None``.
    owner
        What the rows belong to; a file with another owner is refused.
    """

    def __init__(self, path: Path | None, owner: dict[str, Any]):
        self.path, self.owner = path, owner
        self.rows: dict[int, Row] = {}
        self._file: TextIO | None = None
        if path is not None:
            self._open(path)

    def _open(self, path: Path) -> None:
        if path.exists() and path.stat().st_size:
            whole = self._read(path)
            os.truncate(path, whole)
        else:
            self._write(path)
        self._file = open(path, "a", encoding="utf-8")

    def _read(self, path: Path) -> int:
        """Take the rows of a file; how many bytes of it are whole lines."""
        text = path.read_bytes()
        whole = text.rfind(b"\n") + 1
        head, *lines = text[:whole].splitlines() or [b""]
        self._check(path, _parsed(path, 1, head))
        for place, line in enumerate(lines, start=2):
            row = _parsed(path, place, line)
            self.rows.setdefault(row["number"], row)
        return whole

    def _check(self, path: Path, owner: Any) -> None:
        """Refuse the rows of another function, seed or version."""
        if not isinstance(owner, dict) or owner.keys() != self.owner.keys():
            raise ValueError(f"out: {path} does not begin as the file of an ensemble does; give another name.")
        for name, mine in self.owner.items():
            if owner[name] != mine:
                raise ValueError(f"out: the rows of {path} belong to {name} {owner[name]}, expected {mine}; give "
                                 "another file, or go on with what it belongs to.")

    def add(self, row: Row) -> None:
        """Keep a row; it is in the file when this returns."""
        self.rows[row["number"]] = row
        if self._file:
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()

    def sort(self) -> None:
        """Put the file into the order of the numbers."""
        if self.path is not None and list(self.rows) != sorted(self.rows):
            self._write(self.path)

    def release(self) -> None:
        """Close the file as it is."""
        if self._file:
            self._file.close()

    def _write(self, path: Path) -> None:
        """Write the whole file."""
        lines = [self.owner, *(self.rows[number] for number in sorted(self.rows))]
        write_text(path, "".join(json.dumps(line) + "\n" for line in lines))


def _parsed(path: Path, place: int, line: bytes) -> Any:
    try:
        found = json.loads(line)
    except ValueError:
        found = None
    if not isinstance(found, dict) or place > 1 and not isinstance(found.get("number"), int):
        raise ValueError(f"out: line {place} of {path} is no row of an ensemble; give another name, or take the line "
                         "away.")
    return found
