"""Compare scalar programs with JAX, to rounding, which is measured.

A program is run again with every result moved by a few units in its last place: the spread of the outputs is the effect
that rounding can have. A branch that rounding can turn (``floor`` of an integer) shows as a wide spread.
"""

import jax
import jax.numpy as jnp
import numpy as np

from liethermo.tracing.builder import implementation
from liethermo.tracing.program import Program
from liethermo.tracing.scalarize import scalarize
from tests.cases import EPS

EPS_SINGLE = float(np.finfo(np.float32).eps)

SMALLEST_NORMAL = np.finfo(np.float64).tiny


def program_of(f, *args, **options) -> Program:
    return scalarize(jax.make_jaxpr(f)(*map(jnp.asarray, args)), **options)


def jax_values(f, *args) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(jax.jit(f)(*args))]


def perturbed_outputs(program: Program, args, seed: int, composed: bool = False) -> list[np.ndarray]:
    """Return the outputs when every instruction's result is off by up to four units in its last place.

    With ``composed``, zeros get any sign, as a structural zero has none, and subnormal numbers become zero in some
    runs, as XLA rounds them to zero on some processors; and numbers of single precision move by units in their last
    place.
    """
    noise = np.random.default_rng(seed)

    def perturb(value, eps=EPS):
        if not isinstance(value, tuple | list) and np.asarray(value).dtype == np.float64:
            value = value * (1.0 + eps * noise.uniform(-4, 4, np.shape(value)))
            if composed:
                subnormal = np.abs(value) < SMALLEST_NORMAL
                value = np.where(subnormal & (seed % 2 == 0), 0.0, value)
                value = np.where(value == 0.0, noise.choice([0.0, -0.0], np.shape(value)), value)[()]
        return value

    entries = np.concatenate([np.ravel(x) for x in args]).astype(np.float64)
    names = sum(program.inputs, ())
    inputs = [perturb(a) if composed and abs(a) < SMALLEST_NORMAL else a for a in entries]
    values = dict(zip(names, inputs, strict=True))
    with np.errstate(all="ignore"):
        for target, op, operands in program.instructions:
            result = implementation(op)(*(values[a] if isinstance(a, str) else a for a in operands))
            values[target] = perturb(result, EPS_SINGLE if composed and op == "single" else EPS)
    return [np.array([values[a] if isinstance(a, str) else a for a in row], float) for row in program.outputs]


def check(
    program: Program,
    args,
    expected: list[np.ndarray],
    found=None,
    hidden_nan: bool = False,
    composed: bool = False,
    slack: float = 8.0,
) -> None:
    """Raise unless a program gives the expected outputs: numbers to rounding, NaN and infinity where they belong.

    With ``hidden_nan`` a number may stand where JAX has NaN, as a structural zero times NaN is zero.
    """
    found = program.evaluate(*args) if found is None else found
    assert [a.shape for a in found] == [a.shape for a in expected]
    runs = [perturbed_outputs(program, args, seed, composed) for seed in range(6)]
    for i, (reference_entries, entries) in enumerate(zip(expected, found, strict=True)):
        reference_entries, entries = reference_entries.astype(float).ravel(), entries.astype(float).ravel()
        perturbed_entries = np.array([run[i] for run in runs])
        is_stable = (kind(perturbed_entries) == kind(entries)).all(axis=0)
        with np.errstate(all="ignore"):
            rounding_spread = np.abs(perturbed_entries - entries).max(axis=0)
            is_close = (
                np.abs(entries - reference_entries)
                <= slack * rounding_spread + 2 * slack * EPS * np.abs(reference_entries) + 1e-300
            )
        is_wrong = (
            ~np.where(
                np.isfinite(reference_entries),
                is_close,
                hidden_nan & np.isnan(reference_entries) | (kind(reference_entries) == kind(entries)),
            )
            & is_stable
        )
        assert not is_wrong.any(), (
            f"output {i}: {entries[is_wrong]} is not {reference_entries[is_wrong]}, spread {rounding_spread[is_wrong]}"
        )


def kind(a):
    """Return 0 for each number, 1 for infinity, -1 for minus infinity and 2 for NaN."""
    return np.where(np.isinf(a), np.sign(a), 0.0) + 2 * np.isnan(a)


def agrees(f, *args, **options) -> Program:
    program = program_of(f, *args)
    check(program, args, jax_values(f, *args), **options)
    return program
