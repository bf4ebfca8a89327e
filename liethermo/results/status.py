"""Status, statistics and laws of a run."""

from __future__ import annotations

from dataclasses import dataclass

from ..engines.status_codes import STATUS_NAMES, StatusCode
from ..errors import InputError

OK_NAMES = tuple(STATUS_NAMES[code] for code in (StatusCode.COMPLETED, StatusCode.EVENT))
"""Names of the status codes of runs that reached their end or an event that ends them."""


@dataclass(frozen=True)
class Status:
    """Status of a run at its end: a code and a message.

    Attributes
    ----------
    code : {"completed", "event", "not_converged", "non_finite", "step_underflow", "step_limit", "interrupted", \
"reference_failed", "inadmissible"}
        Given by name or as a :class:`liethermo.engines.status_codes.StatusCode`.
    message : str
        A full sentence: what happened, where, and what to try.
    step : int
        Number of steps taken; if ``ok`` is false, the next step failed.
    time : float
        Time reached.
    residual : float
        ``h |k - slopes(k)| / |x|`` of the last attempted step.
    """

    code: str | StatusCode
    message: str
    step: int
    time: float
    residual: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "code", STATUS_NAMES[self.code] if isinstance(self.code, StatusCode) else self.code)
        if self.code not in STATUS_NAMES:
            raise InputError(f"no status {self.code!r}; there are {', '.join(STATUS_NAMES)}")

    @property
    def ok(self) -> bool:
        return self.code in OK_NAMES

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"


@dataclass(frozen=True)
class Stats:
    """Work counters of a run, and extreme values over *all* steps, saved or not.

    Attributes
    ----------
    steps, fixed_point_iterations, newton_iterations, most_iterations : int
        ``most_iterations`` is the largest number of iterations in one step.
    rejected : int
        Number of attempted steps that were too long.
    worst_residual : float
        Largest accepted ``h |k - slopes(k)| / |x|``.
    energy_range : (float, float)
        Smallest and largest energy, less the work done from outside.
    least_entropy_increment, largest_energy_increment : float
        Extreme increments in one step. These and ``energy_range`` are None if no step was followed (no step taken, or
        ``Reference``).
    attitude_residual : float or None
        Largest distance of the saved attitudes from the group, relative to their norm; None without a group.
    spatial_momentum_change : float or None
        Largest change of the spatial momentum ``Ad_star(inverse(g), mu)`` among the saved states, relative to its norm.
    wall_time : float
        Seconds, compilation included.
    """

    steps: int = 0
    fixed_point_iterations: int = 0
    newton_iterations: int = 0
    rejected: int = 0
    most_iterations: int = 0
    worst_residual: float = 0.0
    energy_range: tuple[float, float] | None = None
    least_entropy_increment: float | None = None
    largest_energy_increment: float | None = None
    attitude_residual: float | None = None
    spatial_momentum_change: float | None = None
    wall_time: float = 0.0

    @property
    def iterations_per_step(self) -> float:
        return (self.fixed_point_iterations + self.newton_iterations) / max(self.steps, 1)


@dataclass(frozen=True)
class Laws:
    """Laws that a system promises: of the energy, of the entropy, and the functions that it conserves.

    ``conserved`` names the functions that the method conserves to rounding, ``unpromised`` those that it does not: an
    audit shows their drift without a verdict. ``ledger`` names the recorded functions that count what is received from
    outside. ``balance`` names the ledger functions that the energy of a solution contains; its law is stated without
    them (``dH = work``). ``inexact`` names the laws ("energy", "entropy") that the method does not claim to keep: an
    audit judges them nevertheless, and says so. ``mean`` names the laws that hold only in the mean, because of
    fluctuations: on single paths both functions may rise and fall. ``unknown`` names the functions for which it could
    not be determined whether the system conserves them.
    """

    energy: str | None = "conserved"
    entropy: str | None = None
    conserved: tuple[str, ...] = ()
    ledger: tuple[str, ...] = ()
    inexact: tuple[str, ...] = ()
    balance: tuple[str, ...] = ()
    unpromised: tuple[str, ...] = ()
    mean: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    def __post_init__(self):
        for law in (self.energy, self.entropy):
            if law not in (None, "conserved", "nondecreasing", "nonincreasing"):
                raise InputError(
                    f"a law must be None, 'conserved', 'nondecreasing' or 'nonincreasing', got {law!r:.60}"
                )
