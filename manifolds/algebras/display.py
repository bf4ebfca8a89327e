"""How a notebook shows a Lie algebra."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._tables import html_grid

MAX_LISTED_DIM, MAX_LISTED_BRACKETS = 12, 12
"""More brackets than these are not listed."""


def algebra_html(
    name: str, dim: int, structure_constants: Callable[[], np.ndarray], basis_names: tuple[str, ...] | None
) -> str:
    """Name, dimension and, of a small algebra, the brackets of its basis elements that do not vanish."""
    names = basis_names or tuple(f"e{a + 1}" for a in range(dim))
    rows = [("dimension", str(dim))]
    if dim <= MAX_LISTED_DIM:
        a, b = np.triu_indices(dim, 1)
        brackets = structure_constants()[a, b]
        found = np.flatnonzero(brackets.any(axis=-1))
        rows += [
            (f"[{names[a[i]]}, {names[b[i]]}]", _combination(brackets[i], names)) for i in found[:MAX_LISTED_BRACKETS]
        ]
        if len(found) > MAX_LISTED_BRACKETS:
            rows.append((f"and {len(found) - MAX_LISTED_BRACKETS} more", ""))
    return html_grid((f"Lie algebra {name}", ""), rows)


def _combination(components: np.ndarray, names: tuple[str, ...]) -> str:
    terms = [f"{c:g} {name}" for c, name in zip(components, names, strict=True) if c]
    text = " + ".join(terms).replace("+ -", "- ")
    return text.replace("-1 ", "-").replace("1 ", "") if all(abs(c) in (0.0, 1.0) for c in components) else text
