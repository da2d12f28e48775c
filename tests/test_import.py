"""What importing the package and running a small problem load, and what they leave alone; in fresh processes."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {"numba", "meshio", "matplotlib", "tqdm", "scipy.spatial", "scipy.integrate", "scipy.ndimage", "scipy.optimize"}
RUN = """
import numpy as np
from skfem import MeshQuad
from skfem_mpm import LinearElastic, Particles, explicit_steps, plane_strain
from skfem_mpm.boundary import FixedPlane

axis = np.linspace(0, 1, 9)
mesh = MeshQuad.init_tensor(axis, axis)
body = Particles.fill(mesh, plane_strain, density=1.0, where=lambda x: abs(x - 0.5).max(axis=0) < 0.25)
planes = [FixedPlane(1, 0.25, -1, (0, 1))]
for method in ("gimp", "cmpm-c"):
    for state in explicit_steps(mesh, body, LinearElastic(E=1e3, nu=0.3), planes, steps=2, method=method, engine={}):
        pass
assert state.engine == "numpy"
"""


def loaded_by(code):
    """Modules that a fresh process has loaded after the code, beyond those of scikit-fem."""
    lines = ["import sys", "import skfem", "before = set(sys.modules)", code,
             "print(*sorted(set(sys.modules) - before))"]
    child = subprocess.run([sys.executable, "-W", "ignore", "-c", "\n".join(lines)], cwd=ROOT, capture_output=True,
                           text=True)
    assert child.returncode == 0, child.stderr
    return set(child.stdout.split())


def foreign(modules):
    """Those that are neither ours nor scikit-fem's."""
    return {name for name in modules if name.split(".")[0] not in ("skfem", "skfem_mpm")}


def test_the_package_loads_nothing_that_scikit_fem_does_not():
    assert not foreign(loaded_by("import skfem_mpm"))


@pytest.mark.parametrize("engine", ["'numpy'", "'auto'"])
def test_a_small_explicit_run_loads_nothing_heavy(engine):
    modules = loaded_by(RUN.format(engine))
    assert "skfem_mpm.explicit.run" in modules and "skfem_mpm.explicit.compiled" not in modules
    assert not modules & HEAVY
    assert not any(name.startswith("skfem_mpm.kernels") for name in modules)


def test_an_implicit_run_loads_nothing_heavy():
    code = RUN.replace("explicit_steps", "implicit_steps").split("for method")[0]
    code += "next(iter(implicit_steps(mesh, body, LinearElastic(E=1e3, nu=0.3), planes, steps=1)))"
    assert not loaded_by(code) & HEAVY
