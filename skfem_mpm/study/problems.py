"""The scenes that ship, ready to be studied: how to make them, and the choices and sizes that are worth a look."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from .. import scenes
from ..checks import check_choice
from ..materials import LinearElastic
from ..scenes.vertical_cut_reference import cut_reference
from .choices import Choice
from .names import name_of

STRETCHED = {"domains": "stretched"}


def exact(choice: Choice) -> Mapping[str, float]:
    """Nothing: the reference is a closed form."""
    return {}


@dataclass(frozen=True)
class Problem:
    """A scene to study.

    Attributes
    ----------
    name
        What tables call it.
    make
        A function that makes the scene; of its arguments those that a choice names are given to it.
    choices
        Ways to compute it that are worth a look.
    cells
        Values of ``cells`` to study; the first ones are the pilots of :func:`skfem_mpm.study.cheapest`.
    quantity
        The error that counts, if nothing else is said.
    simpler
        Smaller models by name, as arguments that make them.
    known
        Says of a choice how far the scene's reference may itself be off, by the name of the error; errors below cannot
        be told apart.
    spans
        Whether a run covers a span of time, in as many steps as the time step makes of it.
    """

    name: str
    make: Callable[..., Any]
    choices: tuple[Choice, ...] = ({"method": "mpm"}, {"method": "gimp"}, {"method": "cmpm-c"})
    cells: tuple[int, ...] = (10, 20, 40)
    quantity: str | None = None
    simpler: Mapping[str, Choice] = field(default_factory=dict)
    known: Callable[[Choice], Mapping[str, float]] = exact
    spans: bool = False


def column(cells: int = 16, per_cell: int = 2, dim: int = 1) -> scenes.SelfWeight:
    """:func:`skfem_mpm.scenes.column` by the number of cells along its height."""
    return scenes.column(0.8 / cells, per_cell=per_cell, dim=dim)


def cut(cells: int = 10, per_cell: int = 2, loading: str = "sudden") -> scenes.VerticalCut:
    """:func:`skfem_mpm.scenes.vertical_cut` by the number of cells along its height."""
    return scenes.vertical_cut(1 / cells, per_cell=per_cell, loading=loading)


def cut_known(choice: Choice) -> Mapping[str, float]:
    """How far the reference of the cut may itself be off."""
    return cut_reference(choice.get("loading", "sudden")).uncertainty()


PROBLEMS = {problem.name: problem for problem in (
    Problem("cylinder", scenes.cylinder,
            choices=({"method": "mpm"}, {"method": "mpm", "weights": "interior"}, {"method": "gimp"},
                     {"method": "gimp", "weights": "overlap"}, {"method": "gimp", **STRETCHED},
                     {"method": "cmpm"}, {"method": "gc"}, {"method": "gc", **STRETCHED},
                     {"method": "cmpm", "integration": "field2"}, {"method": "mpm", "integration": "cubic"},
                     {"method": "mpm", "integration": "dual"}),
            cells=(10, 20, 40, 80), quantity="all",
            simpler={"on a line": {"dim": 1}, "small strain": {"strain": "small"}}),
    Problem("column", column,
            choices=({"method": "mpm"}, {"method": "gimp"}, {"method": "gimp", **STRETCHED},
                     {"method": "gc", **STRETCHED}, {"method": "gc", "integration": "field2", **STRETCHED},
                     {"method": "mpm", "integration": "cubic"}, {"method": "mpm", "integration": "dual"},
                     {"method": "gimp", "integration": "dual", **STRETCHED}),
            cells=(8, 16, 32, 64), quantity="all", simpler={"in one dimension": {"dim": 1}}),
    Problem("bar", scenes.bar,
            choices=({"method": "mpm"}, {"method": "mpm", "integrator": "usl"}, {"method": "gimp"},
                     {"method": "gimp", "engine": "numba"}, {"method": "gimp", "integrator": "usl"},
                     {"method": "gimp", "xpic": 2}, {"method": "cmpm-c"}, {"method": "cmpm-c", "xpic": 2},
                     {"method": "gc"}, {"method": "gimp", "integration": "dual"}),
            cells=(8, 16, 32, 64), quantity="stress", spans=True,
            simpler={"implicit steps": {"solver": "implicit", "integrator": None, "xpic": None}}),
    Problem("cut", cut,
            choices=({"method": "mpm"}, {"method": "gimp"}, {"method": "gimp", "remedy": "bbar"}, {"method": "cmpm"},
                     {"method": "cmpm-c"}, {"method": "gc"}, {"method": "gimp", "integration": "dual"}),
            cells=(10, 20, 40), quantity="toe", simpler={"elastic": {"material": LinearElastic(E=400e3, nu=0.35)}},
            known=cut_known, spans=True),
)}


def find_problem(scene: Any) -> Problem:
    """The problem of a name, of a function that makes a scene, or itself.

    Raises
    ------
    ValueError, TypeError
        If it is none of these.
    """
    if isinstance(scene, Problem):
        return scene
    if isinstance(scene, str):
        check_choice("scene", scene, PROBLEMS)
        return PROBLEMS[scene]
    if not callable(scene):
        raise TypeError(f"scene: got {type(scene).__name__}, expected a name such as 'cylinder', or a function that "
                        "makes a scene, so that it can be made with other cells.")
    return Problem(name_of(scene), scene)
