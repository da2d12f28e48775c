"""Implicit steps: small cuts, steps that are too large, systems without an answer."""

from extremes import hard_steps, small_cuts
from extremes.row import Row

TITLE = "Equilibrium"
WORDS = """
Implicit steps of elastic bodies, cells of size 1, Young's modulus 1. A *cut* is how far the outermost points, or the
edges of their domains, reach into the last cells: 1e-6 to 0.5 of a cell. Remedies are tried one by one; a ghost penalty
is what helps most where bodies lie askew, domains that stretch where points cross, and field integration where they do
both and stay in line with the grid.
"""

CUTS = ("no floor", "ghost", "dual")
CROSSING = ("eq10", "field")
UNHELD = "boundary: got a part of the body.* that nothing holds"
NO_WAY = "step .*(residual|inside out).* even after cutting|" + UNHELD

ROWS = [
    Row("small cuts in 1-D: condition",
        """The largest condition number of the stiffness over all cuts of a column, over that without a cut.""",
        small_cuts.condition(1), holds=10, useless=1e10, stops="nothing holds"),
    Row("small cuts in 2-D: condition",
        """The same for a square block on rollers with a cut on two sides.""",
        small_cuts.condition(2), holds=10, useless=1e10, remedies=CUTS, stops="nothing holds"),
    Row("small cuts in 1-D: error",
        """The largest error of stress at a point of a column under its weight, over all cuts, in weights of one cell of
        six.""",
        small_cuts.error(1), holds=1, useless=6, remedies=("eq10", "field", "dual"),
        stops=NO_WAY),
    Row("small cuts in 2-D: error",
        """The same for a square block on rollers with a cut on two sides.""",
        small_cuts.error(2), holds=1, useless=6, remedies=("ghost", "dual", "dm, ghost"), stops=NO_WAY),
    Row("one point a cell",
        """The block, with one point a cell: in the middle, on nodes, beside them and between; some methods
        have modes there that no point feels.  The largest error of stress, in weights of one cell of six.""",
        small_cuts.one_point_a_cell, holds=1, useless=6, remedies=("ghost",),
        stops="nothing holds", warns="holds one point|turned inside out"),
    Row("a load of 100 steps in one: column",
        """A column of Hencky's material under 1.6 times its modulus in one step, which has to be cut; the error of
        positions against the closed form, over the settlement.""",
        hard_steps.column_at_once, holds=0.05, useless=0.5, must=True, stops=NO_WAY),
    Row("a load of 100 steps in one: cantilever",
        """A cantilever that its weight turns down; distance from where 50 small steps put it, over the deflection.""",
        hard_steps.cantilever_at_once, holds=0.1, useless=1, remedies=("ghost",), stops=NO_WAY),
    Row("on from the last good state",
        """A press that would go through the floor stops the run; from the state in the error it goes on in small steps.
        Distance from the run that was never stopped, over the settlement.""",
        hard_steps.from_the_last_good_state, holds=1e-12, useless=1e-6, must=True),
    Row("a cavity opened by half in one step, nu = 0.4999",
        """With `remedy="bbar"` and the outer edge at many places in its cell; the error of the pressure.""",
        hard_steps.cavity, holds=0.1, useless=0.5, remedies=("dual",), stops=NO_WAY),
    Row("pushed through the grid",
        """A bar squeezed by half a per cent between two walls that carry it over the cells, from one set of nodes to
        the next; how far its reaction strays, over the exact one.""",
        hard_steps.pushed, holds=0.01, useless=1, remedies=CROSSING, stops=NO_WAY),
    Row("slid askew over the grid",
        """A block turned by 20 degrees slides by half its width while its weight grows; the root mean square error of
        stress over that at its base.""",
        hard_steps.slid, holds=0.1, useless=1,
        remedies=("field",), stops=NO_WAY,
        warns="turned inside out"),
    Row("weight that comes and goes",
        """Ten times; what is left of the settlement of an elastic column.""",
        hard_steps.on_and_off, holds=0.05, useless=1, remedies=CROSSING, stops=NO_WAY),
    Row("a bar drawn to four times its length",
        """Of elastic material that never breaks, two points a cell: its points end up two cells apart.  The largest
        error of the pull.""",
        hard_steps.torn, holds=0.05, useless=0.5, remedies=("twin",),
        stops=f"{NO_WAY}|behind the plane|outside the grid", warns="comes apart|turned inside out"),
    Row("held in one direction only",
        """A block on a slippery floor under its weight; how far it slides, over the settlement.""",
        hard_steps.held_one_way, holds=1e-9, useless=1e-3, stops=UNHELD),
    Row("a second body that nothing holds",
        """Beside one that is held, with a gap of one to five cells, and pulled away from it; it has to stop.""",
        hard_steps.a_second_body, holds=0, useless=0, stops=UNHELD),
    Row("control: increments of 1e-9 and of a quarter of the bar",
        """Its end is drawn down; the error of the load against the closed form.""",
        hard_steps.before_the_peak, holds=0.01, useless=0.5),
    Row("control: past the peak of the load",
        """The upper cell of a hanging bar of Hencky's material is drawn to three times its length, in steps of 0.02
        to 0.5; the error of the largest load on the way.""",
        hard_steps.past_the_peak, holds=0.05, useless=0.5,
        stops=f"{NO_WAY}|nothing is fixed"),
    Row("tolerance of 0",
        """Distance from the usual answer, over the settlement, if the run does not stop.""",
        hard_steps.tolerance(0.0), holds=1e-9, useless=1e-3, stops="residual"),
    Row("a ghost penalty of 1e3",
        """The same; it holds the block nearly in an affine shape.""",
        hard_steps.strong_ghost, holds=0.05, useless=1),
    Row("time steps of 1e-12",
        """A block in flight with enormous weight, with and without the largest numerical damping; the error of velocity
        over what it was at the start.""",
        hard_steps.tiny_time_steps, holds=1e-12, useless=1e-6),
    Row("time steps of 1e12",
        """With and without the largest numerical damping; distance from where load steps end, over the settlement.""",
        hard_steps.huge_time_steps, holds=1e-9, useless=1e-3),
    Row("no load at all",
        """The largest displacement or stress.""",
        hard_steps.no_load, holds=0, useless=1e-12, must=True),
    Row("one more step in equilibrium",
        """How far a block goes on under the load that it already carries, over the settlement.""",
        hard_steps.in_equilibrium, holds=1e-3, useless=0.1),
    Row("solvers that fail",
        """They raise, or answer with no number, too few of them, or zeros; each has to stop the run.""",
        hard_steps.failing_solvers, holds=0, useless=0, stops="solver: "),
]
