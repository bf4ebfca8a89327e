"""Energies that once crashed the compiler are compiled, and after an unknown crash the array engine runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.compiled.llvm_writer import ProgramWriter
from liethermo.engines.compiled.parameters import ProgramStructure
from liethermo.engines.select_engine import CompiledEngineWarning
from liethermo.functions.magnetism.site_terms import QuadraticSiteEnergy
from liethermo.runs import problem
from liethermo.tracing import scalarize
from liethermo.tracing.builder import ProgramBuilder
from liethermo.tracing.primitives import UNROLLING_RULES

X0 = np.array([0.4, 0.5, -0.3])
ENERGIES = {
    "product with truth values": lambda m: 0.5 * jnp.dot(m > -9, m) * m[0] + m @ m / 2 + m[0] ** 2,
    "truth values in einsum": lambda m: jnp.einsum("i,i->", m > -9, m) + m[0] ** 2,
    "integers in einsum": lambda m: jnp.einsum("i,i->", (m > -9) * jnp.arange(3), m) + m[0] ** 2,
    "truth values by truth values": lambda m: m[0] ** 2 * jnp.dot(m > -9, m > -9) + m[1] ** 2 / 2,
    "integer exponent at run time": lambda m: (2.0 + m[0]) ** jnp.sum(m > -9),
    "flip of a number": lambda m: m @ jnp.array([0.5, 1.0, 1.5]) * m[1] + jnp.flip(m[0], ()),
    "gather with an index at run time": lambda m: jnp.take(m, jnp.argsort(m))[0] ** 2 + m[jnp.argmax(m)] ** 3,
    "float to narrow integers": lambda m: m[0] ** 2 + m[1] ** 2 * (200.0 * m[2]).astype(jnp.uint8).astype(float),
    "larger truth value": lambda m: m[0] ** 2 + m[1] ** 2 * jnp.maximum(m[2] > 0, m[0] > 0),
}
"""Energies that once crashed the compiler."""


def run(system, engine, **options):
    return lt.integrate(system, X0, (0.0, 0.5), 0.1, lt.MetriplecticRungeKutta(4), engine=engine, **options)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", ENERGIES)
def test_is_compiled(name):
    system = lt.LiePoissonSystem(mf.so(3), ENERGIES[name])
    compiled_run, array_run = run(system, "auto"), run(system, "array")
    assert compiled_run.provenance["engine"] == "compiled"
    assert np.abs(compiled_run.x - array_run.x).max() <= 2e-14


def test_entries_that_a_function_is_applied_to():
    """``x.at[i].apply(f)``, which JAX does not differentiate and which once gave zero, is compiled in a friction."""

    def friction(m):
        return jnp.diag(m.at[1].apply(jnp.cos).at[0].apply(lambda a: 1.0 + a * a) ** 2)

    system = lt.LiePoissonSystem(
        mf.so(3), lambda m: m[0] ** 2 + m[1] ** 2 / 2, lambda m: m @ m, lt.FrictionOperator(friction), validate=False
    )
    compiled_run, array_run = run(system, "compiled"), run(system, "array")
    assert np.abs(compiled_run.x - array_run.x).max() <= 2e-14


def sine(m):
    return m[0] ** 2 + jnp.sin(m[1]) * m[2]


@pytest.fixture
def fresh_programs(monkeypatch):
    """Empty the caches of programs."""
    monkeypatch.setattr("liethermo.engines.compiled.step_loop._step_loop_cache", lt.tracing.caching.LRUCache(4))
    monkeypatch.setattr("liethermo.tracing.interpret._unrolled_cache", lt.tracing.caching.LRUCache(4))
    monkeypatch.setattr("liethermo.runs.problem._cached_problem", problem._cached_problem.__wrapped__)


def raising(*arguments, **keywords):
    raise ZeroDivisionError("nobody has seen this yet")


FAULTS = {
    "rule of a primitive": lambda patch: patch.setitem(UNROLLING_RULES, "sin", raising),
    "scalar compiler": lambda patch: patch.setattr(scalarize, "_collect_program", raising),
    "builder": lambda patch: patch.setattr(ProgramBuilder, "mul", raising),
    "writer": lambda patch: patch.setattr(ProgramWriter, "write_operation", raising),
    "LLVM": lambda patch: patch.setattr("liethermo.engines.compiled.loop_codegen.MachineCode", raising),
}
"""Patches that raise an error in a part of the compiler."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_compiler_is_no_fault_of_the_run(fault, monkeypatch, fresh_programs):
    system = lt.LiePoissonSystem(mf.so(3), sine)
    expected_x = run(system, "array").x
    FAULTS[fault](monkeypatch)
    with pytest.warns(CompiledEngineWarning, match="ZeroDivisionError: nobody has seen this yet.*array engine runs it"):
        solution = run(system, "auto")
    assert solution.provenance["engine"] == "array"
    assert np.array_equal(solution.x, expected_x)
    with pytest.warns(CompiledEngineWarning, match="nobody has seen this yet"):
        ensemble = lt.ensemble(system, [X0, X0], (0.0, 0.5), 0.1, lt.MetriplecticRungeKutta(4))
    assert np.abs(ensemble.x[1] - expected_x[-1]).max() <= 1e-14
    with pytest.raises(lt.LiethermoError, match=r"the compiled engine failed.*This is a fault of liethermo"):
        run(system, "compiled")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("options", [{"until": lambda m: m[0] + 9.0}, {}], ids=["event", "adaptive"])
def test_a_fault_where_a_run_has_a_pace(options, monkeypatch, fresh_programs):
    system = lt.LiePoissonSystem(mf.so(3), sine)
    monkeypatch.setattr(ProgramWriter, "write_operation", raising)
    with pytest.warns(CompiledEngineWarning, match="nobody has seen this yet"):
        solution = lt.integrate(system, X0, (0.0, 0.5), lt.Adaptive(1e-8), **options)
    assert solution.provenance["engine"] == "array"


def test_a_fault_in_newtons_method(monkeypatch, fresh_programs):
    """A fault while Newton's method is compiled, at the first step that needs it: the array engine resumes the run."""
    system = lt.LiePoissonSystem(mf.so(3), sine)
    monkeypatch.setattr("liethermo.engines.compiled.step_loop.write_newton_solver", raising)
    with pytest.warns(CompiledEngineWarning, match="nobody has seen this yet"):
        solution = lt.integrate(system, 3.0 * X0, (0.0, 4.0), 0.4, lt.MetriplecticMidpoint())
    assert solution.stats.newton_iterations > 0


def test_the_primitive_and_the_line_of_a_fault_are_named(monkeypatch):
    monkeypatch.setitem(UNROLLING_RULES, "sin", raising)
    with pytest.raises(scalarize.CompilerFault, match=r"on the JAX primitive 'sin' \(test_faults.py:\d+") as error_info:
        scalarize.scalarize(jax.make_jaxpr(sine)(X0))
    assert isinstance(error_info.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_systems_with_other_optional_parameters_have_other_programs(order, fresh_programs):
    """Systems of one class run after one another; each has one array of shape (3,), of another parameter.

    An easy axis, a field, and both in one term, so that a program that served another system would move these spins.
    """
    axis = lt.magnetism.anisotropy(2, 1.5)
    field = lt.magnetism.zeeman(2, (0.0, 0.0, 1.0))  # its zeros are those of the axis
    systems = [lt.SpinSystem(2, energy, lt.LandauLifshitz(0.1)) for energy in (axis, field, [axis, field])]
    start = np.array([[0.6, 0.0, 0.8], [0.0, 0.8, -0.6]])
    for i in order:
        runs = [lt.integrate(systems[i], start, (0.0, 1.0), 0.1, engine=e) for e in ("compiled", "array")]
        np.testing.assert_allclose(runs[0].x, runs[1].x, atol=1e-14)


def test_the_key_of_a_program_knows_which_parameters_exist():
    vector = jnp.array([0.0, 0.0, 1.0])
    linear, quadratic = QuadraticSiteEnergy((1,), None, vector, None), QuadraticSiteEnergy((1,), vector, None, None)
    assert ProgramStructure.from_module(linear) != ProgramStructure.from_module(quadratic)
    assert ProgramStructure.from_module(linear) == ProgramStructure.from_module(
        QuadraticSiteEnergy((1,), None, 2.0 * vector, None)
    )
