"""The rooms of the package and its habits, read from the source: imports look down, and no shortcuts."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "skfem_mpm"
FLOOR = {
    "checks": -1,
    "shapes": 0, "kinematics": 0, "materials": 0,
    "grid": 1, "locator": 1,
    "elements": 2, "particles": 2, "weights": 2,
    "basis": 3, "cover": 3, "kernels": 3, "output": 3, "plot": 3,
    "cautions": 4, "integration": 4, "boundary": 4, "support": 4, "ghost": 4,
    "implicit": 5, "explicit": 5,
    "scenes": 6,
    "study": 7, "stability": 7,
    "__main__": 8,
}  # fmt: skip
METHOD_NAMES = {"mpm", "gimp", "cmpm", "fe-gimp", "gc", "cmpm-c"}
HEAVY = {"numba", "meshio", "matplotlib", "tqdm"}
MAY_BE_HEAVY = {"kernels", "output", "plot", "__main__"}


def relative(path):
    return path.relative_to(ROOT)


def room_of(path):
    return relative(path).with_suffix("").parts[0]


MODULES = sorted(ROOT.rglob("*.py"))
ROOMS = sorted({room_of(path) for path in MODULES} - {"__init__"})
every_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: relative(path).as_posix())


def rooms_imported(source, package):
    """Rooms that the source of a module in ``package`` (a tuple of names) imports, at the top or inside functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) + 1 - node.level]) if node.level else []
            base += node.module.split(".") if node.module else []
            targets = [base + [alias.name] for alias in node.names]
        else:
            continue
        yield from (target[1] if len(target) > 1 else "__init__" for target in targets if target[0] == "skfem_mpm")


def nodes(path, *kinds):
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)]


def places(path, found):
    return [f"{relative(path)}:{node.lineno}" for node in found]


def code_lines(function, lines):
    """Lines of a function that are neither blank, nor comment, nor its docstring."""
    numbers = set(range(function.lineno, function.end_lineno + 1))
    if ast.get_docstring(function) is not None:
        numbers -= set(range(function.body[0].lineno, function.body[0].end_lineno + 1))
    texts = (lines[number - 1].strip() for number in numbers)
    return sum(bool(text) and not text.startswith("#") for text in texts)


def asks_which_method(node):
    if isinstance(node, ast.MatchValue):
        return isinstance(node.value, ast.Constant) and node.value.value in METHOD_NAMES
    words = {part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)}
    sides = [node.left, *node.comparators]
    names = {getattr(side, "id", getattr(side, "attr", "")) for side in sides}
    return bool(words & METHOD_NAMES) or bool(words and "method" in names)


def test_the_import_reader_sees_every_way_to_import():
    source = ("import numpy\nimport skfem_mpm.grid\nfrom skfem_mpm.basis import A\nfrom skfem_mpm import study\n"
              "def f():\n"
              "    from ..shapes import b\n    from .. import plot\n    from . import c\n    from .d import e\n")
    found = list(rooms_imported(source, ("skfem_mpm", "kernels")))
    assert found == ["grid", "basis", "study", "shapes", "plot", "kernels", "kernels"]


def test_every_room_is_in_the_plan():
    assert set(ROOMS) <= set(FLOOR), "a new room: give it a floor in tests/test_layers.py and in docs/decisions.md"


@every_module
def test_modules_import_only_from_lower_floors(path):
    room = room_of(path)
    if room == "__init__":
        return
    for name in rooms_imported(path.read_text(), ("skfem_mpm", *relative(path).parts[:-1])):
        assert name in FLOOR, f"{relative(path)} imports skfem_mpm.{name}, which is no room of its own"
        assert name == room or FLOOR[name] < FLOOR[room], f"{relative(path)} must not import {name}: not a lower floor"


@every_module
def test_only_basis_knows_which_method_it_is(path):
    if room_of(path) != "basis":
        assert not places(path, filter(asks_which_method, nodes(path, ast.Compare, ast.MatchValue)))


@every_module
def test_no_assert_in_the_package(path):
    assert not places(path, nodes(path, ast.Assert))


@every_module
def test_no_catch_all(path):
    found = [node for node in nodes(path, ast.ExceptHandler) if node.type is None or any(
        getattr(part, "id", "") in ("Exception", "BaseException") for part in ast.walk(node.type))]
    assert not places(path, found)


@every_module
def test_only_the_command_line_prints(path):
    if room_of(path) != "__main__":
        assert not places(path, [node for node in nodes(path, ast.Call) if getattr(node.func, "id", "") == "print"])


@every_module
def test_functions_fit_on_a_screen(path):
    lines = path.read_text().splitlines()
    sizes = {f"{relative(path)}:{node.lineno} {node.name}": code_lines(node, lines)
             for node in nodes(path, ast.FunctionDef, ast.AsyncFunctionDef)}
    assert not {name: size for name, size in sizes.items() if size > 40}


@every_module
def test_modules_are_short(path):
    assert len(path.read_text().splitlines()) <= 450, "make it a folder of the same name, one noun per file"


def test_nothing_heavy_is_imported_before_it_is_needed():
    names = ["skfem_mpm"] + [f"skfem_mpm.{room}" for room in ROOMS if room not in MAY_BE_HEAVY]
    code = ("import importlib, sys\n"
            f"for name in {names}:\n"
            "    importlib.import_module(name)\n"
            f"    loaded = sorted({HEAVY} & set(sys.modules))\n"
            "    if loaded: sys.exit(f'import {name} imports {loaded}')\n")
    child = subprocess.run([sys.executable, "-c", code], cwd=ROOT.parent, capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
