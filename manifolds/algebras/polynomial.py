"""Functions on the dual of a Lie algebra: polynomials, exact where possible, and formulas; JAX can call both."""

from __future__ import annotations

import ast
import math
from copy import copy
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from numbers import Rational, Real
from types import CodeType

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_names, component_names
from .._arrays import real_components
from .._class_members import ListedType
from ..errors import ComponentError, ParameterError, ShapeError

Coefficient = Fraction | float


@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Polynomial(metaclass=ListedType):
    """Polynomial in the components ``mu1, mu2, …`` of ``mu``.

    Polynomials are immutable and hashable, hence static leaves of a pytree. Sums, differences and products with
    polynomials and numbers are polynomials; coefficients stay exact as long as every number involved is an integer or a
    fraction.

    Parameters
    ----------
    exponents : array of int, shape (terms, dim)
        One row for each monomial; equal rows are added up.
    coefficients : sequence of int, Fraction or float, length terms
        Coefficients of the monomials.

    Attributes
    ----------
    dim : int
    terms : tuple of (exponents, coefficient)
        The nonzero terms, in lexicographic order: ``mu1**2`` before ``mu1*mu2`` before ``mu2**3``.
    names : tuple of str, or None
        What the components are printed as, if not as ``mu1``, ``mu2``, …; see :meth:`with_names`.
    """

    dim: int
    terms: tuple[tuple[tuple[int, ...], Coefficient], ...]
    names: tuple[str, ...] | None = field(compare=False)

    __array_ufunc__ = None  # lets np.float64(2) * polynomial reach __rmul__

    def __init__(self, exponents, coefficients):
        powers = np.asarray(exponents)
        if powers.ndim != 2 or len(powers) != len(coefficients):
            raise ShapeError(
                f"{len(coefficients)} coefficients need exponents of shape ({len(coefficients)}, dim), "
                f"got {powers.shape}"
            )
        if powers.size and (not np.issubdtype(powers.dtype, np.integer) or powers.min() < 0):
            raise ComponentError("the exponents of a polynomial must be integers >= 0")
        terms: dict[tuple[int, ...], Coefficient] = {}
        for power, coefficient in zip(map(tuple, powers.tolist()), coefficients, strict=True):
            terms[power] = terms.get(power, Fraction(0)) + _checked_coefficient(coefficient)
        nonzero = ((power, terms[power]) for power in sorted(terms, reverse=True) if terms[power])
        object.__setattr__(self, "dim", powers.shape[1])
        object.__setattr__(self, "terms", tuple(nonzero))
        object.__setattr__(self, "names", None)

    def with_names(self, *names: str) -> Polynomial:
        """Return an equal polynomial that prints its components with these names."""
        polynomial = copy(self)
        object.__setattr__(polynomial, "names", checked_names(names, self.dim))
        return polynomial

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Coefficients of :attr:`terms`."""
        return tuple(coefficient for _, coefficient in self.terms)

    @cached_property
    def exponents(self) -> np.ndarray:
        """Exponents of :attr:`terms`, shape (terms, dim), read-only."""
        array = np.array([power for power, _ in self.terms], dtype=np.int64).reshape(len(self.terms), self.dim)
        array.setflags(write=False)
        return array

    @property
    def degree(self) -> int:
        """Largest total degree of a term; 0 for a constant, zero included."""
        return max((sum(power) for power, _ in self.terms), default=0)

    def __call__(self, mu) -> jax.Array:
        """Return the value at ``mu``, shape (..., dim) -> (...)."""
        mu = real_components(mu, self.dim, "mu")
        # Products of gathered components: mu**0 would have the derivative 0 * mu**-1, which is NaN at zero.
        mu_and_one = jnp.concatenate([mu, np.ones((*mu.shape[:-1], 1))], axis=-1)
        values = np.ones((*mu.shape[:-1], len(self.terms)))
        for factor in self._factor_indices:  # not by brackets, whose checks of indices XLA would compile
            values = values * jnp.take(mu_and_one, factor, axis=-1, mode="clip")
        return values @ np.array([float(c) for c in self.coefficients])

    @cached_property
    def _factor_indices(self) -> np.ndarray:
        """Components to multiply in each term, shape (degree, terms); the index ``dim`` stands for the number 1."""
        factors = np.full((self.degree, len(self.terms)), self.dim)
        for term, (power, _) in enumerate(self.terms):
            factors[: sum(power), term] = np.repeat(np.arange(self.dim), power)
        return factors

    def gradient(self) -> tuple[Polynomial, ...]:
        """Return the partial derivatives by mu1, mu2, …"""
        return tuple(self._partial_derivative(a) for a in range(self.dim))

    def _partial_derivative(self, component: int) -> Polynomial:
        terms = [
            ((*p[:component], p[component] - 1, *p[component + 1 :]), p[component] * c)
            for p, c in self.terms
            if p[component]
        ]
        return self._with_terms(terms)

    # -- arithmetic -------------------------------------------------------------------------------------------------

    def __add__(self, other) -> Polynomial:
        other = self._to_operand(other)
        return NotImplemented if other is None else self._with_terms(self.terms + other.terms, other.names)

    def __mul__(self, other) -> Polynomial:
        other = self._to_operand(other)
        if other is None:
            return NotImplemented
        return self._with_terms(
            [(tuple(i + j for i, j in zip(p, q, strict=True)), c * d) for p, c in self.terms for q, d in other.terms],
            other.names,
        )

    __radd__ = __add__
    __rmul__ = __mul__

    def __neg__(self) -> Polynomial:
        return self * -1

    def __sub__(self, other) -> Polynomial:
        other = self._to_operand(other)
        return NotImplemented if other is None else self + -other

    def __rsub__(self, other) -> Polynomial:
        return -self + other

    def _to_operand(self, operand) -> Polynomial | None:
        if isinstance(operand, Real):
            return self._with_terms([((0,) * self.dim, operand)])
        if isinstance(operand, Polynomial) and operand.dim != self.dim:
            raise ShapeError(f"polynomials in {self.dim} and in {operand.dim} variables do not combine")
        return operand if isinstance(operand, Polynomial) else None

    def _with_terms(self, terms, names=None) -> Polynomial:
        """Return a polynomial in the same components, with this polynomial's names or else ``names``."""
        powers = np.array([power for power, _ in terms], dtype=np.int64).reshape(len(terms), self.dim)
        polynomial = Polynomial(powers, [coefficient for _, coefficient in terms])
        names = self.names or names
        return polynomial if names is None else polynomial.with_names(*names)

    # -- printing ---------------------------------------------------------------------------------------------------

    def __str__(self) -> str:
        names = component_names(self.names, self.dim)
        text = " + ".join(_term_text(power, coefficient, names) for power, coefficient in self.terms)
        return text.replace("+ -", "- ") or "0"

    def __repr__(self) -> str:
        return f"<Polynomial {self}>"

    def _repr_latex_(self) -> str:
        """Return the polynomial in LaTeX, for a notebook."""
        text = " + ".join(_latex_term_text(power, coefficient, self.names) for power, coefficient in self.terms)
        return f"$\\displaystyle {text.replace('+ -', '- ') or '0'}$"


def _checked_coefficient(value) -> Coefficient:
    """Return a coefficient as a Fraction if it is rational, else as a float; raise ComponentError if it is none."""
    if isinstance(value, Rational):
        return Fraction(int(value.numerator), int(value.denominator))
    if not isinstance(value, Real) or not math.isfinite(value):
        raise ComponentError(f"a coefficient must be a finite real number, got {value!r}")
    return float(value)


def _term_text(exponents: tuple[int, ...], coefficient: Coefficient, names: tuple[str, ...]) -> str:
    """Return a term of a polynomial as text, such as ``2*mu1**2*mu3``."""
    number = str(coefficient) if isinstance(coefficient, Fraction) else f"{coefficient:.15g}"
    factors = [name + (f"**{e}" if e > 1 else "") for name, e in zip(names, exponents, strict=True) if e]
    if factors and number in ("1", "-1"):
        return number[:-1] + "*".join(factors)
    return "*".join([number, *factors])


def _latex_term_text(exponents: tuple[int, ...], coefficient: Coefficient, names: tuple[str, ...] | None) -> str:
    letters = (
        [rf"\mu_{{{i + 1}}}" for i in range(len(exponents))] if names is None else [rf"\mathrm{{{n}}}" for n in names]
    )
    factors = " ".join(
        letter + (f"^{{{e}}}" if e > 1 else "") for letter, e in zip(letters, exponents, strict=True) if e
    )
    if isinstance(coefficient, Fraction):
        numerator, denominator = abs(coefficient.numerator), coefficient.denominator
        number = str(numerator) if denominator == 1 else rf"\tfrac{{{numerator}}}{{{denominator}}}"
    else:
        digits, _, exponent = f"{abs(coefficient):.15g}".partition("e")
        number = digits + (rf" \cdot 10^{{{int(exponent)}}}" if exponent else "")
    sign = "-" if coefficient < 0 else ""
    return sign + (factors if factors and number == "1" else f"{number} {factors}".strip())


FUNCTIONS = {
    "abs": jnp.abs,
    "atan2": jnp.arctan2,
    "cos": jnp.cos,
    "exp": jnp.exp,
    "log": jnp.log,
    "sin": jnp.sin,
    "sqrt": jnp.sqrt,
}
"""Functions that a formula may contain."""

_SYNTAX = (
    ast.Expression,
    ast.BinOp,
    ast.UnaryOp,
    ast.Call,
    ast.Name,
    ast.Constant,
    ast.Load,
    ast.operator,
    ast.unaryop,
)
"""Parts of Python's grammar that a formula may contain."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Formula:
    """Function of mu given by a formula in the names of its components, such as ``"e1*exp(-e2/e1)"``.

    Formulas are immutable and equal when their texts and names are. JAX differentiates them. Where a denominator or a
    logarithm vanishes, the value is not finite.

    Parameters
    ----------
    text : str
        The formula, in Python's notation, with numbers, the names, ``abs``, ``atan2``, ``cos``, ``exp``, ``log``,
        ``sin`` and ``sqrt``.
    names : tuple of str
        The names of the components of mu.

    Raises
    ------
    ParameterError
        If the text contains anything else.

    Examples
    --------
    >>> invariant = mf.Formula("e1 * exp(-e2 / e1)", ("e1", "e2", "e3"))
    >>> print(invariant, float(invariant([2.0, 0.0, 1.0])))
    e1 * exp(-e2 / e1) 2.0
    """

    text: str
    names: tuple[str, ...]

    def __post_init__(self):
        object.__setattr__(self, "names", checked_names(self.names, len(tuple(self.names))))
        try:
            tree = ast.parse(self.text, mode="eval")
        except SyntaxError as error:
            raise ParameterError(f"the formula {self.text!r} cannot be read: {error}. Write it as in Python") from None
        for node in ast.walk(tree):
            unknown_name = isinstance(node, ast.Name) and node.id not in {*self.names, *FUNCTIONS}
            if unknown_name or not isinstance(node, _SYNTAX):
                part = ast.unparse(node) if isinstance(node, ast.expr) else type(node).__name__
                raise ParameterError(
                    f"the formula {self.text!r} contains {part!r}. Use the names {', '.join(self.names)}, numbers and "
                    f"the functions {', '.join(FUNCTIONS)}"
                )

    @property
    def dim(self) -> int:
        """Number of components of mu."""
        return len(self.names)

    def __call__(self, mu) -> jax.Array:
        """Return the value at ``mu``, shape (..., dim) -> (...)."""
        mu = real_components(mu, self.dim, "mu")
        components = {name: mu[..., i] for i, name in enumerate(self.names)}
        return eval(self._compiled_code, {"__builtins__": {}, **FUNCTIONS}, components)

    @cached_property
    def _compiled_code(self) -> CodeType:
        return compile(self.text, "<formula>", "eval")

    def __str__(self) -> str:
        return self.text


def fill_in_parameters(template: str, parameters: dict[str, float]) -> str:
    """Return a formula with ``{a}`` replaced by the value of the parameter a, in parentheses if it is negative."""
    numbers = {name: repr(value) if value >= 0 else f"({value!r})" for name, value in parameters.items()}
    return template.format(**numbers)


MAX_EXPONENT_DENOMINATOR = 1000
"""Largest denominator of an exponent that is written as a ratio of integers."""


def small_integer_ratio(value: float) -> tuple[int, int] | None:
    """Return (n, m) with ``value = n/m`` to the last digit and m small, or None."""
    for denominator in range(1, MAX_EXPONENT_DENOMINATOR + 1):
        numerator = round(value * denominator)
        if math.isclose(numerator / denominator, value, rel_tol=2e-16, abs_tol=0.0):
            return numerator, denominator
    return None
