"""Long runs and many crossings."""

TITLE = "Long runs"
WORDS = """
"""


ROWS: list = []
