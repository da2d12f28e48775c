"""Time steps: the bound, and shares of the exact limit."""

import numpy as np

from extremes.bodies import FASTEST, LAW, MAKE, MOTION, block, grid_of, last, mechanical, with_noise, worst_of
from extremes.row import MUST, Row
from skfem_mpm import Particles, UnstableError, axisymmetric, explicit_steps
from skfem_mpm.stability import critical_step, growth

TITLE = "Time steps"
WORDS = """
`stability.critical_step` finds the exact limit of a frozen layout, from the eigenvalues of a whole step, and a bound
that is sure and cheaper; runs hold to one that is cheaper still, times `safety`. The random layouts are clouds of
points with volumes, masses and domains of their own, on graded grids, a fifth of them within 1e-10 to 1e-3 of a face.
"""
LAYOUTS = {1: 500, 2: 500, 3: 25}


def scattered(dim, seed, kinematics=None):
    """Points anywhere in a few cells of different sizes, some of them next to faces."""
    random = np.random.default_rng(seed)
    cells, n = {1: (6, 14), 2: (3, 20), 3: (2, 16)}[dim]
    x, volume = random.uniform(0, cells, (dim, n)), random.uniform(0.1, 1.0, n)
    x[:, ::5] = np.round(x[:, ::5]) + random.choice([1e-10, 1e-5, 1e-3], x[:, ::5].shape)
    length = random.uniform(0.2, 1.0, (dim, n))
    axes, knots = [], np.arange(-3.0, cells + 4)
    for k in range(dim):
        sizes = random.uniform(0.7, 1.5, len(knots) - 1)
        axis = np.append(0.0, np.cumsum(sizes))
        axes.append(axis - axis[3])
        x[k] = np.interp(x[k], knots, axes[k])
        length[k] *= sizes.min()
    if kinematics is axisymmetric:
        axes[0], x[0] = axes[0] + 4.0, x[0] + 4.0
        volume = volume * x[0]
    return MAKE[dim](*axes), Particles(x, volume, volume * random.uniform(0.5, 2.0), kinematics or MOTION[dim],
                                       length=length)


def layouts(dim, quick, kinematics=None):
    """Some random layouts."""
    return (scattered(dim, seed, kinematics) for seed in range(LAYOUTS[dim] // (10 if quick else 1)))


def slack(dim, kinematics=None):
    """How many times the bound the exact limit is, in the worst of some layouts; infinite if the bound is not safe."""
    def measure(choices, quick):
        worst = 1.0
        for mesh, body in layouts(dim, quick, kinematics):
            found = critical_step(mesh, body, LAW[dim], exact=True, **choices)
            safe = found.bound <= found.exact * (1 + 1e-6)
            worst = worst_of(worst, found.exact / found.bound if safe else np.inf)
        return worst
    return measure


def taken(dim):
    """The longest step that a run allows itself, as a share of the exact limit, in the worst of some layouts."""
    def measure(choices, quick):
        worst = 0.0
        for mesh, body in layouts(dim, quick):
            exact = critical_step(mesh, body, LAW[dim], exact=True, **choices).exact
            state = next(explicit_steps(mesh, body, LAW[dim], steps=1, safety=1.0, engine="numpy", **choices))
            worst = worst_of(worst, state.dt / exact)
        return worst
    return measure


def rate(dim):
    """Largest growth in a default step, the logarithm of its spectral radius, of some layouts."""
    def measure(choices, quick):
        worst = 0.0
        for mesh, body in layouts(dim, quick):
            found = growth(mesh, body, LAW[dim], **choices)
            worst = worst_of(worst, found.rate * found.dt)
        return worst
    return measure


def ringing(dim, cells, choices, shares, steps):
    """Runs of a block with tiny random velocities, off its quarter points, at shares of the exact limit."""
    mesh, body = grid_of(dim, cells), with_noise(block(dim, cells, shift=0.24), 1e-9)
    limit = critical_step(mesh, body, LAW[dim], exact=True, **choices).exact
    for share in shares:
        yield explicit_steps(mesh, body, LAW[dim], steps=steps, every=steps // 50, dt=share * limit, refresh=1000,
                             engine=FASTEST, **choices)


def drift(choices, quick):
    """Change of the mean energy from the first to the second half of a run, in the worst of some Courant numbers."""
    worst = 0.0
    for dim, cells in ((1, 10), (2, 3)) if quick else ((1, 10), (2, 3), (3, 2)):
        shares = (0.5, 0.9) if quick else (0.1, 0.3, 0.5, 0.7, 0.8, 0.9)
        for run in ringing(dim, cells, choices, shares, 500 if quick else 2000):
            first, second = np.array_split([mechanical(state) for state in run], 2)
            worst = worst_of(worst, second.mean() / first.mean() - 1)
    return worst


def beyond(choices, quick):
    """Ends as a run at 1.2 of the exact limit does; the number of those, from 1.05 on, that go on, if there are any."""
    went_on = 0.0
    for dim, cells in ((2, 3), (1, 10)) if quick else ((3, 2), (2, 3), (1, 10)):
        for run in ringing(dim, cells, choices, (1.05, 1.2), 3000):
            try:
                last(run)
            except UnstableError as error:
                stop = error
            else:
                went_on += 1
    if went_on:
        return went_on
    raise stop


TOO_LONG = "times the energy|inside out|more than a cell|no longer finite|leaves the grid"
ROWS = [
    Row("sure bound, 500 layouts on lines",
        "How many times the sure bound the exact limit is, in the worst layout; infinite if the bound is not safe.",
        slack(1), holds=1 / 0.7, useless=10.0, methods=MUST),
    Row("sure bound, 500 layouts in the plane", "The same in plane strain.",
        slack(2), holds=1 / 0.6, useless=10.0, methods=MUST),
    Row("sure bound, 25 layouts in space", "The same in 3-D.",
        slack(3), holds=2.0, useless=10.0, methods=MUST),
    Row("sure bound, 500 layouts of rings", "The same in axial symmetry.",
        slack(2, axisymmetric), holds=2.0, useless=10.0, methods=MUST),
    Row("step of a run, 500 layouts on lines",
        """The longest step that a run allows itself (`safety=1`) as a share of the exact limit, in the layout where
        that is most.""",
        taken(1), holds=1 + 1e-6, useless=1.1, methods=MUST, remedies=("xpic 2", "tpic")),
    Row("step of a run, 500 layouts in the plane", "The same in plane strain.",
        taken(2), holds=1 + 1e-6, useless=1.1, methods=MUST, remedies=("tpic",)),
    Row("growth at the default step, 500 layouts on lines",
        """Largest growth of any wave in the step that a run takes, the logarithm of its spectral radius: what is not
        zero here is flutter, of which runs warn at their start.""",
        rate(1), holds=1e-6, useless=np.inf, remedies=("usl", "xpic 2")),
    Row("growth at the default step, 500 layouts in the plane", "The same in plane strain.",
        rate(2), holds=1e-6, useless=np.inf),
    Row("0.1 to 0.9 of the exact step",
        """A block rings at steps of 0.1, 0.3, 0.5, 0.7, 0.8 and 0.9 of the exact limit, in one to three dimensions, its
        points off their quarter points; what its mean energy gains from the first half of 2000 steps to the second. At
        0.9 the energy of a leapfrog swings fivefold, so means are only good to some percent.""",
        drift, holds=0.2, useless=1.0, remedies=("usl", "usavg"), must=True, warns="times the|waves grow",
        stops="times the energy"),
    Row("1.05 and 1.2 of the exact step", "The same block with steps that are too long; how many of these runs go on.",
        beyond, holds=0.0, useless=0.0, remedies=("usavg",), stops=TOO_LONG),
]
