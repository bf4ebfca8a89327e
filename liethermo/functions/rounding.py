"""What rounding does to a function, found where it arises.

A bound relative to the result, or to the state, is wrong where large terms cancel: the heat between two bodies of
temperature 1 is rounded like 1 however little it is, and their entropies, the logarithms of 1, vanish. Here each result
of the arithmetic inside the function is given an error of its own, and what they come to is seen in the result
[stochastic arithmetic: Vignes 1993].
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ..tracing.routines import has_matrix_products

EXACT_PRIMITIVES = frozenset(
    """abs broadcast_in_dim ceil clamp concatenate convert_element_type copy copy_p copysign dynamic_slice
    dynamic_update_slice expand_dims floor gather imag iota max min neg pad real reduce_max reduce_min reshape rev round
    select_n sign slice sort split squeeze stop_gradient transpose""".split()
)
"""Primitives that round nothing."""

JAXPR_PARAMETERS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
CONTROL_PRIMITIVES = frozenset({"cond", "scan", "while"})
"""Primitives with programs inside that are left as they are: their results alone are given errors."""

MAX_RELATIVE_PERTURBATION = 2.0**-36
"""Largest error, relative to what a result is: far above rounding, and small enough for errors to add."""

PERTURBATION_SAMPLES = 3
"""Times that errors are drawn: those of two instructions may cancel in one."""

PATTERNS_PER_SHAPE = 8
"""Arrays of errors for each size: few, since a program holds them."""

MAX_STORED_PATTERN_LENGTH = 10_000
"""Numbers in an array up to which it does; longer ones it makes."""


def value_and_rounding_scale(function: Callable, x) -> tuple[jax.Array, jax.Array]:
    """``function(x)`` and the size at which it is rounded: its error is about eps times that, entry by entry.

    Parameters
    ----------
    function : function from an array to an array, shape (...)

    Returns
    -------
    two arrays, shape (...)
        The size is zero where the function is not finite with errors.
    """
    closed = jax.make_jaxpr(function)(x)

    def evaluate_perturbed(shares):
        return _evaluate_perturbed(closed.jaxpr, closed.consts, [x], itertools.count(), shares)[0]

    # one program, as one is quicker to compile; of large arrays one sample after another, for they need memory, and of
    # functions within that are called by several samples, such as networks
    together = np.size(x) <= MAX_STORED_PATTERN_LENGTH and not any(map(_is_routine_call, closed.jaxpr.eqns))
    each = jax.vmap(evaluate_perturbed) if together else functools.partial(jax.lax.map, evaluate_perturbed)
    found = each(np.eye(PERTURBATION_SAMPLES + 1, PERTURBATION_SAMPLES, -1) * MAX_RELATIVE_PERTURBATION)
    right, wrong = found[0], found[1:]
    size = jnp.max(jnp.abs(wrong - right), axis=0) / MAX_RELATIVE_PERTURBATION
    return right, jnp.where(jnp.isfinite(size), size, 0.0)


def propagated_rounding_scale(function: Callable, x, sizes) -> jax.Array:
    """The size at which ``function(x)`` is rounded, to first order, where x itself is.

    Errors so small change nothing that the function decides: one that jumps is not rounded by the size of its jump.

    Parameters
    ----------
    function : function from an array, shape (n,), to a number
    sizes : array, shape (n,)
        The components of x are known to about eps times these.
    """
    closed = jax.make_jaxpr(function)(x)

    def evaluate_perturbed(shares):
        numbers = itertools.count()
        given = x + (_perturb(sizes, next(numbers), shares) - sizes)
        return _evaluate_perturbed(closed.jaxpr, closed.consts, [given], numbers, shares)[0]

    none = jnp.zeros(PERTURBATION_SAMPLES)
    found = [jax.jvp(evaluate_perturbed, (none,), (direction,))[1] for direction in jnp.eye(PERTURBATION_SAMPLES)]
    return jnp.max(jnp.abs(jnp.stack(found)))


def _evaluate_perturbed(jaxpr: Jaxpr, constants, arguments, numbers: Iterator[int], shares) -> list:
    """The results of a program each of whose instructions errs, by shares of what it gives."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))
    for equation in jaxpr.eqns:
        given = [v.val if isinstance(v, Literal) else values[v] for v in equation.invars]
        name, parameters = equation.primitive.name, equation.params
        inner = next((parameters[key] for key in JAXPR_PARAMETERS if key in parameters), None)
        if inner is not None and name not in CONTROL_PRIMITIVES and isinstance(inner, ClosedJaxpr):
            if _is_routine_call(equation):
                whole = jax.jit(
                    lambda given, shares, i=inner: _evaluate_perturbed(i.jaxpr, i.consts, given, numbers, shares)
                )
                found = whole(given, shares)
            else:
                found = _evaluate_perturbed(inner.jaxpr, inner.consts, given, numbers, shares)
        else:
            bound = equation.primitive.get_bind_params(parameters)
            functions, parameters = bound if isinstance(bound, tuple) else ((), bound)  # as older versions of JAX have
            found = equation.primitive.bind(*functions, *given, **parameters)
            found = found if equation.primitive.multiple_results else [found]
            if name not in EXACT_PRIMITIVES:
                found = [_perturb(value, next(numbers), shares) for value in found]
        values.update(zip(equation.outvars, found, strict=True))
    return [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars]


def _is_routine_call(equation) -> bool:
    """Whether it calls a function with products of matrices: in machine code that is a routine, written once."""
    return equation.primitive.name in ("jit", "pjit") and has_matrix_products(equation.params["jaxpr"].jaxpr)


def _perturb(value, number: int, shares):
    if not jnp.issubdtype(jnp.result_type(value), jnp.inexact):
        return value
    shape = np.shape(value)[-1:]
    pattern = _stored_pattern if math.prod(shape) <= MAX_STORED_PATTERN_LENGTH else _generated_pattern
    errors = [
        share * pattern(shape, (number + PERTURBATION_SAMPLES * i) % PATTERNS_PER_SHAPE)
        for i, share in enumerate(shares)
    ]
    return value + (value * sum(errors[1:], errors[0])).astype(jnp.result_type(value))  # single precision stays so


@functools.cache
def _stored_pattern(shape: tuple[int, ...], number: int) -> np.ndarray:
    """Numbers of size one half to one and either sign."""
    random = np.random.default_rng(number)
    return random.uniform(0.5, 1.0, shape) * random.choice([-1.0, 1.0], shape)


def _generated_pattern(shape: tuple[int, ...], number: int) -> jax.Array:
    """The like from a product that overflows the digits of a sine, entry by entry."""
    v = 43758.5453 * jnp.sin(12.9898 * jnp.arange(1.0, shape[0] + 1.0) + 78.233 * number)
    v = 2.0 * (v - jnp.floor(v)) - 1.0
    return jnp.where(v < 0.0, -0.5, 0.5) + 0.5 * v
