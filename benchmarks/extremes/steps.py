"""Time steps: the bound, and shares of the exact limit."""

TITLE = "Time steps"
WORDS = """
"""


ROWS: list = []
