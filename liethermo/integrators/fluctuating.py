"""Steps with noise: the metriplectic midpoint scheme of the stochastic equation."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._module import forwarded

from ..dissipation.base import Dissipation
from ..dissipation.factor import Factor, beside
from ..dissipation.noise import SQUARE, divergence, elsewhere, factors, factors_at, residuals
from ..errors import InputError
from ..functions.energy import Energy
from ..systems import System
from ..tracing.interpret import at_points
from ..tracing.remembered import remembered
from .base import OneStepMethod, TransportingMethod, Wrapping
from .charts import in_charts
from .midpoint import MetriplecticMidpoint

MISFIT = 1e-10
"""Largest difference of ``B B^T`` from the friction matrix, relative to that."""


class Fluctuating(Wrapping, TransportingMethod):
    """``dx = (Pi dH + K dS + k div K) dt + sqrt(2 k) B dW`` (Itô) by midpoints [:doc:`/explanation/fluctuations`].

    As ``div K = sum_a (b_a . grad) b_a + b_a div b_a`` over the columns of B, the first of which is what turns
    Stratonovich's integral into Itô's, a step is

        (x' - x) / h = Pi(z) dgrad H + K_d(z) grad S(z) + B_d(z) (k div B(z) + sqrt(2 k) dW / h)

    at the midpoint z, with K_d and B_d rebuilt from the discrete gradient of H: that is in the kernel of both, so the
    energy is exact on every path, and what noise and friction keep by construction is too. A summand of the dissipation
    that lowers the energy fluctuates with ``k T`` instead of k, T the temperature of the bath that takes it.

    Mean-square order 1/2 (1 where the noise commutes), weak order 1 or better. It keeps no entropy law on paths. Made
    by :func:`liethermo.integrate` from the method that it is given and the ``noise``.

    Attributes
    ----------
    method : MetriplecticMidpoint
    boltzmann : array, shape ()
    temperature : array, shape ()
        Of the bath, where there is one.
    density : Energy or None
        Logarithm of the density of the measure that the motion keeps.
    dW : array, shape (noise_dimension,)
        The increments of the noise in a step.
    """

    method: MetriplecticMidpoint
    boltzmann: jax.Array
    temperature: jax.Array
    density: Energy | None
    dW: jax.Array

    order = 1

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves - {"entropy_law_quadratic"}

    retraction = forwarded("method")

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        return in_charts(self, system, self.method.retraction, "midpoint")

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.at_midpoint(system, x, compensation, h, k)
        return (system.field(z, dH, dS, dL) + sum(B.times(w) for B, w in self._pushes(system, z, dH, dL, h)))[None]

    def velocities(self, system: System, x, compensation, h, k) -> jax.Array:
        z, dH, dS, dL = self.method.at_midpoint(system, x, compensation, h, k)
        pushes = self._pushes(system, z, dH, dL, h)
        return sum((B.velocity(w) for B, w in pushes if B.velocity), start=system.transport(z, dH, dS, dL))[None]

    def transports(self, system: System) -> bool:
        assert system.dissipation is not None
        point = jnp.asarray(system.samples(1)[0])
        return all(B.velocity is not None for _, B in factors_at(system.dissipation, system, point))

    def _pushes(self, system: System, z, dH, dL, h) -> list[tuple[Factor, jax.Array]]:
        """The factors of the summands, each with what it is applied to: drift and noise."""
        assert system.dissipation is not None
        parts = factors(system.dissipation, system, z, dH, dL)
        quanta, ends = self._quanta(parts), np.cumsum([B.size for _, B in parts])[:-1]
        push = quanta * divergence(system.dissipation, system, z)
        if self.density is not None:
            push = push + quanta * beside([B for _, B in parts]).transposed(self.density.gradient(z))
        push = push + jnp.sqrt(2.0 * quanta) * (self.dW / h)
        return list(zip([B for _, B in parts], jnp.split(push, ends), strict=True))

    def _quanta(self, parts: list[tuple[Dissipation, Factor]]) -> jax.Array:
        """``k``, or ``k T`` where the energy is taken by a bath, for every column."""
        factors_of_k = [jnp.ones(()) if part.energy_law == "conserved" else self.temperature for part, _ in parts]
        return self.boltzmann * jnp.concatenate(
            [jnp.full(B.size, T) for T, (_, B) in zip(factors_of_k, parts, strict=True)]
        )

    def predict(self, k, before) -> jax.Array:
        """The noise of a step has nothing to do with that of those before."""
        return jnp.zeros_like(k)

    def keeps(self, system: System, name: str) -> bool:
        return self.method.keeps(system, name) and undisturbed(system)[name]

    def check(self, system: System) -> None:
        """Raise InputError where there is no noise that belongs to the dissipation."""
        self.method.check(system)
        misfit = np.nanmax(_tested(system)[0], initial=0.0)
        if not misfit <= MISFIT:
            raise InputError(
                f"the factor B that a dissipation gives is none of its friction matrix K: B B^T dS misses K dS "
                f"by {misfit:.3g} of its size (tolerance {MISFIT:.0g})"
            )

    def __str__(self) -> str:
        return f"{self.method} with noise"


def with_noise(system: System, method: OneStepMethod, boltzmann, temperature, density: Energy | None) -> Fluctuating:
    """The method for the system with its fluctuations.

    Raises
    ------
    InputError
        If there are none for this system, or this method.
    """
    if not isinstance(method, MetriplecticMidpoint):
        raise InputError(f"steps with noise are those of lt.MetriplecticMidpoint, and {method} has none")
    if system.dissipation is None or all(part.noiseless for part in system.dissipation.terms):
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
    return Fluctuating(
        method, jnp.asarray(boltzmann, float), jnp.asarray(T, float), density, jnp.zeros(_columns(system))
    )


def _columns(system: System) -> int:
    """How many columns the factors have together."""
    assert system.dissipation is not None
    dissipation, point = system.dissipation, jnp.asarray(system.samples(1)[0])
    made = jax.eval_shape(lambda x: [jnp.zeros(B.size) for _, B in factors_at(dissipation, system, x)], point)
    return sum(columns.shape[0] for columns in made)


def noise_dimension(method: OneStepMethod) -> int:
    """How many random numbers drive a step of a method: none without noise."""
    return sum(part.dW.shape[0] for part in jax.tree_util.tree_leaves(method, is_leaf=_noisy) if _noisy(part))


def driven_by(method: OneStepMethod, dW) -> OneStepMethod:
    """The method for one step, with its increments, shape (noise_dimension,)."""

    def changed(part):
        return eqx.tree_at(lambda m: m.dW, part, dW) if _noisy(part) else part

    return jax.tree_util.tree_map(changed, method, is_leaf=_noisy)


def _noisy(part) -> bool:
    return isinstance(part, Fluctuating)


def undisturbed(system: System) -> dict[str, bool]:
    """Whether no noise changes a function, for each of a system's: ``B^T grad f = 0`` at random points."""
    found = {}
    for name, (moved, size) in _tested(system)[1].items():
        inside = np.isfinite(moved)
        found[name] = bool(inside.any() and (moved[inside] <= MISFIT * size[inside]).all())
    return found


@remembered
def _tested(system: System) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    return at_points(_tests, system, system.samples(4))


def _tests(system: System, x):
    """What the factors miss of K, and how far they move each function, beside the size of what moves it."""
    assert system.dissipation is not None
    B = beside([B for _, B in factors_at(system.dissipation, system, x)])
    # they see columns as large as any
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(B.transposed(away))) for away in elsewhere(x.shape[0], 2)]))
    moved = {}
    for name, function in system.functions().items():
        gradient = function.gradient(x)
        moved[name] = jnp.max(jnp.abs(B.transposed(gradient)), initial=0.0), size * jnp.linalg.norm(gradient)
    return residuals(system.dissipation, system, x)[SQUARE], moved
