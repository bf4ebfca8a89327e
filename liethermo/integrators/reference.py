"""An ordinary adaptive integrator for comparison: accurate, but with no regard for the laws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..errors import InputError
from ..systems import System
from ..tracing.programs import program


@dataclass(frozen=True)
class Reference:
    """SciPy's ``solve_ivp`` on the vector field, to measure errors against and to show what ordinary solvers lose.

    Neither energy nor entropy law is kept: both drift with the tolerance. ``step`` is only the spacing of the output.

    Parameters
    ----------
    rtol, atol : float
        Tolerances; ``atol`` is ``rtol * 1e-2`` by default.
    scheme : {"DOP853", "RK45", "RK23", "Radau", "BDF", "LSODA"}
        Order 8 by default; Radau for stiff systems.
    """

    rtol: float = 1e-10
    atol: float | None = None
    scheme: str = "DOP853"

    preserves: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self):
        if not 0.0 < self.rtol < 1.0:
            raise InputError(f"rtol lies between 0 and 1, not at {self.rtol}")
        if self.scheme not in ("DOP853", "RK45", "RK23", "Radau", "BDF", "LSODA"):
            raise InputError(f"no SciPy scheme {self.scheme!r}; take DOP853, RK45, RK23, Radau, BDF or LSODA")

    def trajectory(self, system: System, x0: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, int, str]:
        """States at the times reached, shape (reached, n), the number of field evaluations, a message on failure."""
        from scipy.integrate import solve_ivp

        atol = self.rtol * 1e-2 if self.atol is None else self.atol
        result = solve_ivp(
            lambda _, x: np.asarray(_field(system, x)),
            (times[0], times[-1]),
            x0,
            method=self.scheme,
            t_eval=times,
            rtol=max(self.rtol, 3e-14),
            atol=atol,
        )
        states = result.y.T
        finite = np.isfinite(states).all(axis=1)
        reached = len(states) if finite.all() else int(finite.argmin())
        message = "" if result.success and reached == len(times) else (result.message if not result.success else "NaN")
        return states[:reached], int(result.nfev), message

    def __str__(self) -> str:
        return f"Reference(rtol={self.rtol:g}, scheme={self.scheme})"


@program
def _field(system: System, x):
    return system.vector_field(x)
