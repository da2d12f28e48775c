"""Stretch, compression, shear and rotation far beyond the usual; the axis of rings."""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.special import j0, j1
from skfem import MeshLine, MeshQuad

from extremes.bodies import last, misfit, rms, until
from extremes.prescribed import sheared, turned
from extremes.row import Row
from skfem_mpm import LinearElastic, Particles, axisymmetric, explicit_steps, implicit_steps, uniaxial
from skfem_mpm.boundary import FixedPlane, Wall

TITLE = "Large deformation"
WORDS = """
Turns and simple shear are prescribed at the nodes, so that strain, stress, domains and positions of points are followed
through thousands of steps and many cells, without equations of motion. In one dimension the logarithmic strain of a bar
that is stretched $\\lambda$ times is $\\ln\\lambda$; its points end up further apart than cells are long.
"""

BAR = LinearElastic(E=1.0, nu=0.0)
APART = ("nothing holds|Newton|singular|residual|inside out|carries no mass|more than a cell|outside the grid|"
         "behind the plane")
GAPS = "comes* apart|too few"


# -- turns ------------------------------------------------------------------------------------------------------------

def hundred_turns(choices, quick, solver):
    return turned(solver, choices, "logarithmic", 10.0, 72 if quick else 3600)


def a_turn(choices, quick, solver):
    return turned(solver, choices, "logarithmic", 10.0, 9 if quick else 36)


def one_turn(choices, quick):
    """Drift of the objective rate per turn, from a twelfth of it in steps of 1 degree."""
    return 12 * turned("explicit", choices, "small", 1.0, 30)


def order_of_drift(choices, quick):
    """How far the order of that drift in the angle of a step is from one."""
    coarse, fine = (turned("explicit", choices, "small", angle, round(30 / angle)) for angle in (2.0, 1.0))
    return abs(np.log2(coarse / fine) - 1)


# -- bars -------------------------------------------------------------------------------------------------------------

def pulled(choices, quick, stretch, cells=4, per_cell=2, follows=False):
    """Error of the stress of a bar (rms over points) between a wall and a plane, over the exact one."""
    end = max(stretch, 1.0) * cells
    mesh = MeshLine(np.arange(-4.0, end + 5))
    body = Particles.fill(MeshLine(np.arange(cells + 1.0)), uniaxial, per_cell=per_cell)
    steps = int(np.ceil((2 if quick else 20) * abs(stretch - 1) * max(1.0, 1 / stretch / 2)))
    wall = Wall(np.array([[float(cells)]]), ((stretch - 1) * cells / steps,), name="end")

    def grid(state):
        return MeshLine(np.arange(-4.0, cells + 5) * state.boundary[1].x[0, 0] / cells)

    state = last(implicit_steps(grid if follows else mesh, body, BAR, [FixedPlane(0, 0.0, -1), wall], steps=steps,
                                **choices))
    return relative(state.particles.sigma[0], np.log(stretch))


def relative(found, exact):
    return rms(found - exact) / abs(exact)


def thrown(choices, quick, stretch, cells):
    """The same of a soft bar whose points fly apart (or together) so fast that stress hardly matters."""
    half = cells / 2
    body = Particles.fill(MeshLine(np.arange(-half, half + 1)), uniaxial, density=1.0)
    reach = np.ceil(max(stretch, 1.0) * half) + 4
    body, mesh = replace(body, x=body.x + 0.1), MeshLine(np.arange(-reach, reach + 1))
    steps = 200 if quick else 800
    rate, soft = 1e-3, LinearElastic(E=1e-12, nu=0.0)
    body = replace(body, velocity=rate * np.sign(stretch - 1) * body.x)
    state = last(explicit_steps(mesh, body, soft, steps=steps, every=steps, strain="logarithmic",
                                dt=abs(stretch - 1) / rate / steps, **choices))
    return relative(state.particles.sigma[0] / soft.E, np.log(stretch))


# -- the axis ---------------------------------------------------------------------------------------------------------

def solid_cylinder(cells, height=1):
    mesh = MeshQuad.init_tensor(np.arange(-1.0, cells + 3), np.arange(-1.0, height + 2))
    body = Particles.fill(MeshQuad.init_tensor(np.arange(cells + 1.0), np.arange(height + 1.0)), axisymmetric,
                          density=1.0)
    return mesh, body, [FixedPlane(0, 0.0, -1), FixedPlane(1, 0.0, -1), FixedPlane(1, float(height), 1)]


def near_axis(body, radius):
    """The body with its innermost points at this radius."""
    x = body.x.copy()
    x[0, x[0] == x[0].min()] = radius
    return replace(body, x=x)


def squeezed(choices, quick, radius=None):
    """Largest error of the stress of a solid cylinder that is squeezed from outside, over the exact one."""
    law, cells, push = LinearElastic(E=1.0, nu=0.3), 8, 1e-6
    mesh, body, held = solid_cylinder(cells)
    if radius is not None:
        body = near_axis(body, radius)
    wall = Wall(np.array([[float(cells)] * 2, [0.0, 1.0]]), (-push * cells, None), name="outside")
    state = last(implicit_steps(mesh, body, law, [*held, wall], steps=1, **choices))
    exact = -2 * (law.lam + law.G) * push
    return abs(state.particles.sigma[[0, 2]] / exact - 1).max()


def breathing_rod(choices, quick, radius=None):
    """Error of the displacement of a solid cylinder that breathes in its lowest mode (rms), after T / 8."""
    law, cells = LinearElastic(E=1.0, nu=0.3), 8
    speed, modulus = np.sqrt(law.lam + 2 * law.G), law.lam + 2 * law.G
    k = brentq(lambda k: modulus * k * j0(k * cells) - 2 * law.G * j1(k * cells) / cells, 1e-3, 3.0 / cells)
    mesh, body, held = solid_cylinder(cells)
    if radius is not None:
        body = near_axis(body, radius)
    shape = np.stack([j1(k * body.x[0]), 0 * body.x[0]])
    moving, time = replace(body, velocity=1e-6 * k * speed * shape), np.pi / 4 / (k * speed)
    state = until(time, explicit_steps(mesh, moving, law, held, steps=10 ** 9, every_seconds=time / 10,
                                       engine="numpy", **choices))
    exact = 1e-6 * np.sin(k * speed * state.time) * shape
    return misfit(state.particles.x - body.x, exact)


# -- rows -------------------------------------------------------------------------------------------------------------

TURNS = """A block of 2 x 2 cells, half of its points stressed, is turned by hand in steps of 10 degrees (quick: two
           turns), logarithmic strain and the operators of {} steps; the largest difference of stress from what was
           brought, turned along, in units of E."""
SPUN = """The same with the small strain of explicit steps (Jaumann's rate), {}."""
PULL = """A bar of {} is {} between a plane and a wall; rms error of the stress over the exact one."""
THROW = """The points of a soft bar of {} fly {}; rms error of the stress over the exact one."""
SHEAR = """A block of 2 x 2 cells is sheared by hand to ten times its height in {} steps, {}; the largest error of the
           stress, in units of E, against the closed form of that rate."""
SQUEEZE = """A solid cylinder is squeezed by 1e-6 from outside, eight cells to the axis{}; the largest error of the
             radial and hoop stress, over the exact one."""
BREATHE = """A solid cylinder breathes in its lowest mode, eight cells to the axis{}; the error of its displacement
             after an eighth of the period, rms over points, in terms of the exact one."""
CLOSE = ", the innermost points a billionth of a cell from it"
NEAR = ", the innermost points a hundredth of a cell from it (the stable step falls in proportion)"
RINGS = ("ring domains",)

ROWS = [
    Row("100 turns, logarithmic strain, explicit", TURNS.format("explicit"), partial(hundred_turns, solver="explicit"),
        holds=1e-10, useless=1e-3, must=True),
    Row("100 turns, logarithmic strain, implicit", TURNS.format("implicit"), partial(hundred_turns, solver="implicit"),
        holds=1e-10, useless=1e-3, must=True),
    Row("a turn, logarithmic strain, explicit", "The same for one turn (quick: a quarter), with remedies.",
        partial(a_turn, solver="explicit"), holds=1e-10, useless=1e-3, must=True),
    Row("a turn, logarithmic strain, implicit", "The same for one turn (quick: a quarter), with remedies.",
        partial(a_turn, solver="implicit"), holds=1e-10, useless=1e-3, must=True),
    Row("a turn in steps of 1 degree, objective rate", SPUN.format("per turn"), one_turn, holds=0.01, useless=0.5),
    Row("order of that drift", SPUN.format("in steps of 2 and 1 degrees: how far the order is from one"),
        order_of_drift, holds=0.1, useless=0.5),
    Row("shear to 10, logarithmic strain, explicit", SHEAR.format("100 (quick: 25)", "logarithmic strain"),
        lambda choices, quick: sheared("explicit", choices, "logarithmic", 25 if quick else 100), holds=1e-9,
        useless=0.1),
    Row("shear to 10, logarithmic strain, implicit", SHEAR.format("100 (quick: 25)", "logarithmic strain"),
        lambda choices, quick: sheared("implicit", choices, "logarithmic", 25 if quick else 100), holds=1e-9,
        useless=0.1),
    Row("shear to 10, objective rate",
        SHEAR.format(250, "small strain of explicit steps, whose stress swings; the error is of first order in a step"),
        lambda choices, quick: sheared("explicit", choices, "small", 250), holds=0.03, useless=0.5),
    Row("stretch to 2, implicit", PULL.format("4 cells", "pulled to twice its length"), partial(pulled, stretch=2.0),
        holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "dual", "ghost", "field")),
    Row("stretch to 20, implicit", PULL.format("4 cells", "pulled to 20 times its length"),
        partial(pulled, stretch=20.0), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "field")),
    Row("stretch to 20 with 64 points per cell, implicit", PULL.format("4 cells", "pulled to 20 times its length"),
        partial(pulled, stretch=20.0, per_cell=64), holds=0.05, useless=0.5, stops=APART, warns=GAPS),
    Row("stretch to 20 on a grid that follows, implicit",
        PULL.format("4 cells", "pulled to 20 times its length, the mesh being a function of the state"),
        partial(pulled, stretch=20.0, follows=True), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "eq10", "twin", "field", "cubic")),
    Row("compression to 1/20, implicit", PULL.format("40 cells", "pressed to a twentieth of its length"),
        partial(pulled, stretch=0.05, cells=40), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "dual")),
    Row("stretch to 2, explicit", THROW.format("6 cells", "apart to twice its length"),
        partial(thrown, stretch=2.0, cells=6), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "dual", "tpic")),
    Row("stretch to 20, explicit", THROW.format("6 cells", "apart to 20 times its length"),
        partial(thrown, stretch=20.0, cells=6), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "dual", "tpic")),
    Row("compression to 1/20, explicit", THROW.format("40 cells", "together to a twentieth of its length"),
        partial(thrown, stretch=0.05, cells=40), holds=0.05, useless=0.5, stops=APART, warns=GAPS,
        remedies=("stretched domains", "twin", "dual", "tpic")),
    Row("down to the axis, implicit", SQUEEZE.format(""), squeezed, holds=0.01, useless=0.5, remedies=RINGS),
    Row("points near the axis, implicit", SQUEEZE.format(CLOSE), partial(squeezed, radius=1e-9), holds=0.05,
        useless=0.5, warns="over the axis", remedies=RINGS),
    Row("down to the axis, explicit", BREATHE.format(""), breathing_rod, holds=0.05, useless=0.5,
        stops="times the energy"),
    Row("points near the axis, explicit", BREATHE.format(NEAR), partial(breathing_rod, radius=0.01), holds=0.05,
        useless=0.5, stops="times the energy"),
    Row("points on the axis", "The same with the innermost points on the axis, where a ring has no volume.",
        partial(squeezed, radius=0.0), holds=0.05, useless=0.5, stops="above zero|radius"),
]
