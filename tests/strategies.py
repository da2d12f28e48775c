"""What property-based tests draw: graded grids, points at awkward places, bodies, and whole scenes."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from shared import MAKE

from skfem_mpm import (
    METHODS,
    Hencky,
    LinearElastic,
    Particles,
    VonMises,
    axisymmetric,
    plane_strain,
    solid,
    uniaxial,
)
from skfem_mpm.boundary import FixedPlane
from skfem_mpm.grid import Grid
from skfem_mpm.integration import INTEGRATIONS

MOTIONS = [(1, uniaxial), (1, axisymmetric), (2, plane_strain), (2, axisymmetric), (3, solid)]

powers = st.floats(-6, 6).map(lambda power: 10.0 ** power)


def numbers(least, most):
    """Floats of twelve digits: small, but never so small that their squares underflow."""
    return st.floats(least, most).map(lambda number: round(number, 12))


shares = numbers(0, 1)
units = numbers(-1, 1)
grades = units.map(lambda power: round(power, 6))       # cells count as equal that differ by less than a billionth
motions = st.sampled_from(MOTIONS)


# -- grids and points ----------------------------------------------------------------------------------------------

@st.composite
def axes(draw, dim, least=1, most=6, offset=100.0, graded=True):
    """Node coordinates: neighbouring cells differ by up to ten times, the whole measures 1e-6 to 1e6."""
    size, found = draw(powers), []
    for _ in range(dim):
        ratios = draw(st.lists(grades if graded else st.just(0.0), min_size=least - 1, max_size=most - 1))
        widths = np.cumprod(10.0 ** np.array([0.0, *ratios]))
        line = np.concatenate([[0.0], np.cumsum(widths)]) / widths.max()
        found.append(size * (line + draw(st.sampled_from([0.0, 1.0, -line[-1] / 2, offset, -offset]))))
    return tuple(found)


@st.composite
def places(draw, axis, low=0, high=None):
    """A coordinate between the nodes ``low`` and ``high``: inside a cell, on a node, or an ulp beside it."""
    high = len(axis) - 1 if high is None else high
    cell = draw(st.integers(low, high - 1))
    share = draw(st.one_of(shares, st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])))
    x = axis[cell] + share * (axis[cell + 1] - axis[cell])
    beside = draw(st.sampled_from([0, 0, -np.inf, np.inf]))
    return np.clip(np.nextafter(x, beside) if beside else x, axis[low], axis[high])


@st.composite
def points(draw, lines, least=1, most=8, margin=0):
    """Positions ``(dim, n)``, off the first and last ``margin`` cells of each axis."""
    point = st.tuples(*[places(axis, margin, len(axis) - 1 - margin) for axis in lines])
    return np.array(draw(st.lists(point, min_size=least, max_size=most))).T.reshape(len(lines), -1)


@st.composite
def layouts(draw, motion=motions, margin=0, most=8, **kind):
    """A mesh and points on it, with random volumes, masses and domains that reach no further than GIMP allows."""
    dim, kinematics = draw(motion)
    lines = draw(axes(dim, least=1 + 2 * margin, **kind))
    if kinematics is axisymmetric:                                  # an axis of rotation far from the points
        lines = (lines[0] - lines[0][0] + draw(st.sampled_from([1.0, 100.0])) * (lines[0][-1] - lines[0][0]),
                 *lines[1:])
    mesh = MAKE[dim](*lines)
    grid = Grid.from_mesh(mesh)
    x = draw(points(grid.axes, margin=margin, most=most))
    n = x.shape[1]
    widest = grid.fitting(x, grid.locate(x), np.full(x.shape, np.inf))
    if margin:                                                      # and stay on the grid
        low, high = (np.array([[axis[end]] for axis in grid.axes]) for end in (0, -1))
        widest = np.minimum(widest, 2 * np.minimum(x - low, high - x))
    length = widest * np.array(draw(st.lists(st.floats(0.01, 1), min_size=dim * n, max_size=dim * n))).reshape(dim, n)
    uneven = 10.0 ** np.array(draw(st.lists(st.floats(-3, 3), min_size=n, max_size=n)))
    volume = length.prod(axis=0) * (x[0] if kinematics is axisymmetric else 1.0)
    return mesh, Particles(x, volume, volume * uneven * draw(powers), kinematics, length=length)


# -- scenes --------------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Scene:
    """What a run is made of; ``choices`` are its keyword arguments."""

    mesh: Any
    body: Particles
    law: Any
    boundary: list
    choices: dict

    def run(self, steps_of, steps, **more):
        """States of ``explicit_steps`` or ``implicit_steps``; these choices, but for what is said anew."""
        return steps_of(self.mesh, self.body, self.law, self.boundary, steps=steps, **{**self.choices, **more})

    def scaled(self, length, mass, time):
        """The same scene in units that are powers of two of its own."""
        motion, body = self.body.kinematics, self.body
        along, heavy, fast, late = 2.0 ** length, 2.0 ** mass, 2.0 ** (length - time), 2.0 ** time
        space = body.dim + motion.hoop                                          # of which volume is a measure
        stress = 2.0 ** (mass + (2 - space) * length - 2 * time)
        moved = replace(body, x=body.x * along, volume=body.volume * 2.0 ** (space * length), mass=body.mass * heavy,
                        length=body.length * along, velocity=body.velocity * fast)
        stiff = {name: getattr(self.law, name) * stress for name in ("E", "peak", "residual", "softening")
                 if hasattr(self.law, name)}
        units = {"dt": late, "ramp": late, "gravity": fast / late}
        return Scene(MAKE[body.dim](*[axis * along for axis in Grid.from_mesh(self.mesh).axes]), moved,
                     replace(self.law, **stiff), [replace(plane, at=plane.at * along) for plane in self.boundary],
                     {name: value * units.get(name, 1.0) if name in units else value
                      for name, value in self.choices.items()})


@st.composite
def blocks(draw, motion=motions, **kind):
    """A mesh and a body that fills a block of its cells, off the outermost ones, its points pushed about a little."""
    dim, kinematics = draw(motion)
    lines = draw(axes(dim, least=3, most=5, **kind))
    if kinematics is axisymmetric:
        lines = (lines[0] - 2 * lines[0][0] + lines[0][-1], *lines[1:])
    cells = [sorted(draw(st.lists(st.integers(1, len(line) - 2), min_size=2, max_size=2))) for line in lines]
    inner = [line[low:high + 2] for line, (low, high) in zip(lines, cells)]
    per_cell = draw(st.integers(1, 3 - dim // 2))
    body = Particles.fill(MAKE[dim](*inner), kinematics, density=draw(powers), per_cell=per_cell)
    push = draw(st.sampled_from([0.0, 0.2])) * np.cos(np.arange(body.x.size)).reshape(body.x.shape)
    return MAKE[dim](*lines), replace(body, x=body.x + push * body.length)


@st.composite
def laws(draw, dim, finite):
    """Any law that fits, of any stiffness; soil yields early."""
    E, nu = draw(powers), draw(numbers(0, 0.49))
    kind = draw(st.sampled_from([LinearElastic] + [Hencky] * finite + [VonMises] * (dim > 1)))
    if kind is not VonMises:
        return kind(E=E, nu=nu)
    peak = E * 10.0 ** draw(st.floats(-6, -1))
    return VonMises(E=E, nu=nu, peak=peak, residual=peak * draw(st.floats(0.01, 1)),
                    softening=-E * draw(st.sampled_from([0.0, 0.01, 0.3])))


@st.composite
def planes(draw, grid, x):
    """Fixed planes on lines of the grid beyond the points, rough or smooth; often the nearest."""
    found = []
    for axis, line in enumerate(grid.axes):
        for side, beyond in ((-1, line[line <= x[axis].min()][::-1]), (1, line[line >= x[axis].max()])):
            if draw(st.booleans()):
                at = beyond[0] if draw(st.booleans()) else draw(st.sampled_from(list(beyond)))
                rough = draw(st.booleans())
                found.append(FixedPlane(axis, float(at), side, tuple(range(grid.dim)) if rough else ()))
    return found


@st.composite
def bodies_at_speed(draw, calm, edges):
    """A mesh, a body and its law; and the width of the smallest cell, and the speed of its waves."""
    scattered = layouts(margin=int(edges == "ghost"))
    mesh, body = draw(st.one_of(blocks(), scattered))
    finite = draw(st.booleans())
    law = draw(laws(body.dim, finite))
    wave = np.sqrt(law.E * body.volume.sum() / body.mass.sum())
    speed = wave * 10.0 ** draw(st.floats(-6, -3 if calm else 1))
    velocity = draw(st.lists(units, min_size=body.dim, max_size=body.dim))
    noise = np.sin(np.arange(body.x.size)).reshape(body.x.shape) * draw(shares)
    body = replace(body, velocity=speed * (np.array(velocity)[:, None] + noise))
    width = min(step.min() for step in Grid.from_mesh(mesh).steps)
    return mesh, body, law, "logarithmic" if finite else "small", width, wave


@st.composite
def explicit_scenes(draw, calm=False, free=False):
    """Any scene for ``explicit_steps``; slow in steps that are found if ``calm``, without loads if ``free``."""
    edges = draw(st.sampled_from(["ghost", "clip"] + ["truncate"] * (not free)))
    mesh, body, law, strain, width, wave = draw(bodies_at_speed(calm, edges))
    choices = {
        "method": draw(st.sampled_from(list(METHODS))), "strain": strain, "edges": edges,
        "integrator": draw(st.sampled_from(["musl", "usl", "usf", "usavg"])), "flip": draw(shares),
        "xpic": draw(st.integers(0, 3)), "tpic": draw(st.booleans()),
        "domains": draw(st.sampled_from(["fixed", "stretched"])), "radius": draw(st.sampled_from(["point", "domain"])),
        "integration": draw(st.sampled_from(["points", "points", "twin", "twin2", "dual"])),
        "remedy": draw(st.sampled_from(["none", "bbar"])) if edges != "truncate" else "none",
        "safety": draw(st.floats(0.05, 0.5 if calm else 1)), "refresh": draw(st.sampled_from([None, 1, 3])),
        "leaving": draw(st.sampled_from(["error", "remove"])),
    }
    if not free:
        choices["damping"] = draw(shares)
        choices["gravity"] = np.array(draw(st.lists(units, min_size=body.dim, max_size=body.dim))) * (
            wave ** 2 / width * 10.0 ** draw(st.floats(-6, -4 if calm else 1)))
        choices["ramp"] = draw(st.sampled_from([0.0, width / wave]))
    if not calm and draw(st.booleans()):
        choices["dt"] = width / wave * 10.0 ** draw(st.floats(-3, 3))
    return Scene(mesh, body, law, [] if free else draw(planes(Grid.from_mesh(mesh), body.x)), choices)


@st.composite
def implicit_scenes(draw, integrations=("points",) * 8 + tuple(INTEGRATIONS), calm=False):
    """Any scene for ``implicit_steps``, with and without inertia; ``calm`` ones strain little."""
    edges = draw(st.sampled_from(["ghost", "clip", "truncate"]))
    mesh, body, law, strain, width, wave = draw(bodies_at_speed(calm, edges))
    scheme = draw(st.sampled_from(["equilibrated"] * 3 + ["incremental"] * (not law.kirchhoff)))
    integration = draw(st.sampled_from(integrations))
    bars = edges == "truncate" or (body.dim == 1 and body.kinematics is not axisymmetric) or integration != "points"
    choices = {
        "method": draw(st.sampled_from(list(METHODS))), "strain": strain, "edges": edges, "scheme": scheme,
        "integration": integration, "remedy": "none" if bars else draw(st.sampled_from(["none", "bbar"])),
        "weights": draw(st.sampled_from(["one", "eq10", "interior", "overlap"])) if integration == "points" else "one",
        "domains": draw(st.sampled_from(["fixed", "stretched"])), "radius": draw(st.sampled_from(["point", "domain"])),
        "tangent": draw(st.sampled_from([None, None, "exact", "conjugate"])), "max_cuts": 2,
        "floor": draw(st.sampled_from([0.0, 1e-6, 1e-3])), "ghost": draw(st.sampled_from([0.0, 0.1])),
        "gravity": np.array(draw(st.lists(units, min_size=body.dim, max_size=body.dim))) * (
            wave ** 2 / width * 10.0 ** draw(st.floats(-6, -4 if calm else 1))),
    }
    grid = Grid.from_mesh(mesh)
    boundary = draw(planes(grid, body.x))
    if scheme == "equilibrated" and draw(st.booleans()):
        choices["dt"] = width / wave * 10.0 ** draw(st.floats(-3, 3))
    else:                                                                       # something has to hold it
        below = grid.axes[0][grid.axes[0] <= body.x[0].min()]
        boundary.append(FixedPlane(0, float(below[-1]), -1, tuple(range(body.dim)), name="rough"))
    return Scene(mesh, body, law, boundary, choices)
