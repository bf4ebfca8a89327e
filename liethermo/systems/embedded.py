"""A system on a manifold in the space of arrays around it: a system on R^n that stays on a surface.

The field is the same formula, asked for near the manifold too, where the covectors that it is handed and the velocities
that it gives are made tangent to the level sets of the constraints. So these are first integrals of it, and a method
has no more to do than to end each step on the level that it began on [:doc:`/explanation/exact_laws`].
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

from ..dissipation.base import LiftedDissipation, LiftedGeometry
from ..functions.checks import mark_polynomial_degrees
from ..functions.energy import Energy
from ..functions.surface import ConstraintSurface
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import subprogram
from .base import System

TANGENCY_RTOL = 1e-12
"""Largest component across the level sets, relative to the velocity, of a field that is along them by form."""

MANIFOLD_OFFSET = 0.05
"""How far off the manifold that is asked for, relative to the components of a point."""


class EmbeddedSystem(System):
    """The system on states x, shape (n,), the arrays of the space in one row. Made by :func:`embedded`.

    Attributes
    ----------
    manifold : System
    is_tangent : bool
        Whether the motion is along the level sets of the constraints as it is: then it is not projected.
    is_projection_trivial : bool
        Whether projecting it would leave it as it is, so that the force is not projected either.
    """

    manifold: System
    is_tangent: bool = eqx.field(static=True)
    is_projection_trivial: bool = eqx.field(static=True)

    def __init__(self, manifold: System, is_tangent: bool = False, is_projection_trivial: bool = False):
        self.manifold, self.is_tangent, self.is_projection_trivial = manifold, is_tangent, is_projection_trivial
        self.dim, self.space, self.baths = manifold.dim, None, manifold.baths
        self.energy = mark_polynomial_degrees(manifold.energy, self.dim)
        self.entropy = None if manifold.entropy is None else mark_polynomial_degrees(manifold.entropy, self.dim)
        as_they_are = is_tangent or isinstance(manifold.poisson, mf.NoPoisson)
        self.poisson = manifold.poisson if as_they_are else _TangentPoisson(manifold)
        self.dissipation = _TangentDissipation.lift_terms(
            manifold.dissipation, self._mark_polynomial_degrees, manifold, is_projection_trivial
        )
        self.momentum_maps = {name: self._mark_polynomial_degrees(J) for name, J in manifold.momentum_maps.items()}
        self.preserved_labels, self.invariant_verdicts = manifold.preserved_labels, manifold.invariant_verdicts

    def _mark_polynomial_degrees(self, energy: Energy) -> Energy:
        return mark_polynomial_degrees(energy, self.dim)

    kind = forward_to("manifold")

    @property
    def domain(self) -> str:  # type: ignore[override]
        return f"a point of {_require_space(self.manifold).name}"

    ledger = forward_to("manifold")

    @property
    def projection_flags(self) -> tuple[bool, bool]:
        """What is known of the motion, as the constructor is given it."""
        return self.is_tangent, self.is_projection_trivial

    @property
    def surface(self) -> ConstraintSurface:
        return ConstraintSurface(_require_space(self.manifold), self.is_tangent)

    def outside(self, x) -> str:
        space, x = _require_space(self.manifold), np.atleast_2d(x)
        if not np.isfinite(x).all():
            return ""
        inside = evaluate_at_points(_inside_indicator, self.surface, x) > 0.0
        if inside.all():
            return self.manifold.outside(x)
        return (
            f"the step leaves {space.name}: {space._why_off_space(np.asarray(self.points(x[inside.argmin()])), np.inf)}"
        )

    # -- states -------------------------------------------------------------------------------------------------------

    why_singular = forward_to("manifold")
    points = forward_to("manifold")
    state_array = forward_to("manifold")
    energy_of_vectors = forward_to("manifold")
    samples = forward_to("manifold")
    drop_baths = forward_to("manifold")
    _around = forward_to("manifold")

    def to_user_solution(self, solution):
        given = self.manifold.dissipation
        kind = None if given is None else type(given).__name__
        return self.manifold.to_user_solution(
            solution.with_provenance(system=type(self.manifold).__name__, dissipation=kind)
        )

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def at_time(self, t) -> System:
        return EmbeddedSystem(self.manifold.at_time(t), *self.projection_flags) if self.is_driven else self

    def raise_index(self, x, alpha):
        """What of a gradient is along the level sets: the direction of corrections."""
        return _tangential_part(self.manifold, x, alpha)

    @property
    def can_unroll(self) -> bool:
        return self.manifold.is_smooth

    is_smooth = forward_to("manifold")


class _TangentPoisson(PoissonBySharp):
    """``P Pi P``, P the projector to the level sets."""

    manifold: System

    dim = forward_to("manifold")

    def sharp(self, x, alpha):
        motion = self.manifold.poisson.sharp(x, _tangential_part(self.manifold, x, alpha))
        return _tangential_part(self.manifold, x, motion)


class _TangentDissipation(LiftedDissipation):
    """A dissipation that is handed the metric of the space, ``P K P`` near it.

    There P is symmetric, and what it gives is along the level sets; it need not be a projector, so that K between two
    of them does no work.
    """

    manifold: System
    is_projection_trivial: bool = eqx.field(static=True)

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        """It is handed what is along the level sets: near an equilibrium that has digits of its own."""
        along = functools.partial(_tangential_part, self.manifold, x)
        return LiftedGeometry(self.manifold, x, along, along)

    def force(self, system, x, dH, dS, dL):
        return _tangent_force(self, x, dH, dS, dL)

    def divergence(self, system, x):
        """That with the volume of the manifold."""
        return self.inner.divergence(self.manifold, system.surface.project_state(x))


@subprogram
def _tangent_force(force: _TangentDissipation, x, dH, dS, dL) -> jax.Array:
    at = force.lifted_geometry(force.manifold, x)
    found = force.inner.force(at.system, at.x, *at.lift_gradients(dH, dS, dL))
    return found if force.is_projection_trivial else at.lower(found)


def embed_in_arrays(system: System) -> System:
    """The system in the space around its manifold; itself on R^n, and where it can be run in charts alone."""
    if system.space is None or not system.space.can_be_embedded:
        return system
    if is_traced(system):
        return EmbeddedSystem(system)
    points = _sample_states(system)
    points = points * (1.0 + MANIFOLD_OFFSET * np.random.default_rng(0).uniform(-1.0, 1.0, points.shape))
    conforming, untouched = (
        np.nan_to_num(evaluate_at_points(_tangency_residuals, system, points), nan=np.inf) <= TANGENCY_RTOL
    ).all(axis=0)
    return EmbeddedSystem(system, bool(conforming), bool(conforming and untouched))


def _sample_states(system: System) -> np.ndarray:
    """A few states: of a space whose random points are made of normal numbers, without a compiler."""
    space = _require_space(system)
    if space._n_normals is None:
        return system.samples(3)
    return evaluate_at_points(
        _state_from_normals, space, np.random.default_rng(2).standard_normal((3, space._n_normals))
    )


def _state_from_normals(space: mf.Space, w):
    return space.to_vector(space._point_from_normals(w))


def _inside_indicator(surface: ConstraintSurface, x):
    """1 where the point of the surface next to a state is in the space, else 0."""
    return jnp.where(surface.is_in_space(surface.project_state(x)), 1.0, 0.0)


def _tangency_residuals(system: System, x):
    """What of a field is across the level sets, and what covectors across them do, relative to the field.

    Behind it what projecting the field would change: the projection need not be a projector off the manifold.
    """
    constraints, pull = jax.vjp(functools.partial(_constraint_values, _require_space(system)), x)
    random, number = np.random.default_rng(1), 3 + len(system.preserved)
    covectors = random.standard_normal((number, x.shape[0]))
    off = [pull(jnp.asarray(w))[0] for w in random.standard_normal((number, *constraints.shape))]
    fields = []
    for dH, dS, _, *dL in (covectors, [a + b for a, b in zip(covectors, off, strict=True)]):
        fields.append(system.field(x, dH, None if system.entropy is None else dS, tuple(dL)))
    size = jnp.max(jnp.abs(fields[0]))
    change = jax.jvp(functools.partial(_constraint_values, _require_space(system)), (x,), (fields[0],))[1]
    defect = jnp.maximum(jnp.max(jnp.abs(fields[1] - fields[0])), jnp.max(jnp.abs(change), initial=0.0))
    changed = jnp.max(jnp.abs(_tangential_part(system, x, fields[0]) - fields[0]))
    return jnp.stack([defect, changed]) / jnp.where(size > 0.0, size, 1.0)


def _constraint_values(space: mf.Space, x):
    return space._constraints(space.from_vector(x))


def _tangential_part(system: System, x, w):
    """An array less what would change the constraints of the space."""
    return _tangential_part_in_space(_require_space(system), x, w)


@subprogram
def _tangential_part_in_space(space: mf.Space, x, w):
    return space.to_vector(space._tangential_part(space.from_vector(x), space.from_vector(w)))


def _require_space(system: System) -> mf.Space:
    assert system.space is not None
    return system.space
