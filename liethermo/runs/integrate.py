"""``integrate``: check the arguments, run the time loop, raise the errors of a failed run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Literal

from manifolds._precision import with_library_settings

from ..integrators import OneStepMethod, Reference
from ..results.solution import Solution
from ..systems import System
from .adaptive import Adaptive
from .events import Until
from .noise import Fluctuations
from .preparation import refuse_tracers
from .problem import Problem
from .propagator import Propagator
from .run import Run
from .schedule import StepSchedule


@with_library_settings
@refuse_tracers
def integrate(
    system: System,
    x0,
    t_span: tuple[float, float],
    step: float | Adaptive,
    method: OneStepMethod | Reference | None = None,
    *,
    save_every: int = 1,
    save_at=None,
    until: Until | None = None,
    dense: bool = False,
    engine: Literal["auto", "array", "compiled", "sparse"] = "auto",
    on_failure: Literal["raise", "return"] = "raise",
    progress: bool | None = None,
    save_to: str | os.PathLike | None = None,
    attitude=None,
    noise: Fluctuations | None = None,
    breaks: Sequence[float] = (),
) -> Solution:
    """Integrate a system from a state over a span of time.

    Parameters
    ----------
    system : System
        The system, such as a :class:`LiePoissonSystem`, a :class:`MetriplecticSystem` or a model of
        :mod:`liethermo.models`. Its functions fix the units; the library has none of its own.
    x0 : array, shape (n,)
        The initial state, in the units of the system: for a body in SI units kg m**2 / s. ``system.state`` converts
        other arrays, such as density matrices and spins. If entropies of baths are left out, they are zero.
    t_span : (float, float)
        Start and end (in the unit of time of the system; s in SI), the end later. The last step is shortened to end
        there. Energies and torques that depend on time use these times. The end may be infinite with adaptive steps and
        ``until``: the run then ends at the event.
    step : float or Adaptive
        Step size (time), > 0, or ``lt.Adaptive(rtol, atol)``. For ``Reference`` it is the spacing of the output.
    method : OneStepMethod or Reference
        The integrator; by default ``MetriplecticGauss(1)``, of order 2.
    save_every : int
        Keep the states of every ``save_every``-th step, and the last. The laws are measured at every step.
    save_at : array of times, optional
        Keep the states at these times (in the unit of ``t_span``), and the last. Steps end there, so the laws hold
        there too.
    until : Relaxed, function, or a list of them, optional
        Events. ``lt.Relaxed(tol)`` stops the run when the rate of entropy production, or of the fall of the energy, is
        below ``tol``. A function of (x) or (t, x) that returns a number, in any unit, has its event where it is zero
        and changes its sign. Arguments named ``t``, ``attitude``, ``parameters`` and ``system`` are the time, the
        element of the group, a dict of the parameters of the system by name, and the system. The attribute
        ``terminal`` of a function is True (by default; its first event ends the run), False, or the number of events
        that ends the run; ``direction`` is 1 if only rises count, -1 if only falls do. A step ends at each event, to
        rounding; ``solution.events`` has their times and states, ``solution.event_time`` the time of the last. A jump
        or a pole is not a zero: a step ends there, the run goes on, and the status says so. If a function is NaN
        between two signs, the run ends with the status "non_finite". Steps of given size are examined at their ends,
        adaptive steps also between them.
    dense : bool
        Keep all states, so that ``solution(t)`` is known at any time, by a step from the last state before t.
    engine : {"auto", "array", "compiled", "sparse"}
        "array" runs JAX programs, for systems of any size. "compiled" runs machine code, which takes less time a step;
        it is compiled the first time and kept on disk. "auto" compiles for up to 40 components if a step has few
        operations or the run 20,000 steps and more. It falls back to "array", with a warning, if a
        part of the system cannot be compiled. "sparse" solves stiff steps of large systems with sparse matrices.
        "auto" takes it from 200 components on, if the system knows which of its components act on which (networks do).
    on_failure : {"raise", "return"}
        What to do if a step fails. The trajectory so far is the ``.solution`` of the exception, or it is returned with
        a ``status`` that says what happened.
    progress : bool, optional
        Show a progress bar; by default if the standard error is a terminal.
    save_to : path, optional
        Write the solution to this file, at most once a minute during the run, at its end, and on failure.
    attitude : array, shape (m, m), or scipy.spatial.transform.Rotation; optional
        If the system has a group, the initial element of it (dimensionless); the identity by default. For SO(3) it is
        the matrix from body axes to axes in space; :func:`liethermo.bodies.attitude` converts a quaternion or Euler
        angles.
    noise : Fluctuations, optional
        ``lt.Fluctuations(boltzmann, seed)``, the noise that belongs to the dissipation. The method is then
        ``MetriplecticMidpoint``, which is the default, with steps of one size.
    breaks : sequence of float
        Times (in the unit of ``t_span``) at which the energy or the torque, as a function of time, jumps or has a
        kink. A step ends at each break inside the span. It sees the limits of these functions from before the break,
        and the next step those from after. A jump of the energy is work. Ready torques with jumps, such as
        ``lt.torques.PiecewiseConstant``, state their breaks themselves.

    Returns
    -------
    Solution
        The trajectory; after Ctrl-C the part computed so far, with status "interrupted".

    Raises
    ------
    InputError
        If an argument cannot be used.
    ConvergenceError, NonFiniteError
        If a step fails and ``on_failure`` is "raise".
    FileError
        If ``save_to`` cannot be written at the end, with the run as ``.solution``; before that it is a warning.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> solution = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 20.0), 0.1)
    >>> solution.x.shape, solution.audit().passed
    ((201, 3), True)

    Adaptive steps of order 8, until the body has come to rest:

    >>> solution = lt.integrate(
    ...     body,
    ...     [0.1, 0.2, 1.0],
    ...     (0.0, 1e4),
    ...     lt.Adaptive(1e-9),
    ...     lt.MetriplecticRungeKutta(8),
    ...     until=lt.Relaxed(1e-8),
    ... )
    >>> solution.status.code, solution.event_time < 1e3
    ('event', True)
    """
    propagator = Propagator(system, method, step, engine=engine, noise=noise)
    return propagator(
        x0,
        t_span,
        save_every=save_every,
        save_at=save_at,
        until=until,
        dense=dense,
        on_failure=on_failure,
        progress=progress,
        save_to=save_to,
        attitude=attitude,
        breaks=breaks,
    )


@with_library_settings
def solution_without_steps(system: System, x0, t: float, method: OneStepMethod) -> Solution:
    """Return a solution that holds only the initial state, at time t.

    Raises
    ------
    InputError
        If the method cannot start at x0.
    """
    problem = Problem.from_user(system, method, x0=x0)
    run = Run(problem, problem.initial_state(x0, t), StepSchedule.empty_schedule(t), None, "auto", dense=True)
    run.complete_without_steps()
    return run.solution_so_far()
