"""Units and origins: scenes that are scaled and moved."""

TITLE = "Units and origins"
WORDS = """
"""


ROWS: list = []
