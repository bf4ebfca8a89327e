"""Check that the check of the site finds each fault, planted in a page that is right without it."""

import shutil
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def check_text(import_from_docs):
    return import_from_docs("check_text")


def test_a_table_that_stays_raw_is_found(check_text):
    good_page = "<p>The size | x | of x.</p><table><tr><td>a</td></tr></table><pre>| a |\n| --- |</pre>"
    assert list(check_text.raw_tables(good_page)) == []
    (problem,) = check_text.raw_tables(good_page + "<p>| a | |s| |\n| --- | ---: |\n| 1 | 2 |</p>")
    assert problem.startswith("a table is shown as raw text: | a |")


def test_a_heading_that_stays_raw_is_found(check_text):
    good_page = "<h2>A measurement</h2><p>Issue #12, C# and <code>## code</code>.</p><pre>## A comment</pre>"
    assert list(check_text.raw_headings(good_page)) == []
    (problem,) = check_text.raw_headings(good_page + "<p>A text. ## A measurement</p>")
    assert problem.startswith("a heading is shown as raw text: A text.")


def test_a_number_that_is_not_rounded_is_found(check_text):
    page = "<p>0.123456789012</p><div class='a output'></div>"
    page += '<div class="output highlight-text"><div class="highlight"><pre><span>{}</span></pre></div></div>'
    assert list(check_text.unrounded_output(page.format("0.6768 [0.12345678]"))) == []
    (problem,) = check_text.unrounded_output(page.format("0.676812345678912e-3"))
    assert problem.endswith(": 0.676812345678912e-3")


@pytest.mark.parametrize("line", ["One ends.  Another begins.", "A `name`.  Another.", "A text. ## A measurement"])
def test_a_paragraph_that_begins_within_a_line_is_found(check_text, line):
    good_page = "## A heading\n\nA text. Another.\n\n```text\na.  b\n```\n\n| a.  | b |\n"
    assert list(check_text.lost_paragraphs({"page.md": good_page})) == []
    (problem,) = check_text.lost_paragraphs({"page.md": f"{good_page}\n{line}\n"})
    assert line in problem


@pytest.mark.parametrize("language", ["python", "sh", "bibtex"])
def test_code_wider_than_a_page_is_found(check_text, language):
    page = f"{100 * 'w'}\n\n```{language}\n{{}}\n```\n"
    assert list(check_text.wide_code({"page.md": page.format(check_text.MAX_COLUMNS * "x")})) == []
    (problem,) = check_text.wide_code({"page.md": page.format((check_text.MAX_COLUMNS + 1) * "x")})
    assert "89 columns" in problem


def test_code_of_an_example_wider_than_a_page_is_found(check_text):
    example = f'"""\nTitle\n=====\n\n{100 * "w"}\n"""\n\n# {100 * "w"}\n{{}}\n'
    assert list(check_text.wide_examples({"plot.py": example.format(check_text.MAX_COLUMNS * "x")})) == []
    (problem,) = check_text.wide_examples({"plot.py": example.format((check_text.MAX_COLUMNS + 1) * "x")})
    assert "89 columns" in problem


def test_code_of_a_docstring_wider_than_a_page_is_found(check_text):
    module = f'class A:\n    """{100 * "w"}\n\n    >>> {{}}\n    """\n'
    assert list(check_text.wide_docstrings({"a.py": module.format(84 * "x")})) == []
    (problem,) = check_text.wide_docstrings({"a.py": module.format(85 * "x")})
    assert "89 columns" in problem


def test_the_code_of_the_docstrings_fits_a_page(check_text):
    files = [file for package in ("liethermo", "manifolds") for file in (DOCS.parent / package).rglob("*.py")]
    assert len(files) > 200
    assert list(check_text.wide_docstrings({str(file): file.read_text() for file in files})) == []


def test_the_code_of_the_examples_fits_a_page(check_text):
    examples = {file.name: file.read_text() for file in DOCS.parent.glob("examples/*/plot_*.py")}
    assert len(examples) > 30
    assert list(check_text.wide_examples(examples)) == []


def test_the_check_of_the_sources_finds_each_kind(import_from_docs, tmp_path):
    check_site = import_from_docs("check_site")
    page = tmp_path / "page.md"
    page.write_text("A text.\n")
    assert check_site.check_sources(tmp_path) == []
    page.write_text(f"One ends.  Another begins.\n\n```python\n{100 * 'x'}\n```\n\n`lt.Adaptive(colour=3)`\n")
    kinds = ("colour", "begins within a line", "100 columns")
    assert [sum(kind in problem for problem in check_site.check_sources(tmp_path)) for kind in kinds] == [1, 1, 1]


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
def test_what_is_clipped_is_found(import_from_docs, tmp_path):
    check_site = import_from_docs("check_site")
    cell, style = "<td>" + "w" * 40 + "</td>", "style='display: block; overflow: auto; width: 900px'"
    page = f"<div class='bd-article'><table {style}><tr>{{}}</tr></table>"
    page += f"<div class='highlight'><pre {style}>{{}}</pre></div></div>"
    (tmp_path / "right.html").write_text(page.format(cell, 88 * "x"))
    (tmp_path / "table.html").write_text(page.format(12 * cell, 88 * "x"))
    (tmp_path / "code.html").write_text(page.format(cell, 188 * "x"))
    with check_site.browser() as chromium:
        problems = check_site.check_pages(chromium, tmp_path)
    clipping_problems = [line for line in problems if "clipped" in line]
    assert [line.split(".html: ")[0] for line in clipping_problems] == ["code", "table"]


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="no Chromium on this machine")
def test_text_that_a_narrow_screen_cuts_off_is_found(import_from_docs, tmp_path):
    check_site = import_from_docs("check_site")
    page = "<meta name='viewport' content='width=device-width'><div style='overflow-x: {}'><div class='bd-article'>"
    page += "<p style='width: {}px'>A sentence.</p></div></div>"
    (tmp_path / "right.html").write_text(page.format("hidden", 300))
    (tmp_path / "scrolled.html").write_text(page.format("auto", 500))
    (tmp_path / "wrong.html").write_text(page.format("hidden", 500))
    with check_site.browser() as chromium:
        problems = check_site.check_pages(chromium, tmp_path)
    assert problems == ["wrong.html: cut off at 390 pixels: A sentence."]


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="no Chromium on this machine")
def test_a_picture_that_squeezes_text_is_found(import_from_docs, tmp_path):
    check_site = import_from_docs("check_site")
    page = (
        "<meta name='viewport' content='width=device-width'><div class='bd-article'><img alt='A card' style='float: {}'"
    )
    page += (
        " width='320' height='99' src='data:image/svg+xml,<svg xmlns=%22http://www.w3.org/2000/svg%22/>'><p>A text.</p>"
    )
    (tmp_path / "right.html").write_text(page.format("none"))
    (tmp_path / "wrong.html").write_text(page.format("right"))
    with check_site.browser() as chromium:
        problems = check_site.check_pages(chromium, tmp_path)
    assert [problem.partition(" a picture")[0] for problem in problems] == ["wrong.html: text squeezed beside"]
