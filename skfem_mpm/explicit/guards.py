"""What is watched while a body moves, and what a run says when it stops.

Numbers that are not finite and points that turn inside out are found in the step that makes them.  Energy and yield are
looked at every so many steps, by the number of the step and never by what is yielded, and before a state is yielded.
"""

from __future__ import annotations

import warnings
from typing import Any, NoReturn

import numpy as np
from numpy import ndarray

from ..cautions import Pieces
from ..checks import UnstableError, position
from ..grid import Grid
from ..kinematics import YIELD, Kinematics, beyond_yield, moduli_at_rest, words_of_yield
from .state import Choices, ExplicitState, remaps

LOOK_EVERY = 50    # steps
COUNT_EVERY = 200  # steps, of pieces
SUSPECT = 2.0      # energy over what there was for it, from which a run warns
RUNAWAY = 10.0     # and from which it stops
ROUNDING = 1e-12   # share of the energy of the centre of mass that is not told from rounding
REACH = 3.0        # cells from a plane within which it may hold the body
PATIENCE = 10      # looks that must find a point in tension: one that vibrates is so half of the time
TENSE = 0.01       # tension as a share of the modulus from which bodies leave equilibrium in some thousand steps
BEHIND = 1e-6      # share of the smallest cell that a point may be behind a plane


class Guarded:
    """The guards of a run, which has these attributes."""

    choices: Choices
    kinematics: Kinematics
    material: Any
    last: ExplicitState
    dt: float
    doing: int               # number of the step that is being done, or was done last
    covers: bool
    work: dict[str, float]
    grid: Grid
    planes: tuple[Any, ...]
    farthest: ndarray        # (dim,); how far points may move in one step
    warned: bool
    x: ndarray
    volume: ndarray
    mass: ndarray
    length: Any
    velocity: ndarray
    sigma: ndarray
    epsilon: Any
    history: ndarray
    slope: Any
    kept: ndarray | None
    tense: ndarray | None    # (n,); least tension of the points of late, if that is watched
    pieces: Pieces
    begun: ndarray           # (n,); numbers of the points that the run began with

    def _begin_watch(self, start: ExplicitState) -> None:
        """What guards remember."""
        choices = self.choices
        self.pieces = Pieces(self.grid.locate(self.x), 1 + choices.method.force.reads_domains)
        self.begun = np.arange(self.x.shape[1]) if self.kept is None else self.kept      # with these points
        self.warned = start.dt == choices.dt               # a run that goes on has been told
        limited = choices.guards["moved"] != "off"
        self.farthest = np.array([step.min() if limited else np.inf for step in self.grid.steps])
        lags = remaps(choices.integrator, choices.tpic) and choices.flip == 1 and not choices.xpic
        self.tense = np.full(self.x.shape[1], np.inf) if lags else None

    # -- numbers -----------------------------------------------------------------------------------------------------

    def _check_start(self) -> None:
        """Stop before a step from places, masses or domains that are no numbers: they would be in any cell."""
        unread = ("sigma",) * (self.epsilon is not None)           # some of it is, where strain is kept, and made anew
        for name in ("x", "mass", "length") + ("volume",) * self.covers + unread:
            array = getattr(self, name)
            if array is not None and not np.isfinite(np.vdot(array, array)):
                self._check_finite(name)

    def _check_finite(self, name: str) -> None:
        """Stop a run in which something that points carry is no longer finite."""
        array = np.atleast_2d(getattr(self, name))
        finite = np.isfinite(array)
        if not finite.all():
            point = self._first(~finite.all(axis=0))
            value = array[~finite[:, point], point][0]
            self._stop(point, f"has a {name} that is no longer finite: {value}")

    def _check_volume(self, volume: ndarray) -> None:
        """Stop a run in which a point has turned inside out."""
        wrong = ~((volume > 0) & (volume < np.inf))
        if wrong.any():
            point = self._first(wrong)
            how = "turned inside out" if np.isfinite(volume[point]) else "has a volume that is no longer finite"
            self._stop(point, f"{how}: {volume[point]:.3g}, expected more than zero")

    def _check_stress(self) -> None:
        """Stop a run in which what a law has answered is no longer finite."""
        for name in ("history", "sigma", "epsilon"):
            if getattr(self, name) is not None:
                self._check_finite(name)

    # -- motion ------------------------------------------------------------------------------------------------------

    def _check_step(self, stable: float) -> None:
        """Warn of a given step that is not surely stable, or stop there."""
        what, dt = self.choices.guards["step"], self.choices.dt
        if dt is None or not dt > stable or self.warned or what == "off":
            return
        self.warned = True
        text = (f"dt: got {dt:g}, above the step {stable:g} that is surely stable here; the run may become unstable.  "
                "Take a shorter one, or see with skfem_mpm.stability.critical_step how far the exact limit is.")
        if what == "stop":
            raise UnstableError(f"step {self.doing}: {text}", self.last)
        warnings.warn(text, UserWarning, stacklevel=2)

    def _check_moved(self, moved: ndarray) -> bool:
        """Whether a point moves further than a cell in one step, where a run stops or warns."""
        far = ~(np.abs(moved) <= self.farthest[:, None])
        if not far.any():
            return False
        point = self._first(far.any(axis=0))
        axis = int(np.flatnonzero(far[:, point])[0])
        text = (f"moves {moved[axis, point]:.3g} along axis {axis} in one step, more than a cell of "
                f"{self.farthest[axis]:.3g}")
        if self.choices.guards["moved"] == "stop":
            self._stop(point, text)
        warnings.warn(f"{self._whereabouts(point)} {text}.  {self._cure()}", UserWarning, stacklevel=2)
        self.farthest = np.full_like(self.farthest, np.inf)                 # once is enough
        return True

    def _check_planes(self) -> None:
        """Stop a run in which a point has passed a plane, as one that does not fix its normal component lets it."""
        for plane in self.planes:
            behind = plane.side * (self.x[plane.axis] - plane.at)
            if behind.max() > BEHIND * self.grid.steps[plane.axis].min():
                point = self._first(behind > BEHIND * self.grid.steps[plane.axis].min())
                self._stop(point, f"is {behind[point]:.3g} behind the plane {plane.name!r}, where nodes are images of "
                           "those in front", "A plane holds points in front of it if it fixes its normal component; "
                           f"it fixes {plane.components} and is normal to {plane.axis}.")

    # -- energy and yield --------------------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Look at energy and yield, and note the most that there was for motion and strain."""
        inner, available, noise = self._balance()
        self.work["peak"] = max(self.work["peak"], available)               # what is not a number stays so
        self.work["most"] = self.work["external"]
        limit = self.work["peak"] + noise
        if inner > SUSPECT * limit and not self.alarmed and self.choices.guards["energy"] != "off":
            self.alarmed = True
            warnings.warn(f"step {self.doing}: the body has {inner:.3g} of elastic energy and motion about its centre "
                          f"of mass, more than {SUSPECT:g} times the {limit:.3g} that was there for it.  "
                          f"{self._cure()}", UserWarning, stacklevel=2)
        self._check_energy(inner, limit)
        self._check_yield()
        self._check_planes()
        if self.doing % COUNT_EVERY == 0:
            self.pieces.look(self.grid.locate(self.x), np.searchsorted(self.begun, self._numbers()), self.doing)

    alarmed = False

    def _check_snapshot(self) -> None:
        """The same before a state is yielded, which changes nothing; it never holds what is not a number."""
        for name in ("x", "volume", "velocity", "length", "slope"):
            if getattr(self, name) is not None:
                self._check_finite(name)
        self._check_stress()
        inner, available, noise = self._balance()
        self._check_energy(inner, max(self.work["peak"], available) + noise)
        self._check_yield()
        self._check_planes()

    def _balance(self) -> tuple[float, float, float]:
        """Energy apart from that of the centre of mass, what there is for it, and what rounding makes of that.

        What gravity does to a body in flight is in its centre of mass, however fast; the rest is conserved or lost.
        """
        mean = self._drift()
        carried = float(mean @ (self.velocity @ self.mass) - self.mass.sum() * mean @ mean / 2)
        external, removed = self.work["most"], np.nan_to_num(self.work["removed"])
        available = self.work["start"] + external - removed - carried
        return self._inner(mean), available, ROUNDING * (carried + abs(external))

    def _inner(self, mean: ndarray) -> float:
        """Elastic energy, if the law says it, and motion about a mean velocity."""
        own = self.velocity - mean[:, None]
        return float(np.nansum([(self.mass * (own ** 2).sum(axis=0)).sum() / 2, self._elastic()]))

    def _drift(self) -> ndarray:
        """Velocity of the centre of mass, ``(dim,)``, where nothing holds the body; rings have no common radial one.

        At a plane the momentum of the points follows that of the nodes some steps later, and the motion of the centre
        of mass may become strain before it is gone.
        """
        mean = self.velocity @ self.mass / self.mass.sum()
        if self.kinematics.hoop:
            mean[0] = 0
        for plane in self.planes:
            x = self.x[plane.axis]
            nearest = x.max() if plane.side > 0 else x.min()
            near = abs(nearest - plane.at) < REACH * self.grid.steps[plane.axis].max()
            mean[list(plane.components) if near else []] = 0
        return mean

    def _elastic(self) -> float:
        """Elastic energy; not a number if the law does not say."""
        if not hasattr(self.material, "energy_density"):
            return np.nan
        density = self.material.energy_density(self.sigma, self.epsilon, self.kinematics.components)
        return float(density @ self.volume)

    def _check_energy(self, inner: float, limit: float) -> None:
        """Stop a run in which the body has far more energy than there ever was for it."""
        if inner > RUNAWAY * limit and self.choices.guards["energy"] == "stop":
            speed = ((self.velocity - self._drift()[:, None]) ** 2).sum(axis=0)
            self._stop(self._first(speed == speed.max()),
                       f"is the fastest of a body with more than {RUNAWAY:g} times the energy it was given: apart from "
                       f"the motion of its centre of mass it has {inner:.3g}, where there was {limit:.3g}")

    def _check_yield(self) -> None:
        """Stop a run in which the return mapping has left a stress beyond yield, or warn."""
        what = self.choices.guards["yield"]
        excess = self._excess_of_yield() if what != "off" else None
        if excess is None or (excess <= YIELD).all() or (what == "warn" and self.overdone):
            return
        point = self._first(~(excess <= YIELD))
        trouble, cause = words_of_yield(self.material, excess[point])
        if what == "stop":
            self._stop(point, trouble, cause)
        self.overdone = True
        warnings.warn(f"{self._whereabouts(point)} {trouble}.  {cause}", UserWarning, stacklevel=2)

    overdone = False

    def _excess_of_yield(self) -> ndarray | None:
        """How far stress is beyond yield; nothing if the law does not say."""
        return beyond_yield(self.material, self.sigma, self.epsilon, self.history)

    def _feel_tension(self) -> None:
        """Warn once of a point that stays in tension, which is negative damping where strain lags behind the points.

        Looks are as far from each other as those at energy, and irregular, or a body that swings in time with them
        would seem to stand still.
        """
        if self.tense is None or self.doing % LOOK_EVERY != 31 * (self.doing // LOOK_EVERY) % LOOK_EVERY:
            return
        rows = [k for k, (i, j) in enumerate(self.kinematics.components) if i == j < len(self.x)]
        self.looks += 1
        np.minimum(self.tense, self.sigma[rows].max(axis=0), out=self.tense)
        if self.looks < PATIENCE:
            return
        share = self.tense / self.moduli_at_rest()[0, 0]
        self.tense, self.looks = np.full_like(share, np.inf), 0
        if share.max() > TENSE:
            point, self.tense = self._first(share == share.max()), None
            warnings.warn(f"{self._whereabouts(point)} has been in tension of {share[point]:.3g} of its modulus for "
                          f"{PATIENCE * LOOK_EVERY} steps, more than {TENSE:g}; a body in tension slowly leaves "
                          "equilibrium, at any step.  Take xpic=2, or integrator='usl'.", UserWarning, stacklevel=2)

    looks = 0

    def moduli_at_rest(self) -> ndarray:
        """Stiffness of the points without strain and stress, ``(m, m, n)`` or ``(m, m, 1)``."""
        dim, n = self.x.shape
        return moduli_at_rest(self.material, self.history, len(self.sigma), n, self.kinematics.rows(dim))

    # -- words -------------------------------------------------------------------------------------------------------

    def _first(self, mask: ndarray) -> int:
        """Where the first of some points is kept, the first in the user's order."""
        return int(np.flatnonzero(mask)[0])

    def _numbers(self) -> ndarray:
        """What the user calls the points, in the order in which they are kept."""
        return np.arange(self.x.shape[1]) if self.kept is None else self.kept

    def _number(self, point: int) -> int:
        """What the user calls a point: its number at the start."""
        return point if self.kept is None else int(self.kept[point])

    def _whereabouts(self, point: int) -> str:
        return f"step {self.doing}: point {self._number(point)} at {position(self.x, point)}"

    def _cure(self) -> str:
        if not self.choices.method.conjugate:
            return "Elastic waves grow with this method at any time step; 'cmpm-c' and 'gimp' are the likely cure."
        return f"A shorter time step (it was {self.dt:g}) is the likely cure."

    def _stop(self, point: int, what: str, cure: str = "") -> NoReturn:
        raise UnstableError(f"{self._whereabouts(point)} {what}; the last good state is in .state.  "
                            f"{cure or self._cure()}", self.last)
