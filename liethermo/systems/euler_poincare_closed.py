"""Euler-Poincaré equations with entropy: simple closed systems on a Lie group, reduced [after GBY §2, BFM §3]."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.matrices.linear import solve
from manifolds.structures.poisson import PoissonBySharp

from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.conditions import require_condition
from ..functions.energy import Energy, Function, make_energy
from ..functions.newton import inverse_gradient
from ..tracing.traced import trace_callables
from .body_states import checked_velocity, is_given_by_velocity
from .euler_poincare import require_regular
from .interface import MotionQuantities
from .ledger import LedgerSystem
from .lie_poisson import body_velocity_slices


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
    lagrangian : function of (xi, S), xi of shape (dim,), to a scalar
        l, regular: ``l_xi xi`` has an inverse.
    friction : function of (xi, S), or of (xi, S, t), to a covector, shape (dim,); or a coefficient; optional
        f, with ``f . xi <= 0``. A coefficient R means ``f = -R xi``, as of :class:`liethermo.SimpleClosedSystem`: a
        number, an array of shape (dim,) for a diagonal matrix, or (dim, dim), whose symmetric part is positive
        semidefinite.
    external : function of the same arguments, or an array of shape (dim,); optional
        F, in the frame of the body.
    heat_power : function likewise to a scalar, or a number; optional
        P_H, the heat received per time (power).
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
                f"the algebra must be a manifolds.LieAlgebra, such as mf.so(3), not {type(algebra).__name__}"
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
        self._assemble(structure, n + 1, energy, forces, momentum_maps, validate)

    def state(
        self, x=None, batch: bool = False, *, angular_velocity=None, rotor_rates=None, temperature=None
    ) -> jax.Array:
        """Return a state of this system: ``x``, checked, or the state with a given angular velocity and temperature.

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

        Raises
        ------
        InputError
            If neither or both of x and the angular velocity are given, or no state has these values.
        """
        details = {"rotor_rates": rotor_rates, "temperature": temperature}
        if not is_given_by_velocity(self, x, angular_velocity, "velocity xi", **details):
            return super().state(x, batch)
        xi = checked_velocity(angular_velocity, rotor_rates, self.algebra.dim, batch)
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
        """Return the entropy, shape (1,), at which ``-l_S`` is a temperature."""
        energy = Function(lambda y: -self.lagrangian(xi, y[0]))
        return inverse_gradient(energy, jnp.reshape(temperature, 1))

    def momentum(self, xi, S) -> jax.Array:
        """Return the momentum ``l_xi`` at one point, shape (dim,)."""
        return jax.grad(self.lagrangian)(xi, S)

    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        return cast(VelocityLiePoisson, self.structure).momentum_derivatives(x[: self.dim_without_ledger])[1:]

    @property
    def motion_quantities(self) -> MotionQuantities:
        parts = body_velocity_slices(self.algebra)
        return MotionQuantities({name: lambda x, part=part: x[part] for name, part in parts.items()})

    def temperature_at(self, y) -> jax.Array:
        return -jax.grad(self.lagrangian, argnums=1)(y[:-1], y[-1])

    def momenta(self, x) -> jax.Array:
        """Return the momenta ``l_xi``, shape (..., dim), at states, shape (..., n)."""
        momentum = jnp.vectorize(lambda y: self.momentum(y[:-1], y[-1]), signature="(n)->(m)")
        return momentum(self.drop_ledger(x))

    def casimirs(self) -> dict[str, Energy]:
        return self.momentum_casimirs


class MomentumFunction(Module):
    """A function of the state, from a function of the momentum ``l_xi``."""

    energy: Energy
    lagrangian: Callable

    def __call__(self, x):
        return self.energy.value(jax.grad(self.lagrangian)(x[:-1], x[-1]))


class ReducedEnergy(Energy):
    """The energy ``xi . l_xi - l``."""

    lagrangian: Callable

    def value(self, x) -> jax.Array:
        value, momentum = jax.value_and_grad(self.lagrangian)(x[:-1], x[-1])
        return jnp.dot(x[:-1], momentum) - value


class VelocityLiePoisson(PoissonBySharp):
    """The Lie-Poisson structure on g* x R in the chart ``(xi, S) -> (l_xi, S)``; S is a Casimir function."""

    algebra: mf.LieAlgebra
    lagrangian: Callable

    @property
    def dim(self) -> int:
        return self.algebra.dim + 1

    def momentum_derivatives(self, x) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return ``mu = l_xi`` and its derivatives with respect to xi and S."""
        momentum = jax.grad(self.lagrangian)
        xi_derivative, S_derivative = jax.jacfwd(momentum, argnums=(0, 1))(x[:-1], x[-1])
        return momentum(x[:-1], x[-1]), xi_derivative, S_derivative

    def sharp(self, x, alpha) -> jax.Array:
        mu, W, _ = self.momentum_derivatives(x)
        xi = solve(W, alpha[:-1, None])[:, 0]
        return jnp.append(solve(W, self.algebra.ad_star(xi, mu)[:, None])[:, 0], 0.0)


def _hessian(structure: VelocityLiePoisson, x):
    return structure.momentum_derivatives(x)[1]
