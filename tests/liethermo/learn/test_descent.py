"""The descent of a fit, beside Adam on a problem whose directions are steep and flat."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from liethermo.learn.descent import ADAM_DECAYS, soap_optimiser

optax = pytest.importorskip("optax")

STEPS = 200


def _minimise(optimiser, loss, start):
    def step(carry, _):
        x, state = carry
        value, slope = jax.value_and_grad(loss)(x)
        change, state = optimiser.update(slope, state, x)
        return (x + change, state), value

    x = jnp.asarray(start)
    (x, _), values = jax.jit(lambda x: jax.lax.scan(step, (x, optimiser.init(x)), length=STEPS))(x)
    return np.asarray(x), np.asarray(values)


def test_a_matrix_with_steep_and_flat_directions_is_found_sooner_than_by_adam():
    """``(A (W - W*) B)^2`` with singular values of A and B from 1 to 0.01, in axes that are turned."""
    random = np.random.default_rng(0)
    left_factor, right = (np.linalg.qr(random.standard_normal((6, 6)))[0] * np.logspace(0, -2, 6) for _ in range(2))
    target = random.standard_normal((6, 6))

    def loss(vector):
        return jnp.mean((left_factor.T @ (vector[:36].reshape(6, 6) - target) @ right) ** 2) + jnp.mean(
            vector[36:] ** 2
        )

    schedule = optax.cosine_decay_schedule(0.1, STEPS, alpha=0.01)
    start = np.r_[np.zeros(36), np.ones(3)]
    x, soap_losses = _minimise(soap_optimiser([(6, 6)], schedule), loss, start)
    _, adam_losses = _minimise(optax.adam(schedule), loss, start)
    assert soap_losses[-1] < 0.2 * adam_losses[-1]  # 0.11
    assert np.abs(x[36:]).max() < 1e-2


def test_without_matrices_it_is_adam():
    start = np.array([1.0, -2.0, 3.0])
    schedule = optax.cosine_decay_schedule(0.1, STEPS, alpha=0.01)

    def loss(x):
        return jnp.sum(jnp.array([1.0, 10.0, 100.0]) * x**2)

    x, soap_losses = _minimise(soap_optimiser([(2,)], schedule), loss, start)
    adam_x, values = _minimise(optax.adam(schedule, *ADAM_DECAYS), loss, start)
    np.testing.assert_allclose(soap_losses, values, rtol=1e-9)
    np.testing.assert_allclose(x, adam_x, atol=1e-12)
