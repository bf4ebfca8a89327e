"""Energies of many bodies: one function at many places of a large state."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..errors import FunctionError, InputError
from ..tracing.interpret import polynomial_degree
from ..tracing.traced import trace_callables
from .checks import check_energy, mark_polynomial_degrees
from .conditions import check_numbers
from .energy import Energy, Function, float64_array
from .indices import Indices, clique_pattern
from .path import CollocationPath


class Each(Energy):
    """``sum_e phi(x[places_e], a_e)``: one function at many places of the state, with parameters of its own at each.

    Springs between bodies, the bodies themselves: written once, evaluated at all places together, at a cost that grows
    with their number and not with the square of the state. Every summand has a discrete gradient of its own, corrected
    along its own components only; so a component feels no more of the others than in the exact gradient, and stiff
    systems of any size can be solved by sparse Newton iteration.

    Parameters
    ----------
    phi : function or Energy
        From the components at one place, shape (r,), and the parameters there, to a scalar; or an Energy of those
        components, the same at every place.
    places : array of int, shape (m, r)
        Indices into the state.
    *parameters : arrays, shape (m, ...)
        One entry for each place.

    Raises
    ------
    FunctionError, InputError
    """

    phi: Energy | Callable
    parameters: tuple[jax.Array, ...]
    places: Indices = eqx.field(static=True)
    degree: float = eqx.field(static=True, default=math.inf)

    def __init__(self, phi, places, *parameters):
        self.places = places if isinstance(places, Indices) else _check_places(places)
        self.parameters = tuple(check_numbers(a, "a parameter") for a in parameters)
        m, r = self.places.shape
        for a in self.parameters:
            if a.shape[:1] != (m,):
                raise InputError(f"parameters have an entry for each of the {m} places, but these have shape {a.shape}")
        if isinstance(phi, Energy):
            if parameters:
                raise InputError("an Energy is the same at every place: parameters are for a function")
            self.phi = mark_polynomial_degrees(check_energy(phi, r, "the energy at a place"), r)
            self.degree = self.phi.degree
            return
        if not callable(phi):
            raise FunctionError(f"phi is a function or an Energy, not {type(phi).__name__}")
        first = tuple(jnp.zeros(a.shape[1:]) for a in self.parameters)
        check_energy(Function(lambda y: phi(y, *first)), r, "the function at a place")
        self.phi = trace_callables(phi, lambda phi, *a: phi(*a), (r,), *(a.shape for a in first))
        self.degree = polynomial_degree(_summand_value, (self.phi, first), r)

    @property
    def terms(self) -> tuple[Energy, ...]:
        if isinstance(self.phi, Energy) and len(self.phi.terms) > 1:
            return tuple(Each(term, self.places) for term in self.phi.terms)
        return (self,)

    @property
    def is_quadratic(self) -> bool:
        return self.degree <= 2

    def value(self, x) -> jax.Array:
        return jnp.sum(jax.vmap(lambda y, *a: self._summand(a).value(y))(self._gather_components(x), *self.parameters))

    def gradient(self, x) -> jax.Array:
        x = float64_array(x)
        found = jax.vmap(lambda y, *a: self._summand(a).gradient(y))(self._gather_components(x), *self.parameters)
        return self._scatter_gradients(found, x.shape[0])

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        def one(y, step, kept, *a):
            return self._summand(a).discrete_gradient(scheme, y, step, kept)

        y, step, kept = map(self._gather_components, (x, d, jnp.zeros_like(x) + compensation))
        return self._scatter_gradients(jax.vmap(one)(y, step, kept, *self.parameters), x.shape[0])

    def stage_gradients(self, scheme, path) -> jax.Array:
        def one(own: CollocationPath, *a):
            return self._summand(a).stage_gradients(scheme, own)

        compensation = jnp.zeros_like(path.start) + path.compensation
        gathered = CollocationPath(
            *jax.tree.map(self._gather_components, path._replace(compensation=compensation)[:7]), *path[7:]
        )
        further, symmetries = None if path.kronrod_samples is None else 1, None if path.symmetries is None else 2
        axes = CollocationPath(0, 0, 0, 1, 1, further, symmetries, None, None, None)  # type: ignore[arg-type]
        in_axes = axes, *(0 for _ in self.parameters)
        found = jax.vmap(one, in_axes=in_axes, out_axes=1)(gathered, *self.parameters)
        return jax.vmap(lambda g: self._scatter_gradients(g, path.start.shape[0]))(found)

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(self.places, dim)

    def check_components(self, dim: int, role: str) -> None:
        numbers = np.asarray(self.places)
        if numbers.size and not (numbers.min() >= 0 and numbers.max() < dim):
            outside = int(numbers[(numbers < 0) | (numbers >= dim)][0])
            raise InputError(f"{role} has a term at component {outside} of a state with {dim} components")

    def _summand(self, parameters) -> Energy:
        """The summand with these parameters."""
        if isinstance(self.phi, Energy):
            return self.phi
        return Function(lambda y: self.phi(y, *parameters), degree=self.degree)

    def _gather_components(self, x) -> jax.Array:
        """The components at each place, shape (..., n) to (..., m, r)."""
        if (run := self.places.contiguous_slice) is not None:
            return x[..., run].reshape(*x.shape[:-1], *self.places.shape)
        return x[..., np.asarray(self.places)]

    def _scatter_gradients(self, gradients, n: int) -> jax.Array:
        """The sum of covectors at the places, shape (m, r) to (n,)."""
        if (run := self.places.contiguous_slice) is not None:
            return jnp.zeros(n).at[run].add(gradients.ravel())
        return jnp.zeros(n).at[np.asarray(self.places)].add(gradients)


def _summand_value(model, y):
    phi, parameters = model
    return jnp.asarray(phi(y, *parameters))


def _check_places(places) -> Indices:
    numbers = np.asarray(places)
    if numbers.ndim != 2 or numbers.dtype.kind not in "iu" or 0 in numbers.shape:
        raise InputError(
            f"places are integers of shape (m, r), the r components that each of m summands depends on, not {places!r}"
        )
    return Indices(numbers)
