"""Discrete gradients: vectors with ``dgrad . d = H(x + d) - H(x)`` and ``dgrad -> grad H`` as d -> 0 [BFM 4.1].

The classical formulas divide the difference ``H(x + d) - H(x)``, which carries a rounding error of about ``eps |H|``,
by ``|d|``. A relaxing system ends in the regime d -> 0, where this quotient is noise. Here the difference is first
*predicted* by Gauss quadrature of the gradient along the segment,

    H(x + d) - H(x)  =  int_0^1 grad H(x + t d) . d dt  ~  sum_j w_j grad H(x + c_j d) . d,

whose rounding error is about ``eps |grad H| |d|``: it vanishes with d. Only the error of the quadrature, its *defect*
(difference minus prediction), needs the difference itself. A gate lets the defect through where it matters and
suppresses it where it is rounding noise; the gate is continuous, scale free, and closed near d = 0
(:func:`_ramp_above_threshold`). Quadratic terms have closed forms without a quotient. Polynomials for which the
quadrature is exact have no defect, so no value is computed.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import fields
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..errors import InputError
from .energy import Energy
from .frames import gram_schmidt, sqrt_or_zero, sum_arrays
from .path import CollocationPath, KronrodRule

EPS = float(np.finfo(np.float64).eps)
"""Spacing of float64 numbers at 1."""

DIFFERENCE_NOISE = 4 * EPS
"""Rounding error of ``H(x') - H(x)`` relative to the scale at which the values are rounded: a few roundings inside H.

It is less than the change of H that an audit allows, so a defect that is suppressed as rounding breaks no law.
"""

CURVATURE_SWITCH = 1e-6
"""Relative second difference of the slope above which the defect is always used.

It is about 0.15 (|d|/L)^2 on a length L over which H varies. Above the switch, |d|/L > 2.6e-3, so the noise of the
quotient is below 1e-13 of the gradient. Below the switch, the three-node quadrature is exact to (|d|/L)^7 / 2e6 <
1e-23, so that nothing is lost even in 1e7 steps. A constant in H, or large terms that cancel, make the noise larger:
see :data:`MAX_DIFFERENCE_NOISE`.
"""

MAX_DIFFERENCE_NOISE = 1e-11
"""Largest noise of the difference, relative to gradient times step, at which a defect below the noise is used.

The equations of an implicit step can still be solved to their plateau. If the values of H are rounded more coarsely, as
beside a large constant, a defect below their rounding is left to the correction of the energy.
"""


class DiscreteGradient(Module):
    """A discrete gradient; ``gradient(energy, x, d)`` is that of the step from x to x + d, both of shape (n,).

    A sum of energies is treated term by term: discrete gradients add, and each term selects one of the methods below
    (:meth:`liethermo.Energy.discrete_gradient`). ``compensation`` is the part of x that rounding has removed
    (compensated summation): points along the step are ``x + (compensation + c d)``, so that a step far below the
    rounding of x still has an effect. Without it the rounding of the midpoint lets the energy drift linearly.
    """

    @property
    def order(self) -> int:
        """Order of the midpoint scheme (BFM 4.5) built on it: 2 if it is symmetric in x and x + d, else 1."""
        return 2

    @property
    def is_coordinate_order_independent(self) -> bool:
        """True if the result does not depend on the order of the coordinates."""
        return False

    def __call__(self, energy: Energy, x, d, compensation=0.0) -> jax.Array:
        """Return the discrete gradient of an energy from x + compensation to x + compensation + d, shape (n,)."""
        return sum_arrays(term.discrete_gradient(self, x, d, compensation) for term in energy.terms)

    def quadratic(self, term: Energy, x, d, compensation) -> jax.Array:
        """Return the discrete gradient of a quadratic term, the exact gradient at the midpoint."""
        return term.gradient(x + (compensation + 0.5 * d))

    @abstractmethod
    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        """Return the discrete gradient of a term that need not be quadratic."""

    def __str__(self) -> str:
        changed_fields = [
            f"{f.name}={getattr(self, f.name)}" for f in fields(self) if getattr(self, f.name) != f.default
        ]
        return type(self).__name__ + (f"({', '.join(changed_fields)})" if changed_fields else "")


class Gonzalez(DiscreteGradient):
    """Midpoint discrete gradient ``grad H(z) + [H(x') - H(x) - grad H(z).d] d/|d|^2``, z = x + d/2 [BFM 4.3].

    ``noisy`` is the largest noise of the difference, :data:`MAX_DIFFERENCE_NOISE` by default, at which a defect below
    the noise is used; it may be larger where no equation is solved. With ``across`` the defect is used where the
    gradient varies in any direction, not only along the step: on a circular orbit the gradient of the energy is
    perpendicular to each step, and the quadrature misses a few roundings of one sign.
    """

    noisy: float = eqx.field(static=True, default=MAX_DIFFERENCE_NOISE)
    across: bool = eqx.field(static=True, default=False)

    is_coordinate_order_independent = True

    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        g_start, g_middle, g_end = jax.vmap(lambda c: term.gradient(x + (compensation + c * d)))(_GAUSS_NODES_3)
        # the prediction minus grad H(z).d is 5/18 second_difference.d, free of cancellation
        second_difference = g_start + g_end - 2.0 * g_middle
        if term.degree <= 2 * len(_GAUSS_NODES_3):
            return g_middle + _safe_divide((5 / 18) * jnp.dot(second_difference, d), jnp.dot(d, d)) * d
        prediction = jnp.dot(g_middle, d) + (5 / 18) * jnp.dot(second_difference, d)
        difference = _value_difference_and_rounding_scale(term, x, d, compensation, g_middle)
        gradient_norm, state_norm, step_norm = (jnp.linalg.norm(v) for v in (g_middle, x, d))
        curvature = jnp.linalg.norm(second_difference) * step_norm if self.across else jnp.dot(second_difference, d)
        defect = _gated_defect(
            *difference, prediction, gradient_norm * state_norm, curvature, gradient_norm * step_norm, self.noisy
        )
        return g_middle + _safe_divide((5 / 18) * jnp.dot(second_difference, d) + defect, jnp.dot(d, d)) * d


class MeanValue(DiscreteGradient):
    """Averaged discrete gradient ``int_0^1 grad H(x + t d) dt`` [BFM 4.2], by Gauss quadrature.

    The quadrature is exact for polynomials of degree up to ``2 * nodes``; for other functions its defect is added along
    d, so that the defining identity, and with it the energy, holds for every H.

    Parameters
    ----------
    nodes : int
        The number of nodes of the quadrature.
    """

    nodes: int = eqx.field(static=True, default=5)

    is_coordinate_order_independent = True

    def __check_init__(self):
        if not isinstance(self.nodes, int) or self.nodes < 1:
            raise InputError(f"nodes must be a positive integer, got {self.nodes!r}")

    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        points, weights = _gauss_rule(self.nodes)
        mean = jnp.asarray(weights) @ jax.vmap(lambda c: term.gradient(x + (compensation + c * d)))(points)
        if term.degree <= 2 * self.nodes:
            return mean
        difference = _value_difference_and_rounding_scale(term, x, d, compensation, mean)
        rounding = jnp.linalg.norm(mean) * jnp.linalg.norm(x)
        defect = _gated_defect(*difference, jnp.dot(mean, d), rounding, 0.0, 1.0)
        return mean + _safe_divide(defect, jnp.dot(d, d)) * d


class CoordinateIncrement(DiscreteGradient):
    """Itoh-Abe gradient: the difference quotient in each coordinate in turn [BFM 4.4].

    As printed it is not symmetric in x and x', so the scheme built on it is of first order. With ``symmetric=True`` it
    is the mean of the forward and backward quotients, and of second order.
    """

    symmetric: bool = eqx.field(static=True, default=False)

    @property
    def order(self) -> int:
        return 2 if self.symmetric else 1

    def quadratic(self, term: Energy, x, d, compensation) -> jax.Array:
        if self.symmetric:
            return term.gradient(x + (compensation + 0.5 * d))
        A = jax.hessian(term.value)(x)
        return term.gradient(x + compensation) + (jnp.tril(A, -1) + 0.5 * jnp.diag(jnp.diag(A))) @ d

    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        x = x + compensation
        forward_quotients = self._coordinate_quotients(term, x, d)
        return (
            0.5 * (forward_quotients + self._coordinate_quotients(term, x + d, -d))
            if self.symmetric
            else forward_quotients
        )

    @staticmethod
    def _coordinate_quotients(term: Energy, x, d) -> jax.Array:
        """Return the difference quotient of a term in each coordinate, shape (n,), the coordinates changed in turn."""
        n = x.shape[0]
        corners = x + jnp.tril(jnp.ones((n + 1, n)), -1) * d  # corner i has the first i coordinates of x + d
        values = _values_at_points(term, corners)

        def edge_slopes_and_gradient_norm(
            corner, unit_vector, increment
        ):  # of H along the edge at a corner, and |grad H|
            gradients = jax.vmap(lambda c: term.gradient(corner + c * increment * unit_vector))(_GAUSS_NODES_3)
            return gradients @ unit_vector, jnp.linalg.norm(gradients[1])

        edge_slopes, gradient_norms = jax.vmap(edge_slopes_and_gradient_norm)(corners[:-1], jnp.eye(n), d)
        second_differences = edge_slopes[:, 0] + edge_slopes[:, 2] - 2.0 * edge_slopes[:, 1]
        mean = edge_slopes[:, 1] + (5 / 18) * second_differences
        rounding_scales = _value_rounding_scale(values[1:], values[:-1], term.rounding_scale(x))
        differences = values[1:] - values[:-1]
        defect = _gated_defect(
            differences,
            rounding_scales,
            mean * d,
            gradient_norms * jnp.linalg.norm(x),
            second_differences * d,
            gradient_norms * jnp.abs(d),
        )
        return mean + _safe_divide(defect, d)


DISCRETE_GRADIENTS: dict[str, DiscreteGradient] = {
    "gonzalez": Gonzalez(),
    "mean_value": MeanValue(),
    "coordinate_increment": CoordinateIncrement(),
    "symmetric_coordinate_increment": CoordinateIncrement(symmetric=True),
}
"""The discrete gradients, by name."""


def discrete_gradient_by_name(name_or_object: str | DiscreteGradient) -> DiscreteGradient:
    """Return the discrete gradient with this name; an object is returned unchanged."""
    if isinstance(name_or_object, DiscreteGradient):
        return name_or_object
    if name_or_object not in DISCRETE_GRADIENTS:
        raise InputError(
            f"no discrete gradient {name_or_object!r}; the names are {', '.join(map(repr, DISCRETE_GRADIENTS))}"
        )
    return DISCRETE_GRADIENTS[name_or_object]


MIN_GRADIENT_VARIATION = 1e-3
"""Relative variation of the gradient over a step above which the defect of collocation is used.

Below it the quadrature is exact to 1e-19 of the variation of H, even for functions that vary on ten times shorter
lengths (with Kronrod nodes for one and two stages). Above it the noise of the defect is below 1e-11 of the gradient.
"""

MAX_NOISE_CORRECTION = 1e-10
"""Largest correction that consists of rounding noise, relative to the gradient."""


def discrete_gradients_at_stages(
    energy: Energy, x, compensation, h, k, A, b, kronrod: KronrodRule | None = None, symmetries: jax.Array | None = None
) -> jax.Array:
    """Return discrete gradients at the stages of a collocation method, shape (s, n) [:doc:`/explanation/exact_laws`].

    They are ``grad H(u_i) + alpha d_i`` at ``u_i = x + h sum_j A_ij k_j``, with the number alpha for which ``h sum_i
    b_i g_i . k_i = H(x') - H(x)``. For Gauss nodes alpha is O(h^{2s}); for quadratic terms it is 0. The direction d_i
    is k_i without its components in the directions of symmetries of H, as grad H has none of these [Gonzalez 1996,
    "equivariant"].

    Parameters
    ----------
    x, compensation : array, shape (n,)
        The state is x + compensation.
    k : array, shape (s, n)
    A, b : array, shapes (s, s) and (s,)
    kronrod : KronrodRule, optional
        A better quadrature along the collocation polynomial, for methods of few stages. Without it the energy drifts at
        steps where the defect is suppressed, if it has a part that varies on much shorter lengths than its gradient
        shows: two nodes missed 5e-15 of H in each of a hundred steps.
    symmetries : array, shape (s, r, n), optional
        Vectors at the stages along which H does not change.
    """
    u = x + (compensation + h * (A @ k))
    kronrod_samples = None if kronrod is None else (x + (compensation + h * (kronrod.A @ k)), kronrod.slope_matrix @ k)
    path = CollocationPath(x, compensation, h * (b @ k), u, k, kronrod_samples, symmetries, h, b, kronrod)
    return sum_arrays(term.stage_gradients(_corrected_stage_gradients, path) for term in energy.terms)


def _corrected_stage_gradients(term: Energy, path: CollocationPath, correction_weights=None) -> jax.Array:
    """Return the discrete gradients of one term at the stages, shape (s, m).

    ``correction_weights``, shape (m,), weights the components of the slopes in the direction of the correction; it may
    be a function of the gradients at the stages, shape (s, m). By default all weights are 1.
    """
    if term.is_quadratic:
        return jax.vmap(term.gradient)(path.points)
    x, compensation, k, h, b = path.start, path.compensation, path.slopes, path.h, path.b
    change = FunctionChange.from_step(
        term,
        x,
        compensation,
        path.step,
        [path.points, *(() if path.kronrod_samples is None else path.kronrod_samples[:1])],
    )
    gradients, kronrod_gradients = change.gradients[: len(k)], change.gradients[len(k) :]
    quadrature_correction, gradient_variation = jnp.zeros(()), jnp.zeros(())
    if path.kronrod is not None and path.kronrod_samples is not None:
        # Both rules are exact for a constant gradient. With one gradient subtracted, the two sums vanish with the step;
        # otherwise a derivative would divide the rounding errors of the weights by the step.
        kronrod_rates = jnp.sum((kronrod_gradients - gradients[0]) * path.kronrod_samples[1], axis=1)
        stage_rates = jnp.sum((gradients - gradients[0]) * k, axis=1)
        quadrature_correction = h * (
            jnp.dot(path.kronrod.b, kronrod_rates) + jnp.dot(path.kronrod.weight_change, stage_rates)
        )
        gradient_variation = jnp.max(jnp.linalg.norm(kronrod_gradients - b @ gradients, axis=1))
    weights = correction_weights(gradients) if callable(correction_weights) else correction_weights
    return correct_gradients(
        change,
        gradients,
        k,
        CorrectionDirection.from_slopes(k, b, weights, path.symmetries),
        h,
        b,
        quadrature_correction,
        gradient_variation,
    )


class CorrectionDirection(NamedTuple):
    """The direction of a correction of gradients; all stages are corrected by one multiple of it.

    Attributes
    ----------
    vectors : array, shape (s, m)
    square : array, shape ()
        ``sum_i b_i d_i . k_i``, d the vectors; not negative.
    length_fraction : array, shape ()
        Length of the vectors relative to their length before symmetries are projected off. It is small near a relative
        equilibrium, and noise must not be divided by it.
    """

    vectors: jax.Array
    square: jax.Array
    length_fraction: jax.Array

    @classmethod
    def from_slopes(cls, k, b, weights=None, symmetries=None) -> CorrectionDirection:
        """Return the direction ``d = W k``, W diagonal, without components along the symmetries, shape (s, r, m)."""
        scale = jnp.ones(()) if weights is None else sqrt_or_zero(weights)
        weighted_slopes = projection = scale * k
        if symmetries is not None:
            projection = jax.vmap(lambda v, directions: gram_schmidt(list(directions)).project_off(v))(
                weighted_slopes, scale * symmetries
            )
        square, full_square = (jnp.dot(b, jnp.sum(v * v, axis=1)) for v in (projection, weighted_slopes))
        return cls(scale * projection, square, _safe_divide(jnp.sqrt(square), jnp.sqrt(full_square)))


class FunctionChange(NamedTuple):
    """The change of an energy term over a step, computed from its values, and its gradients at some points.

    Attributes
    ----------
    difference : array, shape ()
    noise : array, shape ()
        Rounding error of the difference.
    gradients : array, shape (points, n)
    """

    difference: jax.Array
    noise: jax.Array
    gradients: jax.Array

    @classmethod
    def from_step(cls, term: Energy, x, compensation, d, points: list[jax.Array]) -> FunctionChange:
        """Return the change of a term from x + compensation to x + compensation + d."""
        new_x, new_compensation = two_sum(x, compensation + d)
        # one vmap for all points, so that the gradient is compiled once
        point_gradients = jax.vmap(term.gradient)(jnp.concatenate([*points, jnp.stack([x, new_x])]))
        gradients, end_gradients = point_gradients[:-2], point_gradients[-2:]
        # these matter only for rounding; an infinite one, as of a root at its end, is ignored
        end_gradients = jnp.where(jnp.isfinite(end_gradients), end_gradients, 0.0)
        start_value, end_value = _values_at_points(term, jnp.stack([x, new_x]))
        # of the compensated states: otherwise a step would undo what rounding or a correction of the energy has changed
        difference = (end_value - start_value) + (
            jnp.dot(end_gradients[1], new_compensation) - jnp.dot(end_gradients[0], compensation)
        )
        max_gradient_norm = jnp.max(jnp.linalg.norm(end_gradients, axis=1))
        rounding_scale = _value_rounding_scale(start_value, end_value, term.rounding_scale(x))
        noise = DIFFERENCE_NOISE * rounding_scale + 4 * EPS * max_gradient_norm * jnp.linalg.norm(x)
        return cls(difference, noise, gradients)


def correct_gradients(
    change: FunctionChange,
    gradients,
    k,
    direction: CorrectionDirection,
    h,
    b,
    quadrature_correction=0.0,
    gradient_variation=0.0,
) -> jax.Array:
    """Return the gradients plus ``alpha d``, shape (s, n), so that their quadrature is the change of the function.

    ``quadrature_correction`` is the difference of a better quadrature from that of the gradients;
    ``gradient_variation`` is the largest distance of gradients between the stages from the mean at the stages.
    """
    mean, d = b @ gradients, direction.vectors
    gradient_norm = jnp.linalg.norm(mean)
    gradient_variation = jnp.maximum(gradient_variation, jnp.max(jnp.linalg.norm(gradients - mean, axis=1)))
    defect = change.difference - (h * jnp.dot(b, jnp.sum(gradients * k, axis=1)) + quadrature_correction)
    length = jnp.sqrt(jnp.dot(b, jnp.sum(d * d, axis=1)))
    noise_bound = jnp.maximum(
        jnp.abs(defect) * (1.0 / MAX_NOISE_CORRECTION), change.noise * (1.0 / MAX_DIFFERENCE_NOISE)
    )
    noise_gate = 1.0 - _ramp_above_threshold(
        _safe_divide(noise_bound, h * direction.square) * length, gradient_norm * direction.length_fraction
    )
    gate = jnp.maximum(
        _ramp_above_threshold(defect, change.noise),
        noise_gate * _ramp_above_threshold(gradient_variation, MIN_GRADIENT_VARIATION * gradient_norm),
    )
    return gradients + _safe_divide(quadrature_correction + _apply_gate(defect, gate), h * direction.square) * d


def two_sum(x, d) -> tuple[jax.Array, jax.Array]:
    """Return x + d in float64, and its rounding error (Neumaier's two-sum)."""
    total = x + d
    increment = total - x
    return total, (x - (total - increment)) + (d - increment)


def _values_at_points(term: Energy, points) -> jax.Array:
    """Return the values of a term at points, all computed by the same machine instructions.

    The end of one step is the start of the next, and the rounding of H must cancel there. Two evaluations that are
    compiled separately may fuse multiplications and additions differently; H then drifts by 1e-11 in 3e5 steps.
    """
    return jax.vmap(term.value)(points)


def _value_difference_and_rounding_scale(term: Energy, x, d, compensation, gradient) -> tuple[jax.Array, jax.Array]:
    """Return ``H(y + d) - H(y)``, y = x + compensation, and the scale at which it is rounded.

    The values are taken where steps begin and end, so that their rounding cancels from step to step; ``gradient``,
    evaluated in between, adds the effect of the compensation. Otherwise a step would undo what rounding, or a
    correction of the energy, has changed.
    """
    new_x, new_compensation = two_sum(x, compensation + d)
    start_value, end_value = _values_at_points(term, jnp.stack([x, new_x]))
    difference = (end_value - start_value) + jnp.dot(gradient, new_compensation - compensation)
    return difference, _value_rounding_scale(start_value, end_value, term.rounding_scale(x))


def _value_rounding_scale(start_values, end_values, term_scale):
    """Return the scale at which values at both ends of a step are rounded, the largest of both and ``term_scale``."""
    return jnp.maximum(jnp.maximum(jnp.abs(start_values), jnp.abs(end_values)), term_scale)


def _gated_defect(
    difference,
    rounding_scale,
    prediction,
    argument_effect,
    second_difference,
    slope_scale,
    max_noise=MAX_DIFFERENCE_NOISE,
):
    """Return the defect of a predicted difference of two values of H, suppressed if it is only rounding noise.

    ``rounding_scale`` is the scale at which the values are rounded. ``argument_effect`` is ``|grad H| |x|``: one
    rounding of the argument changes H by eps times that.
    """
    defect = difference - prediction
    noise = DIFFERENCE_NOISE * rounding_scale + 4 * EPS * argument_effect
    curvature_margin = jnp.abs(second_difference) * (1.0 / CURVATURE_SWITCH) - slope_scale
    noise_margin = 2.0 * slope_scale - noise * (1.0 / max_noise)
    gate = jnp.maximum(
        _ramp_above_threshold(defect, noise), _clipped_ratio(jnp.minimum(curvature_margin, noise_margin), slope_scale)
    )
    return _apply_gate(defect, gate)


def _apply_gate(defect, gate):
    """Return the defect times the opening of its gate, 0 to 1; a NaN passes even a closed gate."""
    gate = jax.lax.stop_gradient(gate)
    return jnp.where(gate > 0.0, gate * defect, jnp.where(jnp.isfinite(defect), 0.0, defect))


def _ramp_above_threshold(value, threshold):
    """Return 0 where ``|value| <= threshold``, 1 above twice the threshold, and a linear function between."""
    return _clipped_ratio(jnp.abs(value) - threshold, threshold)


def _clipped_ratio(numerator, denominator):
    """Return the quotient of two numbers, clipped to [0, 1]; the denominator must not be negative."""
    return jnp.clip(numerator / jnp.maximum(denominator, _TINY), 0.0, 1.0)


def _safe_divide(numerator, denominator):
    """Return a quotient with finite derivatives; 0 where the denominator is less than ``_TINY``."""
    is_usable = jnp.abs(denominator) > _TINY
    return jnp.where(is_usable, numerator / jnp.where(is_usable, denominator, 1.0), 0.0)


def _gauss_rule(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights of Gauss quadrature on [0, 1]."""
    points, weights = np.polynomial.legendre.leggauss(n_nodes)
    return (points + 1.0) / 2.0, weights / 2.0


_GAUSS_NODES_3 = _gauss_rule(3)[0]
"""Nodes of the Gauss rule with three nodes on [0, 1]."""

_TINY = 1e-150
"""Smallest modulus of a divisor: the derivative of a quotient divides by its square, which underflows below 1e-308."""
