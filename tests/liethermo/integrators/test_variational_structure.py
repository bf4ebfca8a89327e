"""The structure identity (4.7) of the discrete flow, and symplecticity without heat."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.integrators.variational.discrete import Pair
from manifolds.matrices.linear import solve
from tests.liethermo.closed_systems import MECHANICAL, OPEN, SCHEMES, X0

H = 0.1


def one_forms(discrete, r):
    """Return Theta^-, Theta^+, omega^(fr + ext) and omega^tau of Definition 4.2, in components, shape (4, 6)."""
    (p0, p1), (force_minus, force_plus), zero = discrete.momenta(*r), discrete.forces(*r), jnp.zeros_like(r[0])
    dL_dS = jax.grad(discrete.lagrangian, argnums=(2, 3))(*r)
    rows = (
        (p0, zero, 0.0, 0.0),
        (zero, p1, 0.0, 0.0),
        (force_minus, force_plus, 0.0, 0.0),
        (zero, zero, -dL_dS[0], -dL_dS[1]),
    )
    return jnp.stack([jnp.concatenate([a, b, jnp.stack([c, d])]) for a, b, c, d in rows])


def implicit_root(residual, y):
    """Return y with ``residual(y) = 0`` as an implicit function, from its known value."""

    def solve_linear(linear, b):
        return solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b[:, None])[:, 0]

    return jax.lax.custom_root(residual, y, lambda _, y: y, solve_linear)


@eqx.filter_jit
def slopes_of_two_steps(discrete, z):
    """Return s of the first pair, and the difference quotients of the second, without derivatives."""
    r = z[:2], z[2:4], z[4], discrete.end_entropy_on_constraint(z[:2], z[2:4], z[4])
    _, q2, S1, S2 = discrete.flow(*r)
    return (r[3] - r[2])[None] / H, jnp.append(q2 - r[1], S2 - S1) / H


@eqx.filter_jit
def two_forms(discrete, flow, z, s_first, y_second):
    """Return ``-d`` of the forms in the chart z = (q_0, q_1, S_0) of C_K^d: at the pair, and after the flow."""

    def pairs(z):
        q0, q1, S0 = z[:2], z[2:4], z[4]
        (s,) = implicit_root(lambda s: discrete.constraint_residual(Pair(q0, (q1 - q0) / H, S0, s[0]))[None], s_first)
        S1 = S0 + H * s
        p1 = flow.momenta(q0, q1, S0, S1)[1]

        def residual(y):
            pair = Pair(q1, y[:2], S1, y[2])
            return jnp.append(flow.motion_residual(p1, pair), flow.constraint_residual(pair))

        y = implicit_root(residual, y_second)
        return jnp.stack(
            [_concatenate_pair(q0, q1, S0, S1), _concatenate_pair(q1, q1 + flow.h * y[:2], S1, S1 + flow.h * y[2])]
        )

    def components(z):
        points, tangents = pairs(z), jax.jacfwd(pairs)(z)
        forms = [
            one_forms(discrete, (r[:2], r[2:4], r[4], r[5])) @ tangent
            for r, tangent in zip(points, tangents, strict=True)
        ]
        return jnp.stack(forms)  # pair, form, component

    slopes = jax.jacfwd(components)(z)  # [..., i, j] = d_j theta_i
    return slopes - slopes.swapaxes(-1, -2)  # -(d theta)_ij = d_j theta_i - d_i theta_j


def _concatenate_pair(q0, q1, S0, S1):
    return jnp.concatenate([q0, q1, jnp.stack([S0, S1])])


def forms_of_two_steps(kind, name) -> np.ndarray:
    """Return minus the two-forms of a pair and of the next: shape (pair, form, component, component)."""
    z, discrete = jnp.array([0.4, -0.3, 0.45, -0.24, 0.2]), SCHEMES[name].discrete_system(OPEN[kind], H)
    return np.asarray(two_forms(discrete, discrete, z, *slopes_of_two_steps(discrete, z)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        pytest.param(kind, name, marks=() if (kind, name) == ("mechanical", "scheme 3") else pytest.mark.slow)
        for kind in OPEN
        for name in SCHEMES
    ],
)
def test_the_structure_identity(kind, name):
    """(4.7) with N = 2: ``F* Omega^+ - Omega^- = -d (omega + F* omega)``, omega = omega^(fr + ext) + omega^tau."""
    forms = forms_of_two_steps(kind, name)
    ends = forms[1, 1] - forms[0, 0]
    forces, heat = forms[0, 2] + forms[1, 2], forms[0, 3] + forms[1, 3]
    assert np.abs(ends - forces - heat).max() < 1e-12 * np.abs(forms[:, :2]).max()
    # it would not hold without either
    assert np.abs(forces).max() > 1e-3
    assert np.abs(heat).max() > 1e-3


@pytest.mark.slow
def test_another_flow_does_not_have_the_structure():
    """Control: the flow with a step that is a tenth longer violates the identity."""
    z, scheme, system = jnp.array([0.4, -0.3, 0.45, -0.24, 0.2]), SCHEMES["scheme 3"], OPEN["mechanical"]
    discrete, longer_step = scheme.discrete_system(system, H), scheme.discrete_system(system, 1.1 * H)
    s_first, _ = slopes_of_two_steps(discrete, z)
    S1 = z[4] + H * s_first[0]
    _, q2, _, S2 = longer_step.flow(z[:2], z[2:4], z[4], S1)
    forms = np.asarray(two_forms(discrete, longer_step, z, s_first, jnp.append(q2 - z[2:4], S2 - S1) / longer_step.h))
    defect = forms[1, 1] - forms[0, 0] - forms[:, 2:].sum(axis=(0, 1))
    assert np.abs(defect).max() > 1e-6 * np.abs(forms[:, :2]).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "scheme 2" else pytest.mark.slow) for n in SCHEMES])
def test_symplecticity_without_heat(name):
    """L = K(q, v) - U(q) - S and no forces: the map (q, p) -> (q', p') is symplectic; with friction it is not."""
    cold = lt.SimpleClosedSystem(MECHANICAL, 5)

    @eqx.filter_jit
    def defect(system, x):
        discrete = SCHEMES[name].discrete_system(system, 0.2)

        def step(q0, p0, S0):
            def residual(y):
                pair = Pair(q0, y[:2], S0, y[2])
                return jnp.append(discrete.motion_residual(p0, pair), discrete.constraint_residual(pair))

            def newton(_, y):
                return y - solve(jax.jacfwd(residual)(y), residual(y)[:, None])[:, 0]

            y = jax.lax.fori_loop(0, 8, newton, jnp.append(p0 / 2, 0.0))
            q1, S1 = q0 + 0.2 * y[:2], S0 + 0.2 * y[2]
            return jnp.concatenate([q1, discrete.momenta(q0, q1, S0, S1)[1]])

        M = jax.jacfwd(lambda y: step(y[:2], y[2:], x[4]))(jnp.asarray(x[:4]))
        J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(2))
        return jnp.abs(M.T @ J @ M - J).max()

    assert defect(cold, np.array(X0)) < 1e-13
    rubbing = lt.SimpleClosedSystem(MECHANICAL, 5, friction=0.1)
    assert defect(rubbing, np.array(X0)) > 1e-3
