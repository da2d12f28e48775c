"""The public face: what is promised exists, is documented, and README's code runs."""

import re
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest

import skfem_mpm

ROOT = Path(__file__).parents[1]
PACKAGE = Path(skfem_mpm.__file__).parent


@pytest.mark.parametrize("name", skfem_mpm.__all__)
def test_every_public_name_exists_and_is_documented(name):
    thing = getattr(skfem_mpm, name)
    if callable(thing):
        assert (thing.__doc__ or "").strip(), f"{name} has no docstring"


def test_import_star():
    namespace = {}
    exec("from skfem_mpm import *", namespace)
    assert set(skfem_mpm.__all__) <= set(namespace)


def test_no_public_name_is_listed_twice():
    assert len(skfem_mpm.__all__) == len(set(skfem_mpm.__all__))


def test_no_public_name_hides_a_module():
    rooms = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert not [name for name in rooms & set(vars(skfem_mpm)) if not isinstance(getattr(skfem_mpm, name), ModuleType)]


def test_types_are_shipped():
    assert (PACKAGE / "py.typed").is_file()


def test_the_version_is_written_in_one_place():
    written = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE).group(1)
    assert f"## [{written}]" in (ROOT / "CHANGELOG.md").read_text()
    try:
        assert metadata.version("skfem-mpm") == written
    except metadata.PackageNotFoundError:
        pytest.skip("the package is not installed: pip install -e .")
    assert getattr(skfem_mpm, "__version__", written) == written


def test_the_code_in_the_readme_runs(tmp_path, monkeypatch):
    readme = ROOT / "README.md"
    text = readme.read_text() if readme.exists() else ""
    monkeypatch.chdir(tmp_path)
    for match in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        above = text[: match.start(1)].count("\n")      # so that a traceback shows README's own line numbers
        exec(compile("\n" * above + match.group(1), str(readme), "exec"), {"__name__": "__main__"})
