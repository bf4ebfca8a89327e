"""What the author of a kind of system says of it: all that the library does not find out by itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..dissipation.base import Dissipation, LawName
from ..dissipation.geometry import Geometry
from ..functions.energy import Energy
from ..functions.surface import Surface
from .baths import HeatBaths


class InvariantVerdicts(NamedTuple):
    """Names of functions of a system: of those that it conserves, and of those that this is not known of."""

    conserved_names: frozenset[str]
    undecided_names: frozenset[str]

    @classmethod
    def from_verdicts(cls, verdicts: Mapping[str, bool | None], declared: Iterable[str]) -> InvariantVerdicts:
        """From a verdict on each function; one that is declared counts as conserved unless it is seen not to be."""
        verdicts = {**verdicts, **{name: True for name in declared if verdicts.get(name, True) is None}}
        constant = {name for name, verdict in verdicts.items() if verdict}
        return cls(frozenset(constant), frozenset(name for name, verdict in verdicts.items() if verdict is None))


class SystemInterface(Geometry):
    """A kind of system: its data, and answers that a subclass may replace; :class:`System` has what follows from them.

    The attributes are those of :class:`System`.
    """

    entropy: Energy | None
    dissipation: Dissipation | None
    momentum_maps: dict[str, Energy]
    preserved_labels: tuple[str, ...] | None = eqx.field(static=True, kw_only=True, default=None)
    """What the functions are called that the dissipation has to preserve, one after another."""
    invariant_verdicts: InvariantVerdicts | None = eqx.field(static=True, kw_only=True, default=None)
    """What it conserves, where that has been found out near the states of a run."""
    baths: HeatBaths | None = eqx.field(kw_only=True, default=None)
    """What takes the heat of the dissipation; the entropies are the last components of a state."""
    production_name: ClassVar[str] = "dS/dt"
    domain: ClassVar[str] = ""
    """What a state of the system has to have beyond finite components, in words."""

    @property
    def kind(self) -> str:
        """What it is, for messages."""
        return type(self).__name__

    @property
    def body_dim(self) -> int:
        """Number of state components, those of baths left out."""
        return self.dim if self.baths is None else self.dim - self.baths.number

    @property
    def inertia(self) -> np.ndarray | None:
        """The tensor of inertia, shape (3, 3), of a rigid body whose state begins with its angular momentum.

        That with all parts inside held fast; None where the system is no such body, or the tensor is not known.
        """
        return None

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def field(self, x, dH, dS, dL=()) -> jax.Array:
        """``Pi(x) dH + force(x; dH, dS, dL)``, shape (n,), for gradients continuous or discrete.

        dS may be None of a system without an entropy. This is the one definition of the dynamics; integrators differ in
        the gradients they hand it.
        """
        motion = self.poisson.sharp(x, dH)
        return motion if self.dissipation is None else motion + self.dissipation.force(self, x, dH, dS, dL)

    @property
    def has_poisson_by_construction(self) -> bool:
        """Whether Pi is a Poisson tensor whatever the user gives, and dear to check when a system is built."""
        return False

    @property
    def has_generator(self) -> bool:
        """Whether the motion has a form without the gradient of the entropy: see :meth:`generated`."""
        return self.dissipation is not None and self.dissipation.has_generator

    def generator_field(self, x) -> jax.Array:
        """:meth:`field` at the gradients of the functions, in the form that the entropy is not in."""
        assert self.dissipation is not None
        dH = self.energy.gradient(x)
        return self.poisson.sharp(x, dH) + self.dissipation.generator_field(self, x, dH)

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Random states, shape (count, n): normal with standard deviation ``scale``, or the space's own points."""
        if self.space is None:
            found = scale * np.random.default_rng(seed).standard_normal((count, self.dim))
        else:
            found = np.asarray(self.space.to_vector(self.space.random(seed, (count,))))
        if self.baths is not None:
            found[..., self.body_dim :] *= min(1.0, 1.0 / scale) * self.baths.scale  # of a temperature that is finite
        return found

    def outside(self, x) -> str:
        """Why a state lies outside the domain of the system, in words; empty where it does not.

        For several states at one time, shape (..., n), the text is about one that does.
        """
        return ""

    def domain_margin(self, x) -> jax.Array | None:
        """A number that is positive where the parameters of the system allow a state x, shape (n,), and nowhere else.

        It is traced, for many systems at a time; :meth:`outside` has the words. None if any parameters allow any state.
        """
        return None

    def why_singular(self, x) -> str:
        """Why no run can start at x whose steps take the gradient of the entropy, in words; empty where one can.

        For several states it is as in :meth:`outside`.
        """
        return ""

    def specific_residuals(self, x) -> dict[str, jax.Array]:
        """Residuals at x of axioms that only this kind of system has, relative to what cancels, by their names."""
        return {}

    # -- what acts from outside ---------------------------------------------------------------------------------------

    @property
    def torque_name(self) -> str:
        """What a torque from outside is called; empty where none acts."""
        return ""

    @property
    def has_impulse(self) -> bool:
        """Whether a torque may change the momenta that a group turns, and not those of parts inside alone."""
        return bool(self.torque_name)

    @property
    def torque_invariant_casimirs(self) -> frozenset[str]:
        """The names of the Casimirs that no torque on the system changes."""
        return frozenset() if self.torque_name else frozenset(self.casimirs())

    @property
    def needs_attitude(self) -> bool:
        """Whether the torque depends on the attitude."""
        return False

    def external_torque(self, x) -> jax.Array | None:
        """The torque at a state, shape (n,), of a system at a time and an attitude; None where none acts."""
        return None

    def drop_torque(self) -> Self:
        """The system without a torque."""
        return self

    # -- laws ---------------------------------------------------------------------------------------------------------

    @property
    def energy_law(self) -> LawName | None:
        """ "conserved", "nonincreasing" under double-bracket dissipation, or None where there is no guarantee."""
        return "conserved" if self.dissipation is None else self.dissipation.energy_law

    @property
    def entropy_law(self) -> LawName | None:
        """ "nondecreasing", "conserved", or None where there is no entropy or no guarantee."""
        if self.entropy is None:
            return None
        return "conserved" if self.dissipation is None else self.dissipation.entropy_law

    def casimirs(self) -> dict[str, Energy]:
        """Casimirs of the Poisson structure that are known, by name."""
        return {}

    @property
    def has_all_casimirs(self) -> bool:
        """Whether every Casimir is known to be a function of :meth:`casimirs`."""
        return False

    @property
    def orbit_levels(self) -> tuple[int, frozenset[str]]:
        """How many momenta a group turns, and the names of the Casimirs on them: an orbit is a level of these."""
        return self.body_dim, frozenset(self.casimirs())

    @property
    def surface(self) -> Surface | None:
        """Where a step has to end, of constraints that are no functions of the system; None where there are none."""
        return None

    @property
    def ledger(self) -> dict[str, Energy]:
        """What the system receives from outside, recorded along a run, by name."""
        return {}

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of what is constant along a run and is no function with one value, such as a momentum in space."""
        return ()

    @property
    def balance_entries(self) -> tuple[str, ...]:
        """Entries of the ledger that the energy of a solution contains; its laws are stated without them."""
        return ()

    # -- states as users see them -------------------------------------------------------------------------------------

    def user_state(self, x) -> jax.Array:
        """The part of a state that is the user's, as points: what the functions of an event are functions of."""
        return self.points(x)

    def pullback(self, energy: Energy) -> Energy:
        """A function of the states that the user sees, as one of the states here."""
        return energy

    @property
    def state_blocks(self) -> tuple[slice, ...]:
        """The parts of a state that have sizes of their own, such as a momentum and the attitude beside it."""
        n = self.body_dim
        return (slice(None),) if self.baths is None else (slice(0, n), slice(n, self.dim))

    # -- for the engines ----------------------------------------------------------------------------------------------

    @property
    def can_unroll(self) -> bool:
        """Whether the compiled engine is worth trying: False where the system is known to need a loop."""
        return self.space is None or (self.space.is_smooth and self.space.dtype.kind != "c")

    @property
    def has_matrix_functions(self) -> bool:
        """Whether it is made of functions of matrices, which XLA compiles more slowly than the compiled engine."""
        return False

    @property
    def is_smooth(self) -> bool:
        """Whether the vector field can be differentiated twice and more."""
        return self.space is None or self.space.is_smooth

    def sparsity_pattern(self) -> scipy.sparse.csr_array | None:
        """Which components of the field depend on which of the state, discrete gradients included; None if not known.

        A pattern, shape (n, n). Large systems that know it are solved by sparse Newton iteration.
        """
        return None

    def residual_weights(self, x) -> jax.Array:
        """Factors of the components of the field, at a state, in which it depends on the state most nearly linearly.

        Newton's method is applied to the equations of a stiff step multiplied by these, shape (n,).
        """
        return jnp.ones_like(x)

    def component_scales(self, k) -> jax.Array:
        """The size that components of slopes, shape (..., n), are measured by, for differences: the largest for all."""
        size = jnp.max(jnp.abs(k))
        return jnp.full_like(k, jnp.where(size > 0.0, size, 1.0))
