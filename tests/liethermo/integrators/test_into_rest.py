"""Driven bodies that a torque brings to rest at the end of a step, where the energy leaves no direction to correct."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt

STOP_TIME = 2.0
"""Time at which the torques have taken all of the momentum."""

EXPLICIT_METHODS = (lt.MetriplecticRungeKutta(4), lt.MetriplecticRungeKutta(6), lt.MetriplecticTaylor(6))
"""One explicit method of each kind."""


def braked_body(momentum, profile, moments=(1.0, 2.0, 3.0)) -> lt.System:
    """Return a body whose torque is ``-profile(t)`` times a momentum until the time ``STOP_TIME``, then zero."""

    def torque(t, _):
        return -jnp.asarray(momentum) * profile(t) * (t < STOP_TIME)

    return lt.models.rigid_body(moments, torque=torque)


def constant_profile(_):
    return 1.0 / STOP_TIME


def sine_profile(t):
    return 0.25 * jnp.pi * jnp.sin(0.5 * jnp.pi * t)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("unit", [1.0, 1e-9])
@pytest.mark.parametrize("method", EXPLICIT_METHODS, ids=str)
@pytest.mark.parametrize("step", [0.0625, 0.125])
def test_a_constant_torque_stops_a_body_at_the_end_of_a_step(method, step, unit):
    """The momentum is linear in time, so that every method reaches rest to rounding and stays there."""
    momentum = unit * np.array([0.15, 0.05, 0.35])
    system = braked_body(momentum, constant_profile, moments=(1.0, 1.0, 1.0))

    solution = lt.integrate(system, momentum, (0.0, 3.0), step, method, breaks=[STOP_TIME])

    assert np.abs(solution.x[-1]).max() < 1e-15 * unit
    assert solution.casimirs["work"][-1] == pytest.approx(-0.5 * momentum @ momentum, rel=1e-13)
    assert solution.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", EXPLICIT_METHODS, ids=str)
def test_the_momentum_at_rest_has_the_order_of_the_method(method):
    """The work is not exact here, and the energy at rest cannot take its error: the work does, and the laws hold."""
    momentum = np.array([0.5, 0.0, 0.0])
    system = braked_body(momentum, sine_profile)

    def momentum_at_rest(step):
        solution = lt.integrate(system, momentum, (0.0, 3.0), step, method, breaks=[STOP_TIME])
        assert solution.audit().passed
        assert solution.casimirs["work"][-1] == pytest.approx(-0.125, abs=1e-11)
        return np.abs(solution.x[-1]).max()

    assert np.log2(momentum_at_rest(0.125) / momentum_at_rest(0.0625)) > method.order - 0.6


def test_a_step_that_is_much_too_long_still_fails():
    """The work takes an error of a hundredth of the energy at most."""
    momentum = np.array([0.5, 0.0, 0.0])
    system = braked_body(momentum, sine_profile)

    with pytest.raises(lt.ConvergenceError, match="Try a smaller step"):
        lt.integrate(system, momentum, (0.0, 3.0), 2.0, lt.MetriplecticRungeKutta(4), breaks=[STOP_TIME])
