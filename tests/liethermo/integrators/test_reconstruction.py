"""Attitudes beside momenta: orders, the group, the spatial momentum, the heavy top, files, rejected input."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.systems.transport import dissipation_keeps_spatial_momentum
from tests.cases import covering

INERTIA = np.array([2.0, 1.0, 2 / 3])
START = np.array([np.cos(1.1), 0.0, np.sin(1.1)])
SO3 = mf.SO(3)
START_ATTITUDE = np.asarray(SO3.exp(np.array([0.4, -0.2, 0.7])))

MOMENTUM_DRIFT = 5e-15
"""Largest drift of the spatial momentum over 200 steps; at most 1e-15 seen."""

GROUP_DISTANCE = 1e-15
"""Largest distance of an attitude from the group; at most 5e-16 seen, after 10^5 steps as after one."""

ORTHOGONALITY_RESIDUAL = 10.0 * np.finfo(float).eps
"""Largest residual of ``g^T g - I``: entries are up to four roundings off, twice, and products are rounded."""


def body(reconstruction=None, damped=False, energy=None) -> lt.LiePoissonSystem:
    return lt.LiePoissonSystem(
        mf.so(3),
        lt.Quadratic(1 / INERTIA) if energy is None else energy,
        lt.Quadratic(np.ones(3)) if damped else None,
        lt.KillingDissipation(0.25) if damped else None,
        group=SO3,
        reconstruction=reconstruction,
    )


def quartic(mu):
    return jnp.sum(mu**2 / INERTIA) / 2 + 0.1 * jnp.sum(mu**4)


def reference(system, T):
    """Return momentum and attitude by SciPy, from START and START_ATTITUDE."""
    field_and_velocity, hat = (
        jax.jit(lambda mu: (system.vector_field(mu), system.energy.gradient(mu))),
        SO3.algebra._require_basis(),
    )

    def rate(t, y):
        field, gradient = map(np.asarray, field_and_velocity(y[:3]))
        turn = np.einsum("a,aij->ij", gradient, np.asarray(hat))
        return np.concatenate([field, (y[3:].reshape(3, 3) @ turn).ravel()])

    start = np.concatenate([START, START_ATTITUDE.ravel()])
    y = solve_ivp(rate, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return y[:3], y[3:].reshape(3, 3)


def spatial_momenta(solution):
    """Return the spatial momentum Ad*_{g^-1} mu, shape (times, 3)."""
    return np.einsum("tij,tj->ti", solution.attitude, solution.x)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "method"),
    [
        pytest.param("cayley", lt.MetriplecticMidpoint(), id="cayley-midpoint"),
        pytest.param("exp", lt.MetriplecticGauss(2), id="exp-gauss2"),
        *(
            pytest.param(kind, method, id=f"{kind}-{name}")
            for kind, method, name in [
                ("exp", lt.MetriplecticMidpoint(), "midpoint"),
                ("cayley", lt.MetriplecticGauss(2), "gauss2"),
                ("exp", lt.MetriplecticGauss(3), "gauss3"),
                ("cayley", lt.MetriplecticGauss(3), "gauss3"),
                ("exp", lt.MetriplecticRungeKutta(4), "rk4"),
                ("exp", lt.MetriplecticRungeKutta(8), "rk8"),
            ]
        ),
        pytest.param("exp", lt.MetriplecticRungeKutta(6), id="exp-rk6"),
    ],
)
def test_orders_of_a_relaxing_body(kind, method):
    """Momentum and attitude have the order of the method, with an energy that is not quadratic."""
    system, T = body(kind, damped=True, energy=quartic), 2.0
    mu, R = reference(system, T)
    steps = {2: [40, 80, 160], 4: [20, 40, 80], 6: [6, 9, 13], 8: [5, 7, 10]}[method.order]
    steps = [2 * n for n in steps] if method.explicit and method.order < 8 else steps
    errors = []
    for n in steps:
        run = lt.integrate(
            system, START, (0.0, T), T / n, method, engine="array", save_every=n, attitude=START_ATTITUDE
        )
        errors.append([np.abs(run.x[-1] - mu).max(), np.abs(run.attitude[-1] - R).max()])
        assert SO3.belongs(run.attitude[-1], GROUP_DISTANCE)
    errors = np.array(errors)
    slopes = np.log(errors[:-1] / errors[1:]) / np.log(np.array(steps[1:]) / steps[:-1])[:, None]
    assert errors[-1].min() > 1e-12, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < (0.4 if method.explicit else 0.2)).all(), (errors, slopes)


@pytest.mark.slow
def test_the_spatial_momentum_of_a_free_body():
    """Cayley's map conserves it to rounding; control: the exponential conserves it to the order of the method."""
    runs = {
        kind: lt.integrate(body(kind), START, (0.0, 20.0), 0.1, engine="array", attitude=START_ATTITUDE)
        for kind in ("cayley", "exp")
    }
    drifts = {kind: np.abs(spatial_momenta(run) - START_ATTITUDE @ START).max() for kind, run in runs.items()}
    assert drifts["cayley"] <= MOMENTUM_DRIFT
    assert 1e-6 < drifts["exp"] < 1e-2
    assert np.array_equal(runs["cayley"].x, runs["exp"].x)
    assert np.array_equal(runs["cayley"].attitude[0], START_ATTITUDE)
    assert runs["cayley"].audit().passed
    without_attitude = lt.integrate(lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / INERTIA)), START, (0.0, 20.0), 0.1)
    assert np.abs(runs["cayley"].x - without_attitude.x).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, 3])
def test_the_spatial_momentum_at_higher_order(stages):
    """Gauss collocation preserves bilinear functions, so g mu, for any number of stages and every energy."""
    system = body("cayley", energy=quartic)
    run = lt.integrate(system, START, (0.0, 20.0), 0.1, lt.MetriplecticGauss(stages), attitude=START_ATTITUDE)
    assert np.abs(spatial_momenta(run) - START_ATTITUDE @ START).max() <= MOMENTUM_DRIFT


@pytest.mark.slow
def test_both_engines_and_a_long_run():
    system = body("cayley", damped=True)
    runs = [lt.integrate(system, START, (0.0, 10.0), 0.1, engine=engine) for engine in ("array", "compiled")]
    assert np.abs(runs[0].attitude - runs[1].attitude).max() < 1e-12
    long_run = lt.integrate(system, START, (0.0, 10_000.0), 0.1, engine="compiled", save_every=100_000)
    assert SO3.belongs(long_run.attitude[-1], GROUP_DISTANCE)


GROUPS = {"SO(3)": SO3, "SU(2)": mf.SU(2), "SE(2)": mf.SE(2), "SE(3)": mf.SE(3), "SL(2)": mf.SL(2), "SO(4)": mf.SO(4)}
ARRAY_ENGINE_GROUPS = ("SU(2)", "SE(2)")
"""Groups run by the array engine: one is complex, and the compiled exponential of the other is slow to compile."""

RELATIVE_MOMENTUM_DRIFT = 4e-14
"""Largest drift of the spatial momentum over 1000 steps, relative to its largest terms; at most 1.2e-14 seen.

The motion on SE(3) leads 20 lengths away.
"""


def free_body(name, reconstruction=None, dissipation=None):
    """Return a body with an energy that no symmetry of the group simplifies."""
    group = GROUPS[name]
    root = np.random.default_rng(0).standard_normal((group.dim, group.dim)) / group.dim
    H = lt.Quadratic(np.eye(group.dim) + root @ root.T + np.diag(np.linspace(0.0, 1.0, group.dim)))
    return lt.LiePoissonSystem(group.algebra, H, dissipation=dissipation, group=group, reconstruction=reconstruction)


def start_momentum(name):
    if name == "SL(2)":  # inside the cone, where what leaves the momentum alone is compact
        return np.array([0.3, 1.0, -0.7])
    return np.random.default_rng(1).standard_normal(GROUPS[name].dim)


def momentum_drift(name, reconstruction, method, steps, dissipation=None, holds=True):
    """Return the drift of the spatial momentum relative to its terms; assert that the audit reports the same."""
    group = GROUPS[name]
    engine = "array" if name in ARRAY_ENGINE_GROUPS else "compiled"
    system = free_body(name, reconstruction, dissipation)
    run = lt.integrate(
        system, start_momentum(name), (0.0, 0.02 * steps), 0.02, method, engine=engine, save_every=steps // 50
    )
    assert run.status.ok
    assert run.audit().passed == holds
    actions = np.asarray(group.Ad(group.inverse(run.attitude)))
    M = np.einsum("tab,ta->tb", actions, run.x)
    drift = np.abs(M - M[0]).max() / np.einsum("tab,ta->tb", np.abs(actions), np.abs(run.x)).max()
    (row,) = [row for row in run.audit().rows if row.law.endswith("momentum in space")]
    assert abs(row.value - drift) <= 1e-6 * drift + 1e-15
    return drift


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "stages"),
    [
        ("SE(3)", 1),
        ("SL(2)", 2),
        *(
            pytest.param(name, stages, marks=pytest.mark.slow)
            for name in GROUPS
            for stages in (1, 2, 3)
            if (name, stages) not in (("SE(3)", 1), ("SL(2)", 2))
        ),
    ],
)
def test_the_spatial_momentum_in_every_group_that_can_keep_it(name, stages):
    """The default reconstruction conserves it to rounding over a thousand steps; the exponential is the control."""
    method = lt.MetriplecticMidpoint() if stages == 1 else lt.MetriplecticGauss(stages)
    assert momentum_drift(name, None, method, 1000) <= RELATIVE_MOMENTUM_DRIFT
    if stages == 1:
        assert momentum_drift(name, "exp", method, 50) > 1e4 * RELATIVE_MOMENTUM_DRIFT


SURFACE_ORBIT_GROUPS = ("SO(3)", "SU(2)", "SE(2)", "SL(2)")
"""Groups with coadjoint orbits of dimension two, on which explicit methods conserve the spatial momentum."""


class ZeroVelocityBracket(lt.DoubleBracket):
    """Control: the attitude follows ``g' = g xi`` alone, as if the friction did not move the momentum."""

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        return jnp.zeros_like(dH)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "method"),
    covering(
        (
            pytest.param(name, method, id=f"{name}-{label}")
            for name in GROUPS
            for label, method in {
                "midpoint": lt.MetriplecticMidpoint(),
                "gauss2": lt.MetriplecticGauss(2),
                "gauss3": lt.MetriplecticGauss(3),
                "rk4": lt.MetriplecticRungeKutta(4),
                "rk8": lt.MetriplecticRungeKutta(8),
                "taylor": lt.MetriplecticTaylor(6),
            }.items()
            if not method.explicit or name in SURFACE_ORBIT_GROUPS
        ),
        lambda name, method: [(name, method.explicit), (method.order, method.explicit), type(method)],
    ),
)
def test_friction_inside_keeps_the_momentum_in_space(name, method):
    """Implicit and explicit methods conserve it in any group that can; the control ignores the friction."""
    metric = np.diag(np.linspace(1.0, 2.0, GROUPS[name].dim))
    rubbing = lt.DoubleBracket(0.05) + lt.DoubleBracket(0.02, metric)
    assert momentum_drift(name, None, method, 500, rubbing) <= RELATIVE_MOMENTUM_DRIFT
    control = ZeroVelocityBracket(0.05)
    if not method.explicit:
        assert momentum_drift(name, None, method, 50, control, holds=False) > 1e4 * RELATIVE_MOMENTUM_DRIFT


MATRIX_GROUPS = [mf.SO(2), mf.SO(3), mf.SO(4), mf.SO(5), mf.SE(2), mf.SE(3), mf.SU(2), mf.SU(3), mf.SL(2)]
MATRIX_GROUPS += [mf.Sp(1), mf.Sp(2), mf.GL(2), mf.Heisenberg(1), mf.Heisenberg(2)]
ADJOINT_GROUPS = {"SO(2)", "SO(3)", "SO(4)", "SE(2)", "SE(3)", "SU(2)", "SL(2)", "Sp(1)", "GL(2)", "Heisenberg(1)"}
"""Groups in which the end of collocation is an adjoint action: see :class:`~liethermo.integrators.WithAttitude`."""
ADJOINT_GROUPS |= {"Heisenberg(2)"}
"""Groups in which the end of collocation is an adjoint action: see :class:`~liethermo.integrators.WithAttitude`."""


@pytest.mark.sampled("SO(3)")
@pytest.mark.parametrize("group", [pytest.param(group, id=group.name) for group in MATRIX_GROUPS])
def test_the_momentum_in_space_of_a_body_that_heats_over_every_group(group):
    """The spatial momentum is constant to rounding, 1e-15 measured, or to the order, as the audit then says."""
    n = group.dim
    root = np.random.default_rng(0).standard_normal((n, n)) / n
    system = lt.LiePoissonSystem(
        group.algebra,
        lt.Quadratic(np.eye(n) + root @ root.T + np.diag(np.linspace(0.0, 1.0, n))),
        dissipation=lt.DoubleBracket(0.05),
        group=group,
        baths=lt.HeatBaths(2.0, 1.5),
    )
    start = np.array([0.3, 1.0, -0.7]) if n == 3 else np.random.default_rng(1).standard_normal(n)
    drifts = []
    for step in (0.04, 0.02):
        run = lt.integrate(system, start / np.linalg.norm(start), (0.0, 1.0), step, engine="array")
        (row,) = [row for row in run.audit().rows if row.law == "drift of momentum in space"]
        assert row.passed is (True if group.name in ADJOINT_GROUPS else None)
        assert np.abs(run.energy - run.energy[0]).max() <= 4e-15 * np.abs(run.energy).max()
        assert run.entropy[-1] > run.entropy[0] or n == 1  # of SO(2) nothing moves the momentum
        drifts.append(row.value)
    if group.name in ADJOINT_GROUPS:
        assert max(drifts) < 5e-15
    else:
        assert 1e-12 < drifts[1] < 0.3 * drifts[0] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GROUPS if name not in SURFACE_ORBIT_GROUPS])
def test_explicit_methods_conserve_spatial_momentum_to_their_order(name):
    """The audit does not claim more: near orbits of fewer dimensions explicit methods cannot conserve it."""
    system, drifts = free_body(name, dissipation=lt.DoubleBracket(0.05)), []
    for step in (0.04, 0.02):
        run = lt.integrate(system, start_momentum(name), (0.0, 2.0), step, lt.MetriplecticRungeKutta(4))
        (row,) = [row for row in run.audit().rows if row.law == "drift of momentum in space"]
        assert row.passed is None
        drifts.append(row.value)
    assert 1e-13 < drifts[1] < drifts[0] / 8.0 < 1e-5
    spinning = np.where(np.arange(system.dim) < 3, start_momentum(name), 0.0)
    assert lt.integrate(system, spinning, (0.0, 1.0), 0.02, lt.MetriplecticRungeKutta(4)).audit().passed


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SL(2)", *(n for n in ("SU(2)", "SE(3)"))])
def test_cayley_on_the_matrices_does_not_conserve_spatial_momentum(name):
    """The former default: "g mu" is the coadjoint action of SO(3) and SE(2) alone."""
    assert momentum_drift(name, "cayley", lt.MetriplecticMidpoint(), 50) > 1e4 * RELATIVE_MOMENTUM_DRIFT


def group_reference(system, mu, T):
    """Return the attitude at T by SciPy, from structure constants and matrices alone."""
    C, E = system.algebra.structure_constants, system.algebra.basis
    n, m, A = len(E), E.shape[1], np.asarray(system.energy.A)

    def rate(t, y):
        mu, g = y[:n].real, y[n:].reshape(m, m)
        xi = A @ mu
        return np.concatenate([np.einsum("abc,a,c->b", C, xi, mu), (g @ np.einsum("a,aij->ij", xi, E)).ravel()])

    start = np.concatenate([mu, np.eye(m).ravel()]).astype(E.dtype)
    y = solve_ivp(rate, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return y[n:].reshape(m, m)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param("SL(2)", lt.MetriplecticGauss(2), id="SL(2)-gauss2"),
        pytest.param("SE(3)", lt.MetriplecticMidpoint(), id="SE(3)-midpoint"),
        *(
            pytest.param(name, method, id=f"{name}-{method.order}", marks=pytest.mark.slow)
            for name in ("SO(3)", "SU(2)", "SE(2)", "SO(4)")
            for method in (lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2))
        ),
    ],
)
def test_the_order_of_the_coadjoint_reconstruction(name, method):
    system, T = free_body(name, "coadjoint"), 1.0
    reference_attitude = group_reference(system, start_momentum(name), T)
    steps, errors = ([40, 80, 160] if method.order == 2 else [10, 20, 40]), []
    for n in steps:
        engine = "array" if name in ARRAY_ENGINE_GROUPS else "compiled"
        run = lt.integrate(system, start_momentum(name), (0.0, T), T / n, method, engine=engine, save_every=n)
        errors.append(np.abs(run.attitude[-1] - reference_attitude).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] > 1e-12, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < 0.2).all(), (errors, slopes)


# -- friction inside, units --------------------------------------------------------------------------------------------


def rubbing_body(scale=1.0, kind=None, rate=0.01):
    """Return a body with internal friction, with inertia and momentum in units ``scale`` times as small."""
    inertia = scale * np.array([3.2, 3.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3),
        lt.Quadratic(1.0 / inertia),
        dissipation=lt.DoubleBracket(rate / scale),
        group=SO3,
        reconstruction=kind,
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(6)], ids=str)
def test_the_attitude_of_a_rubbing_body(method):
    """The attitude follows SciPy's solution of ``g' = g (xi + rate mu x xi)`` at the order of the method."""
    rate, inertia, start, T = 0.1, np.array([3.2, 3.0, 1.0]), np.array([0.8, 0.5, 1.3]), 4.0

    def motion(t, y):
        mu, g = y[:3], y[3:].reshape(3, 3)
        full = mu / inertia + rate * np.cross(mu, mu / inertia)
        return np.concatenate([np.cross(mu, full), (g @ np.cross(np.eye(3), full)).ravel()])

    exact = solve_ivp(motion, (0.0, T), [*start, *np.eye(3).ravel()], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for n in (20, 40, 80):
        run = lt.integrate(rubbing_body(rate=rate), start, (0.0, T), T / n, method, save_every=n)
        errors.append(np.abs(run.attitude[-1] - exact[3:].reshape(3, 3)).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert 1e-12 < errors[-1] < 1e-4
    assert (slopes > method.order - 0.5).all(), (errors, slopes)


UNIT_TEST_METHODS = {
    **{f"midpoint-{kind}": (lt.MetriplecticMidpoint(), kind) for kind in ("coadjoint", "cayley", "exp")},
    **{
        f"gauss{s}-{kind}": (lt.MetriplecticGauss(s), kind)
        for s in (1, 2, 3, 4)
        for kind in ("coadjoint", "cayley", "exp")
    },
    **{f"rk{order}": (lt.MetriplecticRungeKutta(order), None) for order in (4, 6, 8)},
    "taylor": (lt.MetriplecticTaylor(6), None),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "kind", "engine", "step"),
    covering(
        (
            pytest.param(method, kind, engine, step, id=f"{name}-{engine}-{how}")
            for name, (method, kind) in UNIT_TEST_METHODS.items()
            for engine in ("compiled", "array")
            for how, step in {"fixed": 0.3, "adaptive": lt.Adaptive(1e-9 if method.order > 2 else 1e-6)}.items()
        ),
        lambda method, kind, engine, step: [(str(method), kind), (type(method), engine, step == 0.3), (kind, engine)],
    ),
)
def test_the_unit_of_momentum_does_not_turn_the_body(method, kind, engine, step):
    """Momenta of 1e20 and of 1e-20 beside attitudes of size 1: a common tolerance would spoil one of them."""
    start, T = np.array([0.3, 0.01, 1.0]), 300.0 if engine == "compiled" else 10.0
    runs = []
    for scale in (1.0, 2.0**66, 2.0**-66):
        system = rubbing_body(scale, kind, rate=1e-4)
        run = lt.integrate(system, scale * start, (0.0, T), step, method, engine=engine)
        audit = run.audit()
        assert audit.passed
        assert audit.resolved is not None
        assert run.stats.attitude_residual <= ORTHOGONALITY_RESIDUAL
        runs.append(run)
    unit_run, *scaled_runs = runs
    for run in scaled_runs:
        assert run.stats.steps == unit_run.stats.steps
        assert np.abs(run.attitude - unit_run.attitude).max() <= 1e-13


def test_a_torque_moves_the_momentum_in_space(tmp_path):
    """The audit, and a file, say whether the spatial momentum is constant."""
    torque = lt.integrate(body(damped=True), START, (0.0, 5.0), 0.1)
    (row,) = [row for row in torque.audit().rows if "in space" in row.law]
    assert (row.law, row.passed) == ("change of momentum in space", None)
    assert row.value > 1e-2
    assert "torque" in row.note
    loaded = lt.load(torque.save(tmp_path / "run.nc"))
    assert loaded.stats.spatial_momentum_change == torque.stats.spatial_momentum_change
    dissipation_sum = lt.DoubleBracket(0.1) + lt.KillingDissipation(0.1)
    sum_system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1 / INERTIA), lt.Quadratic(np.ones(3)), dissipation_sum, group=SO3
    )
    assert not dissipation_keeps_spatial_momentum(sum_system)
    assert dissipation_keeps_spatial_momentum(rubbing_body())
    exp_run = lt.integrate(rubbing_body(kind="exp"), START, (0.0, 5.0), 0.1)
    (row,) = [row for row in exp_run.audit().rows if "in space" in row.law]
    assert (row.law, row.passed) == ("drift of momentum in space", None)
    assert 1e-8 < row.value < 1e-2


# -- explicit methods -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(6), lt.MetriplecticTaylor(6)], ids=str)
@pytest.mark.parametrize("name", GROUPS)
def test_explicit_methods_turn_every_group_at_their_order(name, method):
    """For any reconstruction of the system they agree with SciPy, and the element stays in its group to rounding."""
    (T, min_steps), system = {"SL(2)": (1.0, 18), "SU(2)": (3.0, 9)}.get(name, (1.0, 6)), free_body(name)
    reference_attitude = group_reference(system, start_momentum(name), T)
    steps, errors = [min_steps, 3 * min_steps // 2, 13 * min_steps // 6], []
    for n in steps:
        run = lt.integrate(system, start_momentum(name), (0.0, T), T / n, method, engine="array", save_every=n)
        errors.append(np.abs(run.attitude[-1] - reference_attitude).max())
        assert run.audit().passed
        assert run.stats.attitude_residual < 1e-14
    slopes = np.diff(np.log(errors)) / -np.diff(np.log(steps))
    assert errors[-1] > 1e-12, "at the rounding plateau nothing is measured"
    assert (slopes > method.order - 0.5).all(), (errors, slopes)


@pytest.mark.slow
def test_explicit_attitudes_in_every_kind_of_run():
    """Both engines, an ensemble and adaptive steps agree; the momenta are those without an attitude."""
    system, method, T = body(damped=True), lt.MetriplecticRungeKutta(8), 2.0
    mu, R = reference(system, T)
    array_run, compiled_run = (
        lt.integrate(system, START, (0.0, T), 0.1, method, engine=engine, attitude=START_ATTITUDE)
        for engine in ("array", "compiled")
    )
    assert np.abs(array_run.attitude - compiled_run.attitude).max() < 1e-14
    momentum_system = lt.LiePoissonSystem(mf.so(3), system.energy, system.entropy, system.dissipation)
    without_attitude = lt.integrate(momentum_system, START, (0.0, T), 0.1, method)
    assert np.abs(without_attitude.x - compiled_run.x).max() < 1e-14
    ensemble = lt.ensemble(system, [START, 1.1 * START], (0.0, T), 0.1, method, attitude=START_ATTITUDE)
    assert np.array_equal(ensemble.attitude[0], compiled_run.attitude[-1])
    adaptive = lt.integrate(system, START, (0.0, T), lt.Adaptive(1e-10), method, attitude=START_ATTITUDE)
    assert np.abs(adaptive.x[-1] - mu).max() < 1e-9
    assert np.abs(adaptive.attitude[-1] - R).max() < 1e-8
    assert adaptive.audit().passed
    rough = body(energy=lambda mu: jnp.sum(mu**2 / INERTIA) / 2 + jnp.abs(mu[0]) ** 3)
    with pytest.raises(lt.LiethermoError, match="needs Taylor series"):
        lt.integrate(rough, START, (0.0, T), 0.1, lt.MetriplecticTaylor(6))


# -- groups of one's own ----------------------------------------------------------------------------------------------


def unimodular(algebra, **maps):
    """Return a user-defined group of matrices with determinant 1."""
    return mf.MatrixGroup("mine", algebra, lambda g: jnp.abs(jnp.linalg.det(g) - 1.0), **maps)


@pytest.mark.slow
def test_an_attitude_stays_in_a_group_of_ones_own():
    """Cayley's map leaves SL(3), and no one has said so: the default is the exponential, and Cayley is rejected."""
    group, H = unimodular(mf.sl(3)), lt.Quadratic(np.arange(1.0, 9.0))
    system = lt.LiePoissonSystem(group.algebra, H, group=group)
    assert system.reconstruction == "exp"
    run = lt.integrate(system, 0.3 * np.ones(8), (0.0, 1.0), 0.1, engine="array")
    assert np.abs(np.linalg.det(run.attitude) - 1.0).max() < 1e-13
    (row,) = [row for row in run.audit().rows if row.law == "attitude in group"]
    assert row.passed
    assert row.value == run.stats.attitude_residual < 1e-13
    for kind in ("cayley", "coadjoint"):
        with pytest.raises(mf.LieAlgebraError, match=r"misses by 0\.0\d+ \(tolerance 1e-10\); use exp") as info:
            lt.LiePoissonSystem(group.algebra, H, group=group, reconstruction=kind)
        assert info.value.residual > 1e-3
    with pytest.raises(mf.LieAlgebraError, match="its defect, its exp_map or the matrices"):
        lt.LiePoissonSystem(group.algebra, H, group=unimodular(group.algebra, exp_map=lambda _, x: 2.0 * np.eye(3)))


def test_the_audit_sees_an_attitude_outside_of_its_group(tmp_path):
    run = lt.integrate(body(), START, (0.0, 1.0), 0.1)
    assert run.stats.attitude_residual < 1e-15
    assert run.audit().passed
    assert lt.load(run.save(tmp_path / "run.nc")).stats.attitude_residual == run.stats.attitude_residual
    bad_run = dataclasses.replace(run, stats=dataclasses.replace(run.stats, attitude_residual=1e-2))
    assert [row.law for row in bad_run.audit().rows if row.passed is False] == ["attitude in group"]
    assert bad_run.audit(attitude=0.1).passed
    free_run = lt.integrate(lt.models.free_rigid_body(), START, (0.0, 1.0), 0.1)
    assert free_run.stats.attitude_residual is None
    assert "attitude" not in str(free_run.audit())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "kind"), [(SO3, "cayley"), (mf.SL(2), "coadjoint"), (mf.SU(2), "coadjoint"), (mf.Sp(2), "cayley")]
)
def test_the_reconstruction_chosen_for_a_group_of_ones_own(group, kind):
    """From the algebra and the distance alone, the default conserves the spatial momentum if possible."""
    user_group = mf.MatrixGroup("mine", group.algebra, group.defect)
    H = lt.Quadratic(np.linspace(1.0, 2.0, group.dim))
    system = lt.LiePoissonSystem(group.algebra, H, group=user_group)
    assert system.reconstruction == kind
    start = np.array([0.3, 1.0, -0.7, *np.zeros(7)])[: group.dim]
    run = lt.integrate(system, start, (0.0, 4.0), 0.02, save_every=10, engine="array")
    assert run.audit().passed
    M = np.asarray(user_group.Ad_star(user_group.inverse(run.attitude), run.x))
    drift = np.abs(M - M[0]).max()
    assert bool(drift <= RELATIVE_MOMENTUM_DRIFT) == (group.name != "Sp(2)")


def heavy_top():
    """Return a top with momenta (l, Gamma), where Gamma is the vertical in the body frame."""
    arm = np.array([0.1, 0.0, 1.0])
    return lt.LiePoissonSystem(
        mf.se(3), lambda m: jnp.sum(m[:3] ** 2 / INERTIA) / 2 + jnp.dot(arm, m[3:]), group=mf.SE(3)
    )


@pytest.mark.slow
def test_the_heavy_top():
    """The vertical, rotated back by the attitude, is constant; so is the momentum about it."""
    start = np.array([0.2, 0.1, 1.5, 0.0, np.sin(0.4), np.cos(0.4)])
    run = lt.integrate(heavy_top(), start, (0.0, 10.0), 0.05, engine="array")
    rotations = run.attitude[:, :3, :3]
    vertical = np.einsum("tij,tj->ti", rotations, run.x[:, 3:])
    assert np.abs(vertical - start[3:]).max() <= MOMENTUM_DRIFT
    vertical_momentum = np.sum(run.x[:, :3] * run.x[:, 3:], axis=1)
    assert np.abs(vertical_momentum - vertical_momentum[0]).max() < 1e-13
    assert np.asarray(mf.SE(3).belongs(run.attitude, 3 * GROUP_DISTANCE)).all()
    assert run.audit().energy_drift < 1e-13


def test_bad_input():
    so3, H = mf.so(3), lt.Quadratic(1 / INERTIA)
    with pytest.raises(lt.InputError, match="not a group of so"):
        lt.LiePoissonSystem(so3, H, group=mf.SE(3))
    with pytest.raises(lt.InputError, match="MatrixGroup"):
        lt.LiePoissonSystem(so3, H, group=mf.SpecialOrthogonal(3))
    with pytest.raises(lt.InputError, match="'coadjoint', 'cayley', 'exp', got 'euler'"):
        lt.LiePoissonSystem(so3, H, group=SO3, reconstruction="euler")
    with pytest.raises(lt.InputError, match="needs group="):
        lt.LiePoissonSystem(so3, H, reconstruction="exp")
    with pytest.raises(mf.LieAlgebraError, match="Cayley map does not take"):
        lt.LiePoissonSystem(mf.su(3), lt.Quadratic(np.ones(8)), group=mf.SU(3), reconstruction="cayley")
    with pytest.raises(lt.InputError, match=r"not in SO\(3\): relative distance 0\.1"):
        lt.integrate(body(), START, (0.0, 1.0), 0.1, attitude=1.1 * np.eye(3))
    with pytest.raises(lt.InputError, match="system with a group"):
        lt.integrate(lt.LiePoissonSystem(so3, H), START, (0.0, 1.0), 0.1, attitude=np.eye(3))


# -- ensembles --------------------------------------------------------------------------------------------------------
