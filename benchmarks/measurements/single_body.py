"""Time of a step of one relaxed rigid body."""

from __future__ import annotations

from ..contest import (
    COMPARED_STEPS,
    RATE_TIMES_DURATION,
    STEP_SIZE,
    c_run,
    library_run,
    max_difference_from_c,
    race_runs_of_one_trajectory,
)
from ..native import BodyProgram
from ..problems import body_parameters, function_body, quadratic_body
from ..report import Report, Target, build_available, ratio

C_ROW = "C"
"""Row of the C program."""
QUADRATIC_ROW = "compiled engine, `lt.Quadratic`"
"""Row of the compiled engine with quadratic functions."""
PLAIN_ROW = "compiled engine, plain functions"
"""Row of the compiled engine with plain functions."""


def run(is_quick: bool) -> Report:
    """Time a step in a run that is long compared with the call, and the call of a short run."""
    steps, rounds = (2000, 1) if is_quick else (1_000_000, 5)
    rate = RATE_TIMES_DURATION / (STEP_SIZE * steps)
    long_works, skip_reasons = build_available(
        {
            C_ROW: lambda: c_run(_c_program(rate), steps),
            QUADRATIC_ROW: lambda: library_run(quadratic_body(rate), steps, "compiled"),
            PLAIN_ROW: lambda: library_run(function_body(rate), steps, "compiled"),
            "array engine, `lt.Quadratic`": lambda: library_run(quadratic_body(rate), steps, "array"),
            "array engine, plain functions": lambda: library_run(function_body(rate), steps, "array"),
        }
    )
    caption = f"A run of {steps:,} steps of size {STEP_SIZE}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = race_runs_of_one_trajectory(caption, long_works, steps, rounds, C_ROW)

    short_steps = 100 if is_quick else 1000
    short_works, _ = build_available(
        {
            C_ROW: lambda: c_run(_c_program(1.0), short_steps, 1),
            "compiled engine": lambda: library_run(quadratic_body(1.0), short_steps, "compiled", 1),
            "array engine": lambda: library_run(quadratic_body(1.0), short_steps, "array", 1),
        }
    )
    caption = (
        f"The run of the paper's figure: one call for {short_steps} steps (rate 1), every state kept. Here the "
        "times are "
        "mostly what a call costs before and after its steps."
    )
    calls, call_times = race_runs_of_one_trajectory(caption, short_works, short_steps, 3 * rounds, C_ROW)
    call_seconds = call_times["compiled engine"] - short_steps * times[QUADRATIC_ROW] / steps

    text = (
        "The metriplectic midpoint scheme on one relaxed rigid body, with the same rules for the iteration, "
        "compensated summation, steering of the energy and record of energy and entropy at every step. Times are of "
        "the processor. That H and S are quadratic the library sees from plain functions too."
    )
    if C_ROW in long_works:
        text += (
            f" Over {COMPARED_STEPS} steps the trajectories of the C program and the compiled engine differ by "
            f"{max_difference_from_c(_c_program(1.0), quadratic_body(1.0)):.0e}."
        )
    targets = [
        Target(
            f"midpoint scheme, one relaxed rigid body, against C ({name})", 1.3, ratio(times[name], times.get(C_ROW))
        )
        for name in (PLAIN_ROW, QUADRATIC_ROW)
    ]
    targets.append(
        Target(
            f"a call of {short_steps} steps that keeps every state, without the steps", 1.5e-4, call_seconds, "seconds"
        )
    )
    return Report("One body", text, [table, calls], targets, skip_reasons)


def _c_program(rate: float) -> BodyProgram:
    return BodyProgram("rigid_body.c", body_parameters(rate))
