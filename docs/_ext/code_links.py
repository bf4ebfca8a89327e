"""A Sphinx extension: a public name in code font links to its reference; one that does not exist is a warning."""

from __future__ import annotations

import builtins
import inspect
import re
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util import logging

import liethermo
import manifolds

logger = logging.getLogger(__name__)

PREFIXES = {"lt": liethermo, "liethermo": liethermo, "mf": manifolds, "manifolds": manifolds}
NAME = re.compile(r"(?:(lt|mf|liethermo|manifolds)\.)?([A-Za-z_][\w.]*?)(\(.*\))?")
MIN_LENGTH_WITHOUT_PREFIX = 2
"""Shorter words without prefix and parentheses are symbols: `u` is a tangent vector, and `mf.u(n)` an algebra."""


def resolve(text: str) -> str | None:
    """The full name of the public object that a word in code font means; None where it means none.

    Raises
    ------
    AttributeError
        If the word begins with ``lt.`` or ``mf.``, and the package has no such name.
    """
    match = NAME.fullmatch(text)
    if match is None:
        return None
    prefix, rest, call = match.groups()
    if not prefix and not call and len(rest) < MIN_LENGTH_WITHOUT_PREFIX:
        return None
    for package in [PREFIXES[prefix]] if prefix else (liethermo, manifolds):
        if prefix or (rest.partition(".")[0] in package.__all__ and not hasattr(builtins, rest)):
            found: Any = package
            for part in rest.split("."):
                found = getattr(found, part)
            if not prefix and inspect.ismodule(found):  # `learn` is an extra too
                return None
            return f"{package.__name__}.{rest}"
    return None


class Links(SphinxPostTransform):
    """Makes links of the literals that name public objects."""

    default_priority = 5

    def run(self, **kwargs: Any) -> None:
        domain = self.env.get_domain("py")
        for literal in list(self.document.findall(nodes.literal)):
            parent = literal.parent
            if isinstance(parent, (nodes.reference, addnodes.pending_xref)) or literal.get("classes", []) == ["xref"]:
                continue
            try:
                name = resolve(literal.astext())
            except AttributeError as error:
                logger.warning("%r is in code font, but %s", literal.astext(), error, location=literal)
                continue
            if name is None or name not in domain.objects:
                continue
            entry = domain.objects[name]
            if entry.docname == self.env.docname:
                continue
            uri = self.app.builder.get_relative_uri(self.env.docname, entry.docname) + "#" + entry.node_id
            literal.replace_self(nodes.reference("", "", literal.deepcopy(), internal=True, refuri=uri))


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_post_transform(Links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
