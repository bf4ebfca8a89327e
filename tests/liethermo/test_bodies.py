"""Closed forms of free bodies, and what is told of how a body is turned."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import liethermo as lt

ASYMMETRIC = np.array([1.0, 2.0, 3.0])


def free(inertia, mu0, t_end, times=None, rate=0.0):
    """Momentum and attitude of a body, by DOP853: equations of their own, shape (12,)."""
    inertia = np.asarray(inertia)

    def f(t, s):
        mu, R = s[:3], s[3:].reshape(3, 3)
        xi = mu / inertia
        whole = xi + rate * np.cross(mu, xi)
        return np.concatenate([np.cross(mu, whole), np.cross(R, whole).ravel()])  # rows r: (R hat(w))_r = r x w

    start = np.concatenate([mu0, np.eye(3).ravel()])
    return solve_ivp(f, (0.0, t_end), start, "DOP853", t_eval=times, rtol=3e-14, atol=1e-15)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)], ids=str)
@pytest.mark.parametrize("mu0", [(0.3, 0.2, 1.0), (1.0, 0.3, -0.2), (0.02, 0.0, 1.0)], ids=str)
def test_periods_against_an_integration(mu0, order):
    """After a period the momentum is back, and the axis has turned about L by its mean rate times the period."""
    inertia, mu0 = ASYMMETRIC[list(order)], np.array(mu0)[list(order)]
    found = lt.bodies.periods(inertia, mu0)
    run = free(inertia, mu0, float(found.rotation))
    mu, g = run.y[:3, -1], run.y[3:, -1].reshape(3, 3)
    assert np.allclose(mu, mu0, rtol=0, atol=3e-12)
    back = Rotation.from_matrix(g).as_rotvec()  # the whole turns about the momentum in space
    L = mu0 / np.linalg.norm(mu0)
    turned = 2 * np.pi * found.rotation / found.precession
    assert np.linalg.norm(np.cross(back, L)) < 3e-12
    assert abs(np.sin(0.5 * (back @ L - turned))) < 3e-12
    axis = order[found.axis]
    assert axis == (2 if abs(mu0[list(order).index(2)]) > 0.9 else 0)
    by_energy = lt.bodies.periods(inertia, np.linalg.norm(mu0), 0.5 * np.sum(mu0**2 / inertia))
    assert np.allclose([*found[:2]], [*by_energy[:2]], rtol=1e-12)
