"""What holds for every test, and how tests are shared among workers (pytest-xdist)."""

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# Child processes (examples, the command line) run the same code as the tests: this checkout.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")           # there is a worker for every core

# The same examples on every run; and no test fails for being slow, compiling as it may be.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_configure(config):
    """The folder of what examples write belongs to the whole session: workers run each example once between them."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory()
        config.add_cleanup(folder.cleanup)
        os.environ["RUNS_OF_EXAMPLES"] = folder.name


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """One process when only files are named: workers would take longer to start than most files to run."""
    return 0 if all(Path(name.split("::")[0]).is_file() for name in config.args) else None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file goes to one worker, as its tests share what they compute; but runs of examples go to any."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Units(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return nodeid if "test_an_example_runs" in nodeid else super()._split_scope(nodeid)

    return Units(config, log)


def pytest_collection_modifyitems(config, items):
    """Slow tests first, so that no worker is left with a long one at the end."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: "slow" not in item.keywords)


def pytest_sessionfinish(session):
    """A test that was skipped in CI has not been passed."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("CI") and reporter and reporter.stats.get("skipped"):
        reporter.write_line("\nCI: skipped tests count as failures", red=True)
        session.exitstatus = session.exitstatus or 1
