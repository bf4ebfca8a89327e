"""Scalar programs of jaxprs agree with JAX to rounding, for every primitive.

The effect of rounding is measured: see :mod:`tests.scalar_programs`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.ad_checkpoint import checkpoint_name

import manifolds as mf
from liethermo.tracing.primitives import UNROLLING_RULES
from liethermo.tracing.program import ScanLoop
from liethermo.tracing.scalarize import CONTROL_FLOW_RULES, scalarize
from liethermo.tracing.searches import iterate_equations
from manifolds.matrices.exponential import expm
from manifolds.matrices.linear import solve
from tests.cases import EPS
from tests.machine_code import compile_program
from tests.scalar_programs import check_agrees_with_jax, check_outputs, jax_values, program_of, real_and_imaginary

rng = np.random.default_rng(0)


# -- every primitive --------------------------------------------------------------------------------------------------

x, y = rng.uniform(0.2, 0.9, (2, 3)), rng.uniform(-2.0, 2.0, (2, 3))
v, w, c3 = rng.standard_normal(3), rng.standard_normal(5), rng.standard_normal((2, 3, 4))
square = rng.standard_normal((3, 3))
spd = square @ square.T + np.eye(3)
c300 = rng.uniform(0.5, 1.0, 300)
NARROW_INTEGERS = (jnp.uint8, jnp.int8, jnp.uint16, jnp.int16, jnp.uint32, jnp.int32, jnp.int64)


@jax.custom_vjp
def doubled_with_wrong_derivative(a):
    return 2.0 * a


doubled_with_wrong_derivative.defvjp(lambda a: (2.0 * a, None), lambda _, g: (3.0 * g,))


def scatter(operand, updates, mode):
    numbers = lax.ScatterDimensionNumbers((), (0,), (0,))
    return lax.scatter_add(operand, np.array([[0], [2], [7], [0]]), updates, numbers, mode=mode)


def value_and_derivative(f):
    """Return a function that computes f and its derivative along a fixed direction."""
    return lambda *args: jax.jvp(f, args, tuple(jnp.cos(3.0 * a) for a in args))


UNARY = """
neg abs sign sqrt rsqrt cbrt exp exp2 expm1 log log1p sin cos tan asin acos atan sinh cosh tanh asinh atanh logistic erf
erfc square floor ceil
"""
BINARY = "add sub mul div max min atan2 rem"
COMPARISONS = "eq ne lt le gt ge"
unary = {name: (value_and_derivative(getattr(lax, name)), x) for name in UNARY.split()}
binary = {name: (value_and_derivative(getattr(lax, name)), y, x) for name in BINARY.split()}
comparisons = {name: (getattr(lax, name), np.round(y), np.round(2 * x)) for name in COMPARISONS.split()}
truth_operations = {
    name + "_": (lambda a, b, op=name: getattr(lax, f"bitwise_{op}")(a > 0.5, b > 0.0), x, y)
    for name in ("and", "or", "xor")
}

hermitian = spd[:2, :2] + 1j * (square - square.T)[:2, :2]


def drop_phases(vectors):
    """Return the moduli of eigenvectors, whose phases are arbitrary."""
    return jnp.abs(vectors)


newton = lambda a: lax.while_loop(  # noqa: E731 - a square root, in as many passes as it takes
    lambda s: jnp.max(jnp.abs(s[1] * s[1] - a)) > 1e-12, lambda s: (s[0] + 1, 0.5 * (s[1] + a / s[1])), (0, a)
)
large_matrix = rng.standard_normal((5, 5)) + 3.0 * np.eye(5)

SPECTRAL = {
    "eigh": (lambda a: [jnp.linalg.eigvalsh(a), drop_phases(jnp.linalg.eigh(a)[1])], spd),
    "eigh, derivative": (
        value_and_derivative(lambda a: [jnp.linalg.eigvalsh(a), drop_phases(jnp.linalg.eigh(a)[1])]),
        spd,
    ),
    "eigh, complex": (
        lambda a: [jnp.linalg.eigvalsh(a + hermitian), drop_phases(jnp.linalg.eigh(a * (1 + 0j) + hermitian)[1])],
        spd[:2, :2],
    ),
    "lu": (
        value_and_derivative(lambda a, b: [jnp.linalg.inv(a), jnp.linalg.solve(a, b), *jnp.linalg.slogdet(a)]),
        square,
        v,
    ),
    "lu, larger": (value_and_derivative(lambda a, b: [jnp.linalg.solve(a, b), jnp.linalg.det(a)]), large_matrix, w),
    "lu, of a zero column": (lambda a: jax.scipy.linalg.lu(jnp.outer(a, a).at[:, 0].set(0.0)), v),
    "lu, complex": (lambda a, b: real_and_imaginary(jnp.linalg.solve(a + 1j * a.T, b + 0j)), square, v),
    "qr": (
        value_and_derivative(lambda a: [*jnp.linalg.qr(a), *jnp.linalg.qr(a[:, :2]), *jnp.linalg.qr(a[:2])]),
        square,
    ),
    "qr, complete": (lambda a: jnp.linalg.qr(a[:, :2], mode="complete"), square),
    "qr, complex": (lambda a: [z for q in jnp.linalg.qr(a + 1j * a.T) for z in real_and_imaginary(q)], square),
    "svd": (value_and_derivative(lambda a: [jnp.linalg.svd(a, compute_uv=False), jnp.linalg.pinv(a[:2])]), square),
    "svd, vectors": (lambda a: [drop_phases(z) for z in jnp.linalg.svd(a[:2], full_matrices=True)[::2]], square),
    "svd, complex": (lambda a: jnp.linalg.svd(a + 1j * a.T)[1], square),
    "cholesky, complex": (
        lambda a: real_and_imaginary(jnp.linalg.cholesky(a + hermitian + 9.0 * jnp.eye(2))),
        spd[:2, :2],
    ),
    "expm": (jax.scipy.linalg.expm, square),
    "expm, own, derivative": (value_and_derivative(expm), square),
    "spectral": (lambda a: mf.spectral(jnp.log, a), spd),
    "spectral, derivative": (value_and_derivative(lambda a: mf.spectral(jnp.sqrt, a)), spd),
    "dot_general, as a loop": (value_and_derivative(lambda a: jnp.kron(a, a) @ jnp.sin(jnp.kron(a, a))), square),
    "dot_general, complex": (lambda a: real_and_imaginary(jnp.kron(a, a + 1j) @ jnp.exp(1j * jnp.kron(a, a))), square),
    "sort": (value_and_derivative(lambda a: [jnp.sort(a), jnp.sort(a)[::-1], jnp.median(a)]), w),
    "sort, with keys": (lambda a, b: [jnp.argsort(a), jnp.lexsort((a, jnp.round(b))), jnp.sort(b, axis=0)], w, w[::-1]),
    "sort, of special values": (jnp.sort, np.array([np.nan, 1.0, -np.inf, np.nan, -0.0, 2.0, np.inf])),
    "sort, of many": (lambda a: [jnp.sort(jnp.outer(a, a).ravel()), jnp.argsort(jnp.outer(a, a).ravel() > 0)], w),
    "truth values, compared": (
        lambda a: [
            jnp.argmax(a > 0),
            jnp.argmin(a > 0),
            jnp.sort(a > 0),
            lax.cummax((a > 0).astype(int)),
            *(comparison(a > 0, a[::-1] > 0) for comparison in (lax.lt, lax.le, lax.gt, lax.ge, lax.eq, lax.ne)),
            jnp.select([a < -1.0, a < 0.0, a < 1.0], [a**2, a**3, a**4], a),
            jnp.mean(a > 0),
        ],
        w,
    ),
    "lt_to, le_to": (
        lambda a: [lax.lt_to_p.bind(a, a[::-1]), lax.le_to_p.bind(a, a[::-1]), jnp.searchsorted(a[1:], a[:1])],
        np.array([np.nan, -0.0, 1.0, 0.0, 2.0]),
    ),
    "conv_general_dilated": (
        value_and_derivative(
            lambda a, b: [
                jnp.convolve(a, b),
                jnp.convolve(a, b, mode="same"),
                lax.conv_general_dilated(a[None, None], b[None, None], (2,), [(1, 2)], (2,), (2,))[0, 0],
            ]
        ),
        w,
        v,
    ),
    "lgamma": (value_and_derivative(lax.lgamma), 2.5 + x),
    "digamma": (value_and_derivative(lax.digamma), 3.0 * x),
    "polygamma": (lambda a: [jax.scipy.special.polygamma(n, a) for n in (1, 2, 4)], 3.0 * x),
    "zeta": (lambda a: jax.scipy.special.zeta(2.0 + a, 1.5), x),
    "erf_inv": (value_and_derivative(lax.erf_inv), x),
    "bessel_i0e": (value_and_derivative(lax.bessel_i0e), y),
    "bessel_i1e": (value_and_derivative(lax.bessel_i1e), y),
    "bessel_jn": (lambda a: jax.scipy.special.bessel_jn(a, v=2), np.array([1.3])),
    "igamma": (lambda a: lax.igamma(2.0 * a, a), x),
    "igammac": (lambda a: lax.igammac(2.0 * a, a), x),
    "regularized_incomplete_beta": (lambda a: lax.betainc(2.0 * a, a, 0.5 * a), x),
}

COMPLEX = {
    "complex": (
        lambda a, b: (
            [
                part
                for f in (
                    jnp.exp,
                    jnp.log,
                    jnp.sqrt,
                    jnp.sin,
                    jnp.cos,
                    jnp.sinh,
                    jnp.cosh,
                    jnp.tanh,
                    jnp.tan,
                    jnp.log1p,
                    jnp.expm1,
                    lambda z: lax.complex(z.real, -z.real),
                    jnp.conj,
                    jnp.sign,
                    jnp.square,
                    jnp.sum,
                    jnp.prod,
                    jax.nn.sigmoid,
                    lambda z: 1.0 / z,
                    lambda z: z**-3,
                    lambda z: z ** (0.5 + 0.2j),
                    lambda z: -z,
                    lambda z: z[::-1].T,
                )
                for part in real_and_imaginary(f(a + 1j * b))
            ]
            + [jnp.abs(a + 1j * b), a + 0j == b, a + 0j != b]
        ),
        x,
        y,
    ),
    "complex, derivative": (
        value_and_derivative(lambda a, b: [jnp.abs(jnp.exp(a + 1j * b)), jnp.real((a + 1j * b) ** 3)]),
        x,
        y,
    ),
    "complex, moved": (
        lambda a: [
            *real_and_imaginary(jnp.where(a > 0.5, a * 1j, a)),
            *real_and_imaginary((a * 1j).at[0].set(2.0)[jnp.argmax(a[:, 0])]),
        ],
        x,
    ),
}

LOOPS = {
    "while": (lambda a: newton(a), x),
    "while, derivative": (lambda a: jax.jacfwd(lambda b: newton(b)[1])(a), x),
    "while, several at once": (lambda a: jax.vmap(lambda b: newton(b)[0] + b.sum())(a), x),
    "while, of nothing": (lambda a: lax.while_loop(lambda s: s[0] < 0, lambda s: (s[0] + 1, s[1] * a), (3, a)), x),
    "while, inside a branch": (lambda a: lax.cond(a[0, 0] > 9.0, lambda b: b, lambda b: newton(b)[1], a), x),
    "while, in a while": (
        lambda a: lax.while_loop(lambda s: s.sum() < 30.0, lambda s: newton(s)[1] ** 2 + newton(s)[1], 1.0 + a), x),
    "fori_loop": (lambda a: lax.fori_loop(0, 2 + jnp.argmax(a[0]), lambda i, s: jnp.sin(s) + i * a, a), x),
    "scan, long": (
        jax.grad(lambda a: jnp.sum(lax.scan(lambda c, t: (0.2 * jnp.sin(c @ a) + t, c[0] * t), a, c300)[1])),
        square,
    ),
    "scan, long, of truths": (
        lambda a: [
            jnp.sum(z) for z in lax.scan(lambda c, t: (jnp.sin(c @ a) / 3, (c > 0.1 * t, jnp.argmax(c[0]))), a, c300)[1]
        ],
        square,
    ),
    "scan, long, backwards": (
        lambda a: lax.scan(lambda c, t: (0.2 * jnp.cos(c @ a) * t, c[0]), a, c300, reverse=True)[1][::99], square),
}  # fmt: skip

INDICES = {
    "gather, among many": (
        lambda a: [
            jnp.interp(a, jnp.linspace(-3.0, 3.0, 40), jnp.sin(jnp.linspace(-3.0, 3.0, 40))),
            jnp.outer(a, a).ravel()[jnp.argsort(a)],
            (jnp.outer(a, a).ravel() > 0.0)[5 * jnp.argsort(a)],
        ],
        w,
    ),
    "gather, at run time": (
        value_and_derivative(
            lambda a, b: [
                b[jnp.argmax(a)], b[jnp.argsort(a)[:3]], b[-jnp.argmin(a)], jnp.take(b, jnp.argmax(a) + 9, mode="fill"),
                jnp.interp(a[:2], jnp.array([-2.0, -0.5, 0.3, 2.0]), b[:4]), jnp.diag(jnp.outer(a, b))[jnp.argmin(a)],
                jnp.take_along_axis(jnp.outer(a, b), jnp.argsort(jnp.outer(b, a), axis=1), 1),
            ]
        ), w, w[::-1].copy(),
    ),
    "dynamic_slice, at run time": (
        lambda a: [lax.dynamic_slice(jnp.outer(a, a), (jnp.argmax(a), 1), (2, 2)), a[jnp.argmin(a)]], w),
    "dynamic_update_slice, at run time": (
        lambda a: lax.dynamic_update_slice(jnp.outer(a, a), jnp.ones((2, 2)), (jnp.argmax(a) - 9, jnp.argmin(a))), w),
    "scatter, at run time": (
        value_and_derivative(lambda a, b: [
            a.at[jnp.argmax(b)].set(b[0]), a.at[jnp.argsort(b)[:2]].set(b[:2]), a.at[jnp.argmax(b) + 9].set(1.0),
            jnp.outer(a, b).at[jnp.argmin(a), 1:3].add(b[:2]), a.at[jnp.argmax(b)].mul(b[1]),
            a.at[jnp.argmax(b) - 9].set(3.0, mode="clip"),
        ]), w, w[::-1].copy(),
    ),
    "integers at run time": (
        lambda a: [
            z
            for i in [jnp.argmax(a) - 2]
            for z in (i // 2, i % 3, lax.div(i, jnp.argmin(a) - 1), abs(i), jnp.sign(i), i * i - 7, -i, i & 3,
                      jnp.minimum(i, 1),
                      lax.rem(i, jnp.argmin(a) - jnp.argmin(a)), lax.div(i, jnp.argmin(a) - jnp.argmin(a)))
        ], w,
    ),
    "numbers that become narrow integers": (
        lambda a: [number.astype(t) for number in (300.0 * a, jnp.float32(300.0 * a)) for t in NARROW_INTEGERS],
        np.array([-1.9, -0.003, 0.5, 3.0, 1e30, -1e30, np.inf, -np.inf, np.nan, 0.0]),
    ),
    "integers of a few bits": (
        lambda a: [f((128.0 * a).astype(jnp.int8)) for f in (abs, jnp.negative, lambda i: (9 * i).astype(jnp.uint8))],
        np.array([-1.0, 1.0, 0.3, -200.0]),
    ),
    "integers that wrap around": (
        lambda a: [(1e9 * a).astype(jnp.int32) * 7, (1e9 * jnp.abs(a)).astype(jnp.uint32) * jnp.uint32(11)], w),
    "scatter, applying a function": (
        lambda a, b: [
            a.at[2].apply(jnp.sin), a.at[jnp.argmax(b)].apply(lambda z: z * z + 1.0), a.at[1:3].apply(jnp.cos),
            a.at[np.array([0, 9])].apply(jnp.exp), a.at[jnp.argmax(b) + 9].apply(jnp.exp),
            *real_and_imaginary((a * 1j).at[1].apply(jnp.exp)), (a > 0).at[1].apply(jnp.logical_not),
        ], w, w[::-1].copy(),
    ),
    "gather, that fills": (
        lambda a: [
            z
            for i in [jnp.argmax(a) + jnp.array([0, 4])]
            for z in (a.at[i].get(mode="fill", fill_value=0), a.at[i].get(mode="fill"),
                      (9.0 * a).astype(jnp.int16).at[i].get(mode="fill"), (a * 1j).at[i].get(mode="fill").imag,
                      jnp.abs(9.0 * a).astype(jnp.uint8).at[i].get(mode="fill"), (a > 0).at[i].get(mode="fill"))
        ], w,
    ),
    "scatter, derivative at a narrow index": (
        jax.grad(lambda a: jnp.sum(jnp.sin(a.at[jnp.abs(3.0 * a[0]).astype(jnp.uint8)].set(a[1])))), w,
    ),
    "empty2": (jax.grad(lambda a: lax.cond(a[0] > 0.0, lambda b: b[0] ** 2, lambda b: 2 * b[1], a)), w),
}  # fmt: skip

CASES = {
    **COMPLEX,
    **LOOPS,
    **INDICES,
    **unary,
    **binary,
    **comparisons,
    "and": truth_operations["and_"],
    "or": truth_operations["or_"],
    "xor": truth_operations["xor_"],
    "acosh": (value_and_derivative(lax.acosh), 1.0 + x),
    "pow": (value_and_derivative(lax.pow), x, y),
    "pow, by integers": (
        lambda a, b: [a ** jnp.sum(a > b), a ** jnp.argsort(b[0]), (1j + a[0]) ** jnp.argsort(a[0])][:2],
        x,
        y,
    ),
    "max, of truth values": (lambda a: [jnp.maximum(a > 0, a < 1), jnp.minimum(a > 0, a < 1)], y),
    "dot_general, mixed": (
        value_and_derivative(
            lambda a, b: [
                jnp.dot(a > 0.5, b.T),
                jnp.einsum("ij,ij->", b, a > 0.5),
                jnp.einsum("ij,j->i", b, jnp.arange(3)),
                1.0 * jnp.dot(a > 0.5, (b > 0).T),
                jnp.einsum("i,i->", jnp.argsort(b[0]), b[1]),
                jnp.abs(jnp.einsum("i,i->", a[0] > 0.5, b[0] + 1j)),
            ]
        ),
        x,
        y,
    ),
    "rev, of a number": (lambda a: [jnp.flip(a[0, 0], ()), lax.rev(a[0, 0] > 0, ()), lax.slice(a[0, 0], (), ())], y),
    "pow by a number": (lambda a: [lax.pow(a, p) for p in (-3.0, -1.0, 0.0, 0.5, 2.0, 3.0, 7.0)], x),
    "integer_pow": (lambda a: [lax.integer_pow(a, n) for n in (-5, -1, 0, 1, 2, 3, 7, 15)], y),
    "add_any": (jax.grad(lambda a: jnp.sum(a * jnp.sin(a))), x),
    "not": (lambda a: lax.bitwise_not(a > 0.0), y),
    "is_finite": (lambda a: jnp.isfinite(jnp.log(a)), y),
    "clamp": (value_and_derivative(lambda a: lax.clamp(-0.5, a, 0.7)), y),
    "round": (
        lambda a: [lax.round(a, r) for r in lax.RoundingMethod],
        np.array([-2.5, -0.5, 0.5 - EPS / 4, 1.5, 2.51, 1e20]),
    ),
    "select_n": (
        value_and_derivative(lambda a, b: [jnp.where(a > b, a, b), lax.select_n(jnp.int64(2) * (b > 0), a, b, a * b)]),
        y,
        x,
    ),
    "convert_element_type": (
        lambda a: [a.astype(int), (a > 0).astype(float), a.astype(bool), jnp.sum(a > 0) * 1.0],
        np.array([-2.7, 0.0, 3.9, 1e30, -1e30, np.inf, np.nan]),
    ),
    "stop_gradient": (jax.grad(lambda a: jnp.sum(lax.stop_gradient(a) * a)), x),
    "copy": (lambda a: jnp.array(a, copy=True) + a, x),
    "name": (lambda a: checkpoint_name(a, "a"), x),
    "optimization_barrier": (lambda a: lax.optimization_barrier((a, 2.0 * a)), x),
    "reduce_sum": (lambda a: [a.sum(), a.sum(axis=(0, 2)), a[:0].sum(axis=0)], c3),
    "reduce_prod": (lambda a: [a.prod(), a.prod(axis=1), a[:0].prod(axis=0)], c3),
    "reduce_prod, derivative": (value_and_derivative(lambda a: a.prod(axis=1)), c3),
    "reduce_max": (value_and_derivative(lambda a: [a.max(), a.max(axis=1)]), c3),
    "reduce_min": (value_and_derivative(lambda a: [a.min(), a.min(axis=0)]), c3),
    "reduce_and": (lambda a: [jnp.all(a > -1.0, axis=1), jnp.all(a[:0] > 0.0)], c3),
    "reduce_or": (lambda a: [jnp.any(a > 1.0, axis=0), jnp.any(a[:0] > 0.0)], c3),
    "argmax": (lambda a: [jnp.argmax(a), jnp.argmax(a, axis=1), jnp.argmax(jnp.log(a), axis=0)], c3),
    "argmin": (lambda a: [jnp.argmin(a), jnp.argmin(jnp.round(a), axis=2), jnp.argmin(jnp.log(a), axis=1)], c3),
    "cumsum": (value_and_derivative(lambda a: [jnp.cumsum(a, axis=1), lax.cumsum(a, axis=2, reverse=True)]), c3),
    "cumprod": (lambda a: [jnp.cumprod(a, axis=0), lax.cumprod(a, axis=1, reverse=True)], c3),
    "cumprod, derivative": (value_and_derivative(lambda a: jnp.cumprod(a, axis=1)), c3),
    "cummax": (lambda a: [lax.cummax(a, axis=1), lax.cummax(a, axis=2, reverse=True)], c3),
    "cummin": (lambda a: lax.cummin(a, axis=1), c3),
    "dot_general": (
        lambda a, b: [
            jnp.einsum("ijk,ijl->ikl", a, a),
            jnp.einsum("ijk,jk->i", a, a[0]),
            b @ b.T,
            jnp.outer(b[0], b[1]),
            jnp.einsum("ijk,ij->ik", a, b),
        ],
        c3,
        x,
    ),
    "broadcast_in_dim": (lambda a: jnp.broadcast_to(a[:, None], (2, 2, 3)), x),
    "reshape": (lambda a: [a.reshape(3, 2), lax.reshape(a, (3, 2), (1, 0))], x),
    "squeeze": (lambda a: lax.squeeze(a[:1], (0,)), x),
    "transpose": (lambda a: a.transpose(2, 0, 1), c3),
    "rev": (lambda a: lax.rev(a, (0, 2)), c3),
    "slice": (lambda a: [a[1:], a[:, ::2, 1:3]], c3),
    "split": (lambda a: jnp.split(a, [1, 3], axis=2), c3),
    "concatenate": (lambda a, b: jnp.concatenate([a, b, 2.0 * a], axis=1), x, y),
    "stack": (lambda a, b: [jnp.stack([a, b], axis=i) for i in range(3)], x, y),
    "unstack": (lambda a: [*lax.unstack(a, axis=1), *lax.unstack(a[0, 0])], c3),
    "tile": (lambda a: [jnp.tile(a, (2, 1, 3)), jnp.tile(a, 2)], x),
    "pad": (lambda a: [lax.pad(a, 7.0, c) for c in [((1, 2, 0), (0, 1, 2)), ((-1, 1, 1), (2, -2, 0))]], x),
    "iota": (lambda a: a * lax.broadcasted_iota(jnp.float64, (2, 3), 1), x),
    "platform_index": (
        lambda a: lax.platform_dependent(a, cpu=jnp.sin, cuda=jnp.cos, default=jnp.tan),
        x,
    ),
    "dynamic_slice": (lambda a: [lax.dynamic_slice(a, (i, jnp.int64(1)), (1, 2)) for i in (-1, 0, 5)], x),
    "places in an array of no axes": (
        lambda a: (lax.dynamic_slice(a[0, 0], (), ()), a[0, 0].at[...].set(2 * a[0, 1]), a[0, 0].at[...].add(a[0, 1])),
        x,
    ),
    "dynamic_update_slice": (lambda a, b: [lax.dynamic_update_slice(a, b[:1, :2], (i, 2)) for i in (0, 5)], x, y),
    "gather": (
        value_and_derivative(
            lambda a: [
                a[np.array([2, 0, 2])],
                a[:, None][np.array([[1, -1]])],
                a.at[np.array([1, 9])].get(mode="fill", fill_value=0.5),
            ]
        ),
        v,
    ),
    "scatter": (lambda a, b: [a.at[np.array([0, 4])].set(b[:2]), a.at[1:3].set(9.0)], w, v),
    "scatter-add": (
        value_and_derivative(
            lambda a, b: [scatter(a, b, mode) for mode in ("drop", "clip")] + [a.at[np.array([1, 1, 3])].add(b[:3])]
        ),
        w,
        rng.standard_normal(4),
    ),
    **{
        f"scatter-{name}": (lambda a, b, method=method: getattr(a.at[np.array([3, 1, 3])], method)(b), w, v)
        for name, method in {"sub": "subtract", "mul": "multiply", "min": "min", "max": "max"}.items()
    },
    "cholesky": (value_and_derivative(lambda a: jnp.linalg.cholesky(jnp.stack([a, 2 * a, -a]))), spd),
    "triangular_solve": (
        lambda a, b: [
            lax.linalg.triangular_solve(
                a, b if left else b.T, left_side=left, lower=lower, transpose_a=flip, unit_diagonal=unit
            )
            for left in (True, False)
            for lower in (True, False)
            for flip in (True, False)
            for unit in (True, False)
        ],
        square,
        rng.standard_normal((3, 2)),
    ),
    **SPECTRAL,
    "custom_linear_solve": (jax.grad(lambda a: solve(a, spd).sum()), square),
    "jit": (jax.jit(lambda a: jnp.sin(a)), x),
    "custom_jvp_call": (jax.nn.softplus, y),
    "custom_vjp_call": (
        lambda a: [doubled_with_wrong_derivative(a), jax.grad(lambda b: doubled_with_wrong_derivative(b).sum())(a)],
        x,
    ),
    "remat2": (jax.grad(jax.checkpoint(lambda a: jnp.sin(jnp.sin(a)).sum())), x),
    "cond": (
        lambda a: [
            *(lax.cond(a[0] > s, lambda b: (jnp.sin(b), b), lambda b: (b, 1 / b), a) for s in (-9.0, 9.0)),
            *(lax.switch(i, [jnp.sin, jnp.cos, jnp.tan], a) for i in (-1, 1, 5)),
        ],
        v,
    ),
    "scan": (
        jax.grad(lambda a: jnp.polyval(a, 0.7) + lax.scan(lambda s, b: (s * b, s + b), 1.0, a, reverse=True)[1] @ a),
        w,
    ),
}

UNTRACED_PRIMITIVES = {
    "inverse": "the equations of a step are solved with it, where Newton's method is traced",
    "deferred": "a step leaves with it to the engine what Newton's method is to find",
    "expand_dims": "lax writes it as broadcast_in_dim",
    "copy_p": "the name of copy in some versions of JAX",
    "pjit": "the name of jit in earlier versions",
    "call": "only other libraries' transformations make it",
    "closed_call": "only other libraries' transformations make it",
    "core_call": "only other libraries' transformations make it",
    "checkpoint": "the name of remat2 in earlier versions",
    "remat": "the name of remat2 in earlier versions",
}
"""Supported primitives that no case uses, with the reason."""


def primitives_in(jaxpr) -> set[str]:
    return {eqn.primitive.name for eqn, _ in iterate_equations(jaxpr)}


@pytest.mark.sampled(20)
@pytest.mark.parametrize("name", CASES)
def test_every_primitive_agrees(name):
    """The program agrees with JAX, and its machine code with the program."""
    f, *args = CASES[name]
    program = check_agrees_with_jax(f, *args)
    check_outputs(program, args, program.evaluate(*args), compile_program(program)(*args))


def test_single_precision_is_rounded_as_such():
    """Results agree to one unit in the last place of float32, as XLA divides by multiplying with the reciprocal."""

    def f(a):
        single = jnp.float32(a)
        return [single * 2.0, a * jnp.float32(0.1), single / jnp.float32(3), jnp.sum(single), jnp.exp(single)]

    program = program_of(f, w)
    for outputs in (program.evaluate(w), compile_program(program)(w)):
        for output, expected in zip(outputs, jax_values(f, w), strict=True):
            assert np.abs(output - expected).max() <= 2 * np.finfo(np.float32).eps * max(
                np.abs(w).max(), expected.max()
            )
    double_program, single = (
        program_of(lambda a: a * 1.1, w),
        program_of(lambda a: jnp.float32(a) * jnp.float32(1.1), w),
    )
    assert np.abs(double_program.evaluate(w)[0] - single.evaluate(w)[0]).max() > 1e-9, "a control: it is rounded"


def test_a_long_loop_is_not_unrolled():
    def f(a):
        return jax.grad(lambda b: lax.scan(lambda c, t: (jnp.sin(c @ b) / 3 + t, c[0]), b, c300)[1].sum())(a)

    program = program_of(f, square)
    assert len(program.instructions) < 200
    assert {str(op) for op in program.operation_counts} >= {
        "scan",
        "column",
    }  # the backward loop reads the stacked results


def test_a_table_that_a_loop_looks_up_is_made_once():
    """The table is made outside of the loop; made in each pass, it would cost as much as all passes."""
    rows = jnp.asarray(np.random.default_rng(0).standard_normal((40, 3)))

    def f(w, a):
        return lax.fori_loop(0, 40, lambda i, c: c + jnp.sin(w[i] @ a), 0.0)

    a = jnp.array([0.3, 1.0, -0.5])
    program = scalarize(jax.make_jaxpr(f)(rows, a))
    loops = [i.op for i in program.instructions if isinstance(i.op, ScanLoop)]
    assert [i.op for loop in loops for i in loop.body.instructions].count("lookup") == 3
    assert not any(i.op == "table" for loop in loops for i in loop.body.instructions)
    points = np.stack([a, 2.0 * a])
    (outputs,) = program.evaluate(np.stack([rows, rows]), points, batch=True)
    np.testing.assert_allclose(outputs, [f(rows, point) for point in points], rtol=1e-14)


def test_every_rule_is_tested():
    traced_primitives = set().union(*(primitives_in(jax.make_jaxpr(f)(*args).jaxpr) for f, *args in CASES.values()))
    rules = set(UNROLLING_RULES) | set(CONTROL_FLOW_RULES)
    untested, unknown = rules - traced_primitives - set(UNTRACED_PRIMITIVES), set(UNTRACED_PRIMITIVES) - rules
    assert not untested, f"add a function that uses it to CASES: {sorted(untested)}"
    assert not unknown, f"no rule has this name in UNTRACED_PRIMITIVES: {sorted(unknown)}"
    assert not traced_primitives & set(UNTRACED_PRIMITIVES)


SPECIAL_NUMBERS = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.0, 1e200, -1e200, 1e-200])


@pytest.mark.sampled(12)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "cbrt" else ())  # unoptimised XLA has an error of 1e-14
        for name in (*UNARY.split(), "acosh", "is_finite", "round", "clamp")
    ],
)
def test_special_values_of_one_argument(name):
    f = CASES[name][0] if name in ("round", "clamp", "is_finite") else getattr(lax, name)
    check_agrees_with_jax(f, SPECIAL_NUMBERS)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", [*BINARY.split(), *COMPARISONS.split(), "pow"])
def test_special_values_of_two_arguments(name):
    check_agrees_with_jax(
        getattr(lax, name),
        np.repeat(SPECIAL_NUMBERS, len(SPECIAL_NUMBERS)),
        np.tile(SPECIAL_NUMBERS, len(SPECIAL_NUMBERS)),
    )
