"""Energy and entropy that are not quadratic: the time of a step."""

from __future__ import annotations

from ..contest import COMPARED_STEPS, RELAXATION, STEP, by_c, by_library, contest, difference
from ..native import Body
from ..problems import general_body, general_parameters
from ..report import Report, Target, ratio, take_part

C, TEXTBOOK, COMPILED = "C", "C, textbook gradient", "compiled engine"


def run(quick: bool) -> Report:
    """Time a step of the midpoint scheme with Gonzalez's gradient."""
    steps, rounds = (2000, 1) if quick else (300_000, 5)
    rate = RELAXATION / (STEP * steps)
    system = general_body(rate)
    works, skipped = take_part(
        {
            C: lambda: by_c(_program(rate), steps),
            TEXTBOOK: lambda: by_c(_program(rate, "-DTEXTBOOK"), steps),
            COMPILED: lambda: by_library(system, steps, "compiled"),
            "array engine": lambda: by_library(system, steps, "array"),
        }
    )
    caption = f"A run of {steps:,} steps of size {STEP}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = contest(caption, works, steps, rounds, C)
    text = (
        "A quartic energy and a logarithmic entropy on so(3)*, given to the library as plain functions and to C with "
        "derivatives by hand. *C* evaluates the library's form of Gonzalez's gradient: three gradients and one value "
        "an iteration. *C, textbook gradient* evaluates the formula as printed, one gradient and one value, which "
        "loses itself in rounding noise when a system comes to rest. Times are of the processor."
    )
    if C in works:
        text += (
            f" Over {COMPARED_STEPS} steps the trajectories of the C program and the compiled engine differ by "
            f"{difference(_program(1.0), general_body(1.0)):.0e}."
        )
    measured = ratio(times[COMPILED], times.get(C))
    targets = [Target("general H and S, same scheme, against C with derivatives by hand", 1.3, measured)]
    return Report("A general energy and entropy", text, [table], targets, skipped)


def _program(rate: float, *options: str) -> Body:
    return Body("general.c", general_parameters(rate), *options)
