"""Euler-Poincaré systems: a Lagrangian on the Lie algebra, without and with entropy [BFM 3.1-3.4; after GBY §2]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.matrices.linear import solve
from manifolds.structures.poisson import PoissonBySharp

from ..dissipation.base import Dissipation, dissipation_terms
from ..dissipation.friction import EulerPoincareForce
from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.conditions import require_condition
from ..functions.energy import Energy, Function, Quadratic, TimeDependent, make_energy
from ..functions.newton import inverse_gradient
from ..tracing.interpret import evaluate_at_points
from ..tracing.traced import trace_callables
from .body_states import checked_velocity, is_state_given_by_velocity
from .interface import BodyKinematics, EngineHints
from .ledger import LedgerSystem
from .lie_poisson import LiePoissonSystem, body_velocity_slices
from .states import evaluate_batch

_SINGULAR_MESSAGE = (
    "the Lagrangian is singular: its Hessian has no inverse, so the momentum mu does not determine the velocity xi"
)


class Legendre(Energy):
    """The Hamiltonian of a Lagrangian l(xi), ``H(mu) = <mu, xi> - l(xi)`` at the xi with ``dl/dxi = mu``.

    Its gradient is xi(mu). The equation is solved by damped Newton, and differentiated as an implicit function.

    Attributes
    ----------
    lagrangian : Energy
    """

    lagrangian: Energy

    def velocity(self, mu) -> jax.Array:
        """Return the velocity xi, shape (n,), at which ``dl/dxi`` is mu; NaN if Newton's method does not converge."""
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
    """A system of forced Euler-Poincaré equations [BFM 3.2, 3.4] in the momentum ``mu = dl/dxi``.

    The equations are ``d/dt dl/dxi = ad*_xi (dl/dxi + F(xi))``. The state is mu; ``system.velocity(mu)`` gives
    xi, and ``system.momentum(xi)`` gives mu. A quadratic Lagrangian given as ``lt.Quadratic`` is transformed in closed
    form.

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
        The Lie algebra g of the velocities.
    lagrangian : function from xi, shape (dim,), to a scalar, or an Energy
        Its Hessian must be invertible (regular Lagrangian). It may depend on time, as a second argument.
    entropy, dissipation, momentum_maps, validate, group, reconstruction, torque
        As for :class:`LiePoissonSystem`; functions of mu.
    force : function from xi to a covector, optional
        The force F of (3.2), which conserves the energy for any function. For a force that raises an entropy use
        ``dissipation``.
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
    def engine_hints(self) -> EngineHints:
        return super().engine_hints._replace(can_unroll=isinstance(self.energy, Quadratic))  # the others iterate

    def at_time(self, t, attitude=None) -> EulerPoincareSystem:
        system = super().at_time(t, attitude)
        if not self.lagrangian.depends_on_time:
            return system
        lagrangian = self.lagrangian.at_time(t)
        return eqx.tree_at(lambda s: (s.lagrangian, s.energy), system, (lagrangian, Legendre(lagrangian)))

    def velocity(self, mu, t=None) -> jax.Array:
        """Return the velocity ``xi = dH/dmu`` of states, shape (..., dim), at the time t if the Lagrangian needs it."""
        return evaluate_batch(self.drop_torque(), _velocity_at, mu, t, "(n)")

    def momentum_of_velocity(self, xi, t=None):
        return self.momentum(xi, t)

    def momentum(self, xi, t=None) -> jax.Array:
        """Return the momentum ``mu = dl/dxi`` of velocities, shape (..., dim), at the time t if it is needed."""
        return evaluate_batch(self.drop_torque(), _momentum_at, xi, t, "(n)")


def _velocity_at(system: EulerPoincareSystem, mu) -> jax.Array:
    """Return the velocity ``dH/dmu`` at one momentum, shape (n,)."""
    return system.energy.gradient(mu)


def _momentum_at(system: EulerPoincareSystem, xi) -> jax.Array:
    """Return the momentum ``dl/dxi`` at one velocity, shape (n,)."""
    return system.lagrangian.gradient(xi)


class _TimedLegendre(Module):
    """The Hamiltonian of a Lagrangian ``l(xi, t)`` as a function of mu and t."""

    lagrangian: Energy

    def __call__(self, mu, t):
        return Legendre(self.lagrangian.at_time(t)).value(mu)


def _legendre_hamiltonian(lagrangian: Energy, dim: int) -> Energy:
    """Return the Hamiltonian of a Lagrangian on an algebra, in closed form if the Lagrangian is quadratic."""
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
    """Raise InputError if the Hessian of the Lagrangian is singular at four random velocities."""
    points = np.random.default_rng(0).standard_normal((4, dim))
    require_regular(_lagrangian_hessian, lagrangian, points, _SINGULAR_MESSAGE)


def _lagrangian_hessian(lagrangian: Energy, xi) -> jax.Array:
    """Return the Hessian of a Lagrangian at a velocity, shape (n, n)."""
    return jax.hessian(lagrangian.value)(xi)


def require_regular(hessian: Callable, model, points: np.ndarray, message: str) -> None:
    """Raise InputError if the matrices ``hessian(model, point)`` at all points are finite and singular.

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


class EulerPoincareClosedSystem(LedgerSystem):
    """A body that turns or moves by the elements of a group, and that its own friction heats [GBY §2.2].

    It obeys ``d/dt l_xi = ad*_xi l_xi + f + F`` and ``T S' = P_H - f·xi`` with ``T = -l_S > 0``, the equations (2.4) of
    a Lagrangian ``L(g, g', S) = l(g^-1 g', S)`` on TG x R: the variations of GBY §2.2 with ``delta xi = eta' + [xi,
    eta]`` and the constraint ``l_S delta S = f . eta``. The energy ``xi . l_xi - l`` is constant and the entropy does
    not fall, as long as ``f . xi <= 0``, which :meth:`check` tests. The spatial momentum ``Ad*_{g^-1} l_xi`` is
    constant in the directions that commute with all others in which f acts: friction between the parts of a body does
    not touch its angular momentum. So the Casimirs of the algebra are constants, as functions of the body's momentum
    ``l_xi``, unless f changes them: these are :meth:`casimirs`.

    The state is (xi, S), shape (dim + 1,). With an external force F or a heat power it has three more components, the
    work W' = F . xi and the heat Q' = P_H received so far, and the time: see :class:`liethermo.SimpleClosedSystem`.

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
        The Lie algebra g of the velocities.
    lagrangian : function of (xi, S), xi of shape (dim,), to a scalar
        l, regular: ``l_xi xi`` has an inverse.
    friction : function of (xi, S), or of (xi, S, t), to a covector, shape (dim,); or a coefficient; optional
        f, with ``f . xi <= 0``. A coefficient R means ``f = -R xi``, as of :class:`liethermo.SimpleClosedSystem`: a
        number, an array of shape (dim,) for a diagonal matrix, or (dim, dim), whose symmetric part is positive
        semidefinite.
    external, heat_power : functions of the same arguments, or an array, shape (dim,), and a number; optional
        F, in the frame of the body, and P_H, the heat received per time (power).
    momentum_maps, validate
        As for :class:`System`; functions of (xi, S).

    Raises
    ------
    AxiomError, FunctionError, InputError

    Attributes
    ----------
    algebra : manifolds.LieAlgebra
    """

    algebra: mf.LieAlgebra
    lagrangian: Callable
    momentum_casimirs: dict[str, Energy]

    first_velocity_index: ClassVar[int] = 0

    def __init__(
        self,
        algebra: mf.LieAlgebra,
        lagrangian,
        friction=None,
        momentum_maps=(),
        validate: bool = True,
        external=None,
        heat_power=None,
    ):
        if not isinstance(algebra, mf.LieAlgebra):
            raise InputError(
                f"the algebra must be a manifolds.LieAlgebra, such as mf.so(3), got {type(algebra).__name__}"
            )
        n = algebra.dim
        checked_energy(make_energy(lambda x: lagrangian(x[:n], x[n]), "the Lagrangian"), n + 1, "the Lagrangian")
        lagrangian = trace_callables(lagrangian, lambda lagrangian, *a: lagrangian(*a), (n,), ())
        self.algebra, self.lagrangian = algebra, lagrangian
        forces = self._set_forces(friction, external, heat_power, ((n,), ()), "(xi, S)")
        casimirs = {
            name: with_polynomial_degrees(Function(MomentumFunction(make_energy(C, "a Casimir"), lagrangian)), n + 1)
            for name, C in algebra.leading_casimirs()
        }
        self.momentum_casimirs = {name: C.on(range(n + 1)) if self.has_ledger else C for name, C in casimirs.items()}
        structure = VelocityLiePoisson(algebra, lagrangian)
        message = "the Lagrangian is singular: its Hessian in xi has no inverse"
        require_regular(_hessian, structure, np.random.default_rng(0).standard_normal((4, n + 1)), message)
        energy = with_polynomial_degrees(ReducedEnergy(lagrangian), n + 1)
        self._build_with_ledger(structure, n + 1, energy, forces, momentum_maps, validate)

    def state(
        self,
        x=None,
        batch: bool = False,
        *,
        angular_velocity=None,
        rotor_rates=None,
        temperature=None,
        degrees: bool = False,
    ) -> jax.Array:
        """Return ``x`` as a checked state, or the state with a given angular velocity and temperature.

        Parameters
        ----------
        x : array, shape (n,), or (..., n) with ``batch``; optional
            See :meth:`System.state`.
        batch : bool
            Whether leading axes are several states.
        angular_velocity : array, shape (3,), or (..., 3) with ``batch``; optional
            Omega in body axes (rad / time), instead of x.
        rotor_rates : array, shape (k,), or (..., k) with ``batch``; optional
            The other velocities, such as those of wheels relative to the body (rad / time); zero by default.
        temperature : float, optional
            Temperature ``-l_S``, from which Newton's method finds S; by default ``S = 0``.
        degrees : bool
            If true, the angular velocity and the other velocities are in degrees / time.

        Raises
        ------
        InputError
            If neither or both of x and the angular velocity are given, or no state has these values.
        """
        details = {"rotor_rates": rotor_rates, "temperature": temperature, "degrees": degrees or None}
        if not is_state_given_by_velocity(self, x, angular_velocity, "velocity xi", **details):
            return super().state(x, batch)
        xi = checked_velocity(angular_velocity, rotor_rates, self.algebra.dim, batch, degrees)
        if temperature is None:
            S = jnp.zeros((*xi.shape[:-1], 1))
        else:
            S = jnp.vectorize(self._entropy_at_temperature, signature="(n),()->(m)")(xi, jnp.asarray(temperature))
            require_condition(
                S,
                lambda v: abs(v) < jnp.inf,
                "no entropy belongs to this temperature: Newton's method ended at {value}",
            )
        return super().state(jnp.concatenate([xi, S], axis=-1), batch)

    def _entropy_at_temperature(self, xi, temperature) -> jax.Array:
        """Return the entropy S, shape (1,), at which the temperature ``-l_S`` has a given value."""
        energy = Function(lambda y: -self.lagrangian(xi, y[0]))
        return inverse_gradient(energy, jnp.reshape(temperature, 1))

    def momentum(self, xi, S) -> jax.Array:
        """Return the momentum ``l_xi`` of the body at one velocity xi and entropy S, shape (dim,)."""
        return jax.grad(self.lagrangian)(xi, S)

    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        structure = cast(VelocityLiePoisson, self.poisson_without_ledger)
        return structure.momentum_and_derivatives(x[: self.dim_without_ledger])[1:]

    @property
    def body_kinematics(self) -> BodyKinematics:
        parts = body_velocity_slices(self.algebra)
        return BodyKinematics({name: lambda x, part=part: x[part] for name, part in parts.items()})

    def temperature_at(self, y) -> jax.Array:
        return -jax.grad(self.lagrangian, argnums=1)(y[:-1], y[-1])

    def momenta(self, x) -> jax.Array:
        """Return the momenta ``l_xi`` of the body, shape (..., dim), at states, shape (..., n)."""
        momentum = jnp.vectorize(lambda y: self.momentum(y[:-1], y[-1]), signature="(n)->(m)")
        return momentum(self.states_without_ledger(x))

    def casimirs(self) -> dict[str, Energy]:
        return self.momentum_casimirs


class MomentumFunction(Module):
    """A function of the state (xi, S), computed from a function of the momentum ``l_xi``."""

    energy: Energy
    lagrangian: Callable

    def __call__(self, x):
        return self.energy.value(jax.grad(self.lagrangian)(x[:-1], x[-1]))


class ReducedEnergy(Energy):
    """The energy of a body as a function of the state (xi, S): ``xi . l_xi - l``."""

    lagrangian: Callable

    def value(self, x) -> jax.Array:
        value, momentum = jax.value_and_grad(self.lagrangian)(x[:-1], x[-1])
        return jnp.dot(x[:-1], momentum) - value


class VelocityLiePoisson(PoissonBySharp):
    """The Lie-Poisson structure on g* x R in coordinates (xi, S) with ``mu = l_xi``; S is a Casimir function."""

    algebra: mf.LieAlgebra
    lagrangian: Callable

    @property
    def dim(self) -> int:
        return self.algebra.dim + 1

    def momentum_and_derivatives(self, x) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the momentum ``l_xi`` and its derivatives by xi and S, shapes (n,), (n, n) and (n,)."""
        momentum = jax.grad(self.lagrangian)
        xi_derivative, S_derivative = jax.jacfwd(momentum, argnums=(0, 1))(x[:-1], x[-1])
        return momentum(x[:-1], x[-1]), xi_derivative, S_derivative

    def sharp(self, x, alpha) -> jax.Array:
        mu, W, _ = self.momentum_and_derivatives(x)
        xi = solve(W, alpha[:-1, None])[:, 0]
        return jnp.append(solve(W, self.algebra.ad_star(xi, mu)[:, None])[:, 0], 0.0)


def _hessian(structure: VelocityLiePoisson, x):
    """Return the Hessian of the Lagrangian in the velocity at a state, shape (n, n)."""
    return structure.momentum_and_derivatives(x)[1]
