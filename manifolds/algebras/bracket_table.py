"""Structure constants from a table of brackets between named basis elements, and the table that a notebook shows."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from numbers import Rational, Real

import numpy as np

from .._arguments import checked_names
from .._tables import html_grid
from ..errors import AntisymmetryError, ComponentError, ParameterError

Combination = dict[str, Fraction | float]
"""A linear combination of basis elements: the coefficient of each name."""


def constants_and_names(brackets: Mapping, basis: Iterable[str] | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the structure constants of a table of brackets, and the names of the basis elements.

    The parameters and errors are those of :meth:`manifolds.LieAlgebra.from_brackets`.
    """
    table = _checked_table(brackets)
    names = _basis_names(table) if basis is None else tuple(basis)
    names = checked_names(names, len(names))
    index = {name: position for position, name in enumerate(names)}
    for pair, combination in table.items():
        for name in (*pair, *combination):
            if name not in index:
                raise ParameterError(
                    f"the bracket of {pair} has the element {name!r}, which is not in basis={names!r}. Add it to basis="
                )
    constants = np.full((len(names),) * 3, Fraction(0), dtype=object)
    for (name_a, name_b), combination in table.items():
        for name, coefficient in combination.items():
            constants[index[name_a], index[name_b], index[name]] = coefficient
            constants[index[name_b], index[name_a], index[name]] = -coefficient
    return constants, names


def _checked_table(brackets: Mapping) -> dict[tuple[str, str], Combination]:
    """Return the brackets as combinations, after checking that no two entries contradict each other."""
    if not isinstance(brackets, Mapping):
        raise ParameterError(
            "brackets must be a dictionary such as {('e1', 'e2'): 'e3'}, not an object of the type "
            f"{type(brackets).__name__}"
        )
    table: dict[tuple[str, str], Combination] = {}
    for pair, value in brackets.items():
        if not isinstance(pair, tuple) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise ParameterError(f"a bracket needs a pair of names such as ('e1', 'e2'), got {pair!r}")
        name_a, name_b = pair
        combination = _parse_combination(value, pair)
        if name_a == name_b and combination:
            raise AntisymmetryError(f"[{name_a}, {name_a}] must be zero, got {value!r}. Remove this entry")
        opposite = table.get((name_b, name_a))
        if name_a != name_b and opposite is not None and opposite != {n: -c for n, c in combination.items()}:
            raise AntisymmetryError(
                f"[{name_b}, {name_a}] = {brackets[name_b, name_a]!r} contradicts [{name_a}, {name_b}] = {value!r}: "
                "one must be minus the other. Give one of the two only"
            )
        if opposite is None:
            table[pair] = combination
    return table


def _parse_combination(value, pair: tuple[str, str]) -> Combination:
    """Return the coefficients, by name, of a bracket that is given as a name, a dictionary or 0; zeros are dropped."""
    if isinstance(value, str):
        if not value.removeprefix("-").strip().isidentifier():
            raise ComponentError(
                f"the bracket of {pair} must be one name such as 'e3' or '-e3', got {value!r}; a combination is a "
                "dictionary such as {'e3': 2, 'e4': 1}"
            )
        return {value.removeprefix("-").strip(): Fraction(-1 if value.startswith("-") else 1)}
    if isinstance(value, Real) and value == 0:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ComponentError(
            f"the bracket of {pair} must be a name such as 'e3', a dictionary such as {{'e3': 2}}, or 0, got {value!r}"
        )
    for name, coefficient in value.items():
        if isinstance(coefficient, bool) or not isinstance(coefficient, Real) or not np.isfinite(float(coefficient)):
            raise ComponentError(
                f"the coefficient of {name!r} in the bracket of {pair} must be a finite real number, got "
                f"{coefficient!r}"
            )
    return {name: Fraction(c) if isinstance(c, Rational) else float(c) for name, c in value.items() if c != 0}


def _basis_names(table: Mapping[tuple[str, str], Combination]) -> list[str]:
    """Return all names of a table: by their numbers if all are one letter string with a number, else as they come."""
    names = list(dict.fromkeys(name for pair, combination in table.items() for name in (*pair, *combination)))
    if not names:
        raise ParameterError("brackets has no elements. Give basis=('e1', 'e2', …) for an abelian algebra")
    numbered_names = [re.fullmatch(r"(.*?)(\d+)", name) for name in names]
    matches = [match for match in numbered_names if match is not None]
    if len(matches) == len(names) and len({match[1] for match in matches}) == 1:
        return [match[0] for match in sorted(matches, key=lambda match: int(match[2]))]
    return names


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
            (f"[{names[a[i]]}, {names[b[i]]}]", _combination_text(brackets[i], names))
            for i in nonzero_pairs[:MAX_LISTED_BRACKETS]
        ]
        if len(nonzero_pairs) > MAX_LISTED_BRACKETS:
            rows.append((f"and {len(nonzero_pairs) - MAX_LISTED_BRACKETS} more", ""))
    return html_grid((f"Lie algebra {name}", ""), rows)


def _combination_text(components: np.ndarray, names: tuple[str, ...]) -> str:
    terms = [f"{c:g} {name}" for c, name in zip(components, names, strict=True) if c]
    text = " + ".join(terms).replace("+ -", "- ")
    return text.replace("-1 ", "-").replace("1 ", "") if all(abs(c) in (0.0, 1.0) for c in components) else text
