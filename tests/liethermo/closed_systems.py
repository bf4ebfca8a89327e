"""Simple closed systems with q in R^2 for the tests: forces that depend on S, work and heat from outside."""

import jax.numpy as jnp

import liethermo as lt
from tests.cases import BuiltOnUse


def mass(q):
    return jnp.array([[2.0 + jnp.sin(q[1]), 0.3], [0.3, 1.5 + 0.2 * jnp.cos(q[0])]])


def internal_energy(q, S):
    return 0.5 * q @ q + 0.25 * jnp.sum(q**4) + 3.0 * jnp.exp(S / 4 + 0.1 * q[0])


def friction(q, v, S):
    """Linear in v, with a coefficient that depends on q and S, and no symmetry."""
    R = (0.3 + 0.1 * jnp.tanh(S)) * jnp.array([[1.0, 0.5], [-0.2, 0.4]])
    return -(1.0 + q[1] ** 2) * R @ v


def coupled_lagrangian(q, v, S):
    """v, q and S all multiply each other: the momentum depends on S and the temperature on v."""
    kinetic = 0.5 * jnp.sum((1.5 + jnp.sin(q)) * v**2) * (1.0 + 0.1 * jnp.tanh(S)) + 0.05 * jnp.sum(v**4)
    return kinetic + 0.2 * q[0] * v[1] * jnp.cos(S) - internal_energy(q, S)


def cubic_friction(q, v, S):
    return -(0.2 + 0.1 * S**2) * (1.0 + v @ v) * v


def swirl(q, v, S, t):
    return jnp.array([0.3 * q[1] * jnp.cos(t), -0.2 * q[0] + 0.1 * v[1] + 0.1 * S])


def heater(q, v, S, t):
    return 0.4 * jnp.sin(2 * t) + 0.1 * q[0]


MECHANICAL = lt.Kinetic(mass) - lt.Potential(internal_energy)
X0 = [0.4, -0.3, 0.5, 0.8, 0.2]

ISOLATED_SYSTEMS = BuiltOnUse(
    {
        "mechanical": lambda: lt.SimpleClosedSystem(MECHANICAL, 5, friction=friction),
        "tangled": lambda: lt.SimpleClosedSystem(coupled_lagrangian, 5, friction=cubic_friction, validate=False),
    }
)
OPEN = BuiltOnUse(
    {
        "mechanical": lambda: lt.SimpleClosedSystem(MECHANICAL, 5, friction, swirl, heater),
        "tangled": lambda: lt.SimpleClosedSystem(coupled_lagrangian, 5, cubic_friction, swirl, heater, validate=False),
    }
)
SCHEMES = {
    "scheme 1": lt.VariationalIntegrator.verlet(),
    "scheme 2": lt.VariationalIntegrator.midpoint(),
    "scheme 3": lt.VariationalIntegrator.symmetrised(),
}
