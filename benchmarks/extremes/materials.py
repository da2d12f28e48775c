"""Stiffness, density and strength far apart, and nearly no compression."""

TITLE = "Materials"
WORDS = """
"""


ROWS: list = []
