"""Where points are: on nodes, faces, edges and corners, alone, hardly in a cell; and what body and grid have to do."""

from dataclasses import replace

import numpy as np

from extremes import places_shift, places_thin
from extremes.bodies import LAW, MOTION, block, grid_of, last, low_planes, pull, rms, worst_of
from extremes.row import Row
from skfem_mpm import Particles, explicit_steps, implicit_steps
from skfem_mpm.boundary import Wall

TITLE = "Where points are"
WORDS = """
Elastic bodies on cells of size 1, moving through an empty grid, stretched, vibrating or under gravity: with points on
nodes and faces, alone, hardly in a cell, many or few in a cell; in bodies and meshes of one cell; and with the grid
shifted against the body.  Rows end with the solver that they are for.
"""

ULPS = (-np.inf, None, np.inf)                     # to which side of a node
NEAR = [side * 10.0 ** -k for k in (1, 4, 7, 9, 12, 16) for side in (-1, 1)]
OVER = 1e-12
HELD = ("eq10", "field", "dual", "ghost")


def nodal(dim, aside):
    """A body whose points are all on nodes, several on the same, or an ulp to one side."""
    body = block(dim, 2)
    x = np.round(body.x) + 1                             # an ulp of zero would be none
    return replace(body, x=x if aside is None else np.nextafter(x, aside))


def flown(body, dim, steps, **choices):
    """The last state of a flight along the diagonal at 0.1 of the wave speed."""
    flying = replace(body, velocity=np.full(body.x.shape, 0.1))
    return last(explicit_steps(grid_of(dim, 4), flying, LAW[dim], steps=steps, every=steps, engine="numpy", **choices))


def astray(state, body):
    """Largest stress, and largest distance from the straight path, in cells."""
    path = body.x + 0.1 * state.time
    return worst_of(abs(state.particles.sigma).max(), abs(state.particles.x - path).max())


def on_nodes(choices, quick):
    """Largest stress in a rigid flight."""
    return worst_of(abs(flown(nodal(dim, aside), dim, 20, **choices).particles.sigma).max()
                    for dim in ((1, 2) if quick else (1, 2, 3)) for aside in ULPS)


def patch(choices, quick):
    """Largest error of stress where all nodes move affinely, relative to the modulus times the strain."""
    worst = 0.0
    for dim in (1, 2) if quick else (1, 2, 3):
        gradient = 1e-3 * np.array([[1.0, 0.3, -0.2], [0.3, -0.5, 0.1], [-0.2, 0.1, 0.4]])[:dim, :dim]
        for aside in ULPS:
            body = nodal(dim, aside)
            low, high = np.floor(body.x.min(axis=1)), np.floor(body.x.max(axis=1)) + 1
            nodes = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high)))).reshape(dim, -1)
            wall = Wall(nodes, tuple(gradient @ nodes))
            state = next(implicit_steps(grid_of(dim, 2), body, LAW[dim], [wall], steps=1, strain="small", **choices))
            expected = stress_of(gradient, dim)[:, :, None]
            worst = worst_of(worst, abs(state.particles.stress - expected).max() / 1e-3)
    return worst


def lone(dim, x):
    """A single point, an eighth (in three dimensions) of a cell."""
    x, size = np.full((dim, 1), float(x)), np.array([0.5 ** dim])
    return Particles(x, size, size, MOTION[dim], length=np.full((dim, 1), 0.5))


def lone_flights(choices, quick):
    """Last states of points that start near a node and fly."""
    for dim in (1, 2) if quick else (1, 2, 3):
        for away in [0.0, *(NEAR[::3] if quick else NEAR)]:
            body = lone(dim, 1 + away)
            yield flown(body, dim, 15, **choices), body


def lone_path(choices, quick):
    """Largest stress, and largest distance from the straight path."""
    return worst_of(astray(*flight) for flight in lone_flights(choices, quick))


def lone_step(choices, quick):
    """Longest over shortest time step of a lone point."""
    ratios = []
    for dim in (1, 2) if quick else (1, 2, 3):
        steps = [flown(lone(dim, 1 + away), dim, 1, **choices).dt for away in NEAR]
        ratios.append(max(steps) / min(steps))
    return worst_of(ratios)


def balance(choices, dims, heights):
    """Largest difference of reaction and weight, relative to the weight, of a lone point on low planes."""
    worst = 0.0
    for dim in dims:
        for height in heights:
            body, gravity = lone(dim, height), pull(dim)
            state = next(implicit_steps(grid_of(dim, 2), body, LAW[dim], low_planes(dim), steps=1, gravity=gravity,
                                        **choices))
            weight = body.mass.sum() * gravity[-1]
            worst = worst_of(worst, abs(state.reactions["base"][-1] / weight + 1))
    return worst


def lone_held(choices, quick):
    """Balance of a lone point that both nodes of its cell know of."""
    away = [0.5, 0.1, 1e-2, 3e-3]
    return balance(choices, (1, 2), [*away, *(1 - a for a in away)])


def lone_on_node(choices, quick):
    """Balance of a lone point that is as good as on a node."""
    return balance(choices, (1, 2), [1 + 1e-12, 1.0, 1 - 1e-12])


def sticking_out(dim, cells, over):
    """Bodies whose outermost points, or whose outermost domains, are this much beyond a face; others are in cells."""
    body = block(dim, cells)
    share = (cells + over) / body.x.max()
    yield replace(body, x=share * body.x, length=share * body.length, volume=share ** dim * body.volume,
                  mass=share ** dim * body.mass)
    yield block(dim, cells, shift=over)


def cover_in_flight(choices, quick):
    """Largest stress, and largest distance from the straight path."""
    return worst_of(astray(flown(body, dim, 20, **choices), body) for dim in ((1, 2) if quick else (1, 2, 3))
                    for body in sticking_out(dim, 2, OVER))


def compared(run, dim, cells):
    """What sticking out changes of displacement and of stress, rms over points, relative to their rms."""
    worst = 0.0
    for out, within in zip(sticking_out(dim, cells, OVER), sticking_out(dim, cells, -OVER)):
        for a, b in zip(run(out), run(within)):
            worst = worst_of(worst, rms(a - b) / rms(b))
    return worst


def cover_vibrating(choices, quick):
    """A block on low planes, with gravity at once, followed until it is about lowest."""
    dim, cells = 2, 4

    def run(body):
        state = last(explicit_steps(grid_of(dim, cells), body, LAW[dim], low_planes(dim), steps=20, every=20, dt=0.2,
                                    gravity=pull(dim), engine="numpy", **choices))
        return state.particles.x - body.x, state.particles.sigma

    return compared(run, dim, cells)


def cover_loaded(choices, quick):
    """A block on low planes under gravity."""
    dim, cells = 2, 4

    def run(body):
        state = next(implicit_steps(grid_of(dim, cells), body, LAW[dim], low_planes(dim), steps=1, gravity=pull(dim),
                                    **choices))
        return state.particles.x - body.x, state.particles.sigma

    return compared(run, dim, cells)


def stress_of(gradient, dim):
    """Stress ``(3, 3)`` of the law at a small displacement gradient."""
    law, strain = LAW[dim], np.zeros((3, 3))
    strain[:dim, :dim] = gradient
    lam, mu = law.E * law.nu / (1 + law.nu) / (1 - 2 * law.nu), law.E / 2 / (1 + law.nu)
    return lam * np.trace(strain) * np.eye(3) + 2 * mu * strain


ROWS = [
    Row("points on nodes, faces and corners, and one ulp beside, in flight",
        """A body whose points all lie on nodes, or one ulp to either side, flies at 0.1 of the wave speed, in one to
        three dimensions; the largest stress in units of the modulus, which should be zero.""",
        on_nodes, holds=1e-12, useless=1e-6, must=True),
    Row("points on nodes, faces and corners, and one ulp beside, stretched (implicit)",
        """The same bodies, with all nodes of their cells moved by walls as a linear field tells; the largest error of
        stress, in units of the modulus times the strain.""",
        patch, holds=1e-9, useless=1e-3, must=True),
    Row("a lone point near a node, in flight",
        """A single point starts at distances from 1e-1 down to 1e-16 of a cell from a node, on it and to both sides,
        and flies at 0.1 of the wave speed; the largest stress in units of the modulus, or distance from the straight
        path in cells, whichever is larger.""",
        lone_path, holds=1e-12, useless=1e-6, must=True, remedies=("usl",)),
    Row("a lone point near a node, its time step",
        """The same points: the longest over the shortest time step.  Steps of a run that crawls cost time, not
        accuracy.""",
        lone_step, holds=10.0, useless=1e6, must=True, remedies=("usl", "tpic")),
    Row("a lone point on a plane, under gravity (implicit)",
        """A single point in the cell above a plane, in two dimensions in a corner of two planes, from 3e-3 of a cell
        above to 3e-3 below the next node; the largest difference of reaction and weight, relative to the weight.""",
        lone_held, holds=1e-9, useless=1e-2, must=True,
        stops="singular|the residual"),
    Row("a lone point on a node above a plane, under gravity (implicit)",
        """A single point on a node one cell above a plane, and 1e-12 of a cell to both sides: as good as a body
        without extent, which nothing holds.  As above.""",
        lone_on_node, holds=1e-9, useless=1e-2, stops="spans a cell|nothing is fixed"),
    Row("a cover of 1e-12, in flight",
        """A body whose outermost points, or whose outermost domains, are 1e-12 of a cell beyond its cells, flies at
        0.1 of the wave speed; the largest stress or distance from the path, as above.""",
        cover_in_flight, holds=1e-10, useless=1e-6, must=True),
    Row("a cover of 1e-12, gravity at once",
        """Such a block of 4 by 4 cells stands in a corner and gravity sets in; after half a period the difference of
        displacement or stress from the block that ends 1e-12 within its cells (rms, relative to the rms).""",
        cover_vibrating, holds=0.05, useless=0.5, must=True, remedies=("xpic 2", "dual")),
    Row("a cover of 1e-12, under gravity (implicit)",
        """The same blocks in equilibrium.  Both are answers on a coarse grid, in which linear interpolation of
        stress alone makes an error of 12 %.""",
        cover_loaded, holds=0.15, useless=0.5, must=True, remedies=HELD),
    *places_thin.ROWS,
    *places_shift.ROWS,
]
