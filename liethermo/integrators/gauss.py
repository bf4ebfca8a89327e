"""Metriplectic Gauss: even orders, with both laws exact for every energy and every entropy.

Its derivation is in :doc:`/explanation/exact_laws`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced

from ..dissipation.base import Dissipation, terms_with_preserved_values
from ..errors import InputError
from ..functions.energy import Energy
from ..functions.frames import OrthonormalFrame, gram_schmidt
from ..functions.gradients import CorrectionDirection, FunctionChange, correct_gradients, discrete_gradients_at_stages
from ..systems import System
from ..systems.invariants import preserved_function_names, preserved_functions_by_number, stack_gradients
from ..systems.transport import has_generator
from ..tracing.interpret import evaluate_at_points
from .base import (
    GaussMethod,
    OneStepMethod,
    TransportingMethod,
    apply_increment,
    checked_stages,
    collocation_error_estimate,
    generator_field_residual_jvp,
    register,
)
from .charts import wrap_in_charts
from .preserved import casimir_residuals, check_preserved, function_on_states, non_casimir_mask, preserved_functions
from .tableaus import gauss_tableau, kronrod_rule

CASIMIR_NEWTON_STEPS = 3
"""Newton steps to a level of the Casimirs: the distance is O(h), so O(h^8) is left after three."""


def composed_entropy_gradients(
    S: Energy, casimirs: Sequence[Energy], gradients, x, compensation, h, k, A, b
) -> jax.Array:
    """Return discrete gradients of ``S = f(C_1, …, C_m)`` at the stages of a collocation method, shape (s, n).

    Each is ``sum_j (f_j(c_i) + alpha r_ij) gC_ij``, a combination of the discrete gradients of the Casimirs at the
    stage. Their rates are ``r_ij = gC_ij . k_i``, and their values ``c_i = C(x) + h sum_l A_il r_l`` are collocated as
    separate unknowns. The number alpha makes ``h sum_i b_i gS_i . k_i = S(x') - S(x)``. So a motion that conserves
    the Casimirs keeps S. At a critical point of f, f' is zero, and so is gS. With the stage u_i
    itself, which is off the level of the Casimirs by O(h^{s+1}), friction would act there.

    f need not be known: its derivatives at c are the components of grad S in the grad C_j, at a point near x with C =
    c.

    Parameters
    ----------
    gradients : array, shape (m, s, n)
        The discrete gradients of the Casimirs.
    """
    rates = jnp.einsum("jin,in->ij", gradients, k)

    def casimir_gradient_frame(y) -> OrthonormalFrame:
        return gram_schmidt([C.gradient(y) for C in casimirs])

    def entropy_coefficients(casimir_changes):
        y = x
        for _ in range(CASIMIR_NEWTON_STEPS):
            residual = casimir_changes - jnp.stack([C.value(y) - C.value(x) for C in casimirs])
            y = y + casimir_gradient_frame(y).vector_with_inner_products(residual)
        return casimir_gradient_frame(y).coefficients(S.gradient(y))

    coefficients = jax.vmap(entropy_coefficients)(h * (A @ rates))
    entropy_change = FunctionChange.from_step(S, x, compensation, h * (b @ k), [])
    return jnp.einsum(
        "ij,jin->in",
        correct_gradients(entropy_change, coefficients, rates, CorrectionDirection.from_slopes(rates, b), h, b),
        gradients,
    )


class MetriplecticGauss(GaussMethod, TransportingMethod):
    """Implicit Gauss steps with both laws exact, of order 2s with s stages.

    ``k_i = Pi(u_i) gH_i + K_d gS_i`` at Gauss nodes ``u_i = x + h sum_j A_ij k_j``; ``x' = x + h sum_i b_i k_i``.

    The gradients have one correction for all stages, ``gH_i = grad H(u_i) + alpha d_i``, such that
    ``h sum_i b_i gH_i . k_i = H(x') - H(x)``. The same holds for gS, and for gC of every first integral C that the
    method keeps: the known Casimirs of the system, and the functions of ``preserve``. K_d is the dissipation rebuilt
    with gH_i and the gC_i in its kernel. Hence

        H(x') = H(x),    S(x') - S(x) = h sum b_i gS_i . K_d gS_i >= 0,    C(x') = C(x),

    for all smooth H, S and C and every step whose equations are solved. The order is 2s, since alpha is O(h^{2s})
    [Hairer, Lubich & Wanner, II.1].

    The motion ``Pi gH`` has to keep S and C too. There are five cases:

    - A quadratic Casimir: collocation keeps it, and so it keeps an entropy that is a function of quadratic Casimirs;
      see :func:`composed_entropy_gradients`.
    - A quadratic momentum map J: d_i is k_i less its component along the symmetry ``Pi grad J``, so that gH_i is
      invariant as grad H is [Gonzalez 1996].
    - Any other Casimir, without dissipation, where the structure knows the leaf of a state, as of density matrices,
      u(n), su(n) and so(n): the motion is ``Pi(v_i) gH_i`` at points v_i for which x' is on the leaf of x. So all
      Casimirs are kept, also where their gradients depend on each other [Modin & Viviani 2020;
      :meth:`manifolds.PoissonStructure.stages_on_leaf`].
    - Any other Casimir: the motion is ``P Pi P gH_i``, P the orthogonal projector off the gC_i of all functions.
    - Any other first integral: the motion is ``Q Pi gH_i``, Q the projector off gH_i, gS_i and the gC_i.

    The method keeps momentum maps only on request, or if the dissipation has to preserve them. Within O(h^{2s}) of a
    relative equilibrium, such as a circular orbit, no step may be able to stay on the levels of both H and J. The run
    then ends with a status.

    The step solves one implicit equation of s times the size of the state. An iteration costs s gradients of H and S.
    For each function that is not quadratic it also costs two values and a gradient at the end of the step, and s + 1
    gradients between the nodes if s is 1 or 2.

    On a manifold the scheme runs in the arrays around it. With ``retraction`` it runs in the chart ``v -> R(x, v)``
    around the state, a new chart in each step, with the same order and laws.

    Parameters
    ----------
    stages : int
        1 to 8; the order is twice that. One stage is the midpoint scheme with the Gonzalez gradient, the entropy law
        made exact too.
    preserve : sequence of functions or energies
        Further first integrals to hold exactly, such as momentum maps. The system has to conserve them (checked when a
        run starts).
    retraction : str or manifolds.Retraction, optional
        On a manifold, the retraction whose charts are used, such as ``"exp"``: :func:`manifolds.retraction` has the
        names.
    held : tuple of str
        Names of the functions of the system to keep. A run fills it in: the conserved ones among its Casimirs and the
        functions that its dissipation has to preserve.
    moving : tuple of int, optional
        Indices of the functions of ``preserve`` that are momentum maps and not Casimirs. A run fills it in.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> method = lt.MetriplecticGauss(stages=3)
    >>> (
    ...     method.order,
    ...     lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.5, method).audit().passed,
    ... )
    (6, True)
    """

    functions: tuple[Energy, ...]
    retraction: str | mf.Retraction | None = eqx.field(static=True)
    held: tuple[str, ...] = eqx.field(static=True)
    moving: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        stages: int = 2,
        preserve: Sequence = (),
        retraction: str | mf.Retraction | None = None,
        held: tuple[str, ...] = (),
        moving: tuple[int, ...] | None = None,
    ):
        self.number = checked_stages(stages)
        self.functions = preserved_functions(preserve)
        self.retraction = retraction
        self.held = held
        self.moving = moving

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        also_conserved = tuple(
            sorted(name for name in system.first_integrals() if self._is_held_by_default(system, name))
        )
        method = self._with_transformed_functions(lambda C: function_on_states(system, C), also_conserved)
        if self.functions and not is_traced((system, method)):
            residuals = evaluate_at_points(casimir_residuals, (system, method.functions), system.samples(4))
            momentum_maps = tuple(int(i) for i in np.flatnonzero(non_casimir_mask(residuals)))
            method = method._with_transformed_functions(lambda C: C, also_conserved, momentum_maps)
        return wrap_in_charts(method, system, self.retraction, "exp")

    def requested_invariants(self, system: System) -> tuple[Energy, ...]:
        return tuple(function_on_states(system, C) for C in self.functions)

    def _with_transformed_functions(
        self, transform: Callable, also_conserved: tuple[str, ...], momentum_maps: tuple[int, ...] | None = None
    ):
        """Return a copy with ``transform`` applied to its preserved functions.

        The copy conserves the first integrals of the system in ``also_conserved`` too.
        """
        return type(self)(
            self.number, tuple(map(transform, self.functions)), self.retraction, also_conserved, momentum_maps
        )

    preserves = frozenset({"energy", "entropy_law", "casimirs"})

    def check(self, system: System) -> None:
        """Raise InputError unless the system conserves the preserved functions, which must be fewer than the
        components of a state."""
        check_preserved(system, self.functions)
        if not self.functions:
            return
        functions = [system.energy, *(() if system.entropy is None else (system.entropy,)), *self.functions]
        gradients = np.nan_to_num(evaluate_at_points(stack_gradients, tuple(functions), system.samples(8)))
        if np.linalg.matrix_rank(gradients, tol=1e-9).max() >= system.dim:
            raise InputError(
                f"energy, entropy and {len(self.functions)} preserved functions are independent, so no motion "
                f"remains in {system.dim} dimensions. Preserve fewer functions"
            )

    # -- the stage equations ------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        leaf_slopes = self._symplectic_leaf_slopes(system, x, compensation, h, k)
        if leaf_slopes is not None:
            return leaf_slopes
        return jax.vmap(lambda *stage: self._stage_slope(system, *stage))(
            *self._stages_and_gradients(system, x, compensation, h, k)
        )

    def _symplectic_leaf_slopes(self, system: System, x, compensation, h, k) -> jax.Array | None:
        """Return the slopes along the symplectic leaf through x, shape (s, n), or None if the structure knows no leaf.

        This is for motions without dissipation whose held functions are all Casimirs.
        """
        functions = self._held_functions_by_name(system) | _functions_determining_entropy(system)
        casimirs = functions.keys() <= {ENTROPY_KEY, *self._casimir_names(system)}
        if system.total_dissipation.terms or not casimirs or all(C.is_quadratic for C in functions.values()):
            return None
        dH = self._energy_gradients(system, self._stage_states(x, compensation, h, k), x, compensation, h, k)
        points = system.poisson.stages_on_leaf(x + compensation, dH, h * gauss_tableau(self.number).A)
        return None if points is None else jax.vmap(system.poisson.sharp)(points, dH)

    def attitude_velocities_at_stages(self, system: System, x, compensation, h, k) -> jax.Array:
        names = tuple(preserved_functions_by_number(system))

        def velocity(u, dH, dS, gradients_by_name):
            return system.attitude_velocity_from_gradients(
                u, dH, dS, tuple(gradients_by_name[name].discrete for name in names)
            )

        return jax.vmap(velocity)(*self._stages_and_gradients(system, x, compensation, h, k))

    def _stages_and_gradients(self, system: System, x, compensation, h, k) -> tuple:
        """Return the stage states u, shape (s, n), the discrete gradients dH and dS there, and others by name."""
        A, b, _ = gauss_tableau(self.number)
        u = self._stage_states(x, compensation, h, k)

        def discrete_and_continuous_gradients(C: Energy) -> StageGradients:
            continuous = jax.vmap(C.gradient)(u)
            if C.is_quadratic:
                return StageGradients(continuous, continuous)
            return StageGradients(
                discrete_gradients_at_stages(C, x, compensation, h, k, A, b, kronrod_rule(self.number)), continuous
            )

        S, entropy_functions = _entropy_if_used(system), _functions_determining_entropy(system)
        dH = self._energy_gradients(system, u, x, compensation, h, k)
        gradients_by_name = {
            name: discrete_and_continuous_gradients(C)
            for name, C in (
                self._held_functions_by_name(system) | entropy_functions | preserved_functions_by_number(system)
            ).items()
        }
        if S is None:
            dS = jnp.zeros_like(k)
        elif ENTROPY_KEY in entropy_functions:
            dS = gradients_by_name[ENTROPY_KEY].discrete
        else:
            discrete = jnp.stack([gradients_by_name[name].discrete for name in entropy_functions])
            dS = composed_entropy_gradients(S, list(entropy_functions.values()), discrete, x, compensation, h, k, A, b)
        return u, dH, dS, gradients_by_name

    def _stage_states(self, x, compensation, h, k) -> jax.Array:
        """Return the states at the stages of a step with the slopes k, shape (s, n)."""
        return x + (compensation + h * (gauss_tableau(self.number).A @ k))

    def _energy_gradients(self, system: System, u, x, compensation, h, k) -> jax.Array:
        """Return gradients of the energy at the stages u, shape (s, n), corrected so that their work is its change."""
        A, b, _ = gauss_tableau(self.number)
        symmetries = self._symmetry_directions(system, u)
        return discrete_gradients_at_stages(
            system.energy, x, compensation, h, k, A, b, kronrod_rule(self.number), symmetries
        )

    def _stage_slope(self, system: System, u, dH, dS, gradients_by_name: dict[str, StageGradients]) -> jax.Array:
        """Return the slope of one stage, ``Pi_d dH + K_d dS`` with discrete Poisson and friction matrices."""
        system = system.cache_tensors_at(u)
        slope = self._conservative_slope(system, u, dH, gradients_by_name)
        keys_and_names = tuple(
            zip(preserved_functions_by_number(system), preserved_function_names(system), strict=True)
        )
        for term, preserved_keys in terms_with_preserved_values(system.total_dissipation.terms, keys_and_names):
            slope = slope + self._dissipative_slope(term, preserved_keys, system, u, dH, dS, gradients_by_name)
        return slope

    def _conservative_slope(self, system: System, u, dH, gradients_by_name: dict[str, StageGradients]) -> jax.Array:
        """Return ``Pi dH`` without the components that would change S or a held function."""
        functions = self._held_functions_by_name(system) | _functions_determining_entropy(system)
        if all(C.is_quadratic for C in functions.values()):
            return system.poisson.sharp(u, dH)
        gradients = [gradients_by_name[name] for name in functions]
        if functions.keys() <= {ENTROPY_KEY, *self._casimir_names(system)}:
            project_off = _gradient_projector(system, u, gradients, n_components=system.body_dim)
            return project_off(system.poisson.sharp(u, project_off(dH)))
        energy = StageGradients(dH, system.energy.gradient(u))
        return _gradient_projector(system, u, [energy, *gradients], n_components=system.body_dim)(
            system.poisson.sharp(u, dH)
        )

    def _dissipative_slope(
        self,
        term: Dissipation,
        preserved_keys: tuple[tuple[str, str], ...],
        system: System,
        u,
        dH,
        dS,
        gradients_by_name,
    ) -> jax.Array:
        """Return the force of one dissipation without the components that would change functions that it has to keep.

        ``preserved_keys`` has a pair for each function in its own ``preserve``: the key in ``gradients_by_name`` and
        the name in the functions of the system.
        """
        dL, functions = (
            tuple(gradients_by_name[key].discrete for key, _ in preserved_keys),
            self._functions_to_project_off(term, {name for _, name in preserved_keys}, system),
        )
        if not functions:
            return term.force(system, u, dH, dS, dL)
        gradients = [gradients_by_name[name] for name in functions] + [
            gradients_by_name[key] for key, name in preserved_keys if name not in functions
        ]
        if term.energy_law == "nonincreasing":
            project_off = _gradient_projector(system, u, gradients)
            return project_off(term.force(system, u, project_off(dH), dS, dL))
        if term.energy_law == "conserved":
            gradients = [StageGradients(dH, system.energy.gradient(u)), *gradients]
        project_off = _gradient_projector(system, u, gradients)
        return project_off(term.force(system, u, dH, project_off(dS), dL))

    def _functions_to_project_off(
        self, term: Dissipation, preserved_names: set[str], system: System
    ) -> dict[str, Energy]:
        """Return the functions, by name, whose gradients are projected off the force of a dissipation.

        These are all functions that it has to keep; none if it keeps all of them by construction.
        """
        functions = self._held_functions_by_name(system) | (
            _functions_determining_entropy(system) if term.energy_law == "nonincreasing" else {}
        )
        gradients_are_exact = system.energy.is_quadratic and (system.entropy is None or system.entropy.is_quadratic)
        casimirs = {ENTROPY_KEY, *self._casimir_names(system)} if term.preserves_casimirs else set()

        def is_kept_by_construction(name: str, C: Energy) -> bool:
            return name in preserved_names or (C.is_quadratic and (gradients_are_exact or name in casimirs))

        return (
            {}
            if not term.is_symmetric or all(is_kept_by_construction(*function) for function in functions.items())
            else functions
        )

    def follows_attitude_exactly(self, system: System) -> bool:
        """Return whether the steps determine the attitude exactly: they do if nothing is projected off the slopes."""
        names = preserved_function_names(system)
        terms = terms_with_preserved_values(system.total_dissipation.terms, names)
        has_only_quadratics = all(
            C.is_quadratic
            for C in (self._held_functions_by_name(system) | _functions_determining_entropy(system)).values()
        )
        return has_only_quadratics and not any(
            self._functions_to_project_off(term, set(term_names), system) for term, term_names in terms
        )

    def preserves_function(self, system: System, name: str) -> bool:
        is_known_invariant = name in system.casimirs() or name in preserved_function_names(system)
        return (
            self._is_held_by_default(system, name) if is_known_invariant else super().preserves_function(system, name)
        )

    def _is_held_by_default(self, system: System, name: str) -> bool:
        """Return True for functions held without request: Casimirs, and those that the dissipation preserves.

        A skew friction is not projected, and keeps only quadratic functions by itself.
        """
        if name not in system.casimirs() and name not in preserved_function_names(system):
            return False
        return system.total_dissipation.is_symmetric or system.functions()[name].is_quadratic

    def _held_functions_by_name(self, system: System) -> dict[str, Energy]:
        """Return the functions that steps hold constant, by name: those of ``held``, and the user's ``preserve``."""
        functions = system.functions()
        user_functions = {f"given {i + 1}": C for i, C in enumerate(self.functions)}
        return {name: functions[name] for name in self.held} | user_functions

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        return apply_increment(
            self, system, x, compensation, self.increment(h, k), tuple(self._held_functions_by_name(system).values())
        )

    def _casimir_names(self, system: System) -> set[str]:
        """Return the names of all known Casimirs: of the system, and among the functions of ``preserve``."""
        user_indices = range(len(self.functions)) if self.moving is not None else ()
        return {*system.casimirs(), *(f"given {i + 1}" for i in user_indices if i not in (self.moving or ()))}

    def _symmetry_directions(self, system: System, u) -> jax.Array | None:
        """Return the directions ``Pi grad J`` at the stages for quadratic momentum maps J, shape (s, r, n)."""
        if system.energy.is_quadratic:
            return None
        casimirs = self._casimir_names(system)
        maps = [
            J for name, J in self._held_functions_by_name(system).items() if J.is_quadratic and name not in casimirs
        ]
        if not maps:
            return None
        sharp = system.poisson.sharp
        return jax.vmap(lambda point: jnp.stack([sharp(point, J.gradient(point)) for J in maps]))(u)

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        if not has_generator(system):
            return super().residual_jvp(system, x, compensation, h, k)
        return generator_field_residual_jvp(system, lambda k: self._stage_states(x, compensation, h, k), k)

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        return collocation_error_estimate(system, x, compensation, h, k)

    def __str__(self) -> str:
        suffix = f", preserve={len(self.functions)} functions" if self.functions else ""
        return f"MetriplecticGauss(stages={self.number}{suffix})"


class StageGradients(NamedTuple):
    """Gradients of a function at the stages, shape (s, n), or at one stage: the discrete ones and their limits."""

    discrete: jax.Array
    continuous: jax.Array


ENTROPY_KEY = "the entropy"
"""Key of the entropy among the gradients by name."""


def _functions_determining_entropy(system: System) -> dict[str, Energy]:
    """Return the functions, by name, of which the entropy is a function: all Casimirs if known, or the entropy.

    For a quadratic entropy the result is this entropy. It is empty if the entropy is not used.
    """
    S = _entropy_if_used(system)
    if S is None:
        return {}
    if S.is_quadratic or not system.orbit_levels.has_all_casimirs:
        return {ENTROPY_KEY: S}
    return system.casimirs()


def _entropy_if_used(system: System) -> Energy | None:
    """Return the entropy of a system, or None if the entropy has no law and no influence on the motion.

    This holds for Lindblad jumps, for example. A projection of the motion off the gradient of this entropy would only
    lower the order, where that gradient is infinite.
    """
    dissipation = system.total_dissipation
    has_no_part = dissipation.has_generator and not dissipation.needs_entropy
    return None if has_no_part and system.entropy_law is None else system.entropy


def _gradient_projector(
    system: System, u, gradients: list[StageGradients], n_components: int | None = None
) -> Callable:
    """Return the orthogonal projector off the given discrete gradients, which does not move the clock of the system.

    Only the first ``n_components`` components are projected: Pi moves no bath, and its rounding must not either.
    """

    def raise_index(alpha):
        vector = system.raise_index(u, alpha)
        return vector if n_components in (None, system.dim) else vector.at[n_components:].set(0.0)

    vectors = [(raise_index(g.discrete), raise_index(g.continuous)) for g in gradients]
    return gram_schmidt([d for d, _ in vectors], reference_vectors=[p for _, p in vectors]).project_off


register(MetriplecticGauss(1), MetriplecticGauss(2), MetriplecticGauss(3))
