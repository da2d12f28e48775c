"""Von Mises soil whose strength goes to nothing, is next to nothing, or goes at once."""

from functools import partial

import numpy as np
from skfem import MeshQuad

from extremes.bodies import last, worst_of
from extremes.row import Row
from skfem_mpm import Particles, VonMises, explicit_steps, implicit_steps, plane_strain
from skfem_mpm.boundary import FixedPlane, Wall

E, NU = 1.0, 0.3
G = E / (2 * (1 + NU))
PEAK = 1e-3
SUDDEN = 1e-6                                             # what 3G + sqrt(3) H is in terms of 3G
LOSES_ALL = VonMises(E=E, nu=NU, peak=PEAK, residual=1e-12 * PEAK, softening=-0.1 * G)
AT_ONCE = VonMises(E=E, nu=NU, peak=PEAK, residual=0.1 * PEAK, softening=-(1 - SUDDEN) * np.sqrt(3) * G)
SIDE = 4                                                  # cells of a block
ROOM = 60


def weak(weight):
    """Soil that carries a millionth of its weight per area."""
    return VonMises(E=E, nu=NU, peak=1e-6 * weight, residual=1e-6 * weight)


def shear_strength(law, strain):
    """What is left of it after a total shear (half of the engineer's) without change of volume."""
    if 2 * law.G * strain <= law.peak:
        return 2 * law.G * strain
    # sqrt(J2) = 2 G (e - e_p) and c = c_p + H eps_p with eps_p = 2 / sqrt(3) e_p
    slope = 2 / np.sqrt(3) * law.softening
    plastic = (2 * law.G * strain - law.peak) / (2 * law.G + slope)
    return max(law.residual, law.peak + slope * plastic)


def size(sigma):
    """Root of J2."""
    deviator = sigma[:3] - sigma[:3].mean(axis=0)
    return np.sqrt((deviator ** 2).sum(axis=0) / 2 + sigma[3] ** 2)


def pressed(choices, quick, law):
    """Largest error of the shear stress of a cell that is pressed flat without change of volume, over the peak."""
    mesh = MeshQuad.init_tensor(*[np.arange(-1.0, 5)] * 2)
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < 1)).all(axis=0))
    steps, strain = 20, 4.1 * PEAK / (2 * G)
    move = strain / steps
    side = Wall(np.array([[1.0, 1.0], [0.0, 1.0]]), (move, None), name="side")
    lid = Wall(np.array([[0.0, 1.0], [1.0, 1.0]]), (None, -move), name="lid")
    worst = 0.0
    for state in implicit_steps(mesh, body, law, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1), side, lid],
                                steps=steps, strain="small", **choices):
        exact = shear_strength(law, strain * state.step / steps)
        worst = worst_of(worst, abs(size(state.particles.sigma) - exact).max() / law.peak)
    return worst


WEIGHT = 0.1                                              # of a block, over E


def heap():
    """A block on a rough floor with room to spread, and what holds it."""
    mesh = MeshQuad.init_tensor(np.arange(-1.0, ROOM + 1), np.arange(-2.0, SIDE + 5))
    body = Particles.fill(mesh, plane_strain, where=lambda x: ((x > 0) & (x < SIDE)).all(axis=0), density=1.0)
    return mesh, body, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1, (0, 1))]


def fallen(choices, quick, law):
    """The last state of a block that its weight pulls apart."""
    mesh, body, held = heap()
    return last(explicit_steps(mesh, body, law, held, steps=60 if quick else 150, every=10 ** 9,
                               gravity=(0.0, -WEIGHT / SIDE), **choices))


def beyond_yield(choices, quick, law):
    """How far stress of the block is beyond the yield surface, over the peak."""
    state = fallen(choices, quick, law)
    kept = law._cohesion(state.particles.history[0])
    return worst_of(0.0, (size(state.particles.sigma) - kept).max() / law.peak)


def gained(choices, quick, law):
    """Energy that comes from nowhere while the block falls apart, over the work of its weight."""
    energy = fallen(choices, quick, law).energy
    return worst_of(0.0, sum(energy[name] for name in ("kinetic", "elastic", "plastic")) / energy["external"] - 1)


def standing(choices, quick):
    """The same block at rest, in load steps: it cannot stand."""
    mesh, body, held = heap()
    state = last(implicit_steps(mesh, body, weak(WEIGHT), held, steps=2,
                                gravity=lambda step: (0.0, -WEIGHT / SIDE * step / 2), **choices))
    return size(state.particles.sigma).max() / weak(WEIGHT).peak


def confined(choices, quick, weight=1e-3):
    """The same soil between smooth walls: error of the vertical stress, over that at the bottom."""
    mesh = MeshQuad.init_tensor(np.arange(-1.0, 4), np.arange(-1.0, SIDE + 4))
    body = Particles.fill(mesh, plane_strain, density=1.0,
                          where=lambda x: (x[0] > 0) & (x[0] < 2) & (x[1] > 0) & (x[1] < SIDE))
    held = [FixedPlane(0, 0.0, -1), FixedPlane(0, 2.0, 1), FixedPlane(1, 0.0, -1)]
    state = last(implicit_steps(mesh, body, weak(weight), held, steps=2, strain="small",
                                gravity=lambda step: (0.0, -weight / SIDE * step / 2), **choices))
    # stress is constant in a cell of linear functions: compare means over them
    exact = -weight / SIDE * (SIDE - body.x[1])
    layer = np.floor(body.x[1]).astype(int)
    mean = [np.bincount(layer, row) / np.bincount(layer) for row in (state.particles.sigma[1], exact)]
    return abs(mean[0] - mean[1]).max() / weight


FALL = """A block of 4 x 4 cells on a rough floor, weight 0.1 E at its foot, {}; explicit steps until it flows ({})."""
FLAT = """A cell is pressed flat between smooth plates without change of volume, to four times the strain of first
           yield in 20 steps at small strain, {}; the largest error of the shear stress at points, over the peak."""
BROKEN = "inside out|times the energy|leaves the grid|more than a cell"
GONE = "loses all of its strength"

ROWS = [
    Row("strength lost at once, implicit",
        FLAT.format("3 G + sqrt(3) H being 3e-6 G (a little more, and there would be no return)"),
        partial(pressed, law=AT_ONCE), holds=1e-3, useless=0.1, stops="Newton|residual"),
    Row("strength lost to nothing, implicit", FLAT.format("softening to 1e-12 of the peak"),
        partial(pressed, law=LOSES_ALL), holds=1e-3, useless=0.1, stops="Newton|residual"),
    Row("strength lost at once, explicit: yield", FALL.format(GONE, "stress beyond the yield surface, over the peak"),
        partial(beyond_yield, law=AT_ONCE), holds=1e-9, useless=1e-3, stops=BROKEN),
    Row("strength lost to nothing, explicit: yield",
        FALL.format("softens to 1e-12 of its peak", "stress beyond the yield surface, over the peak"),
        partial(beyond_yield, law=LOSES_ALL), holds=1e-9, useless=1e-3, stops=BROKEN),
    Row("strength lost to nothing, explicit: energy",
        FALL.format("softens to 1e-12 of its peak", "energy gained from nowhere, over the work of the weight"),
        partial(gained, law=LOSES_ALL), holds=0.01, useless=0.5, stops=BROKEN),
    Row("strength 1e-6 of the load, explicit: yield",
        FALL.format("carries 1e-6 of that", "stress beyond the yield surface, over the strength"),
        partial(beyond_yield, law=weak(WEIGHT)), holds=1e-6, useless=1e-2, stops=BROKEN),
    Row("strength 1e-6 of the load, implicit: confined",
        """The same soil between smooth walls, which is as good as a fluid; the largest error of the vertical stress as
        a mean over cells, over that at the bottom.""", confined, holds=0.01, useless=0.5, stops="Newton|residual"),
    Row("strength 1e-6 of the load, implicit: unconfined",
        """The block cannot stand: there is no equilibrium.  Stress beyond the yield surface if one is found
        nonetheless.""", standing, holds=0.0, useless=0.0, stops="Newton|residual"),
]
