"""Energies written with all kinds of functions are compiled, and the trajectory is that of the array engine."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy import special

import liethermo as lt
import manifolds as mf

INERTIA = jnp.array([1.0, 2.0, 3.0])
KNOTS = jnp.linspace(-3.0, 3.0, 400)
X0 = np.array([0.3, 1.0, -0.5])


def matrix(m):
    """Return a positive definite matrix with distinct eigenvalues."""
    return jnp.diag(jnp.array([2.0, 4.0, 7.0])) + 0.3 * jnp.outer(m, m)


def root(s):
    """Return the square root of s by Newton's method, in a ``while_loop``."""
    start = jnp.zeros(()), s

    def is_unconverged(carry):
        return jnp.abs(carry[1] ** 2 - s) > 1e-13 * s

    return lax.while_loop(is_unconverged, lambda c: (c[0] + 1, (c[1] + s / c[1]) / 2), start)[1]


def six_by_six(m):
    """Return a positive definite 6 x 6 matrix."""
    repeated_m = jnp.tile(m, 2)
    return jnp.kron(matrix(m), jnp.eye(2)) + jnp.outer(repeated_m, repeated_m)


def spectral_entropy(m):
    values, vectors = jnp.linalg.eigh(matrix(m))
    return jnp.sum(values * jnp.log(values) * vectors[0] ** 2)


def complex_eigenvalue_sum(m):
    return jnp.sum(jnp.linalg.eigvalsh(matrix(m) + 0.5j * mf.so(3).ad(m)))


FUNCTIONS = {
    "while_loop": lambda m: root(1.0 + m @ m),
    "fori_loop": lambda m: lax.fori_loop(0, 5, lambda i, s: s + jnp.sin(s + i * m[0]), m[1]),
    "long scan": lambda m: lax.scan(lambda c, t: (c + 0.01 * jnp.cos(t * m[0] + c), None), m[2], KNOTS)[0],
    "cond": lambda m: lax.cond(m[1] > 9.0, lambda a: jnp.sin(a[0]), lambda a: a[0] ** 4, m),
    "switch": lambda m: lax.switch((m[1] > 9.0).astype(int) + 1, [jnp.sum, lambda a: a[0] ** 3, jnp.prod], m),
    "interp": lambda m: jnp.interp(m[0] ** 3 + m[1], KNOTS, 0.5 * KNOTS),
    "index at run time": lambda m: INERTIA[jnp.argmax(jnp.array([1.0, 0.0, 0.0]) * (3.0 + m[0]))] * m[0] ** 4,
    "dynamic_slice": lambda m: lax.dynamic_slice(m, ((m[1] > 9.0).astype(int),), (2,)) @ jnp.array([0.3, 0.4]),
    "integers": lambda m: m[0] ** 4 * ((m > -99.0).sum() // 2 + 5 % (m > -99.0).sum()),
    "single precision": lambda m: jnp.float32(1.1) * m[0] ** 4 * jnp.mean(m > -99.0),
    "complex": lambda m: jnp.abs((m[0] + 1j * m[1] + 2.0) ** 3 * jnp.exp(0.1j * m[2])),
    "eigh": spectral_entropy,
    "eigvalsh": lambda m: jnp.sum(jnp.exp(0.2 * jnp.linalg.eigvalsh(matrix(m)))),
    "eigvalsh, complex": complex_eigenvalue_sum,
    "solve": lambda m: m @ jnp.linalg.solve(matrix(m), m),
    "inv": lambda m: jnp.trace(jnp.linalg.inv(matrix(m))),
    "inv, larger": lambda m: jnp.trace(
        jnp.linalg.inv(jnp.kron(matrix(m), jnp.eye(2)) + jnp.outer(*[jnp.tile(m, 2)] * 2))
    ),
    "det": lambda m: 0.1 * jnp.linalg.det(matrix(m)),
    "slogdet": lambda m: jnp.linalg.slogdet(matrix(m))[1],
    "qr": lambda m: jnp.sum(jnp.log(jnp.abs(jnp.diag(jnp.linalg.qr(matrix(m))[1])))),
    "svd": lambda m: jnp.sum(jnp.linalg.svd(matrix(m), compute_uv=False)),
    "cholesky": lambda m: jnp.sum(jnp.log(jnp.diag(jnp.linalg.cholesky(matrix(m))))),
    "expm": lambda m: 0.1 * jnp.trace(jax.scipy.linalg.expm(0.3 * matrix(m))),
    "product of 10 x 10": lambda m: jnp.trace(
        jnp.outer(jnp.cos(jnp.arange(10.0) * m[0]), jnp.sin(jnp.arange(10.0) + m[1]))
        @ jnp.outer(jnp.cos(jnp.arange(10.0) * m[2]), jnp.sin(jnp.arange(10.0)))
    ),
    "sort": lambda m: jnp.sort(jnp.array([m[0] ** 3, m[1] + 9.0, m[2] - 9.0])) @ jnp.array([0.1, 0.2, 0.3]),
    "lgamma": lambda m: special.gammaln(4.0 + m[0]),
    "digamma": lambda m: special.digamma(4.0 + m[0]),
    "erf_inv": lambda m: special.erfinv(0.3 * jnp.sin(m[0])),
    "bessel i0, i1": lambda m: special.i0(m[0]) + special.i1e(m[1]),
    "bessel_jn": lambda m: special.bessel_jn(m[0] + 4.0, v=1)[1],
    "convolve": lambda m: jnp.sum(jnp.convolve(m, m)[1:3]),
}
"""Function of the momentum for each JAX feature, a part of the energy."""

METHODS = lt.MetriplecticMidpoint(), lt.MetriplecticRungeKutta(4)
CASIMIR = functools.partial(lt.Quadratic, np.ones(3))


def body(function, dissipation=True):
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * jnp.sum(m * m / INERTIA) + 0.1 * function(m),
        CASIMIR(),
        lt.KillingDissipation(0.1) if dissipation else None,
    )


@pytest.mark.sampled("cond-MetriplecticRungeKutta(order=4)")
@pytest.mark.parametrize(
    ("name", "method"),
    [pytest.param(name, METHODS[i % 2], id=f"{name}-{METHODS[i % 2]}") for i, name in enumerate(FUNCTIONS)],
)
def test_functions_of_every_kind(name, method):
    system = body(FUNCTIONS[name])
    compiled_run, array_run = (
        lt.integrate(system, X0, (0.0, 1.0), 0.1, method, engine=e) for e in ("compiled", "array")
    )
    assert compiled_run.provenance["engine"] == "compiled"
    assert np.abs(compiled_run.x - array_run.x).max() <= 2e-14  # 4e-15 measured, over all of them
    assert compiled_run.audit().energy_drift <= 4e-15
    assert (np.diff(compiled_run.entropy) > 0.0).all()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["while_loop", "eigh", pytest.param("inv, larger", marks=pytest.mark.slow)])
def test_a_lane_is_a_single_run(name):
    """A lane equals a single run to the bit, also if loops of the lanes end at different times."""
    system, starts = body(FUNCTIONS[name]), np.random.default_rng(0).uniform(-1.5, 1.5, (11, 3))
    ensemble_x = lt.ensemble(system, starts, (0.0, 0.5), 0.1, lt.MetriplecticMidpoint(), engine="compiled").x
    single_x = [
        lt.integrate(system, x, (0.0, 0.5), 0.1, lt.MetriplecticMidpoint(), engine="compiled").x[-1] for x in starts
    ]
    assert np.array_equal(ensemble_x, single_x)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["solve", "long scan"])
def test_newton_has_them_too(name):
    """Newton's method is compiled with these functions, in steps that fixed-point iteration does not solve."""
    system = body(FUNCTIONS[name])
    compiled_run, array_run = (
        lt.integrate(system, 3.0 * X0, (0.0, 4.0), 2.0, lt.MetriplecticMidpoint(), engine=e)
        for e in ("compiled", "array")
    )
    assert compiled_run.stats.newton_iterations > 0
    assert np.abs(compiled_run.x - array_run.x).max() <= 1e-12


def test_a_power_of_a_complex_number():
    """A complex power is traced without NumPy's warning that an imaginary part is lost."""
    f = lambda m: jnp.real((1.5 + 1j * m[0]) ** 2.5) + m[1] ** 2  # noqa: E731
    gradient = lt.LiePoissonSystem(mf.so(3), f).energy.gradient(X0)
    np.testing.assert_allclose(gradient, jax.grad(f)(X0), rtol=1e-15)


def test_the_order_of_a_polygamma_function_is_known_to_the_compiler():
    system = body(lambda m: special.polygamma(1, 2.0 + m[0]) + m[1] ** 2)
    run = lt.integrate(system, X0, (0.0, 0.2), 0.1, lt.MetriplecticRungeKutta(4), engine="compiled")
    assert run.audit().energy_drift <= 4e-15


def test_what_cannot_be_compiled_is_named():
    system = body(lambda m: jnp.abs(lax.asinh(m[0] + 1j)))
    with pytest.raises(lt.LiethermoError, match=r"primitive 'asinh' on complex numbers \(test_functions.py:\d+"):
        lt.integrate(system, X0, (0.0, 0.1), 0.1, engine="compiled")
    system_with_fft = body(
        lambda m: jnp.sum(jnp.abs(jnp.fft.fft(m)) ** 4)
    )  # a transformed function without a source line
    with pytest.raises(lt.LiethermoError, match=r"primitive 'fft' \((of unknown origin|test_functions.py:\d+)"):
        lt.integrate(system_with_fft, X0, (0.0, 0.1), 0.1, engine="compiled")


FUNCTIONS_OF_MATRICES = {
    "where eigenvalues meet": lambda m: mf.spectral_trace(jnp.log, jnp.diag(2.0 + 0.0 * m) + 0.1 * jnp.outer(m, m)),
    "4 x 4, complex": lambda m: (
        mf.spectral(jnp.sqrt, 2.0 * jnp.eye(4) + 0.3j * mf.so(4).hat(jnp.tile(m, 2)))[0, 0].real
    ),
}
"""Matrix functions of the momentum, a part of the energy."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=["implicit", "explicit"])
@pytest.mark.parametrize("name", FUNCTIONS_OF_MATRICES)
def test_functions_of_matrices(name, method):
    """Matrix functions are compiled, by LAPACK for the second, which has equal pairs of eigenvalues for some m."""
    system = body(FUNCTIONS_OF_MATRICES[name])
    compiled_run, array_run = (
        lt.integrate(system, X0, (0.0, 1.0), 0.1, method, engine=e) for e in ("compiled", "array")
    )
    assert np.abs(compiled_run.x - array_run.x).max() <= 2e-14
    assert compiled_run.audit().energy_drift <= 4e-15
