"""Check that what a user is shown runs: the Python blocks of the README and the pages, and the gallery's examples."""

from __future__ import annotations

import ast
import builtins
import importlib
import re
import runpy
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

import liethermo
import manifolds

ROOT = Path(__file__).resolve().parent.parent
BUILT_FOLDERS = ("_build", "gallery", "generated")
PAGES = [
    ROOT / "README.md",
    *sorted(
        page for page in (ROOT / "docs").rglob("*.md") if not set(BUILT_FOLDERS) & set(page.relative_to(ROOT).parts)
    ),
]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """Enter an empty folder and use a backend without a screen; close all figures afterwards."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    yield tmp_path
    plt.close("all")


@pytest.mark.parametrize("page", ["docs/howto/choose_dissipation.md", "docs/reference/conventions.md"])
def test_the_python_blocks_of_a_page_run_in_order(page, scratch):
    """Two pages run without warnings; `make docs` runs all of them, and a block that fails stops it."""
    text, namespace = (ROOT / page).read_text(), {"__name__": "__main__"}
    for block in BLOCK.finditer(text):
        above = text.count("\n", 0, block.start(1))  # a traceback then names the line of the page
        exec(compile("\n" * above + block[1], str(page), "exec"), namespace)


def test_an_example_runs_and_draws(scratch):
    """One example of the gallery runs as a script; `make docs` runs all of them."""
    runpy.run_path(str(ROOT / "examples/heat/plot_damped_oscillator.py"), run_name="__main__")
    assert plt.get_fignums(), "an example shows at least one figure"


@pytest.mark.parametrize("package", [liethermo, manifolds], ids=lambda package: package.__name__)
def test_the_reference_lists_every_public_name(package):
    pages = [page.read_text() for page in (ROOT / "docs/reference").glob("api_*.md")]
    listed_names = [name for page in pages for name in re.findall(r"^ {3}([\w.]+)$", page, re.MULTILINE)]
    missing = set(package.__all__) - {word for name in listed_names for word in name.split(".")}
    assert not missing, f"add to a page docs/reference/api_*.md: {sorted(missing)}"


def test_the_page_of_errors_has_every_class_with_its_built_in():
    """Each class of errors and warnings has a row, and the page names its nearest base that a user can catch."""
    rows = [
        [re.findall(r"\w+(?:Error|Warning)", cell) for cell in row.split("|")[1:3]]
        for row in (ROOT / "docs/howto/errors.md").read_text().splitlines()
        if row.startswith("| `")
    ]
    bases = {name: also for names, also in rows for name in names}
    for package in (liethermo, manifolds):
        for name in package.__all__:
            thing = getattr(package, name)
            if isinstance(thing, type) and issubclass(thing, Exception) and thing.__bases__ != (Exception,):
                assert name in bases, f"docs/howto/errors.md has no row for {name}"
                if not issubclass(thing, Warning):
                    # an error of both packages has the built-in of the one in manifolds
                    own_bases = [
                        b for base in thing.__bases__ for b in (base.__bases__ if base.__name__ == name else [base])
                    ]
                    parents = {base.__name__ for base in own_bases} - {"LiethermoError", "ManifoldsError"}
                    assert set(bases[name]) == parents, name


LINK = re.compile(
    r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)|\{(?:doc|download)\}`(?:[^`<]*<)?([^`>]+)>?`|^:link: (\S+)$", re.MULTILINE
)
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def _words(page: Path) -> str:
    """Return the text of a page without its code."""
    return FENCE.sub("", page.read_text())


def test_links_of_pages_lead_somewhere():
    links = [(page, a or b or c) for page in PAGES for a, b, c in LINK.findall(_words(page))]
    assert len(links) > 200
    dead_links = [
        (_name(page), target)
        for page, target in ((page, target.partition("#")[0]) for page, target in links if "://" not in target)
        if target
        and target not in ("gallery/index", "../gallery/index")  # made by the build
        and not target.startswith("generated/")  # likewise
        and not any((page.parent / f"{target}{suffix}").is_file() for suffix in ("", ".md"))
    ]
    assert dead_links == []


def test_pictures_are_told_in_words():
    pictures = [(_name(page), *found) for page in PAGES for found in PICTURE.findall(page.read_text())]
    assert pictures
    assert [(page, source) for page, words, source in pictures if not words.strip()] == []


def test_every_page_is_in_the_navigation():
    docs = ROOT / "docs"
    toctree_pages = {"index"}
    for page in PAGES[1:]:
        for tree in re.findall(r"^```\{toctree\}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in tree.splitlines():
                if line and not line.startswith(":"):
                    toctree_pages.add(str((page.parent / line).resolve().relative_to(docs)))
    assert {str(page.relative_to(docs).with_suffix("")) for page in PAGES[1:]} - toctree_pages == set()
    assert {entry for entry in toctree_pages if not (docs / f"{entry}.md").is_file()} == {"gallery/index"}


def test_names_in_code_font_exist(code_links):
    """A page may name nothing that the packages do not have."""
    unknown = []
    for page in PAGES:
        for word in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", _words(page)):
            try:
                code_links.resolve(word)
            except AttributeError as error:
                unknown.append(f"{_name(page)}: {word}: {error}")
    assert unknown == []


def test_a_name_that_does_not_exist_is_found(code_links):
    assert code_links.resolve("lt.integrate(...)") == "liethermo.integrate"
    assert code_links.resolve("LieAlgebra") == "manifolds.LieAlgebra"
    assert code_links.resolve("step") is None
    assert code_links.resolve("u") is None  # a tangent vector
    assert code_links.resolve("learn") is None  # an extra
    assert code_links.resolve("lt.learn") == "liethermo.learn"
    assert code_links.resolve("mf.u") == code_links.resolve("u(n)") == "manifolds.u"
    with pytest.raises(AttributeError, match="integrat"):
        code_links.resolve("lt.integrat")


def test_python_in_code_font_is_right(code_spans):
    """Check short code in the text: names exist, arguments belong to their functions, complete statements run."""
    errors, n_checked = [], 0
    for page in PAGES:
        text = page.read_text()
        page_names = code_spans.names_of("\n".join(BLOCK.findall(text)))
        for span in code_spans.spans(text):
            try:
                n_checked += code_spans.check(span, page_names)
            except code_spans.SpanError as error:
                errors.append(f"{_name(page)}: {span}: {error}")
    assert errors == []
    assert n_checked > 400


def test_an_attribute_without_its_value_is_checked_whatever_ran_before(code_spans, monkeypatch):
    monkeypatch.setattr(builtins, "_", 2.0, raising=False)  # as doctest leaves it
    code_spans.check(".solution")  # an attribute that some class has


def test_blocks_that_are_not_executed_are_right(code_spans):
    """Check the blocks for clusters, marked as ``py``; all other blocks of Python are marked as ``python`` and run."""
    fences = [(page, fence) for page in PAGES for fence in re.findall(r"^```(\w+)$", page.read_text(), re.MULTILINE)]
    assert {fence for _, fence in fences} <= {"python", "py", "sh", "bash", "toml", "text"}
    for page in PAGES:
        for block in re.findall(r"^```py\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
            code_spans.check_block(block)
    with pytest.raises(code_spans.SpanError, match="no attribute 'runn'"):
        code_spans.check_block("import sys\n\nfor client in sys.argv:\n    study.runn(client)")


@pytest.mark.parametrize(
    ("span", "words"),
    [
        ("colour=3", "no public function has an argument 'colour'"),
        ("colour=", "no public function has an argument 'colour'"),
        ("lt.integrate(system, x0, colour=3)", "unexpected keyword argument 'colour'"),
        ("lt.Study(..., colour=3)", "unexpected keyword argument 'colour'"),
        ("step=lt.Adaptive(colour=3)", "unexpected keyword argument 'colour'"),
        ("system.vector_field(x, colour=3)", "unexpected keyword argument 'colour'"),
        ("solution.colour", "no attribute 'colour'"),
        ("lt.integrat(x)", "no 'integrat'"),
        ("ProjectedMetrics()", "there is no 'ProjectedMetrics'"),
        ("colour()", "no function or method 'colour'"),
        ("Quadratic(A, b, c, d)", "too many positional arguments"),
        ("MetriplecticGauss(stages=9)", "stages must be an integer from 1 to 8"),
        ("dissipation='friction'", "no public function takes such a value as 'dissipation'"),
        ("dissipation=[lt.ProjectedMetric(), 3]", "no public function takes such a value as 'dissipation'"),
    ],
)
def test_python_in_code_font_that_is_wrong_is_found(code_spans, span, words):
    with pytest.raises(code_spans.SpanError, match=words):
        code_spans.check(span)


def test_no_paragraph_is_lost_in_a_line(check_text):
    texts = {_name(page): page.read_text() for page in (*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md")}
    assert sum(len(text.splitlines()) for text in texts.values()) > 4000
    assert list(check_text.lost_paragraphs(texts)) == []


def test_code_is_not_wider_than_a_page(check_text):
    texts = check_text.sources(ROOT / "docs")
    assert sum(len(check_text.LISTING.findall(text)) for text in texts.values()) > 200
    assert list(check_text.wide_code(texts)) == []


def test_what_is_no_python_is_left_alone(code_spans):
    for span in ("make bench", "liethermo --version", "docs/_build/html", "CITATION.cff", ".png", "rtol * max|x|"):
        assert not code_spans.check(span)
    table = "| other | liethermo |\n|---|---|\n| `Foreign(colour=3)` | `lt.Adaptive(rtol=1e-3)` |\n\n"
    table += "`step=0.1` {doc}`index`"
    assert code_spans.spans(table) == ["lt.Adaptive(rtol=1e-3)", "step=0.1"]


UNLIMITED_PROMISE = re.compile(
    r"any even order|\b(?:holds?|monotone)\b[^.]*\b(?:any|every) step size"
    r"|\bsteps?\b[^.;]*whatever\s+(?:its|the step) size",
    re.IGNORECASE,
)
"""Promises for orders that no method has, and for steps that a method cannot take."""


def test_orders_and_step_sizes_are_told_as_they_are():
    """The pages name as many stages as the methods take, and promise nothing for steps that a method cannot take."""
    max_stages = max(s for s in range(1, 20) if _has_stages(s))
    orders_by_page = {page: re.findall(r"even orders? up to (\d+)", page.read_text()) for page in PAGES}
    assert {_name(page): set(orders) for page, orders in orders_by_page.items() if orders} == {
        "README.md": {str(2 * max_stages)},
        "docs/index.md": {str(2 * max_stages)},
    }
    assert f"s = 1 … {max_stages} " in (ROOT / "docs/explanation/accuracy.md").read_text()
    promises = [
        f"{_name(path)}: {words}" for path in TEXT_FILES for words in UNLIMITED_PROMISE.findall(path.read_text())
    ]
    assert promises == []


@pytest.mark.parametrize(
    "words",
    [
        "`MetriplecticGauss` has any even order",
        "The laws hold for every step size; accuracy does not.",
        "**The laws hold in every step**, whatever its size: energy constant",
        "keep the energy to rounding and the entropy growing at every step, whatever the step size.",
    ],
)
def test_a_promise_without_limits_is_found(words):
    assert UNLIMITED_PROMISE.search(words)


def _has_stages(stages: int) -> bool:
    try:
        liethermo.MetriplecticGauss(stages)
    except liethermo.InputError:
        return False
    return True


NUMBER = r"(?:\d[\d.,]*|two|three|four|five|six|ten|twenty|fifty|a?\s?hundred|a?\s?thousand|many|several)(?: or more)?"
FRACTION = (
    r"(?:half|(?:a|an|one|two) (?:third|half|quarter|fifth|tenth|twentieth|hundredth)s?|twice|\d+ (?:%|per cent))"
)
SPEED = re.compile(
    rf"\d\s?(?:ns|µs|us|ms)\b|\b(?:nano|micro|milli)seconds?\b"
    rf"|\b(?:{NUMBER} times|twice)\s+(?:as\s+(?:fast|slow|cheap|dear)|faster|slower|cheaper)|\bspeed of C\b"
    rf"|\b(?:takes?|took|costs?)\s+(?:some |about )?{FRACTION}\b|\b{NUMBER} (?:seconds|minutes) a (?:step|call|run)"
    rf"|\btakes?\s+(?:a second|some seconds|a few seconds|{NUMBER} (?:seconds|minutes))",
    re.IGNORECASE,
)
"""Statements in numbers about the speed of the library."""


def _figures_of_speed(path: Path) -> list[str]:
    """Return the statements about speed in the words of a page, or in the docstrings of a module."""
    if path.suffix == ".py":
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Expr)]
        words = [node.value.value for node in nodes if isinstance(node.value, ast.Constant)]
        text = "\n\n".join(word for word in words if isinstance(word, str))
    else:
        text = _words(path)
    return [match[0] for match in SPEED.finditer(text)]


def test_figures_of_speed_are_on_the_pages_of_benchmarks_alone():
    """Only the pages of benchmarks, which the measurements write, have figures of speed: elsewhere they would get
    stale."""
    benchmarks = [ROOT / "docs/reference/benchmarks.md", ROOT / "benchmarks/runs.md"]
    assert all(len(_figures_of_speed(page)) > 50 for page in benchmarks)
    ours = [path for path in TEXT_FILES if path not in benchmarks and not path.is_relative_to(ROOT / "examples")]
    texts = [*ours, ROOT / "CHANGELOG.md"]
    assert len(texts) > 300
    figures = [f"{_name(path)}: {figure}" for path in texts for figure in _figures_of_speed(path)]
    assert figures == []


@pytest.mark.parametrize(
    "words",
    [
        "Native spaces are a hundred times faster and have derivatives of every order.",
        "geomstats runs in NumPy on the host, a hundred or more times slower than a native space",
        "machine code of their own for small ones, ten times as fast and\nmore, after some seconds of compiling",
        "takes 18 ms of processor time",
        "| 10⁵ | 0.060 s | 0.6 µs | 0.8 GB |",
        "so that every pass goes through the memory without gaps: that takes a third of the time.",
        "Plain Python functions at the speed of C",
        "compiles the equations to machine code, which takes a second or two",
        "costs a quarter of what it did; ensembles take half the time",
    ],
)
def test_a_figure_of_speed_is_found(words, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(words)
    assert _figures_of_speed(page)


@pytest.fixture
def code_links(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    return importlib.import_module("code_links")


@pytest.fixture
def check_text(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("check_text")


@pytest.fixture
def code_spans(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    return importlib.import_module("code_spans")


TEXT_FILES = [
    *PAGES,
    *(path for path in sorted((ROOT / "examples").rglob("*")) if path.suffix in (".py", ".rst", ".toml")),
    *(path for package in ("liethermo", "manifolds") for path in sorted((ROOT / package).rglob("*.py"))),
]
INTERNAL_FRICTION = re.compile(
    r"internal friction|friction (?:inside|between its parts)|inside (?:it|them) rubs?|nothing acts"
    r"|friction (?:turns|brings|lets)[^.]* (?:body|whole)",
    re.IGNORECASE,
)
CONSTANT_ENERGY = re.compile(
    r"(?:keeps|constant|cannot change|takes nothing from)\s+(?:\w+\s+){0,2}energy|energy is\s+constant"
)
CONTROLLED_BODY = re.compile(r"\brigid_body\b|KillingDissipation\(")
OTHER_BODIES = re.compile(r"DoubleBracket|body_with_wheels|tumbling_body")


def _wrong_bodies(text: str) -> list[str]:
    """Return the paragraphs about friction inside a body that keeps its kinetic energy.

    The energy of the controlled body is constant, but a torque acts on it. A text with both kinds of bodies is left to
    its reader.
    """
    mentions_controlled_body = CONTROLLED_BODY.search(text) and not OTHER_BODIES.search(text)
    paragraphs = [re.sub(r"\s*\n(?:#|\s)*", " ", paragraph) for paragraph in re.split(r"\n\s*\n", text)]
    return [
        paragraph
        for paragraph in paragraphs
        if INTERNAL_FRICTION.search(paragraph) and (mentions_controlled_body or CONSTANT_ENERGY.search(paragraph))
    ]


def test_no_text_mistakes_the_controlled_body_for_one_with_friction_inside():
    mistakes = [
        f"{_name(path)}: {paragraph[:120]}" for path in TEXT_FILES for paragraph in _wrong_bodies(path.read_text())
    ]
    assert mistakes == []


@pytest.mark.parametrize(
    "text",
    [
        "A body tumbles. Friction inside it turns motion into heat and takes nothing from its energy, so it settles.",
        "Something inside it rubs. Nothing acts from outside.\n\nbody = lt.models.rigid_body(inertia=(3.0, 2.0, 1.0))",
        "A rigid body whose internal friction keeps its energy and lets it settle on its axis of greatest inertia.",
        "A body turns; friction inside it keeps its energy and lets it settle.",
        "A rigid body with internal friction: its energy is\nconstant, its entropy grows.",
        "# Friction inside it produces entropy\n# but cannot change its energy\n\nname = 'rigid_body'",
        "Friction brings the whole to the state of greatest entropy.\n\nlt.KillingDissipation(1.0)",
    ],
)
def test_a_body_told_wrongly_is_found(text):
    assert _wrong_bodies(text)


CITATION = re.compile(r"[\[(]([A-Z][^\[\]()`]*?\b(?:19|20)\d\d\b[^\[\]()`]*)[\])](?!\()")


def _find_citations(text: str) -> list[tuple[str, str]]:
    """Return the names and years of the works that a text cites, such as ``(Holm and Janke 1993)``."""
    works = [work for citation in CITATION.findall(" ".join(text.split())) for work in citation.split(";")]
    matches = [match for work in works if (match := re.match(r"\s*(\D+?),? ((?:19|20)\d\d)", work))]
    names = re.compile(" and others| et al\\.|,? and |,? & |, ")
    return [(name, match[2]) for match in matches for name in names.split(match[1]) if name]


def test_what_the_pages_cite_is_in_the_bibliography():
    bibliography = ROOT / "docs" / "reference" / "bibliography.md"
    entries = [" ".join(entry.split()) for entry in bibliography.read_text().split("\n\n")]
    for page in PAGES:
        if page == bibliography or page.parent.name == "reference":
            continue
        for name, year in _find_citations(page.read_text()):
            assert any(name in entry and f"({year})" in entry for entry in entries), f"{_name(page)}: {name} {year}"


def test_citations_are_found():
    text = (
        "as (Holm and Janke 1993; Beretta 1984) and [Hairer, Lubich & Wanner 2006, II.4], not (in 2005) or [A 1999](b)"
    )
    assert _find_citations(text) == [
        *[(name, "1993") for name in ("Holm", "Janke")],
        ("Beretta", "1984"),
        *[(name, "2006") for name in ("Hairer", "Lubich", "Wanner")],
    ]
