"""Real indecomposable Lie algebras of dimension 1 to 5, with the invariants of their coadjoint actions.

The list is that of Mubarakzyanov (1963), in the notation and with the invariants of Patera, Sharp, Winternitz and
Zassenhaus, J. Math. Phys. 17, 986 (1976), tables I and II. Where the published invariant has several values, such as
one with an angle in it, a function of it that has one value stands here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from ..errors import ParameterError
from .lie_algebra import LieAlgebra
from .polynomial import Formula, fill_in_parameters, small_integer_ratio

Brackets = Mapping[tuple[int, int], Mapping[int, float]]
Parameters = dict[str, float]


class CatalogueEntry(NamedTuple):
    """An algebra of the list, perhaps with parameters.

    Attributes
    ----------
    brackets : callable
        Parameters by name to the brackets ``{(i, j): {k: coefficient}}``, counted from 1.
    invariants : callable
        Parameters to the templates of formulas, and of numbers in them.
    parameters : tuple of str
    condition : callable
        Parameters to True where they are allowed.
    condition_text : str
    """

    brackets: Callable[..., Brackets]
    invariants: Callable[..., tuple[str, ...]]
    parameters: tuple[str, ...] = ()
    condition: Callable[..., bool] = lambda: True
    condition_text: str = ""


def patera(name: str, **parameters: float) -> LieAlgebra:
    """Return a real indecomposable Lie algebra of dimension up to 5 from the list of Patera et al. (1976).

    The algebra has named elements e1, …, e5 and carries its invariants, as many as there are, which methods keep and
    audits follow.

    Parameters
    ----------
    name : str
        Such as ``"A3,1"``, from A1, A2, A3,1 … A3,9, A4,1 … A4,12 and A5,1 … A5,40.
    **parameters : float
        The parameters of a family, ``a``, ``b``, ``c``, ``p``, ``q``, ``s`` or ``eps``, as in the list.

    Returns
    -------
    LieAlgebra

    Raises
    ------
    ParameterError
        If the name is not in the list, or the parameters are not those of the family or not in their ranges.

    Notes
    -----
    A5,17 with p = q = 0 and an irrational s has two invariants that are functions; orbits wind densely around the
    level sets of these two, and the third invariant exists locally only.

    Examples
    --------
    >>> g = mf.patera("A3,5", a=0.5)
    >>> print(*g.invariants)
    e2*abs(e1)**(-0.5)
    """
    if name not in CATALOGUE:
        raise ParameterError(f"name must be one of {', '.join(CATALOGUE)}, got {name!r}")
    entry = CATALOGUE[name]
    if set(parameters) != set(entry.parameters):
        example = ", ".join(f"{p}=…" for p in entry.parameters)
        raise ParameterError(
            f"{name} has {'the parameters ' + ', '.join(entry.parameters) if entry.parameters else 'no parameters'}, "
            f"got {', '.join(parameters) or 'none'}. Write patera({name!r}{', ' + example if example else ''})"
        )
    for parameter, value in parameters.items():
        if not math.isfinite(value):
            raise ParameterError(f"the parameter {parameter} of {name} must be finite, got {value}")
    if not entry.condition(**parameters):
        values = ", ".join(f"{p}={parameters[p]:g}" for p in entry.parameters)
        raise ParameterError(f"{name} needs {entry.condition_text}, got {values}")
    dim = 1 if name == "A1" else int(name[1])
    names = tuple(f"e{i + 1}" for i in range(dim))
    table = {
        (f"e{i}", f"e{j}"): {f"e{k}": coefficient for k, coefficient in combination.items()}
        for (i, j), combination in entry.brackets(**parameters).items()
    }
    numbers = {p: float(v) for p, v in parameters.items()}
    formulas = [Formula(fill_in_parameters(text, numbers), names) for text in entry.invariants(**parameters)]
    label = name + (f"({', '.join(f'{p}={parameters[p]:g}' for p in entry.parameters)})" if parameters else "")
    return LieAlgebra.from_brackets(table, name=label, basis=names)._with_unchecked_invariants(formulas)


def _brackets_with_ideal(**images: Mapping[int, float]) -> dict[tuple[int, int], Mapping[int, float]]:
    """Return the brackets ``[e_i, e_n]`` of one element with an ideal; the keywords are ``e1_5={2: …}``."""
    return {(int(key[1]), int(key[3])): image for key, image in images.items()}


def _parameter_free_formulas(*texts: str) -> Callable[..., tuple[str, ...]]:
    """Return a function that returns these formulas for all parameters."""
    return lambda **parameters: texts


def _parameter_free_brackets(brackets: Brackets) -> Callable[..., Brackets]:
    """Return a function without parameters that returns these brackets."""
    return lambda: brackets


def _invariants_of_two_rotations(p: float, q: float, s: float) -> tuple[str, ...]:
    """Return the invariants of A5,17: the angle or the radius of one plane is the time of the other."""
    if p:
        time = "log(e1**2+e2**2)/(2*{p})"
        return (
            f"(e1*cos({time})+e2*sin({time}))/sqrt(e1**2+e2**2)",
            "(e3**2+e4**2)*(e1**2+e2**2)**(-{q}/{p})",
            f"(e3*cos({{s}}*{time})+e4*sin({{s}}*{time}))*(e1**2+e2**2)**(-{{q}}/(2*{{p}}))",
        )
    if q:
        time = "log(e3**2+e4**2)/(2*{q})"
        return (
            "e1**2+e2**2",
            f"e1*cos({time})+e2*sin({time})",
            f"(e3*cos({{s}}*{time})+e4*sin({{s}}*{time}))/sqrt(e3**2+e4**2)",
        )
    ratio = small_integer_ratio(s)
    circles = ("e1**2+e2**2", "e3**2+e4**2")
    if ratio is None:
        return circles
    return (*circles, f"cos({ratio[0]}*atan2(e2,e1)-{ratio[1]}*atan2(e4,e3))")


def _invariant_of_dilation_and_rotation(a: float, b: float) -> tuple[str, ...]:
    """Return the invariant of A5,35: ``e1 r**-b exp(-a angle)``, or a function of it with one value."""
    if not a:
        return ("e1*(e2**2+e3**2)**(-{b}/2)",)
    angle = "(log(abs(e1))-{b}*log(e2**2+e3**2)/2)/{a}"
    return (f"(e2*cos({angle})+e3*sin({angle}))/sqrt(e2**2+e3**2)",)


_HEISENBERG: dict[tuple[int, int], Mapping[int, float]] = {(2, 3): {1: 1}}
_ENGEL: dict[tuple[int, int], Mapping[int, float]] = {(2, 4): {1: 1}, (3, 4): {2: 1}}
_CHAIN_2 = "(e2**2-2*e1*e3)"
_CHAIN_3 = "(e2**3+3*e1**2*e4-3*e1*e2*e3)"
_SPIRAL = "log(e1**2+e2**2)/(2*{a})"
_LOG_TURN = "log(abs(e1))"
_TURN_18 = "((e1*e3+e2*e4)/(e1**2+e2**2))"

CATALOGUE: dict[str, CatalogueEntry] = {
    "A1": CatalogueEntry(_parameter_free_brackets({}), _parameter_free_formulas("e1")),
    "A2": CatalogueEntry(_parameter_free_brackets({(1, 2): {1: 1}}), _parameter_free_formulas()),
    "A3,1": CatalogueEntry(_parameter_free_brackets(_HEISENBERG), _parameter_free_formulas("e1")),
    "A3,2": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_3={1: 1}, e2_3={1: 1, 2: 1})),
        _parameter_free_formulas("e1*exp(-e2/e1)"),
    ),
    "A3,3": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_3={1: 1}, e2_3={2: 1})),
        _parameter_free_formulas("e2/e1"),
    ),
    "A3,4": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_3={1: 1}, e2_3={2: -1})),
        _parameter_free_formulas("e1*e2"),
    ),
    "A3,5": CatalogueEntry(
        lambda a: _brackets_with_ideal(e1_3={1: 1}, e2_3={2: a}),
        _parameter_free_formulas("e2*abs(e1)**(-{a})"),
        ("a",),
        lambda a: 0 < abs(a) < 1,
        "0 < |a| < 1",
    ),
    "A3,6": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_3={2: -1}, e2_3={1: 1})),
        _parameter_free_formulas("e1**2+e2**2"),
    ),
    "A3,7": CatalogueEntry(
        lambda a: _brackets_with_ideal(e1_3={1: a, 2: -1}, e2_3={1: 1, 2: a}),
        _parameter_free_formulas(f"(e1*cos({_SPIRAL})+e2*sin({_SPIRAL}))/sqrt(e1**2+e2**2)"),
        ("a",),
        lambda a: a > 0,
        "a > 0",
    ),
    "A3,8": CatalogueEntry(
        _parameter_free_brackets({(1, 3): {2: -2}, (1, 2): {1: 1}, (2, 3): {3: 1}}),
        _parameter_free_formulas("e2**2+e1*e3"),
    ),
    "A3,9": CatalogueEntry(
        _parameter_free_brackets({(1, 2): {3: 1}, (2, 3): {1: 1}, (3, 1): {2: 1}}),
        _parameter_free_formulas("e1**2+e2**2+e3**2"),
    ),
    "A4,1": CatalogueEntry(_parameter_free_brackets(_ENGEL), _parameter_free_formulas("e1", "e2**2-2*e1*e3")),
    "A4,2": CatalogueEntry(
        lambda a: _brackets_with_ideal(e1_4={1: a}, e2_4={2: 1}, e3_4={2: 1, 3: 1}),
        _parameter_free_formulas("e1*exp(-{a}*e3/e2)", "e2*exp(-e3/e2)"),
        ("a",),
        lambda a: a != 0,
        "a != 0",
    ),
    "A4,3": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_4={1: 1}, e3_4={2: 1})),
        _parameter_free_formulas("e2", "e1*exp(-e3/e2)"),
    ),
    "A4,4": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e1_4={1: 1}, e2_4={1: 1, 2: 1}, e3_4={2: 1, 3: 1})),
        _parameter_free_formulas("e1*exp(-e2/e1)", f"{_CHAIN_2}/e1**2"),
    ),
    "A4,5": CatalogueEntry(
        lambda a, b: _brackets_with_ideal(e1_4={1: 1}, e2_4={2: a}, e3_4={3: b}),
        _parameter_free_formulas("e2*abs(e1)**(-{a})", "e3*abs(e1)**(-{b})"),
        ("a", "b"),
        lambda a, b: a * b != 0 and -1 <= a <= 1 and -1 <= b <= 1,
        "a b != 0, |a| <= 1, |b| <= 1",
    ),
    "A4,6": CatalogueEntry(
        lambda a, b: _brackets_with_ideal(e1_4={1: a}, e2_4={2: b, 3: -1}, e3_4={2: 1, 3: b}),
        _parameter_free_formulas(
            "(e2**2+e3**2)*abs(e1)**(-2*{b}/{a})",
            f"(e2*cos({_LOG_TURN}/{{a}})+e3*sin({_LOG_TURN}/{{a}}))*abs(e1)**(-{{b}}/{{a}})",
        ),
        ("a", "b"),
        lambda a, b: a != 0 and b >= 0,
        "a != 0, b >= 0",
    ),
    "A4,7": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | _brackets_with_ideal(e1_4={1: 2}, e2_4={2: 1}, e3_4={2: 1, 3: 1})),
        _parameter_free_formulas(),
    ),
    "A4,8": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | _brackets_with_ideal(e2_4={2: 1}, e3_4={3: -1})),
        _parameter_free_formulas("e1", "e2*e3-e1*e4"),
    ),
    "A4,9": CatalogueEntry(
        lambda b: _HEISENBERG | _brackets_with_ideal(e1_4={1: 1 + b}, e2_4={2: 1}, e3_4={3: b}),
        _parameter_free_formulas(),
        ("b",),
        lambda b: -1 < b <= 1,
        "-1 < b <= 1",
    ),
    "A4,10": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | _brackets_with_ideal(e2_4={3: -1}, e3_4={2: 1})),
        _parameter_free_formulas("e1", "2*e1*e4+e2**2+e3**2"),
    ),
    "A4,11": CatalogueEntry(
        lambda a: _HEISENBERG | _brackets_with_ideal(e1_4={1: 2 * a}, e2_4={2: a, 3: -1}, e3_4={2: 1, 3: a}),
        _parameter_free_formulas(),
        ("a",),
        lambda a: a > 0,
        "a > 0",
    ),
    "A4,12": CatalogueEntry(
        _parameter_free_brackets({(1, 3): {1: 1}, (2, 3): {2: 1}, (1, 4): {2: -1}, (2, 4): {1: 1}}),
        _parameter_free_formulas(),
    ),
    "A5,1": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e3_5={1: 1}, e4_5={2: 1})),
        _parameter_free_formulas("e1", "e2", "e2*e3-e1*e4"),
    ),
    "A5,2": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e2_5={1: 1}, e3_5={2: 1}, e4_5={3: 1})),
        _parameter_free_formulas("e1", "e2**2-2*e1*e3", _CHAIN_3),
    ),
    "A5,3": CatalogueEntry(
        _parameter_free_brackets({(3, 4): {2: 1}, (3, 5): {1: 1}, (4, 5): {3: 1}}),
        _parameter_free_formulas("e1", "e2", "e3**2+2*e2*e5-2*e1*e4"),
    ),
    "A5,4": CatalogueEntry(_parameter_free_brackets({(2, 4): {1: 1}, (3, 5): {1: 1}}), _parameter_free_formulas("e1")),
    "A5,5": CatalogueEntry(
        _parameter_free_brackets({(3, 4): {1: 1}, (2, 5): {1: 1}, (3, 5): {2: 1}}), _parameter_free_formulas("e1")
    ),
    "A5,6": CatalogueEntry(
        _parameter_free_brackets({(3, 4): {1: 1}, (2, 5): {1: 1}, (3, 5): {2: 1}, (4, 5): {3: 1}}),
        _parameter_free_formulas("e1"),
    ),
    "A5,7": CatalogueEntry(
        lambda a, b, c: _brackets_with_ideal(e1_5={1: 1}, e2_5={2: a}, e3_5={3: b}, e4_5={4: c}),
        _parameter_free_formulas("e2*abs(e1)**(-{a})", "e3*abs(e1)**(-{b})", "e4*abs(e1)**(-{c})"),
        ("a", "b", "c"),
        lambda a, b, c: a * b * c != 0 and max(abs(a), abs(b), abs(c)) <= 1,
        "a b c != 0, |a|, |b|, |c| <= 1",
    ),
    "A5,8": CatalogueEntry(
        lambda c: _brackets_with_ideal(e2_5={1: 1}, e3_5={3: 1}, e4_5={4: c}),
        _parameter_free_formulas("e1", "e3*exp(-e2/e1)", "e4*exp(-{c}*e2/e1)"),
        ("c",),
        lambda c: 0 < abs(c) <= 1,
        "0 < |c| <= 1",
    ),
    "A5,9": CatalogueEntry(
        lambda b, c: _brackets_with_ideal(e1_5={1: 1}, e2_5={1: 1, 2: 1}, e3_5={3: b}, e4_5={4: c}),
        _parameter_free_formulas("e1*exp(-e2/e1)", "e3*exp(-{b}*e2/e1)", "e4*exp(-{c}*e2/e1)"),
        ("b", "c"),
        lambda b, c: b * c != 0,
        "b c != 0",
    ),
    "A5,10": CatalogueEntry(
        _parameter_free_brackets(_brackets_with_ideal(e2_5={1: 1}, e3_5={2: 1}, e4_5={4: 1})),
        _parameter_free_formulas("e1", "e2**2-2*e1*e3", "e4*exp(-e2/e1)"),
    ),
    "A5,11": CatalogueEntry(
        lambda c: _brackets_with_ideal(e1_5={1: 1}, e2_5={1: 1, 2: 1}, e3_5={2: 1, 3: 1}, e4_5={4: c}),
        _parameter_free_formulas("e1*exp(-e2/e1)", f"{_CHAIN_2}/e1**2", "e4*exp(-{c}*e2/e1)"),
        ("c",),
        lambda c: c != 0,
        "c != 0",
    ),
    "A5,12": CatalogueEntry(
        _parameter_free_brackets(
            _brackets_with_ideal(e1_5={1: 1}, e2_5={1: 1, 2: 1}, e3_5={2: 1, 3: 1}, e4_5={3: 1, 4: 1})
        ),
        _parameter_free_formulas("e1*exp(-e2/e1)", f"{_CHAIN_2}/e1**2", f"{_CHAIN_3}/e1**3"),
    ),
    "A5,13": CatalogueEntry(
        lambda a, p, s: _brackets_with_ideal(e1_5={1: 1}, e2_5={2: a}, e3_5={3: p, 4: -s}, e4_5={3: s, 4: p}),
        _parameter_free_formulas(
            "e2*abs(e1)**(-{a})",
            "(e3**2+e4**2)*abs(e1)**(-2*{p})",
            f"(e3*cos({{s}}*{_LOG_TURN})+e4*sin({{s}}*{_LOG_TURN}))*abs(e1)**(-{{p}})",
        ),
        ("a", "p", "s"),
        lambda a, p, s: a * s != 0 and abs(a) <= 1,
        "a s != 0, |a| <= 1",
    ),
    "A5,14": CatalogueEntry(
        lambda p: _brackets_with_ideal(e2_5={1: 1}, e3_5={3: p, 4: -1}, e4_5={3: 1, 4: p}),
        _parameter_free_formulas(
            "e1",
            "(e3**2+e4**2)*exp(-2*{p}*e2/e1)",
            "(e3*cos(e2/e1)+e4*sin(e2/e1))*exp(-{p}*e2/e1)",
        ),
        ("p",),
    ),
    "A5,15": CatalogueEntry(
        lambda a: _brackets_with_ideal(e1_5={1: 1}, e2_5={1: 1, 2: 1}, e3_5={3: a}, e4_5={3: 1, 4: a}),
        _parameter_free_formulas("e1*exp(-e2/e1)", "e3*exp(-{a}*e2/e1)", "e4/e3-e2/e1"),
        ("a",),
        lambda a: abs(a) <= 1,
        "|a| <= 1",
    ),
    "A5,16": CatalogueEntry(
        lambda p, s: _brackets_with_ideal(e1_5={1: 1}, e2_5={1: 1, 2: 1}, e3_5={3: p, 4: -s}, e4_5={3: s, 4: p}),
        _parameter_free_formulas(
            "e1*exp(-e2/e1)",
            "(e3**2+e4**2)*exp(-2*{p}*e2/e1)",
            "(e3*cos({s}*e2/e1)+e4*sin({s}*e2/e1))*exp(-{p}*e2/e1)",
        ),
        ("p", "s"),
        lambda p, s: s != 0,
        "s != 0",
    ),
    "A5,17": CatalogueEntry(
        lambda p, q, s: _brackets_with_ideal(
            e1_5={1: p, 2: -1}, e2_5={1: 1, 2: p}, e3_5={3: q, 4: -s}, e4_5={3: s, 4: q}
        ),
        _invariants_of_two_rotations,
        ("p", "q", "s"),
        lambda p, q, s: s != 0,
        "s != 0",
    ),
    "A5,18": CatalogueEntry(
        lambda p: _brackets_with_ideal(
            e1_5={1: p, 2: -1}, e2_5={1: 1, 2: p}, e3_5={1: 1, 3: p, 4: -1}, e4_5={2: 1, 3: 1, 4: p}
        ),
        _parameter_free_formulas(
            "(e1*e4-e2*e3)/(e1**2+e2**2)",
            f"(e1**2+e2**2)*exp(-2*{{p}}*{_TURN_18})",
            f"(e1*cos({_TURN_18})+e2*sin({_TURN_18}))*exp(-{{p}}*{_TURN_18})",
        ),
        ("p",),
        lambda p: p >= 0,
        "p >= 0",
    ),
    "A5,19": CatalogueEntry(
        lambda a, b: _HEISENBERG | _brackets_with_ideal(e1_5={1: a}, e2_5={2: 1}, e3_5={3: a - 1}, e4_5={4: b}),
        _parameter_free_formulas("abs(e1)**{b}*abs(e4)**(-{a})"),
        ("a", "b"),
        lambda a, b: b != 0,
        "b != 0",
    ),
    "A5,20": CatalogueEntry(
        lambda a: _HEISENBERG | _brackets_with_ideal(e1_5={1: a}, e2_5={2: 1}, e3_5={3: a - 1}, e4_5={1: 1, 4: a}),
        _parameter_free_formulas("e1*exp(-{a}*e4/e1)"),
        ("a",),
    ),
    "A5,21": CatalogueEntry(
        _parameter_free_brackets(
            _HEISENBERG | _brackets_with_ideal(e1_5={1: 2}, e2_5={2: 1, 3: 1}, e3_5={3: 1, 4: 1}, e4_5={4: 1})
        ),
        _parameter_free_formulas("e4**2/e1"),
    ),
    "A5,22": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | _brackets_with_ideal(e2_5={3: 1}, e4_5={4: 1})),
        _parameter_free_formulas("e1"),
    ),
    "A5,23": CatalogueEntry(
        lambda b: _HEISENBERG | _brackets_with_ideal(e1_5={1: 2}, e2_5={2: 1, 3: 1}, e3_5={3: 1}, e4_5={4: b}),
        _parameter_free_formulas("e4**2*abs(e1)**(-{b})"),
        ("b",),
        lambda b: b != 0,
        "b != 0",
    ),
    "A5,24": CatalogueEntry(
        lambda eps: (
            _HEISENBERG | _brackets_with_ideal(e1_5={1: 2}, e2_5={2: 1, 3: 1}, e3_5={3: 1}, e4_5={1: eps, 4: 2})
        ),
        _parameter_free_formulas("e1*exp(-2*{eps}*e4/e1)"),
        ("eps",),
        lambda eps: abs(eps) == 1,
        "eps = 1 or -1",
    ),
    "A5,25": CatalogueEntry(
        lambda b, p: (
            _HEISENBERG | _brackets_with_ideal(e1_5={1: 2 * p}, e2_5={2: p, 3: 1}, e3_5={2: -1, 3: p}, e4_5={4: b})
        ),
        _parameter_free_formulas("abs(e1)**{b}*abs(e4)**(-2*{p})"),
        ("b", "p"),
        lambda b, p: b != 0,
        "b != 0",
    ),
    "A5,26": CatalogueEntry(
        lambda p, eps: (
            _HEISENBERG
            | _brackets_with_ideal(e1_5={1: 2 * p}, e2_5={2: p, 3: 1}, e3_5={2: -1, 3: p}, e4_5={1: eps, 4: 2 * p})
        ),
        _parameter_free_formulas("e1*exp(-2*{p}*{eps}*e4/e1)"),
        ("p", "eps"),
        lambda p, eps: abs(eps) == 1,
        "eps = 1 or -1",
    ),
    "A5,27": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | _brackets_with_ideal(e1_5={1: 1}, e3_5={3: 1, 4: 1}, e4_5={1: 1, 4: 1})),
        _parameter_free_formulas("e1*exp(-e4/e1)"),
    ),
    "A5,28": CatalogueEntry(
        lambda a: _HEISENBERG | _brackets_with_ideal(e1_5={1: a}, e2_5={2: a - 1}, e3_5={3: 1, 4: 1}, e4_5={4: 1}),
        _parameter_free_formulas("e1*abs(e4)**(-{a})"),
        ("a",),
    ),
    "A5,29": CatalogueEntry(
        _parameter_free_brackets({(2, 4): {1: 1}} | _brackets_with_ideal(e1_5={1: 1}, e2_5={2: 1}, e4_5={3: 1})),
        _parameter_free_formulas("e3"),
    ),
    "A5,30": CatalogueEntry(
        lambda a: _ENGEL | _brackets_with_ideal(e1_5={1: a + 1}, e2_5={2: a}, e3_5={3: a - 1}, e4_5={4: 1}),
        _parameter_free_formulas(f"abs{_CHAIN_2}**({{a}}+1)*abs(e1)**(-2*{{a}})"),
        ("a",),
    ),
    "A5,31": CatalogueEntry(
        _parameter_free_brackets(
            _ENGEL | _brackets_with_ideal(e1_5={1: 3}, e2_5={2: 2}, e3_5={3: 1}, e4_5={3: 1, 4: 1})
        ),
        _parameter_free_formulas(f"{_CHAIN_2}**3/e1**4"),
    ),
    "A5,32": CatalogueEntry(
        lambda a: _ENGEL | _brackets_with_ideal(e1_5={1: 1}, e2_5={2: 1}, e3_5={1: a, 3: 1}),
        _parameter_free_formulas(f"{_CHAIN_2}/e1**2+2*{{a}}*log(abs(e1))"),
        ("a",),
    ),
    "A5,33": CatalogueEntry(
        lambda a, b: {(1, 4): {1: 1}, (3, 4): {3: b}, (2, 5): {2: 1}, (3, 5): {3: a}},
        _parameter_free_formulas("e3*abs(e1)**(-{b})*abs(e2)**(-{a})"),
        ("a", "b"),
        lambda a, b: a != 0 or b != 0,
        "a**2 + b**2 != 0",
    ),
    "A5,34": CatalogueEntry(
        lambda a: {(1, 4): {1: a}, (2, 4): {2: 1}, (3, 4): {3: 1}, (1, 5): {1: 1}, (3, 5): {2: 1}},
        _parameter_free_formulas("e1*abs(e2)**(-{a})*exp(-e3/e2)"),
        ("a",),
    ),
    "A5,35": CatalogueEntry(
        lambda a, b: {
            (1, 4): {1: b},
            (2, 4): {2: 1},
            (3, 4): {3: 1},
            (1, 5): {1: a},
            (2, 5): {3: -1},
            (3, 5): {2: 1},
        },
        _invariant_of_dilation_and_rotation,
        ("a", "b"),
        lambda a, b: a != 0 or b != 0,
        "a**2 + b**2 != 0",
    ),
    "A5,36": CatalogueEntry(
        _parameter_free_brackets(_HEISENBERG | {(1, 4): {1: 1}, (2, 4): {2: 1}, (2, 5): {2: -1}, (3, 5): {3: 1}}),
        _parameter_free_formulas("e5+e2*e3/e1"),
    ),
    "A5,37": CatalogueEntry(
        _parameter_free_brackets(
            _HEISENBERG | {(1, 4): {1: 2}, (2, 4): {2: 1}, (3, 4): {3: 1}, (2, 5): {3: -1}, (3, 5): {2: 1}}
        ),
        _parameter_free_formulas("e5+(e2**2+e3**2)/(2*e1)"),
    ),
    "A5,38": CatalogueEntry(
        _parameter_free_brackets({(1, 4): {1: 1}, (2, 5): {2: 1}, (4, 5): {3: 1}}), _parameter_free_formulas("e3")
    ),
    "A5,39": CatalogueEntry(
        _parameter_free_brackets({(1, 4): {1: 1}, (2, 4): {2: 1}, (1, 5): {2: -1}, (2, 5): {1: 1}, (4, 5): {3: 1}}),
        _parameter_free_formulas("e3"),
    ),
    "A5,40": CatalogueEntry(
        _parameter_free_brackets(
            {
                (1, 2): {1: 2},
                (1, 3): {2: -1},
                (2, 3): {3: 2},
                (1, 4): {5: 1},
                (2, 4): {4: 1},
                (2, 5): {5: -1},
                (3, 5): {4: 1},
            }
        ),
        _parameter_free_formulas("e2*e4*e5-e1*e4**2+e3*e5**2"),
    ),
}
"""Entry of each name."""
for _name in ("A5,14", "A5,20", "A5,28", "A5,30", "A5,32", "A5,34"):  # families with any real parameter
    CATALOGUE[_name] = CATALOGUE[_name]._replace(condition=lambda **parameters: True)
