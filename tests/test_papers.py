"""Compute the figures of the page of verification again, and compare them with the page."""

from __future__ import annotations

import re

import pytest

from tests.papers import PAGE, ROUNDING, ROWS, Difference, Order, Value, agree, bfm, find_table, gby, sml  # noqa: F401


def page_figures() -> dict[str, str]:
    """Return the figures on the page by the names of their lines, and check that its tables have nothing else."""
    text, figures = PAGE.read_text(), {}
    for paper in dict.fromkeys(line.paper for line in ROWS.values()):
        names = [name for name, line in ROWS.items() if line.paper == paper]
        lines = find_table(text, paper).group().splitlines()[2:]
        for name, text_line in zip(names, lines, strict=True):
            *cells, figure = [cell.strip() for cell in re.split(r"(?<!\\)\|", text_line)[1:-1]]
            assert cells == [ROWS[name].where, ROWS[name].what, ROWS[name].beside], name
            figures[name] = figure
    return figures


def test_every_line_is_on_the_page():
    assert set(page_figures()) == set(ROWS)
    assert len(ROWS) >= 39


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", ROWS)
def test_the_figures(name):
    figure = ROWS[name].figure()
    assert agree(figure, page_figures()[name]), (
        f"{figure}, and the page has {page_figures()[name]}: python -m tests.papers"
    )
    if isinstance(figure, Difference):
        assert figure <= ROUNDING


def test_figures_that_are_not_those_of_the_page():
    assert agree(Order(2.004), str(Order(2.0)))
    assert not agree(Order(1.9), str(Order(2.0)))
    assert agree(Value(2.81e-4), str(Value(2.8e-4)))
    assert not agree(Value(2.3e-4), str(Value(2.8e-4)))
    assert agree(Difference(3e-16), str(Difference(2e-16)))
    assert not agree(Difference(1e-13), str(Difference(2e-16)))
    assert not agree(Difference(float("nan")), str(Difference(2e-16)))
