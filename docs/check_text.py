"""What can be wrong with the words of the site, found without a browser: part of ``make docs-check``."""

from __future__ import annotations

import ast
import html
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

EXTENSIONS = Path(__file__).resolve().parent / "_ext"

PARAGRAPH = re.compile(r"<p\b[^>]*>(.*?)</p>", re.DOTALL)
RULE = re.compile(r"\|\s*:?-{3,}:?\s*\|")
TAG = re.compile(r"<[^>]+>")
NUMBER = re.compile(r"(?<![\w.^{])\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?(?![\w^])")
CODE = re.compile(r"```.*?```|\$\$.*?\$\$|\$[^$\n]*\$|<!--.*?-->", re.DOTALL)

FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
LISTING = re.compile(r"^```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE_ELEMENT = re.compile(r"<(code|pre)\b.*?</\1>", re.DOTALL)

LOST_PARAGRAPH = re.compile(r"(?<=[.:;)`])  +(?=\S)|(?<=\S) ##+ \w")
"""Two blanks where a paragraph began, or a heading within a line."""

OUTPUT = re.compile(r'<div class="[^"]*(?:\boutput\b|script-out)[^"]*">.*?<pre>(.*?)</pre>', re.DOTALL)
"""What a block of code prints."""

MAX_DECIMALS = 14
"""Decimals of a printed number: reference values have 14, and a number that nobody has rounded 15 or more."""

MAX_COLUMNS = 88
"""Columns of a line of code that a page of the site shows without a scroll bar."""

BEFORE, AFTER = 2, 2
"""Words around a number that make it the same statement on two pages."""


def raw_tables(page: str) -> Iterator[str]:
    """Paragraphs of a built page that are a table which was not read as one."""
    for paragraph in PARAGRAPH.findall(page):
        text = html.unescape(TAG.sub("", paragraph))
        if RULE.search(text):
            yield f"a table is shown as raw text: {' '.join(text.split())[:80]}"


def raw_headings(page: str) -> Iterator[str]:
    """Yield the paragraphs of a built page that contain the marks of a heading."""
    for paragraph in PARAGRAPH.findall(CODE_ELEMENT.sub("", page)):
        text = html.unescape(TAG.sub("", paragraph))
        if re.search(r"(?:^|\s)##+ \w", text):
            yield f"a heading is shown as raw text: {' '.join(text.split())[:80]}"


def unrounded_output(page: str) -> Iterator[str]:
    """Yield the numbers that a block of code on a built page prints with more digits than a reader can use."""
    for output in OUTPUT.findall(page):
        for number in re.findall(rf"\d+\.\d{{{MAX_DECIMALS + 1},}}(?:e[+-]?\d+)?", TAG.sub("", output)):
            yield f"a printed number has more than {MAX_DECIMALS} decimals: {number}"


def lost_paragraphs(pages: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of Markdown pages in which a paragraph or a heading begins within the line."""
    for name, text in pages.items():
        for line in FENCE.sub("", text).splitlines():
            if LOST_PARAGRAPH.search(line) and not line.lstrip().startswith("|"):
                yield f"{name}: a paragraph begins within a line: {line[:80]}"


def wide_code(pages: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of code on Markdown pages that are wider than a page of the site."""
    for name, text in pages.items():
        for line in "\n".join(LISTING.findall(text)).splitlines():
            if len(line) > MAX_COLUMNS:
                yield f"{name}: code has {len(line)} columns, at most {MAX_COLUMNS} are shown: {line[:80]}"


def wide_examples(examples: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of code of examples of the gallery that are wider than a page; comments are prose there."""
    for name, text in examples.items():
        code = text.split('"""', 2)[-1]
        for line in code.splitlines():
            if len(line) > MAX_COLUMNS and not line.startswith("#"):
                yield f"{name}: code has {len(line)} columns, at most {MAX_COLUMNS} are shown: {line[:80]}"


def wide_docstrings(modules: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of code in the docstrings of Python modules that are wider than a page of the site."""
    for name, text in modules.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                for line in (ast.get_docstring(node) or "").splitlines():
                    if len(line) > MAX_COLUMNS and line.lstrip().startswith((">>> ", "... ")):
                        yield f"{name}: code has {len(line)} columns, at most {MAX_COLUMNS} are shown: {line[:80]}"


def untrue_spans(pages: Mapping[str, str]) -> Iterator[str]:
    """Python in code font that does not fit the packages; the pages are Markdown."""
    sys.path.append(str(EXTENSIONS))
    from code_spans import SpanError, check, names_of, spans

    for name, text in pages.items():
        blocks = "\n".join(re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
        bound = names_of(blocks)
        for span in spans(text):
            try:
                check(span, bound)
            except SpanError as error:
                yield f"{name}: `{span}`: {error}"


def differing_numbers(pages: Mapping[str, str]) -> Iterator[str]:
    """Statements that two pages make in the same words with different numbers; the pages are Markdown.

    A number is told by the words around it in its sentence. Where pages have several numbers in the same words, they
    must have one in common.
    """
    said: dict[tuple, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for name, text in pages.items():
        for context, number in statements(text):
            said[context][name].add(number)
    for (before, after), found in said.items():
        values = list(found.values())
        if len(found) > 1 and any(a.isdisjoint(b) for a in values for b in values):
            told = "; ".join(f"{name}: {', '.join(sorted(numbers))}" for name, numbers in sorted(found.items()))
            yield f"'{' '.join(before)} … {' '.join(after)}' has different numbers: {told}"


def statements(text: str) -> Iterator[tuple[tuple, str]]:
    """The words around each number of the prose, and the number."""
    for paragraph in _prose(text):
        for sentence in re.split(r"(?<=[.:;!?])\s+(?=[A-Z`*(\d])", paragraph):
            words = sentence.split()
            for i, word in enumerate(words):
                number = NUMBER.fullmatch(word.strip("().,;:*"))
                before, after = words[max(i - BEFORE, 0) : i], words[i + 1 : i + 1 + AFTER]
                if number and len(before) == BEFORE and len(after) == AFTER:
                    yield (tuple(map(_plain, before)), tuple(map(_plain, after))), number[0].replace(",", "")


def _plain(word: str) -> str:
    return word.strip("().,;:*`").casefold()


def _prose(text: str) -> Iterable[str]:
    blocks = re.split(r"\n\s*\n|\n(?=[-*#] )", CODE.sub("x", text))
    return (" ".join(block.split()) for block in blocks if not block.lstrip().startswith(("|", "#", ":")))


def sources(docs: Path) -> dict[str, str]:
    """The Markdown pages of a folder, without what is built."""
    built = {"_build", "gallery", "generated"}
    found = sorted(page for page in docs.rglob("*.md") if not built & set(page.relative_to(docs).parts))
    return {str(page.relative_to(docs)): page.read_text() for page in found}
