"""Relaxation on so(n) and su(n): the growth of compile and step times with the dimension."""

from __future__ import annotations

from .. import growth
from ..report import Report, Target

ALGEBRAS = [*(f"so {n}" for n in range(3, 9)), *(f"su {n}" for n in range(2, 6))]
"""Algebras, named as in :func:`.growth.algebra_by_name`."""


def run(is_quick: bool) -> Report:
    """Compile and time both engines on each algebra."""
    steps, rounds, names = (2000, 1, ["so 3"]) if is_quick else (200_000, 3, ALGEBRAS)
    caption = (
        f"Runs of {steps:,} steps of size {growth.STEP}, each algebra in a new process on one core with an empty "
        "cache. *Compiling* is what the first call takes longer than later ones: tracing and compiling."
    )
    table = growth.growth_table(caption, names, steps, rounds)
    ratios = {row[0]: row[6] for row in table.rows}
    text = (
        "A body on each algebra, with a quadratic energy, `KillingDissipation` and the Casimir of the Killing form as "
        "its entropy, relaxing all the way."
    )
    targets = [
        Target(f"{name} relaxation, array engine against compiled engine", 30.0, ratios.get(name), at_least=True)
        for name in ("su(4)", "su(5)")
    ]
    return Report("Dimension", text, [table], targets)


def child(name: str, steps: str, rounds: str) -> dict:
    """Measure one algebra in the child process."""
    return growth.measure_engines(name, int(steps), int(rounds))
