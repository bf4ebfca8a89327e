"""Check that the check of the site finds each fault, planted in a page that is right without it."""

import importlib
import shutil
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def check_text(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("check_text")


def test_a_table_that_stays_raw_is_found(check_text):
    good_page = "<p>The size | x | of x.</p><table><tr><td>a</td></tr></table><pre>| a |\n| --- |</pre>"
    assert list(check_text.raw_tables(good_page)) == []
    (problem,) = check_text.raw_tables(good_page + "<p>| a | |s| |\n| --- | ---: |\n| 1 | 2 |</p>")
    assert problem.startswith("a table is shown as raw text: | a |")


def test_a_code_span_that_is_not_true_is_found(check_text):
    good_page = "`lt.Adaptive(1e-8)` and `make docs`."
    assert list(check_text.untrue_spans({"page.md": good_page})) == []
    (problem,) = check_text.untrue_spans({"page.md": good_page + " `lt.Adaptive(colour=3)`"})
    assert "colour" in problem


def test_a_number_with_two_values_is_found(check_text):
    text_a, text_b = (
        "Steps of a given size have order 13, which suits this.",
        "The runs have order 13, which suits all.",
    )
    pages = {"a.md": text_a, "b.md": text_b}
    assert list(check_text.differing_numbers(pages)) == []
    (problem,) = check_text.differing_numbers(pages | {"b.md": text_b.replace("13", "12")})
    assert "a.md: 13; b.md: 12" in problem


def test_the_pages_share_their_numbers(check_text):
    pages = check_text.sources(DOCS)
    assert sum(len(list(check_text.statements(text))) for text in pages.values()) > 150
    assert list(check_text.differing_numbers(pages)) == []


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="no Chromium on this machine")
def test_what_is_clipped_is_found(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(DOCS))
    check_site = importlib.import_module("check_site")
    cell = "<td>" + "w" * 40 + "</td>"
    page = "<div class='bd-article'><table style='display: block; overflow: auto; width: 900px'><tr>{}</tr></table>"
    (tmp_path / "right.html").write_text(page.format(cell))
    (tmp_path / "wrong.html").write_text(page.format(12 * cell))
    with check_site.browser() as chromium:
        problems = check_site.check_pages(chromium, tmp_path)
    clipping_problems = [line for line in problems if "clipped" in line]
    assert len(clipping_problems) == 1
    assert clipping_problems[0].startswith("wrong.html: ")
