"""One relaxed rigid body: the time of a step."""

from __future__ import annotations

from ..contest import COMPARED_STEPS, RELAXATION, STEP, by_c, by_library, contest, difference
from ..native import Body
from ..problems import body, body_parameters, plain_body
from ..report import Report, Target, ratio, take_part

C, QUADRATIC, PLAIN = "C", "compiled engine, `lt.Quadratic`", "compiled engine, plain functions"


def run(quick: bool) -> Report:
    """Time a step in a run long enough that calls do not count, and the call of a short one."""
    steps, rounds = (2000, 1) if quick else (1_000_000, 5)
    rate = RELAXATION / (STEP * steps)
    long, skipped = take_part(
        {
            C: lambda: by_c(_program(rate), steps),
            QUADRATIC: lambda: by_library(body(rate), steps, "compiled"),
            PLAIN: lambda: by_library(plain_body(rate), steps, "compiled"),
            "array engine, `lt.Quadratic`": lambda: by_library(body(rate), steps, "array"),
            "array engine, plain functions": lambda: by_library(plain_body(rate), steps, "array"),
        }
    )
    caption = f"A run of {steps:,} steps of size {STEP}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = contest(caption, long, steps, rounds, C)

    few = 100 if quick else 1000
    short, _ = take_part(
        {
            C: lambda: by_c(_program(1.0), few, 1),
            "compiled engine": lambda: by_library(body(1.0), few, "compiled", 1),
            "array engine": lambda: by_library(body(1.0), few, "array", 1),
        }
    )
    caption = (
        f"The run of the paper's figure: one call for {few} steps (rate 1), every state kept. Here the times are "
        "mostly what a call costs before and after its steps."
    )
    calls, of_calls = contest(caption, short, few, 3 * rounds, C)
    beside = of_calls["compiled engine"] - few * times[QUADRATIC] / steps

    text = (
        "The metriplectic midpoint scheme on one relaxed rigid body, with the same rules for the iteration, "
        "compensated summation, steering of the energy and record of energy and entropy at every step. Times are of "
        "the processor. That H and S are quadratic the library sees from plain functions too."
    )
    if C in long:
        text += (
            f" Over {COMPARED_STEPS} steps the trajectories of the C program and the compiled engine differ by "
            f"{difference(_program(1.0), body(1.0)):.0e}."
        )
    targets = [
        Target(f"midpoint scheme, one relaxed rigid body, against C ({name})", 1.3, ratio(times[name], times.get(C)))
        for name in (PLAIN, QUADRATIC)
    ]
    targets.append(
        Target(f"a call of {few} steps that keeps every state, without the steps", 1.5e-4, beside, "seconds")
    )
    return Report("One body", text, [table, calls], targets, skipped)


def _program(rate: float) -> Body:
    return Body("rigid_body.c", body_parameters(rate))
