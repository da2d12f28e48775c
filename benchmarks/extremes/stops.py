"""What goes wrong from outside: numbers that are none, no memory, an interrupt."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from extremes.bodies import FASTEST, LAW, block, grid_of, last, with_noise
from extremes.row import Row
from skfem_mpm import LinearElastic, NotConvergedError, OutsideGridError, UnstableError, explicit_steps, implicit_steps
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.explicit import run_before_its_start
from skfem_mpm.explicit.engine import make_run

TITLE = "Stops"
WORDS = """
Numbers that are none, no memory, an interrupt. Such runs have to stop, and at once; these rows
count what gets through.
"""
STEPS = (0, 1, 7)
ERRORS = (UnstableError, NotConvergedError, OutsideGridError)
ARRAYS = ("x", "volume", "mass", "length", "velocity", "sigma", "epsilon", "history", "slope")


def runs_of(choices):
    """Runs that have not begun, of a small block: small and finite strain, each with each engine."""
    body, mesh = with_noise(block(2, 3, shift=0.2), 1e-3), grid_of(2, 3)
    for more in ({}, {"strain": "logarithmic", "tpic": True, "flip": 0.0, "domains": "stretched"}):
        run = run_before_its_start(mesh, body, LAW[2], **choices, **more)
        yield run
        if FASTEST == "numba":
            yield make_run("numba", 1, mesh, run.last, LAW[2], run.choices)


def injected(choices, quick):
    """Injections that are not caught in the step in which they are made."""
    missed = 0
    for step in STEPS[1:2] if quick else STEPS:
        for value in (np.nan, np.inf, -np.inf):
            for name in ARRAYS:
                for run in runs_of(choices):
                    if getattr(run, name) is None or not np.size(getattr(run, name)):
                        continue
                    for _ in range(step):
                        run.advance()
                    spoiled = getattr(run, name).copy()
                    spoiled.flat[spoiled.size // 2] = value
                    setattr(run, name, spoiled)
                    missed += not is_caught(run)
    return float(missed)


def is_caught(run):
    """Whether a step raises one of the library's errors."""
    try:
        run.advance()
    except ERRORS:
        return True
    return False


@dataclass(frozen=True)
class Failing(LinearElastic):
    """A law whose answer fails after some calls: by numbers that are none, or by an error."""

    after: int = field(default=0, compare=False)                 # a run that goes on must not see another law
    failure: object = field(default=np.nan, compare=False)

    def update(self, strain, stress, history, components):
        calls[0] += 1
        sigma, history = LinearElastic.update(self, strain, stress, history, components)
        if calls[0] <= self.after:
            return sigma, history
        if isinstance(self.failure, type):
            raise self.failure("from outside")
        return np.full_like(sigma, self.failure), history


calls = [0]                                                      # of the law, in the run at hand


def explicit_run(law, choices, start=None, steps=6):
    body = with_noise(block(2, 3, shift=0.2), 1e-3)
    return explicit_steps(grid_of(2, 3), start or body, law, steps=steps, engine="numpy", **choices)


def implicit_run(law, choices, start=None, steps=3):
    planes = [FixedPlane(1, 0.0, -1, (0, 1))]
    return implicit_steps(grid_of(2, 3), start or block(2, 3), law, None if start else planes, steps=steps,
                          gravity=lambda step: (0.0, -1e-3 * step), **choices)


def until_it_fails(run, law, choices, errors):
    """The last state before the failure, and whether it came as one of ``errors``; none of it may be spoiled."""
    calls[0], state = 0, None
    try:
        for state in run(law, choices):
            if not np.isfinite(state.particles.sigma).all():
                return state, False
    except errors:
        return state, True
    return state, False


def law_without_numbers(choices, quick):
    """Runs in which a law that answers with numbers that are none is not told."""
    E, nu = LAW[2].E, LAW[2].nu
    return float(sum(not until_it_fails(run, Failing(E, nu, after, value), choices, ERRORS)[1]
                     for run in (explicit_run, implicit_run) for after in (1, 4)
                     for value in (np.nan, np.inf, -np.inf)))


def broken_off(choices, quick):
    """Runs broken off inside a step that do not go on, from their last state, as if nothing had happened."""
    E, nu, missed = LAW[2].E, LAW[2].nu, 0
    for run, steps in ((explicit_run, 6), (implicit_run, 3)):
        calls[0] = 0
        whole = last(run(Failing(E, nu, after=10 ** 9), choices))
        some = calls[0] * 2 // 3
        for error in (MemoryError, KeyboardInterrupt):
            state, told = until_it_fails(run, Failing(E, nu, some, error), choices, error)
            rest = last(run(Failing(E, nu, after=10 ** 9), choices, state, steps - state.step))
            missed += not told or any(not np.array_equal(getattr(rest.particles, name), getattr(whole.particles, name))
                                      for name in ("x", "sigma", "volume"))
    return float(missed)


WRITER = """
import json, resource, signal, sys
import numpy as np
from extremes.bodies import LAW, block, grid_of, with_noise
from skfem_mpm import explicit_steps
from skfem_mpm.output import write_text

body = with_noise(block(2, 3, shift=0.2), 1e-3)
hoard = []
signal.signal(signal.SIGINT, signal.default_int_handler)         # which jobs in the background ignore
for state in explicit_steps(grid_of(2, 3), body, LAW[2], steps=10**6, engine="numpy"):
    write_text(sys.argv[1], json.dumps([state.step] + state.particles.x.ravel().tolist() * 500))
    if state.step == 5:
        print("ready", flush=True)
        if sys.argv[2] == "memory":
            resource.setrlimit(resource.RLIMIT_AS, (2**29, 2**29))
    if state.step > 5 and sys.argv[2] == "memory":
        hoard.append(np.ones(2**21))
"""


def killed_while_writing(choices, quick):
    """Files that are not whole after their writer was killed, interrupted or ran out of memory."""
    broken = 0
    for how in ("kill", "interrupt", "memory")[:None if os.name == "posix" else 0] * (1 if quick else 3):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "states.json"
            path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
            child = subprocess.Popen([sys.executable, "-c", WRITER, str(file), how], stdout=subprocess.PIPE,
                                     stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": path})
            child.stdout.readline()
            if how != "memory":
                child.send_signal(signal.SIGKILL if how == "kill" else signal.SIGINT)
            child.wait()
            broken += child.returncode == 0 or json.loads(file.read_text())[0] < 5
            child.stdout.close()
    return float(broken)


NONE = {"holds": 0.0, "useless": 0.0}
ROWS = [
    Row("numbers that are none, in any array",
        """A nan or an infinity is put into each array of a running explicit run (positions, volumes, masses, domains,
        velocities, stresses, strains, slopes), in several steps, at small and finite strain, with each engine: how many
        times the same step did not end with an error that names the point.""",
        injected, **NONE),
    Row("a law that answers with numbers that are none",
        """The law of an explicit and of an implicit run answers so from some call on: how many runs did not stop, or
        yielded such a state.""",
        law_without_numbers, **NONE),
    Row("no memory, or an interrupt, within a step",
        """An explicit and an implicit run are broken off inside a step by a `MemoryError` and by a `KeyboardInterrupt`,
        and go on from the last state: how many do not end, bit for bit, as if nothing had happened.""",
        broken_off, **NONE),
    Row("killed while writing",
        """A run that writes a file after every step (`output.write_text`) is killed, interrupted, or runs out of
        memory: how many files are not whole.""",
        killed_while_writing, **NONE, methods=("mpm",)),
]
