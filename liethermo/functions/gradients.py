"""Discrete gradients: vectors with ``dgrad . d = H(x + d) - H(x)`` and ``dgrad -> grad H`` as d -> 0 [BFM 4.1].

The classical formulas divide the difference ``H(x + d) - H(x)``, which carries a rounding error of about ``eps |H|``,
by ``|d|``. A relaxing system ends in the regime d -> 0, where that is noise divided by nothing. Here the difference is
first *predicted* by Gauss quadrature of the gradient along the segment,

    H(x + d) - H(x)  =  int_0^1 grad H(x + t d) . d dt  ~  sum_j w_j grad H(x + c_j d) . d,

whose rounding error is about ``eps |grad H| |d|``: it vanishes with d. Only what the quadrature misses, its
*defect* (difference minus prediction), needs the difference itself. The defect is let through where it matters and
shut out where it is rounding noise, by a gate that is continuous, scale free, and closed near d = 0
(:func:`_gate_opening`). Quadratic terms have closed forms with no quotient at all, and of polynomials whose gradients the
quadrature is exact for nothing is missed: no value is asked for.
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
from .frames import gram_schmidt, sqrt_or_zero, sum_terms
from .path import CollocationPath, KronrodRule

EPS = float(np.finfo(np.float64).eps)

DIFFERENCE_NOISE = 4 * EPS
"""Rounding error of ``H(x') - H(x)`` relative to the size at which the values are rounded: a few roundings inside H. It
is less than what an audit allows H to change by, so that what is taken for rounding breaks no law."""

CURVATURE_SWITCH = 1e-6
"""Relative second difference of the slope, about 0.15 (|d|/L)^2 on a length L over which H varies, above which the
defect is always used. There |d|/L > 2.6e-3, so the quotient's noise is below 1e-13 of the gradient; below it the
three-node quadrature is exact to (|d|/L)^7 / 2e6 < 1e-23, nothing to lose even in 1e7 steps. A constant in H, or large
terms that cancel there, make the noise as many times larger: see :data:`NOISY`."""

MAX_DIFFERENCE_NOISE = 1e-11
"""Largest noise of the difference, relative to the gradient times the step, at which a defect below the noise is used.
The equations of an implicit step are then solved to their plateau all the same. Where the values of H are rounded more
coarsely, as beside a large constant, a defect that is less than their rounding is left to the steering of the
energy."""


class DiscreteGradient(Module):
    """A discrete gradient; ``gradient(energy, x, d)`` is that of the step from x to x + d, both of shape (n,).

    A sum of energies is treated term by term: discrete gradients add, and each term knows which of the methods below is
    its own (:meth:`liethermo.Energy.get_discrete_gradient`). ``compensation`` is what rounding has kept from x
    (compensated summation): points along the step are ``x + (compensation + c d)``, so that a step far below the
    rounding of x is still seen. Without it the rounding of the midpoint lets the energy drift linearly.
    """

    @property
    def order(self) -> int:
        """Order of the midpoint scheme (BFM 4.5) built on it: 2 if it is symmetric in x and x + d, else 1."""
        return 2

    @property
    def is_order_independent(self) -> bool:
        """Whether it does not depend on the order of the coordinates."""
        return False

    def __call__(self, energy: Energy, x, d, compensation=0.0) -> jax.Array:
        return sum_terms(term.discrete_gradient(self, x, d, compensation) for term in energy.terms)

    def quadratic(self, term: Energy, x, d, compensation) -> jax.Array:
        """The midpoint gradient: exact for quadratic functions."""
        return term.gradient(x + (compensation + 0.5 * d))

    @abstractmethod
    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        """The discrete gradient of a term that need not be quadratic."""

    def __str__(self) -> str:
        chosen = [f"{f.name}={getattr(self, f.name)}" for f in fields(self) if getattr(self, f.name) != f.default]
        return type(self).__name__ + (f"({', '.join(chosen)})" if chosen else "")


class Gonzalez(DiscreteGradient):
    """Midpoint discrete gradient ``grad H(z) + [H(x') - H(x) - grad H(z).d] d/|d|^2``, z = x + d/2 [BFM 4.3].

    ``noisy`` is :data:`NOISY`, or what takes its place where no equation is solved with it. With ``across`` the defect
    is used where the gradient varies in any direction, and not only along the step: on a circular orbit the gradient of
    the energy is across each step, and the quadrature misses a few roundings of one sign.
    """

    noisy: float = eqx.field(static=True, default=MAX_DIFFERENCE_NOISE)
    across: bool = eqx.field(static=True, default=False)

    is_order_independent = True

    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        left, middle, right = jax.vmap(lambda c: term.gradient(x + (compensation + c * d)))(_GAUSS_NODES_3)
        second = left + right - 2.0 * middle  # the prediction minus grad H(z).d is 5/18 second.d, free of cancellation
        if term.degree <= 2 * len(_GAUSS_NODES_3):
            return middle + _safe_divide((5 / 18) * jnp.dot(second, d), jnp.dot(d, d)) * d
        predicted = jnp.dot(middle, d) + (5 / 18) * jnp.dot(second, d)
        difference = _value_difference(term, x, d, compensation, middle)
        slope, size, length = (jnp.linalg.norm(v) for v in (middle, x, d))
        along = jnp.linalg.norm(second) * length if self.across else jnp.dot(second, d)
        defect = _gated_defect(*difference, predicted, slope * size, along, slope * length, self.noisy)
        return middle + _safe_divide((5 / 18) * jnp.dot(second, d) + defect, jnp.dot(d, d)) * d


class MeanValue(DiscreteGradient):
    """Averaged discrete gradient ``int_0^1 grad H(x + t d) dt`` [BFM 4.2], by Gauss quadrature.

    The quadrature is exact for polynomials of degree up to ``2 * nodes``; for other functions its defect is added
    along d, so that the defining identity, and with it the energy, holds for every H.
    """

    nodes: int = eqx.field(static=True, default=5)

    is_order_independent = True

    def __check_init__(self):
        if not isinstance(self.nodes, int) or self.nodes < 1:
            raise InputError(f"the number of quadrature nodes is a positive integer, not {self.nodes!r}")

    def general(self, term: Energy, x, d, compensation) -> jax.Array:
        points, weights = _gauss_rule(self.nodes)
        mean = jnp.asarray(weights) @ jax.vmap(lambda c: term.gradient(x + (compensation + c * d)))(points)
        if term.degree <= 2 * self.nodes:
            return mean
        difference = _value_difference(term, x, d, compensation, mean)
        rounding = jnp.linalg.norm(mean) * jnp.linalg.norm(x)
        defect = _gated_defect(*difference, jnp.dot(mean, d), rounding, 0.0, 1.0)
        return mean + _safe_divide(defect, jnp.dot(d, d)) * d


class CoordinateIncrement(DiscreteGradient):
    """Itoh-Abe gradient: the difference quotient in each coordinate in turn [BFM 4.4].

    As printed it is not symmetric in x and x', so the scheme built on it is of first order; with ``symmetric=True``
    the mean of the quotients taken forwards and backwards makes it second.
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
        forwards = self._coordinate_quotients(term, x, d)
        return 0.5 * (forwards + self._coordinate_quotients(term, x + d, -d)) if self.symmetric else forwards

    @staticmethod
    def _coordinate_quotients(term: Energy, x, d) -> jax.Array:
        n = x.shape[0]
        corners = x + jnp.tril(jnp.ones((n + 1, n)), -1) * d  # corner i has the first i coordinates moved
        values = _values_at_points(term, corners)

        def slopes(corner, direction, step):  # of H along the edge that leaves a corner, and |grad H|
            gradients = jax.vmap(lambda c: term.gradient(corner + c * step * direction))(_GAUSS_NODES_3)
            return gradients @ direction, jnp.linalg.norm(gradients[1])

        along, slope = jax.vmap(slopes)(corners[:-1], jnp.eye(n), d)
        second = along[:, 0] + along[:, 2] - 2.0 * along[:, 1]
        mean = along[:, 1] + (5 / 18) * second
        sizes = _value_rounding_scale(values[1:], values[:-1], term.rounding_scale(x))
        found = values[1:] - values[:-1]
        defect = _gated_defect(found, sizes, mean * d, slope * jnp.linalg.norm(x), second * d, slope * jnp.abs(d))
        return mean + _safe_divide(defect, d)


DISCRETE_GRADIENTS: dict[str, DiscreteGradient] = {
    "gonzalez": Gonzalez(),
    "mean_value": MeanValue(),
    "coordinate_increment": CoordinateIncrement(),
    "symmetric_coordinate_increment": CoordinateIncrement(symmetric=True),
}


def get_discrete_gradient(choice: str | DiscreteGradient) -> DiscreteGradient:
    """The discrete gradient of that name, or the object itself."""
    if isinstance(choice, DiscreteGradient):
        return choice
    if choice not in DISCRETE_GRADIENTS:
        raise InputError(f"no discrete gradient {choice!r}; the names are {', '.join(map(repr, DISCRETE_GRADIENTS))}")
    return DISCRETE_GRADIENTS[choice]


MIN_GRADIENT_VARIATION = 1e-3
"""Relative variation of the gradient over a step above which the defect of collocation is used. Below it the
quadrature is exact to 1e-19 of what H varies by, on lengths ten times shorter too (with ``finer`` nodes for one and
two stages); above it the noise of the defect is below 1e-11 of the gradient."""

MAX_NOISE_CORRECTION = 1e-10
"""Largest share of the gradient that a correction made of rounding noise may have."""


def stage_gradients(
    energy: Energy, x, compensation, h, k, A, b, kronrod: KronrodRule | None = None, symmetries: jax.Array | None = None
) -> jax.Array:
    """Discrete gradients at the stages of a collocation method, shape (s, n) [:doc:`/explanation/exact_laws`].

    ``grad H(u_i) + alpha d_i`` at ``u_i = x + h sum_j A_ij k_j``, with the one alpha for which
    ``h sum_i b_i g_i . k_i = H(x') - H(x)``. It is O(h^{2s}) for Gauss nodes, and 0 for quadratic terms. The direction
    d_i is k_i, less its components in the directions of symmetries of H: the discrete gradient has none of these, as
    grad H has none [Gonzalez 1996, "equivariant"].

    Parameters
    ----------
    x, compensation : array, shape (n,)
        The state is x + compensation.
    k : array, shape (s, n)
    A, b : array, shapes (s, s) and (s,)
    kronrod : Finer, optional
        A better quadrature along the collocation polynomial, for methods of few stages. An energy with a part that
        varies on lengths far below those seen in its gradient drifts without it, at steps where the defect is shut out:
        two nodes missed 5e-15 of H in each of a hundred steps.
    symmetries : array, shape (s, r, n), optional
        Vectors at the stages along which H does not change.
    """
    u = x + (compensation + h * (A @ k))
    further = None if kronrod is None else (x + (compensation + h * (kronrod.A @ k)), kronrod.slope_matrix @ k)
    path = CollocationPath(x, compensation, h * (b @ k), u, k, further, symmetries, h, b, kronrod)
    return sum_terms(term.stage_gradients(_corrected_stage_gradients, path) for term in energy.terms)


def _corrected_stage_gradients(term: Energy, path: CollocationPath, correction_weights=None) -> jax.Array:
    """Gradients of one term; ``correction_weights`` names the components of the slopes to correct along, all by default.

    It may give them weights, shape (m,), and may be a function of the gradients at the stages, shape (s, m).
    """
    if term.is_quadratic:
        return jax.vmap(term.gradient)(path.points)
    x, compensation, k, h, b = path.start, path.compensation, path.slopes, path.h, path.b
    change = FunctionChange.of(
        term,
        x,
        compensation,
        path.step,
        [path.points, *(() if path.kronrod_samples is None else path.kronrod_samples[:1])],
    )
    gradients, between = change.gradients[: len(k)], change.gradients[len(k) :]
    smooth, spread = jnp.zeros(()), jnp.zeros(())
    if path.kronrod is not None and path.kronrod_samples is not None:
        # Both rules are exact for a gradient that does not vary: less one of the gradients the two sums vanish with the
        # step, where rounding of the weights alone would be divided by it in a derivative.
        rates = jnp.sum((between - gradients[0]) * path.kronrod_samples[1], axis=1)
        own = jnp.sum((gradients - gradients[0]) * k, axis=1)
        smooth = h * (jnp.dot(path.kronrod.b, rates) + jnp.dot(path.kronrod.weight_change, own))
        spread = jnp.max(jnp.linalg.norm(between - b @ gradients, axis=1))
    weights = correction_weights(gradients) if callable(correction_weights) else correction_weights
    return correct_gradients(
        change, gradients, k, CorrectionDirection.of(k, b, weights, path.symmetries), h, b, smooth, spread
    )


class CorrectionDirection(NamedTuple):
    """What a correction goes along, one multiple of it at all stages.

    Attributes
    ----------
    vectors : array, shape (s, m)
    square : array, shape ()
        ``sum_i b_i d_i . k_i``, d the vectors; not negative.
    length_fraction : array, shape ()
        The length of what symmetries leave of them, relative to what they are without. Near a relative equilibrium that
        is little, and noise must not be divided by it.
    """

    vectors: jax.Array
    square: jax.Array
    length_fraction: jax.Array

    @classmethod
    def of(cls, k, b, weights=None, symmetries=None) -> CorrectionDirection:
        """``d = W k``, W diagonal with the weights, but orthogonal to the symmetries, shape (s, r, m)."""
        scale = jnp.ones(()) if weights is None else sqrt_or_zero(weights)
        whole = left = scale * k
        if symmetries is not None:
            left = jax.vmap(lambda v, along: gram_schmidt(list(along)).project_off(v))(whole, scale * symmetries)
        square, most = (jnp.dot(b, jnp.sum(v * v, axis=1)) for v in (left, whole))
        return cls(scale * left, square, _safe_divide(jnp.sqrt(square), jnp.sqrt(most)))


class FunctionChange(NamedTuple):
    """What a function changes by in a step, from its values; and its gradients at some points.

    Attributes
    ----------
    difference : array, shape ()
    noise : array, shape ()
        Its rounding error.
    gradients : array, shape (points, n)
    """

    difference: jax.Array
    noise: jax.Array
    gradients: jax.Array

    @classmethod
    def of(cls, term: Energy, x, compensation, d, points: list[jax.Array]) -> FunctionChange:
        """The change over the step from x + compensation to x + compensation + d."""
        new, new_compensation = two_sum(x, compensation + d)
        # one map for all points, as one is what a compiler has to work on
        found = jax.vmap(term.gradient)(jnp.concatenate([*points, jnp.stack([x, new])]))
        gradients, ends = found[:-2], found[-2:]
        # which count for rounding alone: at an end where one is infinite, as of a root that ends there, for none
        ends = jnp.where(jnp.isfinite(ends), ends, 0.0)
        before, after = _values_at_points(term, jnp.stack([x, new]))
        # of the compensated states: else a step takes back what rounding, or a steering of the energy, has put there
        difference = (after - before) + (jnp.dot(ends[1], new_compensation) - jnp.dot(ends[0], compensation))
        slope = jnp.max(jnp.linalg.norm(ends, axis=1))
        size = _value_rounding_scale(before, after, term.rounding_scale(x))
        noise = DIFFERENCE_NOISE * size + 4 * EPS * slope * jnp.linalg.norm(x)
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
    """``gradients + alpha d``, shape (s, n), with ``h sum_i b_i (.)_i . k_i`` the change of the function.

    ``quadrature_correction`` is what a better quadrature adds to that of the gradients, ``gradient_variation`` how far the gradients between the
    stages are from their mean at the stages.
    """
    mean, d = b @ gradients, direction.vectors
    slope, gradient_variation = (
        jnp.linalg.norm(mean),
        jnp.maximum(gradient_variation, jnp.max(jnp.linalg.norm(gradients - mean, axis=1))),
    )
    defect = change.difference - (h * jnp.dot(b, jnp.sum(gradients * k, axis=1)) + quadrature_correction)
    length = jnp.sqrt(jnp.dot(b, jnp.sum(d * d, axis=1)))
    harm = jnp.maximum(jnp.abs(defect) * (1.0 / MAX_NOISE_CORRECTION), change.noise * (1.0 / MAX_DIFFERENCE_NOISE))
    harmless = 1.0 - _gate_opening(_safe_divide(harm, h * direction.square) * length, slope * direction.length_fraction)
    opened = jnp.maximum(
        _gate_opening(defect, change.noise),
        harmless * _gate_opening(gradient_variation, MIN_GRADIENT_VARIATION * slope),
    )
    return gradients + _safe_divide(quadrature_correction + _apply_gate(defect, opened), h * direction.square) * d


def two_sum(x, d) -> tuple[jax.Array, jax.Array]:
    """x + d as a double, and what rounding keeps from it (Neumaier's two-sum)."""
    new = x + d
    back = new - x
    return new, (x - (new - back)) + (d - back)


def _values_at_points(term: Energy, points) -> jax.Array:
    """H at each of the points, by the same instructions.

    What ends one step begins the next, and the rounding of H has to cancel there. Compiled apart, two evaluations may
    fuse multiplications and additions differently; then H drifts by 1e-11 in 3e5 steps.
    """
    return jax.vmap(term.value)(points)


def _value_difference(term: Energy, x, d, compensation, gradient) -> tuple[jax.Array, jax.Array]:
    """``H(y + d) - H(y)`` from y = x + compensation, and the size at which it is rounded.

    ``gradient`` is one in between.

    From values where steps begin and end, so that their rounding cancels from step to step, and the gradient for what
    these points leave out: else a step would take back what rounding, or a steering of the energy, has put there.
    """
    new, new_compensation = two_sum(x, compensation + d)
    before, after = _values_at_points(term, jnp.stack([x, new]))
    difference = (after - before) + jnp.dot(gradient, new_compensation - compensation)
    return difference, _value_rounding_scale(before, after, term.rounding_scale(x))


def _value_rounding_scale(before, after, terms):
    """The size at which the values at both ends are rounded: theirs, or that of the terms inside."""
    return jnp.maximum(jnp.maximum(jnp.abs(before), jnp.abs(after)), terms)


def _gated_defect(
    difference, size, predicted, argument_effect, second_difference, slope_scale, noisy=MAX_DIFFERENCE_NOISE
):
    """Defect of a predicted difference of two values of H, shut out where it is no more than rounding noise.

    ``size`` is that at which the values are rounded, ``argument_effect`` is ``|grad H| |x|``: one rounding of the
    argument moves H by eps times that.
    """
    defect = difference - predicted
    noise = DIFFERENCE_NOISE * size + 4 * EPS * argument_effect
    curved = jnp.abs(second_difference) * (1.0 / CURVATURE_SWITCH) - slope_scale
    harmless = 2.0 * slope_scale - noise * (1.0 / noisy)
    opened = jnp.maximum(_gate_opening(defect, noise), _clipped_ratio(jnp.minimum(curved, harmless), slope_scale))
    return _apply_gate(defect, opened)


def _apply_gate(defect, opened):
    """The defect by the opening of its gate, 0 to 1; but a NaN must not be hidden by a closed gate."""
    opened = jax.lax.stop_gradient(opened)
    return jnp.where(opened > 0.0, opened * defect, jnp.where(jnp.isfinite(defect), 0.0, defect))


def _gate_opening(size, threshold):
    """0 where ``|size| <= threshold``, 1 from twice that on, linear (so continuous) between."""
    return _clipped_ratio(jnp.abs(size) - threshold, threshold)


def _clipped_ratio(part, whole):
    """The quotient of two numbers, the second positive or zero, between 0 and 1."""
    return jnp.clip(part / jnp.maximum(whole, _TINY), 0.0, 1.0)


def _safe_divide(numerator, denominator):
    """Quotient, 0 where the denominator is 0 or subnormal; safe to differentiate."""
    usable = jnp.abs(denominator) > _TINY
    return jnp.where(usable, numerator / jnp.where(usable, denominator, 1.0), 0.0)


def _gauss_rule(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    points, weights = np.polynomial.legendre.leggauss(nodes)
    return (points + 1.0) / 2.0, weights / 2.0


_GAUSS_NODES_3 = _gauss_rule(3)[0]
_TINY = 1e-290
