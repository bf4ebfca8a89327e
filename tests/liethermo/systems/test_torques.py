"""Torques: the ledger of work, the impulse, orders against SciPy, closed forms, ensembles, files, refusals."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.systems.driven import DrivenSystem, _TorqueForce
from tests.cases import covering

INERTIA = np.array([3.2, 3.0, 1.0])
START = np.array([0.8, 0.5, 1.3])
SO3 = mf.SO(3)
SPAN = (0.3, 5.3)

LAW = 2e-15
"""Limit of the drift of ``H + U - W`` and of momentum in space less impulse, relative, in 100 steps; 9e-16 seen."""


def rotating_field(t):
    return jnp.array([jnp.cos(t), jnp.sin(2.0 * t), 0.3])


TORQUES = {
    "body": lt.torques.ConstantInBody([0.1, 0.2, -0.1]),
    "space": lt.torques.ConstantInSpace([0.1, 0.2, -0.1]),
    "gravity gradient": lt.torques.GravityGradient(INERTIA, 0.7),
    "magnetic": lt.torques.Magnetic([0.3, 0.2, 0.5], rotating_field),
    "thrust": lt.torques.Tabulated(
        [1.0, 2.0, 4.0, 5.0], [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3], [0.1, 0.0, 0.3], [0.0] * 3]
    ),
    "two": [lt.torques.ConstantInSpace([0.1, 0.2, -0.1]), lt.torques.ConstantInBody([0.1, 0.2, -0.1])],
}
METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "gauss2": lt.MetriplecticGauss(2),
    "gauss3": lt.MetriplecticGauss(3),
    "rk4": lt.MetriplecticRungeKutta(4),
    "rk6": lt.MetriplecticRungeKutta(6),
    "rk8": lt.MetriplecticRungeKutta(8),
    "taylor": lt.MetriplecticTaylor(8),
}


def rubbing(torque, warm=True, **more) -> lt.LiePoissonSystem:
    """A body with friction inside, which heats it, and a torque from outside."""
    baths = lt.HeatBaths(capacity=2.0, temperature=1.0) if warm else None
    friction = lt.DoubleBracket(0.02)
    return lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / INERTIA), dissipation=friction, baths=baths, torque=torque, group=SO3, **more
    )


def row(run, law):
    return next(row for row in run.audit().rows if row.law == law)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("torque", "method"),
    covering(itertools.product(TORQUES, METHODS), lambda torque, method: [(torque, type(METHODS[method])), method]),
)
def test_the_ledger_and_the_impulse(torque, method):
    """Energy and heat less work, and momentum in space less impulse, constant to rounding; the entropy law besides."""
    run = lt.integrate(rubbing(TORQUES[torque]), START, SPAN, 0.05, METHODS[method], engine="compiled")
    assert run.laws.energy == "conserved"
    assert run.laws.entropy == "nondecreasing"
    assert run.audit().passed, run.audit()
    assert run.audit().energy_drift <= LAW
    assert row(run, "drift of momentum in space less the impulse").value <= LAW
    work = run.casimirs["work"]
    assert np.ptp(work) > 0.01
    assert np.abs(run.energy - run.energy[0] - work).max() <= LAW * np.abs(run.energy).max()
    impulse = np.stack([run.casimirs[f"impulse {i}"] for i in (1, 2, 3)], axis=1)
    momentum = np.einsum("tij,tj->ti", run.attitude, run.x[:, :3])
    assert np.ptp(impulse, axis=0).max() > 0.01
    assert np.abs(momentum - momentum[0] - impulse).max() <= 4 * LAW
    assert "change of mu1**2 + mu2**2 + mu3**2" in str(run.audit())


def with_wheel(gravity, inertia, wheel) -> lt.LiePoissonSystem:
    """A body with a wheel about axis 2, on so(3) + R."""
    inverse = np.zeros((4, 4))
    inverse[:3, :3] = np.diag(1.0 / (inertia - [0.0, wheel, 0.0]))
    inverse[3, 3] = 1.0 / wheel + inverse[1, 1]
    inverse[1, 3] = inverse[3, 1] = -inverse[1, 1]
    return lt.LiePoissonSystem(
        mf.direct_sum(mf.so(3), mf.abelian(1)),
        lt.Quadratic(inverse),
        torque=lambda t, mu, attitude: jnp.append(gravity(t, mu, attitude), 0.0),
        group=SO3,
    )


def test_a_turn_about_the_momentum_is_not_made_of_rounding():
    """In the plane of its orbit a body turns about its momentum, which tells nothing of such turns."""
    inertia, n = np.array([60.0, 66.0, 8.0]), 1.1e-3
    system = with_wheel(lt.torques.GravityGradient(inertia, n), inertia, 2.0)
    start = [0.0, 66.0 * 2.65 * n, 0.0, 2.0 * 2.65 * n]
    upright = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    T = 2.0 * np.pi / n
    run = lt.integrate(system, start, (0.0, 2.0 * T), T / 60.0, METHODS["rk4"], attitude=upright, engine="compiled")
    other = lt.integrate(
        system, start, (0.0, 2.0 * T), T / 60.0, METHODS["gauss2"], attitude=upright, engine="compiled"
    )
    assert run.audit().passed, run.audit()
    assert np.abs(run.attitude - other.attitude).max() < 2e-3  # 4e-4 seen, of steps of fourth order


@pytest.mark.slow
@pytest.mark.parametrize("method", ["midpoint", "gauss2", "rk4"])
def test_a_torque_on_a_body_with_a_wheel(method):
    """On so(3) + R with the group of the first: the momentum in space is that of the first three components."""
    system = with_wheel(TORQUES["gravity gradient"], INERTIA, 0.1)
    run = lt.integrate(system, [*START, 0.02], SPAN, 0.05, METHODS[method], engine="compiled")
    assert run.audit().passed, run.audit()
    assert run.audit().energy_drift <= LAW
    assert row(run, "drift of momentum in space less the impulse").value <= LAW
    assert np.ptp(run.casimirs["work"]) > 0.01


def test_work_by_another_gradient_breaks_the_ledger(monkeypatch):
    """Control: the power of a torque by the gradient of H where it acts, and not by the discrete one of the step."""
    energy = lambda mu: jnp.sum(mu**2 / INERTIA) / 2 + 0.1 * jnp.sum(mu**4)  # noqa: E731
    system = lt.LiePoissonSystem(mf.so(3), energy, torque=TORQUES["body"])
    good = lt.integrate(system, START, SPAN, 0.1, lt.MetriplecticMidpoint(), engine="array")
    assert good.audit().energy_drift <= LAW
    monkeypatch.setattr(
        _TorqueForce, "force", lambda self, system, x, dH, dS, dL: system.torque_velocity(x, system.energy.gradient(x))
    )
    monkeypatch.setattr(
        DrivenSystem,
        "field",
        lambda self, x, dH, dS, dL=(): _reversible_field(self, x, dH) + self.dissipation.force(self, x, dH, dS, dL),
    )
    method = lt.MetriplecticMidpoint("mean_value")  # of which no program is known
    bad = lt.integrate(system, START, SPAN, 0.1, method, engine="array", on_failure="return")
    assert bad.audit().energy_drift > 1e5 * LAW
    assert not bad.audit().passed


def _reversible_field(system, x, dH):
    return system.poisson.sharp(x, dH)


def test_an_impulse_of_another_collocation_breaks_its_row(monkeypatch):
    """Control: the impulse by the attitudes of the stages, which lie in the group, in place of the collocated ones."""
    monkeypatch.setattr(
        "liethermo.integrators.reconstruction._collocation_stages",
        lambda X: jnp.broadcast_to(jnp.eye(X.shape[-1]), X.shape),
    )
    torque = lt.torques.ConstantInSpace([0.1, 0.2, -0.1002])
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=torque, group=SO3, reconstruction="coadjoint"
    )
    run = lt.integrate(system, START, (0.0, 2.0), 0.1, lt.MetriplecticMidpoint(), engine="array")
    assert row(run, "drift of momentum in space less the impulse").value > 1e5 * LAW
    assert not run.audit().passed


# -- orders ------------------------------------------------------------------------------------------------------------


def from_all_sides(t, mu, attitude):
    """Return a torque that depends on time, momentum and attitude."""
    field = jnp.array([0.6, 0.3, 0.2]) + 0.4 * jnp.stack([jnp.cos(t), jnp.sin(t), 0.0 * t])
    return jnp.cross(jnp.array([0.5, -0.3, 0.8]), attitude.T @ field) + 0.1 * jnp.sin(attitude[0, 0] * mu)


@pytest.fixture(scope="module")
def exact():
    """Momentum, attitude, impulse and work at t = 2.4 by SciPy, from a field written by hand."""

    def rate(t, y):
        mu, g = y[:3], y[3:12].reshape(3, 3)
        field = np.array([0.6, 0.3, 0.2]) + 0.4 * np.array([np.cos(t), np.sin(t), 0.0])
        torque = np.cross([0.5, -0.3, 0.8], g.T @ field) + 0.1 * np.sin(g[0, 0] * mu)
        full = mu / INERTIA + 0.02 * np.cross(mu, mu / INERTIA)
        turning = (g @ np.cross(np.eye(3), full)).ravel()
        return np.concatenate([np.cross(mu, full) + torque, turning, g @ torque, [mu / INERTIA @ torque]])

    start = np.concatenate([START, np.eye(3).ravel(), np.zeros(4)])
    return solve_ivp(rate, (0.4, 2.4), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


STEPS = {2: (40, 80, 160), 4: (20, 40, 80), 6: (8, 12, 18), 8: (6, 9, 12)}


@pytest.mark.sampled("gauss2-cayley")
@pytest.mark.parametrize(
    ("method", "kind"),
    [
        pytest.param(method, kind, id=f"{name}-{kind}")
        for name, method in METHODS.items()
        for kind in ("cayley", "exp")
        if name != "taylor" and (kind == "cayley" or not method.explicit)
    ],
)
def test_orders_against_scipy(method, kind, exact):
    """Momentum, attitude, impulse and work converge with the order of the method."""
    system, errors = rubbing(from_all_sides, warm=False, reconstruction=kind), []
    for n in STEPS[method.order]:
        run = lt.integrate(system, START, (0.4, 2.4), 2.0 / n, method, save_every=n, engine="compiled")
        found_values = [*run.x[-1], *run.attitude[-1].ravel(), *(run.casimirs[f"impulse {i}"][-1] for i in (1, 2, 3))]
        errors.append([np.abs(found_values - exact[:-1]).max(), abs(run.casimirs["work"][-1] - exact[-1])])
        assert run.audit().passed, run.audit()
        if kind == "cayley":
            assert row(run, "drift of momentum in space less the impulse").value <= LAW
    n = np.array(STEPS[method.order])
    slopes = np.log(np.array(errors[:-1]) / errors[1:]) / np.log(n[1:] / n[:-1])[:, None]
    assert np.min(errors) > 1e-12, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < (0.5 if method.explicit else 0.2)).all(), (errors, slopes)


@pytest.mark.slow
def test_explicit_and_implicit_methods_agree(exact):
    """Taylor series go through the exponential of the angles too."""
    run = lt.integrate(rubbing(from_all_sides, warm=False), START, (0.4, 2.4), 0.1, METHODS["rk8"], engine="compiled")
    assert np.abs(run.x[-1] - exact[:3]).max() < 1e-9
    assert run.audit().passed


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["gauss2", "rk4"])
def test_a_body_is_spun_up_from_rest(name):
    """``Omega = tau t / I`` and ``W = (tau t)^2 / (2 I)`` about a principal axis, a constant torque in the body."""
    torque, axis = 0.3, 2
    system = rubbing(lt.torques.ConstantInBody(torque * np.eye(3)[axis]))
    run = lt.integrate(system, np.zeros(3), (0.0, 10.0), 0.1, METHODS[name], engine="compiled")
    expected_values = torque * run.t
    assert np.abs(run.x[:, axis] - expected_values).max() < 1e-14
    assert np.abs(run.casimirs["work"] - expected_values**2 / (2 * INERTIA[axis])).max() < 1e-14
    assert np.abs(run.casimirs["impulse 3"] - expected_values).max() < 1e-14
    assert run.audit().passed


@pytest.mark.slow
def test_libration_under_gravity_gradient():
    """A satellite that points to the earth swings in pitch at ``sqrt(3 n^2 (I_roll - I_yaw) / I_pitch)``."""
    roll, pitch, yaw = 9.0, 10.0, 4.0
    n, angle = 1.1e-3, 1e-3  # of a low orbit, rad/s; a small angle, so that the swing is linear to 1e-7
    inertia = np.array([yaw, roll, pitch])  # body axes: to the earth, along the orbit, normal to it
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / inertia), torque=lt.torques.GravityGradient(inertia, n), group=SO3
    )
    frequency = np.sqrt(3.0 * n**2 * (roll - yaw) / pitch)
    period = 2.0 * np.pi / frequency
    tilted = np.asarray(SO3.exp(np.array([0.0, 0.0, angle])))
    run = lt.integrate(
        system, [0.0, 0.0, pitch * n], (0.0, 2 * period), period / 100, METHODS["gauss3"], attitude=tilted
    )
    to_centre = np.stack([np.cos(n * run.t), np.sin(n * run.t), 0 * run.t], axis=1)
    in_body = np.einsum("tij,ti->tj", run.attitude, to_centre)
    swing = -np.arctan2(in_body[:, 1], in_body[:, 0])
    assert np.abs(swing - angle * np.cos(frequency * run.t)).max() < 1e-5 * angle  # the rest: it is not linear
    other = np.sqrt(3.0 * n**2 * (roll - yaw) / roll)
    assert np.abs(swing - angle * np.cos(other * run.t)).max() > 0.1 * angle
    assert run.audit().passed


def test_a_motor_drives_a_wheel():
    """A motor turns the wheel and not the whole: |Pi| is constant, and the work is of the motor against the wheel."""
    wheel, power = 0.1, lambda t: 0.05 * jnp.sin(t)[None]

    def energy(mu):
        body = mu[:3] - jnp.array([0.0, 0.0, 1.0]) * mu[3]
        return jnp.sum(body**2 / INERTIA) / 2 + mu[3] ** 2 / (2 * wheel)

    length = {"Pi": lambda mu: mu[:3] @ mu[:3]}
    algebra = mf.direct_sum(mf.so(3), mf.abelian(1))
    system = lt.LiePoissonSystem(algebra, energy, torque=lt.torques.Motor(power), momentum_maps=length)
    for name in ("gauss2", "rk6"):
        run = lt.integrate(system, [*START, 0.0], SPAN, 0.05, METHODS[name], engine="compiled")
        assert run.audit().passed, run.audit()
        assert "Pi" in run.laws.conserved
        assert np.abs(run.x[:, 3] - 0.05 * (np.cos(0.3) - np.cos(run.t))).max() < 1e-7


WHEEL = 0.1
WITH_WHEEL = mf.direct_sum(mf.so(3), mf.abelian(1))


def with_a_wheel(torque, **more) -> lt.LiePoissonSystem:
    """A body with a wheel about its third axis; mu is the momentum of the whole, then that of the wheel."""

    def energy(mu):
        body = mu[:3] - jnp.array([0.0, 0.0, 1.0]) * mu[3]
        return jnp.sum(body**2 / INERTIA) / 2 + mu[3] ** 2 / (2 * WHEEL)

    return lt.LiePoissonSystem(WITH_WHEEL, energy, torque=torque, **more)


def moment(t):
    return 0.05 * jnp.sin(t)[None]


INTERNAL = {
    "motor": lt.torques.Motor(moment),
    "number": lt.torques.Motor([0.3]),
    "function": lambda t, mu: jnp.zeros(4).at[3].set(0.05 * jnp.sin(t) - 0.01 * mu[3] ** 3),
    "attitude": lambda t, mu, g: jnp.append(jnp.zeros(3), 0.05 * g[0, 1]),
    "two": [lt.torques.Motor(moment), lambda t, mu: jnp.append(jnp.zeros(3), -0.1 * mu[3])],
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("torque", "name", "step"),
    covering(
        (
            pytest.param(torque, name, step, id=f"{torque}-{name}-{how}")
            for torque, name in itertools.product(INTERNAL, METHODS)
            for how, step in {"0.5": 0.5, "adaptive": lt.Adaptive(1e-6)}.items()
        ),
        lambda torque, name, step: [(torque, type(METHODS[name])), (name, step == 0.5)],
    ),
)
def test_an_internal_torque_leaves_the_momentum_in_space(torque, name, step):
    """As it leaves the length of the momentum: every method holds both, and the audit has a row for each."""
    system = with_a_wheel(INTERNAL[torque], group=SO3)
    run = lt.integrate(system, [*START, 0.05], SPAN, step, METHODS[name], engine="array")
    assert run.audit().passed, run.audit()
    in_space = np.einsum("tij,tj->ti", run.attitude, run.x[:, :3])
    assert np.abs(in_space - in_space[0]).max() <= 5e-15
    lengths = np.linalg.norm(run.x[:, :3], axis=1)
    assert np.abs(lengths - lengths[0]).max() <= 3e-15
    assert row(run, "drift of momentum in space").passed
    assert row(run, "drift of mu1**2 + mu2**2 + mu3**2").passed
    assert not any(name.startswith("impulse") for name in run.casimirs)


def test_a_motor_against_scipy():
    system = with_a_wheel(INTERNAL["motor"], group=SO3)

    def field(t, state):
        mu, g = state[:4], state[4:].reshape(3, 3)
        omega = (mu[:3] - np.array([0.0, 0.0, mu[3]])) / INERTIA
        hat = np.array([[0.0, -omega[2], omega[1]], [omega[2], 0.0, -omega[0]], [-omega[1], omega[0], 0.0]])
        return np.concatenate([np.cross(mu[:3], omega), [0.05 * np.sin(t)], (g @ hat).ravel()])

    start = np.concatenate([START, [0.05], np.eye(3).ravel()])
    exact = solve_ivp(field, SPAN, start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    run = lt.integrate(system, [*START, 0.05], SPAN, 0.05, METHODS["rk8"], engine="array")
    assert np.abs(run.x[-1] - exact[:4]).max() < 1e-10
    assert np.abs(run.attitude[-1].ravel() - exact[4:]).max() < 1e-10


def test_a_motor_beside_friction_in_the_bearing():
    """The conserved functions are decided at random points, and the motor is no reason against them."""
    system = with_a_wheel(
        INTERNAL["motor"], group=SO3, dissipation=lt.Friction([0.0, 0.0, 0.0, 0.02]), baths=lt.HeatBaths(2.0, 1.0)
    )
    run = lt.integrate(system, [*START, 0.05], SPAN, 0.5, METHODS["rk4"], engine="array")
    assert run.audit().passed, run.audit()
    assert row(run, "drift of mu1**2 + mu2**2 + mu3**2").passed


def test_what_a_torque_acts_on_does_not_depend_on_its_numbers():
    """A torque whose numbers happen to be zero has an impulse, as those of another member may not be zero."""
    idle, busy = (lt.torques.ConstantInBody(moment) for moment in ([0.0, 0.0, 0.0, 0.1], [0.1, 0.0, 0.0, 0.1]))
    for torque in (idle, busy, [lt.torques.Motor([0.1]), idle], lambda t, mu: 0.1 * mu):
        system = with_a_wheel(torque, group=SO3)
        assert system.torque_laws.has_impulse
        assert system.torque_laws.changed_casimirs == {"mu1**2 + mu2**2 + mu3**2", "mu4"}
    for torque in INTERNAL.values():
        system = with_a_wheel(torque, group=SO3)
        assert not system.torque_laws.has_impulse
        assert system.torque_laws.changed_casimirs == {"mu4"}
    assert with_a_wheel(INTERNAL["motor"]).torque_laws.changed_casimirs == {"mu4"}


@pytest.mark.slow
def test_an_ensemble_over_the_moment_of_a_motor_is_single_runs():
    moments, method = np.array([[0.0], [0.1], [-0.2]]), METHODS["rk4"]
    system = with_a_wheel(lt.torques.Motor([0.3]), group=SO3)
    many = lt.ensemble(system, [*START, 0.05], SPAN, 0.5, method, parameters={"torque.moment": moments})
    assert many.audit().passed, many.audit()
    for i in range(3):
        alone = with_a_wheel(lt.torques.Motor(moments[i]), group=SO3)
        one = lt.integrate(alone, [*START, 0.05], SPAN, 0.5, method, engine=many.provenance["engine"])
        assert np.array_equal(many.x[i], one.x[-1])
        assert np.array_equal(many.attitude[i], one.attitude[-1])


# -- time, energies that depend on it ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["midpoint", pytest.param("gauss2", marks=pytest.mark.slow)])
def test_a_motion_that_is_turned_around_goes_back(name):
    """Without friction the motion is reversible, and symmetric methods take it back to rounding."""
    torque = lambda t, mu, g: g.T @ rotating_field(t)  # noqa: E731
    back = lambda t, mu, g: g.T @ rotating_field(SPAN[1] + SPAN[0] - t)  # noqa: E731
    there, again = (
        lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=f, group=SO3) for f in (torque, back)
    )
    run = lt.integrate(there, START, SPAN, 0.05, METHODS[name], engine="compiled")
    returned = lt.integrate(again, -run.x[-1], SPAN, 0.05, METHODS[name], attitude=run.attitude[-1], engine="compiled")
    assert np.abs(returned.x[-1] + START).max() < 1e-13
    assert np.abs(returned.attitude[-1] - np.eye(3)).max() < 1e-13
    assert abs(returned.casimirs["work"][-1] + run.casimirs["work"][-1]) < 1e-13


@pytest.mark.slow
def test_an_energy_that_depends_on_time_has_an_attitude():
    """Its momentum in space is constant, since no torque acts; with one its impulse is taken off."""
    swelling = lambda mu, t: jnp.sum(mu**2 / (INERTIA * (1.0 + 0.2 * jnp.sin(t)))) / 2  # noqa: E731
    run = lt.integrate(
        lt.LiePoissonSystem(mf.so(3), swelling, group=SO3), START, SPAN, 0.05, METHODS["gauss2"], engine="compiled"
    )
    assert run.audit().passed
    assert run.audit().energy_drift <= LAW
    assert row(run, "drift of momentum in space").value <= LAW
    pushed = lt.LiePoissonSystem(mf.so(3), swelling, group=SO3, torque=TORQUES["space"])
    both = lt.integrate(pushed, START, SPAN, 0.05, METHODS["gauss2"], engine="compiled")
    assert both.audit().passed
    assert row(both, "drift of momentum in space less the impulse").value <= LAW


# -- ensembles, flows, files -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_ensemble_over_a_parameter_is_single_runs():
    """To the last bit, with equal steps and with adaptive ones; work and impulse too."""
    rates, method = np.linspace(0.3, 0.8, 3), METHODS["gauss2"]
    system = rubbing(TORQUES["gravity gradient"])
    for step in (0.1, lt.Adaptive(1e-7)):
        many = lt.ensemble(system, START, SPAN, step, method, parameters={"torque.mean_motion": rates})
        assert many.provenance["engine"] == "compiled"
        one = lt.integrate(
            rubbing(lt.torques.GravityGradient(INERTIA, rates[2])), START, SPAN, step, method, engine="compiled"
        )
        assert np.array_equal(many.x[2], one.x[-1])
        assert np.array_equal(many.attitude[2], one.attitude[-1])
        assert many.work[2] == one.casimirs["work"][-1]
        assert many[2].casimirs["impulse 1"][-1] == one.casimirs["impulse 1"][-1]
        assert many.audit().passed, many.audit()


@pytest.mark.slow
def test_a_flow_is_differentiated_by_a_parameter():
    def end(rate):
        return lt.flow(rubbing(lt.torques.GravityGradient(INERTIA, rate), warm=False), START, (0.3, 1.3), 0.1)

    slope = jax.jacfwd(end)(0.5)
    quotient = (end(0.5 + 1e-5) - end(0.5 - 1e-5)) / 2e-5
    assert np.abs(slope - quotient).max() < 1e-8
    assert np.abs(slope).max() > 0.01


def test_files_provenance_and_dense_output(tmp_path):
    system = rubbing(TORQUES["gravity gradient"])
    run = lt.integrate(system, START, SPAN, lt.Adaptive(1e-8), METHODS["gauss2"], dense=True, engine="array")
    assert run.provenance["torque"] == "GravityGradient"
    assert run.provenance["dissipation"] == type(system.dissipation).__name__
    assert run.provenance["system"] == "LiePoissonSystem"
    assert np.abs(run(run.t) - run.x).max() < 1e-14
    loaded = lt.load(run.save(tmp_path / "torque.nc"))
    assert loaded.laws == run.laws
    assert str(loaded.audit()) == str(run.audit())
    assert np.array_equal(loaded.casimirs["impulse 2"], run.casimirs["impulse 2"])
    assert "torque" not in lt.integrate(system.drop_torque(), START, (0.0, 0.1), 0.1).provenance


def test_what_the_user_asks_of_a_system():
    system, attitude = rubbing(TORQUES["space"], warm=False), np.asarray(SO3.exp(np.array([0.4, -0.2, 0.7])))
    here = system.at_time(0.5, attitude)
    expected_values = np.asarray(system.drop_torque().vector_field(START)) + attitude.T @ [0.1, 0.2, -0.1]
    assert np.allclose(here.vector_field(START), expected_values, rtol=1e-14)
    timed = rubbing(lambda t, mu: t * mu, warm=False)
    assert np.allclose(timed.vector_field(START, 2.0), timed.drop_torque().vector_field(START) + 2.0 * START)
    assert system.check().passed
    assert rubbing(TORQUES["space"]).entropy_law == "nondecreasing"
    own = lt.LiePoissonSystem(
        mf.so(3),
        lt.Quadratic(1.0 / INERTIA),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.1),
        torque=TORQUES["body"],
    )
    assert own.entropy_law is None, "a torque changes an entropy of momenta"
    assert lt.integrate(own, START, (0.0, 1.0), 0.1).audit().passed
    assert lt.suggest_step(system, START) < 1.0


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (
            lambda: lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.ones(3)), torque=TORQUES["space"]),
            "Give the system a group",
        ),
        (lambda: rubbing(lambda t, mu: mu[:2]), r"shape \(3,\).*got float64 of shape \(2,\)"),
        (lambda: rubbing(lambda t: t), r"shape \(3,\).*got float64 of shape \(\)"),
        (lambda: rubbing(lambda a, b, c, d, e: b), "needs 5 arguments"),
        (lambda: rubbing(3.0), "got float"),
        (lambda: rubbing([]), "empty list"),
        (lambda: rubbing(lambda t, mu: mu @ jnp.ones(4)), "could not be evaluated"),
        (lambda: rubbing(TORQUES["space"]).vector_field(START, 0.0), "a time and the attitude"),
        (lambda: rubbing(TORQUES["body"]).vector_field(START), "Give the time"),
        (lambda: lt.integrate(rubbing(TORQUES["space"]), START, SPAN, 0.1, lt.Reference()), "cannot integrate"),
        (lambda: lt.torques.ConstantInSpace([1.0, 2.0]), r"shape \(3,\), got \(2,\)"),
        (lambda: lt.torques.Magnetic([np.nan, 0.0, 0.0], np.ones(3)), "must be finite"),
        (lambda: lt.torques.GravityGradient(INERTIA, -1.0), "must be positive"),
        (lambda: lt.torques.GravityGradient(np.ones(4), 1.0), r"got \(4,\)"),
        (lambda: lt.torques.GravityGradient(INERTIA, 1.0, normal=(1.0, 0.0, 1.0)), "their cosine is"),
        (lambda: lt.torques.GravityGradient(INERTIA, 1.0, normal=(0.0, 0.0, 0.0)), "must be a direction"),
        (lambda: lt.torques.Tabulated([0.0, 0.0], np.zeros((2, 3))), "increase"),
        (lambda: lt.torques.Tabulated([0.0, 1.0], np.zeros((3, 3))), "moments m rows"),
    ],
)
def test_what_is_refused(build, words):
    with pytest.raises((lt.InputError, lt.FunctionError), match=words) as refused:
        build()
    assert "\n" not in str(refused.value).strip().split(": Traceback")[0]


@pytest.mark.slow
def test_a_study_of_a_torque(tmp_path):
    """Every point is a run of its own, to the last bit, where the torque depends on time and attitude."""

    def build(p):
        return rubbing(lt.torques.GravityGradient(INERTIA, p["rate"]))

    axes, common = {"rate": np.linspace(0.3, 0.6, 3)}, {"step": 0.1, "method": METHODS["gauss2"]}
    study = lt.Study(build, axes, x0=START, t_span=SPAN, measure={"end": "final"}, store=tmp_path / "s.zarr", **common)
    study.run(progress=False)
    one = lt.integrate(build({"rate": axes["rate"][1]}), START, SPAN, engine="compiled", **common)
    assert np.array_equal(np.asarray(study.results["end"])[1], one.x[-1])


@pytest.mark.slow
def test_noise_beside_a_torque():
    """Energy less work and momentum in space less impulse are exact on every path."""
    noise = lt.Fluctuations(1e-3, 1)
    run = lt.integrate(rubbing(TORQUES["space"]), START, (0.3, 2.3), 0.05, noise=noise, engine="array")
    assert run.audit().passed
    assert run.audit().energy_drift <= LAW
    assert row(run, "drift of momentum in space less the impulse").value <= LAW


@pytest.mark.parametrize("amplitude", [0.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_euler_poincare_system_with_a_torque(amplitude):
    """Compare a Lagrangian, fixed or dependent on time, under a torque with a velocity, with SciPy."""
    moments = np.array([3.0, 2.0, 1.0])

    def lagrangian(xi, t):
        return 0.5 * jnp.sum(moments * (1.0 + amplitude * jnp.cos(t)) * xi**2)

    def torque(t, mu, attitude, xi):
        return attitude.T @ jnp.array([0.1 * jnp.sin(t), 0.2, 0.0]) - 0.1 * xi

    given = lagrangian if amplitude else lt.Quadratic(moments)
    system = lt.EulerPoincareSystem(mf.so(3), given, torque=torque, group=SO3)
    run = lt.integrate(system, START, (0.0, 2.0), 0.02, lt.MetriplecticGauss(2))

    def field(t, y):
        mu, g = y[:3], y[3:].reshape(3, 3)
        xi = mu / (moments * (1.0 + amplitude * np.cos(t)))
        hat = np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [-xi[1], xi[0], 0.0]])
        tau = g.T @ np.array([0.1 * np.sin(t), 0.2, 0.0]) - 0.1 * xi
        return np.concatenate([np.cross(mu, xi) + tau, (g @ hat).ravel()])

    exact = solve_ivp(field, (0.0, 2.0), [*START, *np.eye(3).ravel()], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert np.abs(run.x[-1] - exact[:3]).max() < 1e-8
    assert np.abs(run.attitude[-1].ravel() - exact[3:]).max() < 1e-8
    assert run.audit().passed
    if not amplitude:  # the velocity needs no time, which the torque does
        np.testing.assert_allclose(system.velocity(START), START / moments, rtol=1e-15)
    assert abs(np.linalg.norm(run.x[-1]) - np.linalg.norm(START)) > 0.01  # the torque changes |mu|, a Casimir
