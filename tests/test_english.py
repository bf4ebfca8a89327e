"""Prose follows the rules in ``docs/vale``, whether Vale is installed or not; names follow those of ``plain_names``."""

import ast
import collections
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from .plain_names import NameCheck, fault_of_docstring, fault_of_name, names_in

yaml = pytest.importorskip("yaml")

ROOT = Path(__file__).parents[1]
RULES = {path.stem: yaml.safe_load(path.read_text()) for path in sorted((ROOT / "docs/vale/liethermo").glob("*.yml"))}
PAGES = [*ROOT.glob("*.md"), *(page for page in ROOT.glob("docs/**/*.md") if "_build" not in page.parts)]
EXAMPLES = [*ROOT.glob("examples/*/plot_*.py")]
MODULES = [*ROOT.glob("liethermo/**/*.py"), *ROOT.glob("manifolds/**/*.py")]


def paragraphs_of_page(text: str) -> Iterator[str]:
    """Prose alone: no code, tables, formulas or directives."""
    text = re.sub(r"```.*?```|:::.*?:::|\$\$.*?\$\$|<!--.*?-->", "\n\n", text, flags=re.DOTALL)
    for block in re.split(r"\n\s*\n|\n(?=\s*[-*#|] )", text):
        if not block.lstrip().startswith(("|", "#", ":", "(")):
            yield block.lstrip("-* ")


def paragraphs_of_module(text: str) -> Iterator[str]:
    """Docstrings, those of attributes too, by paragraphs and entries of lists of parameters."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            blocks = re.split(r"\n\s*\n|\n\s*-{3,}\s*\n|\n(?=\s*\S+(?:, \S+)* : )", node.value.value)
            yield from (block for block in blocks if "====" not in block and ">>> " not in block)  # no tables, no code


def paragraphs_of_example(text: str) -> Iterator[str]:
    """Yield the introduction and the comments of an example of the gallery, by paragraphs and entries of lists."""
    comments = re.findall(r"(?:^#(?: .*)?\n)+", text, re.MULTILINE)
    for part in (
        ast.get_docstring(ast.parse(text)) or "",
        *(re.sub(r"^# ?", "", c, flags=re.MULTILINE) for c in comments),
    ):
        prose = re.sub(r":math:`.*?`", "x", part, flags=re.DOTALL)
        yield from (
            b for b in re.split(r"\n\s*\n|\n(?=- )", prose) if "====" not in b and not b.startswith((".. ", " "))
        )


def messages_of_module(text: str) -> Iterator[str]:
    """Yield the texts of errors and warnings, with an x for each value."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name.endswith(("Error", "Warning")) or name == "warn":
                yield from (message for argument in node.args if (message := _message_text(argument)))


def _message_text(node: ast.expr) -> str:
    if isinstance(node, ast.BinOp):
        return _message_text(node.left) + _message_text(node.right)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


KINDS = {
    "pages": (PAGES, paragraphs_of_page),
    "docstrings": (MODULES, paragraphs_of_module),
    "messages": (MODULES, messages_of_module),
    "examples": (EXAMPLES, paragraphs_of_example),
}

CURE_VERBS = "give|take|use|set|leave|write|remove|build|add|ask|run|raise|replace|make|call|pass|install|try|choose"

UNCLEAR_MESSAGE = re.compile(rf"\b(is|are|has|have|must)\b[^.;]*, not x|[:;] ({CURE_VERBS}) ")
"""A message that does not say "must be Y, got Z", or whose cure is no sentence of its own."""


def faults(paragraph: str) -> Iterator[str]:
    plain_text = re.sub(
        r"\s+", " ", re.sub(r"``.*?``|`.*?`|\$.*?\$|\[[^\]]*\]", "x", paragraph, flags=re.DOTALL)
    ).strip()
    sentences = re.split(r"(?<=[.!?;:]) ", plain_text)
    for name, rule in RULES.items():
        if rule["extends"] == "substitution":
            faults_found = [word for word in rule["swap"] if re.search(rf"\b{word}\b", plain_text, re.IGNORECASE)]
        elif rule["extends"] == "existence":
            faults_found = [match.group() for raw in rule["raw"] for match in re.finditer(raw, plain_text)]
        else:
            faults_found = [s for s in sentences if len(re.findall(rule["token"], s)) > rule["max"]]
        yield from (f"{name}: {fault!r} in {plain_text[:160]!r}" for fault in faults_found)


@pytest.mark.parametrize("kind", KINDS)
def test_prose_follows_the_rules(kind):
    files, paragraphs = KINDS[kind]
    read = [(path, paragraph) for path in files for paragraph in paragraphs(path.read_text())]
    assert len(read) > 150
    faults_found = [f"{path.relative_to(ROOT)}: {fault}" for path, paragraph in read for fault in faults(paragraph)]
    assert not faults_found, "\n".join(faults_found)


def test_messages_say_what_must_be_what_was_given_and_the_cure():
    messages = [(path, message) for path in MODULES for message in messages_of_module(path.read_text())]
    assert len(messages) > 1000
    unclear = [f"{path.relative_to(ROOT)}: {message}" for path, message in messages if UNCLEAR_MESSAGE.search(message)]
    assert not unclear, "\n".join(unclear)


@pytest.mark.parametrize(
    "message",
    ["a rate must be >= 0, not x", "x depends on time: take system.at_time(t)", "x has no bodies; add a base"],
)
def test_an_unclear_message_is_found(message):
    assert UNCLEAR_MESSAGE.search(message)
    assert not UNCLEAR_MESSAGE.search("a rate must be >= 0, got x. Use its absolute value")


MANNER = (
    "Work in one thread is timed by the processor's clock, so that a busy machine does not count.",
    "A call of 1000 steps beside them, every state kept.",
    "There is no target: No target but to state what is found.",
    "Where a constant is added to H, nothing smaller can be seen, and everything larger is.",
    "So the first of several zeros is found, and one that is undone before the step ends.",
    "They differ where a method is used on what is no metriplectic system.",
    "What is known then is computed then.",
    "It is rounded once where the processor can; which ones are does not depend on the number of lanes.",
    "Keep every n-th state, n this number, and the last.",
    "Which entries of the ledger a solution has in its energy, and its laws are stated without.",
    "How to write a space is told elsewhere.",
    "A rod by and by lies down.",
    "The attitude is left out, since nobody asks for it.",
    "The status tells how it ended.",
    "A matrix is skew, so is the next.",
    "Then every Casimir stays what it is.",
)
"""Sentences that readers stumbled over, each for a manner."""


@pytest.mark.parametrize(
    "sentence",
    [
        "Keep every so-manieth state.",
        "It starts from a step of nothing.",
        "Laws hold. Of the same energy the schemes keep the rest.",
        "One idea " + "and another " * 40 + "is too much.",
        *MANNER,
    ],
)
def test_a_fault_is_found(sentence):
    assert list(faults(sentence))


def test_every_rule_is_understood():
    assert {rule["extends"] for rule in RULES.values()} == {"substitution", "existence", "occurrence"}
    assert "docs/vale" in (ROOT / ".vale.ini").read_text()


# -- names ------------------------------------------------------------------------------------------------------------

CODE = [
    path
    for folder in ("liethermo", "manifolds", "benchmarks", "tests")
    for path in sorted((ROOT / folder).rglob("*.py"))
]

PUBLIC_NAMES = frozenset(
    """
    At Determined Each InCharts Learned NoPoisson NoPolynomialCasimirWarning OffManifoldError Place Relaxed Tabulated
    Zipped all at_time coupled determined expanded on_grid outside passed preserved reduced registered resolved several
    spread symmetrised until zipped _inside
    """.split()
)
"""Names that users call or that their extensions define, which stay; ``all`` is NumPy's word."""

DIGEST_NAMES = frozenset({"called"})
"""Names of functions that digests of stored studies contain."""

MAX_LOCALS_PERCENT = 4.0
"""Share of locals and parameters in a room whose names may have a form that is rarely plain: some are the field's."""


@functools.cache
def code_names() -> tuple[NameCheck, ...]:
    return tuple(name for path in CODE for name in names_in(path))


def names_of_kind(kind: str) -> list[NameCheck]:
    return [name for name in code_names() if name.kind == kind]


@pytest.mark.parametrize("kind", ["constant", "definition"])
def test_names_are_plain(kind):
    assert len(names_of_kind(kind)) > 400
    faults = [n for n in names_of_kind(kind) if n.fault and n.name not in PUBLIC_NAMES | DIGEST_NAMES]
    assert not faults, "\n".join(f"{n.path.relative_to(ROOT)}:{n.line}: {n.name}: {n.fault}" for n in faults)


def test_docstrings_begin_with_a_subject_or_a_verb():
    faults = [n for n in names_of_kind("docstring") if n.fault]
    assert not faults, "\n".join(f"{n.path.relative_to(ROOT)}:{n.line}: {n.name}" for n in faults)


def test_code_in_docstrings_has_both_its_backquotes():
    faults = [
        f"{path.relative_to(ROOT)}: {paragraph.strip()[:80]}"
        for path in MODULES
        for paragraph in paragraphs_of_module(path.read_text())
        if paragraph.count("``") % 2 or paragraph.replace("``", "").count("`") % 2
    ]
    assert not faults, "\n".join(faults)


def test_locals_are_plain_in_every_room():
    rooms = collections.defaultdict(collections.Counter)
    for n in names_of_kind("local"):
        rooms["/".join(n.path.parent.relative_to(ROOT).parts[:2])][bool(n.fault)] += 1
    percents = {room: 100.0 * count[True] / count.total() for room, count in rooms.items() if count.total() > 50}
    assert {room: percent for room, percent in percents.items() if percent > MAX_LOCALS_PERCENT} == {}


@pytest.mark.parametrize(
    "name", ["settled", "own", "of_steps", "by_paces", "SOON", "TOGETHER", "_begun", "kept_before", "WhatIsGiven"]
)
def test_a_name_that_is_not_plain_is_found(name):
    assert fault_of_name(name)


@pytest.mark.parametrize(
    "name",
    ["solve_newton", "h", "ad_star", "why_not_startable", "seed", "embed_in_arrays", "StepControl", "MAX_FACTOR"],
)
def test_a_plain_name_is_left_alone(name):
    assert not fault_of_name(name)


@pytest.mark.parametrize("text", ["What a run is made of.", "Those of every run.", "The same for x.", "Of a step."])
def test_a_docstring_without_a_subject_is_found(text):
    assert fault_of_docstring(text)
