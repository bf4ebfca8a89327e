"""Systems as SymPy expressions, energies from SymPy, and descriptions of problems for other solvers.

SymPy is optional. The expressions come from the tracer of the compiled engine, so no formula is written twice.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy

import manifolds as mf
from manifolds._arguments import module_dir_function

from .. import disk
from ..errors import InputError
from ..integrators import MetriplecticGauss, Reference
from ..runs.integrate import integrate
from ..systems import System
from ..tracing.program import Program
from ..tracing.scalarize import scalarize

__all__ = ["Expressions", "describe", "expressions", "function", "write"]
__dir__ = module_dir_function(__all__)

PROBLEM_FORMAT = "liethermo-problem-1"
"""Value of ``format`` in the description of a problem."""

MAX_DENOMINATOR = 1000
"""Maximum denominator of the fractions by which floating-point numbers are replaced where the two are equal."""

SYMPY_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "pow": lambda a, b: a**b,
    "sqrt": sympy.sqrt,
    "cbrt": sympy.cbrt,
    "exp2": lambda a: 2**a,
    "expm1": lambda a: sympy.exp(a) - 1,
    "log1p": lambda a: sympy.log(1 + a),
    "abs": sympy.Abs,
    "max": sympy.Max,
    "min": sympy.Min,
    "ceil": sympy.ceiling,
    "atan2": sympy.atan2,
    "select": lambda condition, a, b: sympy.Piecewise((a, condition), (b, True)),
    "branch": lambda condition, number: condition,
    "and": sympy.And,
    "or": sympy.Or,
    "xor": sympy.Xor,
    "not": sympy.Not,
    **{name: getattr(sympy, name) for name in "exp log sin cos tan sinh cosh tanh asin acos atan".split()},
    **{name: getattr(sympy, name) for name in "asinh acosh atanh erf erfc sign floor".split()},
    **{name: getattr(sympy, name.capitalize()) for name in "eq ne lt le gt ge".split()},
}
"""SymPy counterpart of each scalar operation of a traced program."""
JAX_SPECIAL_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(jax.scipy.special, name) for name in "erf erfc gamma polygamma".split()},
    "loggamma": jax.scipy.special.gammaln,
}
"""JAX functions that SymPy's printer would otherwise take from a module that cannot be traced."""


@dataclass(frozen=True)
class Expressions:
    """Energy, entropy, vector field and Casimirs of a system as SymPy expressions.

    Attributes
    ----------
    variables : tuple of Symbol
    energy : Expr
    entropy : Expr or None
    field : tuple of Expr
        The right-hand side of ``x' = ...``.
    casimirs : dict of Expr, by name
    """

    variables: tuple[sympy.Symbol, ...]
    energy: sympy.Expr
    entropy: sympy.Expr | None
    field: tuple[sympy.Expr, ...]
    casimirs: dict[str, sympy.Expr]


def expressions(system: System, names: Sequence[str] | None = None) -> Expressions:
    """Return energy, entropy, vector field and Casimirs of a system as SymPy expressions of its state.

    Numbers equal to a simple fraction become fractions. The laws can then be proved: ``sympy.simplify(sum(dH * f))`` is
    zero.

    Parameters
    ----------
    system : System
        A system whose functions can be traced; if its energy depends on time, use ``system.at_time(t)``.
    names : sequence of str, optional
        Names of the components; by default ``x1``, ``x2``, …, or the basis names of the algebra.

    Raises
    ------
    InputError
        If the energy depends on time, or a function contains an operation without an expression.
    """
    if system.is_driven:
        raise InputError("the energy depends on time. Use system.at_time(t), the system at one time")
    algebra = system.lie_algebra
    basis_names = None if algebra is None else algebra.basis_names
    names = names or basis_names or [f"x{i + 1}" for i in range(system.dim)]
    variables = mf.sympy.symbols(system.dim, names)

    def to_expressions(function: Callable) -> list[sympy.Expr]:
        jaxpr = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((system.dim,), jnp.float64))
        return _expressions_of_program(scalarize(jaxpr), variables)

    return Expressions(
        variables=variables,
        energy=to_expressions(system.energy.value)[0],
        entropy=None if system.entropy is None else to_expressions(system.entropy.value)[0],
        field=tuple(to_expressions(system.vector_field)),
        casimirs={name: to_expressions(casimir.value)[0] for name, casimir in system.casimirs().items()},
    )


def function(expression: Any, variables: Sequence[sympy.Symbol]) -> Callable:
    """Convert a SymPy expression to a function of the state, for the energy or the entropy of a system.

    Parameters
    ----------
    expression : Expr
    variables : sequence of symbols
        The components of the state, in order.

    Returns
    -------
    manifolds.Polynomial if the expression is a polynomial, else a function of one JAX array, shape (n,)

    Raises
    ------
    InputError
        If the expression has other symbols, or a function without a counterpart in JAX.
    """
    expression, variables = sympy.sympify(expression), tuple(variables)
    if unknown_symbols := expression.free_symbols - set(variables):
        raise InputError(
            f"{', '.join(sorted(map(str, unknown_symbols)))} in {expression} is not a component of the state"
        )
    if expression.is_polynomial(*variables):
        return mf.sympy.polynomial(expression, variables)
    jax_function = _lambdify_for_jax(expression, variables)
    if jax_function is None:
        subexpressions = sympy.postorder_traversal(expression)
        unknown = next(
            subexpression
            for subexpression in subexpressions
            if subexpression.args and _lambdify_for_jax(subexpression, variables) is None
        )
        raise InputError(
            f"{unknown.func.__name__} in {unknown} has no counterpart in JAX. Write the function with jax.numpy"
        )
    return jax_function


def _lambdify_for_jax(expression: sympy.Basic, variables: tuple[sympy.Symbol, ...]) -> Callable | None:
    """Convert a SymPy expression to a function of one JAX array; return None if JAX lacks a function in it."""
    try:
        numeric_function = sympy.lambdify(variables, expression, modules=[JAX_SPECIAL_FUNCTIONS, "jax"])
        jax.eval_shape(lambda x: numeric_function(*x), jax.ShapeDtypeStruct((len(variables),), jnp.float64))
    except (NameError, AttributeError, NotImplementedError, TypeError):
        return None
    return lambda x: numeric_function(*x)


def describe(system: System, x0, t_span: tuple[float, float], name: str = "problem") -> dict[str, Any]:
    """Return a problem as JSON data for tests of other solvers: expressions, constants and the final state.

    The final state is computed twice, by SciPy's DOP853 and by collocation of order 12, and given to the digits in
    which both agree. Expressions are written for SymPy and for Julia; indices count from 1.

    Parameters
    ----------
    system : System
        See :func:`expressions`.
    x0 : array, shape (n,)
    t_span : (float, float)
    name : str

    Returns
    -------
    dict
        ``format``, ``name``, ``variables``, ``energy``, ``entropy``, ``casimirs``, ``field``, ``initial_state``,
        ``t_span``, ``reference``, and ``lie_algebra`` if the system has one.

    Raises
    ------
    InputError
        If the system has no expressions, or an argument cannot be used.
    """
    symbolic = expressions(system)
    problem = {
        "format": PROBLEM_FORMAT,
        "name": name,
        "variables": [str(x) for x in symbolic.variables],
        "energy": _sympy_and_julia_code(symbolic.energy),
        "entropy": None if symbolic.entropy is None else _sympy_and_julia_code(symbolic.entropy),
        "casimirs": {key: _sympy_and_julia_code(value) for key, value in symbolic.casimirs.items()},
        "field": [_sympy_and_julia_code(component) for component in symbolic.field],
        "initial_state": [float(value) for value in np.asarray(x0, dtype=np.float64)],
        "t_span": [float(t) for t in t_span],
        "reference": _reference_solution(system, x0, t_span),
    }
    if (algebra := system.lie_algebra) is not None:
        constants = mf.sympy.structure_constants(algebra)
        problem["lie_algebra"] = {
            "name": algebra.name,
            "dimension": algebra.dim,
            "structure_constants": [
                [a + 1, b + 1, c + 1, str(constants[a, b, c])]
                for a, b, c in np.argwhere(algebra.structure_constants).tolist()
            ],
        }
    return problem


def write(problem: dict[str, Any], path: str | os.PathLike) -> Path:
    """Write a problem, as returned by :func:`describe`, to a JSON file.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    path = disk.checked_path(path)
    text = json.dumps(problem, indent=2, ensure_ascii=False) + "\n"
    with disk.file_errors("write", path):
        disk.write_atomically(path, text.encode())
    return path


def _sympy_and_julia_code(expression: sympy.Expr) -> dict[str, str]:
    """Return the source text of an expression in SymPy and in Julia, by language."""
    return {"sympy": str(expression), "julia": sympy.julia_code(expression)}


def _reference_solution(system: System, x0, t_span: tuple[float, float]) -> dict[str, Any]:
    """Integrate with two methods; return the final state, rounded to the digits in which they agree, and the
    difference."""
    duration = t_span[1] - t_span[0]
    x_dop853 = integrate(system, x0, t_span, duration, Reference(rtol=1e-13), progress=False).x[-1]
    x_gauss = integrate(
        system, x0, t_span, _gauss_reference_step_size(system, x0, duration), MetriplecticGauss(6), progress=False
    ).x[-1]
    difference = float(np.abs(x_dop853 - x_gauss).max())
    digits = int(np.clip(-np.log10(max(difference, 1e-16)), 1, 15))
    return {"time": float(t_span[1]), "state": [round(float(x), digits) for x in x_gauss], "apart": difference}


def _gauss_reference_step_size(system: System, x0, duration: float) -> float:
    """Return a step size for 6-stage Gauss collocation: a fifth of the time in which the state changes by its
    magnitude."""
    x = np.asarray(x0, dtype=np.float64)
    max_rate = float(np.abs(system.vector_field(system.state(x))).max())
    return float(min(0.05 * duration, 0.2 * max(np.abs(x).max(), 1e-3) / max(max_rate, 1e-300), 0.1))


def _expressions_of_program(program: Program, variables: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    """Return the outputs of a traced program with one input as SymPy expressions of the variables."""
    values: dict[Any, Any] = dict(zip(program.inputs[0], variables, strict=True))

    def expression_of(operand: Any) -> Any:
        return values[operand] if isinstance(operand, str) else _to_sympy_constant(operand)

    for target, op, args in program.instructions:
        if op == "float":
            values[target] = expression_of(args[0])
        elif isinstance(op, str) and op in SYMPY_OPERATIONS:
            values[target] = SYMPY_OPERATIONS[op](*map(expression_of, args))
        else:
            raise InputError(f"the operation {str(op)!r} has no SymPy expression")
    return [
        sympy.expand(expression_of(operand)) if _is_short(expression_of(operand)) else expression_of(operand)
        for entries in program.outputs
        for operand in entries
    ]


def _is_short(expression: Any) -> bool:
    """Return True if an expression has fewer than 400 operations, so that expanding its products keeps it short."""
    return sympy.count_ops(expression) < 400


def _to_sympy_constant(value: Any) -> Any:
    if isinstance(value, bool | np.bool_):
        return sympy.true if value else sympy.false
    number = float(value)
    if not np.isfinite(number):
        return sympy.nan if number != number else sympy.oo * int(np.sign(number))
    fraction = Fraction(number).limit_denominator(MAX_DENOMINATOR)
    exact = float(fraction) == number
    return sympy.Rational(fraction.numerator, fraction.denominator) if exact else sympy.Float(number, 17)
