"""Files that are whole at every moment: the old one until the new one is complete."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: str | Path, text: str) -> None:
    r"""Write a file at once: whoever reads it, or kills the writer, finds the old text or the new one, never a part.

    Parameters
    ----------
    path
        The file; its folder must exist.
    text
        What it will hold, stored as UTF-8.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "table.csv"
    >>> write_text(file, "cells,error\n")
    >>> file.read_text(), [each.name for each in file.parent.iterdir()]
    ('cells,error\n', ['table.csv'])
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    with open(part, "w", encoding="utf-8", newline="\n") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())                 # or a power cut after the replacement leaves an empty file
    os.replace(part, path)
