"""Load steps that are too large, load paths that turn, bodies that come apart, options at their ends."""

from dataclasses import replace

import numpy as np
from scipy.integrate import quad
from scipy.special import lambertw
from skfem import MeshLine, MeshQuad

from extremes.bodies import block, grid_of, last, worst_of
from skfem_mpm import Hencky, LinearElastic, NotConvergedError, Particles, axisymmetric, implicit_steps, plane_strain
from skfem_mpm.boundary import FixedPlane, Wall
from skfem_mpm.implicit import Control

SOFT = Hencky(E=1.0, nu=0.0)
LINEAR = LinearElastic(E=1.0, nu=0.0)
BASE = [FixedPlane(0, 0.0, -1, name="base")]


def largest(values):
    return float(np.abs(values).max())


# -- one step for a hundred --------------------------------------------------------------------------------------------

def settled(x, length, load):
    """Where points of a bar of Hencky's material come to be; ``load`` at its fixed end, as a share of the modulus."""
    def stretch(at):
        return np.exp(-lambertw(-load * (length - at) / length).real)
    return np.array([quad(stretch, 0, at)[0] for at in x])


def column_at_once(choices, quick):
    """Error of positions over the settlement, of a column under 1.6 of its modulus."""
    length, load = 8, -1.6
    body = block(1, length)
    state = last(implicit_steps(grid_of(1, length, 3), body, SOFT, BASE, steps=1, gravity=(load / length,), **choices))
    exact = settled(body.x[0], length, load)
    return largest(state.particles.x[0] - exact) / largest(exact - body.x[0])


def bent(steps, choices):
    """A cantilever of 6 x 2 cells that its weight turns down."""
    body = Particles.fill(MeshQuad.init_tensor(np.arange(7.0), np.arange(3.0)), plane_strain, density=1.0)
    mesh = MeshQuad.init_tensor(np.arange(-3.0, 12.0), np.arange(-9.0, 6.0))
    root = [FixedPlane(0, 0.0, -1, (0, 1), name="root")]
    return body, last(implicit_steps(mesh, body, Hencky(E=1.0, nu=0.2), root, steps=steps,
                                     gravity=lambda step: (0.0, -5e-3 * step / steps), **choices))


def cantilever_at_once(choices, quick):
    """Largest distance from where the load in many steps puts the points, over the largest displacement."""
    (body, one), (_, many) = bent(1, choices), bent(8 if quick else 50, choices)
    return largest(one.particles.x - many.particles.x) / largest(many.particles.x - body.x)


def squeezed(start, steps, push, choices):
    """A block on its base under a wall that comes down by ``push`` a step."""
    mesh = grid_of(2, 3, 2)
    top = np.stack([np.linspace(0.1, 2.9, 7), np.full(7, 3.0)])
    held = [FixedPlane(1, 0.0, -1, (0, 1), name="base"), Wall(top, (None, -push), name="press")]
    if not isinstance(start, Particles):
        held[1] = replace(start.boundary[1], increment=(None, -push))
    return implicit_steps(mesh, start, Hencky(E=1.0, nu=0.3), held, steps=steps, **choices)


def from_the_last_good_state(choices, quick):
    """A press through the floor has to stop; then the run goes on from the state that is left, as if nothing was."""
    body = block(2, 3)
    whole = list(squeezed(body, 6, 0.02, choices))
    try:
        last(squeezed(whole[2], 1, 4.0, choices))
    except NotConvergedError as stop:
        again = last(squeezed(stop.state, 3, 0.02, choices))
        return largest(again.particles.x - whole[-1].particles.x) / largest(whole[-1].particles.x - body.x)
    return np.inf


def cavity(choices, quick):
    """Error of the pressure of a cavity that is opened by half its radius in one step, nearly incompressible."""
    inner, outer, opened, worst = 4.0, 12.0, 2.0, 0.0
    change = (inner + opened) ** 2 - inner ** 2
    exact = quad(lambda r: 2 * np.log(r * r / (r * r - change)) / r, inner + opened, np.sqrt(outer ** 2 + change))[0]
    for shift in (0.0, 1e-6) if quick else (0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.3, 0.5, 0.7, 0.9):
        mesh = MeshLine(np.arange(1.0, 19.0) - shift)
        fill = Particles.fill(MeshLine(np.arange(inner, outer + 1)), axisymmetric, density=1.0)
        wall = Wall(np.array([[inner]]), (opened,), name="cavity")
        state = last(implicit_steps(mesh, fill, Hencky(E=2 * (1 + 0.4999), nu=0.4999), [wall], steps=1,
                                    remedy="bbar", **choices))
        worst = worst_of(worst, abs(state.reactions["cavity"][0] / ((inner + opened) * exact) - 1))
    return worst


# -- on and off, and through the grid ----------------------------------------------------------------------------------

def pushed(choices, quick):
    """A bar squeezed by half a per cent between two walls that carry it on: how far its reaction strays."""
    ends = [Wall(np.array([[0.0]]), (0.0,), name="low"), Wall(np.array([[4.0]]), (-0.02,), name="high")]
    mesh = grid_of(1, 4, 4 if quick else 8)
    state = last(implicit_steps(mesh, block(1, 4), LINEAR, ends, steps=1, **choices))
    way = 0.2 if quick else 0.1
    ends = [replace(wall, increment=(way,)) for wall in state.boundary]
    exact = np.log(3.98 / 4)
    return worst_of(abs(at.reactions["high"][0] / exact - 1)
                    for at in implicit_steps(mesh, state, LINEAR, ends, steps=8 if quick else 50, **choices))


def slid(choices, quick):
    """Error of stress at the end, of a turned block that slides over the grid while its weight grows."""
    angle, cells, steps = np.radians(20), *((4, 6) if quick else (6, 12))
    weight = 0.3 / cells
    along, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    fill = block(2, cells)
    body = replace(fill, x=np.stack([along, up], axis=1) @ fill.x)
    axis = np.arange(-6.0, 13.0) + 0.0371
    wall = Wall(along[:, None] * np.linspace(0, cells, cells + 1), tuple(cells / 2 / steps * along), name="base")
    state = last(implicit_steps(MeshQuad.init_tensor(axis, axis), body, LINEAR, [wall], steps=steps,
                                gravity=lambda step: -weight * step / steps * up, max_cuts=2, **choices))
    exact = -weight * (cells - fill.x[1]) * np.multiply.outer(up, up)[:, :, None]
    error = state.particles.stress[:2, :2] - exact
    return np.sqrt((error ** 2).sum(axis=(0, 1)).mean()) / (weight * cells)


def on_and_off(choices, quick):
    """What is left of the settlement of an elastic column after its weight has come and gone."""
    turns, body = 3 if quick else 10, block(1, 8)
    states = list(implicit_steps(grid_of(1, 8, 3), body, SOFT, BASE, steps=2 * turns,
                                 gravity=lambda step: (-0.05 * (1 - abs(step % 2 - 1)),), **choices))
    return largest(states[-1].particles.x - body.x) / largest(states[0].particles.x - body.x)


# -- apart, and held by nothing ----------------------------------------------------------------------------------------

def torn(choices, quick):
    """Largest error of the pull of a bar, of elastic material that never breaks, drawn to four times its length."""
    ends = [*BASE, Wall(np.array([[4.0]]), (0.5,), name="pull")]
    run = implicit_steps(grid_of(1, 4, 14), block(1, 4), LINEAR, ends, steps=24, **choices)
    return worst_of(abs(state.reactions["pull"][0] / np.log(1 + state.step / 8) - 1) for state in run)


def held_one_way(choices, quick):
    """How far a block that may slide does so under its weight, which does not push it there, over its settlement."""
    worst = 0.0
    for shift in (0.0, 0.3):
        body = block(2, 3, shift=(shift, 0.0))
        floor = [FixedPlane(1, 0.0, -1, name="floor")]
        state = last(implicit_steps(grid_of(2, 3), body, LINEAR, floor, steps=2, gravity=(0.0, -1e-3), **choices))
        moved = state.particles.x - body.x
        worst = worst_of(worst, abs(moved[0].mean()) / largest(moved[1]))
    return worst


def a_second_body(choices, quick):
    """A block beside one that is held, in the air; however wide the gap, it must not hang on nothing."""
    body = block(2, 2)
    for gap in (1, 2) if quick else (1, 2, 3, 5):
        x = np.concatenate([body.x, body.x + [[2.0 + gap], [0.0]]], axis=1)
        both = Particles(x, np.tile(body.volume, 2), np.tile(body.mass, 2), plane_strain,
                         length=np.tile(body.length, 2))
        root = [FixedPlane(0, 0.0, -1, (0, 1), name="root")]
        try:
            last(implicit_steps(grid_of(2, 10), both, LINEAR, root, steps=1, gravity=(1e-9, 0.0), **choices))
        except NotConvergedError as stop:
            found = stop
        else:
            return np.inf
    raise found


# -- control -----------------------------------------------------------------------------------------------------------

def controlled(steps, increment, choices, at=8.0, per_cell=2):
    """Factors of the weight of a hanging bar, and what is left of balance, as a place of it is drawn down."""
    cells = 8
    run = implicit_steps(grid_of(1, cells, 12), block(1, cells, per_cell), SOFT, BASE, steps=steps,
                         gravity=(1 / cells,), control=Control([at], [1.0], increment), **choices)
    return [(state.factor, state.reactions["base"][0] + state.factor) for state in run]


def before_the_peak(choices, quick):
    """Error of the factor for increments of 1e-9 and of a quarter of the bar."""
    def exact(moved):
        low, high = 0.0, np.exp(-1)
        for _ in range(60):
            half = (low + high) / 2
            low, high = (half, high) if settled([8.0], 8, half)[0] - 8 < moved else (low, half)
        return half
    found = [(moved, controlled(1, moved, choices)[0][0]) for moved in (1e-9, 2.0)]
    return worst_of(abs(factor / (2 * moved / 8 if moved < 1e-6 else exact(moved)) - 1) for moved, factor in found)


def past_the_peak(choices, quick):
    """Error of the largest load that a hanging bar carries while its upper cell is drawn to three times its length."""
    worst = 0.0
    for increment in (0.25, 0.5) if quick else (0.02, 0.05, 0.25, 0.5):
        carried = [factor for factor, _ in controlled(round(2 / increment), increment, choices, at=1.0, per_cell=8)]
        worst = worst_of(worst, abs(worst_of(carried) * np.e - 1))
    return worst


# -- options at their ends ---------------------------------------------------------------------------------------------

def slumped(choices, start=None, **more):
    """A block that its weight lets slump, and its state after two steps."""
    body = start or block(2, 3)
    floor = [FixedPlane(1, 0.0, -1, (0, 1), name="floor")]
    return body, last(implicit_steps(grid_of(2, 3), body, Hencky(E=1.0, nu=0.3), floor, steps=2,
                                     **({"gravity": lambda step: (0.0, -0.02 * step)} | choices | more)))


def apart(choices, **more):
    """How far from the usual answer an option leads."""
    (body, usual), (_, other) = slumped(choices), slumped(choices, **more)
    return largest(other.particles.x - usual.particles.x) / largest(usual.particles.x - body.x)


def tolerance(value):
    return lambda choices, quick: apart(choices, tolerance=value)


def strong_ghost(choices, quick):
    return apart(choices, ghost=1e3)


def tiny_time_steps(choices, quick):
    """Error of the flight of a block in time steps of 1e-12, over the way."""
    worst, dt = 0.0, 1e-12
    for damping in (0.0, 1.0):
        body = replace(block(2, 2, shift=0.3), velocity=np.full((2, 16), 0.5))
        state = last(implicit_steps(grid_of(2, 2), body, SOFT, steps=5, dt=dt, numerical_damping=damping,
                                    gravity=(0.0, -1e9), **choices))
        exact = body.velocity + np.array([[0.0], [-1e9]]) * 5 * dt
        worst = worst_of(worst, largest(state.particles.velocity - exact))
    return worst / 0.5


def huge_time_steps(choices, quick):
    """How far from equilibrium time steps of 1e12 end."""
    return worst_of(apart(choices, dt=1e12, numerical_damping=damping) for damping in (0.0, 1.0))


def no_load(choices, quick):
    """Largest displacement and stress in two steps without any load."""
    body, idle = slumped(choices, gravity=None)
    return worst_of(largest(idle.particles.x - body.x), largest(idle.particles.sigma))


def in_equilibrium(choices, quick):
    """How far a block goes on that is in equilibrium, in one more step under the same load, over its settlement."""
    body, loaded = slumped(choices, gravity=(0.0, -1e-4))
    _, again = slumped(choices, gravity=(0.0, -1e-4), start=loaded)
    return largest(again.particles.x - loaded.particles.x) / largest(loaded.particles.x - body.x)


def failing_solvers(choices, quick):
    """Solvers that give up, or answer with something that is no answer; each has to stop the run at the last state."""
    def gives_up(matrix, rhs):
        raise ArithmeticError("it gave up")

    def complains(matrix, rhs):
        raise ValueError("array must not contain infs or NaNs")

    bad = [complains, gives_up, lambda matrix, rhs: rhs * np.nan, lambda matrix, rhs: rhs[:-1],
           lambda matrix, rhs: 0 * rhs]
    body, usual = slumped(choices)
    for solver in bad:
        try:
            last(implicit_steps(grid_of(2, 3), usual, Hencky(E=1.0, nu=0.3), steps=1, gravity=(0.0, -0.05),
                                solver=solver, **choices))
        except NotConvergedError as stop:
            found = stop
            if stop.state is not usual and largest(stop.state.particles.x - usual.particles.x) > 0:
                return np.inf
        else:
            return np.inf
    raise found
