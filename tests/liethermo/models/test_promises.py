"""Constants that the docstring of a model promises are conserved by every conservative method, and audited."""

import numpy as np
import pytest

import liethermo as lt

PROMISES = {
    "body_with_wheels": (
        lt.models.body_with_wheels,
        [0.3, 1.0, 0.4, 0.1, -0.2, 0.3, 0.0],
        {"mu1**2 + mu2**2 + mu3**2": lambda system, x: np.sum(np.asarray(system.momenta(x))[:, :3] ** 2, axis=1)},
    ),
    "moving_thermo_particles": (
        lt.models.moving_thermo_particles,
        [0.0, 1.0, 0.1, 1.0, -0.3, 0.5],
        {
            "momentum": lambda system, x: x[:, 1] + x[:, 4],
            "kinetic energy": lambda system, x: 0.5 * (x[:, 1] ** 2 + x[:, 4] ** 2),
        },
    ),
    "thermo_springs": (
        lt.models.thermo_springs,
        [0.0, 1.0, 0.1, 1.0, -0.3, 0.5],
        {"momentum": lambda system, x: x[:, 1] + x[:, 4]},
    ),
    "free rigid body": (
        lambda: lt.models.free_rigid_body((3.0, 2.0, 1.0)),
        [0.3, 1.0, 0.4],
        {"mu1**2 + mu2**2 + mu3**2": lambda system, x: np.sum(x**2, axis=1)},
    ),
}


@pytest.mark.sampled("thermo_springs-MetriplecticRungeKutta(order=6)", "free rigid body-MetriplecticGauss(stages=2)")
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(6), lt.MetriplecticGauss(2)], ids=str)
@pytest.mark.parametrize("name", PROMISES)
def test_promised_constants_are_held_and_audited(name, method):
    build, x0, constants = PROMISES[name]
    system = build()
    assert constants.keys() <= system.first_integrals()
    run = lt.integrate(system, x0, (0.0, 20.0), 0.1, method)
    rows = {row.law: row for row in run.audit().rows}
    for constant, evaluate in constants.items():
        values = evaluate(system, np.asarray(run.x))
        assert np.abs(values - values[0]).max() <= 1e-13 * np.abs(values).max()
        assert rows[f"drift of {constant}"].passed is not False


def test_friction_on_the_rotation_leaves_no_constant():
    """The momentum that friction changes is shown, but not conserved."""
    wheels = lt.models.body_with_wheels()
    with_friction = lt.EulerPoincareClosedSystem(wheels.algebra, wheels.lagrangian, lambda xi, S: -0.1 * xi + 0.0 * S)
    assert not with_friction.first_integrals()
    assert "mu1**2 + mu2**2 + mu3**2" in with_friction.functions()
    frictionless = lt.EulerPoincareClosedSystem(wheels.algebra, wheels.lagrangian)
    assert frictionless.first_integrals() == set(frictionless.casimirs())


@pytest.mark.slow
@pytest.mark.parametrize("wheels", [[0.1, -0.2, 0.3], [5.0, 5.0, 5.0]], ids=["slow wheels", "fast wheels"])
def test_the_energy_of_a_body_with_wheels_in_many_steps(wheels):
    """The energy changes by rounding alone: at most 3e-15 in 1e5 steps near rest on several bodies, once 1.2e-13."""
    run = lt.integrate(
        lt.models.body_with_wheels(),
        [0.3, 1.0, 0.4, *wheels, 0.0],
        (0.0, 500.0),
        0.005,
        lt.MetriplecticGauss(2),
        save_every=1000,
    )
    assert run.audit(energy=1.5e-14).passed, str(run.audit())
