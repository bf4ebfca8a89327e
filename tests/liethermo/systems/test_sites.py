"""Systems on copies of an algebra, site by site or of the whole, and on spaces and groups of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.projected_metric import GlobalRateWarning
from tests.manifolds.spaces.test_own_spaces import HEISENBERG, Ellipsoid
from tests.refusals import refusal_test

SITES = (3, 2)
G = mf.so(3) ** SITES
STATE = np.random.default_rng(0).standard_normal(G.shape)


def exchange(s):
    return -jnp.sum(s * jnp.roll(s, 1, axis=0)) - 0.3 * jnp.sum(s[..., 2]) + 0.1 * jnp.sum(s[..., 0] ** 4)


def entropy(s):
    return -0.5 * jnp.sum(s**2)


def system(dissipation=None, algebra=G, **named):
    return lt.LiePoissonSystem(algebra, exchange, entropy, dissipation, **named)


@pytest.mark.slow
def test_user_functions_results_and_files_have_the_shape_of_the_sites(tmp_path):
    seen = []

    def recorded_exchange(s):
        seen.append(s.shape)
        return exchange(s)

    made = lt.LiePoissonSystem(
        G, recorded_exchange, entropy, momentum_maps={"m": lambda s: jnp.sum(s[..., 2])}, validate=False
    )
    assert set(seen) == {G.shape}
    run = {"t_span": (0.0, 0.3), "step": 0.1, "engine": "array"}
    solution = lt.integrate(made, STATE, until=lambda s: s[0, 0, 0] - 1e9, dense=True, **run)
    assert solution.x.shape == (4, *G.shape)
    assert solution(0.15).shape == G.shape
    assert solution([0.1, 0.2]).shape == (2, *G.shape)
    np.testing.assert_array_equal(solution.x[0], STATE)
    back = lt.load(solution.save(tmp_path / "run.nc"))
    np.testing.assert_array_equal(back.x, solution.x)
    assert solution.to_xarray()["x"].dims == ("time", "site_1", "site_2", "component")
    flat = lt.integrate(made, STATE.ravel(), **run)
    np.testing.assert_array_equal(flat.x, solution.x)
    some = lt.ensemble(made, np.stack([STATE, 2.0 * STATE]), (0.0, 0.3), 0.1, engine="array")
    assert some.x.shape == some.x0.shape == (2, *G.shape)
    assert some[1].x.shape == (2, *G.shape)
    assert some.to_xarray()["x"].dims == ("trajectory", "site_1", "site_2", "component")
    np.testing.assert_array_equal(lt.load(some.save(tmp_path / "some.nc")).x, some.x)
    np.testing.assert_allclose(some.x[0], solution.x[-1], atol=1e-13)
    np.testing.assert_allclose(lt.flow(made, STATE, (0.0, 0.3), 0.1), solution.x[-1], atol=1e-13)


@pytest.mark.slow
def test_the_motion_is_that_of_the_same_algebra_by_constants():
    dense = mf.algebras.blocks.direct_sum_by_constants([mf.so(3)] * 6)

    def flat(x):
        return exchange(x.reshape(G.shape))

    other = lt.LiePoissonSystem(dense, flat, lambda x: -0.5 * x @ x, lt.KillingDissipation(0.2))
    here = system(lt.KillingDissipation(0.2))
    np.testing.assert_allclose(here.vector_field(STATE), other.vector_field(STATE.ravel()), atol=1e-13)
    x = np.asarray(here.state(STATE))
    np.testing.assert_allclose(here.friction_matrix(x), other.friction_matrix(x), atol=1e-13)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("form", [np.eye(3), np.diag([1.0, 2.0, 3.0])])
def test_a_form_of_one_site_acts_at_each(form):
    everywhere = np.kron(np.eye(6), form)
    for construction in (lt.InnerProductDissipation, lambda K: lt.DoubleBracket(0.3, metric=K)):
        one, all_ = (system(construction(K)).vector_field(STATE) for K in (form, everywhere))
        np.testing.assert_allclose(one, all_, atol=1e-14)


@pytest.mark.slow
def test_local_projected_metric_is_the_projected_metric_of_each_site():
    rates = np.arange(6.0).reshape(SITES)
    made = system(lt.LocalProjectedMetric(rates))
    dH, dS = np.random.default_rng(1).standard_normal((2, *G.shape))
    force = np.asarray(made.dissipation.force(made, STATE.ravel(), dH.ravel(), dS.ravel(), ())).reshape(G.shape)
    np.testing.assert_allclose(force, rates[..., None] * np.cross(dH, np.cross(dS, dH)), atol=1e-13)
    assert made.check().passed
    local, killing = system(lt.LocalProjectedMetric(0.4)), system(lt.KillingDissipation(0.2))
    np.testing.assert_allclose(local.vector_field(STATE), killing.vector_field(STATE), atol=1e-13)
    alone = lt.LiePoissonSystem(mf.so(3), lambda s: s[0] ** 4 + s[1], entropy, lt.ProjectedMetric(rate=0.7))
    same = lt.LiePoissonSystem(mf.so(3), lambda s: s[0] ** 4 + s[1], entropy, lt.LocalProjectedMetric(0.7))
    np.testing.assert_allclose(same.vector_field(STATE[0, 0]), alone.vector_field(STATE[0, 0]), atol=1e-13)


@pytest.mark.slow
def test_local_rates_do_not_depend_on_the_number_of_sites_and_global_ones_do():
    def production(dissipation, n):
        made = lt.LiePoissonSystem(
            mf.so(3) ** n, lambda s: jnp.sum(s[:, 2]) + jnp.sum(s[:, 0] ** 2), entropy, dissipation
        )
        return float(made.entropy_production(np.tile(STATE[0, 0], (n, 1)))) / n

    local = [production(lt.LocalProjectedMetric(), n) for n in (2, 20)]
    assert local[1] == pytest.approx(local[0], rel=1e-12)
    with pytest.warns(GlobalRateWarning, match="LocalProjectedMetric, which acts site by site"):
        over = [production(lt.ProjectedMetric(), n) for n in (2, 20)]
    assert over[1] == pytest.approx(10.0 * over[0], rel=1e-12)


def test_forces_are_functions_on_the_sites():
    made = system(lt.EulerPoincareForce(lambda xi: jnp.roll(xi, 1, axis=0)))
    xi = np.asarray(made.energy.gradient(STATE.ravel())).reshape(G.shape)
    np.testing.assert_allclose(
        np.reshape(made.vector_field(STATE), G.shape), np.cross(STATE + np.roll(xi, 1, axis=0), xi), atol=1e-13
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)], ids=str)
def test_laws_hold_on_many_sites(method):
    g = mf.so(3) ** 60
    x = np.random.default_rng(2).standard_normal(g.shape)
    solution = lt.integrate(system(lt.LocalProjectedMetric(0.2), g), x, (0.0, 1.0), 0.05, method, engine="array")
    assert np.ptp(solution.energy) < 1e-13 * abs(solution.energy[0])
    assert np.diff(solution.entropy).min() > 0.0
    assert solution.x.shape == (21, *g.shape)
    assert list(solution.casimirs) == ["sum of mu1**2 + mu2**2 + mu3**2"]
    assert solution.audit().passed


test_refusals = refusal_test(
    (lambda: system().state(STATE.swapaxes(0, 1)), r"shape \(3, 2, 3\), or flat \(18,\), got \(2, 3, 3\)"),
    (lambda: system().state(STATE[0]), r"shape \(3, 2, 3\), or flat \(18,\), got \(2, 3\)"),
    (lambda: system().state(np.zeros(17)), r"or flat \(18,\), got \(17,\)"),
    (lambda: system(lt.LocalProjectedMetric(np.ones(6))), r"the shape \(3, 2\) of the sites, got \(6,\)"),
    (lambda: lt.LocalProjectedMetric([1.0, -1.0]), "must be >= 0 and finite, got"),
    (lambda: system(lt.LocalProjectedMetric(1.0, np.eye(4))), r"shape \(3, 3\), got \(4, 4\)"),
    (
        lambda: system(lt.InnerProductDissipation(np.eye(4))),
        r"must have shape \(18, 18\) on \(so\(3\)\)\^3x2, got \(4, 4\)",
    ),
    (lambda: system(lt.EulerPoincareForce(lambda xi: xi[0])), r"force F must have shape \(3, 2, 3\), got \(2, 3\)"),
    (lambda: system(group=mf.SO(3)), "is not a group of"),
    error=(lt.InputError, lt.FunctionError),
)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "dissipation",
    [
        lt.LocalProjectedMetric(np.arange(6.0).reshape(SITES), np.diag([1.0, 2.0, 3.0])),
        lt.KillingDissipation(0.3),
        lt.InnerProductDissipation(np.diag([1.0, 0.0, 3.0])),
    ],
    ids=lambda d: type(d).__name__,
)
def test_factors_are_those_of_the_friction_matrix(dissipation):
    made = system(dissipation, validate=False)
    x = made.state(STATE)
    B = made.dissipation.factor(made, x, made.energy.gradient(x), ())
    columns = np.asarray(jax.vmap(B.times, out_axes=1)(np.eye(B.size)))
    np.testing.assert_allclose(columns @ columns.T, made.friction_matrix(x), atol=1e-12)


def heisenberg_system():
    """Points [[1, a, c], [0, 1, b], [0, 0, 1]]; the left-invariant fields d/da and d/dc commute, and b is a Casimir."""
    bracket = np.zeros((9, 9))
    bracket[1, 2], bracket[2, 1] = 1.0, -1.0
    return lt.MetriplecticSystem(
        bracket,
        energy=lambda g: (g[0, 1] ** 2 + g[0, 2] ** 2) / 2 + g[0, 1] ** 4 / 4 + jnp.exp(g[1, 2]),
        entropy=lambda g: g[1, 2],
        dissipation=lt.ProjectedMetric(rate=0.3),
        space=HEISENBERG,
    )


def test_a_system_on_a_group_of_ones_own():
    """The group stands for its space, and the axioms hold at random elements of it."""
    system = heisenberg_system()
    assert system.space == mf.GroupSpace(HEISENBERG)
    assert system.check().passed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "retraction"),
    [
        (lt.MetriplecticGauss, "cayley"),
        (lt.MetriplecticGauss, None),
        (lt.MetriplecticMidpoint, None),
        (lt.MetriplecticMidpoint, "midpoint_cayley"),
    ],
)
def test_a_group_of_ones_own_keeps_the_laws(method, retraction):
    system = heisenberg_system()
    start = np.array([[1.0, 0.7, -0.4], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    how = method(1, retraction=retraction) if method is lt.MetriplecticGauss else method(retraction=retraction)
    run = lt.integrate(system, start, (0.0, 2.0), 0.1, how, engine="array")
    assert run.audit().passed
    assert run.entropy[-1] > run.entropy[0] + 0.1
    assert bool(system.space.belongs(system.points(run.x), 1e-14).all())


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)], ids=str)
def test_order_on_a_space_without_geodesics(method):
    """A spin on an ellipsoid, in the chart of the projection, against the same field integrated in R^3 by SciPy."""
    from scipy.integrate import solve_ivp

    space = Ellipsoid((1.0, 2.0, 3.0))
    squares = np.array([1.0, 4.0, 9.0])

    def cross(a):
        return jnp.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])

    system = lt.MetriplecticSystem(
        lambda x: cross(x / squares), lambda x: x[2] ** 2 + 0.3 * x[0] * x[1] + 0.1 * x[0] ** 4, space=space
    )
    start, T = np.asarray(space.project(np.ones(3))), 2.0

    def rate(_, x):
        dH = [0.3 * x[1] + 0.4 * x[0] ** 3, 0.3 * x[0], 2.0 * x[2]]
        return np.cross(x / squares, dH)

    wanted = solve_ivp(rate, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for n in (20, 40, 80):
        run = lt.integrate(system, start, (0.0, T), T / n, method, engine="array", save_every=n)
        assert run.audit().passed
        errors.append(np.abs(run.x[-1] - wanted).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - method.order) < 0.2).all(), errors
