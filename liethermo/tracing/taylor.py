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
from .scalarize import origin


class NoSeriesError(InputError):
    """A function that has no Taylor series, or whose series there is no rule for.

    Attributes
    ----------
    primitive : str
        The JAX primitive in the way.
    where : str
        The line of the user's code that called for it, as far as JAX knows.
    """

    def __init__(self, primitive: str, where: str, before: str = "", after: str = ""):
        self.primitive, self.where = primitive, where
        reason = "is not smooth" if primitive in KINKED else "has no rule for its Taylor series"
        super().__init__(f"{before}the JAX primitive {primitive!r} {reason} ({where}){after}")

    def about(self, what: str, advice: str) -> NoSeriesError:
        """The same, saying what the function is of and what to do."""
        return type(self)(self.primitive, self.where, what, f": {advice}")


def check_series(function: Callable, x) -> None:
    """Raise NoSeriesError unless a function of an array like x has Taylor series, of which nothing is computed."""
    jax.eval_shape(lambda x: _Recurrences(function, x).sequence and (), jnp.zeros_like(x))


def solution(field: Callable, x, h, order: int) -> jax.Array:
    """The coefficients ``c_1 ... c_order``, shape (order, n), of ``x(h s) = x + c_1 s + c_2 s^2 + ...``.

    This x(h s) is the solution of ``x' = field(x)`` that begins at x, shape (n,). A loop finds one coefficient after
    another, with the same body for all.

    Raises
    ------
    NoSeriesError
        Where the field has none.
    """
    recurrences = _Recurrences(field, x)
    if recurrences.result is None:
        return jnp.zeros((order, *x.shape)).at[0].set(h * recurrences.constant)
    histories = {
        i: _entered(jnp.zeros((order, *start.shape), start.dtype), start, 0) for i, start in recurrences.kept()
    }

    def coefficient(carry, numbers):
        histories, rate = carry
        n, number = numbers
        rate, histories = recurrences.coefficients(n, number, rate / number, histories)
        return (histories, h * rate), carry[1] / number

    numbers = np.arange(1, order), np.arange(1.0, order)
    (_, rate), found = jax.lax.scan(coefficient, (histories, h * recurrences.terms[recurrences.result].start), numbers)
    return jnp.concatenate([found, rate[None] / order])


class _Term(NamedTuple):
    """The series of an intermediate value.

    Attributes
    ----------
    start : array
        Its coefficient 0.
    rule : function of n, the coefficients n of ``now``, and the coefficients so far of ``past``, to coefficient n
        What is not known yet is zero in the latter. None for a value that is known at the start alone.
    now, past : tuple of int
        Places of terms.
    rising : bool
        Whether its coefficient 0 vanishes, as that of ``D a`` does.
    refusal : tuple of str
        A primitive and its origin, where there is no rule.
    """

    start: Any
    rule: Callable | None
    now: tuple[int, ...] = ()
    past: tuple[int, ...] = ()
    rising: bool = False
    refusal: tuple[str, str] = ("", "")


class _Series(NamedTuple):
    """The place of a term."""

    place: int


class _Recurrences:
    """The series of the values that a function is computed with, and the rules that they follow.

    Attributes
    ----------
    terms : list of _Term
        The argument is the first.
    result : int or None
        The place of the result; None where it is ``constant``.
    sequence : list of int
        What the result depends on, the argument left out, each behind those of the same order that it needs.
    """

    def __init__(self, function: Callable, x):
        self.terms: list[_Term] = [_Term(x, None)]
        self._known: dict[tuple, _Series] = {}
        (found,) = self.inlined(lambda x: [function(x)], [_Series(0)])
        self.result = found.place if isinstance(found, _Series) else None
        self.constant = found
        self.sequence = [] if self.result is None else self._sequence(self.result)

    def coefficients(self, n, number, first, histories: dict) -> tuple[jax.Array, dict]:
        """Coefficient n of the result from that of the argument, and the histories with coefficients n entered."""
        now: dict[int, Any] = {}
        histories = dict(histories)
        for place in (0, *self.sequence):
            term = self.terms[place]
            if place:
                assert term.rule is not None
                now[place] = term.rule(n, number, [now[i] for i in term.now], [histories[i] for i in term.past])
            else:
                now[place] = first
            if place in histories:
                histories[place] = _entered(histories[place], now[place], n)
        assert self.result is not None
        return now[self.result], histories

    def kept(self):
        """The places of the terms whose past is needed, and their first coefficients."""
        places = sorted({i for place in self.sequence for i in self.terms[place].past})
        return [(i, self.terms[i].start) for i in places]

    def _sequence(self, result: int) -> list[int]:
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
                        raise NoSeriesError(*term.refusal)
                    stack.append((place, True))
                    stack.extend((i, False) for i in term.now)
                    wanted.extend(term.past)
        return order

    # -- building -----------------------------------------------------------------------------------------------------

    def add(self, start, rule: Callable | None, now=(), past=(), **more) -> _Series:
        self.terms.append(_Term(start, rule, tuple(now), tuple(past), **more))
        return _Series(len(self.terms) - 1)

    def start(self, value):
        return self.terms[value.place].start if isinstance(value, _Series) else value

    def rises(self, value) -> bool:
        return isinstance(value, _Series) and self.terms[value.place].rising

    def inlined(self, function: Callable, values: Sequence) -> list:
        """What a function from arrays to a list of arrays makes of values."""
        avals = [jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)) for a in map(self.start, values)]
        closed = jax.make_jaxpr(function)(*avals)
        return self.walked(closed.jaxpr, closed.consts, values)

    def walked(self, jaxpr, consts: Sequence, values: Sequence) -> list:
        """The results of a jaxpr: arrays where they do not depend on the argument, and series."""
        env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *values), strict=True))

        def read(v):
            return v.val if isinstance(v, Literal) else env[v]

        has_powers = any(eqn.primitive.name == "pow" for eqn in jaxpr.eqns)
        for eqn in jaxpr.eqns:
            given, name = [read(v) for v in eqn.invars], eqn.primitive.name
            if name in CALLS:
                found = _called(self, eqn, given)
            elif has_powers and all(map(_is_small_constant, given)):
                with jax.ensure_compile_time_eval():  # it may become an exponent, whose value says what is done
                    found = _bound(eqn, given)
            elif not any(isinstance(value, _Series) for value in given) or not any(map(_is_real, eqn.outvars)):
                found = _bound(eqn, map(self.start, given))  # tests are decided at the start
            else:
                found = RULES.get(name, _refused)(self, eqn, given)
            env.update(zip(eqn.outvars, found, strict=True))
        return [read(v) for v in jaxpr.outvars]


# -- rules: rule(recurrences, equation, values) -> list of results ----------------------------------------------------


def _refused(recurrences: _Recurrences, eqn, values) -> list:
    """Only the value at the start is known, which is all that a test needs."""
    return [
        recurrences.add(start, None, refusal=(eqn.primitive.name, origin(eqn)))
        for start in _bound(eqn, map(recurrences.start, values))
    ]


def _linear(recurrences: _Recurrences, eqn, values) -> list:
    """Linear in all real arguments together: those that are constant have no further coefficients."""
    moving = [value.place for value in values if isinstance(value, _Series)]

    def rule(n, number, now, past, which):
        rest = iter(now)
        given = [_further(value, rest) for value in values]
        return _bound(eqn, given)[which]

    rising = all(recurrences.terms[place].rising for place in moving)
    return [
        recurrences.add(start, _picking(rule, which), moving, rising=rising)
        for which, start in enumerate(_bound(eqn, map(recurrences.start, values)))
    ]


def _further(value, rest):
    """A coefficient beyond the first: the next of the rest for a series, zero for a constant."""
    if isinstance(value, _Series):
        return next(rest)
    return jnp.zeros_like(value) if jnp.issubdtype(jnp.result_type(value), jnp.inexact) else value


def _picking(rule: Callable, which: int) -> Callable:
    return lambda *arguments: rule(*arguments, which)


def _bilinear(recurrences: _Recurrences, eqn, values) -> list:
    (start,) = _bound(eqn, map(recurrences.start, values))
    a, b = values
    if isinstance(a, _Series) and isinstance(b, _Series):
        now = [x.place for x, y in ((a, b), (b, a)) if not recurrences.rises(y)]  # beside coefficient 0 of the other

        def rule(n, number, now, past):
            return convolved(lambda *pair: _bound(eqn, pair)[0], past[0], past[1], n)

        return [
            recurrences.add(start, rule, now, (a.place, b.place), rising=recurrences.rises(a) or recurrences.rises(b))
        ]
    moving = a if isinstance(a, _Series) else b

    def single(n, number, now, past):
        return _bound(eqn, [now[0] if value is moving else value for value in values])[0]

    return [recurrences.add(start, single, (moving.place,), rising=recurrences.rises(moving))]


def _solved(recurrences: _Recurrences, start, product: Callable, solve: Callable, a: _Series, b) -> list:
    """``c`` with ``product(a, c) = b``, a bilinear product, where ``solve(rhs)`` is it at the start."""
    moving, rising = isinstance(b, _Series), recurrences.rises(b)
    now = [*([b.place] if moving else ()), *(() if rising else (a.place,))]

    def rule(n, number, now, past):
        rest = convolved(product, past[0], past[1], n)  # without coefficient n of c, which is zero yet
        return solve(now[0] - rest if moving else -rest)

    return [recurrences.add(start, rule, now, (a.place, len(recurrences.terms)), rising=rising)]


def _divided(recurrences: _Recurrences, eqn, values) -> list:
    a, b = values
    if not isinstance(b, _Series):
        return _bilinear(recurrences, eqn, values)
    first = recurrences.start(b)
    return _solved(recurrences, recurrences.start(a) / first, jnp.multiply, lambda rhs: rhs / first, b, a)


def _solved_linearly(recurrences: _Recurrences, eqn, values) -> list:
    """``custom_linear_solve``: its matrix from its products, its inverse from the user's way of solving."""
    sizes, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    constants, right = list(values[: sum(sizes)]), values[sum(sizes) :]
    if len(right) > 1:
        return _refused(recurrences, eqn, values)
    (b,), starts = right, [recurrences.start(value) for value in constants]
    shape = np.shape(recurrences.start(b))
    axes = np.eye(int(np.prod(shape)))

    def columns(*own):
        product = jaxpr_as_fun(jaxprs.matvec)
        return [jax.vmap(lambda axis: product(*own, axis.reshape(shape))[0].ravel())(axes)]

    (matrix,) = recurrences.inlined(columns, values[: sizes.matvec])
    if not isinstance(matrix, _Series):
        return _linear(recurrences, eqn, values)  # in b alone: what else is there are the constants of other ways

    def solve(rhs):
        return eqn.primitive.bind(*starts, rhs, **eqn.params)[0]

    def product(columns, c):
        return (c.ravel() @ columns).reshape(shape)

    return _solved(recurrences, solve(recurrences.start(b)), product, solve, matrix, b)


def _solved_by_substitution(recurrences: _Recurrences, eqn, values) -> list:
    """``triangular_solve``: of the matrix one triangle counts."""
    a, b = values
    if not isinstance(a, _Series):
        return _bilinear(recurrences, eqn, values)
    params, first = eqn.params, recurrences.start(a)

    def product(a, c):
        a = jnp.tril(a) if params["lower"] else jnp.triu(a)
        if params["unit_diagonal"]:
            a = a - a * jnp.eye(a.shape[-1])  # the ones belong to coefficient 0, which is solved for
        a = a.swapaxes(-1, -2) if params["transpose_a"] else a
        return a @ c if params["left_side"] else c @ a

    def solve(rhs):
        return eqn.primitive.bind(first, rhs, **params)

    return _solved(recurrences, solve(recurrences.start(b)), product, solve, a, b)


def _by_derivative(recurrences: _Recurrences, eqn, values) -> list:
    """``y = F(a, b, ...)`` from ``D y = dF(D a, D b, ...)``, by JAX's own rule for dF."""
    (start,) = _bound(eqn, map(recurrences.start, values))
    key = (eqn.primitive.name, repr(eqn.params), tuple(value for value in values if isinstance(value, _Series)))
    whole = len(key[2]) == len(values)
    if whole and key in recurrences._known:
        return [recurrences._known[key]]  # which it may be itself: of y = exp(a) the derivative is y
    y = recurrences.add(start, None)
    if whole:
        recurrences._known[key] = y
    rates = [_euler(recurrences, value) for value in values if isinstance(value, _Series)]
    if eqn.primitive.name == "pow":
        (change,) = _change_of_power(recurrences, y, *values)
    else:

        def tangent(*arguments):
            rest = iter(arguments[len(values) :])
            tangents = tuple(next(rest) if isinstance(v, _Series) else jnp.zeros_like(v) for v in values)
            return [jax.jvp(lambda *a: _bound(eqn, a)[0], arguments[: len(values)], tangents)[1]]

        (change,) = recurrences.inlined(tangent, [*values, *rates])
    recurrences.terms[y.place] = _Term(start, lambda n, number, now, past: now[0] / number, (change.place,))
    return [y]


def _power(recurrences: _Recurrences, eqn, values) -> list:
    """``a ** p``: products where p is whole, for ``p D a / a`` loses all digits where a is small, and is NaN at 0."""
    a, p = values
    if not isinstance(a, _Series) or isinstance(p, _Series):
        return _by_derivative(recurrences, eqn, values)
    if _is_small_constant(p):
        exponents: Any = np.asarray(p)
        whole = [int(n) for n in np.unique(exponents) if float(n).is_integer() and abs(n) <= MAX_WHOLE_EXPONENT]
        if len(whole) == 1 and (exponents == whole[0]).all():
            return recurrences.inlined(lambda x: [_whole_power(x, whole[0])], [a])
    else:  # a parameter
        exponents, whole = p, list(range(MAX_WHOLE_PARAMETER + 1))

    def chosen(x, result):
        for n in whole:
            result = jnp.where(exponents == n, _whole_power(x, n), result)
        return [result]

    return recurrences.inlined(chosen, [a, *_by_derivative(recurrences, eqn, values)])


def _is_small_constant(value) -> bool:
    """Whether it is a number, or a few of them, known when the function is traced."""
    return not isinstance(value, _Series | jax.core.Tracer) and np.size(value) <= MAX_EXPONENTS


MAX_EXPONENTS = 64
"""Entries of a constant that may be an array of exponents."""

MAX_WHOLE_EXPONENT = 256
"""Largest size of a whole exponent, known when the function is traced, for which a power is written as products."""

MAX_WHOLE_PARAMETER = 6
"""Largest whole exponent for which a power is, where the exponent is a parameter."""


def _euler(recurrences: _Recurrences, a: _Series) -> _Series:
    zero = jnp.zeros_like(recurrences.start(a))
    return recurrences.add(zero, lambda n, number, now, past: number * now[0], (a.place,), rising=True)


def _change_of_power(recurrences: _Recurrences, y: _Series, a, p) -> list:
    """``D y = y (p D a / a + log(a) D p)``: JAX's rule has another power in it, whose rule has another."""
    if not isinstance(p, _Series):
        return recurrences.inlined(lambda y, a, p, da: [y * (p * (da / a))], [y, a, p, _euler(recurrences, a)])
    if not isinstance(a, _Series):
        return recurrences.inlined(lambda y, a, p, dp: [y * (jnp.log(a) * dp)], [y, a, p, _euler(recurrences, p)])
    rates = _euler(recurrences, a), _euler(recurrences, p)
    return recurrences.inlined(lambda y, a, p, da, dp: [y * (p * (da / a) + jnp.log(a) * dp)], [y, a, p, *rates])


def _rewritten(function: Callable) -> Callable:
    """A primitive in terms of others: ``function(parameters, arguments)``."""
    return lambda recurrences, eqn, values: recurrences.inlined(lambda *a: [function(eqn.params, *a)], values)


def _integer_power(params, x):
    return _whole_power(x, params["y"])


def _whole_power(x, y: int):
    def power(n: int):
        if n == 1:
            return x
        half = power(n // 2)
        return half * half * x if n % 2 else half * half

    if y == 0:
        return jnp.ones_like(x)
    return power(y) if y > 0 else 1.0 / power(-y)


def _called(recurrences: _Recurrences, eqn, values) -> list:
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    jaxpr, consts = (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())
    return recurrences.walked(jaxpr, consts, values)


def _chosen(recurrences: _Recurrences, eqn, values) -> list:
    """``cond``: every branch, then the one that is taken at the start."""
    which, *values = values
    results = [recurrences.walked(branch.jaxpr, branch.consts, values) for branch in eqn.params["branches"]]

    def choice(which, *cases):
        which = jnp.clip(jnp.asarray(which, dtype=jnp.int32), 0, len(cases) - 1)
        return [jax.lax.select_n(which, *cases)]

    return [recurrences.inlined(choice, [recurrences.start(which), *cases])[0] for cases in zip(*results, strict=True)]


def _looped(recurrences: _Recurrences, eqn, values) -> list:
    """``scan``, unrolled."""
    params = eqn.params
    inner, first = params["jaxpr"], params["num_consts"]
    last = first + params["num_carry"]
    consts, carry, slices = values[:first], list(values[first:last]), values[last:]
    rows, gathered = range(params["length"]), []
    for i in reversed(rows) if params["reverse"] else rows:
        own = [recurrences.inlined(lambda x, i=i: [x[i]], [x])[0] for x in slices]
        found = recurrences.walked(inner.jaxpr, inner.consts, [*consts, *carry, *own])
        carry = found[: len(carry)]
        gathered.append(found[len(carry) :])
    if params["reverse"]:
        gathered.reverse()
    return carry + [
        recurrences.inlined(lambda *rows: [jnp.stack(rows)], column)[0] for column in zip(*gathered, strict=True)
    ]


CALLS = set("jit pjit call closed_call core_call custom_jvp_call custom_vjp_call checkpoint remat remat2".split())

KINKED = set(
    "abs sign floor ceil round max min clamp rem reduce_max reduce_min cummax cummin argmax argmin sort".split()
)
"""Primitives that are not smooth."""

LINEAR = """
add sub add_any neg convert_element_type copy copy_p name optimization_barrier stop_gradient real imag complex conj
reduce_sum cumsum broadcast_in_dim reshape squeeze expand_dims transpose rev slice split concatenate stack unstack tile
pad dynamic_slice dynamic_update_slice gather scatter scatter-add scatter-sub select_n
"""

BY_DERIVATIVE = """
exp exp2 expm1 log log1p pow sqrt rsqrt cbrt logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh
erf erfc erf_inv reduce_prod cumprod cholesky
"""

RULES: dict[str, Callable] = {
    **dict.fromkeys(LINEAR.split(), _linear),
    **dict.fromkeys(("mul", "dot_general", "conv_general_dilated"), _bilinear),
    **dict.fromkeys(BY_DERIVATIVE.split(), _by_derivative),
    "square": _rewritten(lambda params, x: x * x),
    "integer_pow": _rewritten(_integer_power),
    "pow": _power,
    "div": _divided,
    "custom_linear_solve": _solved_linearly,
    "triangular_solve": _solved_by_substitution,
    "cond": _chosen,
    "scan": _looped,
}

# -- helpers ----------------------------------------------------------------------------------------------------------


def convolved(product: Callable, a, b, n) -> jax.Array:
    """``sum_k product(a[k], b[n - k])`` for k from 0 to n, of coefficients that are zero beyond n."""
    size = a.shape[0]
    window = jax.lax.dynamic_slice_in_dim(jnp.concatenate([jnp.zeros_like(b), b]), n + 1, size)
    return jax.vmap(product)(a, window[::-1]).sum(axis=0)


def _entered(history, coefficient, n):
    return jax.lax.dynamic_update_index_in_dim(history, coefficient, n, 0)


def _bound(eqn, values) -> list:
    """The results of an equation for arrays."""
    found = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return list(found) if eqn.primitive.multiple_results else [found]


def _is_real(v) -> bool:
    """Whether a variable is one of real or complex numbers."""
    return jnp.issubdtype(v.aval.dtype, jnp.inexact)
