"""What goes wrong from outside: numbers that are none, no memory, an interrupt."""

TITLE = "Stops"
WORDS = """
"""


ROWS: list = []
