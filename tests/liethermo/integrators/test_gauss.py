"""Metriplectic Gauss: its orders, both laws for every energy and entropy, preserved functions, and controls."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.integrators.tableaus import gauss_tableau
from tests.cases import EPS, TRANSCENDENTAL, energy_of, slow_case
from tests.liethermo import random_systems
from tests.liethermo.integrators.test_orders import NONLINEAR

MAX_ENTROPY_DECREASE = 4 * EPS
"""Largest decrease of the entropy in a step, relative to max |S|: roundings of S itself."""


def run(system, x0, steps, h=0.1, method=None, **options):
    """Run in the array engine: few steps are not worth compiling for."""
    method = lt.MetriplecticGauss(2) if method is None else method
    return lt.integrate(system, x0, (0.0, steps * h), h, method, **{"engine": "array"} | options)


def entropy_decrease(solution):
    """Return the largest decrease of the entropy in a step, relative to max |S|."""
    return -solution.stats.least_entropy_increment / np.abs(solution.entropy).max()


# -- order ------------------------------------------------------------------------------------------------------------

STEPS = {  # method, by its stages: the order it must have, and numbers of steps inside the asymptotic regime
    1: (2, [24, 32, 40, 56]),
    2: (4, [12, 16, 20, 28]),
    3: (6, [8, 10, 12, 16]),
    4: (8, [6, 7, 8, 10]),
    5: (10, [5, 6, 7]),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "stages"),
    [
        pytest.param(
            name,
            stages,
            id=f"{name}, order {2 * stages}",
            marks=() if (name, stages) == ("so(3)", 2) else pytest.mark.slow,
        )
        for name in NONLINEAR
        for stages in STEPS
    ],
)
def test_observed_order(name, stages):
    """The error at T, root mean square over initial states, has the right slope between three points or more.

    The mean has no accidental zeros, which the error of one state has; the rounding plateau is at 7e-15.
    """
    system, (order, steps) = NONLINEAR[name][0], STEPS[stages]
    T, rng = 4.0 if system.dim == 3 else 2.0, np.random.default_rng(0)
    x0s = rng.standard_normal((8, system.dim))
    x0s *= 1.3 / np.linalg.norm(x0s, axis=1, keepdims=True)
    exact = [lt.integrate(system, x, (0.0, T), T, lt.Reference(rtol=3e-14)).x[-1] for x in x0s]
    method = lt.MetriplecticGauss(stages)
    ends = [lt.ensemble(system, x0s, (0.0, T), T / n, method, engine="array").x for n in steps]
    errors = np.sqrt([np.mean((x - np.array(exact)) ** 2) for x in ends])
    slopes = -np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert (errors > 3e-14).all(), errors
    # order 10 has three points above rounding, at steps where the next power of h still shows
    assert (np.abs(slopes - order) < max(0.2, 0.03 * order)).all(), (errors, slopes)


# -- both laws, for random systems ------------------------------------------------------------------------------------


def random_run(g, number, steps, stages=2, seed=0, **options):
    p, x0s = random_systems.parameters(g, number, seed), random_systems.states(g, number, seed)
    build, method = random_systems.family(g), lt.MetriplecticGauss(stages)
    h = 0.005  # the stiffest of the random systems has a rate of 400
    return lt.ensemble(build, x0s, (0.0, h * steps), h, method, parameters=p, outputs="summary", **options)


def assert_laws(ensemble):
    assert ensemble.ok.all(), str(ensemble)
    assert ensemble.energy_drift.max() <= 1e-14
    # S passes through zero in some systems; its terms, and so its roundings, are of order one
    assert (ensemble.least_entropy_increment >= -MAX_ENTROPY_DECREASE * np.maximum(ensemble.entropy_scale, 1.0)).all()


@pytest.mark.parametrize("engine", ["compiled", slow_case("array")])
def test_laws(engine):
    assert_laws(random_run(mf.so(3), 12, 1000, engine=engine))


@pytest.mark.slow
def test_laws_over_ten_thousand_steps():
    assert_laws(random_run(mf.so(3), 16, 10_000, engine="compiled"))


@pytest.mark.slow
def test_laws_on_a_semidirect_product():
    assert_laws(random_run(mf.se(3), 8, 100, engine="array"))


@pytest.mark.slow
@pytest.mark.parametrize("g", random_systems.ALGEBRAS, ids=lambda g: g.name)
def test_laws_of_a_thousand_systems(g):
    """The laws hold for 143 systems on each of seven algebras."""
    ensemble = random_run(g, 143, 1000, seed=1, engine="compiled")
    assert_laws(ensemble)


@pytest.mark.slow
@pytest.mark.parametrize("stages", [1, 3])
def test_laws_with_other_stages(stages):
    assert_laws(random_run(mf.so(3), 64, 1000, stages, seed=2, engine="array"))


# -- states of rest, critical points, and the relaxed state -----------------------------------------------------------


def sphere_parameters(number, **parameters):
    """Return the parameters of a rigid sphere on so(3) with S = C, with the given ones replaced."""
    p = random_systems.parameters(mf.so(3), number) | {"root": np.tile(np.eye(3), (number, 1, 1))}
    p |= {"strength": np.zeros((number, 3)), "rate": np.full(number, 0.1), "weights": np.zeros((number, 1, 4))}
    p["weights"][:, 0, 0] = 1.0
    return p | parameters


def run_family(p, x0s, steps):
    build, method = random_systems.family(mf.so(3)), lt.MetriplecticGauss(2)
    return lt.ensemble(build, x0s, (0.0, 0.05 * steps), 0.05, method, parameters=p, engine="compiled")


@pytest.mark.slow
def test_rest_stays_at_rest():
    """States with grad H = 0, grad H parallel to grad S, and axes of the body stay at rest for 10^5 steps."""
    p = sphere_parameters(16)
    p["root"][8:] = np.diag([1.0, 1.5, 2.0])
    p["weights"][:, 0, 1:] = np.random.default_rng(0).uniform(0.0, 1.0, (16, 3))
    x0s = np.random.default_rng(1).standard_normal((16, 3))
    x0s[:2] = 0.0  # both gradients vanish; in 2…7 they are parallel
    x0s[8:] = np.diag([1.0, 0.7, 0.5])[np.arange(8) % 3]
    ensemble = run_family(p, x0s, 100_000)
    assert_laws(ensemble)
    # the spheres turn about their momentum, which rounding leaves where it is; the axes include the unstable one
    assert np.abs(ensemble.x - x0s).max() <= 2e-14  # 5.4e-15 seen
    assert np.median(ensemble.iterations) <= 1.01 * 100_000
    assert ensemble.iterations.max() <= 6 * 100_000  # one of the spheres takes 4, at its rounding plateau


def chosen_level():
    """Return sixteen energies with S = (C - c)^2, starts on C = c, and the growth rates of C - c there."""
    x0s = np.random.default_rng(2).standard_normal((16, 3))
    p = sphere_parameters(16)
    p["root"][:] = np.diag([1.0, 1.5, 2.0])
    p["strength"][:] = 0.1
    p["weights"][:] = [0.0, 0.0, 0.0, 1.0]
    C = random_systems.casimirs(mf.so(3))[0]
    p["centre"] = np.array([[float(C(x))] for x in x0s])
    build = random_systems.family(mf.so(3))
    rates = []
    for i, x in enumerate(x0s):
        field = build({name: value[i] for name, value in p.items()}).vector_field
        rates.append(x @ np.asarray(jax.jacfwd(field)(jnp.asarray(x))) @ x / (x @ x))
    return p, x0s, np.array(rates)


@pytest.mark.slow
def test_no_entropy_gradient_no_friction():
    """On C = c the motion is that of the free body, until the rounding of C - c has grown.

    The stages leave the level by O(h^3). With grad S evaluated there friction would act, S would have to grow, and the
    stage equations would have no solution near the free motion.
    """
    p, x0s, rates = chosen_level()
    is_slow = rates < 1.0
    p, x0s = {name: value[is_slow] for name, value in p.items()}, x0s[is_slow]
    assert len(x0s) == 8
    with_entropy = run_family(p, x0s, 40)
    without_friction = run_family(p | {"rate": np.zeros(8)}, x0s, 40)
    assert with_entropy.ok.all()
    assert with_entropy.energy_drift.max() <= 1e-14
    assert np.sqrt(np.abs(with_entropy.entropy)).max() <= 1e-13
    assert np.abs(with_entropy.x - without_friction.x).max() <= 1e-12
    assert np.abs(without_friction.x - x0s).max() > 0.5  # it does move


@pytest.mark.slow
def test_a_level_that_is_left_faster_than_a_step():
    """The level is an unstable rest of the friction: a deviation grows by exp(h lambda) in a step.

    No step with h lambda = 22 has a solution that goes on along the level, and the run ends with a status at once.
    Steps that resolve the growth leave the level and obey the laws.
    """
    p, x0s, rates = chosen_level()
    build, i_fastest = random_systems.family(mf.so(3)), int(np.argmax(rates))
    assert 0.05 * rates[i_fastest] > 20.0
    system = build({name: value[i_fastest] for name, value in p.items()})
    for h, code in ((0.05, "not_converged"), (0.1 / rates[i_fastest], "completed")):
        run = lt.integrate(system, x0s[i_fastest], (0.0, 2000 * h), h, lt.MetriplecticGauss(2), on_failure="return")
        assert run.status.code == code
        assert run.audit(energy=1e-14).passed or not run.status.ok
    assert run.entropy[-1] > 0.1


@pytest.mark.slow
def test_relaxed_state():
    """After relaxation there is no motion, no noise, and less work per step."""
    g = mf.so(3)
    p, x0s = random_systems.parameters(g, 16, seed=3), random_systems.states(g, 16, seed=3)
    p["rate"] = np.random.default_rng(3).uniform(0.05, 0.1, 16)
    relaxation = run_family(p, x0s, 40_000)
    relaxed_run = run_family(p, relaxation.x, 100_000)
    assert_laws(relaxation)
    assert_laws(relaxed_run)
    assert np.abs(relaxed_run.x - relaxation.x).max() <= 1e-13
    assert relaxed_run.iterations.mean() / 100_000 < relaxation.iterations.mean() / 40_000
    assert relaxed_run.iterations.max() <= 6 * 100_000  # 4.6 a step seen


# -- preserved functions ----------------------------------------------------------------------------------------------

SE3 = mf.se(3)
SE3_CASIMIRS = random_systems.casimirs(SE3)
TOP = np.array([0.4, -0.3, 1.2, 0.3, 0.2, 0.9])


def heavy_top(friction=True):
    """Return Lagrange's top in a field that is not uniform, with the entropy l.p and |p|^2 conserved."""
    kinetic, weight = lt.Quadratic(np.array([1.0, 0.8, 0.5, 0.0, 0.0, 0.0])), lambda m: m[5] + 0.3 * jnp.cos(2.0 * m[3])
    S = next(C for C in SE3_CASIMIRS if C(np.array([0.0, 0, 0, 1, 1, 1])) == 0.0)  # l.p vanishes where l does
    preserved_casimir = next(C for C in SE3_CASIMIRS if C is not S)
    dissipation = lt.ProjectedMetric(preserve=(preserved_casimir,), normalized=True, rate=0.1) if friction else None
    return (
        lt.LiePoissonSystem(SE3, kinetic + weight, lambda m: S(m) + 0.1 * S(m) ** 3, dissipation),
        preserved_casimir,
        S,
    )


@pytest.mark.slow
def test_heavy_top_with_friction():
    """The energy and |p|^2 are constant to rounding, and l.p grows."""
    system, casimir, S = heavy_top()
    solution = run(system, TOP, 400, method=lt.MetriplecticGauss(2, preserve=lambda m: jnp.exp(casimir(m))))
    lengths = np.array([float(casimir(x)) for x in solution.x])
    assert solution.audit(energy=1e-14, entropy=MAX_ENTROPY_DECREASE).passed, str(solution.audit())
    assert np.abs(lengths - lengths[0]).max() <= 4e-15 * abs(lengths[0])
    assert float(S(solution.x[-1])) > float(S(TOP)) + 0.1


@pytest.mark.slow
def test_free_heavy_top():
    """The energy and both Casimirs are constant to rounding."""
    system, casimir, S = heavy_top(friction=False)
    solution = run(system, TOP, 400, method=lt.MetriplecticGauss(2, preserve=(casimir, S)))
    for C in (casimir, S):
        values = np.array([float(C(x)) for x in solution.x])
        assert np.abs(values - values[0]).max() <= 1e-14
    assert solution.audit().energy_drift <= 1e-14


@pytest.mark.slow
def test_a_cubic_casimir():
    """The Gauss methods hold the cubic Casimir of su(3) without request; the midpoint scheme does not."""
    g, x0 = mf.su(3), random_systems.states(mf.su(3), 1)[0]
    cubic = g.casimirs(3)[0]
    system = lt.LiePoissonSystem(g, lambda m: jnp.sum(m**2 * jnp.arange(1.0, 9.0)) / 8 + 0.1 * jnp.sin(m[0] * m[4]))

    def drift(method):
        values = np.array([float(cubic(x)) for x in run(system, x0, 50, 0.3, method).x])
        return np.abs(values - values[0]).max()

    assert drift(lt.MetriplecticGauss(1)) <= 1e-14
    assert drift(lt.MetriplecticGauss(1, preserve=cubic)) <= 1e-14
    assert drift(lt.MetriplecticMidpoint()) > 1e-6


def body(entropy=lambda m: jnp.log(1.0 + jnp.dot(m, m)), rate=0.3):
    def energy(m):
        return 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.1 * m[0] ** 4 + 0.05 * jnp.cos(m[1] + 2.0 * m[2])

    friction = None if rate is None else lt.ProjectedMetric(rate=rate)
    return lt.LiePoissonSystem(mf.so(3), energy, entropy, friction)


@pytest.mark.slow
def test_dependent_and_vanishing_constraints():
    """Functions that depend on each other, or whose gradient is zero along the motion, change nothing."""
    system, x0 = body(lt.Quadratic(np.ones(3)), rate=None), np.array([0.8, 0.5, 0.9])
    C = lambda m: jnp.dot(m, m)  # noqa: E731
    affine_C, squared_C = lambda m: 2.0 * C(m) + 1.0, lambda m: (C(m) - C(x0)) ** 2
    exp_C = lambda m: jnp.exp(C(m))  # noqa: E731  # a function of C that collocation does not keep by itself
    reference = run(system, x0, 100, method=lt.MetriplecticGauss(2, preserve=exp_C))
    functions = (C, affine_C, squared_C, exp_C)
    solution = run(system, x0, 100, method=lt.MetriplecticGauss(2, preserve=functions))
    assert solution.audit(energy=1e-14).passed, str(solution.audit())
    assert np.abs(solution.x - reference.x).max() <= 1e-13
    assert np.abs(reference.x - x0).max() > 0.5


def test_functions_that_cannot_be_preserved():
    def size(m):
        return jnp.dot(m, m)

    with pytest.raises(lt.InputError, match=r"does not conserve the preserved function size.*ProjectedMetric"):
        run(body(), [0.8, 0.5, 0.9], 1, method=lt.MetriplecticGauss(2, preserve=size))
    motionless = lt.MetriplecticSystem(np.zeros((2, 2)), lambda x: x[0] + x[1] ** 2, dim=2)
    with pytest.raises(lt.InputError, match="no motion remains in 2 dimensions"):
        run(motionless, [0.1, 0.2], 1, method=lt.MetriplecticGauss(2, preserve=lambda x: x[1]))
    with pytest.raises(lt.FunctionError, match="must return one number"):
        run(body(), [0.8, 0.5, 0.9], 1, method=lt.MetriplecticGauss(2, preserve=lambda m: m))


@pytest.mark.parametrize("stages", [0, 9, 2.0, True, "2"])
def test_stages_are_one_to_eight(stages):
    with pytest.raises(lt.InputError, match="integer from 1 to 8"):
        lt.MetriplecticGauss(stages)


def test_order_stages_and_name():
    method = lt.MetriplecticGauss(3, preserve=lambda m: m[0])
    assert (method.order, method.stages) == (6, 3)
    assert {"energy", "entropy_law", "casimirs"} == method.preserves
    assert str(method) == "MetriplecticGauss(stages=3, preserve=1 functions)"


# -- the parts of the construction, each of which matters -------------------------------------------------------------


@pytest.mark.slow
def test_one_stage_is_the_midpoint_scheme():
    """With one stage and a quadratic S the method is the midpoint scheme with Gonzalez' gradient."""
    system, x0 = body(lt.Quadratic(np.ones(3))), np.array([0.8, 0.5, 0.9])
    one, midpoint = (run(system, x0, 50, method=m) for m in (lt.MetriplecticGauss(1), lt.MetriplecticMidpoint()))
    assert np.abs(one.x - midpoint.x).max() <= 1e-14
    assert np.abs(one.x[-1] - x0).max() > 0.1


class Collocation(lt.MetriplecticGauss):
    """Control: collocation without the correction alpha."""

    def slopes(self, system, x, compensation, h, k):
        return jax.vmap(system.vector_field)(x + (compensation + h * (gauss_tableau(self.number).A @ k)))


class UnprojectedGauss(lt.MetriplecticGauss):
    """Control: Gauss steps without the projector, so that the motion changes the entropy."""

    def _conservative_slope(self, system, u, dH, gradients_by_name):
        return system.poisson.sharp(u, dH)


@pytest.mark.slow
def test_without_the_correction_the_energy_drifts():
    x0 = np.array([0.8, 0.5, 0.9])
    drifts = [
        run(body(rate=0.01), x0, 100, method=m).audit().energy_drift for m in (lt.MetriplecticGauss(2), Collocation(2))
    ]
    assert drifts[0] <= 2e-15
    assert drifts[1] > 1e-10


@pytest.mark.slow
def test_without_the_projector_the_entropy_falls():
    """Bianchi VI has a Casimir that is no polynomial; with little friction the motion decides the sign."""
    g = mf.bianchi("VI", h=-0.5)
    S, x0 = TRANSCENDENTAL[g.name]

    def H(m):
        return 0.5 * jnp.sum((m - jnp.array([0.0, 1.5, 0.2])) ** 2) + 0.1 * jnp.cos(2.0 * m[0])

    system = lt.LiePoissonSystem(g, H, S, lt.ProjectedMetric(rate=1e-9), validate=False)
    with_projector, control = (run(system, x0, 100, method=m) for m in (lt.MetriplecticGauss(1), UnprojectedGauss(1)))
    assert entropy_decrease(with_projector) <= MAX_ENTROPY_DECREASE
    assert entropy_decrease(control) > 1e-9
    assert control.audit().energy_drift <= 1e-14  # the first law does not need it


def test_casimirs_whose_gradients_depend_on_each_other():
    """On small orbits of su(3), with two equal eigenvalues, all Casimirs are constant without a projector."""
    g = mf.su(3)
    inertia = np.random.default_rng(1).normal(size=(8, 8))
    body = lt.LiePoissonSystem(g, lt.Quadratic(inertia @ inertia.T))
    matrix = np.diag([1.0, 1.0, -2.0]) * 1j
    x0 = np.array([np.trace(matrix.conj().T @ e).real for e in g.basis])
    gradients = np.stack([C.gradient(x0) for C in body.casimirs().values()])
    assert len(gradients) == 2
    assert np.linalg.matrix_rank(gradients, tol=1e-9) == 1
    run = lt.integrate(body, x0, (0.0, 0.5), 0.005, lt.MetriplecticGauss(2))
    assert run.audit().passed
    assert max(np.ptp(values) for values in run.casimirs.values()) <= 2e-15 * np.dot(x0, x0)


@pytest.mark.slow
def test_a_force_that_heats_a_bath_keeps_the_energy_while_cubic_casimirs_are_projected_off_it():
    g = mf.sl(3)
    system = lt.LiePoissonSystem(
        g, energy_of(g.dim, 0), None, lt.DoubleBracket(0.3), baths=lt.HeatBaths(capacity=2.0, temperature=1.0)
    )
    x0 = system.state(np.random.default_rng(0).standard_normal(g.dim))
    solution = lt.integrate(system, x0, (0.0, 1.0), 0.1, lt.MetriplecticGauss(2), engine="array")
    assert np.ptp(solution.energy) <= 1e-13 * np.abs(solution.energy).max()
    for values in solution.casimirs.values():
        assert np.ptp(values) <= 1e-12 * np.abs(values).max()
    assert solution.entropy[-1] > solution.entropy[0] + 1e-3
