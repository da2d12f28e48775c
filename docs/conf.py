"""Sphinx: ``sphinx-build -W -b html docs docs/_build``."""

import importlib
import re
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import skfem_mpm  # noqa: E402

project = "skfem_mpm"
author = "skfem_mpm developers"
copyright = author
release = version = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE).group(1)

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.doctest",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
]
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {"description": "Material points for scikit-fem", "page_width": "1100px", "fixed_sidebar": True}
html_show_copyright = False

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_ivar = True                # else a documented property and its line under Attributes collide
autosummary_generate = False            # the API is one page
doctest_test_doctest_blocks = ""        # pytest runs the docstrings; pages have {doctest} and {testcode} blocks

# Rooms whose names are reached as skfem_mpm.<room>.<name>; those that do not exist yet are left out.
ROOMS = ["scenes", "study", "stability", "boundary", "ghost", "integration", "weights", "materials", "shapes", "output",
         "plot"]


# Public names that are neither classes nor functions: autodoc would show the text of their class, or none.
DATA = {
    "METHODS": "The methods by name, a dict of :class:`Method`: which basis maps mass and motion, which recovers "
               "strain, which carries internal force.",
    "axisymmetric": "Axial symmetry, on quads (r, z) or on lines (r only): a hoop strain, and volumes per radian.",
    "plane_strain": "Plane strain, on quads and triangles.",
    "solid": "Three dimensions, on hexes and tetrahedra.",
    "uniaxial": "One dimension, on lines: strain and stress along it.",
}


def data(name):
    """The directive that documents a public instance."""
    thing = getattr(skfem_mpm, name)
    lines = [f".. py:data:: {name}", f"   :type: {type(thing).__name__}", "", f"   {DATA[name]}", ""]
    if isinstance(thing, dict):
        rows = [(entry.mass, entry.strain, entry.force) for entry in thing.values()]
        lines += ["   .. list-table::", "      :header-rows: 1", "", "      * - name", "        - mass and motion",
                  "        - strain", "        - force"]
        for key, bases in zip(thing, rows):
            lines += [f"      * - ``{key}``"] + [f"        - :class:`{basis.__name__}`" for basis in bases]
        lines.append("")
    return "\n".join(lines)


def automodule(name, exclude=()):
    """The directive that documents a module: what its ``__all__`` lists, else what it defines."""
    module = importlib.import_module(name)
    lines = [f".. automodule:: {name}", "   :members:"]
    if hasattr(module, "__all__"):
        lines.append("   :imported-members:")
    hidden = sorted(set(exclude) & set(vars(module)))
    if hidden:
        lines.append("   :exclude-members: " + ", ".join(hidden))
    return "\n".join(lines) + "\n"


def api_page():
    """The API page, from what the package really has."""
    public = sorted(skfem_mpm.__all__, key=str.lower)
    instances = [name for name in public if not callable(getattr(skfem_mpm, name))]
    listed = [name for name in public if name not in instances]
    parts = ["API\n===\n\n.. currentmodule:: skfem_mpm\n",
             ".. autosummary::\n   :nosignatures:\n\n" + "\n".join(f"   {name}" for name in listed) + "\n",
             "Ready-made objects: " + ", ".join(f":py:data:`{name}`" for name in instances) + ".\n",
             "skfem_mpm\n---------\n", automodule("skfem_mpm", exclude=instances), *map(data, instances)]
    for room in ROOMS:
        name = f"skfem_mpm.{room}"
        if find_spec(name):
            parts += [f"{name}\n{'-' * len(name)}\n", automodule(name, exclude=public)]
    return "\n".join(parts)


def fill_api(app, docname, source):
    """``api.rst`` is an empty page that is filled here."""
    if docname == "api":
        source[0] = api_page()


def setup(app):
    """Called by Sphinx."""
    app.connect("source-read", fill_api)
    app.connect("env-get-outdated", lambda *args: ["api"])
