"""``equilibria`` and ``steady_state``: states at rest, on a leaf or of a driven or open system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from manifolds._class_members import ListedABCMeta
from manifolds._precision import with_library_settings

from ..errors import ConvergenceError, InputError
from ..functions.energy import Energy
from ..tracing.interpret import evaluate_at_points
from .base import System
from .leaf_stability import retract
from .linearisation import (
    FieldDerivatives,
    Linearisation,
    Stability,
    abbreviate_names,
    conserved_functions,
    constant_temperature_entropy_indices,
    evaluate_functions,
    field_derivatives,
    field_derivatives_and_invariants,
    freeze_system,
    linearise_at,
)

RESIDUAL_RTOL = 1e-11
"""Largest velocity of an equilibrium, relative to the Jacobian times the norm of the state. Newton's method ends at
about 1e-15, and at 1e-12 where the Jacobian is ill-conditioned."""

LEVEL_RTOL = 1e-10
"""Largest difference of a conserved function from its value on the leaf, relative to its gradient times the state."""

SAME_STATE_RTOL = 1e-6
"""Distance of two equilibria, relative to the norm of the reference state, below which they count as one."""

MAX_ITERATIONS = 200
"""Largest number of Levenberg-Marquardt steps from a starting point."""

MAX_DAMPING = 1e12
"""Damping at which a search gives up: its steps are then rounding."""

PATIENCE = 12
"""Number of rejected steps in a row after which a search counts as stalled."""

MAX_TRANSIENT_STEPS = 400
"""Largest number of implicit Euler steps of growing size towards a steady state."""

PRINTED_ZERO = 1e-12
"""Size of a component, relative to the largest one, below which it is printed as zero."""

STEP_GROWTH_LIMIT = 10.0
"""Largest factor between two steps of the transient. The factor itself is the ratio of the last two velocities."""


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A state at rest, with the linear motion near it.

    Attributes
    ----------
    x : array, shape (n,)
        The state.
    residual : float
        Norm of the vector field there, relative to the Jacobian times the norm of the state.
    levels : dict of float
        Values of the conserved functions, the energy among them.
    linearisation : Linearisation
        The linear motion on the leaf.
    bath_heat : array, shape (baths,)
        Heat that flows into each bath (energy / time); zero at thermal equilibrium.
    """

    x: np.ndarray
    residual: float
    levels: dict[str, float]
    linearisation: Linearisation
    bath_heat: np.ndarray

    @property
    def stability(self) -> Stability:
        """Stability of the equilibrium on its leaf."""
        return self.linearisation.stability

    @property
    def stable(self) -> bool | None:
        """True if the equilibrium is stable on its leaf, False if not; None if the linear motion does not decide."""
        return self.linearisation.stable

    def __str__(self) -> str:
        levels = abbreviate_names([f"{name} = {value:.6g}" for name, value in self.levels.items()])
        x = np.where(np.abs(self.x) > PRINTED_ZERO * np.abs(self.x).max(initial=0.0), self.x, 0.0)
        return f"{np.array2string(x, precision=6)}  {self.stability}, residual {self.residual:.1e}; {levels}"


@dataclass(frozen=True, eq=False)
class Equilibria(Sequence, metaclass=ListedABCMeta):
    """A list of equilibria, sorted by stability and then by energy, as :func:`equilibria` returns it.

    Attributes
    ----------
    members : tuple of Equilibrium
        The equilibria that were found.
    level_names : tuple of str
        The functions whose values are those of the reference state.
    n_starts, n_converged : int
        Number of starting points, and of those from which an equilibrium was reached.
    """

    members: tuple[Equilibrium, ...]
    level_names: tuple[str, ...]
    n_starts: int
    n_converged: int

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Equilibrium]:
        return iter(self.members)

    def __getitem__(self, index):
        return self.members[index]

    @property
    def x(self) -> np.ndarray:
        """The states at rest, shape (equilibria, n)."""
        return np.array([member.x for member in self.members])

    @property
    def stable(self) -> list[bool | None]:
        """List of verdicts: True for an equilibrium that is stable on its leaf, False if not, None if undecided."""
        return [member.stable for member in self.members]

    def __str__(self) -> str:
        levels = f" with the reference's {abbreviate_names(self.level_names)}" if self.level_names else ""
        head = f"{len(self)} equilibria{levels}, from {self.n_converged} of {self.n_starts} starting points"
        return "\n".join([head, *map(str, self.members)])


@with_library_settings
def equilibria(
    system: System,
    reference=None,
    starts=None,
    levels: Sequence[str] | None = None,
    count: int = 32,
    seed: int = 0,
    t: float | None = None,
) -> Equilibria:
    """Find equilibria of a system on the leaf of a reference state, and return them with their stability.

    The search solves ``x' = 0`` together with the values of the conserved functions by the Levenberg-Marquardt method,
    from each starting point. It finds stable and unstable equilibria. A search from random points does not prove that
    there is no other one.

    The leaf is that of the Casimirs and the other functions that the dissipation conserves. The energy belongs to them
    if there is a dissipation that conserves it; without a dissipation, or at a rate of zero, the equilibria of a leaf
    have different energies. A momentum map is not fixed, because a symmetry moves equilibria to others with the value
    of the map.

    Parameters
    ----------
    system : System
        The system; its functions fix the units.
    reference : array, shape (n,), optional
        A state on the leaf, in the units of the system. Without it no level is fixed, and equilibria near the starting
        points are found.
    starts : array, shape (m, n), optional
        Starting points, in the units of the system; by default random states with the norm of the reference, and the
        reference.
    levels : sequence of str, optional
        Names, without a unit, of the functions that are fixed instead, among the conserved functions and ``"energy"``.
    count, seed : int
        Number and seed of the random starting points (dimensionless).
    t : float, optional
        The time, in the unit of the system, at which a system that depends on time is frozen.

    Returns
    -------
    Equilibria

    Raises
    ------
    InputError

    Examples
    --------
    >>> body = lt.models.free_rigid_body((3.0, 2.0, 1.0))
    >>> rest = lt.equilibria(body, [0.0, 0.6, 0.8])
    >>> len(rest), sorted(map(str, rest.stable))
    (6, ['False', 'False', 'True', 'True', 'True', 'True'])
    """
    system = freeze_system(system, t)
    anchor = None if reference is None else np.asarray(system.state(reference))
    points = _starting_points(system, anchor, starts, count, seed)
    conserved_by_name = conserved_functions(system, points[0])
    names = _fixed_function_names(system, conserved_by_name, levels, points) if anchor is not None else ()
    fixed_functions = {name: conserved_by_name[name] for name in names}
    target_values = None if anchor is None else evaluate_functions(tuple(fixed_functions.values()), anchor[None])[0]
    search = _EquilibriumSearch(
        system, tuple(fixed_functions.values()), target_values, constant_temperature_entropy_indices(system)
    )
    scale = float(np.linalg.norm(points[0] if anchor is None else anchor)) or 1.0
    states = search.solve(points, scale)
    members = [_make_equilibrium(system, x, scale) for x in _distinct_states(states, SAME_STATE_RTOL * scale)]
    order = list(Stability)
    members.sort(key=lambda member: (order.index(member.stability), member.levels["energy"]))
    return Equilibria(tuple(members), names, len(points), len(states))


@with_library_settings
def steady_state(system: System, x0=None, t: float | None = None) -> Equilibrium:
    """Return the steady state that a driven or open system approaches from x0.

    A state at rest of the whole motion: torques, drives, and baths that keep their temperatures included. Implicit
    Euler steps of growing size follow the motion from x0 [Kelley & Keyes 1998], and Newton's method ends the search
    with the values that the conserved functions have at x0. The entropies of baths of constant temperature may grow:
    ``bath_heat`` says how much heat each bath receives.

    Parameters
    ----------
    system : System
        The system; its functions fix the units. A system that depends on time periodically has no state at rest, and
        is refused unless ``t`` is given: see :func:`steady_cycle`.
    x0 : array, shape (n,), optional
        The initial state, in the units of the system; by default a random one, and the completely mixed state of a
        quantum system.
    t : float, optional
        The time, in the unit of the system, at which a system that depends on time is frozen.

    Returns
    -------
    Equilibrium

    Raises
    ------
    ConvergenceError
        If the motion from x0 does not come to rest.
    InputError
        If the energy or a torque depends on time and t is missing.

    Examples
    --------
    A qubit between a hot and a cold bath carries heat from one to the other:

    >>> lower = np.array([[0, 1], [0, 0]])
    >>> baths = lt.HeatBaths(capacity=np.inf, temperature=[0.5, 2.0], number=2)
    >>> jumps = [
    ...     lt.ThermalJumps([(lower, 0.1)], bath=0),
    ...     lt.ThermalJumps([(lower, 0.1)], bath=1),
    ... ]
    >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), jumps, baths=baths)
    >>> rest = lt.steady_state(qubit)
    >>> rest.stable, bool(rest.bath_heat[0] > 0.0), bool(abs(rest.bath_heat.sum()) < 1e-14)
    (True, True, True)
    """
    system = freeze_system(system, t)
    x = np.asarray(system.steady_state_guess() if x0 is None else system.state(x0))
    conserved_by_name = conserved_functions(system, x)
    functions = tuple(conserved_by_name.values())
    search = _EquilibriumSearch(
        system, functions, evaluate_functions(functions, x[None])[0], constant_temperature_entropy_indices(system)
    )
    scale = float(np.linalg.norm(x)) or 1.0
    states = search.solve(search.follow_transient_to_rest(x, scale)[None], scale)
    if not len(states):
        raise ConvergenceError(
            f"the motion of this {system.kind} from x0 does not come to rest: it may oscillate, grow, or have no "
            "steady state. Give another x0, or look for unstable equilibria with lt.equilibria(system)",
            None,
        )
    return _make_equilibrium(system, states[0], scale)


def _make_equilibrium(system: System, x: np.ndarray, scale: float) -> Equilibrium:
    """Return the :class:`Equilibrium` at a state at rest, with the linear motion near it."""
    derivatives, functions = field_derivatives_and_invariants(system, x)
    linearisation = linearise_at(system, x, derivatives, functions, scale)
    velocity = derivatives.velocity.copy()
    velocity[constant_temperature_entropy_indices(system)] = 0.0
    norm = float(np.linalg.norm(derivatives.jacobian))
    levels = dict(zip(functions, derivatives.values.tolist(), strict=True))
    levels["energy"] = float(evaluate_functions((system.energy,), x[None])[0, 0])
    m = system.dim - system.body_dim
    heat = np.zeros(m)
    if m:
        heat = np.asarray(system.temperatures(x)) * derivatives.velocity[system.body_dim :]
    residual = float(np.linalg.norm(velocity)) / (norm * scale or 1.0)
    return Equilibrium(x, residual, levels, linearisation, heat)


def _starting_points(system: System, reference: np.ndarray | None, starts, count: int, seed: int) -> np.ndarray:
    """Return the starting points of a search, shape (points, n): those of the user, or random ones."""
    if starts is not None:
        return np.atleast_2d(np.asarray(system.state(starts, batch=True)))
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"count must be a positive number of starting points, got {count!r}")
    size = 1.0 if reference is None else float(np.linalg.norm(reference)) / np.sqrt(system.dim) or 1.0
    points = system.samples(count, seed, size)
    return points if reference is None else np.concatenate([reference[None], points])


def _fixed_function_names(
    system: System,
    conserved_functions_by_name: dict[str, Energy],
    requested_names: Sequence[str] | None,
    points: np.ndarray,
) -> tuple[str, ...]:
    """Return the names of the functions whose values a search fixes, by default all but energy and momentum maps."""
    if requested_names is None:
        variable = set(system.momentum_maps) | (set() if _has_active_dissipation(system, points) else {"energy"})
        return tuple(name for name in conserved_functions_by_name if name not in variable)
    names = (requested_names,) if isinstance(requested_names, str) else tuple(requested_names)
    if unknown := [name for name in names if name not in conserved_functions_by_name]:
        known_names = abbreviate_names(list(map(repr, conserved_functions_by_name))) or "no function"
        raise InputError(f"levels names {unknown[0]!r}, but this {system.kind} conserves {known_names}")
    return names


def _has_active_dissipation(system: System, points: np.ndarray) -> bool:
    """Return whether the dissipation moves any of the points, shape (points, n)."""
    return bool(system.total_dissipation.terms) and bool(
        np.any(evaluate_at_points(_dissipative_velocity, system, points))
    )


def _dissipative_velocity(system: System, x):
    """Return the part of the vector field that is due to dissipation, shape (n,)."""
    return system.vector_field(x) - system.poisson.sharp(x, system.energy.gradient(x))


def _distinct_states(states: np.ndarray, min_distance: float) -> list[np.ndarray]:
    """Return the states, one for each group of states nearer to each other than ``min_distance``."""
    groups: list[np.ndarray] = []
    for x in states:
        if not any(np.linalg.norm(x - y) <= min_distance for y in groups):
            groups.append(x)
    return groups


class _EquilibriumSearch(NamedTuple):
    """A search for states with zero velocity and given values of conserved functions.

    Attributes
    ----------
    system : System
    functions : tuple of Energy
    target_values : array, shape (functions,), or None
    counter_indices : array of int
        Components that are not part of the equations.
    """

    system: System
    functions: tuple[Energy, ...]
    target_values: np.ndarray | None
    counter_indices: np.ndarray

    def evaluate_derivatives(self, points: np.ndarray) -> FieldDerivatives:
        """Return field, functions and derivatives at points, shape (points, n), with zero velocity of the counters."""
        derivatives = evaluate_at_points(field_derivatives, (self.system, self.functions), points)
        derivatives = FieldDerivatives(*(np.array(a) for a in derivatives))  # solve() overwrites rows
        derivatives.velocity[:, self.counter_indices], derivatives.jacobian[:, self.counter_indices] = 0.0, 0.0
        return derivatives

    def solve(self, starting_points: np.ndarray, scale: float) -> np.ndarray:
        """Return the equilibria, shape (converged, n), that Levenberg-Marquardt steps reach from starting points."""
        states, damping = starting_points.copy(), np.full(len(starting_points), 1e-3)
        derivatives = self.evaluate_derivatives(states)
        weights = self._equation_weights(derivatives, scale)
        residuals, matrices = self._weighted_residuals_and_jacobians(derivatives, weights)
        costs = np.linalg.norm(residuals, axis=1)
        n_rejected = np.zeros(len(starting_points), dtype=int)
        is_active = np.isfinite(costs)
        for _ in range(MAX_ITERATIONS):
            active_indices = np.flatnonzero(is_active)
            if not active_indices.size:
                break
            steps = scale * np.array(
                [_damped_step(scale * matrices[i], residuals[i], damping[i]) for i in active_indices]
            )
            trials = self._retract_steps(states[active_indices], steps, derivatives.frame[active_indices])
            trial_derivatives = self.evaluate_derivatives(trials)
            new_residuals, new_matrices = self._weighted_residuals_and_jacobians(trial_derivatives, weights)
            new_costs = np.linalg.norm(new_residuals, axis=1)
            is_improved = new_costs < costs[active_indices]  # False for NaN
            improved_indices, failed_indices = active_indices[is_improved], active_indices[~is_improved]
            states[improved_indices], costs[improved_indices] = trials[is_improved], new_costs[is_improved]
            residuals[improved_indices], matrices[improved_indices] = (
                new_residuals[is_improved],
                new_matrices[is_improved],
            )
            for old, new in zip(derivatives, trial_derivatives, strict=True):
                old[improved_indices] = new[is_improved]
            damping[improved_indices] = np.maximum(damping[improved_indices] * 0.1, 1e-30)
            damping[failed_indices] *= 10.0
            n_rejected[improved_indices], n_rejected[failed_indices] = 0, n_rejected[failed_indices] + 1
            is_active[(n_rejected > PATIENCE) | (damping > MAX_DAMPING) | (costs == 0.0)] = False
        is_accepted = np.isfinite(costs) & self._is_at_rest(derivatives, scale) & self._is_on_leaf(derivatives, scale)
        is_accepted &= np.array([not self.system.domain.why_outside(x) for x in states], dtype=bool)
        return states[is_accepted]

    def follow_transient_to_rest(self, x: np.ndarray, scale: float) -> np.ndarray:
        """Return the state, shape (n,), that implicit Euler steps of growing size reach from x."""
        derivatives = self.evaluate_derivatives(x[None])
        speed = np.linalg.norm(derivatives.velocity)
        norm = np.linalg.norm(derivatives.jacobian)
        step = 0.1 / norm if norm > 0.0 else 0.1 * scale / (speed or 1.0)
        for _ in range(MAX_TRANSIENT_STEPS):
            velocity, jacobian, frame = derivatives.velocity[0], derivatives.jacobian[0], derivatives.frame[0]
            if not speed > RESIDUAL_RTOL * np.linalg.norm(jacobian) * scale:
                break
            to_coordinates = np.linalg.pinv(frame.T) if self.system.space is not None else np.eye(len(frame))
            matrix = np.eye(len(frame)) / step - to_coordinates @ jacobian
            displacement = np.linalg.lstsq(matrix, to_coordinates @ velocity, rcond=None)[0]
            trial = self._retract_steps(x[None], displacement[None], derivatives.frame)
            trial_derivatives = self.evaluate_derivatives(trial)
            new_speed = np.linalg.norm(trial_derivatives.velocity)
            if (
                not np.isfinite(new_speed)
                or self.system.domain.why_outside(trial[0])
                or new_speed > STEP_GROWTH_LIMIT * speed
            ):
                step *= 0.25
                continue
            step *= float(np.clip(speed / new_speed if new_speed > 0.0 else np.inf, 0.5, STEP_GROWTH_LIMIT))
            x, derivatives, speed = trial[0], trial_derivatives, new_speed
        return x

    def _retract_steps(self, states: np.ndarray, steps: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Return the states, shape (points, n), moved by steps in coordinates of their tangent frames."""
        displacements = np.einsum("bm,bmn->bn", steps, frames)
        if self.system.space is None:
            return states + displacements
        moved_states = evaluate_at_points(_retract_pair, self.system, np.concatenate([states, displacements], axis=1))
        return np.asarray(moved_states)

    def _equation_weights(self, derivatives: FieldDerivatives, scale: float) -> np.ndarray:
        """Return factors, shape (n + functions,), that make the equations of velocity and functions dimensionless."""
        jacobian_norm = np.nanmedian(np.linalg.norm(derivatives.jacobian, axis=(1, 2)))
        gradient_norms = np.nanmedian(np.linalg.norm(derivatives.gradients, axis=2), axis=0)
        velocity_weight = np.full(derivatives.velocity.shape[1], 1.0 / (jacobian_norm * scale or 1.0))
        return np.concatenate([velocity_weight, 1.0 / np.where(gradient_norms > 0.0, gradient_norms * scale, 1.0)])

    def _weighted_residuals_and_jacobians(
        self, derivatives: FieldDerivatives, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return weighted residuals, shape (points, equations), and Jacobians, shape (points, equations, m)."""
        if self.target_values is None:
            weights = weights[: derivatives.velocity.shape[1]]
            return derivatives.velocity * weights, derivatives.jacobian * weights[:, None]
        residuals = np.concatenate([derivatives.velocity, derivatives.values - self.target_values], axis=1)
        matrices = np.concatenate([derivatives.jacobian, derivatives.gradients], axis=1)
        return residuals * weights, matrices * weights[:, None]

    def _is_at_rest(self, derivatives: FieldDerivatives, scale: float) -> np.ndarray:
        """Return for each point whether the velocity is negligible there: bools, shape (points,)."""
        norms = np.linalg.norm(derivatives.jacobian, axis=(1, 2))
        return np.linalg.norm(derivatives.velocity, axis=1) <= RESIDUAL_RTOL * norms * scale

    def _is_on_leaf(self, derivatives: FieldDerivatives, scale: float) -> np.ndarray:
        """Return for each point whether the functions have their target values there: bools, shape (points,)."""
        if self.target_values is None or not self.functions:
            return np.ones(len(derivatives.velocity), dtype=bool)
        sizes = np.linalg.norm(derivatives.gradients, axis=2) * scale + np.abs(self.target_values)
        return (np.abs(derivatives.values - self.target_values) <= LEVEL_RTOL * sizes).all(axis=1)


def _damped_step(matrix: np.ndarray, residual: np.ndarray, damping: float) -> np.ndarray:
    """Return the Levenberg-Marquardt step, shape (m,), of linear equations with a damping."""
    rows = np.concatenate([matrix, np.sqrt(damping) * np.eye(matrix.shape[1])])
    right_side = np.concatenate([-residual, np.zeros(matrix.shape[1])])
    return np.linalg.lstsq(rows, right_side, rcond=None)[0]


def _retract_pair(system: System, state_and_displacement) -> jax.Array:
    """Return the state moved by a displacement; both are given in one array, shape (2n,)."""
    n = system.dim
    return retract(system, state_and_displacement[:n], state_and_displacement[n:])
