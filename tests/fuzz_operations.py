"""Operations of random functions: every primitive that the scalar compiler supports, in various uses."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MAX_ENTRIES = 6
"""Largest number of entries of an intermediate array; more are cut off."""

INTEGER_DTYPES = {"i64": jnp.int64, "i32": jnp.int32, "i16": jnp.int16, "i8": jnp.int8}
INTEGER_DTYPES |= {"u8": jnp.uint8, "u16": jnp.uint16, "u32": jnp.uint32}

DTYPES = {"f": jnp.float64, "s": jnp.float32, "b": jnp.bool_, "i": jnp.int64, "c": jnp.complex128}


class Operation(NamedTuple):
    """A function ``function(*arrays, k)`` of arrays of given kinds, with a variant k from 0 to 5.

    The kinds are keys of DTYPES; ``"i"`` stands for any integers.
    """

    kinds: str
    function: Callable


def resize_like(b, a):
    """Return b in the shape of a."""
    return jnp.resize(b, a.shape)


def limit_size(a):
    """Return an array cut to at most MAX_ENTRIES entries and two axes."""
    a = a.reshape(-1, a.shape[-1]) if a.ndim > 2 else a
    if a.size <= MAX_ENTRIES:
        return a
    return a.ravel()[:MAX_ENTRIES] if a.ndim < 2 else a[:2, : MAX_ENTRIES // 2]


def vector(a, n: int = 4):
    return jnp.resize(a, (n,))


def matrix(a, n: int = 3):
    return jnp.resize(a, (n, n))


def bound_entries(a):
    """Return an array with entries of modulus at most 3."""
    return jnp.where(jnp.abs(a) < 3.0, a, jnp.tanh(jnp.where(jnp.isfinite(a), a, 1.0)))


def limit_modulus(a):
    """Replace finite numbers of modulus 100 or more, for which JAX's loops for ``igamma`` do not end."""
    return jnp.where((jnp.abs(a) < 100.0) | ~jnp.isfinite(a), a, 7.5)


def positive_definite(a):
    m = matrix(bound_entries(a))
    return m @ m.T + jnp.diag(jnp.array([2.0, 3.0, 5.0]))


def symmetric_with_distinct_eigenvalues(a):
    """Return a symmetric matrix with well separated eigenvalues."""
    m = 0.1 * matrix(bound_entries(a))
    return m + m.T + jnp.diag(jnp.array([1.0, 3.0, 6.0]))


def complex_from(a, b):
    return lax.complex(a, resize_like(b, a))


def index_modulo(i, n: int):
    return jnp.abs(i.astype(jnp.int64).ravel()[0]) % n


def unary(name: str):
    function = getattr(lax, name)
    return lambda a, k: function(a)


def binary(name: str):
    function = getattr(lax, name)
    return lambda a, b, k: function(a, resize_like(b, a).astype(a.dtype))


def choose_variant(*choices):
    """Return an operation that calls one of several functions, chosen by ``k``."""
    return lambda *arguments: choices[arguments[-1] % len(choices)](*arguments[:-1])


def indexed_operation(f):
    """Return an operation from ``f(vector, computed index, vector of values)``."""
    return lambda a, i, b, k: f(vector(a), i.astype(jnp.int64).ravel()[0] if k % 2 else index_modulo(i, 4), vector(b))


UNARY = """
neg abs sign sqrt rsqrt cbrt exp exp2 expm1 log log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh
logistic erf erfc square floor ceil
"""
BINARY = "add sub mul div max min atan2 rem pow"
COMPARISONS = "eq ne lt le gt ge"
UNARY_COMPLEX = "neg sign exp log log1p expm1 sqrt sin cos sinh cosh tanh tan square conj"
SCATTERS = ("set", "add", "subtract", "multiply", "min", "max")

OPERATIONS: dict[str, Operation] = {
    **{name: Operation("f", unary(name)) for name in UNARY.split()},
    **{name: Operation("ff", binary(name)) for name in BINARY.split()},
    **{f"{name} of {kind}": Operation(kind * 2, binary(name)) for name in COMPARISONS.split() for kind in "fibs"},
    # truth values
    "and": Operation("bb", lambda a, b, k: a & resize_like(b, a)),
    "or": Operation("bb", lambda a, b, k: a | resize_like(b, a)),
    "xor": Operation("bb", lambda a, b, k: a ^ resize_like(b, a)),
    "not": Operation("b", lambda a, k: ~a),
    "is_finite": Operation("f", lambda a, k: jnp.isfinite(a)),
    "max of truths": Operation(
        "bb", choose_variant(lambda a, b: lax.max(a, resize_like(b, a)), lambda a, b: lax.min(a, resize_like(b, a)))
    ),
    "all, any": Operation(
        "b", choose_variant(jnp.all, jnp.any, lambda a: jnp.argmax(a) > 1, lambda a: jnp.sort(vector(a)))
    ),
    "sum of truths": Operation("b", choose_variant(jnp.sum, jnp.mean, jnp.cumsum, jnp.prod, lambda a: jnp.max(a) * 2)),
    "product with truths": Operation(
        "bf",
        choose_variant(
            lambda a, b: jnp.dot(vector(a), vector(b)),
            lambda a, b: jnp.einsum("i,j->ij", vector(a, 2), vector(b, 2)),
            lambda a, b: vector(a) * vector(b),
            lambda a, b: vector(a) @ vector(a),
            lambda a, b: matrix(b, 2) @ vector(a, 2),
        ),
    ),
    "product with integers": Operation(
        "if",
        choose_variant(
            lambda a, b: jnp.dot(vector(a), vector(b)),
            lambda a, b: jnp.einsum("i,i->i", vector(a), vector(b)),
            lambda a, b: vector(b) ** vector(a),
            lambda a, b: vector(a) @ vector(a),
            lambda a, b: vector(a) * vector(b),
            lambda a, b: jnp.arctan2(vector(a), vector(b)),
            lambda a, b: jnp.ldexp(vector(b), jnp.clip(vector(a), -9, 9)),
        ),
    ),
    # integers
    **{
        f"{name} of integers": Operation("ii", binary(name))
        for name in "add sub mul max min div rem bitwise_and bitwise_or bitwise_xor".split()
    },
    "unary of integers": Operation(
        "i", choose_variant(lax.neg, jnp.abs, lax.sign, lax.square, lambda a: lax.integer_pow(a, 3))
    ),
    "sums of integers": Operation(
        "i",
        choose_variant(jnp.sum, jnp.prod, jnp.cumsum, jnp.max, jnp.argmin, lambda a: jnp.sort(vector(a)), jnp.argsort),
    ),
    "floor_divide": Operation(
        "ii",
        choose_variant(
            lambda a, b: a // resize_like(b, a).astype(a.dtype),
            lambda a, b: a % resize_like(b, a).astype(a.dtype),
            lambda a, b: jnp.where(a > resize_like(b, a), a, 3),
        ),
    ),
    "power of integers": Operation("i", lambda a, k: jnp.clip(a, -3, 3) ** (k % 4)),
    "clip of integers": Operation("i", lambda a, k: jnp.clip(a, -2, 5)),
    # conversions
    **{f"float to {name}": Operation("f", lambda a, k, t=t: a.astype(t)) for name, t in INTEGER_DTYPES.items()},
    **{f"single to {name}": Operation("s", lambda a, k, t=t: a.astype(t)) for name, t in INTEGER_DTYPES.items()},
    **{f"integer to {name}": Operation("i", lambda a, k, t=t: a.astype(t)) for name, t in INTEGER_DTYPES.items()},
    "scaled to integers": Operation(
        "f", lambda a, k: (100.0 * a).astype([jnp.int8, jnp.uint8, jnp.int16, jnp.uint16, jnp.int32, jnp.uint32][k])
    ),
    "integer to float": Operation("i", lambda a, k: a.astype(jnp.float64)),
    "integer to single": Operation("i", lambda a, k: a.astype(jnp.float32)),
    "truth to float": Operation("b", lambda a, k: a.astype(jnp.float64)),
    "truth to integer": Operation("b", lambda a, k: a.astype(list(INTEGER_DTYPES.values())[k])),
    "to truth": Operation("f", lambda a, k: a.astype(bool)),
    "integer to truth": Operation("i", lambda a, k: a.astype(bool)),
    "to single": Operation("f", lambda a, k: a.astype(jnp.float32)),
    "from single": Operation("s", lambda a, k: a.astype(jnp.float64)),
    # single precision
    "unary of single": Operation("s", choose_variant(lax.neg, lax.abs, lax.sign, lax.square, lax.floor, lax.sqrt)),
    "binary of single": Operation(
        "ss",
        choose_variant(
            *(lambda a, b, f=f: f(a, resize_like(b, a)) for f in (lax.add, lax.sub, lax.mul, lax.max, lax.min))
        ),
    ),
    "sum of single": Operation("s", choose_variant(jnp.sum, jnp.max, lambda a: jnp.sort(vector(a)))),
    # complex numbers
    "complex": Operation("ff", lambda a, b, k: complex_from(a, b)),
    "to complex": Operation("f", lambda a, k: a.astype(jnp.complex128)),
    **{f"complex {name}": Operation("c", unary(name)) for name in UNARY_COMPLEX.split()},
    **{f"complex {name}": Operation("cc", binary(name)) for name in "add sub mul div".split()},
    "complex power": Operation(
        "c", choose_variant(lambda a: lax.integer_pow(a, 3), lambda a: lax.integer_pow(a, -2), lambda a: a**0.5)
    ),
    "from complex": Operation("c", choose_variant(jnp.real, jnp.imag, jnp.abs)),
    "complex moved": Operation(
        "cc",
        choose_variant(
            lambda a, b: jnp.where(jnp.real(a) > 0, a, resize_like(b, a)),
            lambda a, b: vector(a) @ vector(b),
            lambda a, b: jnp.sum(a),
            lambda a, b: jnp.prod(vector(a, 3)),
            lambda a, b: a == resize_like(b, a),
            lambda a, b: vector(a)[::-1],
        ),
    ),
    # choices
    "where": Operation(
        "bff",
        choose_variant(
            lambda b, x, y: jnp.where(resize_like(b, x), x, resize_like(y, x)),
            lambda b, x, y: jnp.where(resize_like(b, x), x, 0.0),
            lambda b, x, y: jnp.where(resize_like(b, x), 1.0 / x, resize_like(y, x)),
        ),
    ),
    "select_n": Operation(
        "iff",
        lambda i, x, y, k: lax.select_n(jnp.abs(resize_like(i, x)).astype(jnp.int32) % 3, x, resize_like(y, x), x * x),
    ),
    "clamp": Operation(
        "fff",
        lambda a, b, c, k: lax.clamp(resize_like(b, a), a, resize_like(c, a)) if k % 2 else jnp.clip(a, -0.5, 1.0),
    ),
    "round": Operation(
        "f", choose_variant(jnp.round, lambda a: lax.round(a, lax.RoundingMethod.AWAY_FROM_ZERO), jnp.trunc, jnp.rint)
    ),
    "cond": Operation(
        "bf",
        choose_variant(
            lambda b, a: lax.cond(b.ravel()[0], lambda z: jnp.sin(z) * z, lambda z: 2.0 * z, a),
            lambda b, a: lax.cond(
                b.ravel()[0], lambda z: z, lambda z: jnp.exp(jnp.sin(z)) - jnp.cos(z**3) / (1 + z * z), a
            ),
            lambda b, a: lax.cond(
                jnp.any(b),
                lambda z: z[..., None] if z.ndim < 2 else z,
                lambda z: (z * z)[..., None] if z.ndim < 2 else -z,
                a,
            ),
        ),
    ),
    "switch": Operation(
        "if", lambda i, a, k: lax.switch(i.ravel()[0].astype(jnp.int32), [jnp.sin, jnp.abs, lambda z: z * z - 1], a)
    ),
    # indices
    "take": Operation("f", lambda a, k: a[k % a.shape[0]] if a.ndim else a),
    "gather": Operation("f", lambda a, k: a[np.array([0, -1, k % a.shape[0]])] if a.ndim else a),
    "at an index": Operation("fi", lambda a, i, k: vector(a)[i.ravel()[0]] if k % 2 else vector(a)[index_modulo(i, 4)]),
    "at indices": Operation("fi", lambda a, i, k: vector(a).at[vector(i, 3)].get(mode=["fill", "clip", None][k % 3])),
    "argsorted": Operation("f", lambda a, k: vector(a)[jnp.argsort(vector(a))]),
    "take_along": Operation(
        "ff", lambda a, b, k: jnp.take_along_axis(matrix(a, 2), jnp.argsort(matrix(b, 2), axis=1), k % 2)
    ),
    "truths at an index": Operation("bi", lambda a, i, k: vector(a)[i.ravel()[0]]),
    "integers at an index": Operation(
        "ii", lambda a, i, k: vector(a).at[i.ravel()[0]].get(mode=["fill", "clip", None][k % 3])
    ),
    **{
        f"scatter {name}": Operation("fif", indexed_operation(lambda a, i, b, name=name: getattr(a.at[i], name)(b[0])))
        for name in SCATTERS
    },
    **{
        f"scatter {name} at indices": Operation(
            "fif",
            lambda a, i, b, k, name=name: getattr(vector(a).at[vector(i, 2)], name)(
                vector(b, 2), mode=["drop", "clip"][k % 2]
            ),
        )
        for name in ("set", "add", "multiply", "max")
    },
    "apply at": Operation("f", lambda a, k: lax.stop_gradient(vector(a)).at[k % 4].apply(jnp.sin)),
    "apply at an index": Operation(
        "fi", lambda a, i, k: lax.stop_gradient(vector(a)).at[index_modulo(i, 4)].apply(lambda z: z * z + 1)
    ),
    "set of integers": Operation("ii", lambda a, i, k: vector(a).at[index_modulo(i, 4)].add(7)),
    "set of truths": Operation("bi", lambda a, i, k: vector(a).at[index_modulo(i, 4)].set(True)),
    "dynamic_slice": Operation(
        "fi", lambda a, i, k: lax.dynamic_slice(vector(a), (i.ravel()[0].astype(jnp.int32),), (2,))
    ),
    "dynamic_update_slice": Operation(
        "fif", lambda a, i, b, k: lax.dynamic_update_slice(vector(a), vector(b, 2), (i.ravel()[0].astype(jnp.int32),))
    ),
    "interp": Operation(
        "f", lambda a, k: jnp.interp(a, jnp.array([-2.0, -0.5, 0.0, 1.0]), jnp.array([1.0, -1.0, 3.0, 0.5]))
    ),
    "searchsorted": Operation("f", lambda a, k: jnp.searchsorted(jnp.array([-1.0, 0.0, 0.0, 2.0]), a)),
    # arrangement
    "flip": Operation("f", choose_variant(jnp.flip, lambda a: jnp.flip(a.ravel()[0], ()), lambda a: a.T)),
    "flip of others": Operation(
        "ib",
        choose_variant(lambda i, b: jnp.flip(i), lambda i, b: jnp.flip(b), lambda i, b: jnp.flip(b.ravel()[0], ())),
    ),
    "transpose": Operation("f", lambda a, k: matrix(a, 2).T),
    "broadcast": Operation("f", lambda a, k: jnp.broadcast_to(a.ravel()[0], (k % 3 + 1,))),
    "expand, squeeze": Operation("f", lambda a, k: jnp.squeeze(jnp.expand_dims(a, 0), 0) if k % 2 else a[None]),
    "concatenate": Operation("ff", lambda a, b, k: jnp.concatenate([a.ravel()[k % a.size :], b.ravel()])),
    "stack": Operation("ff", lambda a, b, k: jnp.stack([vector(a, 3), vector(b, 3)], axis=k % 2)),
    "stack of scalars": Operation(
        "fbi",
        choose_variant(
            lambda a, b, i: jnp.stack([a.ravel()[0]] * 2),
            lambda a, b, i: jnp.stack([b.ravel()[0]] * 2),
            lambda a, b, i: jnp.stack([i.ravel()[0]] * 2),
        ),
    ),
    "unstack, split": Operation(
        "f",
        choose_variant(
            lambda a: jnp.unstack(vector(a))[2],
            lambda a: jnp.split(vector(a), 2)[1],
            lambda a: jnp.unstack(matrix(a, 2), axis=1)[0],
        ),
    ),
    "tile": Operation("f", lambda a, k: jnp.tile(a, k % 3 + 1)),
    "pad": Operation("f", lambda a, k: lax.pad(vector(a), 1.5, [(k - 2, 1, k % 2)])),
    "pad of integers": Operation("i", lambda a, k: lax.pad(vector(a), jnp.asarray(3, a.dtype), [(k - 2, 1, k % 2)])),
    "roll": Operation("f", lambda a, k: jnp.roll(a, k)),
    "slice": Operation("f", lambda a, k: a[..., :: k % 2 + 1] if a.ndim else a),
    "iota": Operation("f", lambda a, k: vector(a) * jnp.arange(4) + lax.broadcasted_iota(jnp.float64, (4,), 0)),
    "tril": Operation("f", lambda a, k: jnp.tril(matrix(a, 2), k - 2)),
    "diagonal": Operation(
        "f",
        choose_variant(lambda a: jnp.diag(matrix(a)), lambda a: jnp.diag(vector(a, 2)), lambda a: jnp.trace(matrix(a))),
    ),
    # reductions
    "reduce": Operation(
        "f",
        choose_variant(jnp.sum, jnp.prod, jnp.max, jnp.min, jnp.mean, lambda a: jnp.sum(a, axis=-1) if a.ndim else a),
    ),
    "argmax": Operation("f", choose_variant(jnp.argmax, jnp.argmin)),
    "cumulative": Operation("f", lambda a, k: (jnp.cumsum, jnp.cumprod, lax.cummax, lax.cummin)[k % 4](vector(a), 0)),
    "cumulative, reverse": Operation(
        "f", lambda a, k: (lax.cumsum, lax.cumprod, lax.cummax)[k % 3](vector(a), 0, reverse=True)
    ),
    "logsumexp": Operation(
        "f", choose_variant(jax.scipy.special.logsumexp, lambda a: jax.nn.softmax(vector(a)), jnp.linalg.norm)
    ),
    "sort": Operation(
        "f",
        choose_variant(
            lambda a: jnp.sort(vector(a)), jnp.median, lambda a: jnp.argsort(a), lambda a: jnp.sort(vector(a))[::-1]
        ),
    ),
    "lexsort": Operation("fi", lambda a, i, k: jnp.lexsort((vector(a), vector(i)))),
    "unique ties": Operation("f", lambda a, k: jnp.sum(vector(a)[:, None] == vector(a)[None, :], axis=1)),
    # products
    "matmul": Operation("ff", lambda a, b, k: matrix(a, 2) @ jnp.resize(b, (2, k % 3 + 1))),
    "einsum": Operation(
        "ff",
        choose_variant(
            lambda a, b: jnp.einsum("ij,j->i", matrix(a, 2), vector(b, 2)),
            lambda a, b: jnp.outer(vector(a, 2), vector(b, 3)),
            lambda a, b: jnp.einsum("ij,ij->j", matrix(a, 2), matrix(b, 2)),
            lambda a, b: jnp.cross(vector(a, 3), vector(b, 3)),
            lambda a, b: jnp.kron(vector(a, 2), vector(b, 2)),
            lambda a, b: jnp.vdot(a.ravel(), resize_like(b, a).ravel()),
        ),
    ),
    "convolve": Operation("ff", lambda a, b, k: jnp.convolve(vector(a, 3), vector(b, 2), mode=["full", "same"][k % 2])),
    "polyval": Operation("ff", lambda a, b, k: jnp.polyval(vector(a, 3), b)),
    # linear algebra
    "solve": Operation(
        "ff",
        choose_variant(
            lambda a, b: jnp.linalg.solve(positive_definite(a), vector(b, 3)),
            lambda a, b: jnp.linalg.inv(positive_definite(a))[0],
        ),
    ),
    "det": Operation(
        "f",
        choose_variant(
            lambda a: jnp.linalg.det(positive_definite(a)), lambda a: jnp.linalg.slogdet(positive_definite(a))[1]
        ),
    ),
    "eigh": Operation(
        "f",
        choose_variant(
            lambda a: jnp.linalg.eigvalsh(symmetric_with_distinct_eigenvalues(a)),
            lambda a: jnp.linalg.eigh(symmetric_with_distinct_eigenvalues(a))[1] ** 2,
        ),
    ),
    "svd": Operation("f", lambda a, k: jnp.linalg.svd(symmetric_with_distinct_eigenvalues(a), compute_uv=False)),
    "qr": Operation("f", lambda a, k: jnp.abs(jnp.diag(jnp.linalg.qr(positive_definite(a))[1]))),
    "cholesky": Operation("f", lambda a, k: jnp.diag(jnp.linalg.cholesky(positive_definite(a)))),
    "triangular_solve": Operation(
        "ff",
        lambda a, b, k: jax.scipy.linalg.solve_triangular(
            positive_definite(a), vector(b, 3), lower=bool(k % 2), trans=k // 2 % 2
        ),
    ),
    "expm": Operation("f", lambda a, k: jax.scipy.linalg.expm(0.3 * matrix(bound_entries(a), 2))),
    # loops
    "scan": Operation(
        "ff",
        choose_variant(
            lambda a, b: lax.scan(lambda c, t: (0.5 * jnp.sin(c) + t, c * t), jnp.float64(1.0), vector(a))[1],
            lambda a, b: lax.scan(lambda c, t: (c * t, c), a, vector(b, 3), reverse=True)[0],
            lambda a, b: lax.scan(lambda c, t: (jnp.where(c > t, c, t), c > t), jnp.float64(0.0), vector(a))[1],
            lambda a, b: lax.scan(lambda c, t: (0.9 * c + t * jnp.tanh(a), c.sum()), a, jnp.linspace(0.0, 1.0, 80))[1][
                ::20
            ],
        ),
    ),
    "fori_loop": Operation(
        "f",
        choose_variant(
            lambda a: lax.fori_loop(0, 3, lambda i, s: jnp.sin(s) + i, a),
            lambda a: lax.fori_loop(0, 40, lambda i, s: 0.9 * s + 0.1 * jnp.cos(s + i), a),
        ),
    ),
    "while": Operation(
        "f",
        choose_variant(
            lambda a: lax.while_loop(
                lambda s: jnp.sum(jnp.abs(s[1])) > 1.0, lambda s: (s[0] + 1, 0.5 * s[1]), (0, bound_entries(a))
            )[1],
            lambda a: lax.while_loop(
                lambda s: (s[0] < 5) & jnp.any(s[1] < 2.0), lambda s: (s[0] + 1, s[1] + 0.7), (0, a)
            )[1],
            lambda a: jax.vmap(lambda z: lax.while_loop(lambda s: jnp.abs(s) > 1.0, lambda s: 0.5 * s, z))(
                vector(bound_entries(a))
            ),
        ),
    ),
    "counted while": Operation(
        "f",
        lambda a, k: lax.while_loop(
            lambda s: jnp.sum(jnp.abs(s[1])) > 1.0, lambda s: (s[0] + 1, 0.5 * s[1]), (0, bound_entries(a))
        )[0],
    ),
    # calls
    "jit": Operation("f", lambda a, k: jax.jit(lambda z: jnp.sin(z) * z)(a)),
    "custom derivatives": Operation(
        "f", choose_variant(jax.nn.softplus, jax.nn.relu, jax.nn.gelu, jax.nn.silu, jax.nn.elu, jax.nn.log_sigmoid)
    ),
    "checkpoint": Operation("f", lambda a, k: jax.checkpoint(lambda z: jnp.sin(z) * z)(a)),
    "stop_gradient": Operation("f", lambda a, k: lax.stop_gradient(a) * a),
    "optimization_barrier": Operation("f", lambda a, k: lax.optimization_barrier(a) + 1.0),
    "mod": Operation(
        "f",
        choose_variant(
            lambda a: jnp.mod(a, 0.7),
            lambda a: jnp.floor_divide(a, 0.3),
            lambda a: jnp.fmod(a, 0.3),
            jnp.sinc,
            lambda a: jnp.hypot(a, 2.0),
            jnp.sign,
        ),
    ),
    "powers": Operation("f", lambda a, k: a ** [-3, -1, 0, 2, 3, 7][k]),
    "powers of halves": Operation("f", lambda a, k: a ** [-2.5, -0.5, 0.5, 1.5, 3.0, 4.0][k]),
    # special functions
    # JAX's values near the zeros 1 and 2 have errors of 2e-15, the rounding of terms of size 8 that cancel
    "8 + lgamma": Operation("f", lambda a, k: 8.0 + lax.lgamma(a)),
    "digamma": Operation("f", lambda a, k: lax.digamma(a)),
    "polygamma": Operation("f", lambda a, k: jax.scipy.special.polygamma(k % 4, a)),
    "zeta": Operation("ff", lambda a, b, k: lax.zeta(a, resize_like(b, a))),
    "erf_inv": Operation("f", lambda a, k: lax.erf_inv(a)),
    "bessel": Operation("f", choose_variant(lax.bessel_i0e, lax.bessel_i1e)),
    "igamma": Operation(
        "ff",
        lambda a, b, k: (lax.igamma, lax.igammac)[k % 2](
            lax.stop_gradient(limit_modulus(a)), limit_modulus(resize_like(b, a))
        ),
    ),
    "betainc": Operation("ff", lambda a, b, k: lax.betainc(1.5, 0.5 + k, limit_modulus(resize_like(b, a)))),
}
