"""Stretch, compression, shear and rotation far beyond the usual; the axis of rings."""

TITLE = "Large deformation"
WORDS = """
"""


ROWS: list = []
