"""Bodies whose grid is moved by hand: strain and stress of each method without any equation of motion.

The operators, the update of stress and domains, and the way in which points move are those of the solvers.
"""

from dataclasses import replace

import numpy as np
from skfem import MeshQuad

from extremes.bodies import LAW, block, grid_of
from skfem_mpm.explicit import run_before_its_start
from skfem_mpm.explicit.dilation import CellMeans
from skfem_mpm.implicit import _check
from skfem_mpm.implicit.state import State
from skfem_mpm.implicit.step import Step

PLANE = LAW[2]
OFF = 0.3137, 0.2219                                   # no point gets onto a line of the grid by chance
START = np.array([0.02, -0.01, 0.0, 0.005])            # elastic strain that half of the points bring


def brought(law, strain):
    """A block of 2 x 2 cells, off the grid's lines; every other point is stressed at the start."""
    body = block(2, 2, shift=OFF)
    epsilon = START[:, None] * (np.arange(body.n) % 2)
    sigma = law.update(epsilon, 0 * epsilon, np.zeros((0, body.n)), body.kinematics.components)[0]
    return replace(body, sigma=sigma, epsilon=epsilon if strain == "logarithmic" else None)


def nodes_of(grid):
    return np.stack(np.meshgrid(*grid.axes, indexing="ij")).reshape(grid.dim, -1)


def explicitly(mesh, body, law, moves, strain, choices):
    """Points after the displacements that ``moves`` give for places ``(dim, n)``, one function a step."""
    run = run_before_its_start(mesh, body, law, strain=strain, guards={"energy": "off"}, **choices)
    run.dt = 1.0                                      # velocities are displacements
    for move in moves:
        nodes = run._nodes()
        moved = nodes.spread(move(nodes_of(nodes.grid)) * nodes.active)
        run._respond(smoothed(run, nodes, nodes.strain.gradient(moved)))
        run.x = run.x + nodes.mapping.to_middles(moved)
    return run.snapshot().particles


def smoothed(run, nodes, gradient):
    if run.choices.remedy == "none":
        return gradient
    return CellMeans(nodes.grid, nodes.mapping, nodes.integrated(run.volume)).smooth(gradient)


def implicitly(mesh, body, law, moves, strain, choices):
    """The same with the operators of implicit steps."""
    chosen = {"method": "mpm", "integration": "points", "domains": "fixed", "remedy": "none", **choices}
    options = _check(chosen["method"], strain, "equilibrated", "one", chosen["integration"], "ghost", None, 0.0, 0.0,
                     1e-11, None)
    options = replace(options, domains=chosen["domains"], remedy=chosen["remedy"])
    state = State(0, body, (), np.zeros((2, 0)), {})
    for move in moves:
        step = Step(mesh, state, law, options)
        solved = step.support.solved_nodes
        unknowns = move(nodes_of(step.support.grid)[:, solved]).T.ravel()
        state = step._finish(step.support.spread(unknowns), 1.0, (), {}, None)
    return state.particles


WAYS = {"explicit": explicitly, "implicit": implicitly}


# -- rotation ---------------------------------------------------------------------------------------------------------

def turn(angle):
    """Rotation in the plane by an angle in degrees."""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    return np.array([[c, -s], [s, c]])


def turned(solver, choices, strain, angle, steps):
    """Largest difference of a turned body's stress from what it brought, turned with it, in units of E."""
    law, mesh = PLANE, grid_of(2, 2, 4)
    body, middle = brought(law, strain), 1 + np.array(OFF)[:, None]
    change = turn(angle) - np.eye(2)
    points = WAYS[solver](mesh, body, law, [lambda x: change @ (x - middle)] * steps, strain, choices)
    whole = np.eye(3)
    whole[:2, :2] = turn(angle * steps)
    tensor = body.kinematics.tensor
    exact = np.einsum("ij,jkn,lk->iln", whole, tensor(body.sigma), whole)
    return abs(tensor(points.sigma) - exact).max() / law.E


# -- simple shear -----------------------------------------------------------------------------------------------------

def sheared(solver, choices, strain, steps, total=10.0):
    """Largest error of the stress of a body in simple shear, in units of E, against the closed form of the rate."""
    law, mesh = PLANE, sheared_grid(total)
    body = block(2, 2, shift=OFF)
    move = [lambda x: np.stack([total / steps * (x[1] - OFF[1]), 0 * x[1]])] * steps
    points = WAYS[solver](mesh, body, law, move, strain, choices)
    exact = (jaumann if strain == "small" else logarithmic)(law, total)
    return abs(points.sigma - exact[:, None]).max() / law.E


def sheared_grid(total):
    return MeshQuad.init_tensor(np.arange(-4.0, 2 * total + 8), np.arange(-4.0, 8))


def jaumann(law, shear):
    """Stress of the Jaumann rate swings in simple shear."""
    along = law.G * (1 - np.cos(shear))
    return np.array([along, -along, 0.0, law.G * np.sin(shear)])


def logarithmic(law, shear):
    F = np.array([[1.0, shear], [0.0, 1.0]])
    value, vector = np.linalg.eigh(F @ F.T)
    strain = (vector * np.log(value) / 2) @ vector.T
    return 2 * law.G * np.array([strain[0, 0], strain[1, 1], 0.0, strain[0, 1]])
