"""Metriplectic Gauss: any even order, with both laws exact for every energy and every entropy [EQUATIONS §4]."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation import Dissipation
from ..energy import Energy, as_energy, check_scalar, on_points
from ..engine.interpret import at_points
from ..errors import InputError
from ..gradients import stage_gradients
from ..systems import ChartSystem, System
from .base import GaussMethod, OneStepMethod, checked_stages, collocation_error, register
from .charts import in_charts
from .tableaus import finer, gauss


class MetriplecticGauss(GaussMethod):
    """``k_i = Pi_d gH_i + K_d gS_i`` at the Gauss nodes ``u_i = x + h sum_j A_ij k_j``, ``x' = x + h sum_i b_i k_i``.

    The gradients carry one correction for all stages, ``gH_i = grad H(u_i) + alpha k_i``, such that
    ``h sum b_i gH_i . k_i = H(x') - H(x)``; likewise gS and those of ``preserve``. ``Pi_d = Q Pi(u_i) Q``, Q the
    projector off gS_i and the preserved gC_i; K_d is the dissipation rebuilt with gH_i and gC_i in its kernel. Hence

        H(x') = H(x),    S(x') - S(x) = h sum b_i gS_i . K_d gS_i >= 0,    C(x') = C(x),

    for every smooth H, S and C and every step. Order 2s: alpha is O(h^{2s}) [Hairer, Lubich & Wanner, II.1]. Quadratic
    Casimirs and linear invariants are kept by collocation itself. One implicit equation of s times the size of the
    state; an iteration costs s gradients of H and S; of each that is not quadratic two values and a gradient at the end
    of the step besides, and s + 1 gradients between the nodes where s is 1 or 2.

    On a manifold the scheme runs in the chart ``v -> R(x, v)`` around the state, a new one at each step: same order,
    same laws. See :class:`InCharts`.

    Parameters
    ----------
    stages : int
        1 to 8; the order is twice that. One stage is the midpoint scheme with the Gonzalez gradient, the entropy law
        made exact too.
    preserve : sequence of functions or energies
        Further functions to hold exactly. The system has to conserve them (checked when a run starts).
    retraction : str or manifolds.Retraction, optional
        On a manifold: ``"exp"`` by default, or as :func:`manifolds.retraction` names them.
    """

    functions: tuple[Energy, ...]
    retraction: str | mf.Retraction | None = eqx.field(static=True)

    def __init__(self, stages: int = 2, preserve: Sequence = (), retraction: str | mf.Retraction | None = None):
        self.number = checked_stages(stages)
        functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
        self.functions = tuple(as_energy(C, "a preserved function") for C in functions)
        self.retraction = retraction

    def on(self, system: System) -> OneStepMethod:
        method = self._with(lambda C: on_points(C, system.space))
        return in_charts(method, system, self.retraction, "exp")

    def pulled(self, local: ChartSystem) -> OneStepMethod:
        return self._with(local.pulled)

    def _with(self, change: Callable) -> MetriplecticGauss:
        """The method with its preserved functions changed."""
        if not self.functions:
            return self
        return eqx.tree_at(lambda m: m.functions, self, tuple(map(change, self.functions)))

    @property
    def preserves(self) -> frozenset[str]:
        return frozenset({"energy", "entropy_law", "quadratic_invariants", "linear_invariants"})

    def check(self, system: System) -> None:
        """Raise InputError unless the system conserves what is to be preserved, and room is left for it to move."""
        for C in self.functions:
            check_scalar(C, system.dim, "a preserved function")
        for C, kept in zip(self.functions, system.conserves(self.functions), strict=True):
            if not kept:
                raise InputError(
                    f"the system does not conserve the preserved function {_name(C)}: holding it would change the "
                    "dynamics. Give a dissipation that preserves it too, such as ProjectedMetric(preserve=...)"
                )
        held = [system.energy, *(() if system.entropy is None else (system.entropy,)), *self.functions]
        points = system.samples(8)
        ranks = np.linalg.matrix_rank(np.nan_to_num(at_points(_gradients, tuple(held), points)), tol=1e-9)
        if self.functions and ranks.max() >= system.dim:
            raise InputError(
                f"energy, entropy and {len(self.functions)} preserved functions are independent and leave no room to "
                f"move in {system.dim} dimensions"
            )

    def slopes(self, system: System, x, low, h, k) -> jax.Array:
        A, b, _ = gauss(self.number)

        def gradients(energy):
            return stage_gradients(energy, x, low, h, k, A, b, finer(self.number))

        u = x + (low + h * (A @ k))
        dH = gradients(system.energy)
        dS = jnp.zeros_like(k) if system.entropy is None else gradients(system.entropy)
        dL, dC = (tuple(map(gradients, functions)) for functions in (system.preserved, self.functions))
        return jax.vmap(lambda *stage: self._slope(system, *stage))(u, dH, dS, dL, dC)

    def _slope(self, system: System, u, dH, dS, dL, dC) -> jax.Array:
        """``Pi_d dH + K_d dS`` at one stage."""
        system = system.here(u)
        entropy = None if system.entropy is None or system.entropy.is_quadratic else system.entropy
        if entropy is None and not dC:  # Pi dS = 0 as it stands
            return system.field(u, dH, dS, dL)
        held = list(zip(dC, (C.gradient(u) for C in self.functions), strict=True))
        off = _projector(held if entropy is None else [(dS, entropy.gradient(u)), *held])
        motion = off(system.poisson.sharp(u, off(dH)))
        for part in () if system.dissipation is None else system.dissipation.terms:
            motion = motion + self._force(part, system, u, dH, dS, dL, held)
        return motion

    @staticmethod
    def _force(part: Dissipation, system: System, u, dH, dS, dL, held) -> jax.Array:
        own = tuple(dL[i] for C in part.preserve for i, L in enumerate(system.preserved) if L is C)
        if part.energy_law != "conserved":  # it lowers the energy and has to keep the entropy
            entropy = [] if system.entropy is None else [(dS, system.entropy.gradient(u))]
            off = _projector([*entropy, *held])
            return off(part.force(system, u, off(dH), dS, own))
        if not held:
            return part.force(system, u, dH, dS, own)
        off = _projector([(dH, system.energy.gradient(u)), *held])
        return off(part.force(system, u, dH, off(dS), own))

    def velocities(self, system: System, x, low, h, k) -> jax.Array:
        A, b, _ = gauss(self.number)
        return stage_gradients(system.energy, x, low, h, k, A, b, finer(self.number))

    def error(self, system: System, x, low, h, k) -> jax.Array:
        return collocation_error(system, x, low, h, k)

    def __str__(self) -> str:
        kept = f", preserve={len(self.functions)} functions" if self.functions else ""
        return f"MetriplecticGauss(stages={self.number}{kept})"


def _gradients(functions: tuple[Energy, ...], x):
    return jnp.stack([f.gradient(x) for f in functions])


def _name(function: Energy) -> str:
    return getattr(getattr(function, "function", None), "__name__", str(function))


def _projector(gradients):
    """The orthogonal projector off the span of discrete gradients, each given with the gradient at the stage itself.

    One that vanishes or depends on those before it is left out, and the gradients at the stage tell which: the discrete
    ones of C and exp(C) differ by a multiple of the slope, and to project off both would stop the motion.
    """

    def without(frame, v):
        for _ in range(2):  # the second pass removes what rounding left of the first
            for e in frame:
                v = v - jnp.dot(e, v) * e
        return v

    frame: list[jax.Array] = []
    plain_frame: list[jax.Array] = []
    for gradient, plain in gradients:
        rest, plain_rest = without(frame, gradient), without(plain_frame, plain)
        square, plain_square = jnp.dot(rest, rest), jnp.dot(plain_rest, plain_rest)
        independent = (plain_square > 1e-24 * jnp.dot(plain, plain)) & (plain_square > 0.0) & (square > 0.0)
        frame.append(_unit(rest, square, independent))
        plain_frame.append(_unit(plain_rest, plain_square, independent))
    return lambda v: without(frame, v)


def _unit(v, square, usable):
    """``v / |v|``, or 0 where that cannot be used."""
    return v * jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, square, 1.0)), 0.0)


register(MetriplecticGauss(1), MetriplecticGauss(2), MetriplecticGauss(3))
