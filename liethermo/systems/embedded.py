"""``EmbeddedSystem``: a system on a manifold, extended to the arrays around it.

The formula of the vector field is used near the manifold too. Covectors and velocities are projected to the level sets
of the constraints, so the constraints are first integrals. A method only has to end each step on the level on which
the step began [:doc:`/explanation/exact_laws`].
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import forward_to
from manifolds.structures.poisson import PoissonBySharp

from ..dissipation.base import LiftedDissipation, LiftedGeometry, dissipation_name
from ..functions.checks import with_polynomial_degrees
from ..functions.energy import Energy
from ..functions.surface import ConstraintSurface
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import jit_if_traced
from .base import System
from .domain import Domain
from .interface import EngineHints, WrappedSystem

TANGENCY_RTOL = 1e-12
"""Largest component normal to the level sets, relative to the velocity, of a field that counts as tangent to them."""

MANIFOLD_OFFSET = 0.05
"""Distance from the manifold at which tangency is tested, relative to the components of a point."""


class EmbeddedSystem(System):
    """A system on a manifold, extended to the flat arrays around it, shape (n,); :func:`embed_in_arrays` builds it.

    Attributes
    ----------
    manifold_system : System
    is_tangent : bool
        Whether the motion is tangent to the level sets of the constraints without a projection.
    is_projection_trivial : bool
        Whether the projection leaves the motion unchanged, so that the force is not projected either.
    """

    manifold_system: System
    is_tangent: bool = eqx.field(static=True)
    is_projection_trivial: bool = eqx.field(static=True)

    def __init__(self, manifold_system: System, is_tangent: bool = False, is_projection_trivial: bool = False):
        self.manifold_system, self.is_tangent, self.is_projection_trivial = (
            manifold_system,
            is_tangent,
            is_projection_trivial,
        )
        self.dim, self.space, self.baths = manifold_system.dim, None, manifold_system.baths
        self.energy = with_polynomial_degrees(manifold_system.energy, self.dim)
        self.entropy = (
            None if manifold_system.entropy is None else with_polynomial_degrees(manifold_system.entropy, self.dim)
        )
        needs_no_projection = is_tangent or isinstance(manifold_system.poisson, mf.NoPoisson)
        self.poisson = manifold_system.poisson if needs_no_projection else _TangentPoisson(manifold_system)
        self.dissipation = _TangentDissipation.lift_terms(
            manifold_system.dissipation, self._mark_polynomial_degrees, manifold_system, is_projection_trivial
        )
        self.momentum_maps = {
            name: self._mark_polynomial_degrees(J) for name, J in manifold_system.momentum_maps.items()
        }
        self.preserved_labels, self.invariant_verdicts = (
            manifold_system.preserved_labels,
            manifold_system.invariant_verdicts,
        )

    def _mark_polynomial_degrees(self, energy: Energy) -> Energy:
        """Return an energy with the degree set in each function that is a polynomial of the components of a state."""
        return with_polynomial_degrees(energy, self.dim)

    kind = forward_to("manifold_system")

    @property
    def domain(self) -> Domain:
        name, why_entropy_gradient_infinite = (
            _space_of(self.manifold_system).name,
            self.manifold_system.domain.why_entropy_gradient_infinite,
        )
        return Domain(f"a point of {name}", self._why_outside_domain, why_entropy_gradient_infinite)

    ledger_functions = forward_to("manifold_system")

    @property
    def wrapped_system(self) -> WrappedSystem:
        return WrappedSystem(self.manifold_system, EmbeddedSystem, (self.is_tangent, self.is_projection_trivial))

    @property
    def constraint_surface(self) -> ConstraintSurface:
        return ConstraintSurface(_space_of(self.manifold_system), self.is_tangent)

    def _why_outside_domain(self, x) -> str:
        space, x = _space_of(self.manifold_system), np.atleast_2d(x)
        if not np.isfinite(x).all():
            return ""
        is_inside = evaluate_at_points(_inside_indicator, self.constraint_surface, x) > 0.0
        if is_inside.all():
            return self.manifold_system.domain.why_outside(x)
        point = np.asarray(self.points(x[is_inside.argmin()]))
        return f"the step leaves {space.name}: {space._why_off_space(point, np.inf)}"

    # -- states -------------------------------------------------------------------------------------------------------

    points = forward_to("manifold_system")
    state_array = forward_to("manifold_system")
    energy_of_flat_states = forward_to("manifold_system")
    samples = forward_to("manifold_system")
    drop_baths = forward_to("manifold_system")

    def to_user_solution(self, solution):
        name = dissipation_name(self.manifold_system.dissipation)
        return self.manifold_system.to_user_solution(
            solution.with_provenance(system=type(self.manifold_system).__name__, dissipation=name)
        )

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def at_time(self, t, attitude=None) -> EmbeddedSystem:
        return (
            EmbeddedSystem(self.manifold_system.at_time(t), *self.wrapped_system.arguments) if self.is_driven else self
        )

    def raise_index(self, x, alpha):
        """Return the part of a gradient tangent to the constraint level sets, along which corrections move a state."""
        return _tangential_part(self.manifold_system, x, alpha)

    @property
    def engine_hints(self) -> EngineHints:
        is_smooth = self.manifold_system.engine_hints.is_smooth
        return super().engine_hints._replace(can_unroll=is_smooth, is_smooth=is_smooth)


class _TangentPoisson(PoissonBySharp):
    """The Poisson tensor ``P Pi P`` near a manifold, with the projector P to the level sets of the constraints."""

    manifold_system: System

    dim = forward_to("manifold_system")

    def sharp(self, x, alpha):
        motion = self.manifold_system.poisson.sharp(x, _tangential_part(self.manifold_system, x, alpha))
        return _tangential_part(self.manifold_system, x, motion)


class _TangentDissipation(LiftedDissipation):
    """The dissipation ``P K P`` near a manifold, with the metric of the space.

    P is symmetric and maps to tangent vectors of the level sets, so K between two of them does no work. P need not be a
    projector off the manifold.
    """

    manifold_system: System
    is_projection_trivial: bool = eqx.field(static=True)

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        """Return the system on the manifold, with gradients and velocities projected to the constraint level sets."""
        project = functools.partial(_tangential_part, self.manifold_system, x)
        return LiftedGeometry(self.manifold_system, x, project, project)

    def force(self, system, x, dH, dS, dL):
        return _tangent_force(self, x, dH, dS, dL)

    def factor_divergence(self, system, x):
        """Return the divergence of the noise with respect to the volume of the manifold."""
        return self.inner.factor_divergence(self.manifold_system, system.constraint_surface.project_state(x))


@jit_if_traced
def _tangent_force(dissipation: _TangentDissipation, x, dH, dS, dL) -> jax.Array:
    """Return the force of the inner dissipation, projected to the tangent space of the level sets, shape (n,)."""
    geometry = dissipation.lifted_geometry(dissipation.manifold_system, x)
    velocity = dissipation.inner.force(geometry.system, geometry.x, *geometry.inner_gradients(dH, dS, dL))
    return velocity if dissipation.is_projection_trivial else geometry.lower_velocity(velocity)


def embed_in_arrays(system: System) -> System:
    """Return the system extended to the arrays around its space; unchanged on R^n, or if only charts are possible."""
    if system.space is None or not system.space.can_be_embedded:
        return system
    if is_traced(system):
        return EmbeddedSystem(system)
    points = _sample_states(system)
    points = points * (1.0 + MANIFOLD_OFFSET * np.random.default_rng(0).uniform(-1.0, 1.0, points.shape))
    residuals = np.nan_to_num(evaluate_at_points(_tangency_residuals, system, points), nan=np.inf)
    is_tangent, is_unchanged = (residuals <= TANGENCY_RTOL).all(axis=0)
    return EmbeddedSystem(system, bool(is_tangent), bool(is_tangent and is_unchanged))


def _sample_states(system: System) -> np.ndarray:
    """Return three random states, shape (3, n), without compiling a program if the space allows it."""
    space = _space_of(system)
    if space._n_gaussian_samples is None:
        return system.samples(3)
    return evaluate_at_points(
        _state_from_gaussian_samples, space, np.random.default_rng(2).standard_normal((3, space._n_gaussian_samples))
    )


def _state_from_gaussian_samples(space: mf.Space, gaussian_samples):
    """Return the state, shape (n,), that a space computes from standard normal numbers."""
    return space.to_vector(space._point_from_gaussian_samples(gaussian_samples))


def _inside_indicator(surface: ConstraintSurface, state):
    """Return 1.0 if the point of the surface nearest to a state is in the space, otherwise 0.0."""
    return jnp.where(surface.is_in_space(surface.project_state(state)), 1.0, 0.0)


def _tangency_residuals(system: System, x):
    """Return the part of the field that is not tangent, and its change by projection, relative to its norm.

    A field is tangent if it conserves the constraints and does not depend on normal components of covectors. The
    second value is separate, because off the manifold the projection need not be a projector.
    """
    constraints, pull = jax.vjp(functools.partial(_constraint_values, _space_of(system)), x)
    random, n_covectors = np.random.default_rng(1), 3 + len(system.preserved_functions)
    covectors = random.standard_normal((n_covectors, x.shape[0]))
    normals = [pull(jnp.asarray(w))[0] for w in random.standard_normal((n_covectors, *constraints.shape))]
    fields = []
    for dH, dS, _, *dL in (covectors, [a + b for a, b in zip(covectors, normals, strict=True)]):
        fields.append(system.field(x, dH, None if system.entropy is None else dS, tuple(dL)))
    norm = jnp.max(jnp.abs(fields[0]))
    constraint_rates = jax.jvp(functools.partial(_constraint_values, _space_of(system)), (x,), (fields[0],))[1]
    residual = jnp.maximum(jnp.max(jnp.abs(fields[1] - fields[0])), jnp.max(jnp.abs(constraint_rates), initial=0.0))
    change = jnp.max(jnp.abs(_tangential_part(system, x, fields[0]) - fields[0]))
    return jnp.stack([residual, change]) / jnp.where(norm > 0.0, norm, 1.0)


def _constraint_values(space: mf.Space, x):
    """Return the values of the constraints of a space at a state."""
    return space._constraints(space.from_vector(x))


def _tangential_part(system: System, x, w):
    """Return an array w without the component that would change the constraints of the space."""
    return _tangential_part_in_space(_space_of(system), x, w)


@jit_if_traced
def _tangential_part_in_space(space: mf.Space, x, w):
    """Return an array w without the component that would change the constraints of a space."""
    return space.to_vector(space._tangential_part(space.from_vector(x), space.from_vector(w)))


def _space_of(system: System) -> mf.Space:
    """Return the space of a system on a manifold."""
    assert system.space is not None
    return system.space


class ChartSystem(System):
    """A system on a manifold, in coordinates c of a chart, shape (dim,).

    Parameters
    ----------
    system : System
        A system on a manifold.
    coordinates : manifolds.Coordinates
    place : manifolds.Place, optional
        Fixed point at which Pi and K are evaluated, instead of the point with the coordinates c.
    start : array, optional
        State vector at the start of the step, for a system that serves one step.
    """

    manifold_system: System
    coordinates: mf.Coordinates
    place: mf.Place | None
    start: jax.Array | None

    def __init__(self, system: System, coordinates: mf.Coordinates, place: mf.Place | None = None, start=None):
        assert system.space is not None
        self.manifold_system, self.coordinates, self.place, self.start = system, coordinates, place, start
        self.dim, self.space, self.momentum_maps = system.space.dim, None, {}
        self.energy = self.pullback(system.energy)
        self.entropy = None if system.entropy is None else self.pullback(system.entropy)
        trivial = isinstance(system.poisson, mf.NoPoisson)
        self.poisson = mf.NoPoisson(self.dim) if trivial else _ChartPoisson(system, coordinates, place)
        self.momentum_maps = {name: self.pullback(J) for name, J in system.momentum_maps.items()}
        self.dissipation = _ChartDissipation.lift_terms(system.dissipation, self.pullback, system, coordinates, place)
        self.preserved_labels, self.invariant_verdicts = system.preserved_labels, system.invariant_verdicts

    def pullback(self, energy: Energy) -> Energy:
        """Return a function of chart coordinates from a function of states."""
        space = self.manifold_system.space
        assert space is not None
        return energy.map_terms(lambda term: term.pullback_to_chart(self.coordinates, space, self.start))

    @property
    def engine_hints(self) -> EngineHints:
        return super().engine_hints._replace(
            is_smooth=self.manifold_system.engine_hints.is_smooth, has_fixed_levels=False
        )

    def cache_tensors_at(self, x) -> System:
        if self.place is not None:
            return self
        return ChartSystem(self.manifold_system, self.coordinates, self.coordinates.at(x), self.start)

    def field(self, x, dH, dS, dL=()):
        point = _ChartPoint(self.manifold_system, self.coordinates, self.place, x)
        dS, dL = None if dS is None else point.lift_covector(dS), tuple(map(point.lift_covector, dL))
        return point.lower_velocity(self.manifold_system.field(point.state, point.lift_covector(dH), dS, dL))


class _ChartPoint:
    """A point of a manifold, with maps of covectors and velocities between chart coordinates and states."""

    def __init__(self, system: System, coordinates: mf.Coordinates, place: mf.Place | None, c):
        assert system.space is not None
        self._space, self._place = system.space, coordinates.at(c) if place is None else place
        self.state = self._space.to_vector(self._place.point)

    def lift_covector(self, alpha):
        """Return the covector of states, shape (n,), of a covector of coordinates, shape (dim,)."""
        return self._space.to_vector(self._place.lift(alpha).conj())

    def lower_velocity(self, v):
        """Return the velocity of coordinates, shape (dim,), of a velocity of states, shape (n,)."""
        return self._place.lower(self._space.from_vector(v))


class _ChartPoisson(PoissonBySharp):
    """The Poisson structure of a system in coordinates of a chart."""

    system: System
    coordinates: mf.Coordinates
    place: mf.Place | None

    @property
    def dim(self) -> int:
        assert self.system.space is not None
        return self.system.space.dim

    def sharp(self, x, alpha):
        point = _ChartPoint(self.system, self.coordinates, self.place, x)
        return point.lower_velocity(self.system.poisson.sharp(point.state, point.lift_covector(alpha)))


class _ChartDissipation(LiftedDissipation):
    """The dissipation of a system in coordinates of a chart."""

    system: System
    coordinates: mf.Coordinates
    place: mf.Place | None

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        point = _ChartPoint(self.system, self.coordinates, self.place, x)
        return LiftedGeometry(self.system, point.state, point.lift_covector, point.lower_velocity)

    def factor_divergence(self, system, x):
        """Return the divergence of the noise with respect to the volume of the manifold."""
        return self.inner.factor_divergence(
            self.system, _ChartPoint(self.system, self.coordinates, self.place, x).state
        )
