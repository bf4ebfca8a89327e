"""Gradients of large energies."""

import jax
import jax.numpy as jnp
import numpy as np

from liethermo.functions.energy import MIN_BUFFERED_DIM, make_energy


def test_a_large_gradient_is_buffered_and_has_derivatives():
    """The gradient is stored by a branch, which must not affect batches and derivatives."""
    energy = make_energy(lambda x: jnp.sum(x * jnp.roll(x, 1) ** 2), "the energy")
    x, v = np.random.default_rng(3).standard_normal((2, MIN_BUFFERED_DIM))
    plain_gradient = jax.grad(energy.value)
    assert " cond[" in str(jax.make_jaxpr(energy.gradient)(x))
    assert " cond[" not in str(jax.make_jaxpr(energy.gradient)(x[1:])), "a control: small ones are not"
    np.testing.assert_allclose(
        jax.vmap(energy.gradient)(jnp.stack([x, v])), jax.vmap(plain_gradient)(jnp.stack([x, v])), atol=1e-14
    )
    tangent, expected = (jax.jvp(f, (x,), (v,))[1] for f in (energy.gradient, plain_gradient))
    np.testing.assert_allclose(tangent, expected, atol=1e-13)
    assert np.isnan(energy.gradient(np.append(np.inf, x[1:]))).all()
