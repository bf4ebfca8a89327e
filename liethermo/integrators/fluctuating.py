"""Steps with noise: the metriplectic midpoint scheme of the stochastic equation."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import forward_to

from ..dissipation.factor import Factor, concatenate_factors
from ..dissipation.noise import (
    FACTOR_SQUARE_CHECK,
    factor_divergence,
    factor_residuals,
    generic_covectors,
    terms_with_continuous_factors,
    terms_with_factors,
)
from ..errors import InputError
from ..functions.energy import Energy
from ..systems import SpinSystem, System
from ..tracing.caching import memoize
from ..tracing.interpret import evaluate_at_points
from .base import MethodWrapper, OneStepMethod, TransportingMethod, apply_increment
from .charts import wrap_in_charts
from .midpoint import MetriplecticMidpoint

FACTOR_RTOL = 1e-10
"""Largest difference of ``B B^T`` from the friction matrix, relative to that."""


class StochasticMidpoint(MethodWrapper, TransportingMethod):
    """``dx = (Pi dH + K dS + k div K) dt + sqrt(2 k) B dW`` (Itô) by midpoints [:doc:`/explanation/fluctuations`].

    As ``div K = sum_a (b_a . grad) b_a + b_a div b_a`` over the columns of B, the first of which is what turns
    Stratonovich's integral into Itô's, a step is

        (x' - x) / h = Pi(z) dgrad H + K_d(z) grad S(z) + B_d(z) (k div B(z) + sqrt(2 k) dW / h)

    at the midpoint z, with K_d and B_d rebuilt from the discrete gradient of H: that is in the kernel of both, so the
    energy is exact on every path, and what noise and friction keep by construction is too. A summand of the dissipation
    that lowers the energy fluctuates with ``k T`` instead of k, T the temperature of the bath that takes it.

    A step is a function of the state, the increments and the time alone: it hands on nothing of what rounding has kept
    from the state. So a run in two parts is the run in one, to the bit.

    Mean-square order 1/2 (1 where the noise commutes), weak order 1 or better. It keeps no entropy law on paths. Made
    by :func:`liethermo.integrate` from the method that it is given and the ``noise``.

    Attributes
    ----------
    method : MetriplecticMidpoint
    boltzmann : array, shape ()
    temperature : array, shape ()
        Of the bath, where there is one.
    log_density : Energy or None
        Logarithm of the density of the measure that the motion keeps.
    dW : array, shape (noise_dimension,)
        The increments of the noise in a step.
    invariant_names : frozenset of str
        The functions of the system that steps conserve, whatever the noise.
    """

    method: MetriplecticMidpoint
    boltzmann: jax.Array
    temperature: jax.Array
    log_density: Energy | None
    dW: jax.Array
    invariant_names: frozenset[str] = eqx.field(static=True, default=frozenset())

    order = 1

    carries_compensation = False

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves - {"entropy_law_quadratic"}

    retraction = forward_to("method")

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        kept = frozenset(name for name in system.first_integrals() if self.preserves_function(system, name))
        own = dataclasses.replace(self, invariant_names=kept)
        return wrap_in_charts(own, system, self.method.retraction, "midpoint")

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.midpoint_gradients(system, x, compensation, h, k)
        pushes = self._factors_and_inputs(system, z, dH, dL, h)
        found = system.field(z, dH, dS, dL) + sum(B.times(w) for B, w in pushes)
        turns = [
            B.spin_coefficients[..., None] * w.reshape(-1, 3) for B, w in pushes if B.spin_coefficients is not None
        ]
        if not turns or not isinstance(system, SpinSystem):
            return found[None]
        # The same solution, in a fraction of the iterations: of many spins some are turned far in every step.
        return (k[0] + system.solve_rotation(0.5 * h * sum(turns), found - k[0]))[None]

    def stage_velocities(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.midpoint_gradients(system, x, compensation, h, k)
        pushes = self._factors_and_inputs(system, z, dH, dL, h)
        return sum((B.velocity(w) for B, w in pushes if B.velocity), start=system.transport(z, dH, dS, dL))[None]

    def can_transport_attitude(self, system: System) -> bool:
        assert system.dissipation is not None
        point = jnp.asarray(system.samples(1)[0])
        return all(B.velocity is not None for _, B in terms_with_continuous_factors(system.dissipation, system, point))

    def _factors_and_inputs(self, system: System, z, dH, dL, h) -> list[tuple[Factor, jax.Array]]:
        """The factors of the summands, each with what it is applied to: drift and noise."""
        assert system.dissipation is not None
        parts = terms_with_factors(system.dissipation, system, z, dH, dL)
        ends = np.cumsum([B.size for _, B in parts])[:-1]
        drift = factor_divergence(system.dissipation, system, z)
        if self.log_density is not None:
            drift = drift + concatenate_factors([B for _, B in parts]).transpose_times(self.log_density.gradient(z))
        found = []
        for (part, B), d, dW in zip(parts, jnp.split(drift, ends), jnp.split(self.dW, ends), strict=True):
            quantum = self.boltzmann * (1.0 if part.energy_law == "conserved" else self.temperature)
            found.append((B, quantum * d + _noise_amplitude(B, quantum, h) * (dW / h)))
        return found

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        return apply_increment(self, system, x, compensation, self.increment(h, k), is_noisy=True)

    def predict(self, k, before) -> jax.Array:
        """The noise of a step has nothing to do with that of those before."""
        return jnp.zeros_like(k)

    def preserves_function(self, system: System, name: str) -> bool:
        return self.method.preserves_function(system, name) and noise_invariance(system)[name]

    def check(self, system: System) -> None:
        """Raise InputError where there is no noise that belongs to the dissipation."""
        self.method.check(system)
        misfit = np.nanmax(_sampled_noise_tests(system)[0], initial=0.0)
        if not misfit <= FACTOR_RTOL:
            raise InputError(
                f"the factor B that a dissipation gives is none of its friction matrix K: B B^T dS misses K dS "
                f"by {misfit:.3g} of its size (tolerance {FACTOR_RTOL:.0g})"
            )

    def __str__(self) -> str:
        return f"{self.method} with noise"


def _noise_amplitude(B: Factor, quantum, h) -> jax.Array:
    """``sqrt(2 k)``, or k T for k, and more where the noise turns spins: a midpoint step turns less than is asked.

    A vector w of angles turns a spin by ``2 atan(|w| / 2)``, and the friction of such a step is less too. In a weak
    field the spin then rests at the temperature of exact noise of variance ``s (1 - s / 4 + 3 s^2 / 8 - ...)`` in each
    component, where w has s. So s is chosen for which that is ``u = 2 k r^2 h`` [:doc:`/explanation/fluctuations`].
    """
    if B.spin_coefficients is None:
        return jnp.sqrt(2.0 * quantum)
    u = 2.0 * quantum * B.spin_coefficients**2 * jnp.abs(h)
    found = jnp.sqrt(2.0 * quantum * (1.0 + 0.25 * u / (1.0 + u)))
    return jnp.repeat(found, 3) if found.ndim else found


def add_noise(
    system: System, method: OneStepMethod, boltzmann, temperature, density: Energy | None
) -> StochasticMidpoint:
    """The method for the system with its fluctuations.

    Raises
    ------
    InputError
        If there are none for this system, or this method.
    """
    if not isinstance(method, MetriplecticMidpoint):
        raise InputError(f"steps with noise are those of lt.MetriplecticMidpoint, and {method} has none")
    if system.dissipation is None or all(part.is_noiseless for part in system.dissipation.terms):
        raise InputError("noise belongs to a dissipation, and this system has none")
    lowers = [part for part in system.dissipation.terms if part.energy_law != "conserved"]
    if lowers and temperature is None:
        raise InputError(
            f"{type(lowers[0]).__name__} lowers the energy: give the temperature of the bath that takes it, "
            "lt.Fluctuations(boltzmann, seed, temperature=...)"
        )
    if temperature is not None and not lowers:
        raise InputError("the dissipation keeps the energy, so there is no bath that could have a temperature")
    T = 1.0 if temperature is None else temperature
    return StochasticMidpoint(
        method, jnp.asarray(boltzmann, float), jnp.asarray(T, float), density, jnp.zeros(_count_factor_columns(system))
    )


def _count_factor_columns(system: System) -> int:
    """How many columns the factors have together."""
    assert system.dissipation is not None
    dissipation, point = system.dissipation, jnp.asarray(system.samples(1)[0])
    made = jax.eval_shape(
        lambda x: [jnp.zeros(B.size) for _, B in terms_with_continuous_factors(dissipation, system, x)], point
    )
    return sum(columns.shape[0] for columns in made)


def noise_dimension(method: OneStepMethod) -> int:
    """How many random numbers drive a step of a method: none without noise."""
    return sum(
        part.dW.shape[0] for part in jax.tree_util.tree_leaves(method, is_leaf=_is_stochastic) if _is_stochastic(part)
    )


def set_noise_increments(method: OneStepMethod, dW) -> OneStepMethod:
    """The method for one step, with its increments, shape (noise_dimension,)."""

    def with_increments(part):
        return eqx.tree_at(lambda m: m.dW, part, dW) if _is_stochastic(part) else part

    return jax.tree_util.tree_map(with_increments, method, is_leaf=_is_stochastic)


def _is_stochastic(part) -> bool:
    return isinstance(part, StochasticMidpoint)


def noise_invariance(system: System) -> dict[str, bool]:
    """Whether no noise changes a function, for each of a system's: ``B^T grad f = 0`` at random points."""
    found = {}
    for name, (change, size) in _sampled_noise_tests(system)[1].items():
        inside = np.isfinite(change)
        found[name] = bool(inside.any() and (change[inside] <= FACTOR_RTOL * size[inside]).all())
    return found


@memoize
def _sampled_noise_tests(system: System) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    return evaluate_at_points(_noise_tests, system, system.samples(4))


def _noise_tests(system: System, x):
    """What the factors miss of K, and how far they move each function, beside the size of what moves it."""
    assert system.dissipation is not None
    B = concatenate_factors([B for _, B in terms_with_continuous_factors(system.dissipation, system, x)])
    # they see columns as large as any
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(B.transpose_times(away))) for away in generic_covectors(x.shape[0], 2)]))
    changes = {}
    for name, function in system.functions().items():
        gradient = function.gradient(x)
        changes[name] = jnp.max(jnp.abs(B.transpose_times(gradient)), initial=0.0), size * jnp.linalg.norm(gradient)
    return factor_residuals(system.dissipation, system, x)[FACTOR_SQUARE_CHECK], changes
