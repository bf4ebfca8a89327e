"""Functions on the dual of a Lie algebra that are written as formulas: rational, exponential or logarithmic."""

from __future__ import annotations

import ast
import math
from dataclasses import dataclass
from functools import cached_property
from types import CodeType

import jax
import jax.numpy as jnp

from .._arrays import real_components
from .._names import checked_names
from ..errors import ParameterError

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
            raise ParameterError(f"the formula {self.text!r} cannot be read: {error}; write it as in Python") from None
        for node in ast.walk(tree):
            unknown_name = isinstance(node, ast.Name) and node.id not in {*self.names, *FUNCTIONS}
            if unknown_name or not isinstance(node, _SYNTAX):
                part = ast.unparse(node) if isinstance(node, ast.expr) else type(node).__name__
                raise ParameterError(
                    f"the formula {self.text!r} contains {part!r}; use the names {', '.join(self.names)}, numbers and "
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
        return eval(self._code, {"__builtins__": {}, **FUNCTIONS}, components)

    @cached_property
    def _code(self) -> CodeType:
        return compile(self.text, "<formula>", "eval")

    def __str__(self) -> str:
        return self.text


def fill_in_parameters(template: str, parameters: dict[str, float]) -> str:
    """Return a formula with ``{a}`` replaced by the value of the parameter a, in parentheses if it is negative."""
    numbers = {name: repr(value) if value >= 0 else f"({value!r})" for name, value in parameters.items()}
    return template.format(**numbers)


def is_integer_ratio(value: float, max_denominator: int = 1000) -> tuple[int, int] | None:
    """Return (n, m) with ``value = n/m`` to the last digit and m small, or None."""
    for denominator in range(1, max_denominator + 1):
        numerator = round(value * denominator)
        if math.isclose(numerator / denominator, value, rel_tol=2e-16, abs_tol=0.0):
            return numerator, denominator
    return None
