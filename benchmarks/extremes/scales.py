"""Units and places: scenes scaled by powers of two and of ten, far from the origin, and on graded grids."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from skfem import MeshLine, MeshQuad

from extremes.bodies import FASTEST, last, rms, worst_of
from extremes.row import Row
from skfem_mpm import LinearElastic, Particles, explicit_steps, implicit_steps, plane_strain, uniaxial
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.materials import Hencky
from skfem_mpm.scenes.self_weight import self_weight

TITLE = "Scales"
WORDS = """
One scene, a block of soil of 3 by 3 m in plane strain that falls onto its base, or stands on it (E = 10 MPa,
nu = 0.3, 2000 kg per cubic metre), in other units and at other places.
"""


@dataclass(frozen=True)
class Units:
    """How many of the units of length, mass and time are in a metre, a kilogram and a second; and a shift in metres."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0
    shift: float = 0.0

    @property
    def stress(self):
        """In plane strain mass is per metre of depth, so it stands for a mass per length."""
        return self.mass / self.time ** 2

    @property
    def acceleration(self):
        return self.length / self.time ** 2


SI = Units()


def scene(units):
    """Mesh, points, law and planes."""
    lines = [units.length * (units.shift + np.arange(-2.0, 7.0))] * 2
    inside = [axis[2:6] for axis in lines]
    body = Particles.fill(MeshQuad.init_tensor(*inside), plane_strain, density=2000.0 * units.mass / units.length ** 2)
    at = float(lines[0][2])
    planes = [FixedPlane(0, at, -1, name="side"), FixedPlane(1, at, -1, name="base")]
    return MeshQuad.init_tensor(*lines), body, LinearElastic(E=1e7 * units.stress, nu=0.3), planes


def moved(run, choices, units, **given):
    """Displacement and stress at the end of a run, in metres and pascals."""
    mesh, body, law, planes = scene(units)
    gravity = (2.0 * units.acceleration, -10.0 * units.acceleration)
    state = last(run(mesh, body, law, planes, units, gravity=gravity, **given, **choices))
    points = state.particles
    return (points.x - body.x) / units.length, points.sigma / units.stress, points.x / units.length


def falling(mesh, body, law, planes, units, **choices):
    """Time steps of the block, thrown sideways and down at 7 m/s, so that points cross cells."""
    speed = np.array([[7.0], [-7.0]]) * units.length / units.time
    thrown = replace(body, velocity=np.broadcast_to(speed, body.x.shape).copy())
    return explicit_steps(mesh, thrown, law, planes, steps=40, every=40, **choices)


def standing(mesh, body, law, planes, units, **choices):
    """Load steps of the block, under 20 times its weight."""
    gravity = np.array(choices.pop("gravity"))
    return implicit_steps(mesh, body, law, planes, steps=2, gravity=lambda step: tuple(10 * step * gravity), **choices)


def changed(run, choices, kinds, **given):
    """Largest difference that units make, relative to the largest number of its kind."""
    reference = moved(run, choices, SI, **given)
    worst = 0.0
    for units in kinds:
        for a, b in zip(moved(run, choices, units, **given), reference):
            worst = worst_of(worst, abs(a - b).max() / abs(b).max())
    return worst


def scaled(factor):
    """Length, mass and time by a factor and its inverse, one by one and together."""
    return [Units(**{name: each for name in names}) for each in (factor, 1 / factor)
            for names in (("length",), ("mass",), ("time",), ("length", "mass", "time"))]


ENGINES = sorted({"numpy", FASTEST})
BINARY, DECIMAL = scaled(2.0 ** 30), scaled(1e9)
ENGINEERS = [Units(1e3, 1e-3, 1.0), Units(1e3, 1.0, 1e3), Units(1e3, 1e-6, 1e3), Units(1e-3, 1e-12, 1 / 3600),
             Units(1 / 0.3048, 1 / 14.5939, 1.0)]


def binary(choices, quick, run):
    """Both engines."""
    return worst_of(changed(run, choices, BINARY[3:5] if quick else BINARY, engine=engine) for engine in ENGINES)


def decimal(choices, quick, run):
    """By 1e9 and 1e-9, and other systems of units."""
    return changed(run, choices, DECIMAL[::4] if quick else DECIMAL + ENGINEERS, engine="numpy")


def far(choices, quick, run):
    """A million body sizes from the origin, in cells whose edges are no binary numbers."""
    reference, away = (moved(run, choices, Units(0.1, shift=shift), engine="numpy") for shift in (0.0, 3e6))
    return worst_of(abs(a - b).max() / abs(b).max() for a, b in zip(away[:2], reference))


def graded(spare=3):
    """A line of four cells of size 1, four of 0.001 and four of 1, and cells of size 1 around."""
    return np.cumsum([-spare, *[1.0] * (spare + 4), *[1e-3] * 4, *[1.0] * (spare + 4)])


def graded_flight(choices, quick):
    """Largest stress of a bar on a graded grid that flies over three of the small cells."""
    lines = graded()
    body = Particles.fill(MeshLine(lines[3:-3]), uniaxial, density=1.0)
    flying = replace(body, velocity=np.full(body.x.shape, 0.1))
    state = last(explicit_steps(MeshLine(lines), flying, LinearElastic(E=1.0, nu=0.0), steps=150, every=150, dt=2e-4,
                                engine="numpy", **choices))
    return abs(state.particles.sigma).max()


def graded_column(choices, quick):
    """Rms error of stress of a column on a graded grid, relative to the largest."""
    lines, load = graded(), 1e-4
    body = Particles.fill(MeshLine(lines[3:-3]), uniaxial, density=1.0)
    height = lines[-4]
    base = [FixedPlane(0, 0.0, -1, name="base")]
    state = last(implicit_steps(MeshLine(lines), body, Hencky(E=1.0, nu=0.0), base, steps=1,
                                gravity=(-load / height,), **choices))
    stretch = self_weight(body.x[0], height, load)[1]
    return rms(state.particles.sigma[0] - np.log(stretch) / stretch) / load


ROWS = [
    Row("scaled by powers of two",
        """Forty time steps of the block, with length, mass and time in units 2^30 and 2^-30 times as large, one by one
        and together, in both engines; the largest difference of displacement, stress or position after scaling back,
        relative to the largest number of its kind.  All bits should be the same.""",
        partial(binary, run=falling), holds=0.0, useless=1e-6, must=True),
    Row("scaled by powers of two (implicit)",
        """The same of two load steps.""",
        partial(binary, run=standing), holds=0.0, useless=1e-6, must=True),
    Row("scaled by 1e9 and 1e-9, and in other systems of units",
        """As above by powers of ten, and in t, mm, s; kN, mm, ms; GN, mm, ms; Tg, km, h and slug, ft, s: round-off of
        forty steps.""",
        partial(decimal, run=falling), holds=1e-11, useless=1e-6, must=True),
    Row("scaled by 1e9 and 1e-9, and in other systems of units (implicit)",
        """The same of two load steps.""",
        partial(decimal, run=standing), holds=1e-11, useless=1e-6, must=True),
    Row("a million body sizes from the origin",
        """The block in cells of 0.1 m, at the origin and a million times its size away; largest difference of
        displacement and stress after forty steps, relative to the largest.  There the coordinates of points and grid
        are rounded to 6e-10 of a cell, at every step.""",
        partial(far, run=falling), holds=1e-6, useless=1e-3, must=True),
    Row("a million body sizes from the origin (implicit)",
        """The same of two load steps.""",
        partial(far, run=standing), holds=1e-6, useless=1e-3, must=True),
    Row("cells of 1 and 0.001 side by side, in flight",
        """A bar on four cells of size 1, four of 0.001 and four of 1 flies over three of the small ones; largest stress
        in units of the modulus.""",
        graded_flight, holds=1e-11, useless=1e-6, remedies=("dual",),
        stops="beyond the neighbours|turned inside out|more than a cell"),
    Row("cells of 1 and 0.001 side by side, a column (implicit)",
        """The bar stands up under its own weight, which moves points by less than a small cell; rms error of stress
        relative to the largest.  Linear functions alone make 3 %.""",
        graded_column, holds=0.045, useless=0.58, remedies=("field", "cubic", "twin", "dual", "ghost"),
        stops="beyond the neighbours"),
]
