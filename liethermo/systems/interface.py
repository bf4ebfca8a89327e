"""``SystemInterface``: the data and the answers that the author of a kind of system provides."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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
from .clock import Clock
from .conditions import RunCondition


class InvariantVerdicts(NamedTuple):
    """Names of the functions that a system conserves, and of those for which this is not known."""

    conserved_names: frozenset[str]
    undecided_names: frozenset[str]

    @classmethod
    def from_verdicts(cls, verdicts: Mapping[str, bool | None], declared: Iterable[str]) -> InvariantVerdicts:
        """Build from a verdict on each function; declared functions count as conserved unless False."""
        verdicts = {**verdicts, **{name: True for name in declared if verdicts.get(name, True) is None}}
        constant = {name for name, verdict in verdicts.items() if verdict}
        return cls(frozenset(constant), frozenset(name for name, verdict in verdicts.items() if verdict is None))


class EngineHints(NamedTuple):
    """Properties of a system on which an engine and a check may rely.

    Attributes
    ----------
    can_unroll : bool
        Whether the compiled engine is worth trying; False if the system needs a loop.
    has_matrix_functions : bool
        Whether the system consists of matrix functions, which XLA compiles more slowly than the compiled engine.
    is_smooth : bool
        Whether the vector field is at least twice differentiable.
    """

    can_unroll: bool = True
    has_matrix_functions: bool = False
    is_smooth: bool = True


class SystemInterface(Geometry):
    """Data of a kind of system, and methods that a subclass may override.

    :class:`System` derives everything else from them, and documents the attributes.
    """

    entropy: Energy | None
    dissipation: Dissipation | None
    momentum_maps: dict[str, Energy]
    preserved_labels: tuple[str, ...] | None = eqx.field(static=True, kw_only=True, default=None)
    """Names of the functions that the dissipation has to preserve, in their order."""
    invariant_verdicts: InvariantVerdicts | None = eqx.field(static=True, kw_only=True, default=None)
    """Functions that the system conserves, if they were determined near the states of a run."""
    baths: HeatBaths | None = eqx.field(kw_only=True, default=None)
    """Baths that take the heat of the dissipation; their entropies are the last components of a state."""
    production_name: ClassVar[str] = "dS/dt"
    domain: ClassVar[str] = ""
    """Condition, in words, that a state must satisfy beside finite components."""

    @property
    def kind(self) -> str:
        """Name of the kind of system, for messages."""
        return type(self).__name__

    @property
    def body_dim(self) -> int:
        """Number of state components, those of baths left out."""
        return self.dim if self.baths is None else self.dim - self.baths.number

    @property
    def inertia(self) -> np.ndarray | None:
        """The tensor of inertia, shape (3, 3), of a rigid body whose state begins with its angular momentum.

        All internal parts count as fixed. None if the system is no such body, or the tensor is not known.
        """
        return None

    def momentum_scale(self, x) -> jax.Array:
        """Return the size of terms that cancel in the momentum at x, shape (); zero if there are none."""
        return jnp.zeros(())

    @property
    def joint_ranges(self) -> tuple[tuple[str, int, int], ...]:
        """Names of bodies with a joint, and the first and the last but one index of its coordinates in a state."""
        return ()

    @property
    def velocity_functions(self) -> dict[str, Callable]:
        """Functions of a state, shape (n,), to velocities that a solution shows, shape (k,), by name.

        They are ``angular_velocity`` of a rigid body, in body axes, ``rotor_rates`` of its rotors relative to it, and
        ``joint_rates`` in the order of :attr:`joint_ranges`.
        """
        return {}

    @property
    def inner(self) -> SystemInterface | None:
        """The inner system, whose state is the first part of a state and whose laws hold here too; None without one."""
        return None

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def field(self, x, dH, dS, dL=()) -> jax.Array:
        """Return the vector field at x for given gradients, continuous or discrete, shape (n,).

        It is ``Pi(x) dH + force(x; dH, dS, dL)``. dS is None if the system has no entropy. This is the one definition
        of the dynamics; integrators differ in the gradients that they pass.
        """
        motion = self.poisson.sharp(x, dH)
        return motion if self.dissipation is None else motion + self.dissipation.force(self, x, dH, dS, dL)

    def entropy_gradient(self, x) -> jax.Array | None:
        """Return the gradient of the entropy at x, shape (n,); None without an entropy."""
        return None if self.entropy is None else self.entropy.gradient(x)

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Return random states, shape (count, n): normal with standard deviation ``scale``, or points of the space."""
        if self.space is None:
            states = scale * np.random.default_rng(seed).standard_normal((count, self.dim))
        else:
            states = np.asarray(self.space.to_vector(self.space.random(seed, (count,))))
        if self.baths is not None:
            states[..., self.body_dim :] *= min(1.0, 1.0 / scale) * self.baths.scale  # keeps temperatures finite
        return states

    def resting_guess(self) -> np.ndarray:
        """Return a state from which a steady state is looked for, shape (n,): a random one, baths at entropy zero."""
        x = np.array(self.samples(1)[0])
        x[self.body_dim :] = 0.0
        return x

    def outside(self, x) -> str:
        """Explain why a state lies outside the domain of the system; "" if it lies inside.

        For several states, shape (..., n), the text is about one that lies outside.
        """
        return ""

    def domain_margin(self, x) -> jax.Array | None:
        """Return a number that is positive if and only if the parameters of the system allow the state x, shape (n,).

        JAX traces it, for many systems at once; :meth:`outside` explains it in words. None if all parameters allow
        all states.
        """
        return None

    def why_singular(self, x) -> str:
        """Explain why the gradient of the entropy is infinite at x, so that no run can start there; "" if it is finite.

        For several states, shape (..., n), the text is about one of them.
        """
        return ""

    def run_conditions(self, x: np.ndarray, t: np.ndarray, guarantees: frozenset[str]) -> tuple[RunCondition, ...]:
        """Return conditions of a run beside its laws, such as positive density matrices, for the rows of an audit.

        Parameters
        ----------
        x : array, shape (m, n)
            States of the run.
        t : array, shape (k,)
            Times of the run, such as those of the states.
        guarantees : frozenset of str
            What the method keeps to rounding: see :class:`liethermo.integrators.base.Guarantee`.
        """
        return ()

    def specific_residuals(self, x) -> dict[str, jax.Array]:
        """Return residuals at x, by name, of axioms of this kind of system alone, relative to the terms that cancel."""
        return {}

    # -- what acts from outside ---------------------------------------------------------------------------------------

    @property
    def is_driven(self) -> bool:
        """True if the energy depends on time, or a torque acts, so that work is done from outside."""
        return self.energy.depends_on_time

    def at_time(self, t, attitude=None) -> Self:
        """Return the system with its energy and its torque frozen at the time t; itself if none depends on time.

        A torque may need an attitude too, shape (m, m).
        """
        del attitude  # without a torque
        return eqx.tree_at(lambda system: system.energy, self, self.energy.at_time(t)) if self.is_driven else self

    @property
    def torque_name(self) -> str:
        """Name of the external torque; "" if none acts."""
        return ""

    @property
    def has_impulse(self) -> bool:
        """True if a torque may change momenta that the group acts on, and not only those of internal parts."""
        return bool(self.torque_name)

    @property
    def torque_invariant_casimirs(self) -> frozenset[str]:
        """Names of the Casimirs that the torque leaves constant."""
        return frozenset() if self.torque_name else frozenset(self.casimirs())

    @property
    def needs_attitude(self) -> bool:
        """True if the torque depends on the attitude."""
        return False

    def external_torque(self, x) -> jax.Array | None:
        """Return the external torque at a state, shape (n,), at a fixed time and attitude; None if none acts."""
        return None

    def external_velocity(self, x, dH) -> jax.Array | None:
        """Return the velocity that acts from outside, shape (n,), with temperatures from the gradient dH, shape (n,).

        It is :meth:`external_torque` for torques, which do not depend on the gradient.
        """
        return self.external_torque(x)

    @property
    def torque_entropy_law(self) -> LawName:
        """Law of the entropy under what acts from outside alone: "conserved", or "nondecreasing" if it heats."""
        return "conserved"

    def drop_torque(self) -> Self:
        """Return the system without its external torque."""
        return self

    @property
    def clock(self) -> Clock | None:
        """Components of a state that hold the time and the work, with the span of the run; None if there are none."""
        return None

    # -- spins ----------------------------------------------------------------------------------------------------

    def solve_at_spins(self, x, dH, dS, noise_rates, others, half_step, k) -> jax.Array | None:
        """Return the slopes of a step from earlier slopes k, solved at each spin in its present field; None without
        spins.

        A solution of ``k = v`` is kept, where v is the field plus the turn by noise plus ``others``. Each spin gets
        ``k_i + u_i`` with ``u_i - half_step J_i u_i = v_i - k_i``, J_i the derivative of v_i by s_i at the given
        gradient dH, and the other components get v.

        Parameters
        ----------
        x, dH, dS : array, shape (n,)
            Midpoint of the step and gradients there.
        noise_rates : array, shape (sites, 3) or (1, 3)
            Angular velocities by noise (1 / time).
        others : array, shape (n,)
            Velocity by other noise.
        half_step : array, shape ()
        k : array, shape (n,)
        """
        return None

    # -- laws ---------------------------------------------------------------------------------------------------------

    @property
    def dissipations(self) -> tuple[Dissipation, ...]:
        """The summands of the dissipation; () without one."""
        return () if self.dissipation is None else self.dissipation.terms

    @property
    def preserved(self) -> tuple[Energy, ...]:
        """Functions that the dissipation, or one of its summands, has to preserve beside the energy."""
        return () if self.dissipation is None else self.dissipation.preserve

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
        """Return the known Casimirs of the Poisson structure, by name."""
        return {}

    @property
    def has_all_casimirs(self) -> bool:
        """True if every Casimir is known to be a function of :meth:`casimirs`."""
        return False

    @property
    def orbit_levels(self) -> tuple[int, frozenset[str]]:
        """Number of momenta that the group acts on, and names of the Casimirs whose common levels are the orbits."""
        return self.body_dim, frozenset(self.casimirs())

    @property
    def surface(self) -> Surface | None:
        """Surface on which every step has to end, for constraints beside conserved functions; None without any."""
        return None

    @property
    def ledger(self) -> dict[str, Energy]:
        """Work and heat that the system receives from outside, recorded along a run, by name."""
        return {}

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of constants of the motion with several components, such as a momentum in space."""
        return ()

    # -- states as users see them -------------------------------------------------------------------------------------

    def user_state(self, x) -> jax.Array:
        """Return the state as the user sees it, as a point; event functions receive it."""
        return self.points(x)

    def pullback(self, energy: Energy) -> Energy:
        """Return a function of the states of this system from a function of the states that the user sees."""
        return energy

    @property
    def state_blocks(self) -> tuple[slice, ...]:
        """Parts of a state that have scales of their own, such as a momentum and an attitude."""
        n = self.body_dim
        return (slice(None),) if self.baths is None else (slice(0, n), slice(n, self.dim))

    # -- for the engines ----------------------------------------------------------------------------------------------

    @property
    def hints(self) -> EngineHints:
        """Return the properties that engines and checks may rely on, by default those known from the space."""
        is_smooth = self.space is None or self.space.is_smooth
        is_complex = self.space is not None and self.space.dtype.kind == "c"
        return EngineHints(can_unroll=is_smooth and not is_complex, is_smooth=is_smooth)

    def sparsity_pattern(self) -> scipy.sparse.csr_array | None:
        """Return the sparsity pattern of the Jacobian of the field, shape (n, n); None if it is not known.

        It holds for discrete gradients too. Large systems with a pattern are solved by sparse Newton iteration.
        """
        return None

    def residual_weights(self, x) -> jax.Array:
        """Return factors, shape (n,), that make the components of the field nearly linear in the state.

        Newton's method solves the equations of a stiff step multiplied by these factors.
        """
        return jnp.ones_like(x)

    def component_scales(self, k) -> jax.Array:
        """Return the scale of each component of slopes, shape (..., n), for finite differences: the largest of all."""
        scale = jnp.max(jnp.abs(k))
        return jnp.full_like(k, jnp.where(scale > 0.0, scale, 1.0))
