"""Display of a Lie algebra in a notebook."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._tables import html_grid

MAX_LISTED_DIM = 12
"""Largest dimension in which brackets are listed."""

MAX_LISTED_BRACKETS = 12
"""Largest number of brackets in a list."""


def algebra_html(
    name: str, dim: int, structure_constants: Callable[[], np.ndarray], basis_names: tuple[str, ...] | None
) -> str:
    """Return an HTML table of the name, the dimension and, for a small algebra, the nonzero brackets."""
    names = basis_names or tuple(f"e{a + 1}" for a in range(dim))
    rows = [("dimension", str(dim))]
    if dim <= MAX_LISTED_DIM:
        a, b = np.triu_indices(dim, 1)
        brackets = structure_constants()[a, b]
        nonzero_pairs = np.flatnonzero(brackets.any(axis=-1))
        rows += [
            (f"[{names[a[i]]}, {names[b[i]]}]", _combination(brackets[i], names))
            for i in nonzero_pairs[:MAX_LISTED_BRACKETS]
        ]
        if len(nonzero_pairs) > MAX_LISTED_BRACKETS:
            rows.append((f"and {len(nonzero_pairs) - MAX_LISTED_BRACKETS} more", ""))
    return html_grid((f"Lie algebra {name}", ""), rows)


def _combination(components: np.ndarray, names: tuple[str, ...]) -> str:
    terms = [f"{c:g} {name}" for c, name in zip(components, names, strict=True) if c]
    text = " + ".join(terms).replace("+ -", "- ")
    return text.replace("-1 ", "-").replace("1 ", "") if all(abs(c) in (0.0, 1.0) for c in components) else text
