"""Implicit steps: small cuts, steps that are too large, systems without an answer."""

TITLE = "Equilibrium"
WORDS = """
"""


ROWS: list = []
