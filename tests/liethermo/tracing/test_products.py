"""Products with matrices that are inputs, such as weights of networks: loops that read them in place."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing.calls import MatrixProduct
from liethermo.tracing.program import Routine
from liethermo.tracing.scalarize import scalarize

RANDOM = np.random.default_rng(0)
W = RANDOM.standard_normal((12, 15))
X = RANDOM.standard_normal(15)
POINTS = RANDOM.standard_normal((3, 15))


def _program(f, *arrays):
    return scalarize(jax.make_jaxpr(f)(*arrays))


def _products(program):
    products = [i.op for i in program.instructions if isinstance(i.op, MatrixProduct)]
    inner_programs = [getattr(i.op, name, None) for i in program.instructions for name in ("test", "body")]
    return products + [product for p in inner_programs if p is not None for product in _products(p)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("f", "arrays", "count"),
    [
        (lambda W, x: W @ x, (W, X), 1),
        (lambda W, x: W.T @ jnp.tanh(W @ x), (W, X), 2),
        (lambda W, x: jax.grad(lambda x: jnp.sum(jnp.tanh(W @ x)))(x), (W, X), 2),
        (lambda W, points: jax.vmap(lambda x: W @ x)(points), (W, POINTS), 1),
        (lambda W, x: W[:, :5] @ x[:5], (W, X), 0),  # 60 products are unrolled
        (lambda W, x: (2.0 * W) @ x, (W, X), 0),  # a computed matrix is copied: 180 products are unrolled
    ],
)
def test_products_are_loops(f, arrays, count):
    program = _program(f, *arrays)
    assert len(_products(program)) == count
    np.testing.assert_allclose(program.evaluate(*arrays)[0], f(*arrays), rtol=1e-13, atol=1e-13)
    if count:
        assert "mul" not in {str(i.op) for i in program.instructions} or count == 2


def test_products_in_loops_read_the_matrix_in_place():
    """The matrix is a parameter of the program around two loops, which pass it on as a table, not entry by entry."""

    def f(W, x):
        def step(x, _):
            return jnp.tanh(W.T @ (W @ x) / 20.0 + x), None

        def body(carry):
            return jax.lax.scan(step, carry[0], None, length=200)[0], carry[1] + 1

        return jax.lax.while_loop(lambda carry: carry[1] < 2, body, (x, 0))[0]

    program = _program(f, W, X)
    products = _products(program)
    assert len(products) == 2
    assert {p.strides[0] for p in products} == {(15, 1), (1, 15)}
    np.testing.assert_allclose(program.evaluate(W, X)[0], f(W, X), rtol=1e-12)


def test_large_quadratic_form_has_degree_two():
    A = W.T @ W
    assert _program(lambda A, x: x @ A @ x, A, X).degree_bound(1) == 2
    system = lt.MetriplecticSystem(None, lambda x: 0.5 * x @ jnp.asarray(A) @ x, dim=15)
    assert system.energy.is_quadratic


@jax.jit
def _network(W, x):
    return jnp.sum(jnp.tanh(W.T @ jnp.tanh(W @ x)))


def test_repeated_calls_share_a_routine():
    """The gradient of a network at three points needs two routines, forward and backward, and copies no weights."""

    def f(W, x):
        gradient = jax.grad(lambda y: _network(W, y))
        return gradient(gradient(x)) + gradient(jnp.zeros(15))

    program = _program(f, W, X)
    calls = [i for i in program.instructions if isinstance(i.op, Routine)]
    assert len(calls) == 6
    assert len({i.op for i in calls}) == 2
    assert "tanh" not in {str(i.op) for i in program.instructions}
    assert all(len(i.args) < W.size for i in calls)
    np.testing.assert_allclose(program.evaluate(W, X)[0], f(W, X), rtol=1e-12, atol=1e-13)


def test_routine_inside_a_loop():
    def f(W, x):
        return jax.lax.fori_loop(0, 300, lambda i, x: x + 0.01 * jax.grad(lambda y: _network(W, y))(x), x)

    np.testing.assert_allclose(_program(f, W, X).evaluate(W, X)[0], f(W, X), rtol=1e-12)


def test_routine_passes_truth_values_and_integers():
    @jax.jit
    def relu_network(W, x, n, on):
        return jnp.where(on, jnp.sum(jax.nn.relu(W.T @ jax.nn.relu(W @ x))), 0.0) * n, n + 1, ~on

    def f(W, x):
        value = jax.grad(lambda y: relu_network(W, y, 2, x[0] > 0.0)[0])(x)
        _, n, is_off = relu_network(W, x, jnp.asarray(x[1] > 0.0, int), x[2] > 5.0)
        return jnp.where(is_off, value * n, 0.0)

    program = _program(f, W, X)
    assert any(isinstance(i.op, Routine) for i in program.instructions)
    np.testing.assert_allclose(program.evaluate(W, X)[0], f(W, X), rtol=1e-12)


def test_a_routine_has_the_degree_of_what_it_computes():
    @jax.jit
    def square(W, x):
        return W.T @ (W @ x)

    program = _program(lambda W, x: x @ square(W, x) + jnp.sum(square(W, x)), W, X)
    assert any(isinstance(i.op, Routine) for i in program.instructions)
    assert program.degree_bound(1) == 2


SLOW_METHOD = pytest.param(lt.MetriplecticRungeKutta(4), marks=pytest.mark.slow)


@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), SLOW_METHOD], ids=str)
def test_machine_code_agrees_with_xla(method):
    """A network with 12 neurons in a layer; single runs and lanes agree to the bit."""
    system = lt.learn.Metriplectic(3, entropy=lambda x: x[2], poisson=mf.Canonical(1), width=12)
    starts = RANDOM.standard_normal((5, 3))
    compiled_run, array_run = (
        lt.integrate(system, starts[0], (0.0, 1.0), 0.1, method=method, engine=e) for e in ("compiled", "array")
    )
    np.testing.assert_allclose(compiled_run.x, array_run.x, atol=1e-13)
    ensemble = lt.ensemble(system, starts, (0.0, 1.0), 0.1, method, outputs="final", engine="compiled")
    np.testing.assert_array_equal(ensemble.x[0], compiled_run.x[-1])
