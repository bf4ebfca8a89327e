"""Comparison of scalar programs with JAX, to their rounding error, which is measured.

A program is evaluated repeatedly with every result perturbed by a few units in its last place; the spread of the
outputs is the effect of rounding. A decision that rounding can change (``floor`` of an integer) shows as a wide spread.
"""

import jax
import jax.numpy as jnp
import numpy as np

from liethermo.tracing.builder import implementation
from liethermo.tracing.program import Program
from liethermo.tracing.scalarize import scalarize
from tests.cases import EPS

EPS_SINGLE = float(np.finfo(np.float32).eps)
"""Spacing of float32 numbers at 1."""

SMALLEST_NORMAL = np.finfo(np.float64).tiny
"""Smallest normal float64 number."""


def program_of(f, *args, **options) -> Program:
    return scalarize(jax.make_jaxpr(f)(*map(jnp.asarray, args)), **options)


def jax_values(f, *args) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(jax.jit(f)(*args))]


def evaluate_perturbed(program: Program, args, seed: int, perturb_zeros: bool = False) -> list[np.ndarray]:
    """Evaluate a program with every instruction's result perturbed by up to four units in its last place.

    With ``perturb_zeros``, zeros get a random sign, as a structural zero has none; subnormal numbers become zero for
    even seeds, as XLA rounds them to zero on some processors; and float32 numbers are perturbed by units in their last
    place.
    """
    rng = np.random.default_rng(seed)

    def perturb(value, eps=EPS):
        if not isinstance(value, tuple | list) and np.asarray(value).dtype == np.float64:
            value = value * (1.0 + eps * rng.uniform(-4, 4, np.shape(value)))
            if perturb_zeros:
                subnormal = np.abs(value) < SMALLEST_NORMAL
                value = np.where(subnormal & (seed % 2 == 0), 0.0, value)
                value = np.where(value == 0.0, rng.choice([0.0, -0.0], np.shape(value)), value)[()]
        return value

    entries = np.concatenate([np.ravel(x) for x in args]).astype(np.float64)
    names = sum(program.inputs, ())
    inputs = [perturb(a) if perturb_zeros and abs(a) < SMALLEST_NORMAL else a for a in entries]
    values = dict(zip(names, inputs, strict=True))
    with np.errstate(all="ignore"):
        for target, op, operands in program.instructions:
            result = implementation(op)(*(values[a] if isinstance(a, str) else a for a in operands))
            values[target] = perturb(result, EPS_SINGLE if perturb_zeros and op == "single" else EPS)
    return [np.array([values[a] if isinstance(a, str) else a for a in row], float) for row in program.outputs]


def check_outputs(
    program: Program,
    args,
    expected: list[np.ndarray],
    outputs=None,
    hidden_nan: bool = False,
    perturb_zeros: bool = False,
    slack: float = 8.0,
) -> None:
    """Assert that a program gives the expected outputs: numbers to rounding, NaN and infinity at the same entries.

    With ``hidden_nan``, a number is accepted where JAX has NaN, because a structural zero times NaN is zero. Outputs
    after such a number are not compared: they may be computed from it.
    """
    outputs = program.evaluate(*args) if outputs is None else outputs
    assert [a.shape for a in outputs] == [a.shape for a in expected]
    runs = [evaluate_perturbed(program, args, seed, perturb_zeros) for seed in range(6)]
    for i, (reference, output) in enumerate(zip(expected, outputs, strict=True)):
        reference, output = reference.astype(float).ravel(), output.astype(float).ravel()
        perturbations = np.array([run[i] for run in runs])
        is_stable = (number_class(perturbations) == number_class(output)).all(axis=0)
        with np.errstate(all="ignore"):
            spread = np.abs(perturbations - output).max(axis=0)
            is_close = np.abs(output - reference) <= slack * spread + 2 * slack * EPS * np.abs(reference) + 1e-300
        agrees = np.where(
            np.isfinite(reference),
            is_close,
            hidden_nan & np.isnan(reference) | (number_class(reference) == number_class(output)),
        )
        is_wrong = ~agrees & is_stable
        assert not is_wrong.any(), (
            f"output {i}: {output[is_wrong]} is not {reference[is_wrong]}, spread {spread[is_wrong]}"
        )
        if (np.isnan(reference) & ~np.isnan(output)).any():
            return


def number_class(a):
    """Return 0 for a finite number, 1 for infinity, -1 for minus infinity, 2 for NaN."""
    return np.where(np.isinf(a), np.sign(a), 0.0) + 2 * np.isnan(a)


def check_agrees_with_jax(f, *args, **options) -> Program:
    program = program_of(f, *args)
    check_outputs(program, args, jax_values(f, *args), **options)
    return program


def real_and_imaginary(z):
    return [jnp.real(z), jnp.imag(z)]
