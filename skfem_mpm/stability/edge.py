"""How far a set-up is from the edge: its stable step, and how fast waves grow beyond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from skfem import Mesh

from ..checks import check_spans
from ..explicit import ExplicitState, run_before_its_start
from ..particles import Particles
from .layout import Layout
from .safe import safe_step
from .spectrum import Spectrum

LARGEST = 1500      # unknowns up to which the exact limit is found without being asked for


@dataclass(frozen=True)
class StepLimit:
    """How long a time step may be on a layout of points.

    Attributes
    ----------
    bound
        A step that is stable for sure; with TPIC and a share of FLIP, where waves may grow at any step, what runs take.
    exact
        The largest stable step, infinite if no step is too long and zero if TPIC with a share of FLIP makes any too
        long; ``None`` if it was not looked for.  Where waves flutter, which they do at any step, the one from which the
        step itself makes them grow too.
    flutters
        Whether waves grow at any step; ``None`` if it was not looked for.
    unknowns
        Number of velocity components that are free.
    """

    bound: float
    exact: float | None
    flutters: bool | None
    unknowns: int

    def __str__(self) -> str:
        exact = "not looked for" if self.exact is None else f"{self.exact:.4g}"
        said = "; waves grow at any step" if self.flutters else ""
        return f"stable up to {self.bound:.4g} for sure, exact limit {exact}{said}; {self.unknowns} unknowns"


@dataclass(frozen=True)
class Growth:
    """What one explicit step does to the fastest growing wave of a layout.

    Attributes
    ----------
    dt
        The time step.
    radius
        Spectral radius of the step, at least 1.
    rate
        Rate of growth, ``log(radius) / dt``.
    flutter
        Rate of growth of the layout itself, as the time step vanishes, with FLIP; other transfers take some of it away.
    cause
        ``none`` if waves do not grow; ``step`` if the time step is beyond the exact limit; else ``flutter``: a shorter
        step does not help, another method does.
    limit
        The exact limit, as in :class:`StepLimit`.
    """

    dt: float
    radius: float
    rate: float
    flutter: float
    cause: str
    limit: float

    def __str__(self) -> str:
        cure = "take 'cmpm-c' or 'gimp'" + ("" if self.flutter else ", and flip=0 with tpic")
        said = {"none": "none", "flutter": f"{self.rate:.4g}, waves flutter at any step; {cure}",
                "step": f"{self.rate:.4g}, the step is too long"}[self.cause]
        return f"growth with a step of {self.dt:.4g} (limit {self.limit:.4g}): {said}"


def critical_step(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: Sequence[Any] | None = None,
                  *, exact: bool | None = None, **choices: Any) -> StepLimit:
    r"""The largest stable time step of an explicit run, of a layout of points that stay where they are.

    The layout is at rest and free of stress, and the law linear, as stiff as it is at rest.  The exact limit is that
    of the eigenvalues of the whole step, :math:`2 / \omega_{\max}` with FLIP and not ``usl``, in any
    dimension, with every transfer, method, remedy and integration.  The bound comes from norms of blocks of
    :math:`M^{-1} C M^{-1} K`.  With FLIP it is no shorter than the cheaper one that runs hold to, of which they take
    the share ``safety``, nor is it as a rule where the stiffness is symmetric; with a share of PIC, or with XPIC, and
    an unsymmetric stiffness it may be a hundred times shorter.

    Parameters
    ----------
    mesh, start, material, boundary
        As in :func:`skfem_mpm.explicit_steps`.
    exact
        Whether to look for the exact limit; if not given, up to 1500 unknowns.  The work grows with their cube.
    choices
        Those of :func:`skfem_mpm.explicit_steps`; ``damping`` must be zero, as local damping is not linear.

    Returns
    -------
    StepLimit
        The bound and the exact limit.

    Raises
    ------
    ValueError, TypeError
        As :func:`skfem_mpm.explicit_steps`, and if there is damping.

    Examples
    --------
    >>> import numpy as np
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, uniaxial
    >>> from skfem_mpm.stability import critical_step
    >>> bar = Particles.fill(MeshLine(np.arange(11.0)), uniaxial)
    >>> print(critical_step(MeshLine(np.arange(-2.0, 14)), bar, LinearElastic(E=1.0, nu=0.0)))
    stable up to 1.6... for sure, exact limit 1.732; 11 unknowns
    """
    layout = _layout(mesh, start, material, boundary, choices)
    if not (exact is None or isinstance(exact, (bool, np.bool_))):
        raise TypeError(f"exact: got {exact!r}, expected True, False or None.")
    return limit_of(layout, spectrum_of(layout, exact))


def growth(mesh: Mesh, start: Particles | ExplicitState, material: Any, boundary: Sequence[Any] | None = None, *,
           dt: float | None = None, **choices: Any) -> Growth:
    """How fast waves grow in an explicit run, of a layout of points that stay where they are, and why.

    The spectral radius of one whole step; what is said of the layout in :func:`critical_step` holds here too.  Growth
    below 1e-5 of the highest frequency, or 1e-7 in a step, is not told from rounding.  The work grows with the cube of
    the unknowns.

    Parameters
    ----------
    mesh, start, material, boundary, choices
        As in :func:`critical_step`.
    dt
        The time step; if not given, what a run finds at its start.

    Returns
    -------
    Growth
        Radius, rate and cause.

    Raises
    ------
    ValueError, TypeError
        As :func:`critical_step`.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import replace
    >>> from skfem import MeshLine
    >>> from skfem_mpm import LinearElastic, Particles, uniaxial
    >>> from skfem_mpm.stability import growth
    >>> bar, law = Particles.fill(MeshLine(np.arange(21.0)), uniaxial), LinearElastic(E=1.0, nu=0.0)
    >>> mesh, bar = MeshLine(np.arange(-4.0, 25)), replace(bar, x=bar.x + 0.24)
    >>> print(growth(mesh, bar, law, method="cmpm"))
    growth with a step of 0.4894 (limit 1.398): 0.1275, waves flutter at any step; take 'cmpm-c' or 'gimp'
    >>> growth(mesh, bar, law, method="cmpm-c").cause, growth(mesh, bar, law, method="mpm", dt=2.0).cause
    ('none', 'step')
    """
    check_spans({"dt": dt})
    layout = _layout(mesh, start, material, boundary, choices)
    return growth_of(Spectrum(layout), float(dt or layout.first_step))


def _layout(mesh: Mesh, start: Any, material: Any, boundary: Any, choices: dict[str, Any]) -> Layout:
    """The layout of a run that could begin now."""
    if choices.get("damping"):
        raise ValueError(f"damping: got {choices['damping']!r}, expected 0; local damping is not linear, so a step "
                         "with it has no eigenvalues: leave it out.")
    return Layout(run_before_its_start(mesh, start, material, boundary, **choices))


def spectrum_of(layout: Layout, exact: bool | None = None) -> Spectrum | None:
    """Eigenvalues of a layout if they are asked for, or, if nothing is said, if it is small."""
    return Spectrum(layout) if (layout.size <= LARGEST if exact is None else exact) else None


def limit_of(layout: Layout, spectrum: Spectrum | None) -> StepLimit:
    """The stable steps of a layout, the exact one if its eigenvalues are known."""
    exact, flutters = (None, None) if spectrum is None else (spectrum.limit, spectrum.flutters)
    return StepLimit(safe_step(layout), exact, flutters, layout.size)


def growth_of(spectrum: Spectrum, dt: float) -> Growth:
    """What a step of this length does to the fastest growing wave of a layout, and why."""
    radius = spectrum.radius(dt)
    rate, cause = float(np.log(radius)) / dt, "none"
    if rate > spectrum.noise(dt):
        cause = "step" if spectrum.limit > 0 and dt > spectrum.limit else "flutter"
    return Growth(dt, radius, rate, spectrum.flutter, cause, spectrum.limit)
