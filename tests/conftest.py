"""What holds for every test."""

import os
from pathlib import Path

from hypothesis import settings

# Child processes (examples, the command line) run the same code as the tests: this checkout.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
os.environ.setdefault("MPLBACKEND", "Agg")

# The same examples on every run; and no test fails for being slow, compiling as it may be.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_sessionfinish(session):
    """A test that was skipped in CI has not been passed."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("CI") and reporter and reporter.stats.get("skipped"):
        reporter.write_line("\nCI: skipped tests count as failures", red=True)
        session.exitstatus = session.exitstatus or 1
