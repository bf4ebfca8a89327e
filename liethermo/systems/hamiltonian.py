"""The Hamiltonian of a quantum system as users write it, with QuTiP's time-dependent form, as a mean energy."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf

from ..dissipation.operators import HasMatrix, checked_hermitian, checked_square_matrix
from ..errors import InputError
from ..functions.density import ExpectationValue, MeanEnergy, ModulatedExpectationValue, choose_reference_level
from ..functions.energy import Energy, TimeDependent
from ..functions.piecewise import ContinuedSpline
from .invariants import TEST_TIMES


def hamiltonian_energy(hamiltonian, times=None) -> tuple[int, Energy]:
    """Return the number of levels of a Hamiltonian, and the energy ``tr(rho H)`` as a function of coordinates."""
    if isinstance(hamiltonian, list | tuple) and any(map(_is_hamiltonian_term, hamiltonian)):
        return _energy_of_terms(hamiltonian, times)
    if callable(hamiltonian) and not isinstance(hamiltonian, HasMatrix):
        if isinstance(_value_at_time(hamiltonian, TEST_TIMES[0], "the Hamiltonian"), HasMatrix):
            raise InputError(
                f"the Hamiltonian is a {type(hamiltonian).__name__} that returns a Qobj, which JAX cannot trace. Give "
                "its terms, [H0, [H1, f]], with a function f of jax.numpy, or with an array of its values and times="
            )
        matrices = [
            checked_hermitian(_value_at_time(hamiltonian, t, "the Hamiltonian"), f"the Hamiltonian at t = {t:.3g}")
            for t in TEST_TIMES
        ]
        structure = mf.DensityMatrices(len(matrices[0]))
        with jax.ensure_compile_time_eval():  # a number, while a family of systems is traced
            lowest = jnp.asarray(np.diag(matrices[0]).real.min())
        return structure.size, TimeDependent(ExpectationValue(hamiltonian, structure, lowest))
    if isinstance(hamiltonian, jax.core.Tracer):
        structure = mf.DensityMatrices(hamiltonian.shape[-1])
        return structure.size, MeanEnergy(structure.vector(hamiltonian), jnp.min(jnp.diag(hamiltonian).real))
    H = checked_hermitian(checked_square_matrix(hamiltonian, "the Hamiltonian"), "the Hamiltonian")
    with jax.ensure_compile_time_eval():  # numbers, while a family of systems is traced
        b = jnp.asarray(mf.DensityMatrices(len(H)).vector(H))
        reference = jnp.asarray(choose_reference_level(np.diag(H).real))
    return len(H), MeanEnergy(b, reference)


def _value_at_time(function, t: float, what: str):
    """Return the value of a function of time at t.

    Raises
    ------
    InputError
        If the function does not accept one argument.
    """
    try:
        inspect.signature(function).bind(t)
    except TypeError as error:
        raise InputError(f"{what}, where it is a function, is one of the time t alone: {error}") from None
    except ValueError:  # the signature is not known
        pass
    return function(t)


def _is_hamiltonian_term(term) -> bool:
    """Return whether a term of a list is a matrix, or begins with one, and is not a row of numbers."""
    if isinstance(term, list | tuple):
        return bool(term) and (isinstance(term[0], list | tuple) or _is_hamiltonian_term(term[0]))
    return isinstance(term, HasMatrix) or np.ndim(term) == 2


def _energy_of_terms(terms: Sequence, times) -> tuple[int, Energy]:
    """Return the number of levels and the energy of a Hamiltonian ``[H0, (H1, f), ...]``, ``H0 + f(t) H1 + ...``."""
    constant: list[np.ndarray] = []
    modulated: list[np.ndarray] = []
    functions = []
    for i, term in enumerate(terms):
        is_pair = isinstance(term, list | tuple) and len(term) == 2 and _is_hamiltonian_term(term[0])
        H, f = term if is_pair else (term, None)
        f = f if f is None or callable(f) else _coefficient_function(f, times, i)
        if isinstance(H, list | tuple) and H and _is_hamiltonian_term(H[0]):
            raise InputError(f"term {i} of the Hamiltonian is a matrix, or a pair of a matrix and a function of t")
        H = checked_hermitian(H, f"term {i} of the Hamiltonian")
        if H.shape != (first_matrix := (constant + modulated + [H])[0]).shape:
            raise InputError(
                f"term {i} of the Hamiltonian has shape {H.shape}, but another term has shape {first_matrix.shape}"
            )
        if f is None:
            constant.append(H)
            continue
        value = _value_at_time(f, TEST_TIMES[0], f"the second of term {i} of the Hamiltonian")
        if np.shape(value) or jnp.result_type(value).kind not in "fiu":
            raise InputError(f"the function of term {i} of the Hamiltonian gives a real number, not {value!r}")
        modulated.append(H)
        functions.append(f)
    if times is not None and not any(isinstance(f, ContinuedSpline) for f in functions):
        raise InputError("times= belongs to coefficients that are arrays, and the Hamiltonian has none. Remove times=")
    structure = mf.DensityMatrices(len(H))
    with jax.ensure_compile_time_eval():  # numbers, while a family of systems is traced
        matrices = (sum(constant, np.zeros_like(H)), *modulated)
        static, *rows = (jnp.asarray(structure.vector(a)) for a in matrices)
        reference = jnp.asarray(choose_reference_level(np.asarray(static)[: structure.size]))
    if not modulated:
        return structure.size, MeanEnergy(static, reference)
    initial = static
    for f, row in zip(functions, rows, strict=True):
        initial = initial + f(TEST_TIMES[0]) * row
    lowest = jnp.min(initial[: structure.size])  # works for traced functions too
    return structure.size, TimeDependent(ModulatedExpectationValue(static, tuple(rows), tuple(functions), lowest))


def _coefficient_function(coefficient, times, i: int) -> Callable:
    """Return a function of time that interpolates the values of a coefficient at ``times``."""
    if isinstance(coefficient, str):
        raise InputError(
            f"the coefficient of term {i} of the Hamiltonian is the string {coefficient!r}, which is not evaluated. "
            "Give a function of t, such as lambda t: jnp.cos(t)"
        )
    values = np.asarray(coefficient)
    if values.dtype.kind not in "fiu" or values.ndim != 1:
        raise InputError(
            f"term {i} of the Hamiltonian is a matrix, or a pair of a matrix and a function of t, or of a matrix and "
            f"an array of real numbers; its second entry is of type {type(coefficient).__name__}"
        )
    if times is None:
        raise InputError(f"the coefficient of term {i} of the Hamiltonian is an array, so it needs times=")
    knots = np.asarray(times, dtype=np.float64)
    if knots.shape != values.shape or knots.size < 4 or not (np.diff(knots) > 0.0).all():
        raise InputError(
            f"times must be at least 4 increasing numbers, one for each value of a coefficient, got the shapes "
            f"{knots.shape} and {values.shape}"
        )
    return ContinuedSpline(scipy.interpolate.CubicSpline(knots, values))  # as QuTiP interpolates it
