"""Attitudes beside momenta: orders, the group, the spatial momentum, the heavy top, files, refusals."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

INERTIA = np.array([2.0, 1.0, 2 / 3])
START = np.array([np.cos(1.1), 0.0, np.sin(1.1)])
SO3 = mf.SO(3)
TURNED = np.asarray(SO3.exp(np.array([0.4, -0.2, 0.7])))

MOMENTUM = 5e-15
"""Drift of the spatial momentum over 200 steps; at most 1e-15 seen."""

MEMBER = 1e-15
"""Distance of an attitude from the group; at most 5e-16 seen, after 10^5 steps as after one."""


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
    """Momentum and attitude by SciPy, from START and TURNED."""
    gradient, field, hat = system.energy.gradient, system.vector_field, np.asarray(SO3.algebra._known_basis())

    def rate(t, y):
        mu, R = jnp.asarray(y[:3]), y[3:].reshape(3, 3)
        turn = np.einsum("a,aij->ij", np.asarray(gradient(mu)), hat)
        return np.concatenate([np.asarray(field(mu)), (R @ turn).ravel()])

    start = np.concatenate([START, TURNED.ravel()])
    y = solve_ivp(rate, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return y[:3], y[3:].reshape(3, 3)


def spatial(solution):
    """The momentum seen from space, Ad*_{g^-1} mu."""
    return np.einsum("tij,tj->ti", solution.attitude, solution.x)


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        pytest.param("cayley", lt.MetriplecticMidpoint(), id="cayley-midpoint"),
        pytest.param("exp", lt.MetriplecticGauss(2), id="exp-gauss2", marks=pytest.mark.slow),
        *(
            pytest.param(kind, method, id=f"{kind}-{name}", marks=pytest.mark.slow)
            for kind, method, name in [
                ("exp", lt.MetriplecticMidpoint(), "midpoint"),
                ("cayley", lt.MetriplecticGauss(2), "gauss2"),
                ("exp", lt.MetriplecticGauss(3), "gauss3"),
                ("cayley", lt.MetriplecticGauss(3), "gauss3"),
            ]
        ),
    ],
)
def test_orders_of_a_relaxing_body(kind, method):
    """Order 2s in momentum and attitude, with an energy that is not quadratic."""
    system, T = body(kind, damped=True, energy=quartic), 2.0
    mu, R = reference(system, T)
    steps = {2: [40, 80, 160], 4: [20, 40, 80], 6: [6, 9, 13]}[method.order]
    errors = []
    for n in steps:
        run = lt.integrate(system, START, (0.0, T), T / n, method, engine="array", save_every=n, attitude=TURNED)
        errors.append([np.abs(run.x[-1] - mu).max(), np.abs(run.attitude[-1] - R).max()])
        assert SO3.belongs(run.attitude[-1], MEMBER)
    errors = np.array(errors)
    slopes = np.log(errors[:-1] / errors[1:]) / np.log(np.array(steps[1:]) / steps[:-1])[:, None]
    assert errors[-1].min() > 1e-12, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < 0.2).all(), (errors, slopes)


def test_the_spatial_momentum_of_a_free_body():
    """Kept to rounding by Cayley's map; control: by the exponential it is kept to the order of the method only."""
    runs = {
        kind: lt.integrate(body(kind), START, (0.0, 20.0), 0.1, engine="array", attitude=TURNED)
        for kind in ("cayley", "exp")
    }
    drifts = {kind: np.abs(spatial(run) - TURNED @ START).max() for kind, run in runs.items()}
    assert drifts["cayley"] <= MOMENTUM
    assert 1e-6 < drifts["exp"] < 1e-2
    assert np.array_equal(runs["cayley"].x, runs["exp"].x)
    assert np.array_equal(runs["cayley"].attitude[0], TURNED)
    assert runs["cayley"].audit().passed
    alone = lt.integrate(lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / INERTIA)), START, (0.0, 20.0), 0.1)
    assert np.abs(runs["cayley"].x - alone.x).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, 3])
def test_the_spatial_momentum_at_higher_order(stages):
    """Gauss collocation keeps what is bilinear, so g mu for every number of stages and every energy."""
    system = body("cayley", energy=quartic)
    run = lt.integrate(system, START, (0.0, 20.0), 0.1, lt.MetriplecticGauss(stages), attitude=TURNED)
    assert np.abs(spatial(run) - TURNED @ START).max() <= MOMENTUM


@pytest.mark.slow
def test_both_engines_and_a_long_run():
    system = body("cayley", damped=True)
    runs = [lt.integrate(system, START, (0.0, 10.0), 0.1, engine=engine) for engine in ("array", "compiled")]
    assert np.abs(runs[0].attitude - runs[1].attitude).max() < 1e-12
    long = lt.integrate(system, START, (0.0, 10_000.0), 0.1, engine="compiled", save_every=100_000)
    assert SO3.belongs(long.attitude[-1], MEMBER)


def heavy_top():
    """Momenta (l, Gamma), Gamma the vertical seen from the body; the group's rotations are the attitude of the top."""
    arm = np.array([0.1, 0.0, 1.0])
    return lt.LiePoissonSystem(
        mf.se(3), lambda m: jnp.sum(m[:3] ** 2 / INERTIA) / 2 + jnp.dot(arm, m[3:]), group=mf.SE(3)
    )


def test_the_heavy_top():
    """The vertical, turned back by the attitude, stays where it is; so does the momentum about it."""
    start = np.array([0.2, 0.1, 1.5, 0.0, np.sin(0.4), np.cos(0.4)])
    run = lt.integrate(heavy_top(), start, (0.0, 10.0), 0.05, engine="array")
    rotations = run.attitude[:, :3, :3]
    vertical = np.einsum("tij,tj->ti", rotations, run.x[:, 3:])
    assert np.abs(vertical - start[3:]).max() <= MOMENTUM
    about_it = np.sum(run.x[:, :3] * run.x[:, 3:], axis=1)
    assert np.abs(about_it - about_it[0]).max() < 1e-13
    assert np.asarray(mf.SE(3).belongs(run.attitude, 3 * MEMBER)).all()
    assert run.audit().energy_drift < 1e-13


@pytest.mark.slow
def test_complex_groups_and_files(tmp_path):
    """SU(2), whose elements are complex: twice around is once back; and a file that gives the attitudes back."""
    system = lt.LiePoissonSystem(mf.su(2), lt.Quadratic(np.ones(3)), group=mf.SU(2))
    run = lt.integrate(system, [0.0, 0.0, 1.0], (0.0, 2 * np.pi), np.pi / 200, lt.MetriplecticGauss(2), engine="array")
    assert np.abs(run.attitude[-1] + np.eye(2)).max() < 1e-7
    again = lt.load(run.save(tmp_path / "run.nc"))
    assert np.array_equal(again.attitude, run.attitude)
    su3 = lt.LiePoissonSystem(mf.su(3), lt.Quadratic(np.arange(1.0, 9.0)), group=mf.SU(3))
    run = lt.integrate(su3, np.ones(8), (0.0, 1.0), 0.1, engine="array")
    assert np.asarray(mf.SU(3).belongs(run.attitude, 1e-14)).all()


def test_what_is_refused():
    so3, H = mf.so(3), lt.Quadratic(1 / INERTIA)
    with pytest.raises(lt.InputError, match="not a group of so"):
        lt.LiePoissonSystem(so3, H, group=mf.SE(3))
    with pytest.raises(lt.InputError, match="MatrixGroup"):
        lt.LiePoissonSystem(so3, H, group=mf.SpecialOrthogonal(3))
    with pytest.raises(lt.InputError, match="'cayley' or 'exp'"):
        lt.LiePoissonSystem(so3, H, group=SO3, reconstruction="euler")
    with pytest.raises(lt.InputError, match="needs a group"):
        lt.LiePoissonSystem(so3, H, reconstruction="exp")
    with pytest.raises(mf.LieAlgebraError, match="Cayley map does not take"):
        lt.LiePoissonSystem(mf.su(3), lt.Quadratic(np.ones(8)), group=mf.SU(3), reconstruction="cayley")
    with pytest.raises(lt.InputError, match=r"not in SO\(3\): relative distance 0\.331"):
        lt.integrate(body(), START, (0.0, 1.0), 0.1, attitude=1.1 * np.eye(3))
    with pytest.raises(lt.InputError, match="system with a group"):
        lt.integrate(lt.LiePoissonSystem(so3, H), START, (0.0, 1.0), 0.1, attitude=np.eye(3))


# -- ensembles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", [pytest.param("array", marks=pytest.mark.slow), "compiled"])
def test_ensembles_carry_attitudes(engine):
    """Each as a run of its own; one attitude may be for all, and states that are not kept have none."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lt.Quadratic(1.0 / np.array([3.0, 2.0, 1.0])),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.1),
        group=mf.SO(3),
    )
    rng = np.random.default_rng(0)
    mu, g = rng.standard_normal((4, 3)), mf.SO(3).exp(rng.standard_normal((4, 3)))
    many = lt.ensemble(system, mu, (0.0, 2.0), 0.1, attitude=g, outputs="trajectory", engine=engine)
    assert (many.x.shape, many.attitude.shape) == ((4, 21, 3), (4, 21, 3, 3))
    one = lt.integrate(system, mu[2], (0.0, 2.0), 0.1, attitude=g[2])
    assert np.abs(many.attitude[2] - one.attitude).max() < 1e-13
    assert np.abs(many.x[2] - one.x).max() < 1e-13
    same = lt.ensemble(system, mu[2], (0.0, 2.0), 0.1, attitude=g, engine=engine)
    assert np.abs(same.attitude @ mf.SO(3).inverse(g) @ g[2] - same.attitude[2]).max() > 1e-3  # g acts from the left
    assert np.abs(g[2] @ mf.SO(3).inverse(g) @ same.attitude - same.attitude[2]).max() < 1e-13
    assert lt.ensemble(system, mu, (0.0, 2.0), 0.1, outputs="summary", engine=engine).attitude is None


def test_attitudes_that_cannot_be_used():
    free = lt.models.free_rigid_body()
    with pytest.raises(lt.InputError, match=r"group=mf\.SO\(3\)"):
        lt.ensemble(free, [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, attitude=np.eye(3))
    turning = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.ones(3)), group=mf.SO(3))
    with pytest.raises(lt.InputError, match="one attitude"):
        lt.integrate(turning, [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, attitude=np.stack([np.eye(3)] * 2))
    with pytest.raises(lt.InputError, match=r"not in SO\(3\)"):
        lt.ensemble(turning, np.eye(3), (0.0, 1.0), 0.1, attitude=np.stack([np.eye(3), np.eye(3), 2 * np.eye(3)]))
