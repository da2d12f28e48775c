"""Runs stop with a clear word where a limit is passed; guards are relaxed by name, and never silently."""

import inspect
import re
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from shared import both_engines
from skfem import MeshLine, MeshQuad

from skfem_mpm import (
    Hencky,
    LinearElastic,
    NotConvergedError,
    OutsideGridError,
    Particles,
    UnstableError,
    VonMises,
    explicit_steps,
    implicit_steps,
    plane_strain,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.explicit.prepare import prepare
from skfem_mpm.implicit.guards import respond
from skfem_mpm.kinematics import Logarithmic

ELASTIC, BAR = LinearElastic(E=100.0, nu=0.3), LinearElastic(E=1.0, nu=0.0)
SOIL = VonMises(E=100.0, nu=0.3, peak=2.0, residual=0.5, softening=-5.0)
FLOOR = [FixedPlane(1, 0.0, -1, (0, 1), name="floor")]
DOWN = (0.0, -1.0)
ARRAYS = ("x", "volume", "mass", "length", "velocity", "sigma", "epsilon", "history", "slope")
CHOICES = {name: each.default for name, each in inspect.signature(explicit_steps).parameters.items()
           if each.kind is each.KEYWORD_ONLY and name not in ("steps", "every", "every_seconds")}
MIDDLE = 21                                     # a point inside the block, in which a number goes wrong


class Own(VonMises):
    """A law that no kernel knows."""


def block():
    """A soft block on a floor that is sheared and squeezed."""
    axis = np.arange(-1, 6) * 0.25
    body = Particles.fill(MeshQuad.init_tensor(axis[1:-1], axis[1:-1]), plane_strain, where=lambda x: x[1] < 1)
    velocity = np.stack([0.3 * body.x[1], -0.2 * body.x[1] * (1 + body.x[0])])
    return MeshQuad.init_tensor(axis, axis), replace(body, velocity=velocity)


def prepared(law=SOIL, **choices):
    mesh, body = block()
    return prepare(mesh, body, law, FLOOR, **CHOICES | {"gravity": DOWN, "damping": 0.1} | choices)


def listed(action, run):
    """All states of a run, whose warnings are no news or errors."""
    with warnings.catch_warnings():
        warnings.simplefilter(action)
        return list(run)


quiet, strict = partial(listed, "ignore"), partial(listed, "error")


# -- finite numbers ----------------------------------------------------------------------------------------------------

def injected(name, wrong, after, **choices):
    """The error of a step before which a number has gone wrong; none if there is no such array."""
    run = prepared(**choices)
    for _ in range(after):
        run.advance()
    array = getattr(run, name)
    if array is None or not array.size:
        return None
    array, at = array.copy(), np.flatnonzero(run.order == MIDDLE)[0] if run.engine == "numba" else MIDDLE
    array[..., at] = wrong
    setattr(run, name, array)
    with pytest.raises((UnstableError, OutsideGridError)) as caught:
        run.advance()
    return str(caught.value)


@both_engines
@pytest.mark.parametrize("choices", [
    {"method": "mpm"}, {"method": "mpm", "integrator": "usf", "flip": 0.9}, {"method": "gimp", "integrator": "usl"},
    {"method": "gimp", "tpic": True, "flip": 0.0}, {"method": "cmpm-c", "remedy": "bbar"},
    {"method": "gimp", "domains": "stretched", "xpic": 2}, {"method": "mpm", "integration": "twin"},
    {"method": "mpm", "strain": "logarithmic"}, {"method": "mpm", "law": Own(**vars(SOIL))}], ids=repr)
def test_a_number_that_is_not_finite_is_caught_within_the_step(engine, choices):
    seen = 0
    for name in ARRAYS:
        for wrong, after in ((np.nan, 0), (np.nan, 2), (np.inf, 1), (-np.inf, 1)):
            message = injected(name, wrong, after, engine=engine, **choices)
            if message is not None:
                point = MIDDLE if name in ("x", "mass", "length") else r"\d+"
                assert re.match(rf"step {after + 1}: point {point} at \(.*(no longer finite|inside out)", message), name
                seen += 1
    assert seen >= 4 * 6                            # every run has x, volume, mass, length, velocity and sigma


@pytest.mark.parametrize("name", ["sigma", "velocity", "history", "volume"])
def test_both_engines_say_the_same_of_it(name):
    said = [injected(name, np.nan, 1, engine=engine) for engine in ("numpy", "numba")]
    assert said[0] == said[1]


@both_engines
def test_what_is_not_finite_is_never_yielded(engine):
    for name in ("x", "volume", "velocity", "sigma", "history"):
        run = prepared(engine=engine)
        run.advance()
        array = getattr(run, name).copy()
        array[..., MIDDLE] = np.nan
        setattr(run, name, array)
        with pytest.raises(UnstableError, match=f"^step 1: .*{name} that is no longer finite: nan"):
            run.snapshot()


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_tangent_that_is_not_finite_is_refused(wrong):
    class Loose(LinearElastic):
        def tangent(self, strain, stress, history, places):
            moduli = super().tangent(strain, stress, history, places) * np.ones(strain.shape[1])
            moduli[..., 3] = wrong
            return moduli

    mesh, body = block()
    for dt in (None, 1e-3):
        with warnings.catch_warnings(), pytest.raises(ValueError, match="tangent of the law"):
            warnings.simplefilter("error")
            list(explicit_steps(mesh, body, Loose(100.0, 0.3), steps=1, dt=dt))


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_planes_and_walls_without_a_place_or_an_increment_are_refused(wrong):
    mesh, body = block()
    with pytest.raises(ValueError, match="^at: got"):
        quiet(explicit_steps(mesh, body, ELASTIC, [FixedPlane(1, wrong, -1)], steps=1))
    with pytest.raises(ValueError, match="^wall: got"):
        Wall(np.array([[wrong], [0.5]]), (0.1, None))
    with pytest.raises(ValueError, match="^increment: got"):
        Wall(np.array([[0.5], [0.5]]), (wrong, None))


@both_engines
def test_messages_name_value_limit_and_cure(engine):
    mesh, body = block()
    fast = replace(body, velocity=body.velocity + np.array([[3.0], [0.0]]))
    with pytest.raises(UnstableError, match=r"^step 1: point 0 at \(.* moves 0\.3\d* along axis 0 in one step, more "
                       r"than a cell of 0\.25; .*shorter time step \(it was 0\.1\)"):
        quiet(explicit_steps(mesh, fast, ELASTIC, steps=1, dt=0.1, engine=engine))
    with pytest.raises(UnstableError, match=r"^step 1: point \d+ at \(.* turned inside out: -.*, expected more than "
                       "zero; .*shorter time step"):
        crushed = replace(body, velocity=np.array([[-20.0], [0.0]]) * (body.x - 0.5))
        quiet(explicit_steps(mesh, crushed, ELASTIC, steps=1, dt=0.1, engine=engine, guards={"moved": "off"}))


def test_a_point_squeezed_flat_to_rounding_is_named():
    """Its volume is above zero, its logarithmic strain is not finite."""
    zero, x = np.zeros((3, 1)), np.array([[0.5]])
    motion = Logarithmic(uniaxial, 1, Hencky(E=1.0, nu=0.0), zero, zero)
    with np.errstate(all="raise"):
        response, trouble = respond(motion, np.array([[-1 + 1e-9]]), x)
    assert response is None and re.match(r"point 0 at \(0.5\) has a \w+ that is not finite", trouble)


# -- energy ------------------------------------------------------------------------------------------------------------

def bar(cells=20, spare=60, **arrays):
    body = Particles.fill(MeshLine(np.linspace(0.1, 1.1, cells + 1)), uniaxial)
    made = {name: make(body.x) for name, make in arrays.items()}
    return MeshLine((np.arange(-1, cells + spare + 1) - 0.24) / cells), replace(body, **made)


def trembling(speed, size=1e-3):
    noise = np.random.default_rng(7).uniform(-size, size, (1, 40))
    return bar(velocity=lambda x: speed + noise - noise.mean())


@pytest.mark.parametrize("refresh", [1, 10 ** 6])
@pytest.mark.parametrize("speed", [0.0, 0.1])
def test_vibrations_that_grow_are_stopped_in_flight_as_at_rest(speed, refresh):
    """They have next to nothing of the energy of a flying body, and are stopped all the same."""
    mesh, body = trembling(speed)
    said = r"^step \d+: point \d+ .*more than 10 times the energy .*'cmpm-c'"
    with pytest.raises(UnstableError, match=said) as caught:
        for state in explicit_steps(mesh, body, BAR, method="cmpm", steps=1000, every=10, refresh=refresh,
                                    safety=0.8, engine="numpy"):
            pass
    if speed:
        assert state is caught.value.state
        assert state.energy["kinetic"] + state.energy["elastic"] < 1.01 * state.energy["start"]


def test_energy_that_grows_is_told_once_before_it_stops_a_run():
    mesh, body = trembling(0.1)
    given = {"method": "cmpm", "safety": 0.8, "engine": "numpy", "every": 200}

    def told(steps, **more):
        with warnings.catch_warnings(record=True) as record:
            warnings.simplefilter("always")
            try:
                list(explicit_steps(mesh, body, BAR, steps=steps, **given, **more))
                stop = None
            except UnstableError as error:
                stop = int(re.match(r"step (\d+): .*more than 10 times", str(error))[1])
        texts = [str(each.message) for each in record]
        return [int(re.match(r"step (\d+)", text)[1]) for text in texts if "more than 2 times the" in text], stop

    (warned,), stop = told(1000)
    assert warned < stop
    assert told(stop, guards={"energy": "warn"}) == ([warned], None)
    assert told(stop, guards={"energy": "off"}) == ([], None)


@both_engines
def test_bodies_that_fall_land_and_swing_are_left_alone(engine):
    """From rest with no energy at all, to a speed at which rounding is all there is, to the floor, and swinging."""
    mesh, body = block()
    body = replace(body, velocity=None)
    high = MeshQuad.init_tensor(np.arange(-1, 6) * 0.25, np.arange(0, 80) * 0.25)
    falling = replace(body, x=body.x + np.array([[0.0], [10.0]]))
    states = strict(explicit_steps(high, falling, ELASTIC, steps=300, every=100, gravity=DOWN, engine=engine))
    assert states[-1].energy["peak"] < 1e-12 * states[-1].energy["external"]
    swung = strict(explicit_steps(mesh, body, ELASTIC, FLOOR, steps=300, every=2, gravity=DOWN, engine=engine))
    work = [state.energy["external"] for state in swung]
    assert min(work[50:]) < 0.5 * max(work) and 0 < swung[-1].energy["peak"] <= max(work) * (1 + 1e-12)
    near = replace(body, x=body.x + np.array([[0.0], [0.25]]), velocity=np.array([[0.0], [-2.0]]) * np.ones(body.n))
    mesh = MeshQuad.init_tensor(np.arange(-6, 11) * 0.25, np.arange(-1, 13) * 0.25)
    landed = strict(explicit_steps(mesh, near, ELASTIC, [FixedPlane(1, 0.0, -1)], steps=60, every=1, engine=engine))
    assert landed[-1].energy["peak"] > 0.1 * landed[-1].energy["start"]


@both_engines
def test_what_is_yielded_does_not_change_the_ledger(engine):
    mesh, body = block()
    given = {"gravity": DOWN, "engine": engine}
    rare = list(explicit_steps(mesh, body, SOIL, FLOOR, steps=120, every=120, **given))[-1]
    often = list(explicit_steps(mesh, body, SOIL, FLOOR, steps=120, every=7, **given))
    rest = list(explicit_steps(mesh, often[9], SOIL, steps=120 - often[9].step, every=11, **given))[-1]
    assert dict(rare.energy) == dict(often[-1].energy) == dict(rest.energy) and rare.energy["peak"] > 0


@pytest.mark.parametrize("law", [ELASTIC, SOIL], ids=["elastic", "soil"])
def test_the_kernels_of_the_guards_see_what_the_law_says(law):
    run, twin = prepared(law, engine="numba"), prepared(law, engine="numpy")
    for _ in range(30):
        run.advance()
        twin.advance()
    np.testing.assert_allclose(run._balance(), twin._balance(), rtol=1e-9)
    assert run._excess_of_yield() is None
    if law is SOIL:
        run.sigma = run.sigma + np.where(run.order == MIDDLE, 10.0, 0.0) * np.array([[0.0], [0.0], [0.0], [1.0]])
        with pytest.raises(UnstableError, match=rf"^step 30: point {MIDDLE} at \(.* beyond yield by"):
            run.snapshot()


def test_stress_whose_energy_nobody_knows_may_set_a_body_in_motion():
    class Mute(LinearElastic):
        energy_density = property()

    mesh, body = bar(sigma=lambda x: 0.01 * np.sin(2 * np.pi * x))
    state = strict(explicit_steps(mesh, body, Mute(1.0, 0.0), steps=200, every=10, engine="numpy"))[-1]
    assert state.energy["kinetic"] > 0 and np.isnan(state.energy["elastic"]) and np.isnan(state.energy["peak"])
    falling = strict(explicit_steps(mesh, replace(body, sigma=None), Mute(1.0, 0.0), steps=200, gravity=(0.01,),
                                    every=200, engine="numpy"))[-1]
    assert np.isfinite(falling.energy["peak"])


# -- yield -------------------------------------------------------------------------------------------------------------

class Sloppy(VonMises):
    """Its return mapping stops half way."""

    def update(self, strain, stress, history, components):
        after, memory = super().update(strain, stress, history, components)
        return (after + self.trial(strain, stress, components)) / 2, memory


@both_engines
@pytest.mark.parametrize("strain", ["small", "logarithmic"])
def test_a_return_mapping_that_has_not_converged_stops_a_run(engine, strain):
    mesh, body = block()
    given = {"steps": 100, "every": 10, "gravity": DOWN, "engine": engine, "strain": strain}
    strict(explicit_steps(mesh, body, SOIL, FLOOR, **given))
    broken = Sloppy(**vars(SOIL))
    said = r"point \d+ at \(.* beyond yield by [\d.e-]+ of the strength, expected at most 1e-06.*Sloppy\.update"
    with pytest.raises(UnstableError, match=rf"^step \d+: {said}"):
        list(explicit_steps(mesh, body, broken, FLOOR, **given))
    with pytest.warns(UserWarning, match=said) as record:
        list(explicit_steps(mesh, body, broken, FLOOR, guards={"yield": "warn"}, **given))
    assert len(record) == 1


def test_stress_beyond_yield_at_the_start_is_brought_back():
    mesh, body = block()
    sigma = np.zeros((4, body.n))
    sigma[3] = 10 * SOIL.peak
    for integrator in ("usf", "usl", "musl"):
        states = strict(explicit_steps(mesh, replace(body, sigma=sigma), SOIL, FLOOR, steps=3, integrator=integrator))
        assert SOIL.excess(states[0].particles.sigma, states[0].particles.history).max() < 1e-10


@pytest.mark.parametrize("strain", ["small", "logarithmic"])
def test_load_steps_watch_the_return_mapping_too(strain):
    mesh, body = block()
    given = {"steps": 2, "gravity": (0.0, -6.0), "strain": strain, "engine": "numpy", "tolerance": 1e-6}
    broken = Sloppy(**vars(SOIL))
    with pytest.raises(NotConvergedError, match=r"^step \d: point \d+ at \(.* beyond yield .*Sloppy\.update") as caught:
        states = []
        for state in implicit_steps(mesh, body, broken, FLOOR, **given):
            states.append(state)
    assert caught.value.state is states[-1] if states else caught.value.state.step == 0


# -- relaxing ----------------------------------------------------------------------------------------------------------

def steps_with(solver, guards):
    mesh, body = block()
    return solver(mesh, body, ELASTIC, FLOOR, steps=1, guards=guards)


@pytest.mark.parametrize("solver", [explicit_steps, implicit_steps])
@pytest.mark.parametrize("guards, error, text", [
    (["energy"], TypeError, "^guards: got a list, expected a mapping"),
    ("off", TypeError, "^guards: got a str, expected a mapping"),
    ({"finite": "off"}, ValueError, "^guards: got 'finite', which always holds: nothing sensible"),
    ({"positive": "warn"}, ValueError, "^guards: got 'positive', which always holds: a point"),
    ({"inside": "off"}, ValueError, "^guards: got 'inside', which always holds: .*leaving='remove'"),
    ({"energie": "off"}, ValueError, "^guards: got 'energie', expected one of .*'yield'"),
    ({3: "off"}, ValueError, "^guards: got 3, expected one of "),
    ({"yield": "no"}, ValueError, r"^guards\['yield'\]: got 'no', expected one of 'stop', 'warn', 'off'"),
    ({"yield": True}, ValueError, r"^guards\['yield'\]: got True, expected one of"),
], ids=str)
def test_what_is_no_guard_is_refused_at_the_door(solver, guards, error, text):
    with pytest.raises(error, match=text):
        steps_with(solver, guards)


def test_some_guard_must_hold():
    with pytest.raises(ValueError, match="^guards: got all of them 'off', expected at least one"):
        steps_with(explicit_steps, dict.fromkeys(("step", "moved", "energy", "yield"), "off"))
    with pytest.raises(ValueError, match=r"^guards\['converged'\]: got 'off', expected one of 'stop', 'warn'"):
        steps_with(implicit_steps, {"converged": "off"})


@pytest.mark.parametrize("solver", [explicit_steps, implicit_steps])
def test_a_guard_that_is_off_is_named_once_when_a_run_starts(solver):
    with pytest.warns(UserWarning, match="^guards: 'yield' off") as record:
        assert len(list(steps_with(solver, {"yield": "off"}))) == 1
    assert len(record) == 1 and record[0].filename == __file__
    strict(steps_with(solver, {"yield": "warn"}))


@both_engines
def test_points_may_move_further_than_a_cell_where_that_is_wanted(engine):
    _, body = block()
    mesh = MeshQuad.init_tensor(np.arange(-1, 40) * 0.25, np.arange(-1, 6) * 0.25)
    flying = replace(body, velocity=np.array([[3.0], [0.0]]) * np.ones(body.n))
    given = {"steps": 5, "every": 5, "dt": 0.1, "engine": engine}
    ends = []
    for what in ("warn", "off"):
        with pytest.warns(UserWarning) as record:
            ends.append(list(explicit_steps(mesh, flying, BAR, guards={"moved": what, "step": "off"}, **given))[-1])
        assert sum("more than a cell" in str(each.message) for each in record) == (what == "warn")
    np.testing.assert_allclose(ends[0].particles.x[0], body.x[0] + 1.5, rtol=1e-12)
    assert_array_equal(ends[0].particles.x, ends[1].particles.x)


def test_a_step_that_is_not_surely_stable_may_stop():
    mesh, body = block()
    with pytest.raises(UnstableError, match="^step 1: dt: got 1, above the step .*critical_step"):
        list(explicit_steps(mesh, body, ELASTIC, steps=1, dt=1.0, guards={"step": "stop"}))


# -- load steps --------------------------------------------------------------------------------------------------------

class Failing(LinearElastic):
    """Goes wrong at the call that is said, and from then on."""

    calls, bad, wrong = 0, 0, np.nan

    def update(self, strain, stress, history, components):
        type(self).calls += 1
        after, history = super().update(strain, stress, history, components)
        if self.calls < self.bad:
            return after, history
        if isinstance(self.wrong, type):
            raise self.wrong
        after[0, MIDDLE] = self.wrong
        return after, history


def failing(bad, wrong):
    return type("Broken", (Failing,), {"bad": bad, "wrong": wrong})(100.0, 0.3)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("choices", [{}, {"dt": 0.1}, {"scheme": "incremental", "strain": "small"}], ids=repr)
def test_a_law_that_answers_no_number_is_named_in_a_load_step(wrong, choices):
    mesh, body = block()
    for bad in range(1, 6):
        states = []
        said = rf"^step \d: .*point {MIDDLE} at \(.* has a sigma that is not finite"
        with pytest.raises(NotConvergedError, match=said) as caught:
            for state in implicit_steps(mesh, body, failing(bad, wrong), FLOOR, steps=9, gravity=DOWN, **choices):
                states.append(state)
        assert caught.value.state is states[-1] if states else caught.value.state.step == 0
        assert all(np.isfinite(state.particles.sigma).all() for state in states)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_number_that_is_wrong_only_once_is_no_equilibrium(wrong):
    """A force without bound at the start of a step makes every residual small beside it; the step comes in halves."""
    class Once(Failing):
        def update(self, strain, stress, history, components):
            type(self).bad = 1 if type(self).calls == 0 else 10 ** 9
            return super().update(strain, stress, history, components)

    Once.wrong, (mesh, body) = wrong, block()
    (state,) = implicit_steps(mesh, body, Once(100.0, 0.3), FLOOR, steps=1, gravity=DOWN)
    *_, good = implicit_steps(mesh, body, ELASTIC, FLOOR, steps=2, gravity=lambda step: (0.0, -step / 2))
    assert state.residuals[-1] < 1e-11 and state.cuts == 1
    assert_array_equal(state.particles.sigma, good.particles.sigma)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("scheme", ["equilibrated", "incremental"])
def test_moduli_solvers_and_loads_that_are_not_finite_are_caught(wrong, scheme):
    class Loose(LinearElastic):
        def tangent(self, strain, stress, history, places):
            return wrong * super().tangent(strain, stress, history, places)

    mesh, body = block()
    given = {"steps": 1, "gravity": DOWN, "scheme": scheme, "strain": "small"}

    def raising(A, b):
        raise RuntimeError("no")

    for law, choices in ((Loose(100.0, 0.3), {}), (ELASTIC, {"solver": lambda A, b: wrong * b}),
                         (ELASTIC, {"solver": raising})):
        with pytest.raises(NotConvergedError) as caught:
            quiet(implicit_steps(mesh, body, law, FLOOR, **given | choices))
        assert caught.value.state.step == 0
    with pytest.raises(ValueError, match=f"^gravity: got {wrong}"):
        list(implicit_steps(mesh, body, ELASTIC, FLOOR, **given | {"gravity": lambda step: (0.0, wrong)}))


def test_a_step_that_does_not_converge_may_be_taken_with_a_warning():
    """What it lacks is part of the next step: with room to converge, that one is in equilibrium."""
    mesh, body = block()
    given = {"gravity": (0.0, -20.0), "tolerance": 1e-13, "max_cuts": 0}

    class Rough(LinearElastic):
        def tangent(self, strain, stress, history, places):
            return 0.3 * super().tangent(strain, stress, history, places)

    with pytest.raises(NotConvergedError, match="after cutting it 0 times"):
        list(implicit_steps(mesh, body, Rough(100.0, 0.3), FLOOR, steps=1, **given))
    said = "^step 1: taken with a residual of .*, above the tolerance of 1e-13"
    with pytest.warns(UserWarning, match=said) as record:
        state = list(implicit_steps(mesh, body, Rough(100.0, 0.3), FLOOR, steps=1, guards={"converged": "warn"},
                                    **given))[-1]
    assert len(record) == 1 and state.residuals[-1] > 1e-13
    on = list(implicit_steps(mesh, state, ELASTIC, steps=1, gravity=(0.0, -20.0)))[-1]
    assert on.residuals[-1] < 1e-11


# -- interrupts --------------------------------------------------------------------------------------------------------

def copies(state):
    return {name: array.copy() for name, array in state.particles.arrays().items()}


@pytest.mark.parametrize("stop", [MemoryError, KeyboardInterrupt])
@pytest.mark.parametrize("kind", ["numpy", "numba", "implicit"])
def test_the_last_state_outlives_what_stops_a_run(stop, kind):
    mesh, body = block()

    def run(start, law, steps, planes=None):
        if kind == "implicit":
            return implicit_steps(mesh, start, law, planes, steps=steps, gravity=DOWN)
        return explicit_steps(mesh, start, law, planes, steps=steps, every=1, gravity=DOWN, engine=kind)

    law, states, held = failing(12, stop), [], []
    with pytest.raises(stop):
        for state in run(body, law, 12, FLOOR):
            states.append(state)
            held.append(copies(state))
    assert 0 < len(states) < 12
    for state, before in zip(states, held):
        for name, array in state.particles.arrays().items():
            assert not array.flags.writeable
            assert_array_equal(array, before[name])
    type(law).bad = 10 ** 9
    whole, rest = (list(run(start, law, 12 - done, planes))[-1]
                   for start, done, planes in ((body, 0, FLOOR), (states[-1], len(states), None)))
    for name, array in whole.particles.arrays().items():
        assert_array_equal(array, rest.particles.arrays()[name])
    if kind != "implicit":
        assert whole.energy == rest.energy


WRITER = """
import resource, signal, sys
import numpy as np
from skfem import MeshLine
from skfem_mpm import LinearElastic, Particles, explicit_steps, uniaxial
from skfem_mpm.output import write_text

signal.signal(signal.SIGINT, signal.default_int_handler)         # which jobs in the background ignore
grid = MeshLine(np.linspace(0, 2, 41))
bar = Particles.fill(MeshLine(np.linspace(0.5, 1, 11)), uniaxial)
out, limited = sys.argv[1], sys.argv[2] == "memory"
if limited:
    pages = int(open("/proc/self/statm").read().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 64 * 2 ** 20,) * 2)
lines = 2000
for state in explicit_steps(grid, bar, LinearElastic(1.0, 0.0), steps=10 ** 6, engine="numpy"):
    write_text(out, f"{state.step}\\n" * lines + "end\\n")
    print(state.step, flush=True)
    lines *= 1 + limited
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory and kills")
@pytest.mark.parametrize("how", ["memory", "kill", "interrupt"])
def test_the_last_written_file_is_whole(tmp_path, how):
    out = tmp_path / "state.txt"
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(out), how], stdout=subprocess.PIPE,
                             stderr=subprocess.PIPE, text=True)
    first = child.stdout.readline()
    if how != "memory":
        time.sleep(0.2)
        child.send_signal(signal.SIGKILL if how == "kill" else signal.SIGINT)
    said, errors = child.communicate(timeout=60)
    assert child.returncode and {"memory": "MemoryError", "kill": "", "interrupt": "KeyboardInterrupt"}[how] in errors
    printed = int((first + said).split()[-1])
    *steps, end = out.read_text().split("\n")[:-1]
    assert end == "end" and len(set(steps)) == 1 and int(steps[0]) in (printed, printed + 1)


# -- a state goes on with its own points ----------------------------------------------------------------------------

@pytest.mark.parametrize("count", [1, 30])
def test_a_state_does_not_take_what_is_of_other_points(count):
    """One acceleration would otherwise be that of all points, say."""
    mesh, body = block()
    fewer = body.where(np.arange(count))
    tilted = next(explicit_steps(mesh, body, SOIL, FLOOR, steps=1, tpic=True))
    swung = next(implicit_steps(mesh, body, ELASTIC, FLOOR, steps=1, dt=1e-3))
    with pytest.raises(ValueError, match=rf"slope: got that of {body.n} points in a state with {count}"):
        replace(tilted, particles=fewer)
    with pytest.raises(ValueError, match=rf"acceleration: got that of {body.n} points in a state with {count}"):
        replace(swung, particles=fewer)
    assert replace(tilted, particles=fewer, slope=None, order=None, kept=None).particles.n == count


@both_engines
def test_a_body_does_not_pass_a_plane_without_a_word(engine):
    """A plane that fixes the component along it only lets the body through, to where nodes are images."""
    if engine == "numba":
        pytest.importorskip("numba")
    axis = np.arange(-4.0, 5)
    body = Particles.fill(MeshQuad.init_tensor(axis, axis), plane_strain, where=lambda x: (x[1] > 0) & (x[1] < 2))
    body = replace(body, velocity=np.array([[0.0], [-0.2]]) * np.ones((1, body.n)))
    run = explicit_steps(MeshQuad.init_tensor(axis, axis), body, ELASTIC, [FixedPlane(1, 0.0, -1, (0,), "base")],
                         steps=200, every=200, dt=0.03, engine=engine)
    with pytest.raises(UnstableError, match="behind the plane 'base'.*normal component"):
        next(run)
