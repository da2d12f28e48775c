"""Stiffness, density and strength far apart, and nearly no compression."""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.special import j0, j1, y0, y1
from skfem import MeshLine, MeshQuad

from extremes.bodies import last, misfit, rms, until
from extremes.contrast import ROWS as CONTRASTS
from extremes.row import Row
from extremes.strength import ROWS as STRENGTHS
from skfem_mpm import LinearElastic, Particles, axisymmetric, explicit_steps, implicit_steps
from skfem_mpm.boundary import FixedPlane, Wall

TITLE = "Materials"
WORDS = """
Young's modulus is 1 unless a row says otherwise. Thick cylinders have the radii 1 and 3; at nearly constant volume they
move as $u = a / r$. No linear function of the radius does so, and points that each see a dilation of their own lock:
runs with a Poisson's ratio above 0.45 and without `remedy="bbar"` warn of it. The stiffest point of a cell says how
stiff the cell is: runs with points of a cell whose stiffness differs more than a hundred times warn too.
"""

INNER, OUTER = 1.0, 3.0
MODERATE = (0.0, 0.3, 0.49)
NEARLY = (0.499, 0.499999)
LOCKING = "lock"


# -- thick cylinders --------------------------------------------------------------------------------------------------

def expansion(choices, quick, nu):
    """Wall pressure and point stress (rms) of a cylinder whose inner wall moves, as errors over the wall's pressure."""
    cells, push, law = 20, 1e-6, LinearElastic(E=1.0, nu=nu)
    h = (OUTER - INNER) / cells
    mesh = MeshQuad.init_tensor(INNER + h * np.arange(-1, cells + 2), h * np.arange(-1, 3))
    body = Particles.fill(mesh, axisymmetric, where=lambda x: (
        (x[0] > INNER) & (x[0] < OUTER) & (x[1] > 0) & (x[1] < h)))
    wall = Wall(np.array([[INNER, INNER], [0.0, h]]), (push, None), name="inner")
    held = [FixedPlane(1, 0.0, -1), FixedPlane(1, h, 1), wall]
    state = last(implicit_steps(mesh, body, law, held, steps=1, strain="small", **choices))
    # u = a r + b / r, free of stress at the outer radius
    a, b = np.linalg.solve([[INNER, 1 / INNER], [2 * (law.lam + law.G), -2 * law.G / OUTER ** 2]], [push, 0])
    pressure = 2 * law.G * b / INNER ** 2 - 2 * (law.lam + law.G) * a
    exact = 2 * (law.lam + law.G) * a - 2 * law.G * b / body.x[0] ** 2
    load = abs(state.reactions["inner"][0] / (h * pressure) - 1)
    return load, rms(state.particles.sigma[0] - exact) / pressure


def load_error(choices, quick, nu):
    return expansion(choices, quick, nu)[0]


def stress_error(choices, quick, nu):
    return expansion(choices, quick, nu)[1]


def breathing_mode(law):
    """Frequency and radial shape of the lowest mode of a long cylinder of density 1 with free faces."""
    speed = np.sqrt(law.lam + 2 * law.G)

    def stress(k, r):                                  # of J1(kr) and Y1(kr), with u' + u / r = k J0(kr)
        return [(law.lam + 2 * law.G) * k * f0(k * r) - 2 * law.G * f1(k * r) / r for f0, f1 in ((j0, j1), (y0, y1))]

    def both(k):
        (a, b), (c, d) = stress(k, INNER), stress(k, OUTER)
        return a * d - b * c

    k = brentq(both, 0.1 * np.sqrt(law.G) / speed, 2 * np.sqrt(law.G) / speed, xtol=1e-14)
    a, b = stress(k, INNER)
    return k * speed, lambda r: b * j1(k * r) - a * y1(k * r)


def breathing(choices, quick, nu):
    """Error of the displacement (rms over points) of a breathing cylinder after a part of its period."""
    law, cells = LinearElastic(E=1.0, nu=nu), 8
    h, (frequency, shape) = (OUTER - INNER) / cells, breathing_mode(law)
    mesh = MeshLine(INNER + h * np.arange(-2, cells + 3))
    body = Particles.fill(mesh, axisymmetric, where=lambda x: (x[0] > INNER) & (x[0] < OUTER), density=1.0)
    mode, time = shape(body.x), np.pi / (100 if quick else 8) / frequency
    mode = mode / abs(mode).max()
    moving = replace(body, velocity=1e-6 * frequency * mode)
    state = until(time, explicit_steps(mesh, moving, law, steps=10 ** 9, every_seconds=time / 10, **choices))
    exact = 1e-6 * np.sin(frequency * state.time) * mode
    return misfit(state.particles.x - body.x, exact)


def poisson_rows():
    rows = []
    for nu in (*MODERATE, *NEARLY):
        moderate = nu in MODERATE
        remedies = () if nu < 0.49 else ("b-bar", "twin", "dual")
        rows += [
            Row(f"Poisson's ratio {nu:g}, implicit: load",
                """The inner wall of a thick cylinder of 20 cells moves by 1e-6 (axial symmetry, one step at small
                strain); the error of its pressure against Lame.""",
                partial(load_error, nu=nu), holds=0.05, useless=0.5, must=moderate, remedies=remedies,
                warns=LOCKING),
            Row(f"Poisson's ratio {nu:g}, explicit",
                """A thick cylinder of 8 cells breathes in its lowest mode; the error of its displacement after a
                sixteenth of the period (quick: a two hundredth), rms over points, in terms of the exact one.""",
                partial(breathing, nu=nu), holds=0.05, useless=0.5, must=moderate,
                remedies=remedies[:1], warns=LOCKING, stops="times the energy")]
    rows += [Row(f"Poisson's ratio {nu:g}, implicit: stress at points",
                 """The same cylinder as for the load: rms error of the radial stress over all points, in terms of the
                 wall's pressure.""",
                 partial(stress_error, nu=nu), holds=0.05, useless=0.5, warns=LOCKING,
                 remedies=("b-bar", "twin", "dual")) for nu in (0.3, 0.49, *NEARLY)]
    return rows


ROWS = [*poisson_rows(), *CONTRASTS, *STRENGTHS]
