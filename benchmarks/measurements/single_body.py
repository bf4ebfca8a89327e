"""One relaxed rigid body: the time of a step."""

from __future__ import annotations

from ..contest import (
    COMPARED_STEPS,
    RATE_TIMES_DURATION,
    STEP_SIZE,
    c_run,
    library_run,
    max_difference_from_c,
    race_one_trajectory,
)
from ..native import BodyProgram
from ..problems import body_parameters, function_body, quadratic_body
from ..report import Report, Target, build_available, ratio

C_ROW, QUADRATIC_ROW, PLAIN_ROW = "C", "compiled engine, `lt.Quadratic`", "compiled engine, plain functions"


def run(quick: bool) -> Report:
    """Time a step in a run long enough that calls do not count, and the call of a short one."""
    steps, rounds = (2000, 1) if quick else (1_000_000, 5)
    rate = RATE_TIMES_DURATION / (STEP_SIZE * steps)
    long, skipped = build_available(
        {
            C_ROW: lambda: c_run(_c_program(rate), steps),
            QUADRATIC_ROW: lambda: library_run(quadratic_body(rate), steps, "compiled"),
            PLAIN_ROW: lambda: library_run(function_body(rate), steps, "compiled"),
            "array engine, `lt.Quadratic`": lambda: library_run(quadratic_body(rate), steps, "array"),
            "array engine, plain functions": lambda: library_run(function_body(rate), steps, "array"),
        }
    )
    caption = f"A run of {steps:,} steps of size {STEP_SIZE}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = race_one_trajectory(caption, long, steps, rounds, C_ROW)

    few = 100 if quick else 1000
    short, _ = build_available(
        {
            C_ROW: lambda: c_run(_c_program(1.0), few, 1),
            "compiled engine": lambda: library_run(quadratic_body(1.0), few, "compiled", 1),
            "array engine": lambda: library_run(quadratic_body(1.0), few, "array", 1),
        }
    )
    caption = (
        f"The run of the paper's figure: one call for {few} steps (rate 1), every state kept. Here the times are "
        "mostly what a call costs before and after its steps."
    )
    calls, of_calls = race_one_trajectory(caption, short, few, 3 * rounds, C_ROW)
    beside = of_calls["compiled engine"] - few * times[QUADRATIC_ROW] / steps

    text = (
        "The metriplectic midpoint scheme on one relaxed rigid body, with the same rules for the iteration, "
        "compensated summation, steering of the energy and record of energy and entropy at every step. Times are of "
        "the processor. That H and S are quadratic the library sees from plain functions too."
    )
    if C_ROW in long:
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
        Target(f"a call of {few} steps that keeps every state, without the steps", 1.5e-4, beside, "seconds")
    )
    return Report("One body", text, [table, calls], targets, skipped)


def _c_program(rate: float) -> BodyProgram:
    return BodyProgram("rigid_body.c", body_parameters(rate))
