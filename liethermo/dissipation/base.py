"""Dissipation: the part of a metriplectic system that produces entropy, one class per construction.

Each class defines a *force* ``f(x; dH, dS, dL)`` by the gradients that it is passed. With the gradients at x it is the
continuous dissipation ``K(x) grad S``. With discrete gradients it is the discretisation ``K_d``, which has the discrete
gradient of the energy in its kernel by construction: this is the rebuilding of BFM (4.6) and Remark 4.7, once for every
class.
"""

from __future__ import annotations

import functools
import operator
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy

from manifolds._pytree_module import Module, forward_to

from ..errors import InputError, refuse_replaced_members
from ..functions.energy import Energy
from ..functions.indices import Indices, union_pattern
from ..tracing.short_form import short_form
from .factor import Factor, concatenate_factors
from .geometry import Geometry, divergence_summands_of_fields

LawName = Literal["conserved", "nondecreasing", "nonincreasing"]
"""Name of the law of a function: how a construction lets it change."""
T = TypeVar("T")


REPLACED_MEMBERS = {
    "prepared": "bind_to",
    "own_residuals": "input_residuals",
    "generated": "generator_field",
    "heated_bath": "heated_bath_index",
    "keeps_casimirs": "preserves_casimirs",
    "noiseless": "is_noiseless",
    "symmetric": "is_symmetric",
    "velocity": "added_attitude_velocity",
    "divergence": "factor_divergence",
    "changes": "factor_divergence_terms",
    "can_drive_baths": "can_act_on_baths",
}
"""Former names of members that subclasses of :class:`Dissipation` override, and the present names."""


class Dissipation(Module):
    """Base class of dissipations: a subclass states its laws and defines :meth:`force`.

    Attributes
    ----------
    preserve : tuple of Energy
        Functions besides the energy that it keeps constant; for a sum the functions of all summands, in order.
    """

    __repr__ = short_form

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        refuse_replaced_members(cls, REPLACED_MEMBERS)

    @property
    def energy_law(self) -> LawName | None:
        """Law that the construction guarantees for the energy, or None."""
        return "conserved"

    @property
    def entropy_law(self) -> LawName | None:
        """Law that the construction guarantees for the entropy, or None."""
        return "nondecreasing"

    @property
    def is_symmetric(self) -> bool:
        """True if the force is ``K(x) grad S`` with a symmetric K.

        Otherwise it is a skew bracket with the energy [SML 6].
        """
        return True

    @property
    def is_noiseless(self) -> bool:
        """True for an external action without friction, to which no noise belongs."""
        return False

    def force_pattern(self, system: Geometry) -> scipy.sparse.csr_array | None:
        """Return the pattern, shape (n, n), of the state and gradient components that each force component depends on.

        Systems too large for a full Jacobian matrix use it. None if the pattern is not known.
        """
        return self.couplings(system)

    def couplings(self, system: Geometry) -> scipy.sparse.csr_array | None:
        """Return None. In 0.2 :meth:`force_pattern` had this name, and a subclass may still override it."""
        return None

    @property
    def preserves_casimirs(self) -> bool:
        """True if the force conserves every Casimir, for any gradients: it lies in the range of Pi(x)."""
        return False

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        """The summands of a sum, as a tuple; otherwise this dissipation alone."""
        return (self,)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        """Functions besides the energy that the dissipation keeps constant; a sum has those of all summands."""
        return ()

    @property
    def needs_entropy(self) -> bool:
        """True if the force contains the gradient of the entropy, so that the system must have an entropy."""
        return True

    @property
    def depends_on_time(self) -> bool:
        """True if the force depends explicitly on the time, for example by a rate that is a function of time."""
        return False

    @property
    def can_act_on_baths(self) -> bool:
        """True if the force may have components along bath entropies, in a system whose body has no entropy."""
        return False

    @property
    def acts_on_baths_alone(self) -> bool:
        """True if the force changes entropies of baths only, and depends on their temperatures only."""
        return False

    def bind_to(self, system: Geometry) -> Dissipation:
        """Return this dissipation, checked against its system and completed by properties of the system."""
        return self

    def input_residuals(self, system: Geometry, x) -> dict[str, jax.Array]:
        """Return the relative residuals at x, by name, of the conditions on functions that the user has given.

        A residual is divided by the size of the terms that cancel in it.
        """
        return {}

    @abstractmethod
    def force(self, system: Geometry, x, dH, dS, dL) -> jax.Array:
        """Return the dissipative part of ``x'``, shape (n,).

        Parameters
        ----------
        system : Geometry
        x : array, shape (n,)
        dH, dS : array, shape (n,)
            Gradients of energy and entropy, continuous or discrete. dS may be None for a system without an entropy.
        dL : tuple of array, shape (n,)
            Gradients of the functions in :attr:`preserve`, in their order.
        """

    @property
    def heated_bath_index(self) -> Indices | None:
        """Index of the bath that takes the heat, or one index for each site; None for the first bath."""
        return None

    @property
    def has_generator(self) -> bool:
        """True if :meth:`generator_field` computes the force without the gradient of the entropy."""
        return False

    def generator_field(self, system: Geometry, x, dH) -> jax.Array:
        """Return the force at x, shape (n,), from a generator that does not need the gradient of the entropy.

        It is the force for the exact gradients, and exists if :attr:`has_generator` is True. Lindblad's equation is a
        generator: it needs no logarithm of the density matrix.
        """
        raise NotImplementedError(f"{type(self).__name__} has no generator")

    def added_attitude_velocity(self, system: Geometry, x, dH, dS, dL) -> jax.Array | None:
        """Return the velocity sigma, shape (n,), that the force adds to that of an attitude; None for other forces.

        Internal friction of a body has the force ``Pi(x) sigma``, on a Lie algebra ``ad*_sigma x``, which carries the
        momentum along its coadjoint orbit. Then the attitude with ``g' = g hat(dH + sigma)`` conserves the spatial
        momentum. If the force changes internal momenta only, such as those of rotors, sigma is zero. A force of another
        form is an external torque, and the result is None. Whether it is None depends on the construction alone.
        """
        return None

    def factor(self, system: Geometry, x, dH, dL) -> Factor | None:
        """Return a factor B with ``B B^T = K``, where the force is K dS, or None if there is no factor.

        If a dissipation lowers the energy, the force is ``-K dH``. Noise and potentials of forces are made with B. For
        any gradients passed, ``B^T dH = 0`` if the energy is conserved, and ``B^T dL = 0`` for each gradient dL of a
        preserved function.
        """
        return None

    def factor_divergence(self, system: Geometry, x) -> jax.Array:
        """Return the divergence of each column of the factor B at x, shape (columns,).

        It is computed by differentiation, except where the construction makes it vanish.
        """
        B = self.factor_at_state(system, x)
        assert B is not None
        return jnp.zeros(B.size) if B.solenoidal else jnp.sum(self.factor_divergence_terms(system, x), axis=0)

    def factor_divergence_terms(self, system: Geometry, x) -> jax.Array:
        """Return the terms, shape (n, columns), whose sum over the first axis is :meth:`factor_divergence`."""

        def contract_columns(y, alpha) -> jax.Array:
            B = self.factor_at_state(system, y)
            assert B is not None
            return B.transpose_times(alpha)

        return divergence_summands_of_fields(system, x, contract_columns)

    def factor_at_state(self, system: Geometry, x) -> Factor | None:
        """Return the factor B at x, by the exact gradients of the energy and of the preserved functions; or None."""
        return self.factor(system, x, system.energy.gradient(x), tuple(L.gradient(x) for L in self.preserve))

    def added_momentum(self, dH, bracket_dH_dS) -> jax.Array | None:
        """Return the covector F, shape (n,), if the force is ``ad*_dH F`` (forced Euler-Poincaré); otherwise None.

        ``bracket_dH_dS`` is the Lie bracket ``[dH, dS]``, shape (n,). F is added to the momentum of the motion,
        ``x' = ad*_dH (x + F)``, so a step takes one coadjoint action instead of two.
        """
        return None

    def rate_of_change(self, system: Geometry, x, dH, dS, dL, gradient) -> jax.Array:
        """Return ``gradient . force``, the rate at which the dissipation changes a function with this gradient."""
        return gradient @ self.force(system, x, dH, dS, dL)

    def __add__(self, other: Dissipation) -> Dissipation:
        return DissipationSum((*self.terms, *other.terms))


class DissipationSum(Dissipation):
    """A sum of dissipations that act together; a law holds if every summand obeys it.

    Attributes
    ----------
    parts : tuple of Dissipation
        The summands. Names of parameters, such as ``dissipation.parts[1].rate``, contain the name of this field.
    """

    parts: tuple[Dissipation, ...]

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        return self.parts

    @property
    def energy_law(self) -> LawName | None:
        laws = {part.energy_law for part in self.parts}
        return None if None in laws else "nonincreasing" if "nonincreasing" in laws else "conserved"

    @property
    def entropy_law(self) -> LawName | None:
        laws = {part.entropy_law for part in self.parts} - {"conserved"}
        return "conserved" if not laws else ("nondecreasing" if laws == {"nondecreasing"} else None)

    @property
    def is_symmetric(self) -> bool:
        return all(part.is_symmetric for part in self.parts)

    def force_pattern(self, system):
        return union_pattern(part.force_pattern(system) for part in self.parts)

    @property
    def preserves_casimirs(self) -> bool:
        return all(part.preserves_casimirs for part in self.parts)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return tuple(L for part in self.parts for L in part.preserve)

    @property
    def needs_entropy(self) -> bool:
        return any(part.needs_entropy for part in self.parts)

    @property
    def depends_on_time(self) -> bool:
        return any(part.depends_on_time for part in self.parts)

    def bind_to(self, system: Geometry) -> Dissipation:
        return DissipationSum(tuple(part.bind_to(system) for part in self.parts))

    def force(self, system, x, dH, dS, dL):
        if not self.parts:
            return jnp.zeros_like(x)
        return sum(
            term.force(system, x, dH, dS, dL_term) for term, dL_term in terms_with_preserved_values(self.parts, dL)
        )

    @property
    def has_generator(self) -> bool:
        return bool(self.parts) and all(part.has_generator for part in self.parts)

    def generator_field(self, system, x, dH):
        return sum(part.generator_field(system, x, dH) for part in self.parts)

    def factor(self, system, x, dH, dL):
        factors = [term.factor(system, x, dH, dL_term) for term, dL_term in terms_with_preserved_values(self.parts, dL)]
        known_factors = [B for B in factors if B is not None]
        return concatenate_factors(known_factors) if len(known_factors) == len(factors) else None


ABSENT_DISSIPATION = DissipationSum(())
"""Dissipation of a system that has none: energy and entropy are conserved, and the force is zero."""


def nondecreasing_law_if(is_known: bool) -> LawName | None:
    """Return "nondecreasing", the law of an entropy, if it is known to hold; otherwise None."""
    return "nondecreasing" if is_known else None


def sum_dissipations(dissipations: Dissipation | Sequence[Dissipation] | None) -> Dissipation | None:
    """Return the ``dissipation`` argument of a system, None, one or a sequence, as one dissipation or None.

    Raises
    ------
    InputError
        If the list is empty, or an entry is not a dissipation.
    """
    if dissipations is None or isinstance(dissipations, Dissipation):
        return dissipations
    if not isinstance(dissipations, list | tuple):
        raise InputError(
            f"dissipation must be a Dissipation of this library, a list of them or None, "
            f"got {type(dissipations).__name__}"
        )
    if not dissipations:
        raise InputError("dissipation is an empty list. For a system without dissipation use None")
    for i, term in enumerate(dissipations):
        if not isinstance(term, Dissipation):
            raise InputError(f"dissipation[{i}] must be a Dissipation of this library, got {type(term).__name__}")
    return functools.reduce(operator.add, dissipations)


def dissipation_terms(dissipations: Dissipation | Sequence[Dissipation] | None) -> tuple[Dissipation, ...]:
    """Return the summands of the ``dissipation`` argument of a system: see :func:`sum_dissipations`."""
    total = sum_dissipations(dissipations)
    return () if total is None else total.terms


def dissipation_name(dissipation: Dissipation | None) -> str | None:
    """Return the name of the class of a dissipation, for provenances; None without a dissipation."""
    return None if dissipation is None else type(dissipation).__name__


def terms_with_preserved_values(
    terms: Sequence[Dissipation], values: Sequence[T]
) -> Iterator[tuple[Dissipation, tuple[T, ...]]]:
    """Yield each summand with its portion of ``values``, which belong to the functions that they preserve, in order."""
    start = 0
    for term in terms:
        end = start + len(term.preserve)
        yield term, tuple(values[start:end])
        start = end


class LiftedGeometry(NamedTuple):
    """The system and state of a lifted dissipation, with maps that lift gradients and lower velocities.

    Attributes
    ----------
    system : Geometry
        The inner system, in which the dissipation acts.
    x : array, shape (m,)
        The inner state.
    lift_covector : function
        Maps an outer gradient, shape (n,), to an inner one, shape (m,).
    lower_velocity : function
        Maps an inner velocity, shape (m,), to an outer one, shape (n,).
    preserves_solenoidal : bool
        True if an inner field of divergence zero is lowered to one.
    """

    system: Geometry
    x: jax.Array
    lift_covector: Callable
    lower_velocity: Callable
    preserves_solenoidal: bool = False

    @classmethod
    def from_leading_components(cls, system: Geometry, x, n: int) -> LiftedGeometry:
        """Return the geometry of an inner system whose states are the first n components of the outer ones."""
        n_extra = len(x) - n
        return cls(system, x[:n], lambda alpha: alpha[:n], lambda v: jnp.pad(v, (0, n_extra)), True)

    def inner_gradients(self, dH, dS, dL) -> tuple:
        """Return the gradients of energy, entropy and preserved functions in the inner system; dS may be None."""
        return (
            self.lift_covector(dH),
            None if dS is None else self.lift_covector(dS),
            tuple(map(self.lift_covector, dL)),
        )


class LiftedDissipation(Dissipation):
    """A dissipation in other coordinates or on a larger state, with the laws of the inner dissipation.

    Attributes
    ----------
    part : Dissipation
        The inner dissipation. Names of parameters, such as ``dissipation.part.rate``, contain the name of this field.
    functions : tuple of Energy
        The preserved functions of the inner dissipation, as functions of the outer state.
    """

    part: Dissipation
    functions: tuple[Energy, ...]

    @property
    def inner(self) -> Dissipation:
        return self.part

    @abstractmethod
    def lifted_geometry(self, system: Geometry, x) -> LiftedGeometry:
        """Return the inner system and state for the outer state x, with the maps between them."""

    def force(self, system, x, dH, dS, dL):
        geometry = self.lifted_geometry(system, x)
        return geometry.lower_velocity(
            self.inner.force(geometry.system, geometry.x, *geometry.inner_gradients(dH, dS, dL))
        )

    has_generator = forward_to("inner")

    def generator_field(self, system, x, dH):
        geometry = self.lifted_geometry(system, x)
        return geometry.lower_velocity(
            self.inner.generator_field(geometry.system, geometry.x, geometry.lift_covector(dH))
        )

    def factor(self, system, x, dH, dL):
        geometry = self.lifted_geometry(system, x)
        B = self.inner.factor(
            geometry.system, geometry.x, geometry.lift_covector(dH), tuple(map(geometry.lift_covector, dL))
        )
        if B is None:
            return None
        return B._replace(
            times=lambda w: geometry.lower_velocity(B.times(w)),
            solenoidal=geometry.preserves_solenoidal and B.solenoidal,
        )

    def input_residuals(self, system, x):
        geometry = self.lifted_geometry(system, x)
        return self.inner.input_residuals(geometry.system, geometry.x)

    @classmethod
    def lift_terms(
        cls, dissipation: Dissipation | None, pull_back_function: Callable[[Energy], Energy], *extra_fields
    ) -> Dissipation | None:
        """Return the lifted summands, their preserved functions pulled back; a subclass gets ``extra_fields`` too."""
        if dissipation is None:
            return None
        terms = tuple(
            cls(term, tuple(map(pull_back_function, term.preserve)), *extra_fields) for term in dissipation.terms
        )
        return terms[0] if len(terms) == 1 else DissipationSum(terms)

    energy_law = forward_to("inner")
    entropy_law = forward_to("inner")
    preserves_casimirs = forward_to("inner")
    is_symmetric = forward_to("inner")
    needs_entropy = forward_to("inner")

    @property
    def preserve(self):
        return self.functions


class SkewFriction(Dissipation):
    """Base of friction that heats by a skew bracket with the energy, so that the energy is conserved [SML 6].

    Attributes
    ----------
    law : str or None
        The law of the entropy.
    """

    law: LawName | None = eqx.field(static=True, kw_only=True, default=None)

    @property
    def entropy_law(self) -> LawName | None:
        return self.law

    needs_entropy = False
    is_symmetric = False


class Damping(Dissipation):
    """Base of dissipations that lower the energy of a body; the baths of a system take the heat.

    Attributes
    ----------
    bath : Indices or None
        The number of the bath that takes the heat, one for each site where sites differ; None for the first bath.
    """

    bath: Indices | None = eqx.field(static=True, kw_only=True, default=None)

    energy_law = "nonincreasing"
    needs_entropy = False

    @property
    def entropy_law(self) -> LawName | None:
        return None

    @property
    def heated_bath_index(self):
        return self.bath
