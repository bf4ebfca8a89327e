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
    factor_divergences,
    factor_property_residuals,
    generic_covectors,
    noisy_terms_with_factors,
    terms_with_factors_at_state,
)
from ..errors import InputError
from ..functions.energy import Energy
from ..systems import System
from ..tracing.caching import memoize
from ..tracing.interpret import evaluate_at_points
from .base import MethodWrapper, OneStepMethod, TransportingMethod, apply_increment
from .charts import wrap_in_charts
from .midpoint import MetriplecticMidpoint

FACTOR_RTOL = 1e-10
"""Largest difference between ``B B^T`` and the friction matrix, relative to the friction matrix."""


class StochasticMidpoint(MethodWrapper, TransportingMethod):
    """Midpoint scheme for a metriplectic system with noise [:doc:`/explanation/fluctuations`].

        dx = (Pi dH + K dS + k div K) dt + sqrt(2 k) B dW    (Itô)

    As ``div K = sum_a (b_a . grad) b_a + b_a div b_a`` over the columns of B, and the first term turns Stratonovich's
    integral into Itô's, a step is

        (x' - x) / h = Pi(z) dgrad H + K_d(z) grad S(z) + B_d(z) (k div B(z) + sqrt(2 k) dW / h)

    at the midpoint z. K_d and B_d are rebuilt from the discrete gradient of H, which is in the kernel of both: the
    energy is exact on every path, and so is what noise and friction preserve by construction. A summand of the
    dissipation that lowers the energy fluctuates with ``k T`` instead of k, where T is the temperature of its bath.

    A step is a function of the state, the increments and the time alone; it passes no compensation on. So a run in two
    parts equals the run in one part, to the bit.

    The mean-square order is 1/2 (1 if the noise commutes), the weak order 1 or better. No entropy law holds on single
    paths. :func:`liethermo.integrate` makes this method from the given method and ``noise``.

    Attributes
    ----------
    method : MetriplecticMidpoint
    boltzmann : array, shape ()
    temperature : array, shape ()
        Temperature of the bath, if there is one.
    log_density : Energy or None
        Logarithm of the density of the measure that the motion preserves.
    dW : array, shape (noise_dimension,)
        Increments of the noise in a step.
    invariant_names : frozenset of str
        Names of the functions of the system that steps conserve for any noise.
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
        invariant_names = frozenset(name for name in system.first_integrals() if self.preserves_function(system, name))
        method = dataclasses.replace(self, invariant_names=invariant_names)
        return wrap_in_charts(method, system, self.method.retraction, "midpoint")

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.midpoint_and_gradients(system, x, compensation, h, k)
        factors_and_inputs = self._factors_and_drift_plus_noise(system, z, dH, dL, h)
        noise_rates_by_term = [
            B.spin_coefficients[..., None] * w.reshape(-1, 3)
            for B, w in factors_and_inputs
            if B.spin_coefficients is not None
        ]
        if noise_rates_by_term:
            other_noise_velocity = sum(
                (B.times(w) for B, w in factors_and_inputs if B.spin_coefficients is None), jnp.zeros_like(z)
            )
            noise_rates = sum(noise_rates_by_term[1:], noise_rates_by_term[0])
            slopes = system.solve_slopes_at_each_spin(z, dH, dS, noise_rates, other_noise_velocity, 0.5 * h, k[0])
            if slopes is not None:
                return slopes[None]
        return sum((B.times(w) for B, w in factors_and_inputs), system.field(z, dH, dS, dL))[None]

    def attitude_velocities_at_stages(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.midpoint_and_gradients(system, x, compensation, h, k)
        factors_and_inputs = self._factors_and_drift_plus_noise(system, z, dH, dL, h)
        return sum(
            (B.added_attitude_velocity(w) for B, w in factors_and_inputs if B.added_attitude_velocity),
            start=system.attitude_velocity_from_gradients(z, dH, dS, dL),
        )[None]

    def follows_attitude_exactly(self, system: System) -> bool:
        point = jnp.asarray(system.samples(1)[0])
        return all(
            B.added_attitude_velocity is not None
            for _, B in terms_with_factors_at_state(system.total_dissipation, system, point)
        )

    def _factors_and_drift_plus_noise(self, system: System, z, dH, dL, h) -> list[tuple[Factor, jax.Array]]:
        """Return the pairs (B, drift + noise) of the summands of the dissipation; the slope adds their products B w."""
        terms = noisy_terms_with_factors(system.total_dissipation, system, z, dH, dL)
        split_indices = np.cumsum([B.size for _, B in terms])[:-1]
        drift = factor_divergences(system.total_dissipation, system, z)
        if self.log_density is not None:
            drift = drift + concatenate_factors([B for _, B in terms]).transpose_times(self.log_density.gradient(z))
        factors_and_inputs = []
        for (term, B), d, dW in zip(
            terms, jnp.split(drift, split_indices), jnp.split(self.dW, split_indices), strict=True
        ):
            thermal_energy = self.boltzmann * (1.0 if term.energy_law == "conserved" else self.temperature)
            factors_and_inputs.append((B, thermal_energy * d + _noise_amplitude(B, thermal_energy, h) * (dW / h)))
        return factors_and_inputs

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        return apply_increment(self, system, x, compensation, self.increment(h, k), is_noisy=True)

    def predict(self, k, previous_k) -> jax.Array:
        """Return zeros: the noise of a step is independent of the previous steps."""
        return jnp.zeros_like(k)

    def preserves_function(self, system: System, name: str) -> bool:
        return self.method.preserves_function(system, name) and noise_invariance_by_name(system)[name]

    def check(self, system: System) -> None:
        """Raise InputError unless ``B B^T`` equals the friction matrix K of the dissipation, to FACTOR_RTOL."""
        self.method.check(system)
        residual = np.nanmax(_factor_residuals_and_noise_changes_at_samples(system)[0], initial=0.0)
        if not residual <= FACTOR_RTOL:
            raise InputError(
                f"B B^T does not equal the friction matrix K: B B^T dS differs from K dS by a relative error of "
                f"{residual:.3g} (tolerance {FACTOR_RTOL:.0g}). Correct Dissipation.factor"
            )

    def __str__(self) -> str:
        return f"{self.method} with noise"


def _noise_amplitude(B: Factor, thermal_energy, h) -> jax.Array:
    """Return the amplitude of Brownian increments, ``sqrt(2 k)`` or ``sqrt(2 k T)``, with a correction for spins.

    A midpoint step with the angles w rotates a spin by ``2 atan(|w| / 2)``, less than |w|, and its friction is smaller
    too. In a weak field the spin then has the temperature of exact noise of variance ``s (1 - s / 4 + 3 s^2 / 8 -
    ...)`` in each component, where w has the variance s. So s is chosen such that this is ``u = 2 k r^2 h``
    [:doc:`/explanation/fluctuations`].
    """
    if B.spin_coefficients is None:
        return jnp.sqrt(2.0 * thermal_energy)
    u = 2.0 * thermal_energy * B.spin_coefficients**2 * jnp.abs(h)
    amplitude = jnp.sqrt(2.0 * thermal_energy * (1.0 + 0.25 * u / (1.0 + u)))
    return jnp.repeat(amplitude, 3) if amplitude.ndim else amplitude


def stochastic_method(
    system: System, method: OneStepMethod, boltzmann, temperature, log_density: Energy | None
) -> StochasticMidpoint:
    """Return the stochastic midpoint method that adds the fluctuations of the system to the steps of ``method``.

    Raises
    ------
    InputError
        If the system has no fluctuations, or the method cannot have any.
    """
    if not isinstance(method, MetriplecticMidpoint):
        raise InputError(f"noise= works only with lt.MetriplecticMidpoint, got {method}")
    if all(part.is_noiseless for part in system.total_dissipation.terms):
        raise InputError("noise= needs a dissipation with noise, but this system has none")
    lowering_terms = [part for part in system.total_dissipation.terms if part.energy_law != "conserved"]
    if lowering_terms and temperature is None:
        raise InputError(
            f"{type(lowering_terms[0]).__name__} lowers the energy. Give the temperature of the bath that takes it, "
            "lt.Fluctuations(boltzmann, seed, temperature=...)"
        )
    if temperature is not None and not lowering_terms:
        raise InputError(
            "temperature= needs a dissipation that lowers the energy, and this one conserves it. Leave it out"
        )
    T = 1.0 if temperature is None else temperature
    return StochasticMidpoint(
        method,
        jnp.asarray(boltzmann, float),
        jnp.asarray(T, float),
        log_density,
        jnp.zeros(_count_factor_columns(system)),
    )


def _count_factor_columns(system: System) -> int:
    """Return the number of columns of the noise factors B of all dissipations of the system together."""
    dissipation, point = system.total_dissipation, jnp.asarray(system.samples(1)[0])
    column_blocks = jax.eval_shape(
        lambda x: [jnp.zeros(B.size) for _, B in terms_with_factors_at_state(dissipation, system, x)], point
    )
    return sum(block.shape[0] for block in column_blocks)


def noise_dimension(method: OneStepMethod) -> int:
    """Return the number of random numbers that a step uses: 0 without noise."""
    return sum(
        part.dW.shape[0] for part in jax.tree_util.tree_leaves(method, is_leaf=_is_stochastic) if _is_stochastic(part)
    )


def with_noise_increments(method: OneStepMethod, dW) -> OneStepMethod:
    """Return a copy of the method whose next step uses the Brownian increments dW, shape (noise_dimension,)."""

    def with_increments(node):
        return eqx.tree_at(lambda m: m.dW, node, dW) if _is_stochastic(node) else node

    return jax.tree_util.tree_map(with_increments, method, is_leaf=_is_stochastic)


def _is_stochastic(node) -> bool:
    """Return True if a node of a pytree is a StochasticMidpoint."""
    return isinstance(node, StochasticMidpoint)


def noise_invariance_by_name(system: System) -> dict[str, bool]:
    """Return, for each function of a system, True if noise leaves it constant: ``B^T grad f = 0`` at random points."""
    is_invariant = {}
    for name, (change, scale) in _factor_residuals_and_noise_changes_at_samples(system)[1].items():
        is_finite = np.isfinite(change)
        is_invariant[name] = bool(is_finite.any() and (change[is_finite] <= FACTOR_RTOL * scale[is_finite]).all())
    return is_invariant


@memoize
def _factor_residuals_and_noise_changes_at_samples(
    system: System,
) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return :func:`_factor_residual_and_noise_changes` at four states of the system, along the first axis."""
    return evaluate_at_points(_factor_residual_and_noise_changes, system, system.samples(4))


def _factor_residual_and_noise_changes(system: System, x):
    """Return the residual of ``B B^T = K`` at x, and for each function of the system (change by noise, its scale)."""
    B = concatenate_factors([B for _, B in terms_with_factors_at_state(system.total_dissipation, system, x)])
    # The scale is the largest product with generic covectors, which none of the columns is orthogonal to.
    max_product = jnp.max(
        jnp.stack([jnp.max(jnp.abs(B.transpose_times(covector))) for covector in generic_covectors(x.shape[0], 2)])
    )
    changes = {}
    for name, function in system.functions().items():
        gradient = function.gradient(x)
        changes[name] = (
            jnp.max(jnp.abs(B.transpose_times(gradient)), initial=0.0),
            max_product * jnp.linalg.norm(gradient),
        )
    return factor_property_residuals(system.total_dissipation, system, x)[FACTOR_SQUARE_CHECK], changes
