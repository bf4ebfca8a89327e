"""Taylor series of the solutions of ``x' = f(x)``, by the recurrences of Taylor arithmetic on the jaxpr of f.

Coefficient n of every intermediate value follows from coefficients up to n of its arguments [Hairer, Nørsett & Wanner
1993, I.8]. A product is a convolution; a quotient is a convolution solved for its last term. JAX knows the derivative
of every other function ``y = F(a)``, so one rule serves all: the Euler operator ``D = t d/dt``, which multiplies
coefficient n by n, gives ``D y = F'(a) D a``. Coefficient n of y thus follows from the coefficients of F'(a) up to n -
1.

The tests of ``jnp.where`` and ``lax.cond`` are evaluated at the start of the series. A function without derivatives of
every order is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from manifolds._jaxprs import CALL_PRIMITIVES, user_source_line

from ..errors import InputError


class TaylorSeriesError(InputError):
    """Error that a function has no Taylor series, or that no rule for its series is known.

    Attributes
    ----------
    primitive : str
        The JAX primitive without a rule.
    source_line : str
        The line of the user's code that led to it, if JAX knows it.
    """

    def __init__(self, primitive: str, source_line: str, prefix: str = "", suffix: str = ""):
        self.primitive, self.source_line = primitive, source_line
        reason = "is not smooth" if primitive in NONSMOOTH_PRIMITIVES else "has no rule for its Taylor series"
        super().__init__(f"{prefix}the JAX primitive {primitive!r} {reason} ({source_line}){suffix}")

    def add_context(self, subject: str, advice: str) -> TaylorSeriesError:
        """Return a copy of the error whose message begins with the name of the function and ends with advice."""
        return type(self)(self.primitive, self.source_line, subject, f": {advice}")


def check_has_taylor_series(function: Callable, x) -> None:
    """Raise TaylorSeriesError unless a function of an array like x has a Taylor series; compute no coefficients."""
    jax.eval_shape(lambda x: _Recurrences(function, x).evaluation_order and (), jnp.zeros_like(x))


def solution_taylor_coefficients(field: Callable, x, h, order: int) -> jax.Array:
    """Return the Taylor coefficients of orders 1 to ``order`` of the solution of ``x' = field(x)`` over a step h.

    The solution that begins at x, shape (n,), is ``x(h s) = x + c_1 s + c_2 s^2 + ...``; the result, shape (order, n),
    holds ``c_1, c_2, ...``. The coefficients are computed one after another, in a loop.

    Raises
    ------
    TaylorSeriesError
        If the field has no Taylor series.
    """
    recurrences = _Recurrences(field, x)
    if recurrences.result is None:
        return jnp.zeros((order, *x.shape)).at[0].set(h * recurrences.constant)
    histories = {
        i: _store_coefficient(jnp.zeros((order, *start.shape), start.dtype), start, 0)
        for i, start in recurrences.initial_coefficients_of_histories()
    }

    def compute_next_coefficient(carry, order_numbers):
        histories, rate = carry
        n, n_float = order_numbers
        rate, histories = recurrences.next_coefficient_and_histories(n, n_float, rate / n_float, histories)
        return (histories, h * rate), carry[1] / n_float

    order_numbers = np.arange(1, order), np.arange(1.0, order)
    (_, rate), coefficients = jax.lax.scan(
        compute_next_coefficient, (histories, h * recurrences.terms[recurrences.result].start), order_numbers
    )
    return jnp.concatenate([coefficients, rate[None] / order])


class _SeriesTerm(NamedTuple):
    """The Taylor series of an intermediate value, by its first coefficient and a recurrence.

    Attributes
    ----------
    start : array
        Coefficient 0.
    rule : function, or None
        Computes coefficient n from n, n as a float, the coefficients n of ``current_terms``, and all coefficients so
        far of ``history_terms``, in which the unknown ones are zero. None for a value whose start alone is known.
    current_terms, history_terms : tuple of int
        Indices of terms.
    starts_at_zero : bool
        Whether coefficient 0 is known to vanish, as for ``D a``.
    refusal : tuple of str
        The primitive without a rule and its source line.
    """

    start: Any
    rule: Callable | None
    current_terms: tuple[int, ...] = ()
    history_terms: tuple[int, ...] = ()
    starts_at_zero: bool = False
    refusal: tuple[str, str] = ("", "")


class _TermReference(NamedTuple):
    """A reference to a term by its index, of a type that differs from that of a constant."""

    term_index: int


class _Recurrences:
    """The Taylor series of all intermediate values of a function, with the recurrences that compute their coefficients.

    Attributes
    ----------
    terms : list of _SeriesTerm
        The first term is the argument.
    result : int or None
        Index of the result; None if the result is ``constant``.
    evaluation_order : list of int
        Indices of the terms that the result depends on, without the argument, each after its ``current_terms``.
    """

    def __init__(self, function: Callable, x):
        self.terms: list[_SeriesTerm] = [_SeriesTerm(x, None)]
        self._cached_series: dict[tuple, _TermReference] = {}
        (result,) = self.inline_function(lambda x: [function(x)], [_TermReference(0)])
        self.result = result.term_index if isinstance(result, _TermReference) else None
        self.constant = result
        self.evaluation_order = [] if self.result is None else self._topological_order(self.result)

    def next_coefficient_and_histories(
        self, n, n_float, argument_coefficient, histories: dict
    ) -> tuple[jax.Array, dict]:
        """Return the n-th coefficient of the result from that of the argument, and the histories with it appended."""
        coefficients: dict[int, Any] = {}
        histories = dict(histories)
        for term_index in (0, *self.evaluation_order):
            term = self.terms[term_index]
            if term_index:
                assert term.rule is not None
                coefficients[term_index] = term.rule(
                    n,
                    n_float,
                    [coefficients[i] for i in term.current_terms],
                    [histories[i] for i in term.history_terms],
                )
            else:
                coefficients[term_index] = argument_coefficient
            if term_index in histories:
                histories[term_index] = _store_coefficient(histories[term_index], coefficients[term_index], n)
        assert self.result is not None
        return coefficients[self.result], histories

    def initial_coefficients_of_histories(self):
        """Return (index, coefficient 0) of each term of which some rule reads all earlier coefficients."""
        indices = sorted({i for term_index in self.evaluation_order for i in self.terms[term_index].history_terms})
        return [(i, self.terms[i].start) for i in indices]

    def _topological_order(self, result: int) -> list[int]:
        """Return the terms of the recurrence on which a result depends, each after the terms that it needs at the
        same order."""
        order, pending, visited_terms = [], [result], {0}
        while pending:
            stack = [(pending.pop(), False)]
            while stack:
                term_index, is_expanded = stack.pop()
                if is_expanded:
                    order.append(term_index)
                elif term_index not in visited_terms:
                    visited_terms.add(term_index)
                    term = self.terms[term_index]
                    if term.rule is None:
                        raise TaylorSeriesError(*term.refusal)
                    stack.append((term_index, True))
                    stack.extend((i, False) for i in term.current_terms)
                    pending.extend(term.history_terms)
        return order

    # -- building -----------------------------------------------------------------------------------------------------

    def add_term(self, start, rule: Callable | None, current_terms=(), history_terms=(), **fields) -> _TermReference:
        """Append a term; return a reference to it. The arguments are the fields of :class:`_SeriesTerm`."""
        self.terms.append(_SeriesTerm(start, rule, tuple(current_terms), tuple(history_terms), **fields))
        return _TermReference(len(self.terms) - 1)

    def initial_value(self, value):
        """Return coefficient 0 of a term; a constant is returned unchanged."""
        return self.terms[value.term_index].start if isinstance(value, _TermReference) else value

    def starts_at_zero(self, value) -> bool:
        """Return whether a value is a term whose coefficient 0 is known to vanish."""
        return isinstance(value, _TermReference) and self.terms[value.term_index].starts_at_zero

    def inline_function(self, function: Callable, values: Sequence) -> list:
        """Add the terms of a function of constants and series; return its results, constants or series, as a list."""
        avals = [jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)) for a in map(self.initial_value, values)]
        closed_jaxpr = jax.make_jaxpr(function)(*avals)
        return self.add_jaxpr_terms(closed_jaxpr.jaxpr, closed_jaxpr.consts, values)

    def add_jaxpr_terms(self, jaxpr, consts: Sequence, values: Sequence) -> list:
        """Add the terms of a jaxpr; return its results, which are series, or arrays if constant."""
        env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *values), strict=True))

        def read(v):
            return v.val if isinstance(v, Literal) else env[v]

        has_powers = any(eqn.primitive.name == "pow" for eqn in jaxpr.eqns)
        for eqn in jaxpr.eqns:
            arguments, name = [read(v) for v in eqn.invars], eqn.primitive.name
            if name in CALL_PRIMITIVES:
                results = _call_rule(self, eqn, arguments)
            elif has_powers and all(map(_is_small_constant, arguments)):
                with jax.ensure_compile_time_eval():  # it may become an exponent, whose value selects the rule
                    results = _evaluate_equation(eqn, arguments)
            elif not any(isinstance(value, _TermReference) for value in arguments) or not any(
                map(_is_inexact, eqn.outvars)
            ):
                results = _evaluate_equation(eqn, map(self.initial_value, arguments))  # tests use the initial values
            else:
                results = SERIES_RULES.get(name, _placeholder_rule)(self, eqn, arguments)
            env.update(zip(eqn.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]


# -- rules: rule(recurrences, equation, values) -> list of results ----------------------------------------------------


def _placeholder_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return placeholder terms without a recurrence, which only tests may read; other uses raise TaylorSeriesError."""
    return [
        recurrences.add_term(start, None, refusal=(eqn.primitive.name, user_source_line(eqn)))
        for start in _evaluate_equation(eqn, map(recurrences.initial_value, values))
    ]


def _linear_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of a primitive that is linear in all real arguments together, coefficient by coefficient."""
    series_indices = [value.term_index for value in values if isinstance(value, _TermReference)]

    def rule(n, n_float, current, history, output_number):
        coefficients = iter(current)
        arguments = [_next_coefficient_or_zero(value, coefficients) for value in values]
        return _evaluate_equation(eqn, arguments)[output_number]

    starts_at_zero = all(recurrences.terms[i].starts_at_zero for i in series_indices)
    return [
        recurrences.add_term(start, _select_output(rule, output_number), series_indices, starts_at_zero=starts_at_zero)
        for output_number, start in enumerate(_evaluate_equation(eqn, map(recurrences.initial_value, values)))
    ]


def _next_coefficient_or_zero(value, coefficients):
    """Return the next Taylor coefficient, of order one or more, from the iterator ``coefficients``; zero for a
    constant."""
    if isinstance(value, _TermReference):
        return next(coefficients)
    return jnp.zeros_like(value) if jnp.issubdtype(jnp.result_type(value), jnp.inexact) else value


def _select_output(rule: Callable, output_index: int) -> Callable:
    """Return the rule that computes one output of an equation, from a rule with the index of the output."""
    return lambda *arguments: rule(*arguments, output_index)


def _bilinear_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of a primitive that is linear in each of two arguments: a Cauchy product."""
    (start,) = _evaluate_equation(eqn, map(recurrences.initial_value, values))
    a, b = values
    if isinstance(a, _TermReference) and isinstance(b, _TermReference):
        # coefficient n of a factor is multiplied by coefficient 0 of the other one
        current_terms = [x.term_index for x, y in ((a, b), (b, a)) if not recurrences.starts_at_zero(y)]

        def rule(n, n_float, current, history):
            return cauchy_product_coefficient(lambda *pair: _evaluate_equation(eqn, pair)[0], history[0], history[1], n)

        return [
            recurrences.add_term(
                start,
                rule,
                current_terms,
                (a.term_index, b.term_index),
                starts_at_zero=recurrences.starts_at_zero(a) or recurrences.starts_at_zero(b),
            )
        ]
    series = a if isinstance(a, _TermReference) else b

    def linear_rule(n, n_float, current, history):
        return _evaluate_equation(eqn, [current[0] if value is series else value for value in values])[0]

    return [
        recurrences.add_term(
            start, linear_rule, (series.term_index,), starts_at_zero=recurrences.starts_at_zero(series)
        )
    ]


def _solve_bilinear(recurrences: _Recurrences, start, product: Callable, solve: Callable, a: _TermReference, b) -> list:
    """Return the series c with ``product(a, c) = b``; ``solve(rhs)`` solves this for coefficient 0 of a."""
    is_series, starts_at_zero = isinstance(b, _TermReference), recurrences.starts_at_zero(b)
    current_terms = [*([b.term_index] if is_series else ()), *(() if starts_at_zero else (a.term_index,))]

    def rule(n, n_float, current, history):
        # coefficient n of c is still zero here
        lower_terms = cauchy_product_coefficient(product, history[0], history[1], n)
        return solve(current[0] - lower_terms if is_series else -lower_terms)

    return [
        recurrences.add_term(
            start, rule, current_terms, (a.term_index, len(recurrences.terms)), starts_at_zero=starts_at_zero
        )
    ]


def _division_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of a quotient a / b, from the product of b and the quotient."""
    a, b = values
    if not isinstance(b, _TermReference):
        return _bilinear_rule(recurrences, eqn, values)
    divisor_start = recurrences.initial_value(b)
    return _solve_bilinear(
        recurrences, recurrences.initial_value(a) / divisor_start, jnp.multiply, lambda rhs: rhs / divisor_start, b, a
    )


def _linear_solve_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of ``custom_linear_solve``, whose matrix is assembled from its products with unit vectors."""
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    constants, right_sides = list(values[: sum(lengths)]), values[sum(lengths) :]
    if len(right_sides) > 1:
        return _placeholder_rule(recurrences, eqn, values)
    (b,), starts = right_sides, [recurrences.initial_value(value) for value in constants]
    shape = np.shape(recurrences.initial_value(b))
    basis = np.eye(int(np.prod(shape)))

    def matrix_columns(*matvec_constants):
        product = jaxpr_as_fun(jaxprs.matvec)
        return [
            jax.vmap(lambda basis_vector: product(*matvec_constants, basis_vector.reshape(shape))[0].ravel())(basis)
        ]

    (matrix,) = recurrences.inline_function(matrix_columns, values[: lengths.matvec])
    if not isinstance(matrix, _TermReference):
        return _linear_rule(recurrences, eqn, values)  # linear in b; the other values are constants of the other jaxprs

    def solve(rhs):
        return eqn.primitive.bind(*starts, rhs, **eqn.params)[0]

    def product(columns, c):
        return (c.ravel() @ columns).reshape(shape)

    return _solve_bilinear(recurrences, solve(recurrences.initial_value(b)), product, solve, matrix, b)


def _triangular_solve_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of ``triangular_solve``, which reads one triangle of the matrix."""
    a, b = values
    if not isinstance(a, _TermReference):
        return _bilinear_rule(recurrences, eqn, values)
    params, matrix_start = eqn.params, recurrences.initial_value(a)

    def product(a, c):
        a = jnp.tril(a) if params["lower"] else jnp.triu(a)
        if params["unit_diagonal"]:
            a = a - a * jnp.eye(a.shape[-1])  # the unit diagonal belongs to coefficient 0
        a = a.swapaxes(-1, -2) if params["transpose_a"] else a
        return a @ c if params["left_side"] else c @ a

    def solve(rhs):
        return eqn.primitive.bind(matrix_start, rhs, **params)

    return _solve_bilinear(recurrences, solve(recurrences.initial_value(b)), product, solve, a, b)


def _smooth_primitive_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series ``y = F(a, b, ...)`` of a smooth primitive, from ``D y = dF(D a, D b, ...)`` by JAX's rule."""
    (start,) = _evaluate_equation(eqn, map(recurrences.initial_value, values))
    key = (eqn.primitive.name, repr(eqn.params), tuple(value for value in values if isinstance(value, _TermReference)))
    is_all_series = len(key[2]) == len(values)
    if is_all_series and key in recurrences._cached_series:
        return [recurrences._cached_series[key]]  # also inside its own rule: the derivative of exp(a) is exp(a)
    y = recurrences.add_term(start, None)
    if is_all_series:
        recurrences._cached_series[key] = y
    rates = [_apply_euler_operator(recurrences, value) for value in values if isinstance(value, _TermReference)]
    if eqn.primitive.name == "pow":
        (euler_derivative,) = _euler_operator_of_power(recurrences, y, *values)
    else:

        def evaluate_tangent(*arguments):
            rate_values = iter(arguments[len(values) :])
            tangents = tuple(next(rate_values) if isinstance(v, _TermReference) else jnp.zeros_like(v) for v in values)
            return [jax.jvp(lambda *a: _evaluate_equation(eqn, a)[0], arguments[: len(values)], tangents)[1]]

        (euler_derivative,) = recurrences.inline_function(evaluate_tangent, [*values, *rates])
    recurrences.terms[y.term_index] = _SeriesTerm(
        start, lambda n, n_float, current, history: current[0] / n_float, (euler_derivative.term_index,)
    )
    return [y]


def _power_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series ``a ** p``, by products for an integer p, since ``p D a / a`` is inaccurate near a = 0."""
    a, p = values
    if not isinstance(a, _TermReference) or isinstance(p, _TermReference):
        return _smooth_primitive_rule(recurrences, eqn, values)
    if _is_small_constant(p):
        exponents: Any = np.asarray(p)
        integers = [int(n) for n in np.unique(exponents) if float(n).is_integer() and abs(n) <= MAX_INTEGER_EXPONENT]
        if len(integers) == 1 and (exponents == integers[0]).all():
            return recurrences.inline_function(lambda x: [_power_by_squaring(x, integers[0])], [a])
    else:  # the exponent is a parameter
        exponents, integers = p, list(range(MAX_INTEGER_PARAMETER + 1))

    def replace_integer_powers(x, result):
        for n in integers:
            result = jnp.where(exponents == n, _power_by_squaring(x, n), result)
        return [result]

    return recurrences.inline_function(replace_integer_powers, [a, *_smooth_primitive_rule(recurrences, eqn, values)])


def _is_small_constant(value) -> bool:
    """Return whether a value is a number, or a few numbers, known at trace time."""
    return not isinstance(value, _TermReference | jax.core.Tracer) and np.size(value) <= MAX_CONSTANT_EXPONENTS


MAX_CONSTANT_EXPONENTS = 64
"""Largest number of entries of a constant that is treated as an array of exponents."""

MAX_INTEGER_EXPONENT = 256
"""Largest modulus of a constant integer exponent for which a power is written as products."""

MAX_INTEGER_PARAMETER = 6
"""Largest integer exponent, given by a parameter, for which a power is written as products."""


def _apply_euler_operator(recurrences: _Recurrences, a: _TermReference) -> _TermReference:
    """Add the series of ``D a = t da/dt``, whose coefficient n is n times that of a; return its term."""
    zero = jnp.zeros_like(recurrences.initial_value(a))
    return recurrences.add_term(
        zero, lambda n, n_float, current, history: n_float * current[0], (a.term_index,), starts_at_zero=True
    )


def _euler_operator_of_power(recurrences: _Recurrences, y: _TermReference, a, p) -> list:
    """Add the series of ``D y = y (p D a / a + log(a) D p)`` for ``y = a**p``; return its term in a list."""
    if not isinstance(p, _TermReference):
        return recurrences.inline_function(
            lambda y, a, p, da: [y * (p * (da / a))], [y, a, p, _apply_euler_operator(recurrences, a)]
        )
    if not isinstance(a, _TermReference):
        return recurrences.inline_function(
            lambda y, a, p, dp: [y * (jnp.log(a) * dp)], [y, a, p, _apply_euler_operator(recurrences, p)]
        )
    rates = _apply_euler_operator(recurrences, a), _apply_euler_operator(recurrences, p)
    return recurrences.inline_function(
        lambda y, a, p, da, dp: [y * (p * (da / a) + jnp.log(a) * dp)], [y, a, p, *rates]
    )


def _make_rewriting_rule(function: Callable) -> Callable:
    """Return the rule that writes a primitive in terms of others: ``function(parameters, *arguments)``."""
    return lambda recurrences, eqn, values: recurrences.inline_function(lambda *a: [function(eqn.params, *a)], values)


def _integer_power_expression(params, x):
    """Return ``integer_pow`` of x, with the exponent among the parameters, as products."""
    return _power_by_squaring(x, params["y"])


def _power_by_squaring(x, exponent: int):
    """Return ``x**exponent`` by repeated squaring."""

    def power(n: int):
        if n == 1:
            return x
        half = power(n // 2)
        return half * half * x if n % 2 else half * half

    if exponent == 0:
        return jnp.ones_like(x)
    return power(exponent) if exponent > 0 else 1.0 / power(-exponent)


def _call_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the series of the results of a call, from the jaxpr that it calls."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    jaxpr, consts = (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())
    return recurrences.add_jaxpr_terms(jaxpr, consts, values)


def _cond_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the Taylor series of the branch of a ``cond`` that the point of expansion selects."""
    branch_index, *values = values
    results = [recurrences.add_jaxpr_terms(branch.jaxpr, branch.consts, values) for branch in eqn.params["branches"]]

    def selected_case(index, *cases):
        index = jnp.clip(jnp.asarray(index, dtype=jnp.int32), 0, len(cases) - 1)
        return [jax.lax.select_n(index, *cases)]

    return [
        recurrences.inline_function(selected_case, [recurrences.initial_value(branch_index), *cases])[0]
        for cases in zip(*results, strict=True)
    ]


def _scan_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Return the Taylor series of the results of a ``scan``, which is unrolled pass by pass."""
    params = eqn.params
    body, n_consts = params["jaxpr"], params["num_consts"]
    carry_end = n_consts + params["num_carry"]
    consts, carry, tables = values[:n_consts], list(values[n_consts:carry_end]), values[carry_end:]
    rows, row_outputs = range(params["length"]), []
    for i in reversed(rows) if params["reverse"] else rows:
        row_slices = [recurrences.inline_function(lambda x, i=i: [x[i]], [x])[0] for x in tables]
        results = recurrences.add_jaxpr_terms(body.jaxpr, body.consts, [*consts, *carry, *row_slices])
        carry = results[: len(carry)]
        row_outputs.append(results[len(carry) :])
    if params["reverse"]:
        row_outputs.reverse()
    return carry + [
        recurrences.inline_function(lambda *rows: [jnp.stack(rows)], column)[0]
        for column in zip(*row_outputs, strict=True)
    ]


NONSMOOTH_PRIMITIVES = set(
    "abs sign floor ceil round max min clamp rem reduce_max reduce_min cummax cummin argmax argmin sort".split()
)
"""Primitives that are not smooth."""

LINEAR_PRIMITIVES = """
add sub add_any neg convert_element_type copy copy_p name optimization_barrier stop_gradient real imag complex conj
reduce_sum cumsum broadcast_in_dim reshape squeeze expand_dims transpose rev slice split concatenate stack unstack tile
pad dynamic_slice dynamic_update_slice gather scatter scatter-add scatter-sub select_n
"""
"""Primitives that are linear in all real arguments together."""

DERIVATIVE_PRIMITIVES = """
exp exp2 expm1 log log1p pow sqrt rsqrt cbrt logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh
erf erfc erf_inv reduce_prod cumprod cholesky
"""
"""Primitives whose series follow from their derivative."""

SERIES_RULES: dict[str, Callable] = {
    **dict.fromkeys(LINEAR_PRIMITIVES.split(), _linear_rule),
    **dict.fromkeys(("mul", "dot_general", "conv_general_dilated"), _bilinear_rule),
    **dict.fromkeys(DERIVATIVE_PRIMITIVES.split(), _smooth_primitive_rule),
    "square": _make_rewriting_rule(lambda params, x: x * x),
    "integer_pow": _make_rewriting_rule(_integer_power_expression),
    "pow": _power_rule,
    "div": _division_rule,
    "custom_linear_solve": _linear_solve_rule,
    "triangular_solve": _triangular_solve_rule,
    "cond": _cond_rule,
    "scan": _scan_rule,
}
"""Rules ``rule(recurrences, equation, values)`` by primitive; each returns the list of results."""

# -- helpers ----------------------------------------------------------------------------------------------------------


def cauchy_product_coefficient(product: Callable, a, b, n) -> jax.Array:
    """Return ``sum_k product(a[k], b[n - k])`` for k from 0 to n; coefficients beyond n are zero."""
    n_coefficients = a.shape[0]
    window = jax.lax.dynamic_slice_in_dim(jnp.concatenate([jnp.zeros_like(b), b]), n + 1, n_coefficients)
    return jax.vmap(product)(a, window[::-1]).sum(axis=0)


def _store_coefficient(history, coefficient, n):
    """Return an array of coefficients with coefficient n replaced."""
    return jax.lax.dynamic_update_index_in_dim(history, coefficient, n, 0)


def _evaluate_equation(eqn, values) -> list:
    """Return the results of an equation for arrays."""
    results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return list(results) if eqn.primitive.multiple_results else [results]


def _is_inexact(v) -> bool:
    """Return whether a variable holds real or complex numbers."""
    return jnp.issubdtype(v.aval.dtype, jnp.inexact)
