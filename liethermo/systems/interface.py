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
from ..errors import InputError
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
    def from_verdicts(cls, verdicts: Mapping[str, bool | None], declared: Iterable[str]) -> InvariantVerdicts:
        """Build from the verdicts, one for each function; a declared function counts as conserved unless its verdict
        is False."""
        verdicts = {**verdicts, **{name: True for name in declared if verdicts.get(name, True) is None}}
        constant = {name for name, verdict in verdicts.items() if verdict}
        return cls(frozenset(constant), frozenset(name for name, verdict in verdicts.items() if verdict is None))


class OrbitLevels(NamedTuple):
    """Common levels of Casimirs that are the orbits of a group.

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


class MotionQuantities(NamedTuple):
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
    """The system that another one wraps for a run, and how.

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
    """Functions of a system for Newton's method with a sparse Jacobian; by default no pattern is known.

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
    """Properties of a system on which an engine and a check may rely.

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
    """Name of the torque from outside that acts on a system, and its effects; by default no torque acts.

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
    "velocity_functions": "motion_quantities",
}
"""Names of members that kinds of systems used to override, and of those that replace them."""


class SystemInterface(Geometry):
    """Data of a kind of system, and methods that a subclass may override.

    :class:`System` derives everything else from them, and documents the attributes.
    """

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        for name, replacement in REPLACED_MEMBERS.items():
            if name in cls.__dict__:
                raise TypeError(f"{cls.__name__} defines {name}, which nothing calls. Override {replacement}")

    entropy: Energy | None
    dissipation: Dissipation | None
    momentum_maps: dict[str, Energy]
    preserved_labels: tuple[str, ...] | None = eqx.field(static=True, kw_only=True, default=None)
    """Names of the functions that the dissipation has to preserve, in their order."""
    invariant_verdicts: InvariantVerdicts | None = eqx.field(static=True, kw_only=True, default=None)
    """Functions that the system conserves, if they were determined near the states of a run."""
    baths: HeatBaths = eqx.field(kw_only=True, default=ABSENT_BATHS)
    """Baths that take the heat of the dissipation, if any; their entropies are the last components of a state."""
    production_name: ClassVar[str] = "dS/dt"

    @property
    def kind(self) -> str:
        """Name of the kind of system, for messages."""
        return type(self).__name__

    @property
    def body_dim(self) -> int:
        """Number of state components, those of baths left out."""
        return self.dim - self.baths.number

    @property
    def inertia(self) -> np.ndarray | None:
        """The tensor of inertia, shape (3, 3), of a rigid body whose state begins with its angular momentum.

        All internal parts count as fixed. None if the system is not such a body, or the tensor is not known.
        """
        return None

    @property
    def motion_quantities(self) -> MotionQuantities:
        """Velocities and joints of rigid bodies in the system; empty for other systems."""
        return MotionQuantities()

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
            states = np.array(self.space.to_vector(self.space.random(seed, (count,))))
        states[..., self.body_dim :] *= min(1.0, 1.0 / scale) * self.baths.scale  # keeps temperatures finite
        return states

    def resting_guess(self) -> np.ndarray:
        """Return a state from which a steady state is looked for, shape (n,): a random one, baths at entropy zero."""
        x = np.array(self.samples(1)[0])
        x[self.body_dim :] = 0.0
        return x

    @property
    def domain(self) -> Domain:
        """Conditions that a state must satisfy beside finite components, with functions that explain them."""
        return Domain()

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
    def torque_laws(self) -> TorqueLaws:
        """Name of the torque from outside, and what it does to the momenta, the Casimirs and the entropy."""
        return TORQUE_FREE_LAWS

    def external_torque(self, x) -> jax.Array | None:
        """Return the external torque at a state, shape (n,), at a fixed time and attitude; None if none acts."""
        return None

    def external_velocity(self, x, dH) -> jax.Array | None:
        """Return the velocity that acts from outside, shape (n,), with temperatures from the gradient dH, shape (n,).

        It is :meth:`external_torque` for torques, which do not depend on the gradient.
        """
        return self.external_torque(x)

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
    def total_dissipation(self) -> Dissipation:
        """The dissipation; of a system without dissipation a sum of no terms, which does nothing."""
        return ABSENT_DISSIPATION if self.dissipation is None else self.dissipation

    @property
    def preserved(self) -> tuple[Energy, ...]:
        """Functions that the dissipation, or one of its summands, has to preserve beside the energy."""
        return self.total_dissipation.preserve

    @property
    def energy_law(self) -> LawName | None:
        """ "conserved", "nonincreasing" under double-bracket dissipation, or None where there is no guarantee."""
        return self.total_dissipation.energy_law

    @property
    def entropy_law(self) -> LawName | None:
        """ "nondecreasing", "conserved", or None where there is no entropy or no guarantee."""
        return None if self.entropy is None else self.total_dissipation.entropy_law

    def casimirs(self) -> dict[str, Energy]:
        """Return the known Casimirs of the Poisson structure, by name."""
        return {}

    def casimir_components(self) -> dict[str, dict[str, Energy]]:
        """Return, by the name of a Casimir that is a sum, its terms by name, if each of them is a Casimir too."""
        return {}

    @property
    def orbit_levels(self) -> OrbitLevels:
        """Casimirs whose common levels are the orbits of the group, and whether all Casimirs are known."""
        return OrbitLevels(self.body_dim, frozenset(self.casimirs()))

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

    @property
    def wrapped_system(self) -> WrappedSystem | None:
        """The system that this one wraps for a run, with a clock, an attitude or an embedding; None without one."""
        return None

    @property
    def attitude_layout(self) -> AttitudeLayout | None:
        """Components of a state that hold an attitude and an impulse; None if there are none."""
        return None

    @abstractmethod
    def state_array(self, x, batch: bool = False) -> np.ndarray | jax.Array:
        """Return the state x, checked; several states with ``batch``."""

    def initial_state(self, x, t: float = 0.0, attitude=None, batch: bool = False) -> jax.Array | np.ndarray:
        """Return the state of a run that starts at the user's state x, at the time t; several states with ``batch``.

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
        """Return the state as the user sees it, as a point; event functions receive it."""
        return self.points(x)

    def pullback(self, energy: Energy) -> Energy:
        """Return a function of the states of this system from a function of the states that the user sees."""
        return energy

    @property
    def state_blocks(self) -> tuple[slice, ...]:
        """Parts of a state that have scales of their own, such as a momentum and an attitude."""
        n = self.body_dim
        return (slice(0, n), slice(n, self.dim)) if self.baths.number else (slice(None),)

    # -- for the engines ----------------------------------------------------------------------------------------------

    @property
    def hints(self) -> EngineHints:
        """Return the properties that engines and checks may rely on, by default those known from the space."""
        is_smooth = self.space is None or self.space.is_smooth
        is_complex = self.space is not None and self.space.dtype.kind == "c"
        return EngineHints(can_unroll=is_smooth and not is_complex, is_smooth=is_smooth)

    @property
    def sparse_newton(self) -> SparseNewton:
        """Functions for Newton's method with a sparse Jacobian, which solves large systems with a known pattern."""
        return SparseNewton()

    def component_scales(self, k) -> jax.Array:
        """Return the scale of each component of slopes, shape (..., n), for finite differences: the largest of all."""
        scale = jnp.max(jnp.abs(k))
        return jnp.full_like(k, jnp.where(scale > 0.0, scale, 1.0))
