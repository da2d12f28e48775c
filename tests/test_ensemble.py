"""Ensembles: each realisation exactly once, with the same numbers, whatever happens to workers and to the study."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import fake_scenes
import numpy as np
import pytest
import realisations
from numpy.testing import assert_equal

from skfem_mpm.study import ensemble, load, tradeoff
from skfem_mpm.study.processes import Processes

COUNT = 24
STUDY = """
import signal
from functools import partial
from realisations import slow
from skfem_mpm.study import ensemble

signal.signal(signal.SIGINT, signal.default_int_handler)        # what runs in the background may have it ignored

if __name__ == "__main__":
    ensemble(partial(slow, folder={folder!r}, seconds=0.05), 60, seed=5, out={out!r}, workers=2)
    print("done")
"""


@pytest.fixture(scope="module")
def threads():
    with ThreadPoolExecutor(2) as pool:
        yield pool


def serial(function, count, seed=0):
    """What an ensemble is: numpy's spawned children, one after the other."""
    children = np.random.SeedSequence(seed).spawn(count)
    return [{"number": number, "status": "finished", **function(number, np.random.default_rng(child))}
            for number, child in enumerate(children)]


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def evaluated(folder):
    """How often each realisation was evaluated to the end."""
    return Counter(int(mark.name.split("-")[0]) for mark in Path(folder).iterdir() if mark.name[0].isdigit())


def alive(pid):
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(holds, seconds=60):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


# The same numbers.

@pytest.mark.parametrize("workers", [1, 2, 3])
def test_rows_do_not_depend_on_the_number_of_workers(workers):
    rows = ensemble(realisations.draw, COUNT, seed=7, workers=workers)
    assert rows == serial(realisations.draw, COUNT, seed=7)
    assert len({row["first"] for row in rows}) == COUNT


def test_rows_are_those_of_threads_too(threads):
    assert ensemble(realisations.draw, COUNT, seed=7, executor=threads) == serial(realisations.draw, COUNT, seed=7)


def test_rows_are_those_of_a_larger_ensemble(threads):
    assert ensemble(realisations.draw, 9, executor=threads) == serial(realisations.draw, COUNT)[:9]


def test_another_seed_gives_other_numbers(threads):
    first, second = (ensemble(realisations.draw, 5, seed=seed, executor=threads) for seed in (1, 2))
    assert all(a["first"] != b["first"] for a, b in zip(first, second))


def test_a_given_pool_of_processes_stays_open():
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for _ in range(2):
            assert ensemble(realisations.draw, 4, executor=pool) == serial(realisations.draw, 4)


class LastFirst(Executor):
    """Ends what it was given in reverse order, as soon as ``size`` calls have gathered or none is left to come."""

    def __init__(self, size, total):
        self.size, self.left, self.waiting, self.most = size, total, [], 0

    def submit(self, fn, *args):
        future = Future()
        self.waiting.append((future, fn, args))
        self.left -= 1
        self.most = max(self.most, len(self.waiting))
        if len(self.waiting) == self.size or not self.left:
            while self.waiting:
                ended, fn, args = self.waiting.pop()
                ended.set_result(fn(*args))
        return future


def test_rows_and_lines_are_in_order_whatever_ends_first(tmp_path):
    out = tmp_path / "rows.jsonl"
    rows = ensemble(realisations.draw, COUNT, executor=LastFirst(5, COUNT), ahead=5, out=out)
    assert rows == serial(realisations.draw, COUNT) == lines(out)[1:]


def test_few_are_handed_out_at_a_time():
    executor = LastFirst(3, 50)
    ensemble(realisations.draw, 50, executor=executor, ahead=3)
    assert executor.most == 3


# Failures.

def test_a_realisation_that_fails_is_a_row_with_the_reason(threads, tmp_path):
    for _ in range(2):                                      # the second one reads the file
        rows = ensemble(realisations.stops, 7, executor=threads, out=tmp_path / "rows.jsonl")
        names = ["NotConvergedError", "UnstableError", "OutsideGridError", "ZeroDivisionError", "FloatingPointError"]
        assert [row["status"] for row in rows[:5]] == [f'{name}: at {k},\nand "so" on' for k, name in enumerate(names)]
        assert all(set(row) == {"number", "status"} for row in rows[:5])
        assert rows[5:] == [{"number": k, "status": "finished", **realisations.draw(k, rng(k))} for k in (5, 6)]


def rng(number, seed=0):
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(number + 1)[number])


def test_an_error_of_the_program_ends_the_ensemble_and_keeps_what_is_done(tmp_path):
    out = tmp_path / "rows.jsonl"
    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyError, match="nothing"):
        ensemble(realisations.wrong, COUNT, executor=pool, ahead=1, out=out)
    assert lines(out)[1:] == serial(realisations.draw, 3)


@pytest.mark.parametrize("what, message", [
    ([1.0], "got a list from it"), (None, "got a NoneType"), ({"x": [1.0]}, r"got \[1.0\] as x"),
    ({"x": "1"}, "got '1' as x"), ({"x": 1j}, "as x"), ({"status": 1.0}, "name 'status'"), ({3: 1.0}, "name 3"),
    ({"number": 1.0}, "name 'number'")])
def test_a_function_gives_a_dict_of_numbers(threads, what, message):
    with pytest.raises(TypeError, match=message):
        ensemble(partial(realisations.gives, what=what), 2, executor=threads)


def test_numbers_of_any_kind_come_back_as_floats_to_the_last_bit(threads, tmp_path):
    what = {"a": np.float32(0.1), "b": 3, "c": np.bool_(True), "d": np.pi, "e": -np.inf, "f": np.array(2.0)}
    for _ in range(2):
        row, = ensemble(partial(realisations.gives, what=what), 1, executor=threads, out=tmp_path / "rows.jsonl")
        assert {name: row[name] for name in what} == {name: float(value) for name, value in what.items()}
        assert all(type(row[name]) is float for name in what)


# Workers that die.

def test_a_worker_that_dies_once_costs_nothing(tmp_path):
    (tmp_path / "marks").mkdir()
    rows = ensemble(partial(realisations.kills_once, folder=tmp_path / "marks"), 10, workers=2,
                    out=tmp_path / "rows.jsonl")
    assert (tmp_path / "marks" / "died").exists()
    assert rows == serial(realisations.draw, 10) == lines(tmp_path / "rows.jsonl")[1:]


@pytest.mark.slow
def test_a_realisation_that_kills_every_worker_is_a_row_that_says_so():
    rows = ensemble(realisations.kills_always, 10, workers=2)
    assert rows[2]["number"] == 2 and "worker died" in rows[2]["status"] and len(rows[2]) == 2
    expected = serial(realisations.draw, 10)
    assert rows[:2] + rows[3:] == expected[:2] + expected[3:]


def test_a_given_pool_that_breaks_ends_the_ensemble_and_says_so():
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with pool, pytest.raises(RuntimeError, match="executor: it is broken"):
        ensemble(realisations.kills_always, 6, executor=pool)


def dask_client(local):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(n_workers=2, processes=True, threads_per_worker=1, dashboard_address=None,
                                       local_directory=str(local))
    return distributed.Client(cluster), cluster


def test_nothing_is_lost_when_a_worker_of_a_dask_cluster_is_killed(tmp_path):
    marks, out, done = tmp_path / "marks", tmp_path / "rows.jsonl", []
    marks.mkdir()
    client, cluster = dask_client(tmp_path)

    def kill(count, total):
        """Kill the worker that began last, once six are done: it is most likely in the middle of something."""
        done.append(count)
        if count == 6:
            last = max(marks.glob("pid-*"), key=lambda mark: mark.stat().st_mtime_ns)
            os.kill(int(last.name.split("-")[2]), signal.SIGKILL)

    with cluster, client:
        rows = ensemble(partial(realisations.notes_its_worker, folder=str(marks)), 20, seed=3, out=out,
                        executor=client.get_executor(), progress=kill)
    assert rows == serial(realisations.draw, 20, seed=3)
    assert lines(out)[1:] == rows and done == list(range(21))
    assert len({mark.name.split("-")[2] for mark in marks.glob("pid-*")}) >= 2


def test_an_untimed_study_loses_nothing_when_a_worker_of_a_dask_cluster_is_killed(tmp_path):
    client, cluster = dask_client(tmp_path / "cluster")
    axes = {"methods": ["mpm", "gimp", "gc"], "cells": [5, 10, 20, 40], "steps": [3], "repeats": 0}

    def killing(found):
        for count, each in enumerate(found):
            if count == 3:
                os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
            yield each

    with cluster, client:
        found = tradeoff("cylinder", **axes, executor=client.get_executor(), progress=killing, out=tmp_path)
    alone = tradeoff("cylinder", **axes, memory=False)
    for rows in (found.rows, load(tmp_path).rows):
        assert_equal([dict(row) for row in rows], [dict(row) for row in alone.rows])
    assert len(found.rows) == 12 and all(row["status"] == "done" for row in found.rows)


def test_a_run_of_an_untimed_study_that_kills_its_worker_is_a_row(tmp_path):
    with Processes(2) as processes:
        found = tradeoff(fake_scenes.make, ["mpm"], [5, 10], more={"how": ["is well", "dies"]}, repeats=0,
                         executor=processes)
    assert [row["status"] for row in found.rows] == ["done", "failed", "done", "failed"]
    assert all("worker died" in row["reason"] for row in found.rows[1::2])


class GivesUp(Executor):
    """Ends calls as Dask does after some deaths, the killer's and, when it is not alone, its neighbour's."""

    def __init__(self):
        self.calls = []

    def submit(self, fn, number, *alone):
        killed = pytest.importorskip("distributed").KilledWorker
        self.calls.append(number)
        future = Future()
        if number == 2 or number == 3 and not alone:
            future.set_exception(killed("task", None, 3))
        else:
            future.set_result(fn(number, *alone))
        return future


def test_what_dask_gives_up_is_tried_again_alone():
    rows, expected = ensemble(realisations.draw, 6, executor=(executor := GivesUp())), serial(realisations.draw, 6)
    assert "worker died" in rows[2]["status"] and len(rows[2]) == 2
    assert rows[:2] + rows[3:] == expected[:2] + expected[3:]
    assert executor.calls == [0, 1, 2, 3, 4, 5, 2, 3]


# Studies that die.

def start(tmp_path):
    """A study of 60 realisations in a process of its own, with the folder of its marks and its file."""
    folder, out, script = tmp_path / "marks", tmp_path / "rows.jsonl", tmp_path / "study_.py"
    folder.mkdir(exist_ok=True)
    script.write_text(STUDY.format(folder=str(folder), out=str(out)))
    path = os.pathsep.join([str(Path(__file__).parent), os.environ["PYTHONPATH"]])
    child = subprocess.Popen([sys.executable, str(script)], env={**os.environ, "PYTHONPATH": path},
                             stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    return child, folder, out


def workers_of(folder):
    return {int(mark.name.split("-")[1]) for mark in folder.iterdir()}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=["killed", "ctrl-c"])
def test_a_study_that_was_stopped_goes_on_without_repeating_what_is_done(tmp_path, number):
    child, folder, out = start(tmp_path)
    wait_until(lambda: out.exists() and out.read_text().count("\n") > 10)
    time.sleep(np.random.default_rng().uniform(0, 0.2))     # any moment will do
    if number == signal.SIGINT:
        os.killpg(child.pid, number)                        # as a terminal does
    else:
        child.kill()
    printed, said = child.communicate(timeout=60)
    assert child.returncode != 0 and not printed
    wait_until(lambda: not any(map(alive, workers_of(folder))), 20)          # nobody works on
    assert number == signal.SIGKILL or "KeyboardInterrupt" in said
    text = out.read_text()
    before = [json.loads(line)["number"] for line in text[:text.rfind("\n")].splitlines()[1:]]
    assert 10 <= len(before) < 60

    with ThreadPoolExecutor(2) as pool:                     # whoever goes on with it
        rows = ensemble(partial(realisations.slow, folder=str(folder), seconds=0.05), 60, seed=5, out=out,
                        executor=pool)
    assert rows == lines(out)[1:] == serial(realisations.draw, 60, seed=5)
    times = evaluated(folder)
    assert set(times) == set(range(60)) and all(times[k] == 1 for k in before)
    assert sum(times.values()) <= 60 + 4                    # what was handed out, and had no row yet, is done again


def test_a_file_cut_off_anywhere_is_gone_on_with(threads, tmp_path):
    out, whole = tmp_path / "rows.jsonl", tmp_path / "whole.jsonl"
    rows = ensemble(realisations.draw, 2, executor=threads, out=whole)
    text = whole.read_bytes()
    for end in range(text.index(b"\n") + 1, len(text) + 1):
        out.write_bytes(text[:end])
        done = []
        found = ensemble(realisations.draw, 2, executor=threads, out=out, progress=lambda n, count: done.append(n))
        assert found == rows and out.read_bytes() == text
        assert done == list(range(text[:end].count(b"\n") - 1, 3))


def test_an_empty_file_is_begun_and_a_half_written_head_is_refused(threads, tmp_path):
    out = tmp_path / "rows.jsonl"
    out.touch()
    rows = ensemble(realisations.draw, 2, executor=threads, out=out)
    text = out.read_bytes()
    out.write_bytes(text[:30])
    with pytest.raises(ValueError, match="out: line 1 of .* is no row"):
        ensemble(realisations.draw, 2, executor=threads, out=out)
    assert out.read_bytes() == text[:30] and len(rows) == 2


def test_a_finished_ensemble_evaluates_nothing_and_a_larger_one_only_what_is_new(tmp_path):
    marks = tmp_path / "marks"
    marks.mkdir()
    function, out = partial(realisations.slow, folder=str(marks), seconds=0.0), tmp_path / "rows.jsonl"
    with ThreadPoolExecutor(2) as pool:
        for count in (6, 6, 9, 4):
            assert ensemble(function, count, executor=pool, out=out) == serial(realisations.draw, count)
    assert evaluated(marks) == dict.fromkeys(range(9), 1)
    assert ensemble(function, 9, out=out) == serial(realisations.draw, 9)            # no processes for nothing
    assert [row["number"] for row in lines(out)[1:]] == list(range(9))


# Whose file it is.

@pytest.mark.parametrize("change, message", [
    (dict(function=realisations.stops), "function realisations.draw, expected realisations.stops"),
    (dict(seed=1), "seed 0, expected 1"),
    (dict(function=partial(realisations.draw)), r"expected realisations.draw\(\)")])
def test_a_file_of_another_function_or_seed_is_refused(threads, tmp_path, change, message):
    out = tmp_path / "rows.jsonl"
    ensemble(realisations.draw, 2, executor=threads, out=out)
    text = out.read_bytes()
    with pytest.raises(ValueError, match=f"out: .*{message}"):
        ensemble(**{"function": realisations.draw, "count": 2, "executor": threads, "out": out, **change})
    assert out.read_bytes() == text


@pytest.mark.parametrize("factor", [2.0000000001, np.array([1.0, 3.0]), np.r_[np.zeros(5000), 1.0]],
                         ids=["digit", "array", "long array"])
def test_other_arguments_make_another_function(threads, tmp_path, factor):
    out, usual = tmp_path / "rows.jsonl", np.zeros(5001) if np.size(factor) > 2 else 2.0
    ensemble(partial(realisations.scaled, factor=usual), 2, executor=threads, out=out)
    with pytest.raises(ValueError, match="belong to function"):
        ensemble(partial(realisations.scaled, factor=factor), 2, executor=threads, out=out)


def test_the_file_says_whose_rows_it_has(threads, tmp_path):
    out = tmp_path / "rows.jsonl"
    ensemble(partial(realisations.scaled, factor=2.0, by=1.0), 2, seed=4, executor=threads, out=out)
    head = lines(out)[0]
    assert head["function"] == "realisations.scaled(by=1.0, factor=2.0)" and head["seed"] == 4
    assert head["versions"]["numpy"] == np.__version__
    head["versions"]["numpy"] = "1.0"
    out.write_text(json.dumps(head) + "\n")
    with pytest.raises(ValueError, match="versions"):
        ensemble(partial(realisations.scaled, factor=2.0, by=1.0), 2, seed=4, executor=threads, out=out)


@pytest.mark.parametrize("text", ["number,x\n0,1.0\n", "{}\n", "[]\n", "\n", "words"])
def test_files_of_others_are_left_alone(threads, tmp_path, text):
    out = tmp_path / "rows.csv"
    out.write_text(text)
    with pytest.raises(ValueError, match="out: "):
        ensemble(realisations.draw, 2, executor=threads, out=out)
    assert out.read_text() == text


def test_a_line_that_is_no_row_is_named(threads, tmp_path):
    out = tmp_path / "rows.jsonl"
    ensemble(realisations.draw, 2, executor=threads, out=out)
    out.write_text(out.read_text() + "\nnonsense\n")
    with pytest.raises(ValueError, match="out: line 4 of .* take the line"):
        ensemble(realisations.draw, 2, executor=threads, out=out)


# The door.

@pytest.mark.parametrize("change, message", [
    (dict(function=3), "function: got 3"), (dict(count=0), "count: got 0"), (dict(count=2.0), "count: got 2.0"),
    (dict(seed=-1), "seed: got -1"), (dict(seed=None), "seed: got None"), (dict(workers=0), "workers: got 0"),
    (dict(ahead=0), "ahead: got 0"), (dict(executor=3), "executor: got a int, expected .*get_executor"),
    (dict(executor=LastFirst(1, 1), workers=2), "workers: got 2 with an executor"),
    (dict(progress=True), "progress: got True"),
    (dict(function=lambda number, rng: {}), "function: got .* cannot be sent to processes")])
def test_bad_input_is_refused_before_anything_is_done(change, message, tmp_path):
    out = tmp_path / "rows.jsonl"
    with pytest.raises((TypeError, ValueError), match=message):
        ensemble(**{"function": realisations.draw, "count": 2, "out": out, **change})
    assert not out.exists()


def test_a_function_without_a_lasting_name_has_no_file(threads, tmp_path):
    function = partial(realisations.gives, what=object())
    with pytest.raises(ValueError, match="function: got .* another name next time"):
        ensemble(function, 2, executor=threads, out=tmp_path / "rows.jsonl")


def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text("from realisations import draw\nfrom skfem_mpm.study import ensemble\n"
                      "ensemble(draw, 2, workers=1)\n")
    path = os.pathsep.join([str(Path(__file__).parent), os.environ["PYTHONPATH"]])
    done = subprocess.run([sys.executable, str(script)], env={**os.environ, "PYTHONPATH": path}, text=True, timeout=60,
                          capture_output=True)
    assert done.returncode == 1 and "if __name__ ==" in done.stderr.splitlines()[-1]
