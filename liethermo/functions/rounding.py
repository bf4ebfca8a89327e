"""Rounding errors of a function, estimated where they arise.

A bound relative to the result, or to the state, is wrong if large terms cancel: the heat between two bodies of
temperature 1 is rounded like 1 however small it is, and their entropies, the logarithms of 1, vanish. Here each result
of the arithmetic inside the function is perturbed, and the perturbation of the final result is measured [stochastic
arithmetic: Vignes 1993].
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

from ..tracing.searches import has_large_matrix_products

EXACT_PRIMITIVES = frozenset(
    """abs broadcast_in_dim ceil clamp concatenate convert_element_type copy copy_p copysign dynamic_slice
    dynamic_update_slice expand_dims floor gather imag iota max min neg pad real reduce_max reduce_min reshape rev round
    select_n sign slice sort split squeeze stop_gradient transpose""".split()
)
"""Primitives without rounding error."""

JAXPR_PARAMETERS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
"""Parameters of equations that hold a jaxpr."""
CONTROL_PRIMITIVES = frozenset({"cond", "scan", "while"})
"""Primitives whose inner programs are not perturbed; only their results are."""

MAX_RELATIVE_PERTURBATION = 2.0**-36
"""Largest perturbation relative to a result: far above rounding, and small enough for perturbations to add up."""

PERTURBATION_SAMPLES = 3
"""Number of perturbed evaluations; in one of them, the errors of two instructions may cancel."""

PATTERNS_PER_SHAPE = 8
"""Number of perturbation patterns for each shape; a program stores them, so they are few."""

MAX_STORED_PATTERN_LENGTH = 10_000
"""Largest length of a pattern that is stored as a constant; longer ones are generated at run time."""


def value_and_rounding_scale(function: Callable, x) -> tuple[jax.Array, jax.Array]:
    """Return ``function(x)`` and its rounding scale: the error of each entry is about eps times its scale.

    Parameters
    ----------
    function : function from an array to an array, shape (...)

    Returns
    -------
    two arrays, shape (...)
        The scale is zero if a perturbed result is not finite.
    """
    closed_jaxpr = jax.make_jaxpr(function)(x)

    def evaluate_perturbed(amplitudes):
        perturbation = Perturbation(amplitudes, itertools.count())
        return _evaluate_perturbed(closed_jaxpr.jaxpr, closed_jaxpr.consts, [x], perturbation)[0]

    # vectorised samples compile faster; large arrays are mapped one by one to save memory, and so are functions that
    # contain routines, such as networks, which all samples then share
    can_vectorise = np.size(x) <= MAX_STORED_PATTERN_LENGTH and not any(map(_is_routine_call, closed_jaxpr.jaxpr.eqns))
    map_samples = jax.vmap(evaluate_perturbed) if can_vectorise else functools.partial(jax.lax.map, evaluate_perturbed)
    results = map_samples(np.eye(PERTURBATION_SAMPLES + 1, PERTURBATION_SAMPLES, -1) * MAX_RELATIVE_PERTURBATION)
    exact_result, perturbed_results = results[0], results[1:]
    rounding_scale = jnp.max(jnp.abs(perturbed_results - exact_result), axis=0) / MAX_RELATIVE_PERTURBATION
    return exact_result, jnp.where(jnp.isfinite(rounding_scale), rounding_scale, 0.0)


def propagated_rounding_scale(function: Callable, x, input_scales) -> jax.Array:
    """Return the scale at which ``function(x)`` is rounded, to first order, if x is rounded too.

    Infinitesimal perturbations do not change any decision of the function: a jump does not count as rounding.

    Parameters
    ----------
    function : function from an array, shape (n,), to a number
    input_scales : array, shape (n,)
        The components of x are known to about eps times these scales.
    """
    closed_jaxpr = jax.make_jaxpr(function)(x)

    def evaluate_perturbed(amplitudes):
        perturbation = Perturbation(amplitudes, itertools.count())
        perturbed_x = x + input_scales * perturbation.next_errors(input_scales.shape)
        return _evaluate_perturbed(closed_jaxpr.jaxpr, closed_jaxpr.consts, [perturbed_x], perturbation)[0]

    zero_amplitudes = jnp.zeros(PERTURBATION_SAMPLES)
    derivatives = [
        jax.jvp(evaluate_perturbed, (zero_amplitudes,), (direction,))[1] for direction in jnp.eye(PERTURBATION_SAMPLES)
    ]
    return jnp.max(jnp.abs(jnp.stack(derivatives)))


class Perturbation:
    """Small random relative errors, one array for each result of a program.

    Arrays of one shape repeat after :data:`PATTERNS_PER_SHAPE` results, and a program computes each of them once.

    Parameters
    ----------
    amplitudes : array, shape (PERTURBATION_SAMPLES,)
        Each of them is the amplitude of a pattern of its own; the errors are their sum.
    result_numbers : iterator
        It numbers the results, also across the routines of a program.
    """

    def __init__(self, amplitudes, result_numbers: Iterator[int]):
        self.amplitudes, self.result_numbers = amplitudes, result_numbers
        self._errors: dict[tuple, jax.Array] = {}

    def next_errors(self, shape: tuple[int, ...]) -> jax.Array:
        """Return the errors of the next result, shape ``shape[-1:]``: its rows have the same errors."""
        key = shape[-1:], next(self.result_numbers) % PATTERNS_PER_SHAPE
        if key not in self._errors:
            self._errors[key] = self._sum_of_patterns(*key)
        return self._errors[key]

    def _sum_of_patterns(self, shape: tuple[int, ...], pattern_number: int) -> jax.Array:
        """Return the sum of random arrays of a shape, each times its amplitude."""
        pattern = _stored_random_numbers if math.prod(shape) <= MAX_STORED_PATTERN_LENGTH else _pseudorandom_numbers
        errors = [
            amplitude * pattern(shape, (pattern_number + PERTURBATION_SAMPLES * i) % PATTERNS_PER_SHAPE)
            for i, amplitude in enumerate(self.amplitudes)
        ]
        return sum(errors[1:], errors[0])


def _evaluate_perturbed(jaxpr: Jaxpr, constants, arguments, perturbation: Perturbation) -> list:
    """Return the results of a jaxpr in which the result of each equation has a relative error."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))
    for equation in jaxpr.eqns:
        inputs = [v.val if isinstance(v, Literal) else values[v] for v in equation.invars]
        name, parameters = equation.primitive.name, equation.params
        inner = next((parameters[key] for key in JAXPR_PARAMETERS if key in parameters), None)
        if isinstance(inner, ClosedJaxpr) and name not in CONTROL_PRIMITIVES and not _is_iteration(equation):
            if _is_routine_call(equation):
                # Errors of its own: arrays of this program are not known inside the routine.
                routine = jax.jit(
                    lambda inputs, amplitudes, i=inner: _evaluate_perturbed(
                        i.jaxpr, i.consts, inputs, Perturbation(amplitudes, perturbation.result_numbers)
                    )
                )
                results = routine(inputs, perturbation.amplitudes)
            else:
                results = _evaluate_perturbed(inner.jaxpr, inner.consts, inputs, perturbation)
        else:
            bind_params = equation.primitive.get_bind_params(parameters)
            # older versions of JAX return (functions, parameters)
            functions, parameters = bind_params if isinstance(bind_params, tuple) else ((), bind_params)
            results = equation.primitive.bind(*functions, *inputs, **parameters)
            results = results if equation.primitive.multiple_results else [results]
            if name not in EXACT_PRIMITIVES:
                results = [_perturb(value, perturbation) for value in results]
        values.update(zip(equation.outvars, results, strict=True))
    return [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars]


def _is_routine_call(equation) -> bool:
    """Return whether an equation calls a function with products of matrices, which is a routine in machine code."""
    return equation.primitive.name in ("jit", "pjit") and has_large_matrix_products(equation.params["jaxpr"].jaxpr)


def _is_iteration(equation) -> bool:
    """Return whether an equation calls a function that iterates, as functions of matrices do.

    Perturbed iterations do not converge to rounding, and such functions then return NaN.
    """
    if equation.primitive.name != "custom_jvp_call":
        return False
    return any(inner.primitive.name in ("scan", "while") for inner in equation.params["call_jaxpr"].jaxpr.eqns)


def _perturb(value, perturbation: Perturbation):
    """Return a value with the next relative errors added to its entries; numbers that are not floats as they are."""
    if not jnp.issubdtype(jnp.result_type(value), jnp.inexact):
        return value
    # single precision is preserved
    return value + (value * perturbation.next_errors(np.shape(value))).astype(jnp.result_type(value))


@functools.cache
def _stored_random_numbers(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Return an array of random numbers of modulus 0.5 to 1 and random sign, the same at each call with a seed."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 1.0, shape) * rng.choice([-1.0, 1.0], shape)


def _pseudorandom_numbers(shape: tuple[int, ...], seed: int) -> jax.Array:
    """Return a vector of pseudorandom numbers of modulus 0.5 to 1, from fractional parts of multiples of a sine."""
    v = 43758.5453 * jnp.sin(12.9898 * jnp.arange(1.0, shape[0] + 1.0) + 78.233 * seed)
    v = 2.0 * (v - jnp.floor(v)) - 1.0
    return jnp.where(v < 0.0, -0.5, 0.5) + 0.5 * v
