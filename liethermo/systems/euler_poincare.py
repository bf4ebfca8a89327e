"""Euler-Poincaré systems: a Lagrangian on the Lie algebra, the Legendre transform inside [BFM 3.1-3.4]."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..dissipation.base import Dissipation, dissipation_terms
from ..dissipation.force import EulerPoincareForce
from ..errors import InputError
from ..functions.checks import checked_energy
from ..functions.energy import Energy, Quadratic, TimeDependent, make_energy
from ..functions.newton import inverse_gradient
from ..tracing.interpret import evaluate_at_points
from .interface import EngineHints
from .lie_poisson import LiePoissonSystem
from .states import evaluate_batch

_SINGULAR_MESSAGE = (
    "the Lagrangian is singular: its Hessian has no inverse, so the momentum mu does not determine the velocity xi"
)


class Legendre(Energy):
    """The Hamiltonian ``H(mu) = <mu, xi> - l(xi)`` at the xi with ``dl/dxi = mu``.

    Its gradient is xi(mu). The equation is solved by damped Newton, and differentiated as an implicit function.

    Attributes
    ----------
    lagrangian : Energy
    """

    lagrangian: Energy

    def velocity(self, mu) -> jax.Array:
        """Return the velocity xi with ``dl/dxi = mu``, shape (n,); NaN where Newton's method finds none."""
        return inverse_gradient(self.lagrangian, jnp.asarray(mu))

    def momentum(self, xi) -> jax.Array:
        """Return the momentum ``dl/dxi``, shape (n,)."""
        return self.lagrangian.gradient(jnp.asarray(xi))

    def value(self, x) -> jax.Array:
        xi = self.velocity(x)
        return jnp.dot(x, xi) - self.lagrangian.value(xi)

    def gradient(self, x) -> jax.Array:
        return self.velocity(x)


class EulerPoincareSystem(LiePoissonSystem):
    """Forced Euler-Poincaré equations ``d/dt dl/dxi = ad*_xi (dl/dxi + F(xi))`` [BFM 3.2, 3.4], in mu = dl/dxi.

    The state is mu; ``system.velocity(mu)`` gives xi and ``system.momentum(xi)`` the way back. A quadratic Lagrangian
    given as ``lt.Quadratic`` is transformed in closed form.

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
    lagrangian : function from xi, shape (dim,), to a scalar, or an Energy
        Its Hessian must be invertible (regular Lagrangian). It may depend on time, as a second argument.
    entropy, dissipation, momentum_maps, validate, group, reconstruction, torque
        As for :class:`LiePoissonSystem`; functions of mu.
    force : function from xi to a covector, optional
        F of (3.2): conserves the energy whatever it is. For a force that raises an entropy use ``dissipation``.
    """

    lagrangian: Energy

    def __init__(
        self,
        algebra: mf.LieAlgebra,
        lagrangian,
        entropy=None,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        force: Callable | None = None,
        momentum_maps=(),
        validate: bool = True,
        group: mf.MatrixGroup | None = None,
        reconstruction: str | None = None,
        torque=None,
    ):
        energy = make_energy(lagrangian, "the Lagrangian")
        self.lagrangian = checked_energy(energy, algebra.dim, "the Lagrangian", allow_time=True)
        if force is not None:
            dissipation = [*dissipation_terms(dissipation), EulerPoincareForce(force)]
        energy = _legendre_hamiltonian(self.lagrangian, algebra.dim)
        super().__init__(
            algebra, energy, entropy, dissipation, momentum_maps, validate, group, reconstruction, torque=torque
        )

    @property
    def hints(self) -> EngineHints:
        return super().hints._replace(can_unroll=isinstance(self.energy, Quadratic))  # the others iterate

    def at_time(self, t, attitude=None) -> EulerPoincareSystem:
        system = super().at_time(t, attitude)
        if not self.lagrangian.depends_on_time:
            return system
        lagrangian = self.lagrangian.at_time(t)
        return eqx.tree_at(lambda s: (s.lagrangian, s.energy), system, (lagrangian, Legendre(lagrangian)))

    def velocity(self, mu, t=None) -> jax.Array:
        """Return the velocity ``xi = dH/dmu`` of states, shape (..., dim), at the time t if the Lagrangian needs it."""
        return evaluate_batch(self.drop_torque(), lambda system, mu: system.energy.gradient(mu), mu, t, "(n)")

    def momentum_of_velocity(self, xi, t=None):
        return self.momentum(xi, t)

    def momentum(self, xi, t=None) -> jax.Array:
        """Return the momentum ``mu = dl/dxi`` of velocities, shape (..., dim), at the time t if it is needed."""
        return evaluate_batch(self.drop_torque(), lambda system, xi: system.lagrangian.gradient(xi), xi, t, "(n)")


class _TimedLegendre(Module):
    """The Hamiltonian of a Lagrangian ``l(xi, t)``, a function of mu and t."""

    lagrangian: Energy

    def __call__(self, mu, t):
        return Legendre(self.lagrangian.at_time(t)).value(mu)


def _legendre_hamiltonian(lagrangian: Energy, dim: int) -> Energy:
    if lagrangian.depends_on_time:
        _require_regular(lagrangian.at_time(0.0), dim)
        return TimeDependent(_TimedLegendre(lagrangian))
    if not isinstance(lagrangian, Quadratic):
        _require_regular(lagrangian, dim)
        return Legendre(lagrangian)
    A, b = lagrangian.A, lagrangian.b
    b = jnp.zeros(dim) if b is None else b
    if not isinstance(A, jax.core.Tracer):
        singular = np.abs(A) if A.ndim == 1 else np.linalg.svd(np.asarray(A), compute_uv=False)
        if not singular.min() > 1e-14 * singular.max():
            raise InputError(_SINGULAR_MESSAGE)
    inverse = 1.0 / A if A.ndim == 1 else jnp.linalg.inv(A)
    if inverse.ndim == 2:
        inverse = 0.5 * (inverse + inverse.T)
    shift = -inverse * b if inverse.ndim == 1 else -inverse @ b
    return Quadratic(inverse, None if lagrangian.b is None else shift, -0.5 * jnp.dot(b, shift) - lagrangian.c)


def _require_regular(lagrangian: Energy, dim: int) -> None:
    points = np.random.default_rng(0).standard_normal((4, dim))
    require_regular(_lagrangian_hessian, lagrangian, points, _SINGULAR_MESSAGE)


def _lagrangian_hessian(lagrangian: Energy, xi) -> jax.Array:
    return jax.hessian(lagrangian.value)(xi)


def require_regular(hessian: Callable, model, points: np.ndarray, message: str) -> None:
    """Raise InputError if the matrices ``hessian(model, point)`` are all finite and all singular.

    Nothing is tested while JAX traces the model.
    """
    if is_traced(model):
        return
    matrices = evaluate_at_points(hessian, model, points)
    if not np.isfinite(matrices).all():
        return
    singular = np.linalg.svd(matrices, compute_uv=False)
    if (singular[:, -1] <= 1e-14 * singular[:, 0]).all():
        raise InputError(message)
