"""The random cut: its field is the one it states, each point yields at its own cohesion, and its interval is exact."""

import csv
import importlib.util
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta
from shared import both_engines

from skfem_mpm import VonMises
from skfem_mpm.scenes import vertical_cut
from skfem_mpm.study import ensemble, generator

SPEC = importlib.util.spec_from_file_location("random_cut",
                                              Path(__file__).parents[1] / "examples" / "random_cut.py")
random_cut = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_cut)
SOIL, FIELD = random_cut.SOIL, random_cut.FIELD


@pytest.fixture(scope="module")
def samples():
    """Cohesion of many realisations on a coarse grid, one value for each cell, ``(samples, 4, 8)``: rows go up."""
    x = vertical_cut(0.25).particles.x
    order = np.lexsort(np.floor(x / 0.25))
    drawn = [random_cut.cohesion(x, 0.25, generator(3, number), **FIELD) for number in range(4000)]
    return np.array(drawn)[:, order].reshape(len(drawn), 32, 4)


def test_the_points_of_a_cell_share_their_cohesion(samples):
    assert (np.ptp(samples, axis=2) == 0).all()
    assert len(np.unique(samples[0])) == 32


def test_the_field_has_the_mean_and_the_variation_that_it_is_given(samples):
    """Within about four standard errors of 4000 independent samples at each place."""
    cells = samples[:, :, 0]
    np.testing.assert_allclose(cells.mean(axis=0), SOIL.peak, rtol=4 * 0.3 / np.sqrt(4000))
    np.testing.assert_allclose(cells.std(axis=0) / SOIL.peak, 0.3, rtol=0.09)
    logarithm = np.log(cells)
    skew = ((logarithm - logarithm.mean()) ** 3).mean() / logarithm.std() ** 3
    assert abs(skew) < 0.05 < ((cells - cells.mean()) ** 3).mean() / cells.std() ** 3     # lognormal


def test_it_is_correlated_further_along_than_up(samples):
    logarithm = np.log(samples[:, :, 0]).reshape(-1, 4, 8)
    for axis, length in [(2, FIELD["lengths"][0]), (1, FIELD["lengths"][1])]:
        for lag in (1, 2, 3):
            ahead, behind = (np.take(logarithm, range(start, start + logarithm.shape[axis] - lag), axis)
                             for start in (lag, 0))
            found = np.corrcoef(ahead.ravel(), behind.ravel())[0, 1]
            assert found == pytest.approx(np.exp(-2 * 0.25 * lag / length), abs=0.03)


@both_engines
@pytest.mark.parametrize("cohesion, density", [(6e3, 2e3), (12e3, 4e3)], ids=["below", "above"])
def test_a_start_on_the_softening_line_is_a_peak_of_its_own(engine, cohesion, density):
    """The same motion as with that peak, and the same energy: to rounding."""
    own = vertical_cut(0.2, material=replace(SOIL, peak=cohesion), density=density)
    shifted = vertical_cut(0.2, material=SOIL, density=density)
    start = np.full((1, shifted.particles.n), (cohesion - SOIL.peak) / SOIL.softening)
    shifted = replace(shifted, particles=replace(shifted.particles, history=start))
    one, other = ([*scene.run("gimp", steps=150, every=150, engine=engine)][-1] for scene in (own, shifted))
    slip = one.particles.history
    assert slip.max() > 0.02
    np.testing.assert_allclose(other.particles.history - start, slip, atol=1e-9 * slip.max())
    np.testing.assert_allclose(other.particles.x, one.particles.x, rtol=0, atol=1e-10)
    assert other.energy["plastic"] == pytest.approx(one.energy["plastic"], rel=1e-8)


def test_points_of_several_cohesions_yield_each_at_its_own():
    """Pure shear of free points: sqrt(J2) is c where it yields first, whatever the neighbours."""
    c = np.array([2e3, 9e3, 30e3])
    law = VonMises(E=SOIL.E, nu=SOIL.nu, peak=9e3, residual=1e3, softening=-1e-3)       # as good as none
    plane, shear = [(0, 0), (1, 1), (2, 2), (0, 1)], np.zeros((4, 3))
    shear[3] = 1.0
    stress, _ = law.update(shear, np.zeros((4, 3)), ((c - law.peak) / law.softening)[None, :], plane)
    np.testing.assert_allclose(stress[3], c, rtol=1e-6)


@pytest.mark.parametrize("cohesion, fails", [(6.5e3, True), (9e3, False)])
def test_the_uniform_cut_stands_with_the_mean_and_fails_well_below(cohesion, fails):
    toe, _ = random_cut.watched(vertical_cut(0.1, loading="ramped", material=replace(SOIL, peak=cohesion)))
    assert (toe[-1] > random_cut.OUT) == fails
    assert fails or abs(toe[-1] - toe[-6]) < random_cut.MOVES


def test_realisations_are_the_same_on_one_and_on_two_workers(monkeypatch):
    monkeypatch.setattr(random_cut, "END", 0.3)
    function = partial(random_cut.realisation, h=0.25, **FIELD)
    rows = []
    for workers in (1, 2):
        with ThreadPoolExecutor(workers) as pool:
            rows.append(ensemble(function, 3, seed=2, executor=pool))
    assert rows[0] == rows[1] and all(row["status"] == "finished" for row in rows[0])


def test_the_interval_is_that_of_clopper_and_pearson():
    share, low, high = random_cut.estimates([1, 0, 0, 1, 0])
    np.testing.assert_allclose(share, [1, 1 / 2, 1 / 3, 2 / 4, 2 / 5])
    assert low[-1] == pytest.approx(beta.ppf(0.025, 2, 4)) and high[-1] == pytest.approx(beta.ppf(0.975, 3, 3))
    assert high[0] == 1 and 0 < low[0] < share[0]


@pytest.mark.slow
def test_its_answer_is_that_of_its_table_and_it_goes_on_with_more(tmp_path):
    path, out = Path(random_cut.__file__), tmp_path / "here"
    tables = []
    for more in (["--count", "3"], ["--count", "6", "--resume"], ["--count", "3", "--seed", "2"]):
        done = subprocess.run([sys.executable, str(path), "--workers", "1", "--out", str(out), *more], text=True,
                              capture_output=True)
        assert done.returncode == 0, done.stderr
        with open(out / "random_cut.csv", newline="") as file:
            tables.append(list(csv.DictReader(file)))
        failed = [float(row["failed"]) for row in tables[-1]]
        share, low, high = 100 * random_cut.estimates(failed)[:, -1]
        assert f"{sum(failed):.0f} of {len(failed)} cuts failed" in done.stdout
        assert f"failure is {share:.1f} %, with 95 % confidence between {low:.1f} and {high:.1f} %" in done.stdout
    assert [len(rows) for rows in tables] == [3, 6, 3]
    assert tables[1][:3] == tables[0] != tables[2]
    for row in tables[1]:
        assert (float(row["toe"]) > random_cut.OUT) == bool(float(row["failed"])) or float(row["time"]) > random_cut.END
