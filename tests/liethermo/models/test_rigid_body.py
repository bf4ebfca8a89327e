"""The controlled rigid body of the catalogue, and isolated bodies."""

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

INERTIA = np.array([3.0, 2.0, 1.0])
START = np.array([0.06, 0.1, 1.0])


def test_the_relaxed_body_is_turned_by_a_torque_that_does_no_work():
    """The kinetic energy of Morrison's body is constant and |mu| grows."""
    body = lt.models.rigid_body(INERTIA, rate=0.2)
    states = np.random.default_rng(0).standard_normal((20, 3))
    omega = states / INERTIA
    torque = np.asarray(body.vector_field(states)) - np.cross(states, omega)
    assert np.allclose(torque, 0.2 * np.cross(omega, np.cross(states, omega)), rtol=0, atol=1e-14)
    assert np.abs(np.sum(torque * omega, axis=1)).max() < 1e-14
    assert np.sum(torque * states, axis=1).min() > 0.0

    run = lt.integrate(body, START, (0.0, 100.0), 0.1)
    kinetic, size = 0.5 * np.sum(run.x**2 / INERTIA, axis=1), np.linalg.norm(run.x, axis=1)
    assert np.ptp(kinetic) < 1e-14
    assert np.diff(size).min() >= -4e-16
    assert size[0] == pytest.approx(1.0068, abs=1e-4)
    assert size[-1] == pytest.approx(np.sqrt(2 * INERTIA.max() * kinetic[0]), rel=1e-5)  # 1.7374


def test_the_momentum_in_space_of_the_relaxed_body_moves():
    inverse, casimir = lt.Quadratic(1 / INERTIA), lt.Quadratic(np.ones(3))
    body = lt.LiePoissonSystem(mf.so(3), inverse, casimir, lt.KillingDissipation(0.1), group=mf.SO(3))
    run = lt.integrate(body, START, (0.0, 20.0), 0.1)
    spatial = np.einsum("tij,tj->ti", run.attitude, run.x)
    assert np.abs(spatial - spatial[0]).max() > 0.1


def test_a_body_left_to_itself_keeps_its_momentum_and_loses_kinetic_energy():
    """The double bracket omits the heat; for wheels with friction see the tests of ``LieVariational``."""
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / INERTIA), dissipation=lt.DoubleBracket(0.2))
    run = lt.integrate(body, START, (0.0, 200.0), 0.1)
    size = np.linalg.norm(run.x, axis=1)
    assert np.ptp(size) < 1e-13
    assert np.diff(run.energy).max() <= 4e-16
    assert run.energy[-1] == pytest.approx(size[0] ** 2 / (2 * INERTIA.max()), rel=1e-4)
