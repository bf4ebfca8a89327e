"""The flow as a differentiable function: its derivatives are those of the discrete flow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

X0 = jnp.array([0.3, 1.0, 0.2])
PARAMETERS = jnp.array([10.0, 5.0, 1.0, 1.0])


def body(parameters):
    return lt.models.rigid_body(parameters[:3], parameters[3])


def nonlinear(parameters):
    inertia = parameters[:3]
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / inertia) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1]),
        lambda p: jnp.log(1.0 + p @ p),
        lt.ProjectedMetric(rate=parameters[3]),
    )


def test_the_same_steps_as_integrate():
    """5.05 is no multiple of the step."""
    path = lt.flow(body(PARAMETERS), X0, (0.0, 5.05), 0.1, save_every=10)
    solution = lt.integrate(body(PARAMETERS), X0, (0.0, 5.05), 0.1, save_every=10, engine="array")
    assert path.shape == solution.x.shape
    assert np.abs(path - solution.x).max() < 1e-14
    assert np.array_equal(lt.flow(body(PARAMETERS), X0, (0.0, 5.05), 0.1), path[-1])


@pytest.mark.parametrize(
    ("build", "method"),
    [(body, lt.MetriplecticMidpoint()), pytest.param(nonlinear, lt.MetriplecticGauss(2), marks=pytest.mark.slow)],
    ids=["midpoint", "gauss"],
)
def test_derivatives_against_differences(build, method):
    """By initial state and parameters, forwards and backwards."""

    @jax.jit
    def end(parameters, x0):
        return lt.flow(build(parameters), x0, (0.0, 3.0), 0.1, method)

    forwards = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(PARAMETERS, X0)
    backwards = jax.jit(jax.jacrev(end, argnums=(0, 1)))(PARAMETERS, X0)
    for argument, (a, b) in enumerate(zip(forwards, backwards, strict=True)):
        assert np.abs(a - b).max() < 1e-12 * np.abs(a).max()
        for i in range(a.shape[1]):
            arguments = [PARAMETERS, X0]
            size = 1e-5 * float(jnp.abs(arguments[argument][i]))
            moved = [[*arguments], [*arguments]]
            for sign, version in zip((1.0, -1.0), moved, strict=True):
                version[argument] = arguments[argument].at[i].add(sign * size)
            difference = (end(*moved[0]) - end(*moved[1])) / (2 * size)
            assert np.abs(difference - a[:, i]).max() < 1e-7 * np.abs(a).max()


def test_the_energy_is_conserved_in_every_derivative():
    """``dH(x(t)) / dx0 = dH / dx0``: the law holds for neighbouring trajectories too."""
    system = body(PARAMETERS)
    gradient = jax.grad(lambda x0: system.energy.value(lt.flow(system, x0, (0.0, 3.0), 0.1)))(X0)
    assert np.abs(gradient - system.energy.gradient(X0)).max() < 1e-13


def test_a_batch():
    states = jnp.asarray(np.random.default_rng(0).standard_normal((4, 3)))
    ends = jax.jit(jax.vmap(lambda x: lt.flow(body(PARAMETERS), x, (0.0, 2.0), 0.1)))(states)
    alone = lt.ensemble(body(PARAMETERS), states, (0.0, 2.0), 0.1).x
    assert np.abs(ends - alone).max() < 1e-13


def test_a_step_that_cannot_be_solved_gives_nan():
    system = lt.LiePoissonSystem(mf.so(3), lambda p: jnp.sum(jnp.sin(40.0 * p)), lt.Quadratic(np.ones(3)))
    assert np.isnan(lt.flow(system, [0.3, 1.0, -0.2], (0.0, 500.0), 50.0)).all()
    with pytest.raises(lt.InputError, match="positive"):
        lt.flow(system, X0, (0.0, 1.0), -0.1)
