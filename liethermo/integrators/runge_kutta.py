"""Explicit methods with both laws exact: Runge-Kutta steps, brought back onto the levels that they have to end on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.base import portions
from ..errors import InputError
from ..functions.energy import Energy
from ..functions.frames import towards
from ..functions.gradients import EPS, Gonzalez
from ..systems import ChartSystem, System
from .base import OneStepMethod, register
from .charts import InCharts, in_charts
from .lobatto import ORDERS, ExplicitTableau, lobatto
from .preserved import check_preserved, preserved_functions, seen_on

SLOPE, ERROR, FIRST, LAST, MISSED, LEVELS = range(6)
"""What stands in the vectors that a step hands on: its mean slope, the estimate of its local error, the slopes at its
ends; in each component, what is missed of the levels after the corrections; and the levels that the run has begun on.
Error and what is missed are over h."""

NOTICED, STEERED = 4.0 * EPS, 0.25 * EPS
"""What a function that is conserved has to be off the level of the start, relative to its size, for steps to take it
back, and the most that one takes back: far below what its rounding is."""


class MetriplecticRungeKutta(OneStepMethod):
    """Explicit Runge-Kutta steps with both laws exact, of order 4, 6 or 8.

    ``X_i = x + h sum_{j<i} A_ij f(X_j)``, ``y = x + h sum_i b_i f(X_i)``, and x' the point near y where

        H(x') = H(x),    C(x') = C(x),    S(x') = S(x) + h sum_i b_i sigma(X_i),    sigma = grad S . K grad S >= 0,

    for every C that the system is known to conserve [EQUATIONS §4, "Explicit methods"]. The weights b of Lobatto's
    quadrature are nonnegative, so that the entropy never falls; the quadrature is of the order p of the method, 4, 6 or
    8, so that x' - y is O(h^{p+1}).

    The point x' is found by Newton's method along the gradients of H and the C, and that of S as far as it is
    independent of these. What a function changes by is taken from a discrete gradient along the step, whose rounding
    vanishes with the step. So a state that relaxes is not held off its equilibrium by rounding.

    Vectors of constant length, such as many spins, are held one by one, in work and memory that grow with their number:
    each is brought back to its sphere along its radius, and the corrections above are made along the spheres.

    Of a system whose energy falls and whose entropy is conserved, as with double bracket dissipation, the energy falls
    by its own quadrature.

    A step costs 4, 7 or 11 evaluations of the field; and with four corrections, five values of what each function
    changes by. There is nothing to iterate, so it is many times as fast as an implicit step; but stiff systems ask for
    short steps. A step that is too long for its corrections fails with a status.

    On a manifold the scheme runs in the chart ``v -> R(x, v)`` around the state, a new one at each step: same order,
    same laws. See :class:`InCharts`.

    Parameters
    ----------
    order : int
        4, 6 or 8.
    preserve : sequence of functions or energies
        Further first integrals to hold exactly. The system has to conserve them (checked when a run starts).
    retraction : str or manifolds.Retraction, optional
        On a manifold, with its base point where the step starts: ``"exp"`` by default.
    held : tuple of str
        Names of the functions of the system to hold. A run fills it in with what the system conserves.
    """

    corrections: ClassVar[int] = 4
    """Newton corrections of a step: a relative error of a twentieth is one of rounding after them."""

    number: int = eqx.field(static=True)
    functions: tuple[Energy, ...]
    retraction: str | mf.Retraction | None = eqx.field(static=True)
    held: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        order: int = 4,
        preserve: Sequence = (),
        retraction: str | mf.Retraction | None = None,
        held: tuple[str, ...] = (),
    ):
        if type(order) is not int or order not in ORDERS:
            raise InputError(f"the order is 4, 6 or 8, not {order!r}")
        self.number, self.functions = order, preserved_functions(preserve)
        self.retraction, self.held = retraction, held

    @property
    def order(self) -> int:
        return self.number

    @property
    def stages(self) -> int:
        return LEVELS + 1

    @property
    def explicit(self) -> bool:
        return True

    @property
    def evaluations(self) -> int:
        return len(self.tableau.b)

    @property
    def preserves(self) -> frozenset[str]:
        return frozenset({"energy", "entropy_law", "casimirs"})

    @property
    def tableau(self) -> ExplicitTableau:
        return lobatto(self.number)

    def keeps(self, system: System, name: str) -> bool:
        return name in system.first_integrals()

    def on(self, system: System) -> OneStepMethod:
        seen = self._with(lambda C: seen_on(system, C), tuple(sorted(system.first_integrals())))
        method = in_charts(seen, system, self.retraction, "exp")
        if isinstance(method, InCharts) and not isinstance(method.retraction, mf.Chart):
            raise InputError(
                f"{self} needs a retraction with its base point where the step starts, not {method.retraction}"
            )
        return method

    def pulled(self, local: ChartSystem) -> OneStepMethod:
        return self._with(local.pulled, self.held)

    def _with(self, change: Callable, held: tuple[str, ...]) -> MetriplecticRungeKutta:
        """The method with its preserved functions changed, holding these of the system."""
        return type(self)(self.number, tuple(map(change, self.functions)), self.retraction, held)

    def check(self, system: System) -> None:
        """Raise InputError unless the system has a law to hold and conserves what is to be preserved."""
        if not self._laws(system):
            raise InputError(f"{self} holds the laws of a system, and this one claims none: take lt.Reference")
        check_preserved(system, self.functions)

    def start(self, system: System, x) -> jax.Array:
        levels = jnp.stack([law.function.value(x) for law in self._laws(system)])[: x.shape[0]]
        levels = jnp.concatenate([levels, jnp.zeros(x.shape[0] - levels.shape[0])])
        return jnp.zeros((self.stages, x.shape[0])).at[SLOPE].set(system.vector_field(x)).at[LEVELS].set(levels)

    # -- the step -----------------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, low, h, k) -> jax.Array:
        """The vectors that the step hands on; of those before it the levels alone are needed."""
        laws, t = self._laws(system), self.tableau
        s = len(t.b)

        def stage(slopes, row):
            i, weights = row
            found, rates = self._rates(system, laws, x + (low + h * (weights @ slopes)))
            return jax.lax.dynamic_update_index_in_dim(slopes, found, i, 0), rates

        slopes, rates = jax.lax.scan(stage, jnp.zeros((s, x.shape[0])), (np.arange(s), t.A))
        changes = h * (t.b @ rates)
        if not isinstance(
            system, ChartSystem
        ):  # whose coordinates, and with them the levels' row, are new at every step
            changes = changes + self._steering(laws, x, low, k[LEVELS])
        d, missed = self._corrected(system, laws, x, low, h * (t.b @ slopes), changes)
        return jnp.stack([d / h, t.d @ slopes, slopes[0], slopes[-1], jnp.broadcast_to(missed / h, x.shape), k[LEVELS]])

    def _steering(self, laws: list[_Law], x, low, levels) -> jax.Array:
        """What functions that are conserved are to change by, back to the levels that the run has begun on.

        Each step is exact but for a few roundings, whose sum would walk at random. The engines do so with the energy.
        """

        def back(law: _Law, level) -> jax.Array:
            gradient = law.function.gradient(x)
            size = jnp.maximum(jnp.abs(level), law.function.sensitivity(x))
            off = (level - law.function.value(x)) - jnp.dot(gradient, low)
            return jnp.where(jnp.abs(off) > NOTICED * size, jnp.clip(off, -STEERED * size, STEERED * size), 0.0)

        found = [
            back(law, levels[i]) if law.sign == 0.0 and i < x.shape[0] else jnp.zeros(()) for i, law in enumerate(laws)
        ]
        return jax.lax.stop_gradient(jnp.stack(found))

    def _rates(self, system: System, laws: list[_Law], x) -> tuple[jax.Array, jax.Array]:
        """The field at a stage, and at what rates the functions of the laws change, of the sign that the law wants."""
        system = system.here(x)
        dH = system.energy.gradient(x)
        dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
        dL = tuple(L.gradient(x) for L in system.preserved)
        if system.dissipation is None:
            return system.field(x, dH, dS, dL), jnp.zeros(len(laws))
        names, force = tuple(system.preserved_by_name()), jnp.zeros_like(x)
        gradients = dict(zip(names, dL, strict=True))
        for part, own in portions(system.dissipation, names):
            force = force + part.force(system, x, dH, dS, tuple(gradients[name] for name in own))
        # apart from the motion, along which H and S do not change: near rest that is rounding noise
        rates = [law.sign * jnp.maximum(law.sign * jnp.dot(law.function.gradient(x), force), 0.0) for law in laws]
        return system.field(x, dH, dS, dL), jnp.stack(rates)

    def _corrected(self, system: System, laws: list[_Law], x, low, d, changes) -> tuple[jax.Array, jax.Array]:
        """The displacement nearest to d that changes the functions as it has to, and what it misses, as a length."""
        change = Gonzalez()

        def misses(d) -> jax.Array:
            return changes - jnp.stack([jnp.dot(change(law.function, x, d, low), d) for law in laws])

        spheres = system.spheres

        def directions(d):
            end = x + (low + d)
            found = [system.raised(end, law.function.gradient(end)) for law in laws]
            return found if spheres is None else [spheres.along(end, v) for v in found]

        def landed(d):
            return d if spheres is None else spheres.reached(x, low, d)

        d = landed(d)
        found = directions(d)
        for i in range(self.corrections):
            found = directions(d) if 0 < i < 3 else found  # the last time they are as good as they get
            d = landed(d + towards(found, misses(d)))
        squares = jnp.stack([jnp.dot(v, v) for v in found])
        left = misses(d) / jnp.sqrt(jnp.where(squares == 0.0, 1.0, squares))
        return d, jnp.max(jnp.abs(jnp.where(squares == 0.0, 0.0, left)))

    def _laws(self, system: System) -> list[_Law]:
        """The functions that a step ends on levels of; the one that changes last, where the others leave it room."""
        functions = system.functions()
        laws = [_Law(system.energy, LAWS[system.energy_law])] if system.energy_law in LAWS else []
        local = set() if system.spheres is None else {system.spheres.name}
        laws += [_Law(functions[name], 0.0) for name in self.held if name not in local]
        laws += [_Law(C, 0.0) for C in self.functions]
        if system.entropy_law in LAWS:
            assert system.entropy is not None
            laws.append(_Law(system.entropy, LAWS[system.entropy_law]))
        return sorted(laws, key=lambda law: law.sign != 0.0)

    def missed(self, system: System, x, low, h, k) -> jax.Array:
        del system, x, low, h
        return jnp.max(jnp.abs(k[MISSED]))

    def increment(self, h, k) -> jax.Array:
        return h * k[SLOPE]

    def weights(self, theta) -> np.ndarray:
        """Of the cubic through both ends with the slopes there, which is O(h^4) between."""
        theta = np.asarray(theta, dtype=np.float64)
        found = np.zeros((*theta.shape, self.stages))
        found[..., SLOPE] = theta**2 * (3.0 - 2.0 * theta)
        found[..., FIRST] = theta * (1.0 - theta) ** 2
        found[..., LAST] = theta**2 * (theta - 1.0)
        return found

    def predict(self, k, before) -> jax.Array:
        del before
        return k

    def error(self, system: System, x, low, h, k) -> jax.Array:
        """From weights that lower orders leave undetermined: see :class:`.lobatto.ExplicitTableau`."""
        del system, x, low
        t = self.tableau
        found, length = h * jnp.max(jnp.abs(k[ERROR])), h * jnp.max(jnp.abs(k[SLOPE]))
        share = found / jnp.where(length > 0.0, length, 1.0)
        return t.scale * found * share ** ((self.number - t.q) / (t.q + 1))

    def explain(self, system: System, x, k, h) -> str:
        del k
        if not bool(jnp.isfinite(system.vector_field(jnp.asarray(x))).all()):
            return ""
        return (
            f"the stages of a step of {h:g} run away, or leave the domain of the functions: it is too long for an "
            "explicit method; lt.MetriplecticGauss takes longer ones of a stiff system"
        )

    def __str__(self) -> str:
        kept = f", preserve={len(self.functions)} functions" if self.functions else ""
        return f"MetriplecticRungeKutta(order={self.number}{kept})"


class _Law(NamedTuple):
    """A function, and whether it is to fall, to stay or to rise: -1, 0 or 1."""

    function: Energy
    sign: float


LAWS = {"conserved": 0.0, "nondecreasing": 1.0, "nonincreasing": -1.0}


register(*map(MetriplecticRungeKutta, ORDERS))
