"""``SystemInterface``: the data and the answers that the author of a kind of system provides."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..dissipation.base import ABSENT_DISSIPATION, Dissipation, LawName
from ..dissipation.geometry import Geometry
from ..errors import InputError, refuse_replaced_members
from ..functions.energy import Energy
from ..functions.surface import Surface
from .attitude_layout import AttitudeLayout
from .baths import ABSENT_BATHS, HeatBaths
from .clock import Clock
from .conditions import RunCondition
from .domain import Domain


class InvariantVerdicts(NamedTuple):
    """Names of the functions that a system conserves, and of those for which this is not known."""

    conserved_names: frozenset[str]
    undecided_names: frozenset[str]

    @classmethod
    def from_verdicts(cls, verdicts: Mapping[str, bool | None], declared_names: Iterable[str]) -> InvariantVerdicts:
        """Return the verdicts by names; a declared function counts as conserved unless its verdict is False."""
        verdicts = {**verdicts, **{name: True for name in declared_names if verdicts.get(name, True) is None}}
        constant = {name for name, verdict in verdicts.items() if verdict}
        return cls(frozenset(constant), frozenset(name for name, verdict in verdicts.items() if verdict is None))


class OrbitLevels(NamedTuple):
    """Names of the Casimirs whose common levels are the orbits of a group on the momenta.

    Attributes
    ----------
    n_momenta : int
        Number of momenta that the group acts on.
    casimirs : frozenset of str
        Names of the Casimirs whose common levels are the orbits.
    has_all_casimirs : bool
        Whether every Casimir is known to be a function of the Casimirs of the system.
    """

    n_momenta: int
    casimirs: frozenset[str]
    has_all_casimirs: bool = False


class BodyKinematics(NamedTuple):
    """Velocities and joints of rigid bodies in a system, for its solutions.

    Attributes
    ----------
    velocities : mapping from names to functions of a state, shape (n,), to an array, shape (k,)
        The names are ``angular_velocity`` of a rigid body, in body axes, ``rotor_rates`` of its rotors relative to it,
        and ``joint_rates``. Joint rates have the order of ``joint_ranges``.
    joint_ranges : tuple of (str, int, int)
        Names of bodies with a joint, and the first and the last but one index of its coordinates in a state.
    momentum_scale : function from a state, shape (n,), to a number, shape ()
        Returns the size of terms that cancel in the momentum; zero if there are none.
    """

    velocities: Mapping[str, Callable] = MappingProxyType({})
    joint_ranges: tuple[tuple[str, int, int], ...] = ()
    momentum_scale: Callable[[Any], jax.Array] = lambda x: jnp.zeros(())


class WrappedSystem(NamedTuple):
    """The system that another system wraps for a run, with the function that wraps it.

    Attributes
    ----------
    system : System
        The system inside.
    wrap : function of a system and ``arguments`` to a system
        Wraps another system of the same kind.
    arguments : tuple
    """

    system: Any
    wrap: Callable[..., Any]
    arguments: tuple = ()


MISSING_GROUP_MESSAGE = (
    "an attitude is for a system with a group. Give LiePoissonSystem one, such as group=mf.SO(3), or a model of a body "
    "attitude=True"
)
"""Error message for an attitude of a system without a group."""


class SparseNewton(NamedTuple):
    """Functions that Newton's method with a sparse Jacobian needs; by default no sparsity pattern is known.

    Attributes
    ----------
    find_pattern : function without arguments to a sparse array, shape (n, n), or None
        Returns the sparsity pattern of the Jacobian of the field, for discrete gradients too; None if it is not known.
    residual_weights : function from a state, shape (n,), to an array, shape (n,)
        Returns factors that make the components of the field nearly linear in the state. The equations of a stiff step
        are solved multiplied by these factors.
    """

    find_pattern: Callable[[], scipy.sparse.csr_array | None] = lambda: None
    residual_weights: Callable[[Any], jax.Array] = jnp.ones_like


class EngineHints(NamedTuple):
    """Properties of a system that engines and checks may rely on.

    Attributes
    ----------
    can_unroll : bool
        Whether the compiled engine is worth trying; False if the system needs a loop.
    can_unroll_newton : bool
        Whether it is worth trying for methods too whose steps may need Newton's method.
    has_matrix_functions : bool
        Whether the system consists of matrix functions, which XLA compiles more slowly than the compiled engine.
    is_smooth : bool
        Whether the vector field is at least twice differentiable.
    has_fixed_levels : bool
        Whether the conserved functions have the same levels at every step; False in coordinates that are new at every
        step.
    """

    can_unroll: bool = True
    can_unroll_newton: bool = True
    has_matrix_functions: bool = False
    is_smooth: bool = True
    has_fixed_levels: bool = True


@dataclass(frozen=True)
class TorqueLaws:
    """Name and effects of the external torque on a system; by default no torque acts.

    Attributes
    ----------
    name : str
        Name of the torque; "" if none acts.
    has_impulse : bool
        Whether the torque may change momenta that the group acts on, and not only those of internal parts.
    needs_attitude : bool
        Whether the torque depends on the attitude.
    changed_casimirs : frozenset of str
        Names of the Casimirs that the torque may change.
    entropy_law : {"conserved", "nondecreasing"}
        Law of the entropy under the torque alone: "nondecreasing" if it heats.
    """

    name: str = ""
    has_impulse: bool = False
    needs_attitude: bool = False
    changed_casimirs: frozenset[str] = frozenset()
    entropy_law: LawName = "conserved"


TORQUE_FREE_LAWS = TorqueLaws()
"""Laws of a system on which no torque acts."""


REPLACED_MEMBERS = {
    "outside": "domain",
    "domain_margin": "domain",
    "why_singular": "domain",
    "torque_name": "torque_laws",
    "has_impulse": "torque_laws",
    "torque_invariant_casimirs": "torque_laws",
    "needs_attitude": "torque_laws",
    "torque_entropy_law": "torque_laws",
    "has_all_casimirs": "orbit_levels",
    "sparsity_pattern": "sparse_newton",
    "residual_weights": "sparse_newton",
    "velocity_functions": "body_kinematics",
    "hints": "engine_hints",
    "preserved": "preserved_functions",
    "component_scales": "slope_scales",
    "constant_names": "vector_invariant_names",
    "casimir_components": "casimir_terms",
    "resting_guess": "steady_state_guess",
    "specific_residuals": "specific_axiom_residuals",
    "production_name": "entropy_production_name",
    "freeze_at": "cache_tensors_at",
    "here": "cache_tensors_at",
    "surface": "constraint_surface",
    "solve_at_spins": "solve_slopes_at_each_spin",
    "transport": "attitude_velocity_from_gradients",
    "energy_of_vectors": "energy_of_flat_states",
    "inner": "inner_system",
    "ledger": "ledger_functions",
    "own_residuals": "specific_axiom_residuals",
    "pushed_by": "torque_laws",
    "casimirs_of_torque": "torque_laws",
    "left_alone": "drop_torque",
    "without_baths": "drop_baths",
    "presented": "to_user_solution",
    "solved_for": "subsystem_to_solve",
    "solved_subsystem": "subsystem_to_solve",
}
"""Former names of members that kinds of systems override, and the present names."""


class SystemInterface(Geometry):
    """Base class with the data of a system and the methods that a kind of system may override.

    :class:`System` derives everything else from them, and documents the attributes.
    """

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        refuse_replaced_members(cls, REPLACED_MEMBERS)

    entropy: Energy | None
    dissipation: Dissipation | None
    momentum_maps: dict[str, Energy]
    preserved_labels: tuple[str, ...] | None = eqx.field(static=True, kw_only=True, default=None)
    """Names of the functions that the dissipation has to preserve, in their order."""
    invariant_verdicts: InvariantVerdicts | None = eqx.field(static=True, kw_only=True, default=None)
    """Functions that the system conserves, if they were determined near the states of a run."""
    baths: HeatBaths = eqx.field(kw_only=True, default=ABSENT_BATHS)
    """Baths that take the heat of the dissipation, if any; their entropies are the last components of a state."""
    entropy_production_name: ClassVar[str] = "dS/dt"

    @property
    def kind(self) -> str:
        """Name of the kind of system, for messages."""
        return type(self).__name__

    @property
    def body_dim(self) -> int:
        """Number of state components without the entropies of baths."""
        return self.dim - self.baths.number

    @property
    def inertia(self) -> np.ndarray | None:
        """The tensor of inertia, shape (3, 3), of a rigid body whose state begins with its angular momentum.

        All internal parts count as fixed. None if the system is not such a body, or the tensor is not known.
        """
        return None

    @property
    def body_kinematics(self) -> BodyKinematics:
        """Functions that compute velocities of rigid bodies from a state; empty for systems without bodies."""
        return BodyKinematics()

    @property
    def inner_system(self) -> SystemInterface | None:
        """The system whose state is the first part of a state of this one, with the same laws; None without one."""
        return None

    # -- dynamics -----------------------------------------------------------------------------------------------------

    def field(self, x, dH, dS, dL=()) -> jax.Array:
        """Return the vector field at x, shape (n,), for given gradients, continuous or discrete.

        It is ``Pi(x) dH + force(x; dH, dS, dL)``. dS is None if the system has no entropy. This is the one definition
        of the dynamics; integrators differ in the gradients that they pass.
        """
        motion = self.poisson.sharp(x, dH)
        return motion if self.dissipation is None else motion + self.dissipation.force(self, x, dH, dS, dL)

    def entropy_gradient(self, x) -> jax.Array | None:
        """Return the gradient of the entropy at x, shape (n,); None without an entropy."""
        return None if self.entropy is None else self.entropy.gradient(x)

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Return random states, shape (count, n): points of the space, or normal numbers times ``scale``."""
        if self.space is None:
            states = scale * np.random.default_rng(seed).standard_normal((count, self.dim))
        else:
            states = np.array(self.space.to_vector(self.space.random(seed, (count,))))
        states[..., self.body_dim :] *= (
            min(1.0, 1.0 / scale) * self.baths.constant_entropy_scales
        )  # keeps temperatures finite
        return states

    def steady_state_guess(self) -> np.ndarray:
        """Return the default start of a search for a steady state, shape (n,): random, with bath entropies zero."""
        x = np.array(self.samples(1)[0])
        x[self.body_dim :] = 0.0
        return x

    @property
    def domain(self) -> Domain:
        """Conditions that a state must satisfy besides being finite, with functions that explain violations."""
        return Domain()

    def run_conditions(self, x: np.ndarray, t: np.ndarray, guarantees: frozenset[str]) -> tuple[RunCondition, ...]:
        """Return conditions on a run besides its laws, such as positive density matrices, for the rows of an audit.

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

    def specific_axiom_residuals(self, x) -> dict[str, jax.Array]:
        """Return the residuals at x, by name, of axioms that only this kind of system has, relative to their terms."""
        return {}

    # -- what acts from outside ---------------------------------------------------------------------------------------

    @property
    def is_driven(self) -> bool:
        """True if work is done from outside: the energy depends on time, or a torque acts."""
        return self.energy.depends_on_time

    def at_time(self, t, attitude=None) -> Self:
        """Return the system with its energy and torque frozen at the time t; unchanged if nothing depends on time.

        A torque may need an attitude too, shape (m, m).
        """
        del attitude  # without a torque
        return eqx.tree_at(lambda system: system.energy, self, self.energy.at_time(t)) if self.is_driven else self

    @property
    def torque_laws(self) -> TorqueLaws:
        """Name of the external torque, and its effects on momenta, Casimirs and entropy."""
        return TORQUE_FREE_LAWS

    def external_torque(self, x) -> jax.Array | None:
        """Return the external torque at a state, shape (n,), at a fixed time and attitude; None if none acts."""
        return None

    def external_velocity(self, x, dH) -> jax.Array | None:
        """Return the part of the vector field that acts from outside, shape (n,), at a gradient dH; None without one.

        It is :meth:`external_torque` for torques, which do not depend on the gradient.
        """
        return self.external_torque(x)

    def drop_torque(self) -> Self:
        """Return the system without its external torque."""
        return self

    @property
    def clock(self) -> Clock | None:
        """Indices of the time and the work in a state, with the span of the run; None if a state has no time."""
        return None

    # -- spins ----------------------------------------------------------------------------------------------------

    def solve_slopes_at_each_spin(self, x, dH, dS, noise_rates, other_noise_velocity, half_step, k) -> jax.Array | None:
        """Return slopes of a step, shape (n,), improved by solving the step equations spin by spin; None without spins.

        A solution of ``k = v`` is kept, where v is the field plus the turn by noise plus ``other_noise_velocity``. Each
        spin gets ``k_i + u_i`` with ``u_i - half_step J_i u_i = v_i - k_i``, J_i the derivative of v_i by s_i at the
        given gradient dH, and the other components get v.

        Parameters
        ----------
        x, dH, dS : array, shape (n,)
            Midpoint of the step and gradients there.
        noise_rates : array, shape (sites, 3) or (1, 3)
            Angular velocities by noise (1 / time).
        other_noise_velocity : array, shape (n,)
            Velocity by other noise.
        half_step : array, shape ()
        k : array, shape (n,)
        """
        return None

    # -- laws ---------------------------------------------------------------------------------------------------------

    @property
    def total_dissipation(self) -> Dissipation:
        """The dissipation of the system; a sum of no terms, which does nothing, if it has none."""
        return ABSENT_DISSIPATION if self.dissipation is None else self.dissipation

    @property
    def preserved_functions(self) -> tuple[Energy, ...]:
        """Functions that the dissipation, or one of its summands, has to preserve besides the energy."""
        return self.total_dissipation.preserve

    preserved = property(lambda self: self.preserved_functions, doc="The functions of :attr:`preserved_functions`.")

    @property
    def energy_law(self) -> LawName | None:
        """Law of the energy under the dissipation: "conserved", "nonincreasing", or None without a guarantee."""
        return self.total_dissipation.energy_law

    @property
    def entropy_law(self) -> LawName | None:
        """Law of the entropy under the dissipation: "nondecreasing", "conserved", or None without a guarantee."""
        return None if self.entropy is None else self.total_dissipation.entropy_law

    def casimirs(self) -> dict[str, Energy]:
        """Return the known Casimirs of the Poisson structure, by name."""
        return {}

    def casimir_terms(self) -> dict[str, dict[str, Energy]]:
        """Return, by the name of each Casimir that is a sum of Casimirs, its terms by name."""
        return {}

    @property
    def orbit_levels(self) -> OrbitLevels:
        """Names of the Casimirs whose common levels are the orbits of the group."""
        return OrbitLevels(self.body_dim, frozenset(self.casimirs()))

    @property
    def constraint_surface(self) -> Surface | None:
        """Surface on which every step has to end because of constraints; None without constraints."""
        return None

    @property
    def ledger_functions(self) -> dict[str, Energy]:
        """Functions of a state, by name, that give the work and the heat received from outside along a run."""
        return {}

    @property
    def vector_invariant_names(self) -> tuple[str, ...]:
        """Names of constants of the motion with several components, such as the spatial momentum."""
        return ()

    # -- states as users see them -------------------------------------------------------------------------------------

    @property
    def wrapped_system(self) -> WrappedSystem | None:
        """The system that a run extends to this one by time, attitude or embedding; None for a system of the user."""
        return None

    @property
    def attitude_layout(self) -> AttitudeLayout | None:
        """Indices of the attitude and the impulse in a state; None if a state has no attitude."""
        return None

    @abstractmethod
    def state_array(self, x, batch: bool = False) -> np.ndarray | jax.Array:
        """Return x as a checked state of this system, shape (n,); several states, shape (..., n), with ``batch``."""

    def initial_state(self, x, t: float = 0.0, attitude=None, batch: bool = False) -> jax.Array | np.ndarray:
        """Return the state of a run that starts at the user's state x at the time t; several states with ``batch``.

        Raises
        ------
        InputError
            If x is no state, or an attitude is given and the system has no group.
        """
        del t  # without a clock
        if attitude is not None:
            raise InputError(MISSING_GROUP_MESSAGE)
        return self.state_array(x, batch)

    def user_state(self, x) -> jax.Array:
        """Return the state as the user sees it, such as a point of the space; event functions receive it."""
        return self.points(x)

    def pullback(self, energy: Energy) -> Energy:
        """Return a function of states of this system from a function of the states that the user sees."""
        return energy

    @property
    def state_blocks(self) -> tuple[slice, ...]:
        """Slices of a state whose components have a common scale, such as a momentum and an attitude."""
        n = self.body_dim
        return (slice(0, n), slice(n, self.dim)) if self.baths.number else (slice(None),)

    # -- for the engines ----------------------------------------------------------------------------------------------

    @property
    def engine_hints(self) -> EngineHints:
        """Properties that engines and checks may rely on, by default those known from the space."""
        is_smooth = self.space is None or self.space.is_smooth
        is_complex = self.space is not None and self.space.dtype.kind == "c"
        return EngineHints(can_unroll=is_smooth and not is_complex, is_smooth=is_smooth)

    @property
    def sparse_newton(self) -> SparseNewton:
        """Functions that Newton's method with a sparse Jacobian needs, for large systems with a known pattern."""
        return SparseNewton()

    def slope_scales(self, slopes) -> jax.Array:
        """Return a scale for each component of slopes, shape (..., n), by default the largest absolute value of all."""
        scale = jnp.max(jnp.abs(slopes))
        return jnp.full_like(slopes, jnp.where(scale > 0.0, scale, 1.0))
