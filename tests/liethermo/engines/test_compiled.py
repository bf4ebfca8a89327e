"""The compiled engine: trajectories, statuses and work as in the array engine, and a cache that breaks no run."""

import os
import subprocess
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines import array
from liethermo.engines.choice import CompiledEngineWarning
from liethermo.engines.codes import StatusCode
from liethermo.engines.compiled import machine_code
from liethermo.engines.compiled.stepper import CompiledEngine
from liethermo.engines.rules import SolverOptions
from tests.cases import DISSIPATIONS, build, state_of

BODY = lt.models.rigid_body()
X0 = [0.001, 1.0, 0.001]


def both(system, x0, span, h, method=None, **options):
    return [
        lt.integrate(system, x0, span, h, method, engine=engine, on_failure="return", **options)
        for engine in ("array", "compiled")
    ]


def assert_same(a, b, tolerance=1e-13):
    assert (a.status.code, a.status.step, a.laws) == (b.status.code, b.status.step, b.laws)
    assert np.array_equal(a.t, b.t)
    assert np.abs(a.x - b.x).max() <= tolerance * np.abs(a.x).max()
    # the plateau is met an iteration earlier or later as rounding has it
    assert b.stats.iterations_per_step == pytest.approx(a.stats.iterations_per_step, rel=0.05)


CASES = [
    ("so(3)", "projected", "gonzalez"),
    ("so(3)", "double_bracket", "mean_value"),
    ("so(3)", "friction_operator", "symmetric_coordinate_increment"),
    ("so(3)", "projected_preserve", "gonzalez"),
    ("se(3)", "force", "gonzalez"),
    ("sl(2)", "killing", "coordinate_increment"),
    ("su(3)", "kulkarni_nomizu", "gonzalez"),
]


def cases():
    for i, case in enumerate(CASES):
        yield pytest.param(*case, marks=pytest.mark.slow if i > 0 else (), id="-".join(case))


@pytest.mark.parametrize(("algebra", "dissipation", "gradient"), list(cases()))
def test_same_trajectories(algebra, dissipation, gradient):
    g = next(g for g in (mf.so(3), mf.se(3), mf.sl(2), mf.su(3)) if g.name == algebra)
    system = build(g, next(case for case in DISSIPATIONS if case.name == dissipation))
    a, b = both(system, state_of(g, 1), (0.0, 2.0), 0.02, lt.MetriplecticMidpoint(gradient))
    assert b.provenance["engine"] == "compiled"
    assert_same(a, b, 1e-12)
    if system.energy_law == "conserved":
        assert b.audit().energy_drift <= 2e-14


def test_the_body_of_the_paper():
    a, b = both(BODY, X0, (0.0, 500.05), 0.1)
    assert_same(a, b)
    assert b.audit(energy=1e-14).passed
    assert b.entropy[-1] == pytest.approx(10 * b.energy[0], rel=1e-14)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("every", [7, 10_000])
def test_save_every(every):
    assert_same(*both(BODY, X0, (0.0, 30.05), 0.1, save_every=every))


def test_newton_on_demand():
    """Compiled where a step first asks for it, in the middle of a save interval too."""
    stiff = lt.models.rigid_body(rate=200.0)
    a, b = both(stiff, [0.1, 1.0, 0.1], (0.0, 50.0), 0.5, save_every=3)
    assert b.stats.newton_iterations > 0
    assert (a.status.code, np.array_equal(a.t, b.t)) == ("completed", True)
    assert np.abs(a.x - b.x).max() < 1e-13
    assert b.audit().passed


@pytest.mark.slow
def test_failures_are_the_same():
    too_large = lt.LiePoissonSystem(
        mf.so(3), lambda p: jnp.sum(jnp.sin(40.0 * p)), lt.Quadratic(np.ones(3)), lt.KillingDissipation()
    )
    a, b = both(too_large, [0.3, 1.0, -0.2], (0.0, 500.0), 50.0)
    assert a.status.code == b.status.code == "not_converged"
    leaves_its_domain = lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / jnp.array([10.0, 5.0, 1.0])) + 1e-3 * jnp.sqrt(1.1 - p[0]),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.5),
        validate=False,
    )
    a, b = both(leaves_its_domain, X0, (0.0, 500.0), 0.1, save_every=7)
    assert (a.status.code, a.status.step) == ("non_finite", b.status.step)
    assert str(a.status).split(" near")[0] == str(b.status).split(" near")[0]
    assert np.abs(a.x - b.x).max() < 1e-12


def test_every_engine_goes_by_the_rules_it_is_given():
    system = lt.LiePoissonSystem(mf.so(3), lambda p: jnp.sum(p**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation())
    x0, method = np.array([0.8, 0.5, 0.9]), lt.MetriplecticGauss(1)
    for engine in (CompiledEngine, array.ArrayEngine):
        hasty = engine(system, method, SolverOptions(max_fixed_point_iterations=1, max_newton_iterations=1))
        state = hasty.step(hasty.initial_run_state(x0), 0.1)
        assert int(state.status) == StatusCode.NOT_CONVERGED
        assert np.array_equal(state.x, x0)
        assert (
            int(engine(system, method).step(state_of_engine := hasty.initial_run_state(x0), 0.1).status)
            == StatusCode.COMPLETED
        )
        assert np.array_equal(state_of_engine.x, x0)


def test_rules_of_large_systems_in_machine_code():
    """A choice of all of a state at once, where a system is large, is one of numbers of the kinds that it has there."""
    for method in (lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)):
        usual = CompiledEngine(BODY, method)
        large = CompiledEngine(BODY, method, SolverOptions(matrix_free_dim=2))
        state = large.advance(large.initial_run_state(X0), 0.1, 1, 20)[0]
        assert int(state.status) == StatusCode.COMPLETED
        assert np.abs(state.x - usual.advance(usual.initial_run_state(X0), 0.1, 1, 20)[0].x).max() < 1e-14
    hasty = CompiledEngine(
        BODY,
        lt.MetriplecticGauss(1),
        SolverOptions(matrix_free_dim=2, max_fixed_point_iterations=1, max_newton_iterations=1),
    )
    failed = hasty.step(hasty.initial_run_state(X0), 0.1)
    assert int(failed.status) == StatusCode.NOT_CONVERGED
    assert np.array_equal(failed.x, X0)


def test_what_takes_minutes_to_compile_is_said(monkeypatch):
    monkeypatch.setattr("liethermo.engines.choice.SLOW_COMPILE_OPERATIONS", 2)
    with pytest.warns(CompiledEngineWarning, match=r"takes minutes to compile\. Leave out engine"):
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1, engine="compiled")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1)


def test_code_is_optimised_once_many_steps_are_taken(tmp_path, monkeypatch):
    """Not for a few, nor for those that are found on disk; and the numbers are the same to the bit."""
    made = []
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path))
    compile_it = machine_code._compile_module
    monkeypatch.setattr(machine_code, "_compile_module", lambda text, hasty: made.append(hasty) or compile_it(text, hasty))
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda x: jnp.sum((1.3 + x**2) ** 1.37) + jnp.exp(0.3 * x[0]) * jnp.sin(x[1]) + (0.5 + x[2] ** 2) ** 0.5,
        mf.so(3).casimirs(2)[0],
        lt.ProjectedMetric(rate=0.1),
    )

    def run(steps):
        return lt.integrate(system, X0, (0.0, 20.0), 20.0 / steps, lt.MetriplecticRungeKutta(4), engine="compiled").x

    few = run(400)
    assert made == [True]
    run(4_000)
    assert made == [True, False]
    assert np.array_equal(run(400), few)
    assert made == [True, False]


@pytest.mark.slow
def test_parameters_are_arguments(monkeypatch):
    """A sweep over inertias and rates compiles once; another pattern of zeros is another program."""
    loaded = []
    compile_it = machine_code._compile_module
    monkeypatch.setattr(machine_code, "_compile_module", lambda *a: loaded.append(a[0]) or compile_it(*a))
    for inertia, rate in [((9.0, 4.0, 2.0), 0.3), ((7.0, 3.0, 1.0), 0.4), ((5.0, 4.0, 3.0), 0.5)]:
        system = lt.models.rigid_body(inertia, rate)
        a, b = both(system, X0, (0.0, 5.0), 0.1)
        assert_same(a, b)
    assert len(loaded) <= 1
    assert_same(*both(lt.models.rigid_body((9.0, 4.0, 2.0), rate=0.0), X0, (0.0, 5.0), 0.1))

    class Quartic(eqx.Module):
        strength: jax.Array

        def __call__(self, mu):
            return 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0])) + self.strength * mu[0] ** 4

    loaded.clear()
    for strength in (0.1, 0.7):
        system = lt.LiePoissonSystem(mf.so(3), Quartic(jnp.asarray(strength)), lt.Quadratic(np.ones(3)))
        assert_same(*both(system, [0.5, 1.0, 0.2], (0.0, 5.0), 0.1), tolerance=1e-12)
    assert len(loaded) == 1


def unsupported():
    def energy(mu):
        return jnp.sum(jnp.abs(jnp.fft.fft(mu)) ** 2 * jnp.array([1.0, 2.0, 3.0]))

    return lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), validate=False)


@pytest.mark.slow
def test_what_cannot_be_compiled(monkeypatch):
    with pytest.raises(lt.LiethermoError, match="JAX primitive"):
        lt.integrate(unsupported(), [0.5, 1.0, 0.2], (0.0, 1.0), 0.1, engine="compiled")
    with pytest.warns(UserWarning, match=r"JAX primitive.*array engine"):
        solution = lt.integrate(unsupported(), [0.5, 1.0, 0.2], (0.0, 1.0), 0.1)
    assert solution.provenance["engine"] == "array"


@jax.custom_jvp
def slope_of_fourth_power(mu):
    return mu**3


@slope_of_fourth_power.defjvp
def _slope_rule(primals, tangents):
    ((mu,), (d,)) = primals, tangents
    return mu**3, 3.0 * mu**2 * d + 0.0 * jnp.sum(jnp.fft.fft(mu).real)


@jax.custom_jvp
def fourth_power(mu):
    return 0.25 * jnp.sum(mu**4)


fourth_power.defjvp(
    lambda primals, tangents: (fourth_power(*primals), jnp.dot(slope_of_fourth_power(*primals), *tangents))
)


@pytest.mark.slow
@pytest.mark.parametrize("adaptive", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_newtons_method_that_cannot_be_compiled(adaptive):
    """Its program is made when a step first needs it: with the second derivative of the energy."""
    stiff = lt.LiePoissonSystem(mf.so(3), fourth_power, lt.Quadratic(np.ones(3)), lt.KillingDissipation(2.0))
    # the first steps are easy, the rest are not
    step = {"step": 1.0, "save_at": [3.0, 6.0]} if adaptive else {"step": 1.0}
    with pytest.warns(UserWarning, match=r"JAX primitive.*array engine"):
        solution = lt.integrate(stiff, [1.5, 1.0, 0.2], (0.0, 6.0), **step)
    assert solution.provenance["engine"] == "array"
    assert solution.stats.newton_iterations > 0
    plain = lt.LiePoissonSystem(
        mf.so(3), lambda mu: 0.25 * jnp.sum(mu**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation(2.0)
    )
    same = lt.integrate(plain, [1.5, 1.0, 0.2], (0.0, 6.0), **step, engine="array")
    assert np.abs(solution.x - same.x).max() <= 1e-12
    for _ in range(2):  # a second attempt fails as clearly as the first
        with pytest.raises(lt.LiethermoError, match="JAX primitive"):
            lt.integrate(stiff, [1.5, 1.0, 0.2], (0.0, 6.0), **step, engine="compiled")


def test_auto_compiles_small_systems_and_long_runs(monkeypatch):
    chosen = lambda: lt.integrate(BODY, X0, (0.0, 1.0), 0.1).provenance["engine"]  # noqa: E731
    assert chosen() == "compiled"
    monkeypatch.setattr("liethermo.engines.choice.MAX_AUTO_COMPILED_OPERATIONS", 2)
    assert chosen() == "array"
    monkeypatch.setattr("liethermo.engines.choice.MIN_STEPS_TO_COMPILE", 5)
    assert chosen() == "compiled"
    monkeypatch.setattr("liethermo.engines.choice.MAX_COMPILED_DIM", 2)
    assert chosen() == "array"


@pytest.mark.slow
def test_a_plain_function_that_is_quadratic_is_treated_as_one():
    """By what is written, not by its Hessian: that of ``|x|`` vanishes too."""
    matrix = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, 0.1], [0.0, 0.1, 0.5]])
    offset = jnp.array([0.1, 0.0, 0.2])
    plain = lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * m @ matrix @ m + offset @ m, lambda m: jnp.sum(m**2), lt.ProjectedMetric()
    )
    given = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(matrix, offset), lt.Quadratic(2 * np.ones(3)), lt.ProjectedMetric()
    )
    assert plain.energy.is_quadratic
    assert plain.entropy.is_quadratic
    a, b = (lt.integrate(system, [0.5, 1.0, 0.2], (0.0, 5.0), 0.1) for system in (plain, given))
    assert np.abs(a.x - b.x).max() <= 1e-14
    for general in (
        lambda m: jnp.abs(m[0]),
        lambda m: jnp.floor(m[0]) * m[1],
        lambda m: jnp.where(m[0] > 0.0, m[0] ** 2, m[1] ** 2),
        lambda m: m[0] * m[1] * m[2],
        lambda m: jnp.linalg.norm(m) ** 2,
        lambda m: m[0] / m[1],
        lambda m: m[0] ** m[1],
    ):
        assert not lt.LiePoissonSystem(mf.so(3), general, validate=False).energy.is_quadratic


# -- the cache --------------------------------------------------------------------------------------------------------

RUN = """
import liethermo as lt
print(lt.integrate(lt.models.rigid_body(), [0.001, 1.0, 0.001], (0.0, 5.0), 0.1, engine="compiled").x[-1].tolist())
"""


def in_a_process(folder):
    result = subprocess.run(
        [sys.executable, "-c", RUN], capture_output=True, text=True, env={**os.environ, "LIETHERMO_CACHE": str(folder)}
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_another_process_finds_the_cache_and_survives_damage(tmp_path):
    folder = tmp_path / "cache"
    first = in_a_process(folder)
    (file,) = folder.glob("*.o")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])  # as a killed process or a bad disk would
    assert in_a_process(folder) == first


@pytest.mark.slow
def test_a_folder_that_cannot_be_used(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert in_a_process(blocked / "cache") == in_a_process(tmp_path / "cache")
