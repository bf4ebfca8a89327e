"""Energies of many bodies: one function evaluated at many places of a large state."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..errors import FunctionError, InputError
from ..tracing.interpret import polynomial_degree_bound
from ..tracing.traced import trace_callables
from .checks import checked_energy, with_polynomial_degrees
from .conditions import checked_numbers
from .energy import Energy, Function, float64_array
from .indices import Indices, clique_pattern
from .path import CollocationPath


class Each(Energy):
    """A sum of one function over many places of the state, ``sum_e phi(x[places_e], a_e)``, a_e parameters.

    It describes springs between bodies, or the bodies themselves. The function is written once and evaluated at all
    places together, at a cost proportional to their number, not to the square of the dimension of the state. Every
    summand has its own discrete gradient, corrected along its own components. The Jacobian is therefore as sparse as
    that of the exact gradient, so stiff systems of any size can be solved by sparse Newton iteration.

    Parameters
    ----------
    phi : function or Energy
        From the components at one place, shape (r,), and the parameters there, to a scalar; or an Energy of these
        components, equal at every place.
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
        self.places = places if isinstance(places, Indices) else _checked_places(places)
        self.parameters = tuple(checked_numbers(a, "a parameter") for a in parameters)
        m, r = self.places.shape
        for a in self.parameters:
            if a.shape[:1] != (m,):
                raise InputError(
                    f"parameters must have shape ({m}, ...), an entry for each of the {m} places, got {a.shape}"
                )
        if isinstance(phi, Energy):
            if parameters:
                raise InputError(
                    "parameters need a function phi(y, *parameters), got an Energy, which is equal at every place"
                )
            self.phi = with_polynomial_degrees(checked_energy(phi, r, "the energy at a place"), r)
            self.degree = self.phi.degree
            return
        if not callable(phi):
            raise FunctionError(f"phi must be a function or an Energy, got {type(phi).__name__}")
        zero_parameters = tuple(jnp.zeros(a.shape[1:]) for a in self.parameters)
        checked_energy(Function(lambda y: phi(y, *zero_parameters)), r, "the function at a place")
        self.phi = trace_callables(phi, lambda phi, *a: phi(*a), (r,), *(a.shape for a in zero_parameters))
        self.degree = polynomial_degree_bound(_summand_value, (self.phi, zero_parameters), r)

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
        gradients = jax.vmap(lambda y, *a: self._summand(a).gradient(y))(self._gather_components(x), *self.parameters)
        return self._scatter_gradients(gradients, x.shape[0])

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        def summand_discrete_gradient(y, step, summand_compensation, *a):
            return self._summand(a).discrete_gradient(scheme, y, step, summand_compensation)

        y, step, offset = map(self._gather_components, (x, d, jnp.zeros_like(x) + compensation))
        return self._scatter_gradients(
            jax.vmap(summand_discrete_gradient)(y, step, offset, *self.parameters), x.shape[0]
        )

    def stage_gradients(self, scheme, path) -> jax.Array:
        def summand_stage_gradients(summand_path: CollocationPath, *a):
            return self._summand(a).stage_gradients(scheme, summand_path)

        compensation = jnp.zeros_like(path.start) + path.compensation
        summand_paths = CollocationPath(
            *jax.tree.map(self._gather_components, path._replace(compensation=compensation)[:7]), *path[7:]
        )
        kronrod_axis = None if path.kronrod_samples is None else 1
        symmetry_axis = None if path.symmetries is None else 2
        axes = CollocationPath(0, 0, 0, 1, 1, kronrod_axis, symmetry_axis, None, None, None)  # type: ignore[arg-type]
        mapped_axes = axes, *(0 for _ in self.parameters)
        gradients = jax.vmap(summand_stage_gradients, in_axes=mapped_axes, out_axes=1)(summand_paths, *self.parameters)
        return jax.vmap(lambda g: self._scatter_gradients(g, path.start.shape[0]))(gradients)

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(self.places, dim)

    def check_components(self, dim: int, role: str) -> None:
        indices = np.asarray(self.places)
        if indices.size and not (indices.min() >= 0 and indices.max() < dim):
            invalid_index = int(indices[(indices < 0) | (indices >= dim)][0])
            raise InputError(f"{role} has a term at component {invalid_index}, but the state has {dim} components")

    def _summand(self, parameters) -> Energy:
        """Return the summand with these parameters."""
        if isinstance(self.phi, Energy):
            return self.phi
        return Function(lambda y: self.phi(y, *parameters), degree=self.degree)

    def _gather_components(self, x) -> jax.Array:
        """Return the components at each place, from shape (..., n) to (..., m, r)."""
        if (contiguous_slice := self.places.contiguous_slice) is not None:
            return x[..., contiguous_slice].reshape(*x.shape[:-1], *self.places.shape)
        return x[..., np.asarray(self.places)]

    def _scatter_gradients(self, gradients, n: int) -> jax.Array:
        """Return the sum of the gradients at the places, from shape (m, r) to (n,)."""
        if (contiguous_slice := self.places.contiguous_slice) is not None:
            return jnp.zeros(n).at[contiguous_slice].add(gradients.ravel())
        return jnp.zeros(n).at[np.asarray(self.places)].add(gradients)


def _summand_value(phi_and_parameters, y):
    phi, parameters = phi_and_parameters
    return jnp.asarray(phi(y, *parameters))


def _checked_places(places) -> Indices:
    indices = np.asarray(places)
    if indices.ndim != 2 or indices.dtype.kind not in "iu" or 0 in indices.shape:
        raise InputError(
            f"places must be integers of shape (m, r), the r components of each of m summands, got {places!r}"
        )
    return Indices(indices)
