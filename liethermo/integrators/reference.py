"""An ordinary adaptive integrator for comparison: accurate, but with no regard for the laws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..errors import InputError
from ..systems import System
from ..tracing.programs import jit_cached


@dataclass(frozen=True)
class Reference:
    """SciPy's ``solve_ivp`` on the vector field, as a reference for errors and as an example of an ordinary solver.

    It obeys neither law: energy and entropy drift with the tolerance. ``step`` is only the spacing of the output.

    Parameters
    ----------
    rtol, atol : float
        Relative tolerance (dimensionless) and absolute tolerance (in the units of the state). By default ``atol`` is
        ``rtol * 1e-2``.
    scheme : {"DOP853", "RK45", "RK23", "Radau", "BDF", "LSODA"}
        Order 8 by default; Radau for stiff systems.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> exact = lt.integrate(
    ...     body, [0.1, 0.2, 1.0], (0.0, 10.0), 1.0, lt.Reference(rtol=1e-12)
    ... )
    >>> ours = lt.integrate(
    ...     body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1, lt.MetriplecticGauss(4)
    ... )
    >>> bool(abs(ours.x[-1] - exact.x[-1]).max() < 1e-9)
    True
    """

    rtol: float = 1e-10
    atol: float | None = None
    scheme: str = "DOP853"

    preserves: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self):
        if not 0.0 < self.rtol < 1.0:
            raise InputError(f"rtol must be between 0 and 1, got {self.rtol}")
        if self.scheme not in ("DOP853", "RK45", "RK23", "Radau", "BDF", "LSODA"):
            raise InputError(f"scheme must be DOP853, RK45, RK23, Radau, BDF or LSODA, got {self.scheme!r}")

    def trajectory(self, system: System, x0: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, int, str, bool]:
        """Return the states at the times, the number of evaluations, a message, and whether the run was interrupted.

        The message is "" on success; Ctrl-C returns the states up to that time.
        """
        import scipy.integrate

        rtol, atol = max(self.rtol, 3e-14), self.rtol * 1e-2 if self.atol is None else self.atol
        solver, sign = getattr(scipy.integrate, self.scheme), 1.0 if times[-1] >= times[0] else -1.0
        chunks, message, was_interrupted = [np.asarray(x0)[None]], "", False
        n_reached = 1
        try:
            run = solver(
                lambda _, x: np.asarray(_vector_field(system, x)),
                times[0],
                np.asarray(x0),
                times[-1],
                rtol=rtol,
                atol=atol,
            )
            while run.status == "running" and n_reached < len(times):
                message = run.step() or ""
                n_passed = int(np.searchsorted(sign * times, sign * run.t, side="right"))
                if run.status != "failed" and n_passed > n_reached:
                    chunks.append(run.dense_output()(times[n_reached:n_passed]).T)
                    n_reached = n_passed
        except KeyboardInterrupt:
            was_interrupted = True
        states = np.concatenate(chunks)
        finite = np.isfinite(states).all(axis=1)
        if not finite.all():
            states, message = states[: int(finite.argmin())], message or "NaN"
        return states, int(run.nfev), message, was_interrupted

    def __str__(self) -> str:
        return f"Reference(rtol={self.rtol:g}, scheme={self.scheme})"


@jit_cached
def _vector_field(system: System, x):
    """Return the vector field of a system at the state x, shape (n,)."""
    return system.vector_field(x)
