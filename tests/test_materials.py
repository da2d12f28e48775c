"""Laws answer the closed forms, and refuse moduli that no material has."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shared import every_motion

from skfem_mpm import Hencky, LinearElastic, VonMises, plane_strain, solid, uniaxial
from skfem_mpm.kinematics import Logarithmic
from skfem_mpm.materials import numerical_tangent

NOTHING = np.zeros((0, 1))                               # the history of a law that has none
every_law = pytest.mark.parametrize("Law", [LinearElastic, Hencky])
STRETCHES = [0.1, 0.5, 1.0, 1.5, 10.0]


def stretched(law, kinematics, dim, *stretches):
    """Cauchy stress, ``(3, 3)``, after principal stretches along the axes from an unstressed start."""
    gradient = np.array([[stretches[i] - 1.0 if i == j else 0.0] for i, j in kinematics.rows(dim)])
    motion = Logarithmic(kinematics, dim, law, np.zeros((kinematics.ncomp, 1)), None)
    return kinematics.tensor(motion.respond(gradient).sigma)[:, :, 0]


@every_law
@pytest.mark.parametrize("stretch", STRETCHES)
def test_hydrostatic_pressure_is_the_bulk_modulus_times_the_logarithm_of_the_volume(Law, stretch):
    law = Law(E=2.0, nu=0.2)
    bulk, J = law.E / (3 * (1 - 2 * law.nu)), stretch ** 3
    expected = bulk * np.log(J) / (J if law.kirchhoff else 1)
    sigma = stretched(law, solid, 3, *[stretch] * 3)
    assert_allclose(sigma, expected * np.eye(3), rtol=1e-13, atol=1e-14)


@every_law
@every_motion
@pytest.mark.parametrize("stretch", STRETCHES)
def test_stretch_along_one_axis_is_the_oedometer_modulus_times_its_logarithm(Law, kinematics, dim, stretch):
    law = Law(E=2.0, nu=0.2)
    oedometer = law.E * (1 - law.nu) / ((1 + law.nu) * (1 - 2 * law.nu))
    sigma = stretched(law, kinematics, dim, stretch, 1, 1)
    expected = oedometer * np.log(stretch) / (stretch if law.kirchhoff else 1)
    assert_allclose(sigma[0, 0], expected, rtol=1e-13, atol=1e-14)
    if kinematics is not uniaxial:
        side = law.nu / (1 - law.nu) * expected
        assert_allclose([sigma[1, 1], sigma[2, 2]], side, rtol=1e-13, atol=1e-14)


@every_law
@pytest.mark.parametrize("stretch", STRETCHES)
def test_a_stretch_that_keeps_the_volume_makes_no_pressure_and_the_same_stress_in_both_laws(Law, stretch):
    law = Law(E=2.0, nu=0.2)
    sigma = stretched(law, plane_strain, 2, stretch, 1 / stretch, 1)
    rounding = 1e-15 * max(stretch, 1 / stretch) ** 4      # the smaller principal stretch stands beside the larger one
    assert_allclose(np.diag(sigma), 2 * law.G * np.log(stretch) * np.array([1, -1, 0]), atol=rounding)


@every_law
def test_compression_and_extension_are_mirror_images_in_the_logarithm(Law):
    law = Law(E=2.0, nu=0.2)
    J = 2.0 if law.kirchhoff else 1.0
    tension, pressure = (stretched(law, uniaxial, 1, stretch, 1, 1)[0, 0] for stretch in (2.0, 0.5))
    assert_allclose(tension * J, -pressure / J, rtol=1e-14)


@every_law
def test_moduli_are_those_of_textbooks(Law):
    """Lame's parameters of the paper's soil, E = 25 MPa and nu = 0.3, in kPa."""
    law = Law(E=25000.0, nu=0.3)
    assert_allclose([law.lam, law.G], [14423.08, 9615.38], atol=0.005)


@every_law
@every_motion
def test_the_tangent_is_the_derivative_of_the_update(Law, kinematics, dim):
    """Symmetric strain only reaches the law, so shear rows are halved."""
    law, random = Law(E=2.0, nu=0.2), np.random.default_rng(0)
    places = kinematics.rows(dim)
    stress, strain, change = (random.uniform(-1, 1, (kinematics.ncomp, 5)) for _ in range(3))
    gradient = random.uniform(-1, 1, (len(places), 5))
    change[:] = 0
    for row, (i, j) in zip(gradient, places):
        change[kinematics.packed_index((i, j))] += row if i == j else row / 2
    before, after = (law.update(e, stress, NOTHING, kinematics.components)[0] for e in (strain, strain + change))
    moved = after - before
    expected = np.stack([moved[kinematics.packed_index(place)] for place in places])
    tangent = np.broadcast_to(law.tangent(strain, stress, NOTHING, places), (len(places), len(places), 5))
    assert_allclose(np.einsum("qrn,rn->qn", tangent, gradient), expected, atol=1e-14)


SOIL = VonMises(E=4.0, nu=0.3, peak=0.5, residual=0.2, softening=-0.5)


@every_motion
@pytest.mark.parametrize("law", [LinearElastic(E=2.0, nu=0.2), Hencky(E=2.0, nu=0.2), SOIL], ids=str)
def test_the_numerical_tangent_is_the_exact_one(law, kinematics, dim):
    if kinematics is uniaxial and law is SOIL:
        return
    random, places = np.random.default_rng(0), kinematics.rows(dim)
    strain, stress = (random.normal(size=(kinematics.ncomp, 50)) for _ in range(2))
    history = np.zeros((len(law.history), 50))
    exact = np.broadcast_to(law.tangent(strain, stress, history, places), (len(places), len(places), 50))
    assert_allclose(numerical_tangent(law, strain, stress, history, places), exact, atol=2e-7 * law.E)


# Energy

def contract(a, b, components):
    return sum(x * y * (1 if i == j else 2) for x, y, (i, j) in zip(a, b, components))


@every_motion
@pytest.mark.parametrize("nu", [-0.3, 0.0, 0.45])
def test_the_energy_of_small_strain_is_half_the_stress_times_the_strain(kinematics, dim, nu):
    """From the stress alone, or with the strain if there is one."""
    law, components = LinearElastic(E=2.0, nu=nu), kinematics.components
    strain = np.random.default_rng(0).normal(size=(len(components), 7))
    stress = law.trial(strain, np.zeros_like(strain), components)
    for given in (None, strain):
        found = law.energy_density(stress, given, components)
        assert_allclose(found, contract(stress, strain, components) / 2, rtol=1e-12)
        assert (found > 0).all()


@every_motion
def test_henckys_energy_makes_its_stress(kinematics, dim):
    """The Piola stress is the derivative of the energy per volume at the start of the step, whatever came before."""
    law, random = Hencky(E=2.0, nu=0.3), np.random.default_rng(1)
    rows = kinematics.rows(dim)
    possible = np.array([[i == j or (i, j) in rows] for i, j in kinematics.components])
    before = 0.2 * possible * random.normal(size=(kinematics.ncomp, 9))
    motion = Logarithmic(kinematics, dim, law, np.zeros_like(before), before)
    gradient, step = 0.2 * random.normal(size=(len(rows), 9)), 1e-6

    def energy(gradient):
        answer = motion.respond(gradient)
        return law.energy_density(answer.sigma, answer.epsilon, kinematics.components) * answer.ratio

    units = step * np.eye(len(rows))[:, :, None]
    found = [(energy(gradient + unit) - energy(gradient - unit)) / (2 * step) for unit in units]
    assert_allclose(found, motion.respond(gradient).piola, atol=1e-8)


@pytest.mark.parametrize("stretch", [1.001, 1.1, 0.9, 2.0])
def test_cauchy_stress_linear_in_strain_gives_back_another_energy_than_half_the_product(stretch):
    """A known limit: in a bar M (e - 1 + 1 / exp(e)) per current volume is the work, M e^2 / 2 what is reported."""
    law, e = LinearElastic(E=2.0, nu=0.2), np.array([[np.log(stretch)]])
    modulus = law.lam + 2 * law.G
    work = modulus * (e + np.expm1(-e))[0]
    found = law.energy_density(modulus * e, e, uniaxial.components)
    assert_allclose(found, work, rtol=0.4 * abs(e).max())
    assert (np.abs(found / work - 1) > 0.3 * abs(e).max()).all()


def test_hencky_has_no_energy_for_a_stress_alone():
    law = Hencky(E=1.0, nu=0.3)
    assert_array_equal(law.energy_density(np.zeros((4, 2)), None, plane_strain.components), [0, 0])
    with pytest.raises(ValueError, match="epsilon: got None with stress, expected the elastic logarithmic strain"):
        law.energy_density(np.ones((4, 2)), None, plane_strain.components)


@every_law
def test_updates_are_pure(Law):
    law, strain, stress = Law(E=2.0, nu=0.2), np.ones((4, 3)), np.full((4, 3), 2.0)
    first = law.update(strain, stress, NOTHING, plane_strain.components)[0]
    assert_array_equal(first, law.update(strain, stress, NOTHING, plane_strain.components)[0])
    assert (strain == 1).all() and (stress == 2).all()
    with pytest.raises(FrozenInstanceError):
        law.E = 1.0


@every_law
@pytest.mark.parametrize("E", [0, 0.0, -25e6, np.nan, np.inf, np.array([1.0, 2.0]), "25e6", None, True, 1j], ids=str)
def test_a_modulus_that_is_not_above_zero_is_refused(Law, E):
    with pytest.raises(ValueError, match=r"^E: got .*expected a modulus above zero"):
        Law(E=E, nu=0.3)


@every_law
@pytest.mark.parametrize("nu", [-1, -1.5, 0.5, 0.7, np.nan, np.array([0.1, 0.2]), "0.3", None], ids=str)
def test_a_ratio_outside_its_bounds_is_refused(Law, nu):
    with pytest.raises(ValueError, match=r"^nu: got .*expected a ratio between -1 and 0\.5.*use 0\.49"):
        Law(E=1.0, nu=nu)


@every_law
@pytest.mark.parametrize("nu", [-0.999, 0.0, 0.4999])
def test_ratios_near_the_bounds_are_taken(Law, nu):
    law = Law(E=1.0, nu=nu)
    assert law.lam + 2 * law.G > 0 and law.G > 0
