"""Where points are: on nodes, faces, edges and corners, alone, many to a cell, hardly in a cell."""

from dataclasses import replace

import numpy as np

from extremes.bodies import LAW, block, grid_of, last
from extremes.row import Row
from skfem_mpm import explicit_steps

TITLE = "Where points are"
WORDS = """
A free elastic body of cells of size 1 that moves through an empty grid, or is stretched.
"""


def on_nodes(choices, quick):
    """Largest stress in a rigid flight, of points that start on nodes and faces, or an ulp beside them."""
    worst = 0.0
    for dim in (1, 2) if quick else (1, 2, 3):
        body = block(dim, 2)
        for aside in (-np.inf, None, np.inf):
            x = np.round(body.x)                                 # every point on a node; several on the same
            x = x if aside is None else np.nextafter(x, aside)
            flying = replace(body, x=x, velocity=np.full(x.shape, 0.1))
            state = last(explicit_steps(grid_of(dim, 2, 4), flying, LAW[dim], steps=20, every=20, engine="numpy",
                                        **choices))
            worst = max(worst, abs(state.particles.sigma).max())
    return worst


ROWS = [
    Row("points on nodes, faces and corners, and one ulp beside, in flight",
        """A body whose points all lie on nodes, or one ulp to either side, flies at 0.1 of the wave speed, in one to
        three dimensions; the largest stress in units of the modulus, which should be zero.""",
        on_nodes, holds=1e-12, useless=1e-6, must=True),
]
