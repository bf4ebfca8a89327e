"""Rules for names and for first sentences of docstrings, which ``test_english.py`` holds the code to.

A name is plain if a reader who sees path, name and parameters alone can say what it stands for. No program can judge
that; these rules find the forms that readers misread most: a bare participle (``settled``), adjective or pronoun
(``own``), a leading preposition (``of_steps``), a constant that is an ordinary word (``SOON``).
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

IRREGULAR_PARTICIPLES = frozenset(
    """
    become begun bound broken built chosen come cut done drawn felt found given gone grown held hidden hit kept
    known laid left lost made meant met paid put rung said seen sent shown shrunk shut spent spread spun sprung
    stood struck sunk sworn taken thrown told torn understood undone won worn wound written
    """.split()
)

PARTICIPLE_LOOKALIKES = frozenset(
    "bed embed exceed feed indeed need proceed red seed shed speed succeed thread token".split()
)
"""Words that end like a participle and are none."""

ORDINARY_WORDS = frozenset(
    """
    about again ahead alike all alone along already any apart around aside asking away back bare before behind
    beside besides best better big both clear close closer common common dry each early either elsewhere enough
    equal even every falling far fast faster fastest few first free further gentle going great growing harmless
    here high hopeless inside instead large larger largest last late least less like likely likewise long longer
    longest looking low measured missing more most moving narrow near nearer neither new next none noticed now
    odd off often once only other others out outside own part patient place plain previous pure quick quickly
    reaching ready regular right rising rushing same short shorter shortest slow slower small smaller smallest
    smooth some soon steady straight strong such sure then there thick thin together true turning twice unequal
    unlike until useful wanted weak when where while whole wide willing worst worth wrong
    """.split()
)

LEADING_PREPOSITIONS = frozenset(
    """
    about after all along any around at before beside between by each either for how if in like neither no not
    of off on out over some than under until up what when where whether who why without within
    """.split()
)

EXPLAINING = "why"
"""``why_not_solvable`` returns a text that explains: the one leading word of this kind that is allowed."""

EMPTY_BEGINNING = re.compile(r"(?:How|It|Likewise|Of|That of|The others?|The same|Those|What|Where|Whether|Which)\b")
"""First words of a docstring whose sentence has no subject of its own."""


class NameCheck(NamedTuple):
    """A name or a docstring of the code, and the rule that it breaks ("" where it breaks none)."""

    kind: str
    path: Path
    line: int
    name: str
    fault: str


def is_participle(word: str) -> bool:
    return word in IRREGULAR_PARTICIPLES or (
        word.endswith("ed") and len(word) > 3 and word not in PARTICIPLE_LOOKALIKES
    )


def words_of(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+", name.strip("_"))]


def fault_of_name(name: str) -> str:
    """Return the rule that a name breaks, or ""."""
    words = words_of(name)
    if not words:
        return ""
    if len(words) == 1:
        return "participle" if is_participle(words[0]) else "ordinary word" if words[0] in ORDINARY_WORDS else ""
    if words[0] == EXPLAINING:
        return ""
    if words[0] in LEADING_PREPOSITIONS:
        return "leading preposition"
    if all(word in ORDINARY_WORDS | LEADING_PREPOSITIONS or is_participle(word) for word in words):
        return "no noun and no verb"
    return ""


def fault_of_docstring(text: str) -> str:
    """Return the rule that the first sentence of a docstring breaks, or ""."""
    return "no subject" if EMPTY_BEGINNING.match(text.strip()) else ""


def names_in(path: Path) -> Iterator[NameCheck]:
    """Yield the constants, definitions, locals and docstrings of a module."""
    tree = ast.parse(path.read_text())
    if text := ast.get_docstring(tree):
        yield NameCheck("docstring", path, 1, path.stem, fault_of_docstring(text))
    for node, following in zip(tree.body, [*tree.body, None][1:], strict=False):
        yield from _constants(path, node, following)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if not node.name.startswith("__"):
                yield NameCheck("definition", path, node.lineno, node.name, fault_of_name(node.name))
            if text := ast.get_docstring(node):
                yield NameCheck("docstring", path, node.lineno, node.name, fault_of_docstring(text))
        if isinstance(node, ast.FunctionDef):
            names = {a.arg for a in ast.walk(node) if isinstance(a, ast.arg)}
            names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
            for name in sorted(names):
                yield NameCheck("local", path, node.lineno, name, fault_of_name(name))


def _constants(path: Path, node: ast.stmt, following: ast.stmt | None) -> Iterator[NameCheck]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    for target in targets:
        elements = target.elts if isinstance(target, ast.Tuple) else [target]
        constants = [e for e in elements if isinstance(e, ast.Name) and e.id.isupper()]
        for constant in constants:
            fault = "several constants in one statement" if len(constants) > 1 else fault_of_name(constant.id)
            yield NameCheck("constant", path, node.lineno, constant.id, fault)
    text = getattr(getattr(following, "value", None), "value", None)
    if targets and isinstance(text, str) and isinstance(targets[0], ast.Name):
        yield NameCheck("docstring", path, node.lineno, targets[0].id, fault_of_docstring(text))
