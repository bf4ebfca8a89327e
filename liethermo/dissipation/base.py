"""Dissipation: the part of a metriplectic system that produces entropy, one class per construction.

Each gives a *force* ``f(x; dH, dS, dL)``, written in terms of the gradients it is handed. Handed the gradients at x it
is the continuous dissipation ``K(x) grad S``; handed discrete gradients it is its discretisation ``K_d``, with the
discrete gradient of the energy in the kernel of K_d by construction: this is the rebuilding that BFM (4.6) and
Remark 4.7 ask for, once for every class.
"""

from __future__ import annotations

import functools
import operator
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import scipy

from manifolds._pytree_module import Module, forward_to

from ..errors import InputError
from ..functions.energy import Energy
from ..functions.indices import Indices, union_pattern
from .factor import Factor, concatenate_factors
from .geometry import Geometry

LawName = Literal["conserved", "nondecreasing", "nonincreasing"]
T = TypeVar("T")


class Dissipation(Module):
    """Base class. A subclass states its laws and gives :meth:`force`; :meth:`prepared` may complete and check it.

    Attributes
    ----------
    preserve : tuple of Energy
        Functions besides the energy that it keeps constant; of a sum those of all parts, one part after another.
    """

    @property
    def energy_law(self) -> LawName | None:
        """What the construction guarantees of the energy; None where it guarantees nothing."""
        return "conserved"

    @property
    def entropy_law(self) -> LawName | None:
        """What the construction guarantees of the entropy; None where it guarantees nothing."""
        return "nondecreasing"

    @property
    def is_symmetric(self) -> bool:
        """Whether the force is ``K(x) grad S``, K symmetric, and not a skew bracket with the energy alone [SML 6]."""
        return True

    @property
    def is_noiseless(self) -> bool:
        """Whether it is what acts from outside and no friction at all, so that no noise belongs to it."""
        return False

    def couplings(self, system: Geometry) -> scipy.sparse.csr_array | None:
        """Which components of the force depend on which components of the state and of the gradients it is handed.

        A pattern, shape (n, n), for systems too large for a full Jacobian matrix; None where it is not known.
        """
        return None

    @property
    def preserves_casimirs(self) -> bool:
        """Whether the force keeps every Casimir, whatever gradients it is handed: it lies in the range of Pi(x)."""
        return False

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        """The summands, or this one alone."""
        return (self,)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return ()

    @property
    def needs_entropy(self) -> bool:
        return True

    @property
    def can_drive_baths(self) -> bool:
        """Whether it acts on states with the entropies of baths behind them, where a body has no entropy of its own."""
        return False

    def bind_to(self, system: Geometry) -> Dissipation:
        """This dissipation, checked against the system it is used in and completed with what that determines."""
        return self

    def input_residuals(self, system: Geometry, x) -> dict[str, jax.Array]:
        """Residuals at x of what it was given and would have to mend, relative to what cancels, by their names."""
        return {}

    @abstractmethod
    def force(self, system: Geometry, x, dH, dS, dL) -> jax.Array:
        """The dissipative part of ``x'``, shape (n,).

        Parameters
        ----------
        system : Geometry
        x : array, shape (n,)
        dH, dS : array, shape (n,)
            Gradients of energy and entropy, continuous or discrete. dS may be None of a system without an entropy.
        dL : tuple of array, shape (n,)
            Gradients of the functions in :attr:`preserve`, in their order.
        """

    @property
    def heated_bath_index(self) -> Indices | None:
        """The number of the bath that takes its heat, or of that of each site; None for the first one."""
        return None

    @property
    def has_generator(self) -> bool:
        """Whether :meth:`generated` gives the force in a form that the gradient of the entropy is not in."""
        return False

    def generator_field(self, system: Geometry, x, dH) -> jax.Array:
        """The force at the gradients that energy and entropy have at x, shape (n,); see :attr:`has_generator`.

        Such a form needs no entropy, as Lindblad's equation needs no logarithm of the density matrix.
        """
        raise NotImplementedError(f"{type(self).__name__} has no such form")

    def velocity(self, system: Geometry, x, dH, dS, dL) -> jax.Array | None:
        """sigma with force ``Pi(x) sigma``, shape (n,), where the dissipation says that it acts so; else None.

        On a Lie algebra the force is ``ad*_sigma x``: friction inside a body, which carries the momentum along its
        coadjoint orbit by a further velocity. An attitude that follows it too keeps the momentum in space. A force of
        another form is a torque from outside. Whether it is None depends on the construction alone.
        """
        return None

    def factor(self, system: Geometry, x, dH, dL) -> Factor | None:
        """A matrix B with ``B B^T = K``, of the friction matrix K that the force is K dS with; None where it has none.

        Where a dissipation lowers the energy, the force is ``-K dH``. Noise is made with B, and so are potentials of
        forces; ``B^T dH = 0`` and ``B^T dL = 0`` for whatever gradients it is handed, where these are conserved.
        """
        return None

    def divergence(self, system: Geometry, x) -> jax.Array:
        """The divergence of every column of the factor at the gradients of the functions, shape (columns,).

        By differentiation, except where the construction makes it vanish.
        """
        B = self.continuous_factor(system, x)
        assert B is not None
        return jnp.zeros(B.size) if B.solenoidal else jnp.sum(self.divergence_terms(system, x), axis=0)

    def divergence_terms(self, system: Geometry, x) -> jax.Array:
        """What the divergence of each column is the sum of, shape (n, columns)."""
        return system.divergence_terms(x, lambda y, alpha: self.continuous_factor(system, y).transpose_times(alpha))  # type: ignore[union-attr]

    def continuous_factor(self, system: Geometry, x) -> Factor | None:
        """The factor at the gradients of the functions."""
        return self.factor(system, x, system.energy.gradient(x), tuple(L.gradient(x) for L in self.preserve))

    def added_momentum(self, dH, turned) -> jax.Array | None:
        """F with force ``ad*_dH F``, for dissipations of the form of forced Euler-Poincaré equations [BFM 3.2].

        ``turned`` is ``[dH, dS]``. Such an F joins the momentum of the motion, ``x' = ad*_dH (x + F)``: one coadjoint
        action instead of two. None where the force is of another form.
        """
        return None

    def rate_of_change(self, system: Geometry, x, dH, dS, dL, gradient) -> jax.Array:
        """``gradient . force``: the rate at which a function with this gradient changes by the dissipation."""
        return gradient @ self.force(system, x, dH, dS, dL)

    def __add__(self, other: Dissipation) -> Dissipation:
        return DissipationSum((*self.terms, *other.terms))


class DissipationSum(Dissipation):
    """A sum of dissipations acting together; a law holds if every part obeys it."""

    summands: tuple[Dissipation, ...]

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        return self.summands

    @property
    def energy_law(self) -> LawName | None:
        laws = {part.energy_law for part in self.summands}
        return None if None in laws else "nonincreasing" if "nonincreasing" in laws else "conserved"

    @property
    def entropy_law(self) -> LawName | None:
        laws = {part.entropy_law for part in self.summands} - {"conserved"}
        return "conserved" if not laws else ("nondecreasing" if laws == {"nondecreasing"} else None)

    @property
    def is_symmetric(self) -> bool:
        return all(part.is_symmetric for part in self.summands)

    def couplings(self, system):
        return union_pattern(part.couplings(system) for part in self.summands)

    @property
    def preserves_casimirs(self) -> bool:
        return all(part.preserves_casimirs for part in self.summands)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return tuple(L for part in self.summands for L in part.preserve)

    @property
    def needs_entropy(self) -> bool:
        return any(part.needs_entropy for part in self.summands)

    def bind_to(self, system: Geometry) -> Dissipation:
        return DissipationSum(tuple(part.bind_to(system) for part in self.summands))

    def force(self, system, x, dH, dS, dL):
        return sum(term.force(system, x, dH, dS, dL_part) for term, dL_part in terms_with_preserved(self, dL))

    @property
    def has_generator(self) -> bool:
        return all(part.has_generator for part in self.summands)

    def generator_field(self, system, x, dH):
        return sum(part.generator_field(system, x, dH) for part in self.summands)

    def factor(self, system, x, dH, dL):
        factors = [term.factor(system, x, dH, dL_part) for term, dL_part in terms_with_preserved(self, dL)]
        known_factors = [B for B in factors if B is not None]
        return concatenate_factors(known_factors) if len(known_factors) == len(factors) else None


def sum_dissipations(dissipations: Dissipation | Sequence[Dissipation] | None) -> Dissipation | None:
    """What a system is given as its dissipation: one, none, or a list or tuple of those that act together.

    Raises
    ------
    InputError
        If the list is empty, or an entry is not a dissipation.
    """
    if dissipations is None or isinstance(dissipations, Dissipation):
        return dissipations
    if not isinstance(dissipations, list | tuple):
        raise InputError(
            f"dissipation must be a Dissipation of this library, a list of them or None, not {type(dissipations).__name__}"
        )
    if not dissipations:
        raise InputError("dissipation is an empty list: a system without dissipation is given None")
    for i, term in enumerate(dissipations):
        if not isinstance(term, Dissipation):
            raise InputError(f"dissipation[{i}] must be a Dissipation of this library, not {type(term).__name__}")
    return functools.reduce(operator.add, dissipations)


def terms_with_preserved(dissipation: Dissipation, values: Sequence[T]) -> Iterator[tuple[Dissipation, tuple[T, ...]]]:
    """Each summand with its portion of what belongs to the functions in ``dissipation.preserve``, in their order."""
    start = 0
    for term in dissipation.terms:
        end = start + len(term.preserve)
        yield term, tuple(values[start:end])
        start = end


class LiftedGeometry(NamedTuple):
    """Where a dissipation acts that is carried to other states: the system and the state there, and the way to and fro.

    Attributes
    ----------
    system : Geometry
    x : array, shape (m,)
    lift : function
        From a gradient here, shape (n,), to that there, shape (m,).
    lower : function
        From a velocity there to that here.
    preserves_solenoidal : bool
        Whether a field of divergence zero there has none here.
    """

    system: Geometry
    x: jax.Array
    lift: Callable
    lower: Callable
    preserves_solenoidal: bool = False

    def lift_gradients(self, dH, dS, dL) -> tuple:
        """The gradients there; dS may be None."""
        return self.lift(dH), None if dS is None else self.lift(dS), tuple(map(self.lift, dL))


class LiftedDissipation(Dissipation):
    """A dissipation in other coordinates or on a larger state: it obeys the laws of the one that it is made from.

    Attributes
    ----------
    inner : Dissipation
    preserved_functions : tuple of Energy
        What that one preserves, as functions of the new state.
    """

    inner: Dissipation
    preserved_functions: tuple[Energy, ...]

    @abstractmethod
    def lifted_geometry(self, system: Geometry, x) -> LiftedGeometry:
        """Where it acts when it is asked for at x."""

    def force(self, system, x, dH, dS, dL):
        geometry = self.lifted_geometry(system, x)
        return geometry.lower(self.inner.force(geometry.system, geometry.x, *geometry.lift_gradients(dH, dS, dL)))

    has_generator = forward_to("inner")

    def generator_field(self, system, x, dH):
        geometry = self.lifted_geometry(system, x)
        return geometry.lower(self.inner.generator_field(geometry.system, geometry.x, geometry.lift(dH)))

    def factor(self, system, x, dH, dL):
        geometry = self.lifted_geometry(system, x)
        B = self.inner.factor(geometry.system, geometry.x, geometry.lift(dH), tuple(map(geometry.lift, dL)))
        if B is None:
            return None
        return B._replace(
            times=lambda w: geometry.lower(B.times(w)), solenoidal=geometry.preserves_solenoidal and B.solenoidal
        )

    def input_residuals(self, system, x):
        geometry = self.lifted_geometry(system, x)
        return self.inner.input_residuals(geometry.system, geometry.x)

    @classmethod
    def lift_terms(
        cls, dissipation: Dissipation | None, pullback: Callable[[Energy], Energy], *extra_fields
    ) -> Dissipation | None:
        """That of each summand, what it preserves pulled back; ``extra_fields`` is what a subclass has besides."""
        if dissipation is None:
            return None
        terms = tuple(cls(term, tuple(map(pullback, term.preserve)), *extra_fields) for term in dissipation.terms)
        return terms[0] if len(terms) == 1 else DissipationSum(terms)

    energy_law = forward_to("inner")
    entropy_law = forward_to("inner")
    preserves_casimirs = forward_to("inner")
    is_symmetric = forward_to("inner")
    needs_entropy = forward_to("inner")

    @property
    def preserve(self):
        return self.preserved_functions


class SkewFriction(Dissipation):
    """A skew bracket with the energy alone, so that the energy is conserved: friction that heats [SML 6]."""

    needs_entropy = False
    is_symmetric = False
