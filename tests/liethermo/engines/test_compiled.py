"""Compiled engine: trajectories, statuses and work equal those of the array engine, and a bad cache breaks no run."""

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
from liethermo.engines import array_engine
from liethermo.engines.compiled import machine_code
from liethermo.engines.compiled.engine import CompiledEngine
from liethermo.engines.compiled.step_loop import CompiledStepLoop
from liethermo.engines.select_engine import CompiledEngineWarning
from liethermo.engines.solver_options import SolverOptions
from liethermo.engines.status_codes import StatusCode
from liethermo.runs import problem
from tests.cases import DISSIPATIONS, build, state_of
from tests.liethermo import random_systems
from tests.machine_code import copy_at_offset
from tests.systems import rigid_body

X0 = [0.001, 1.0, 0.001]


def run_both_engines(system, x0, span, h, method=None, **options):
    return [
        lt.integrate(system, x0, span, h, method, engine=engine, on_failure="return", **options)
        for engine in ("array", "compiled")
    ]


def assert_equal_runs(a, b, tolerance=1e-13):
    assert (a.status.code, a.status.step, a.laws) == (b.status.code, b.status.step, b.laws)
    assert np.array_equal(a.t, b.t)
    assert np.abs(a.x - b.x).max() <= tolerance * np.abs(a.x).max()
    # rounding decides whether the plateau is met an iteration earlier or later
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
    algebra_object = next(g for g in (mf.so(3), mf.se(3), mf.sl(2), mf.su(3)) if g.name == algebra)
    system = build(algebra_object, next(case for case in DISSIPATIONS if case.name == dissipation))
    a, b = run_both_engines(system, state_of(algebra_object, 1), (0.0, 2.0), 0.02, lt.MetriplecticMidpoint(gradient))
    assert b.provenance["engine"] == "compiled"
    assert_equal_runs(a, b, 1e-12)
    if system.energy_law == "conserved":
        assert b.audit().energy_drift <= 2e-14


def test_the_body_of_the_paper():
    a, b = run_both_engines(rigid_body(), X0, (0.0, 500.05), 0.1)
    assert_equal_runs(a, b)
    assert b.audit(energy=1e-14).passed
    assert b.entropy[-1] == pytest.approx(10 * b.energy[0], rel=1e-14)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("save_every", [7, 10_000])
def test_save_every(save_every):
    assert_equal_runs(*run_both_engines(rigid_body(), X0, (0.0, 30.05), 0.1, save_every=save_every))


def test_newton_on_demand():
    """Newton's method is compiled when a step first needs it, also in the middle of a save interval."""
    stiff = lt.models.rigid_body(rate=200.0)
    a, b = run_both_engines(stiff, [0.1, 1.0, 0.1], (0.0, 50.0), 0.5, save_every=3)
    assert b.stats.newton_iterations > 0
    assert (a.status.code, np.array_equal(a.t, b.t)) == ("completed", True)
    assert np.abs(a.x - b.x).max() < 1e-13
    assert b.audit().passed


@pytest.mark.slow
def test_failures_are_the_same():
    oscillating_system = lt.LiePoissonSystem(
        mf.so(3), lambda p: jnp.sum(jnp.sin(40.0 * p)), lt.Quadratic(np.ones(3)), lt.KillingDissipation()
    )
    a, b = run_both_engines(oscillating_system, [0.3, 1.0, -0.2], (0.0, 500.0), 50.0)
    assert a.status.code == b.status.code == "not_converged"
    system_with_domain = lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / jnp.array([10.0, 5.0, 1.0])) + 1e-3 * jnp.sqrt(1.1 - p[0]),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.5),
        validate=False,
    )
    a, b = run_both_engines(system_with_domain, X0, (0.0, 500.0), 0.1, save_every=7)
    assert (a.status.code, a.status.step) == ("non_finite", b.status.step)
    assert str(a.status).split(" near")[0] == str(b.status).split(" near")[0]
    assert np.abs(a.x - b.x).max() < 1e-12


def test_every_engine_goes_by_the_rules_it_is_given():
    system = lt.LiePoissonSystem(mf.so(3), lambda p: jnp.sum(p**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation())
    x0, method = np.array([0.8, 0.5, 0.9]), lt.MetriplecticGauss(1)
    for engine in (CompiledEngine, array_engine.ArrayEngine):
        limited_engine = engine(system, method, SolverOptions(max_fixed_point_iterations=1, max_newton_iterations=1))
        state = limited_engine.step(limited_engine.initial_run_state(x0), 0.1)
        assert int(state.status) == StatusCode.NOT_CONVERGED
        assert np.array_equal(state.x, x0)
        assert (
            int(engine(system, method).step(initial_state := limited_engine.initial_run_state(x0), 0.1).status)
            == StatusCode.COMPLETED
        )
        assert np.array_equal(initial_state.x, x0)


def test_rules_of_large_systems_in_machine_code():
    """Steps of "large" systems, which select all of a state at once, compile and give the same states."""
    for method in (lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)):
        default_engine = CompiledEngine(rigid_body(), method)
        large_engine = CompiledEngine(rigid_body(), method, SolverOptions(matrix_free_dim=2))
        state = large_engine.advance(large_engine.initial_run_state(X0), 0.1, 1, 20)[0]
        assert int(state.status) == StatusCode.COMPLETED
        assert (
            np.abs(state.x - default_engine.advance(default_engine.initial_run_state(X0), 0.1, 1, 20)[0].x).max()
            < 1e-14
        )
    limited_engine = CompiledEngine(
        rigid_body(),
        lt.MetriplecticGauss(1),
        SolverOptions(matrix_free_dim=2, max_fixed_point_iterations=1, max_newton_iterations=1),
    )
    failed_state = limited_engine.step(limited_engine.initial_run_state(X0), 0.1)
    assert int(failed_state.status) == StatusCode.NOT_CONVERGED
    assert np.array_equal(failed_state.x, X0)


def test_what_takes_minutes_to_compile_is_said(monkeypatch):
    monkeypatch.setattr(problem, "_cached_problem", problem._cached_problem.__wrapped__)  # no engine of another test
    monkeypatch.setattr("liethermo.engines.select_engine.SLOW_COMPILE_OPERATIONS", 2)
    with pytest.warns(CompiledEngineWarning, match=r"takes minutes to compile\. Leave out engine"):
        lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1, engine="compiled")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1)


def test_code_is_optimised_once_many_steps_are_taken(tmp_path, monkeypatch):
    """Code is not optimised for few steps, nor if it is found on disk; the results are equal to the bit."""
    skipped_optimisation = []
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path))
    compile_module = machine_code._compile_module
    monkeypatch.setattr(
        machine_code,
        "_compile_module",
        lambda text, skip_optimisation: (
            skipped_optimisation.append(skip_optimisation) or compile_module(text, skip_optimisation)
        ),
    )
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda x: jnp.sum((1.3 + x**2) ** 1.37) + jnp.exp(0.3 * x[0]) * jnp.sin(x[1]) + (0.5 + x[2] ** 2) ** 0.5,
        mf.so(3).casimirs(2)[0],
        lt.ProjectedMetric(rate=0.1),
    )

    def run(steps):
        return lt.integrate(system, X0, (0.0, 20.0), 20.0 / steps, lt.MetriplecticRungeKutta(4), engine="compiled").x

    states = run(400)
    assert skipped_optimisation == [True]
    run(4_000)
    assert skipped_optimisation == [True, False]
    assert np.array_equal(run(400), states)
    assert skipped_optimisation == [True, False]


@pytest.mark.slow
def test_parameters_are_arguments(monkeypatch):
    """A sweep over inertias and rates compiles once; another pattern of zeros is another program."""
    compiled_texts = []
    compile_module = machine_code._compile_module
    monkeypatch.setattr(machine_code, "_compile_module", lambda *a: compiled_texts.append(a[0]) or compile_module(*a))
    for inertia, rate in [((9.0, 4.0, 2.0), 0.3), ((7.0, 3.0, 1.0), 0.4), ((5.0, 4.0, 3.0), 0.5)]:
        system = lt.models.rigid_body(inertia, rate)
        a, b = run_both_engines(system, X0, (0.0, 5.0), 0.1)
        assert_equal_runs(a, b)
    assert len(compiled_texts) <= 1
    assert_equal_runs(*run_both_engines(lt.models.rigid_body((9.0, 4.0, 2.0), rate=0.0), X0, (0.0, 5.0), 0.1))

    class Quartic(eqx.Module):
        strength: jax.Array

        def __call__(self, mu):
            return 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0])) + self.strength * mu[0] ** 4

    compiled_texts.clear()
    for strength in (0.1, 0.7):
        system = lt.LiePoissonSystem(mf.so(3), Quartic(jnp.asarray(strength)), lt.Quadratic(np.ones(3)))
        assert_equal_runs(*run_both_engines(system, [0.5, 1.0, 0.2], (0.0, 5.0), 0.1), tolerance=1e-12)
    assert len(compiled_texts) == 1


@pytest.mark.sampled("fixed")
@pytest.mark.parametrize("h", [0.01, lt.Adaptive(1e-6)], ids=["fixed", "adaptive"])
def test_blocks_may_begin_at_any_number(h, monkeypatch):
    """Members have matrices of their own in memory that is not aligned to whole vectors, as NumPy's is not."""
    g, make_blocks = mf.se(3), CompiledStepLoop.blocks_from_fields
    arguments = random_systems.family(g), random_systems.states(g, 9), (0.0, 0.05), h, lt.MetriplecticMidpoint()

    def final_states(offset: int) -> np.ndarray:
        monkeypatch.setattr(
            CompiledStepLoop, "blocks_from_fields", lambda *fields: copy_at_offset(make_blocks(*fields), offset)
        )
        many = lt.ensemble(*arguments, parameters=random_systems.parameters(g, 9), engine="compiled")
        assert many.ok.all()
        return many.x

    expected = final_states(0)
    assert all(np.array_equal(final_states(offset), expected) for offset in range(1, 8))


def system_with_fft():
    def energy(mu):
        return jnp.sum(jnp.abs(jnp.fft.fft(mu)) ** 2 * jnp.array([1.0, 2.0, 3.0]))

    return lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), validate=False)


@pytest.mark.slow
def test_what_cannot_be_compiled(monkeypatch):
    with pytest.raises(lt.LiethermoError, match="JAX primitive"):
        lt.integrate(system_with_fft(), [0.5, 1.0, 0.2], (0.0, 1.0), 0.1, engine="compiled")
    with pytest.warns(UserWarning, match=r"JAX primitive.*array engine"):
        solution = lt.integrate(system_with_fft(), [0.5, 1.0, 0.2], (0.0, 1.0), 0.1)
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
@pytest.mark.parametrize("adaptive", [False, True])
def test_newtons_method_that_cannot_be_compiled(adaptive):
    """The array engine takes over when a step first needs Newton's method, which contains an unsupported primitive."""
    stiff = lt.LiePoissonSystem(mf.so(3), fourth_power, lt.Quadratic(np.ones(3)), lt.KillingDissipation(2.0))
    # the first steps are easy, the rest are not
    step = {"step": 1.0, "save_at": [3.0, 6.0]} if adaptive else {"step": 1.0}
    with pytest.warns(UserWarning, match=r"JAX primitive.*array engine"):
        solution = lt.integrate(stiff, [1.5, 1.0, 0.2], (0.0, 6.0), **step)
    assert solution.provenance["engine"] == "array"
    assert solution.stats.newton_iterations > 0
    supported_system = lt.LiePoissonSystem(
        mf.so(3), lambda mu: 0.25 * jnp.sum(mu**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation(2.0)
    )
    expected = lt.integrate(supported_system, [1.5, 1.0, 0.2], (0.0, 6.0), **step, engine="array")
    assert np.abs(solution.x - expected.x).max() <= 1e-12
    for _ in range(2):  # a second attempt fails as clearly as the first
        with pytest.raises(lt.LiethermoError, match="JAX primitive"):
            lt.integrate(stiff, [1.5, 1.0, 0.2], (0.0, 6.0), **step, engine="compiled")


def test_auto_compiles_small_systems_and_long_runs(monkeypatch):
    monkeypatch.setattr(problem, "_cached_problem", problem._cached_problem.__wrapped__)  # no engine of another test
    chosen_engine = lambda: lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1).provenance["engine"]  # noqa: E731
    assert chosen_engine() == "compiled"
    monkeypatch.setattr("liethermo.engines.select_engine.MAX_AUTO_COMPILED_OPERATIONS", 2)
    assert chosen_engine() == "array"
    monkeypatch.setattr("liethermo.engines.select_engine.MIN_STEPS_TO_COMPILE", 5)
    assert chosen_engine() == "compiled"
    monkeypatch.setattr("liethermo.engines.select_engine.MAX_COMPILED_DIM", 2)
    assert chosen_engine() == "array"


@pytest.mark.slow
def test_a_plain_function_that_is_quadratic_is_treated_as_one():
    """A function is recognised as quadratic by its program, not by its Hessian: that of ``|x|`` vanishes too."""
    matrix = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, 0.1], [0.0, 0.1, 0.5]])
    offset = jnp.array([0.1, 0.0, 0.2])
    function_system = lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * m @ matrix @ m + offset @ m, lambda m: jnp.sum(m**2), lt.ProjectedMetric()
    )
    quadratic_system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(matrix, offset), lt.Quadratic(2 * np.ones(3)), lt.ProjectedMetric()
    )
    assert function_system.energy.is_quadratic
    assert function_system.entropy.is_quadratic
    a, b = (lt.integrate(system, [0.5, 1.0, 0.2], (0.0, 5.0), 0.1) for system in (function_system, quadratic_system))
    assert np.abs(a.x - b.x).max() <= 1e-14
    for function in (
        lambda m: jnp.abs(m[0]),
        lambda m: jnp.floor(m[0]) * m[1],
        lambda m: jnp.where(m[0] > 0.0, m[0] ** 2, m[1] ** 2),
        lambda m: m[0] * m[1] * m[2],
        lambda m: jnp.linalg.norm(m) ** 2,
        lambda m: m[0] / m[1],
        lambda m: m[0] ** m[1],
    ):
        assert not lt.LiePoissonSystem(mf.so(3), function, validate=False).energy.is_quadratic


# -- the cache --------------------------------------------------------------------------------------------------------

RUN_SCRIPT = """
import liethermo as lt
print(lt.integrate(lt.models.rigid_body(), [0.001, 1.0, 0.001], (0.0, 5.0), 0.1, engine="compiled").x[-1].tolist())
"""


def run_in_process(folder):
    result = subprocess.run(
        [sys.executable, "-c", RUN_SCRIPT],
        capture_output=True,
        text=True,
        env={**os.environ, "LIETHERMO_CACHE": str(folder)},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_another_process_finds_the_cache_and_survives_damage(tmp_path):
    folder = tmp_path / "cache"
    output = run_in_process(folder)
    (file,) = folder.glob("*.o")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])  # as a killed process or a bad disk would
    assert run_in_process(folder) == output


@pytest.mark.slow
def test_a_folder_that_cannot_be_used(tmp_path):
    file = tmp_path / "file"
    file.write_text("not a folder")
    assert run_in_process(file / "cache") == run_in_process(tmp_path / "cache")
