"""The command line: what it prints and writes, and what it answers to the shell."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.image import imread

from skfem_mpm import study
from skfem_mpm.__main__ import main

ROOT = Path(__file__).parents[1]
TINY = ["tradeoff", "cylinder", "--cells", "5,10", "--methods", "mpm,gc", "--steps", "1", "--repeats", "1",
        "--no-memory"]


def test_tradeoff_writes_a_table_and_a_picture_and_goes_on(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "new" / "results"
    assert main([*TINY, "--out", str(folder)]) == 0
    printed, errors = capsys.readouterr()
    assert sorted(path.name for path in folder.iterdir()) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]
    assert len(list(csv.DictReader((folder / "tradeoff.csv").open()))) == 4
    assert len(json.loads((folder / "tradeoff.json").read_text())["rows"]) == 4
    image = imread(folder / "tradeoff.png")
    assert min(image.shape[:2]) > 300 and image[..., :3].std() > 0.01
    table = printed.splitlines()
    assert "error_all" in table[0] and len(table) == 6 and "*" in printed and errors == ""
    monkeypatch.setattr(study.trade, "measured", None)              # whoever runs anything fails
    monkeypatch.setattr(study.trade, "timed", None)
    assert main([*TINY, "--out", str(folder)]) == 0 and capsys.readouterr().out == printed


def test_without_seconds_there_is_still_a_table(tmp_path, capsys):
    assert main([*TINY[:-3], "--repeats", "0", "--no-memory", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "tradeoff.png").exists() and "gc" in capsys.readouterr().out


def test_quick_leaves_what_is_said(monkeypatch, tmp_path):
    asked = {}

    def stops(scene, **axes):
        asked.update(axes)
        raise ValueError("enough")
    monkeypatch.setattr(study, "tradeoff", stops)
    main(["tradeoff", "cylinder", "--quick", "--per-cell", "3", "--steps", "2", "--domains", "fixed, stretched"])
    assert asked["steps"] == [2] and asked["cells"] == [10, 20] and asked["per_cell"] == [3] and asked["memory"]
    assert asked["domains"] == ["fixed", "stretched"] and "weights" not in asked


@pytest.mark.parametrize("more, message", [
    (["--quantity", "stress"], "quantity: got 'stress', expected one of 'point', 'all', 'inner'"),
    (["--methods", "magic"], "no run was done .*method: got 'magic'"),
    (["--repeats", "-1"], "repeats: got -1"), (["--cells", "0"], "no run was done")])
def test_what_the_library_refuses(tmp_path, capsys, more, message):
    assert main([*TINY, "--cells", "5", "--out", str(tmp_path), *more]) == 2
    printed = capsys.readouterr().err
    assert re.match(f"skfem-mpm: .*{message}", printed) and len(printed.splitlines()) == 1


def test_a_file_where_the_folder_should_be(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([*TINY, "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err


def test_interrupted(monkeypatch, capsys):
    def interrupt(*arguments, **more):
        raise KeyboardInterrupt
    monkeypatch.setattr(study, "tradeoff", interrupt)
    assert main(TINY) == 130 and "goes on" in capsys.readouterr().err


@pytest.mark.parametrize("arguments, message", [
    ([], "COMMAND"), (["tradeoff"], "scene"), (["tradeoff", "circle"], "invalid choice: 'circle'"),
    (["tradeoff", "cylinder", "--cells", "a,b"], "--cells: got 'a,b', expected whole numbers"),
    (["tradeoff", "cylinder", "--cells", "10,"], "--cells: got '10,'"),
    (["tradeoff", "cylinder", "--methods", "mpm,,gc"], "--methods: got 'mpm,,gc', expected names"),
    (["cheapest", "cylinder"], "--tolerance"), (["cheapest", "cylinder", "--tolerance", "some"], "invalid float"),
    (["cheapest", "cylinder", "--tolerance", "1", "--cost", "euros"], "invalid choice: 'euros'")])
def test_the_parser_says_what_it_wants(capsys, arguments, message):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("arguments, words", [(["--help"], ["tradeoff", "cheapest"]), (["tradeoff", "-h"], [
    "--methods", "--integrations", "--per-cell", "--quick", "--out"]), (["cheapest", "-h"], ["--tolerance", "--cost"])])
def test_help(capsys, arguments, words):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    printed = capsys.readouterr().out
    assert not stopped.value.code and all(word in printed for word in words)


FEW = study.Problem("cylinder", study.PROBLEMS["cylinder"].make, ({"method": "mpm", "dim": 1},), (4, 8), "all")


@pytest.mark.parametrize("tolerance, code", [("0.2", 0), ("1e-9", 1), ("-1", 2)])
def test_cheapest_answers_the_shell(monkeypatch, capsys, tmp_path, tolerance, code):
    monkeypatch.setitem(study.PROBLEMS, "cylinder", FEW)
    assert main(["cheapest", "cylinder", "--tolerance", tolerance, "--steps", "1", "--repeats", "1", "--out",
                 str(tmp_path)]) == code
    printed, errors = capsys.readouterr()
    assert {0: "mpm, dim=1, cells=4", 1: "not reachable: 1e-09", 2: "tolerance: got -1.0"}[code] in printed + errors


def test_help_imports_no_pictures_and_is_both_commands():
    code = ("import runpy, sys; sys.argv = ['skfem-mpm', '--help']\n"
            "try: runpy.run_module('skfem_mpm', run_name='__main__', alter_sys=True)\n"
            "finally: print(sorted({'matplotlib', 'tqdm', 'numba', 'meshio', 'multiprocessing.pool'}"
            "              & set(sys.modules)))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.startswith("usage: skfem-mpm") and done.stdout.endswith("[]\n")
    assert 'skfem-mpm = "skfem_mpm.__main__:main"' in (ROOT / "pyproject.toml").read_text()
