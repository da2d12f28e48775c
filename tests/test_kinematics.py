"""Stress follows a displacement gradient as continuum mechanics says, in every kinematics and law."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation
from shared import MOTIONS, every_motion
from skfem import ElementLineP1, ElementVector, LinearForm, MeshLine
from skfem.helpers import ddot

from skfem_mpm import (
    Hencky,
    LinearElastic,
    ParticleBasis,
    Particles,
    VonMises,
    axisymmetric,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.kinematics import RATES, STRAINS, Logarithmic, Objective, Small

LAWS = [LinearElastic(E=3.0, nu=0.3), Hencky(E=3.0, nu=0.3), LinearElastic(E=3.0, nu=0.49), Hencky(E=3.0, nu=-0.5)]
PAIRS = [(Small, law) for law in LAWS if not law.kirchhoff] + [(Logarithmic, law) for law in LAWS]
SOIL = VonMises(E=400e3, nu=0.35, peak=6e3, residual=1e3, softening=-25e3)
every_law = pytest.mark.parametrize("law", LAWS, ids=str)
every_pair = pytest.mark.parametrize("strain, law", PAIRS, ids=lambda value: getattr(value, "name", str(value)))
in_a_plane_or_space = pytest.mark.parametrize("kinematics, dim", [pair for pair in MOTIONS if pair[1] > 1],
                                              ids=lambda value: getattr(value, "name", value))


@dataclass
class Draw:
    """Random increments and what the points carry before them."""

    gradient: np.ndarray
    epsilon: np.ndarray
    sigma: np.ndarray


def draw(kinematics, dim, size=0.3, before=0.2, n=20, seed=0):
    random, rows = np.random.default_rng(seed), kinematics.rows(dim)
    # On a line of radii nothing ever shears.
    possible = np.array([[i == j or (i, j) in rows] for i, j in kinematics.components])
    return Draw(size * random.uniform(-1, 1, (len(rows), n)),
                before * possible * random.uniform(-1, 1, (kinematics.ncomp, n)),
                possible * random.uniform(-1, 1, (kinematics.ncomp, n)))


def shift(kinematics, dim, gradient):
    """The displacement gradient as 3 x 3 matrices, points first."""
    H = np.zeros((gradient.shape[1], 3, 3))
    for row, (i, j) in zip(gradient, kinematics.rows(dim)):
        H[:, i, j] = row
    return H


def full(kinematics, dim, gradient):
    """The deformation gradient as 3 x 3 matrices, points first."""
    return np.eye(3) + shift(kinematics, dim, gradient)


def hooke(kinematics, dim, law, gradient):
    """Linear elastic stress of small strains, ``(3, 3, n)``."""
    H = shift(kinematics, dim, gradient)
    strain = (H + H.transpose(0, 2, 1)) / 2
    stress = 2 * law.G * strain + law.lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return stress.transpose(1, 2, 0)


def matrices(tensor):
    return tensor.transpose(2, 0, 1)


def oracle(kinematics, dim, law, gradient, epsilon):
    """Piola and Cauchy stress by matrix functions of full 3 x 3 tensors: slow, plain, and ours only in name."""
    piola, cauchy, strains = [], [], []
    for F, before in zip(full(kinematics, dim, gradient), matrices(kinematics.tensor(epsilon))):
        strain = np.real(logm(F @ expm(2 * before) @ F.T)) / 2
        stress = 2 * law.G * strain + law.lam * np.trace(strain) * np.eye(3)
        sigma = stress / np.exp(np.trace(strain)) if law.kirchhoff else stress
        piola.append(np.linalg.det(F) * sigma @ np.linalg.inv(F).T)
        cauchy.append(sigma)
        strains.append(strain)
    return [np.stack(part, axis=-1) for part in (piola, cauchy, strains)]


def at(places, tensor):
    return np.stack([tensor[i, j] for i, j in places])


# Stress.

@every_motion
@every_law
def test_logarithmic_stress_is_the_matrix_logarithm_of_the_stretch(kinematics, dim, law):
    given = draw(kinematics, dim)
    found = Logarithmic(kinematics, dim, law, given.sigma, given.epsilon).respond(given.gradient)
    piola, sigma, strain = oracle(kinematics, dim, law, given.gradient, given.epsilon)
    assert_allclose(found.sigma, at(kinematics.components, sigma), atol=1e-12)
    assert_allclose(found.piola, at(kinematics.rows(dim), piola), atol=1e-12)
    assert_allclose(found.epsilon, at(kinematics.components, strain), atol=1e-13)


@every_motion
@every_pair
def test_the_ratio_is_the_determinant(kinematics, dim, strain, law):
    given = draw(kinematics, dim)
    motion = strain(kinematics, dim, law, given.sigma, given.epsilon)
    expected = np.linalg.det(full(kinematics, dim, given.gradient))
    assert_allclose(motion.respond(given.gradient).ratio, expected, rtol=1e-13)
    assert_allclose(motion.stretch(given.gradient), expected, rtol=1e-13)


@every_motion
def test_small_strain_adds_hookes_law_to_the_stress(kinematics, dim):
    law, given = LAWS[0], draw(kinematics, dim)
    found = Small(kinematics, dim, law, given.sigma, None).respond(given.gradient)
    expected = given.sigma + at(kinematics.components, hooke(kinematics, dim, law, given.gradient))
    assert_allclose(found.sigma, expected, atol=1e-14)
    assert_allclose(kinematics.tensor(found.sigma)[tuple(zip(*kinematics.rows(dim)))], found.piola, atol=1e-14)


@every_motion
@every_pair
@pytest.mark.parametrize("size", [1e-4, 1e-9, 1e-12])
def test_tiny_increments_keep_their_digits(kinematics, dim, strain, law, size):
    """ln(1 + 1e-12) by way of 1 + 1e-12 would leave four digits."""
    given = draw(kinematics, dim, size=size, before=0)
    stress = hooke(kinematics, dim, law, given.gradient)
    zero = np.zeros_like(given.sigma)
    found = strain(kinematics, dim, law, zero, zero).respond(given.gradient)
    error = np.abs(found.sigma - at(kinematics.components, stress)).max(axis=0)
    assert (error <= (20 * size + 1e-14) * np.abs(stress).max(axis=(0, 1))).all()


@every_motion
@every_law
def test_tiny_strains_of_before_keep_their_digits(kinematics, dim, law):
    size = 1e-10
    given = draw(kinematics, dim, before=size)
    still = np.zeros_like(given.gradient)
    found = Logarithmic(kinematics, dim, law, given.sigma, given.epsilon).respond(still)
    assert_allclose(found.epsilon, given.epsilon, atol=1e-14 * size)


@every_motion
@every_pair
def test_no_motion_no_change(kinematics, dim, strain, law):
    given = draw(kinematics, dim)
    motion = strain(kinematics, dim, law, given.sigma, given.epsilon)
    first = motion.respond(np.zeros_like(given.gradient))
    again = strain(kinematics, dim, law, first.sigma, first.epsilon).respond(np.zeros_like(given.gradient))
    assert_allclose(again.sigma, first.sigma, atol=1e-14)
    assert_allclose(again.ratio, 1, rtol=1e-15)


@every_motion
@every_law
def test_two_steps_are_one(kinematics, dim, law):
    """Elastic and hyperelastic in stress: the way does not matter, only where it ends."""
    one, two = draw(kinematics, dim, seed=1), draw(kinematics, dim, seed=2)
    first = Logarithmic(kinematics, dim, law, one.sigma, one.epsilon).respond(one.gradient)
    second = Logarithmic(kinematics, dim, law, first.sigma, first.epsilon).respond(two.gradient)
    together = full(kinematics, dim, two.gradient) @ full(kinematics, dim, one.gradient)
    gradient = at(kinematics.rows(dim), (together - np.eye(3)).transpose(1, 2, 0))
    once = Logarithmic(kinematics, dim, law, one.sigma, one.epsilon).respond(gradient)
    assert_allclose(second.sigma, once.sigma, atol=1e-12)
    assert_allclose(first.ratio * second.ratio, once.ratio, rtol=1e-13)


# Rigid motion and objectivity.

def rotation(kinematics, dim, n, seed=3):
    """Rotations ``(n, 3, 3)`` in the space that the motion knows."""
    random = np.random.default_rng(seed)
    vectors = random.uniform(-2, 2, (n, 3)) * ([1, 1, 1] if dim == 3 else [0, 0, 1])
    return Rotation.from_rotvec(vectors).as_matrix()


@in_a_plane_or_space
@every_law
def test_a_rotation_alone_makes_no_stress(kinematics, dim, law):
    Q = rotation(kinematics, dim, 20)
    gradient = at(kinematics.rows(dim), (Q - np.eye(3)).transpose(1, 2, 0))
    zero = np.zeros((kinematics.ncomp, 20))
    found = Logarithmic(kinematics, dim, law, zero, None).respond(gradient)
    modulus = law.lam + 2 * law.G
    assert_allclose(found.sigma / modulus, 0, atol=1e-14)
    assert_allclose(found.piola / modulus, 0, atol=1e-14)
    assert_allclose(found.ratio, 1, rtol=1e-14)


@in_a_plane_or_space
@every_law
def test_a_rotation_on_top_of_a_step_rotates_the_stress(kinematics, dim, law):
    given = draw(kinematics, dim)
    Q = rotation(kinematics, dim, 20)
    turned = Q @ full(kinematics, dim, given.gradient)
    gradient = at(kinematics.rows(dim), (turned - np.eye(3)).transpose(1, 2, 0))
    motion = Logarithmic(kinematics, dim, law, given.sigma, given.epsilon)
    before, after = motion.respond(given.gradient), motion.respond(gradient)
    for part in ("sigma", "epsilon"):
        tensor = matrices(kinematics.tensor(getattr(before, part)))
        expected = (Q @ tensor @ Q.transpose(0, 2, 1)).transpose(1, 2, 0)
        assert_allclose(getattr(after, part), at(kinematics.components, expected), atol=1e-13)
    assert_allclose(after.ratio, before.ratio, rtol=1e-13)


@in_a_plane_or_space
def test_small_strain_sees_no_infinitesimal_rotation(kinematics, dim):
    spin = np.random.default_rng(4).uniform(-1, 1, (dim, dim, 20))
    gradient = np.zeros((len(kinematics.rows(dim)), 20))
    gradient[:dim * dim] = (spin - spin.transpose(1, 0, 2)).reshape(dim * dim, -1)
    sigma = np.ones((kinematics.ncomp, 20))
    assert_array_equal(Small(kinematics, dim, LAWS[0], sigma, None).respond(gradient).sigma, sigma)


@in_a_plane_or_space
def test_small_strain_is_fooled_by_a_finite_rotation(kinematics, dim):
    """A known limit: turned by 0.1 it strains by 1 - cos 0.1."""
    Q = Rotation.from_rotvec([0, 0, 0.1]).as_matrix()
    gradient = at(kinematics.rows(dim), (Q - np.eye(3))[:, :, None])
    law, zero = LinearElastic(E=1.0, nu=0.0), np.zeros((kinematics.ncomp, 1))
    found = Small(kinematics, dim, law, zero, None).respond(gradient)
    assert_allclose(found.sigma[:2, 0], np.cos(0.1) - 1, rtol=1e-12)


# The Jaumann rate.

def spun(kinematics, dim, vectors, sigma, history=None, law=None):
    """Stress after a step of pure spin, given by the spin's axial vectors ``(3, n)``."""
    a, b, c = vectors
    spin = np.array([[0 * a, -c, b], [c, 0 * a, -a], [-b, a, 0 * a]])
    law = law or LinearElastic(E=3.0, nu=0.3)
    return Objective(kinematics, dim, law, sigma, None, history).respond(at(kinematics.rows(dim), spin)).sigma


def axial(dim, n, size, seed=5):
    vectors = size * np.random.default_rng(seed).normal(size=(3, n))
    return vectors * [[dim == 3], [dim == 3], [True]]


@in_a_plane_or_space
@pytest.mark.parametrize("size", [1e-6, 0.1, 1.0, 100.0])
def test_spin_turns_stress_by_twice_the_arctangent_of_half_of_it(kinematics, dim, size):
    """Cayley's rotation: a rotation however large the step."""
    sigma, vectors = draw(kinematics, dim).sigma, axial(dim, 20, size)
    length = np.linalg.norm(vectors, axis=0)
    Q = Rotation.from_rotvec((2 * np.arctan(length / 2) / length * vectors).T).as_matrix()
    expected = (Q @ matrices(kinematics.tensor(sigma)) @ Q.transpose(0, 2, 1)).transpose(1, 2, 0)
    assert_allclose(spun(kinematics, dim, vectors, sigma), at(kinematics.components, expected), atol=5e-15)


@in_a_plane_or_space
def test_a_thousand_spins_leave_the_principal_stresses_alone(kinematics, dim):
    sigma = start = draw(kinematics, dim).sigma
    for step in range(1000):
        sigma = spun(kinematics, dim, axial(dim, 20, 0.3, seed=step), sigma)
    before, after = (np.linalg.eigvalsh(matrices(kinematics.tensor(each))) for each in (start, sigma))
    assert_allclose(after, before, atol=1e-13)


@in_a_plane_or_space
def test_a_turn_in_many_steps_tends_to_the_finite_rotation_at_second_order(kinematics, dim):
    given, vector = draw(kinematics, dim), axial(dim, 20, 1.0)
    Q = Rotation.from_rotvec(vector.T).as_matrix()
    expected = at(kinematics.components,
                  (Q @ matrices(kinematics.tensor(given.sigma)) @ Q.transpose(0, 2, 1)).transpose(1, 2, 0))
    errors = []
    for steps in (10, 20, 40):
        sigma = given.sigma
        for _ in range(steps):
            sigma = spun(kinematics, dim, vector / steps, sigma)
        errors.append(np.abs(sigma - expected).max())
    assert errors[-1] < 3e-3
    assert min(errors[0] / errors[1], errors[1] / errors[2]) > 3.8


@every_motion
def test_without_spin_the_rate_is_that_of_small_strain_bit_for_bit(kinematics, dim):
    given = draw(kinematics, dim)
    gradient = given.gradient.copy()
    block = gradient[:dim * dim].reshape(dim, dim, -1)
    block[:] = block + block.transpose(1, 0, 2)
    one, other = (strain(kinematics, dim, LAWS[0], given.sigma, None) for strain in (Small, Objective))
    assert_array_equal(one.respond(gradient).sigma, other.respond(gradient).sigma)


@in_a_plane_or_space
def test_in_a_closed_cycle_the_jaumann_rate_leaves_stress_and_logarithmic_strain_leaves_none(kinematics, dim):
    """A known limit: what is left falls with the cube of the strain (stretch, shear and back again)."""
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    left = []
    for size in (0.1, 0.05):
        path = [[size * (a + t * (c - a)), size * (b + t * (d - b))]
                for (a, b), (c, d) in zip(corners, corners[1:]) for t in np.arange(100) / 100] + [[0.0, 0.0]]
        for strain in (Objective, Logarithmic):
            sigma, epsilon, F = np.zeros((kinematics.ncomp, 1)), None, np.eye(3)
            for stretch, shear in path:
                new = np.eye(3) + stretch * np.outer([1, 0, 0], [1, 0, 0]) + shear * np.outer([1, 0, 0], [0, 1, 0])
                change = at(kinematics.rows(dim), (new @ np.linalg.inv(F) - np.eye(3))[:, :, None])
                answer = strain(kinematics, dim, LAWS[0], sigma, epsilon).respond(change)
                sigma, epsilon, F = answer.sigma, answer.epsilon, new
            left.append(np.abs(sigma).max())
    assert max(left[1], left[3]) < 1e-13
    assert 0 < left[2] < left[0] / 3 < 0.1 ** 2


# Tangents.

def differences(motion, gradient, step=1e-6):
    """Derivative of Piola stress by the gradient, central differences, ``(m, m, n)``."""
    columns = []
    for q in range(len(gradient)):
        shift = np.zeros_like(gradient)
        shift[q] = step
        columns.append((motion.respond(gradient + shift).piola - motion.respond(gradient - shift).piola) / (2 * step))
    return np.stack(columns, axis=1)


@every_motion
@every_pair
@pytest.mark.parametrize("size, before", [(0.3, 0.2), (0.3, 0.0), (0.0, 0.2), (0.0, 0.0), (1e-7, 0.0), (1e-9, 0.2)])
def test_the_tangent_is_the_derivative_of_the_stress(kinematics, dim, strain, law, size, before):
    given = draw(kinematics, dim, size, before)
    motion = strain(kinematics, dim, law, given.sigma, given.epsilon)
    exact = np.broadcast_to(motion.respond(given.gradient).tangent(), (*2 * given.gradient.shape[:1], 20))
    assert_allclose(exact, differences(motion, given.gradient), atol=3e-8 * np.abs(exact).max())


@every_motion
@every_law
@pytest.mark.parametrize("gap", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3])
def test_the_tangent_stands_equal_principal_stretches(kinematics, dim, law, gap):
    """Two principal values that meet make 0 / 0 in the textbook formula; near ones lose digits there."""
    rows = kinematics.rows(dim)
    gradient = np.array([[(0.25 + gap * i) if i == j else 0.0] for i, j in rows])
    epsilon = np.array([[0.1 if i == j else 0.0] for i, j in kinematics.components])
    motion = Logarithmic(kinematics, dim, law, np.zeros_like(epsilon), epsilon)
    exact = motion.respond(gradient).tangent()
    assert np.isfinite(exact).all()
    assert_allclose(np.broadcast_to(exact, (len(rows), len(rows), 1)), differences(motion, gradient),
                    atol=3e-8 * np.abs(exact).max())


@every_motion
@pytest.mark.parametrize("law", [law for law in LAWS if law.kirchhoff], ids=str)
def test_henckys_tangent_has_major_symmetry(kinematics, dim, law):
    """It comes from a stored energy."""
    given = draw(kinematics, dim)
    tangent = Logarithmic(kinematics, dim, law, given.sigma, given.epsilon).respond(given.gradient).tangent()
    assert_allclose(tangent, tangent.transpose(1, 0, 2), atol=1e-13 * np.abs(tangent).max())


@pytest.mark.parametrize("kinematics, dim", [pair for pair in MOTIONS if pair != (uniaxial, 1)],
                         ids=lambda value: getattr(value, "name", value))
def test_cauchy_stress_linear_in_logarithmic_strain_has_no_energy(kinematics, dim):
    """A known property of LinearElastic at large strain: its tangent is unsymmetric."""
    given = draw(kinematics, dim)
    tangent = Logarithmic(kinematics, dim, LAWS[0], given.sigma, given.epsilon).respond(given.gradient).tangent()
    assert np.abs(tangent - tangent.transpose(1, 0, 2)).max() > 1e-3 * np.abs(tangent).max()


@every_motion
@every_pair
def test_every_tangent_starts_as_hookes(kinematics, dim, strain, law):
    zero = np.zeros((kinematics.ncomp, 1))
    rows = kinematics.rows(dim)
    tangent = strain(kinematics, dim, law, zero, None).respond(np.zeros((len(rows), 1))).tangent()[:, :, 0]
    delta = np.eye(3)
    expected = [[law.lam * delta[i, j] * delta[k, l] + law.G * (delta[i, k] * delta[j, l] + delta[i, l] * delta[j, k])
                 for k, l in rows] for i, j in rows]
    assert_allclose(tangent, expected, atol=1e-14)


# Inverted points.

@every_motion
@every_pair
@pytest.mark.parametrize("length", [0.0, -0.5])
def test_a_stretch_that_is_not_positive_is_seen(kinematics, dim, strain, law, length):
    for q, (i, j) in enumerate(kinematics.rows(dim)):
        if i == j:
            gradient = np.zeros((len(kinematics.rows(dim)), 2))
            gradient[q, 1] = length - 1
            ratio = strain(kinematics, dim, law, np.zeros((kinematics.ncomp, 2)), None).stretch(gradient)
            assert ratio[0] == 1
            assert not ratio[1] > 0


@pytest.mark.parametrize("dim", axisymmetric.dims)
@pytest.mark.parametrize("strain", STRAINS.values(), ids=STRAINS)
def test_two_inverted_stretches_do_not_make_a_sound_one(dim, strain):
    """Turned inside out along the radius *and* thrown across the axis: the product of both is positive again."""
    rows = axisymmetric.rows(dim)
    gradient = np.array([[-1.5 if place in ((0, 0), (2, 2)) else 0.0] for place in rows])
    ratio = strain(axisymmetric, dim, LAWS[0], np.zeros((4, 1)), None).stretch(gradient)
    assert not ratio[0] > 0


# What laws may answer.

def refused(update, *, strain=Small, history=(), **members):
    """The message for a law whose update is ``update``."""
    def wrong(self, strain, stress, history, components):
        return update(*LinearElastic.update(self, strain, stress, history, components), strain, stress)

    law = type("Mine", (LinearElastic,), {"update": wrong, "history": history, **members})(E=3.0, nu=0.3)
    with pytest.raises((ValueError, TypeError)) as caught:
        strain(plane_strain, 2, law, np.zeros((4, 5)), None).respond(np.zeros((4, 5)))
    return str(caught.value)


def in_place(stress, history, strain, before):
    before += stress
    return before, history


@pytest.mark.parametrize("strain", [Small, Objective, Logarithmic])
@pytest.mark.parametrize("update, message", [
    (lambda s, h, *_: s, r"Mine.update: got one ndarray, expected the pair (stress, history)."),
    (lambda s, h, *_: None, "Mine.update: got one NoneType, expected the pair"),
    (lambda s, h, *_: (s, h, h), "Mine.update: got 3 values, expected the pair"),
    (lambda s, h, *_: (s[:2], h), "Mine.update: got shape (2, 5) for the stress, expected (4, 5)"),
    (lambda s, h, *_: (s.T, h), "Mine.update: got shape (5, 4) for the stress, expected (4, 5)"),
    (lambda s, h, *_: (s[:, :1], h), "Mine.update: got shape (4, 1) for the stress, expected (4, 5)"),
    (lambda s, h, *_: (list(s), h), "Mine.update: got list for the stress, expected an array of floats (4, 5)"),
    (lambda s, h, *_: (s + 0j, h), "Mine.update: got an array of complex128 for the stress"),
    (lambda s, h, *_: (s, s), "Mine.update: got shape (4, 5) for the history, expected (0, 5)"),
    (lambda s, h, *_: (s, None), "Mine.update: got NoneType for the history"),
    (in_place, "Mine.update: it changes its arguments in place, expected a pure function; write a = a + b"),
])
def test_a_law_that_answers_with_something_else_is_named(strain, update, message):
    assert message in refused(update, strain=strain)


@pytest.mark.parametrize("members, message", [
    ({"history": "eps_p"}, "material: got Mine with the history 'eps_p', expected a tuple of names"),
    ({"history": ["eps_p"]}, "expected a tuple of names"),
])
def test_a_history_is_a_tuple_of_names(members, message):
    assert message in refused(lambda s, h, *_: (s, h), **members)


class NoLaw:
    kirchhoff = False

    def update(self, strain, stress, history, components):
        return stress, history


@pytest.mark.parametrize("law, message", [
    (3, "got int, without kirchhoff, history, update, tangent; expected a law with"),
    (NoLaw(), "got NoLaw, without history, tangent"),
    (LinearElastic, r"got the class LinearElastic, expected a law; give it numbers, as in LinearElastic\(E="),
])
@pytest.mark.parametrize("strain", [Small, Objective, Logarithmic])
def test_what_is_no_law_is_refused(strain, law, message):
    with pytest.raises(TypeError, match=f"^material: {message}"):
        strain(plane_strain, 2, law, np.zeros((4, 5)), None)


def test_a_law_with_a_history_must_know_its_elastic_strain_at_finite_strain():
    class Half(NoLaw):
        history = ("a",)
        tangent = LinearElastic.tangent

    Small(plane_strain, 2, Half(), np.zeros((4, 5)), None)
    with pytest.raises(TypeError, match="got Half, without elastic_strain"):
        Logarithmic(plane_strain, 2, Half(), np.zeros((4, 5)), None)


@pytest.mark.parametrize("strain", [Small, Objective, Logarithmic])
@pytest.mark.parametrize("shape", [(2, 5), (1, 4), (5,)])
def test_a_history_that_is_not_the_laws_is_refused(strain, shape):
    with pytest.raises(ValueError, match=r"history: got shape .* expected \(1, 5\), .* each of eps_p of VonMises"):
        strain(plane_strain, 2, SOIL, np.zeros((4, 5)), None, np.zeros(shape))


@pytest.mark.parametrize("strain", [Small, Objective, Logarithmic])
def test_a_law_without_a_history_forgets_that_of_another(strain):
    gradient = np.full((4, 5), 0.01)
    answer = strain(plane_strain, 2, LAWS[0], np.zeros((4, 5)), None, np.ones((1, 5))).respond(gradient)
    assert answer.history.shape == (0, 5)


def test_a_tangent_of_the_wrong_shape_is_named():
    class Bent(LinearElastic):
        def tangent(self, *given):
            return super().tangent(*given)[:, :, 0]

    for strain in (Small, Logarithmic):
        answer = strain(plane_strain, 2, Bent(E=3.0, nu=0.3), np.zeros((4, 5)), None).respond(np.zeros((4, 5)))
        with pytest.raises(ValueError, match=r"Bent.tangent: got shape \(4, 4\), expected \(4, 4, 5\), or \(4, 4, 1\)"):
            answer.tangent()


@pytest.mark.parametrize("strain", RATES.values(), ids=RATES)
def test_a_law_may_hand_back_what_it_was_given_or_odd_arrays(strain):
    """What comes out can be written to, is in doubles and in one piece, as compiled code wants it."""
    class Lazy(LinearElastic):
        def update(self, strain, stress, history, components):
            return (stress if self.nu else np.asfortranarray(strain, dtype=np.float32)), history

    for nu in (0.0, 0.3):
        start = np.full((4, 5), 0.125)
        answer = strain(plane_strain, 2, Lazy(E=3.0, nu=nu), start, start).respond(np.full((4, 5), 0.25))
        assert answer.sigma.dtype == float and answer.sigma.flags.c_contiguous and answer.sigma.flags.writeable
        assert (start == 0.125).all()


# Storage and forms.

@every_motion
def test_packed_components_and_tensors_are_two_views_of_one_thing(kinematics, dim):
    packed = np.random.default_rng(5).uniform(size=(kinematics.ncomp, 7))
    tensor = kinematics.tensor(packed)
    assert tensor.shape == (3, 3, 7)
    assert_array_equal(tensor, tensor.transpose(1, 0, 2))
    assert_array_equal(at(kinematics.components, tensor), packed)
    others = set(np.ndindex(3, 3)) - set(kinematics.components) - {(j, i) for i, j in kinematics.components}
    assert not any(tensor[place].any() for place in others)
    for i, j in kinematics.rows(dim):
        assert kinematics.components[kinematics.packed_index((i, j))] in ((i, j), (j, i))


@every_motion
def test_rows_are_the_gradient_and_the_hoop(kinematics, dim):
    rows = kinematics.rows(dim)
    assert rows[:dim * dim] == tuple(np.ndindex(dim, dim))
    assert rows[dim * dim:] == (((2, 2),) if kinematics is axisymmetric else ())


@pytest.mark.parametrize("kinematics, dim", [(uniaxial, 2), (uniaxial, 3), (plane_strain, 1), (plane_strain, 3),
                                             (axisymmetric, 3), (solid, 1), (solid, 2)],
                         ids=lambda value: getattr(value, "name", value))
def test_a_dimension_that_does_not_fit_is_refused(kinematics, dim):
    with pytest.raises(ValueError, match=rf"got {kinematics.name} in {dim} dimension.*expected {kinematics.dims[0]}"):
        kinematics.rows(dim)


@pytest.mark.parametrize("kinematics, dim", MOTIONS, ids=lambda value: getattr(value, "name", value))
def test_small_strain_refuses_hencky(kinematics, dim):
    with pytest.raises(ValueError, match="got 'small' with Hencky.*needs strain='logarithmic'.*LinearElastic"):
        Small(kinematics, dim, LAWS[1], np.zeros((kinematics.ncomp, 1)), None)


def test_a_scalar_field_has_no_strain():
    """On a line the gradients of a scalar and of a vector look alike to numpy; the mistake used to go unseen."""
    mesh = MeshLine().refined(1)
    points = Particles.fill(mesh, uniaxial, per_cell=1)
    form = LinearForm(lambda v, w: ddot(w.stress, uniaxial.strain(v, w)))
    with pytest.raises(ValueError, match=r"u: got a field with a gradient of shape .* use ElementVector"):
        form.assemble(ParticleBasis(mesh, ElementLineP1(), points))
    assert form.assemble(ParticleBasis(mesh, ElementVector(ElementLineP1()), points)).shape == (3,)
