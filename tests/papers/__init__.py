"""Check the papers formula by formula: each figure is the difference between the library and an independent
calculation.

``python -m tests.papers`` computes every figure and writes them into ``docs/reference/verification.md``.
"""

from __future__ import annotations

import functools
import importlib
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt
from liethermo.tracing.interpret import evaluate_at_points

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "verification.md"

ROUNDING = 1e-12
"""Largest relative difference of a formula without a step: at most 3e-14 seen, in sums of some hundred products."""


class Order(float):
    """Measured order of convergence."""

    def __str__(self) -> str:
        return f"order {float(self):.2f}"


class Value(float):
    """Figure that is not rounding, and that both calculations have."""

    def __str__(self) -> str:
        return _power(self, 2) if self < 0.01 else f"{float(self):.2g}"


class Difference(float):
    """Largest difference between two calculations, relative to the largest number of the second."""

    def __str__(self) -> str:
        return "0" if self == 0.0 else _power(self, 1)


Figure = Order | Value | Difference


class Row(NamedTuple):
    """Line of the tables: the place in a paper, the part of the library, the comparison, and the function for the
    figure."""

    paper: str
    where: str
    what: str
    beside: str
    figure: Callable[[], Figure]


ROWS: dict[str, Row] = {}


def row(paper: str, where: str, what: str, beside: str, *arguments) -> Callable:
    """Return a decorator that enters a function as the figure of a line, called with these arguments."""

    def enter(figure: Callable[..., Figure]) -> Callable[..., Figure]:
        name = " ".join([figure.__name__, *map(str, arguments)])
        ROWS[f"{paper} {where}: {name}"] = Row(paper, where, what, beside, functools.partial(figure, *arguments))
        return figure

    return enter


def agree(figure: Figure, page_text: str) -> bool:
    """Return True if a figure is the one on the page: orders and values to their digits, rounding within a power of
    ten."""
    if isinstance(figure, Order):
        return page_text.startswith("order ") and abs(figure - float(page_text.removeprefix("order "))) < 0.02
    number = float(re.sub(r"\$(.*) \\cdot 10\^\{(.*)\}\$", r"\1e\2", page_text))
    if isinstance(figure, Value):
        return abs(figure - number) < 0.05 * abs(number)
    return 0.0 <= figure <= max(10.0 * number, 1e-15)


def tables(figures: dict[str, Figure]) -> dict[str, str]:
    """Return the table of each paper in Markdown, with a figure for the name of each line."""
    lines_by_paper: dict[str, list[str]] = {}
    for name, line in ROWS.items():
        lines = lines_by_paper.setdefault(line.paper, ["| where | what | beside | figure |", "|---|---|---|---|"])
        lines.append(f"| {line.where} | {line.what} | {line.beside} | {figures[name]} |")
    return {paper: "\n".join(lines) for paper, lines in lines_by_paper.items()}


def find_table(text: str, paper: str) -> re.Match[str]:
    """Return the match of a paper's table in the text of the page."""
    match = re.search(rf"(?<=<!-- {paper}: python -m tests.papers -->\n\n).*?(?=\n\n<!-- end -->)", text, re.S)
    assert match is not None, f"the page has no place for the table of {paper}"
    return match


class Tests:
    """Module of tests that is imported when an attribute of it is asked for: importing this package builds nothing."""

    def __init__(self, name: str):
        self._name = f"tests.liethermo.{name}"

    def __getattr__(self, name: str):
        return getattr(importlib.import_module(self._name), name)


# -- what lines are computed with -------------------------------------------------------------------------------------


def fields(system, points) -> np.ndarray:
    """Return the vector field of a system at points, shape (m, n)."""
    return evaluate_at_points(_field, system, np.atleast_2d(np.asarray(points, dtype=float)))


def _field(system, x):
    return system.vector_field(x)


def relative_difference(array, reference) -> Difference:
    """Return the largest difference of two arrays, relative to the largest entry of the second."""
    array, reference = np.asarray(array), np.asarray(reference)
    return Difference(np.abs(array - reference).max() / np.abs(reference).max())


def largest_difference(*figures: Difference) -> Difference:
    return Difference(max(figures))


def solve_with_scipy(rate: Callable, y0, t: float) -> np.ndarray:
    """Return the state at time t by SciPy's DOP853 with tolerances of 1e-13."""
    return solve_ivp(rate, (0.0, t), y0, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def order(system, x0, t: float, exact, method, counts: Sequence[int] = (20, 40), laws: bool = True) -> Order:
    """Return the order of a method from its errors with two numbers of steps.

    ``exact`` is the state at the end. The run's audit must pass unless ``laws`` is False.
    """
    errors = []
    for count in counts:
        run = lt.integrate(system, x0, (0.0, t), t / count, method)
        assert run.status.ok, run.status
        assert run.audit().passed or not laws
        errors.append(np.abs(run.x[-1] - exact).max())
    return Order(math.log2(errors[0] / errors[1]))


def _power(value: float, digits: int) -> str:
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return rf"${mantissa} \cdot 10^{{{int(exponent)}}}$"
