"""Energy and entropy that are not quadratic: the time of a step."""

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
from ..problems import general_body, general_parameters
from ..report import Report, Target, build_available, ratio

C_ROW = "C"
"""Row of the C program."""
TEXTBOOK_ROW = "C, textbook gradient"
"""Row of the C program with the gradient as printed."""
COMPILED_ROW = "compiled engine"
"""Row of the compiled engine."""


def run(is_quick: bool) -> Report:
    """Time a step of the midpoint scheme with Gonzalez's gradient."""
    steps, rounds = (2000, 1) if is_quick else (300_000, 5)
    rate = RATE_TIMES_DURATION / (STEP_SIZE * steps)
    system = general_body(rate)
    works, skip_reasons = build_available(
        {
            C_ROW: lambda: c_run(_c_program(rate), steps),
            TEXTBOOK_ROW: lambda: c_run(_c_program(rate, "-DTEXTBOOK"), steps),
            COMPILED_ROW: lambda: library_run(system, steps, "compiled"),
            "array engine": lambda: library_run(system, steps, "array"),
        }
    )
    caption = f"A run of {steps:,} steps of size {STEP_SIZE}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = race_runs_of_one_trajectory(caption, works, steps, rounds, C_ROW)
    text = (
        "A quartic energy and a logarithmic entropy on so(3)*, given to the library as plain functions and to C with "
        "derivatives by hand. *C* evaluates the library's form of Gonzalez's gradient: three gradients and one value "
        "an iteration. *C, textbook gradient* evaluates the formula as printed, one gradient and one value, which "
        "loses itself in rounding noise when a system comes to rest. Times are of the processor."
    )
    if C_ROW in works:
        text += (
            f" Over {COMPARED_STEPS} steps the trajectories of the C program and the compiled engine differ by "
            f"{max_difference_from_c(_c_program(1.0), general_body(1.0)):.0e}."
        )
    c_ratio = ratio(times[COMPILED_ROW], times.get(C_ROW))
    targets = [Target("general H and S, same scheme, against C with derivatives by hand", 1.3, c_ratio)]
    return Report("A general energy and entropy", text, [table], targets, skip_reasons)


def _c_program(rate: float, *options: str) -> BodyProgram:
    return BodyProgram("general.c", general_parameters(rate), *options)
