"""Metrics projected off the gradients of what is to stay constant."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from ..functions.checks import recognised
from ..functions.energy import Energy, as_energy
from .base import Dissipation
from .checks import checked_rate, form_at, semidefinite


class ProjectedMetric(Dissipation):
    """Dissipation by a cometric G, projected off what it has to conserve [BFM 2.2, Remark 2.1].

    ``K(alpha, beta) = det(C) G(P alpha, P beta)``, P the G-orthogonal projector off the span of dH and the
    gradients dL_a of ``preserve``, and ``C_ab = G(dL_a, dL_b)`` with L_1 = H. For the energy alone
    ``det(C) = G(dH, dH)`` and this is BFM (2.2), ``G(dH, dH) G(alpha, beta) - G(dH, alpha) G(dH, beta)``. With
    ``normalized=True`` the factor det(C) is left out (Remark 2.1).

    Parameters
    ----------
    cometric : array, shape (n, n), or function from x, shape (n,), to one
        Positive definite. By default the identity, or on a manifold the metric of the space.
    preserve : sequence of functions or energies
        Kept constant besides the energy.
    normalized : bool
    rate : float, >= 0
        Factor on the whole.
    """

    cometric: jax.Array | Callable | None
    functions: tuple[Energy, ...]
    normalized: bool = eqx.field(static=True)
    rate: jax.Array

    def __init__(self, cometric=None, preserve=(), normalized=False, rate=1.0):
        self.cometric = cometric if cometric is None or callable(cometric) else semidefinite(cometric, "the cometric")
        functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
        self.functions = tuple(as_energy(L, "a preserved function") for L in functions)
        self.normalized = bool(normalized)
        self.rate = checked_rate(rate)

    @property
    def preserve(self):
        return self.functions

    def prepared(self, system):
        if system.space is not None:
            return self
        return eqx.tree_at(lambda d: d.functions, self, tuple(recognised(L, system.dim) for L in self.functions))

    def force(self, system, x, dH, dS, dL):
        G = form_at(self.cometric, x)

        def raised(alpha):
            return system.raised(x, alpha) if G is None else system.tangent(x, G @ alpha)

        if not dL and not self.normalized:
            GdH = raised(dH)
            return self.rate * (jnp.dot(GdH, dH) * raised(dS) - jnp.dot(GdH, dS) * GdH)
        frame: list[tuple[jax.Array, jax.Array]] = []  # G-orthonormal covectors and their images under G

        def off_frame(alpha):
            for _ in range(2):  # the second pass removes what rounding left of the first
                for e, Ge in frame:
                    alpha = alpha - jnp.dot(Ge, alpha) * e
            return alpha

        gram = jnp.ones(())
        for gradient in (dH, *dL):
            before = jnp.dot(raised(gradient), gradient)
            rest = off_frame(gradient)
            square = jnp.dot(raised(rest), rest)
            # a gradient that depends on the earlier ones adds nothing to project off
            independent = square > 1e-24 * before
            square = jnp.where(independent, square, 0.0)
            e = rest * jnp.where(independent, 1.0 / jnp.sqrt(jnp.where(independent, square, 1.0)), 0.0)
            frame.append((e, raised(e)))
            gram = gram * square
        projected = raised(off_frame(dS))
        for e, Ge in frame:  # P is G-symmetric: project the image as well, so that K stays symmetric to rounding
            projected = projected - jnp.dot(e, projected) * Ge
        return self.rate * (projected if self.normalized else gram * projected)
