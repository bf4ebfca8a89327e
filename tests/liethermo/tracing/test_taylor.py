"""Taylor arithmetic: recurrences against Cauchy's integral, nested functions, and refusals by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from liethermo.tracing.taylor import TaylorSeriesError, check_has_taylor_series, solution_taylor_coefficients

ORDER = 20

FUNCTIONS = {
    # name: (JAX function, complex function of NumPy or SciPy, point, radius of a circle on which it is analytic)
    "quotient": (lambda x: (1.0 + x) / (2.0 - x * x), lambda z: (1 + z) / (2 - z * z), 0.3, 0.8),
    "constant over": (lambda x: 3.0 / x, lambda z: 3 / z, 1.3, 0.9),
    "integer powers": (lambda x: x**5 + x**-3 + jnp.square(x), lambda z: z**5 + z**-3 + z**2, 1.3, 0.9),
    "power": (lambda x: x**2.5, lambda z: z**2.5, 1.3, 0.9),
    "whole powers as floats, near zero": (
        lambda x: x**3.0 - 2.0 * x**4.0 + x**0.0,
        lambda z: z**3 - 2 * z**4 + 1,
        1e-6,
        0.9,
    ),
    "whole powers as floats, at zero": (lambda x: x**3.0 + (1.0 + x) ** -2.0, lambda z: z**3 + (1 + z) ** -2, 0.0, 0.9),
    "powers of entries": (
        lambda x: jnp.sum(jnp.stack([x, x, 1.0 + x]) ** np.array([2.0, 5.0, 1.5])),
        lambda z: z**2 + z**5 + (1 + z) ** 1.5,
        0.0,
        0.9,
    ),
    "power by a parameter": (
        lambda x: jax.jit(lambda x, p: x**p)(x, jnp.array(3.0)),
        lambda z: z**3,
        0.0,
        0.9,
    ),
    "power of two series": (lambda x: (1.0 + x) ** jnp.sin(x), lambda z: (1 + z) ** np.sin(z), 0.3, 0.9),
    "power of a constant": (lambda x: 2.0**x, lambda z: 2**z, 0.3, 2.0),
    "exp": (jnp.exp, np.exp, 0.3, 2.0),
    "exp2": (jnp.exp2, lambda z: np.exp(z * np.log(2)), 0.3, 2.0),
    "expm1": (jnp.expm1, lambda z: np.exp(z) - 1, 0.3, 2.0),
    "log": (jnp.log, np.log, 1.3, 0.9),
    "log1p": (jnp.log1p, lambda z: np.log(1 + z), 0.3, 0.9),
    "sqrt": (jnp.sqrt, np.sqrt, 1.3, 0.9),
    "rsqrt": (jax.lax.rsqrt, lambda z: 1 / np.sqrt(z), 1.3, 0.9),
    "cbrt": (jnp.cbrt, lambda z: z ** (1 / 3), 1.3, 0.9),
    "logistic": (jax.nn.sigmoid, lambda z: 1 / (1 + np.exp(-z)), 0.3, 2.0),
    "sin and cos": (lambda x: jnp.sin(x) + 2.0 * jnp.cos(3.0 * x), lambda z: np.sin(z) + 2 * np.cos(3 * z), 0.3, 2.0),
    "tan": (jnp.tan, np.tan, 0.3, 0.9),
    "asin and acos": (lambda x: jnp.arcsin(x) + 2 * jnp.arccos(x), lambda z: np.arcsin(z) + 2 * np.arccos(z), 0.1, 0.7),
    "atan": (jnp.arctan, np.arctan, 0.3, 0.9),
    "atan2": (lambda x: jnp.arctan2(x, 2.0 + x * x), lambda z: np.arctan(z / (2 + z * z)), 0.3, 0.8),
    "sinh and cosh": (lambda x: jnp.sinh(x) + 2.0 * jnp.cosh(x), lambda z: np.sinh(z) + 2 * np.cosh(z), 0.3, 2.0),
    "tanh": (jnp.tanh, np.tanh, 0.3, 1.2),
    "asinh": (jnp.arcsinh, np.arcsinh, 0.3, 0.8),
    "acosh": (jnp.arccosh, np.arccosh, 2.5, 1.3),
    "atanh": (jnp.arctanh, np.arctanh, 0.1, 0.7),
    "erf and erfc": (
        lambda x: jax_special_function(x, "erf") + 2.0 * jax_special_function(x, "erfc"),
        lambda z: scipy.special.erf(z) + 2 * scipy.special.erfc(z),
        0.3,
        2.0,
    ),
    "product of entries": (
        lambda x: jnp.prod(jnp.stack([x, jnp.sin(x), jnp.exp(x)])),
        lambda z: z * np.sin(z) * np.exp(z),
        0.3,
        2.0,
    ),
    "matrices": (
        lambda x: jnp.einsum("ij,jk,k->i", rotation(x), rotation(2.0 * x), jnp.array([1.0, 2.0]))[1],
        lambda z: np.sin(3 * z) + 2 * np.cos(3 * z),
        0.3,
        1.5,
    ),
    "elimination": (
        lambda x: jnp.linalg.solve(
            jnp.array([[2.0, 1.0], [0.0, 1.0]]) + x * jnp.array([[0.0, 1], [1, 3]]), one_and_x(x)
        )[0],
        lambda z: ((1 + 3 * z) - (1 + z) * z) / (2 * (1 + 3 * z) - z * (1 + z)),
        0.3,
        0.5,
    ),
    "substitution": (
        lambda x: jax.scipy.linalg.solve_triangular(
            jnp.array([[1.0, 9.0], [0.0, 2.0]]).T + x * jnp.eye(2), one_and_x(x), lower=True
        )[1],
        lambda z: (z - 9 / (1 + z)) / (2 + z),
        0.3,
        0.9,
    ),
    "Cholesky": (
        lambda x: jnp.linalg.cholesky(jnp.array([[2.0, 1.0], [1.0, 3.0]]) + x * jnp.array([[1.0, 0.3], [0.3, 2.0]]))[
            1, 1
        ],
        lambda z: np.sqrt(3 + 2 * z - (1 + 0.3 * z) ** 2 / (2 + z)),
        0.3,
        0.8,
    ),
    "scan": (
        lambda x: jax.lax.scan(lambda y, k: (jnp.sin(y) * x + k, y), x, jnp.arange(3.0), reverse=True)[0],
        lambda z: np.sin(np.sin(np.sin(z) * z + 2) * z + 1) * z,
        0.3,
        0.7,
    ),
    "rows of a scan": (
        lambda x: jnp.sum(jax.lax.scan(lambda y, k: (y * k, y + x), x, jnp.stack([x, 2.0 * x]))[1]),
        lambda z: 4 * z + (z * z - z),
        0.3,
        1.5,
    ),
    "cond": (
        lambda x: jax.lax.cond(x > 0.0, jnp.sin, jnp.cos, x),
        np.sin,
        0.3,
        2.0,
    ),
    "where, beyond what is not finite": (
        lambda x: jnp.where(x < 1.0, jnp.exp(x), jnp.log(jnp.where(x < 1.0, 1.0, x - 1.0))),
        np.exp,
        0.3,
        2.0,
    ),
    "where one has a kink as a test alone": (
        lambda x: jnp.where(jnp.abs(x) < 1e-3, 0.0, jnp.sin(x) / x),
        lambda z: np.sin(z) / z,
        1.3,
        1.0,
    ),
    "moved entries": (
        lambda x: jnp.pad(jnp.roll(jnp.stack([x, x * x, 1.0 + x**3]), 1)[::-1], (1, 2)).at[2].add(jnp.exp(x))[2],
        lambda z: z + np.exp(z),
        0.3,
        2.0,
    ),
    "complex numbers": (
        lambda x: jnp.real(jnp.exp(1j * x) * jnp.conj(jnp.exp(2j * x))),
        np.cos,
        0.3,
        2.0,
    ),
}


def jax_special_function(x, name):
    return getattr(jax.scipy.special, name)(x)


def rotation(angle):
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])


def one_and_x(x):
    return jnp.stack([jnp.ones(()), x])


def cauchy_coefficients(function, point, radius, count=1024):
    """Return coefficients times powers of the radius, from values on a circle by the discrete Fourier transform."""
    circle = point + radius * np.exp(2j * np.pi * np.arange(count) / count)
    return (np.fft.fft(function(circle)) / count).real[:ORDER]


def test_recurrences_agree_with_cauchy_integrals():
    """Solve ``x' = 1, y' = F(x)``; errors are relative to the largest term on the circle."""
    points = np.array([point for _, _, point, _ in FUNCTIONS.values()])

    def field(state):
        values = [function(state[i]) for i, (function, *_) in enumerate(FUNCTIONS.values())]
        return jnp.concatenate([jnp.ones(len(points)), jnp.stack(values)])

    coefficients = jax.jit(lambda x: solution_taylor_coefficients(field, x, 1.0, ORDER))(
        jnp.concatenate([points, jnp.zeros(len(points))])
    )
    coefficients = np.asarray(coefficients)[:, len(points) :] * np.arange(1, ORDER + 1)[:, None]
    for series, (name, (_, complex_function, point, radius)) in zip(coefficients.T, FUNCTIONS.items(), strict=True):
        expected = cauchy_coefficients(complex_function, point, radius)
        error = np.abs(series * radius ** np.arange(ORDER) - expected).max() / np.abs(expected).max()
        assert error < 2e-14, (name, error)


def test_coefficients_of_a_known_solution():
    """The coefficients of ``x' = x^2`` are powers of h x; in units of h they neither overflow nor underflow."""
    for h, x in ((0.5, 0.8), (1e-100, 1e100)):
        coefficients = np.asarray(solution_taylor_coefficients(lambda x: x * x, jnp.array([x]), h, 24))[:, 0]
        assert np.allclose(coefficients, x * (h * x) ** np.arange(1, 25), rtol=1e-14, atol=0.0)
    constant = np.asarray(solution_taylor_coefficients(lambda x: jnp.array([2.0, 3.0]), jnp.zeros(2), 0.5, 6))
    assert np.array_equal(constant, [[1.0, 1.5], *np.zeros((5, 2))])


@pytest.mark.parametrize(
    ("function", "primitive"),
    [
        (jnp.abs, "abs"),
        (lambda x: jnp.maximum(x, 0.0) ** 3, "max"),
        (lambda x: jnp.clip(x, 0.0, 1.0), "min"),
        (jnp.sign, "sign"),
        (jnp.floor, "floor"),
        (lambda x: jnp.max(jnp.stack([x, 2.0 * x])), "reduce_max"),
        (lambda x: jnp.sort(jnp.stack([x, x * x]))[0], "sort"),
        (jax.scipy.special.gammaln, "lgamma"),
        (lambda x: jax.lax.while_loop(lambda y: y < 1.0, lambda y: 2.0 * y, x), "while"),
        (lambda x: jnp.where(x > 0.0, jnp.abs(x), x), "abs"),
        (lambda x: jnp.linalg.eigh(jnp.eye(2) * x)[0][0], "eigh"),
    ],
)
def test_refusals(function, primitive):
    with pytest.raises(TaylorSeriesError, match=f"'{primitive}'") as error:
        check_has_taylor_series(function, 0.5)
    assert error.value.primitive == primitive
    check_has_taylor_series(lambda x: jnp.where(function(x) > 0.0, x, x * x), 0.5)  # a test needs no series


def shifted_abs(x):
    return jnp.abs(x) + 1.0


def test_a_refusal_names_the_line():
    with pytest.raises(TaylorSeriesError, match=r"'abs' is not smooth \(test_taylor.py:\d+, in shifted_abs\)"):
        check_has_taylor_series(shifted_abs, 0.5)
