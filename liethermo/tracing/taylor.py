"""Taylor series of the solutions of ``x' = f(x)``, by the recurrences of Taylor arithmetic on the jaxpr of f.

Coefficient n of every intermediate value follows from coefficients up to n of the values it is made of [Hairer, Nørsett
& Wanner 1993, I.8]. A product is a convolution, a quotient is one solved for its last term. For every other function
there is one rule, since JAX knows the derivative: of ``y = F(a)`` the Euler operator ``D = t d/dt``, which multiplies
coefficient n by n, makes ``D y = F'(a) D a``; so coefficient n of y follows from those of F'(a) up to n - 1, which
are made of a, y and their like.

What depends on a test, ``jnp.where`` and ``lax.cond``, is decided where the series begins. What has no derivatives of
every order is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from ..errors import InputError
from .scalarize import user_source_line


class TaylorSeriesError(InputError):
    """A function that has no Taylor series, or whose series there is no rule for.

    Attributes
    ----------
    primitive : str
        The JAX primitive in the way.
    source_line : str
        The line of the user's code that called for it, as far as JAX knows.
    """

    def __init__(self, primitive: str, source_line: str, before: str = "", after: str = ""):
        self.primitive, self.source_line = primitive, source_line
        reason = "is not smooth" if primitive in NONSMOOTH_PRIMITIVES else "has no rule for its Taylor series"
        super().__init__(f"{before}the JAX primitive {primitive!r} {reason} ({source_line}){after}")

    def add_context(self, what: str, advice: str) -> TaylorSeriesError:
        """The same, saying what the function is of and what to do."""
        return type(self)(self.primitive, self.source_line, what, f": {advice}")


def check_taylor_series(function: Callable, x) -> None:
    """Raise TaylorSeriesError unless a function of an array like x has Taylor series, of which nothing is computed."""
    jax.eval_shape(lambda x: _Recurrences(function, x).evaluation_order and (), jnp.zeros_like(x))


def taylor_coefficients(field: Callable, x, h, order: int) -> jax.Array:
    """The coefficients ``c_1 ... c_order``, shape (order, n), of ``x(h s) = x + c_1 s + c_2 s^2 + ...``.

    This x(h s) is the solution of ``x' = field(x)`` that begins at x, shape (n,). A loop finds one coefficient after
    another, with the same body for all.

    Raises
    ------
    TaylorSeriesError
        Where the field has none.
    """
    recurrences = _Recurrences(field, x)
    if recurrences.result is None:
        return jnp.zeros((order, *x.shape)).at[0].set(h * recurrences.constant)
    histories = {
        i: _store_coefficient(jnp.zeros((order, *start.shape), start.dtype), start, 0)
        for i, start in recurrences.history_starts()
    }

    def coefficient(carry, numbers):
        histories, rate = carry
        n, number = numbers
        rate, histories = recurrences.next_coefficient(n, number, rate / number, histories)
        return (histories, h * rate), carry[1] / number

    numbers = np.arange(1, order), np.arange(1.0, order)
    (_, rate), found = jax.lax.scan(coefficient, (histories, h * recurrences.terms[recurrences.result].start), numbers)
    return jnp.concatenate([found, rate[None] / order])


class _SeriesTerm(NamedTuple):
    """The series of an intermediate value.

    Attributes
    ----------
    start : array
        Its coefficient 0.
    rule : function of n, the coefficients n of ``current_terms``, and the coefficients so far of ``history_terms``, to coefficient n
        What is not known yet is zero in the latter. None for a value that is known at the start alone.
    current_terms, history_terms : tuple of int
        Places of terms.
    starts_at_zero : bool
        Whether its coefficient 0 vanishes, as that of ``D a`` does.
    refusal : tuple of str
        A primitive and its origin, where there is no rule.
    """

    start: Any
    rule: Callable | None
    current_terms: tuple[int, ...] = ()
    history_terms: tuple[int, ...] = ()
    starts_at_zero: bool = False
    refusal: tuple[str, str] = ("", "")


class _SeriesIndex(NamedTuple):
    """The place of a term."""

    term_index: int


class _Recurrences:
    """The series of the values that a function is computed with, and the rules that they follow.

    Attributes
    ----------
    terms : list of _SeriesTerm
        The argument is the first.
    result : int or None
        The place of the result; None where it is ``constant``.
    evaluation_order : list of int
        What the result depends on, the argument left out, each behind those of the same order that it needs.
    """

    def __init__(self, function: Callable, x):
        self.terms: list[_SeriesTerm] = [_SeriesTerm(x, None)]
        self._cached_series: dict[tuple, _SeriesIndex] = {}
        (found,) = self.inline(lambda x: [function(x)], [_SeriesIndex(0)])
        self.result = found.term_index if isinstance(found, _SeriesIndex) else None
        self.constant = found
        self.evaluation_order = [] if self.result is None else self._topological_order(self.result)

    def next_coefficient(self, n, number, first, histories: dict) -> tuple[jax.Array, dict]:
        """Coefficient n of the result from that of the argument, and the histories with coefficients n entered."""
        now: dict[int, Any] = {}
        histories = dict(histories)
        for place in (0, *self.evaluation_order):
            term = self.terms[place]
            if place:
                assert term.rule is not None
                now[place] = term.rule(
                    n, number, [now[i] for i in term.current_terms], [histories[i] for i in term.history_terms]
                )
            else:
                now[place] = first
            if place in histories:
                histories[place] = _store_coefficient(histories[place], now[place], n)
        assert self.result is not None
        return now[self.result], histories

    def history_starts(self):
        """The places of the terms whose past is needed, and their first coefficients."""
        places = sorted({i for place in self.evaluation_order for i in self.terms[place].history_terms})
        return [(i, self.terms[i].start) for i in places]

    def _topological_order(self, result: int) -> list[int]:
        """Depth first; by way of ``past`` further terms are needed, in no order."""
        order, wanted, entered = [], [result], {0}
        while wanted:
            stack = [(wanted.pop(), False)]
            while stack:
                place, done = stack.pop()
                if done:
                    order.append(place)
                elif place not in entered:
                    entered.add(place)
                    term = self.terms[place]
                    if term.rule is None:
                        raise TaylorSeriesError(*term.refusal)
                    stack.append((place, True))
                    stack.extend((i, False) for i in term.current_terms)
                    wanted.extend(term.history_terms)
        return order

    # -- building -----------------------------------------------------------------------------------------------------

    def add_term(self, start, rule: Callable | None, now=(), past=(), **more) -> _SeriesIndex:
        self.terms.append(_SeriesTerm(start, rule, tuple(now), tuple(past), **more))
        return _SeriesIndex(len(self.terms) - 1)

    def initial_value(self, value):
        return self.terms[value.term_index].start if isinstance(value, _SeriesIndex) else value

    def starts_at_zero(self, value) -> bool:
        return isinstance(value, _SeriesIndex) and self.terms[value.term_index].starts_at_zero

    def inline(self, function: Callable, values: Sequence) -> list:
        """What a function from arrays to a list of arrays makes of values."""
        avals = [jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)) for a in map(self.initial_value, values)]
        closed = jax.make_jaxpr(function)(*avals)
        return self.evaluate_jaxpr(closed.jaxpr, closed.consts, values)

    def evaluate_jaxpr(self, jaxpr, consts: Sequence, values: Sequence) -> list:
        """The results of a jaxpr: arrays where they do not depend on the argument, and series."""
        env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *values), strict=True))

        def read(v):
            return v.val if isinstance(v, Literal) else env[v]

        has_powers = any(eqn.primitive.name == "pow" for eqn in jaxpr.eqns)
        for eqn in jaxpr.eqns:
            given, name = [read(v) for v in eqn.invars], eqn.primitive.name
            if name in CALL_PRIMITIVES:
                found = _call_rule(self, eqn, given)
            elif has_powers and all(map(_is_small_constant, given)):
                with jax.ensure_compile_time_eval():  # it may become an exponent, whose value says what is done
                    found = _evaluate_equation(eqn, given)
            elif not any(isinstance(value, _SeriesIndex) for value in given) or not any(map(_is_inexact, eqn.outvars)):
                found = _evaluate_equation(eqn, map(self.initial_value, given))  # tests are decided at the start
            else:
                found = SERIES_RULES.get(name, _refuse_series)(self, eqn, given)
            env.update(zip(eqn.outvars, found, strict=True))
        return [read(v) for v in jaxpr.outvars]


# -- rules: rule(recurrences, equation, values) -> list of results ----------------------------------------------------


def _refuse_series(recurrences: _Recurrences, eqn, values) -> list:
    """Only the value at the start is known, which is all that a test needs."""
    return [
        recurrences.add_term(start, None, refusal=(eqn.primitive.name, user_source_line(eqn)))
        for start in _evaluate_equation(eqn, map(recurrences.initial_value, values))
    ]


def _linear_rule(recurrences: _Recurrences, eqn, values) -> list:
    """Linear in all real arguments together: those that are constant have no further coefficients."""
    moving = [value.term_index for value in values if isinstance(value, _SeriesIndex)]

    def rule(n, number, now, past, which):
        rest = iter(now)
        given = [_higher_coefficient(value, rest) for value in values]
        return _evaluate_equation(eqn, given)[which]

    rising = all(recurrences.terms[place].starts_at_zero for place in moving)
    return [
        recurrences.add_term(start, _select_output(rule, which), moving, starts_at_zero=rising)
        for which, start in enumerate(_evaluate_equation(eqn, map(recurrences.initial_value, values)))
    ]


def _higher_coefficient(value, rest):
    """A coefficient beyond the first: the next of the rest for a series, zero for a constant."""
    if isinstance(value, _SeriesIndex):
        return next(rest)
    return jnp.zeros_like(value) if jnp.issubdtype(jnp.result_type(value), jnp.inexact) else value


def _select_output(rule: Callable, which: int) -> Callable:
    return lambda *arguments: rule(*arguments, which)


def _bilinear_rule(recurrences: _Recurrences, eqn, values) -> list:
    (start,) = _evaluate_equation(eqn, map(recurrences.initial_value, values))
    a, b = values
    if isinstance(a, _SeriesIndex) and isinstance(b, _SeriesIndex):
        now = [
            x.term_index for x, y in ((a, b), (b, a)) if not recurrences.starts_at_zero(y)
        ]  # beside coefficient 0 of the other

        def rule(n, number, now, past):
            return cauchy_product(lambda *pair: _evaluate_equation(eqn, pair)[0], past[0], past[1], n)

        return [
            recurrences.add_term(
                start,
                rule,
                now,
                (a.term_index, b.term_index),
                starts_at_zero=recurrences.starts_at_zero(a) or recurrences.starts_at_zero(b),
            )
        ]
    moving = a if isinstance(a, _SeriesIndex) else b

    def single(n, number, now, past):
        return _evaluate_equation(eqn, [now[0] if value is moving else value for value in values])[0]

    return [recurrences.add_term(start, single, (moving.term_index,), starts_at_zero=recurrences.starts_at_zero(moving))]


def _solve_bilinear(recurrences: _Recurrences, start, product: Callable, solve: Callable, a: _SeriesIndex, b) -> list:
    """``c`` with ``product(a, c) = b``, a bilinear product, where ``solve(rhs)`` is it at the start."""
    moving, rising = isinstance(b, _SeriesIndex), recurrences.starts_at_zero(b)
    now = [*([b.term_index] if moving else ()), *(() if rising else (a.term_index,))]

    def rule(n, number, now, past):
        rest = cauchy_product(product, past[0], past[1], n)  # without coefficient n of c, which is zero yet
        return solve(now[0] - rest if moving else -rest)

    return [recurrences.add_term(start, rule, now, (a.term_index, len(recurrences.terms)), starts_at_zero=rising)]


def _division_rule(recurrences: _Recurrences, eqn, values) -> list:
    a, b = values
    if not isinstance(b, _SeriesIndex):
        return _bilinear_rule(recurrences, eqn, values)
    first = recurrences.initial_value(b)
    return _solve_bilinear(
        recurrences, recurrences.initial_value(a) / first, jnp.multiply, lambda rhs: rhs / first, b, a
    )


def _linear_solve_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``custom_linear_solve``: its matrix from its products, its inverse from the user's way of solving."""
    sizes, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    constants, right = list(values[: sum(sizes)]), values[sum(sizes) :]
    if len(right) > 1:
        return _refuse_series(recurrences, eqn, values)
    (b,), starts = right, [recurrences.initial_value(value) for value in constants]
    shape = np.shape(recurrences.initial_value(b))
    axes = np.eye(int(np.prod(shape)))

    def columns(*own):
        product = jaxpr_as_fun(jaxprs.matvec)
        return [jax.vmap(lambda axis: product(*own, axis.reshape(shape))[0].ravel())(axes)]

    (matrix,) = recurrences.inline(columns, values[: sizes.matvec])
    if not isinstance(matrix, _SeriesIndex):
        return _linear_rule(recurrences, eqn, values)  # in b alone: what else is there are the constants of other ways

    def solve(rhs):
        return eqn.primitive.bind(*starts, rhs, **eqn.params)[0]

    def product(columns, c):
        return (c.ravel() @ columns).reshape(shape)

    return _solve_bilinear(recurrences, solve(recurrences.initial_value(b)), product, solve, matrix, b)


def _triangular_solve_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``triangular_solve``: of the matrix one triangle counts."""
    a, b = values
    if not isinstance(a, _SeriesIndex):
        return _bilinear_rule(recurrences, eqn, values)
    params, first = eqn.params, recurrences.initial_value(a)

    def product(a, c):
        a = jnp.tril(a) if params["lower"] else jnp.triu(a)
        if params["unit_diagonal"]:
            a = a - a * jnp.eye(a.shape[-1])  # the ones belong to coefficient 0, which is solved for
        a = a.swapaxes(-1, -2) if params["transpose_a"] else a
        return a @ c if params["left_side"] else c @ a

    def solve(rhs):
        return eqn.primitive.bind(first, rhs, **params)

    return _solve_bilinear(recurrences, solve(recurrences.initial_value(b)), product, solve, a, b)


def _derivative_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``y = F(a, b, ...)`` from ``D y = dF(D a, D b, ...)``, by JAX's own rule for dF."""
    (start,) = _evaluate_equation(eqn, map(recurrences.initial_value, values))
    key = (eqn.primitive.name, repr(eqn.params), tuple(value for value in values if isinstance(value, _SeriesIndex)))
    whole = len(key[2]) == len(values)
    if whole and key in recurrences._cached_series:
        return [recurrences._cached_series[key]]  # which it may be itself: of y = exp(a) the derivative is y
    y = recurrences.add_term(start, None)
    if whole:
        recurrences._cached_series[key] = y
    rates = [_euler_derivative(recurrences, value) for value in values if isinstance(value, _SeriesIndex)]
    if eqn.primitive.name == "pow":
        (change,) = _power_derivative(recurrences, y, *values)
    else:

        def tangent(*arguments):
            rest = iter(arguments[len(values) :])
            tangents = tuple(next(rest) if isinstance(v, _SeriesIndex) else jnp.zeros_like(v) for v in values)
            return [jax.jvp(lambda *a: _evaluate_equation(eqn, a)[0], arguments[: len(values)], tangents)[1]]

        (change,) = recurrences.inline(tangent, [*values, *rates])
    recurrences.terms[y.term_index] = _SeriesTerm(
        start, lambda n, number, now, past: now[0] / number, (change.term_index,)
    )
    return [y]


def _power_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``a ** p``: products where p is whole, for ``p D a / a`` loses all digits where a is small, and is NaN at 0."""
    a, p = values
    if not isinstance(a, _SeriesIndex) or isinstance(p, _SeriesIndex):
        return _derivative_rule(recurrences, eqn, values)
    if _is_small_constant(p):
        exponents: Any = np.asarray(p)
        whole = [int(n) for n in np.unique(exponents) if float(n).is_integer() and abs(n) <= MAX_INTEGER_EXPONENT]
        if len(whole) == 1 and (exponents == whole[0]).all():
            return recurrences.inline(lambda x: [_power_by_squaring(x, whole[0])], [a])
    else:  # a parameter
        exponents, whole = p, list(range(MAX_INTEGER_PARAMETER + 1))

    def select_power(x, result):
        for n in whole:
            result = jnp.where(exponents == n, _power_by_squaring(x, n), result)
        return [result]

    return recurrences.inline(select_power, [a, *_derivative_rule(recurrences, eqn, values)])


def _is_small_constant(value) -> bool:
    """Whether it is a number, or a few of them, known when the function is traced."""
    return not isinstance(value, _SeriesIndex | jax.core.Tracer) and np.size(value) <= MAX_CONSTANT_EXPONENTS


MAX_CONSTANT_EXPONENTS = 64
"""Entries of a constant that may be an array of exponents."""

MAX_INTEGER_EXPONENT = 256
"""Largest size of a whole exponent, known when the function is traced, for which a power is written as products."""

MAX_INTEGER_PARAMETER = 6
"""Largest whole exponent for which a power is, where the exponent is a parameter."""


def _euler_derivative(recurrences: _Recurrences, a: _SeriesIndex) -> _SeriesIndex:
    zero = jnp.zeros_like(recurrences.initial_value(a))
    return recurrences.add_term(zero, lambda n, number, now, past: number * now[0], (a.term_index,), starts_at_zero=True)


def _power_derivative(recurrences: _Recurrences, y: _SeriesIndex, a, p) -> list:
    """``D y = y (p D a / a + log(a) D p)``: JAX's rule has another power in it, whose rule has another."""
    if not isinstance(p, _SeriesIndex):
        return recurrences.inline(
            lambda y, a, p, da: [y * (p * (da / a))], [y, a, p, _euler_derivative(recurrences, a)]
        )
    if not isinstance(a, _SeriesIndex):
        return recurrences.inline(
            lambda y, a, p, dp: [y * (jnp.log(a) * dp)], [y, a, p, _euler_derivative(recurrences, p)]
        )
    rates = _euler_derivative(recurrences, a), _euler_derivative(recurrences, p)
    return recurrences.inline(lambda y, a, p, da, dp: [y * (p * (da / a) + jnp.log(a) * dp)], [y, a, p, *rates])


def _rewriting_rule(function: Callable) -> Callable:
    """A primitive in terms of others: ``function(parameters, arguments)``."""
    return lambda recurrences, eqn, values: recurrences.inline(lambda *a: [function(eqn.params, *a)], values)


def _integer_power_expression(params, x):
    return _power_by_squaring(x, params["y"])


def _power_by_squaring(x, y: int):
    def power(n: int):
        if n == 1:
            return x
        half = power(n // 2)
        return half * half * x if n % 2 else half * half

    if y == 0:
        return jnp.ones_like(x)
    return power(y) if y > 0 else 1.0 / power(-y)


def _call_rule(recurrences: _Recurrences, eqn, values) -> list:
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    jaxpr, consts = (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())
    return recurrences.evaluate_jaxpr(jaxpr, consts, values)


def _cond_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``cond``: every branch, then the one that is taken at the start."""
    which, *values = values
    results = [recurrences.evaluate_jaxpr(branch.jaxpr, branch.consts, values) for branch in eqn.params["branches"]]

    def choice(which, *cases):
        which = jnp.clip(jnp.asarray(which, dtype=jnp.int32), 0, len(cases) - 1)
        return [jax.lax.select_n(which, *cases)]

    return [
        recurrences.inline(choice, [recurrences.initial_value(which), *cases])[0]
        for cases in zip(*results, strict=True)
    ]


def _scan_rule(recurrences: _Recurrences, eqn, values) -> list:
    """``scan``, unrolled."""
    params = eqn.params
    inner, first = params["jaxpr"], params["num_consts"]
    last = first + params["num_carry"]
    consts, carry, slices = values[:first], list(values[first:last]), values[last:]
    rows, gathered = range(params["length"]), []
    for i in reversed(rows) if params["reverse"] else rows:
        own = [recurrences.inline(lambda x, i=i: [x[i]], [x])[0] for x in slices]
        found = recurrences.evaluate_jaxpr(inner.jaxpr, inner.consts, [*consts, *carry, *own])
        carry = found[: len(carry)]
        gathered.append(found[len(carry) :])
    if params["reverse"]:
        gathered.reverse()
    return carry + [
        recurrences.inline(lambda *rows: [jnp.stack(rows)], column)[0] for column in zip(*gathered, strict=True)
    ]


CALL_PRIMITIVES = set(
    "jit pjit call closed_call core_call custom_jvp_call custom_vjp_call checkpoint remat remat2".split()
)

NONSMOOTH_PRIMITIVES = set(
    "abs sign floor ceil round max min clamp rem reduce_max reduce_min cummax cummin argmax argmin sort".split()
)
"""Primitives that are not smooth."""

LINEAR_PRIMITIVES = """
add sub add_any neg convert_element_type copy copy_p name optimization_barrier stop_gradient real imag complex conj
reduce_sum cumsum broadcast_in_dim reshape squeeze expand_dims transpose rev slice split concatenate stack unstack tile
pad dynamic_slice dynamic_update_slice gather scatter scatter-add scatter-sub select_n
"""

DERIVATIVE_PRIMITIVES = """
exp exp2 expm1 log log1p pow sqrt rsqrt cbrt logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh
erf erfc erf_inv reduce_prod cumprod cholesky
"""

SERIES_RULES: dict[str, Callable] = {
    **dict.fromkeys(LINEAR_PRIMITIVES.split(), _linear_rule),
    **dict.fromkeys(("mul", "dot_general", "conv_general_dilated"), _bilinear_rule),
    **dict.fromkeys(DERIVATIVE_PRIMITIVES.split(), _derivative_rule),
    "square": _rewriting_rule(lambda params, x: x * x),
    "integer_pow": _rewriting_rule(_integer_power_expression),
    "pow": _power_rule,
    "div": _division_rule,
    "custom_linear_solve": _linear_solve_rule,
    "triangular_solve": _triangular_solve_rule,
    "cond": _cond_rule,
    "scan": _scan_rule,
}

# -- helpers ----------------------------------------------------------------------------------------------------------


def cauchy_product(product: Callable, a, b, n) -> jax.Array:
    """``sum_k product(a[k], b[n - k])`` for k from 0 to n, of coefficients that are zero beyond n."""
    size = a.shape[0]
    window = jax.lax.dynamic_slice_in_dim(jnp.concatenate([jnp.zeros_like(b), b]), n + 1, size)
    return jax.vmap(product)(a, window[::-1]).sum(axis=0)


def _store_coefficient(history, coefficient, n):
    return jax.lax.dynamic_update_index_in_dim(history, coefficient, n, 0)


def _evaluate_equation(eqn, values) -> list:
    """The results of an equation for arrays."""
    found = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return list(found) if eqn.primitive.multiple_results else [found]


def _is_inexact(v) -> bool:
    """Whether a variable is one of real or complex numbers."""
    return jnp.issubdtype(v.aval.dtype, jnp.inexact)
