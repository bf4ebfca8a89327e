"""How a run ended, what it counted, and which laws it is judged by."""

from __future__ import annotations

from dataclasses import dataclass

from ..engines.codes import STATUS_NAMES, StatusCode
from ..errors import InputError


@dataclass(frozen=True)
class Status:
    """How a run ended.

    Attributes
    ----------
    code : {"completed", "event", "not_converged", "non_finite", "step_underflow", "step_limit", "interrupted", \
"reference_failed", "inadmissible"}
        Or its :class:`liethermo.engines.codes.StatusCode`.
    message : str
        A full sentence: what happened, where, and what to try.
    step : int
        Steps taken; where ``ok`` is false the step after it is the one that failed.
    time : float
        Time reached.
    residual : float
        ``h |k - slopes(k)| / |x|`` of the last step tried.
    """

    code: str | StatusCode
    message: str
    step: int
    time: float
    residual: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "code", self.code.status_name if isinstance(self.code, StatusCode) else self.code)
        if self.code not in STATUS_NAMES:
            raise InputError(f"no status {self.code!r}; there are {', '.join(STATUS_NAMES)}")

    @property
    def ok(self) -> bool:
        return self.code in (StatusCode.COMPLETED.status_name, StatusCode.EVENT.status_name)

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"


@dataclass(frozen=True)
class Stats:
    """The work of a run and its extremes over *all* steps, saved or not.

    Attributes
    ----------
    steps, fixed_point_iterations, newton_iterations, most_iterations : int
        ``most_iterations`` is the largest number in one step.
    rejected : int
        Steps that were tried and were too long.
    worst_residual : float
        Largest ``h |k - slopes(k)| / |x|`` accepted.
    energy_range : (float, float)
        Smallest and largest energy met; less the work done from outside, where there is any.
    least_entropy_increment, largest_energy_increment : float
        Of one step. These three are None where no step was followed (no step taken, or ``Reference``).
    attitude_residual : float or None
        Largest distance from the group of the attitudes kept, relative to their size; None without a group.
    spatial_momentum_change : float or None
        Largest change of the momentum in space ``Ad_star(inverse(g), mu)`` among the states kept, relative to its size.
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
    """What the system promises: the law of the energy, of the entropy, and the functions it conserves.

    ``conserved`` names those that the method promises to keep to rounding, ``unpromised`` those that it does not: an
    audit shows how far these drift, without a verdict. ``ledger`` names the recorded functions that say what comes from
    outside. ``balance`` names those of them that the energy of a solution contains, and its law is stated without
    (``dH = work``). ``inexact`` says which of the two laws ("energy", "entropy") the method makes no claim to keep: an
    audit judges them all the same, and says so. ``mean`` names those of the two laws that fluctuations leave for the
    mean alone: on paths both may rise and fall. ``unknown`` names the functions of which it could not be found out
    whether the system conserves them.
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
                raise InputError(f"there is no law {law!r:.60}")
