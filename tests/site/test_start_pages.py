"""Check that each reader finds a first page: pictures, prerequisites, and the words that are searched."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FIELDS = sorted(page for page in (DOCS / "start").glob("*.md") if page.stem not in ("index", "install", "adopt"))
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if not {"_build", "gallery", "generated"} & set(page.parts)]
CARD = re.compile(r"images/cards/(\w+)\.png")


@pytest.mark.parametrize("page", FIELDS, ids=lambda page: page.stem)
def test_a_start_page_begins_with_a_picture_and_what_one_needs(page):
    text = page.read_text()
    beginning = text.partition("\n## ")[0]
    assert f"images/cards/{page.stem}.png" in beginning
    assert re.search(r"^You need: ", beginning, re.MULTILINE)
    assert "## 1. Install\n\nThe page {doc}`install` has the command." in text
    assert "<!-- picture:" in text


def test_both_indices_have_a_card_for_every_start_page():
    for index in ("index.md", "start/index.md"):
        cards = set(CARD.findall((DOCS / index).read_text()))
        assert {page.stem for page in FIELDS} <= cards, index


def test_every_picture_of_a_card_is_drawn_and_shown(import_from_docs):
    cards = import_from_docs("cards")
    drawn_names = {page.rpartition("/")[2] for page in cards.FIGURES}
    assert drawn_names == {path.stem for path in cards.CARDS.glob("*.png")}
    assert drawn_names == {name for page in PAGES for name in CARD.findall(page.read_text())}
    assert all((DOCS / f"{page}.md").is_file() for page in cards.FIGURES)


def _keywords(text: str) -> set[str]:
    """Return the words that the search finds a page by, beside those of its text."""
    match = re.match(r'---\nmyst:\n  html_meta:\n    keywords: "(.*)"\n---\n', text)
    return {word.strip().lower() for word in match[1].split(",")} if match else set()


@pytest.mark.parametrize(
    ("words", "page"),
    [
        ("license", "start/adopt"),
        ("licence", "start/adopt"),
        ("citation", "start/adopt"),
        ("roadmap", "start/adopt"),
        ("float32", "start/install"),
        ("GPU", "start/install"),
        ("conda", "start/install"),
        ("LLG", "start/magnets"),
        ("Landau-Lifshitz-Gilbert", "start/magnets"),
        ("micromagnetics", "start/magnets"),
        ("master equation", "start/quantum"),
        ("Lindblad", "start/quantum"),
        ("reaction wheel", "start/spacecraft"),
        ("attitude control", "start/spacecraft"),
        ("detumbling", "howto/torques"),
        ("Toda", "howto/choose_dissipation"),
        ("cluster", "howto/studies"),
        ("security", "explanation/trust"),
        ("Langevin", "explanation/fluctuations"),
    ],
)
def test_the_search_finds_the_page_of_a_word(words, page):
    text = (DOCS / f"{page}.md").read_text()
    page_words = _keywords(text) | set(re.findall(r"\w+", text.lower()))
    assert set(re.findall(r"\w+", words.lower())) <= page_words


def test_keywords_are_single_words():
    """Sphinx finds a keyword as a whole, and what a reader types word by word."""
    faulty_words = {
        page.stem: word for page in PAGES for word in _keywords(page.read_text()) if re.search(r"[\s-]", word)
    }
    assert faulty_words == {}
    assert sum(bool(_keywords(page.read_text())) for page in PAGES) > 30


def test_the_search_lists_last_pages_that_exist():
    last_pages = re.findall(r'^  "([\w/]+)",$', (DOCS / "search_scorer.js").read_text(), re.MULTILINE)
    assert {"reference/changelog", "reference/bibliography", "reference/benchmarks"} <= set(last_pages)
    assert all((DOCS / f"{page}.md").is_file() for page in last_pages)
    assert 'str(HERE / "search_scorer.js")' in (DOCS / "conf.py").read_text()  # Sphinx reads it from anywhere
