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

TANGENT = 1e-12
"""Largest component across the level sets, relative to the velocity, of a field that is along them by form."""

AWAY = 0.05
"""How far off the manifold that is asked for, relative to the components of a point."""


class EmbeddedSystem(System):
    """The system on states x, shape (n,), the arrays of the space in one row. Made by :func:`embedded`.

    Attributes
    ----------
    manifold : System
    conforming : bool
        Whether the motion is along the level sets of the constraints as it is: then it is not projected.
    untouched : bool
        Whether projecting it would leave it as it is, so that the force is not projected either.
    """

    manifold: System
    conforming: bool = eqx.field(static=True)
    untouched: bool = eqx.field(static=True)

    def __init__(self, manifold: System, conforming: bool = False, untouched: bool = False):
        self.manifold, self.conforming, self.untouched = manifold, conforming, untouched
        self.dim, self.space, self.baths = manifold.dim, None, manifold.baths
        self.energy = mark_polynomial_degrees(manifold.energy, self.dim)
        self.entropy = None if manifold.entropy is None else mark_polynomial_degrees(manifold.entropy, self.dim)
        as_they_are = conforming or isinstance(manifold.poisson, mf.NoPoisson)
        self.poisson = manifold.poisson if as_they_are else _Tangent(manifold)
        self.dissipation = _Force.lift_terms(manifold.dissipation, self._recognised, manifold, untouched)
        self.momentum_maps = {name: self._recognised(J) for name, J in manifold.momentum_maps.items()}
        self.preserved_as, self.decided = manifold.preserved_as, manifold.decided

    def _recognised(self, energy: Energy) -> Energy:
        return mark_polynomial_degrees(energy, self.dim)

    kind = forward_to("manifold")

    @property
    def domain(self) -> str:  # type: ignore[override]
        return f"a point of {_space(self.manifold).name}"

    ledger = forward_to("manifold")

    @property
    def known(self) -> tuple[bool, bool]:
        """What is known of the motion, as the constructor is given it."""
        return self.conforming, self.untouched

    @property
    def surface(self) -> ConstraintSurface:
        return ConstraintSurface(_space(self.manifold), self.conforming)

    def outside(self, x) -> str:
        space, x = _space(self.manifold), np.atleast_2d(x)
        if not np.isfinite(x).all():
            return ""
        inside = evaluate_at_points(_inside, self.surface, x) > 0.0
        if inside.all():
            return self.manifold.outside(x)
        return (
            f"the step leaves {space.name}: {space._why_off_space(np.asarray(self.points(x[inside.argmin()])), np.inf)}"
        )

    # -- states -------------------------------------------------------------------------------------------------------

    singular = forward_to("manifold")
    points = forward_to("manifold")
    numbers = forward_to("manifold")
    on_states = forward_to("manifold")
    samples = forward_to("manifold")
    drop_baths = forward_to("manifold")
    _around = forward_to("manifold")

    def presented(self, solution):
        given = self.manifold.dissipation
        kind = None if given is None else type(given).__name__
        return self.manifold.presented(solution.with_provenance(system=type(self.manifold).__name__, dissipation=kind))

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def at_time(self, t) -> System:
        return EmbeddedSystem(self.manifold.at_time(t), *self.known) if self.is_driven else self

    def raise_index(self, x, alpha):
        """What of a gradient is along the level sets: the direction of corrections."""
        return _along(self.manifold, x, alpha)

    @property
    def unrollable(self) -> bool:
        return self.manifold.smooth

    smooth = forward_to("manifold")


class _Tangent(PoissonBySharp):
    """``P Pi P``, P the projector to the level sets."""

    manifold: System

    dim = forward_to("manifold")

    def sharp(self, x, alpha):
        motion = self.manifold.poisson.sharp(x, _along(self.manifold, x, alpha))
        return _along(self.manifold, x, motion)


class _Force(LiftedDissipation):
    """A dissipation that is handed the metric of the space, ``P K P`` near it.

    There P is symmetric, and what it gives is along the level sets; it need not be a projector, so that K between two
    of them does no work.
    """

    manifold: System
    untouched: bool = eqx.field(static=True)

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        """It is handed what is along the level sets: near an equilibrium that has digits of its own."""
        along = functools.partial(_along, self.manifold, x)
        return LiftedGeometry(self.manifold, x, along, along)

    def force(self, system, x, dH, dS, dL):
        return _forced(self, x, dH, dS, dL)

    def divergence(self, system, x):
        """That with the volume of the manifold."""
        return self.inner.divergence(self.manifold, system.surface.project_state(x))


@subprogram
def _forced(force: _Force, x, dH, dS, dL) -> jax.Array:
    at = force.lifted_geometry(force.manifold, x)
    found = force.inner.force(at.system, at.x, *at.lift_gradients(dH, dS, dL))
    return found if force.untouched else at.lower(found)


def embedded(system: System) -> System:
    """The system in the space around its manifold; itself on R^n, and where it can be run in charts alone."""
    if system.space is None or not system.space.can_be_embedded:
        return system
    if is_traced(system):
        return EmbeddedSystem(system)
    points = _some_points(system)
    points = points * (1.0 + AWAY * np.random.default_rng(0).uniform(-1.0, 1.0, points.shape))
    conforming, untouched = (np.nan_to_num(evaluate_at_points(_across, system, points), nan=np.inf) <= TANGENT).all(
        axis=0
    )
    return EmbeddedSystem(system, bool(conforming), bool(conforming and untouched))


def _some_points(system: System) -> np.ndarray:
    """A few states: of a space whose random points are made of normal numbers, without a compiler."""
    space = _space(system)
    if space._n_normals is None:
        return system.samples(3)
    return evaluate_at_points(_from_normals, space, np.random.default_rng(2).standard_normal((3, space._n_normals)))


def _from_normals(space: mf.Space, w):
    return space.to_vector(space._point_from_normals(w))


def _inside(surface: ConstraintSurface, x):
    """1 where the point of the surface next to a state is in the space, else 0."""
    return jnp.where(surface.is_in_space(surface.project_state(x)), 1.0, 0.0)


def _across(system: System, x):
    """What of a field is across the level sets, and what covectors across them do, relative to the field.

    Behind it what projecting the field would change: the projection need not be a projector off the manifold.
    """
    constraints, pull = jax.vjp(functools.partial(_constraints, _space(system)), x)
    random, number = np.random.default_rng(1), 3 + len(system.preserved)
    covectors = random.standard_normal((number, x.shape[0]))
    off = [pull(jnp.asarray(w))[0] for w in random.standard_normal((number, *constraints.shape))]
    fields = []
    for dH, dS, _, *dL in (covectors, [a + b for a, b in zip(covectors, off, strict=True)]):
        fields.append(system.field(x, dH, None if system.entropy is None else dS, tuple(dL)))
    size = jnp.max(jnp.abs(fields[0]))
    change = jax.jvp(functools.partial(_constraints, _space(system)), (x,), (fields[0],))[1]
    defect = jnp.maximum(jnp.max(jnp.abs(fields[1] - fields[0])), jnp.max(jnp.abs(change), initial=0.0))
    changed = jnp.max(jnp.abs(_along(system, x, fields[0]) - fields[0]))
    return jnp.stack([defect, changed]) / jnp.where(size > 0.0, size, 1.0)


def _constraints(space: mf.Space, x):
    return space._constraints(space.from_vector(x))


def _along(system: System, x, w):
    """An array less what would change the constraints of the space."""
    return _along_in(_space(system), x, w)


@subprogram
def _along_in(space: mf.Space, x, w):
    return space.to_vector(space._tangential_part(space.from_vector(x), space.from_vector(w)))


def _space(system: System) -> mf.Space:
    assert system.space is not None
    return system.space
