"""Studies in an ordinary loop: new closures reuse compiled programs, and memory does not grow."""

import gc
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing import programs, traced
from liethermo.tracing.caching import LRUCache
from tests.machine_code import count_memory_maps

SCRIPT_SETUP = """
import resource, sys, time
import jax.numpy as jnp, numpy as np
import liethermo as lt, manifolds as mf

def maps():
    return sum(1 for _ in open("/proc/self/maps"))

def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

def build(k):
    weights = np.array([1.0, 0.5, 0.1 + 0.1 * k])
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(weights * p * p) + k * p[0] ** 4,
        lambda p: 0.5 * k * p @ p,
        lt.ProjectedMetric(cometric=lambda p: jnp.eye(3) * (1.0 + k * p[1] ** 2)),
        momentum_maps={"nothing": lambda p: 0.0 * k * p[0]},
    )

def canonical(k):
    return lt.MetriplecticSystem(
        lambda x: k * jnp.array([[0.0, 1.0], [-1.0, 0.0]]), lambda x: k * (x @ x) + jnp.cos(k * x[0]), dim=2
    )

def one_pass(i, everything):
    k = 1.0 + 1e-4 * i
    x, span, system = [0.3, 1.0, 0.2], (0.0, 0.3), build(k)
    lt.integrate(system, x, span, 0.1, engine="compiled")
    lt.flow(system, x, span, 0.1)
    if everything:
        free = lt.LiePoissonSystem(mf.so(3), lambda p: k * jnp.cos(p[0]) + p[1] ** 2)
        lt.integrate(free, x, span, 0.1, lt.MetriplecticGauss(1, preserve=lambda p: k * p @ p), engine="compiled")
        lt.integrate(system, x, span, 0.1, engine="array")
        lt.ensemble(system, np.eye(3), span, 0.1)
        lt.integrate(canonical(k), [0.3, 1.0], span, 0.1, engine="array")

passes, everything = int(sys.argv[1]), sys.argv[2] == "all"
one_pass(0, everything)
one_pass(1, everything)
"""

SCRIPT_LOOP = """
before = maps(), memory()
started = time.process_time()
for i in range(2, passes):
    one_pass(i, everything)
print(maps() - before[0], memory() - before[1], (time.process_time() - started) / (passes - 2))
"""


def run_loop(passes: int, mode: str) -> tuple[float, ...]:
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT_SETUP + SCRIPT_LOOP, str(passes), mode], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr[-2000:]
    return tuple(map(float, process.stdout.split()))


@pytest.mark.slow
def test_a_loop_compiles_once_and_does_not_grow():
    """Without the cache, a pass took some 400 of the 65,530 memory maps of a process, and five seconds."""
    maps, megabytes, seconds_per_pass = run_loop(60, "some")
    assert maps < 100
    assert megabytes < 40
    assert seconds_per_pass < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("passes", "what"), [(300, "all"), (10_000, "some")])
def test_long_loops(passes, what):
    maps, megabytes, seconds_per_pass = run_loop(passes, what)
    assert maps < 300
    assert megabytes < 200
    assert seconds_per_pass < 0.6


# -- programs by content ----------------------------------------------------------------------------------------------

STATE = jax.ShapeDtypeStruct((3,), jnp.float64)
X = jnp.array([0.3, 1.0, 0.2])


def function(a, weights, count=3, shift=0.0):
    """Return a function that contains its numbers in every possible place."""
    weights = np.asarray(weights)

    def inner(c, w):
        return a * c + w, c

    def f(x):
        loop_results = jax.lax.scan(inner, x[0], weights * x)[0] + jax.lax.fori_loop(0, count, lambda i, y: y * a, x[1])
        branch_result = jax.lax.cond(x[0] > a, lambda y: y * a, lambda y: y / (a + 2.0), x[2])
        jit_result = jax.jit(lambda y: jnp.sum(weights * y**2) / a)(x) + jax.nn.softplus(a * x[0]) + jnp.sinc(x[1])
        indexed_sum = x[jnp.asarray([0, 2])].sum() + x[(jnp.asarray(weights) * 0 + 1.0).astype(int)].sum()
        return loop_results + branch_result + jit_result + indexed_sum + jnp.where(x[0] > shift, x[0] ** 1.3, 0.0)

    return f


def test_functions_with_other_numbers_share_a_program():
    function_a, function_b = (
        traced.trace_function(function(a, w), STATE) for a, w in ((0.3, [1.0, 2.0, 3.0]), (0.4, [0.5, 2.5, 1.5]))
    )
    assert function_a.program is function_b.program
    assert jax.tree_util.tree_structure(function_a) == jax.tree_util.tree_structure(function_b)
    for f, g in ((function(0.3, [1.0, 2.0, 3.0]), function_a), (function(0.4, [0.5, 2.5, 1.5]), function_b)):
        results = jax.jit(jax.value_and_grad(f))(X), jax.jit(jax.value_and_grad(g))(X)
        assert np.abs(results[0][0] - results[1][0]) < 1e-13
        assert np.abs(results[0][1] - results[1][1]).max() < 1e-13


@pytest.mark.parametrize(
    "other",
    [
        function(0.3, [1.0, 2.0, 3.0], count=4),
        lambda x: function(0.3, [1.0, 2.0, 3.0])(x) + x[0],
        lambda x: function(0.3, [1.0, 2.0, 3.0])(x[::-1]),
    ],
    ids=["another count", "another operation", "another order"],
)
def test_other_operations_are_other_programs(other):
    assert (
        traced.trace_function(function(0.3, [1.0, 2.0, 3.0]), STATE).program
        is not traced.trace_function(other, STATE).program
    )


def test_integers_and_truths_belong_to_the_operations():
    """They decide on indices and branches, so other values need another program."""

    def of(a):
        return lambda x: jnp.where(jnp.asarray(a) > 0.5, x[jnp.asarray(a).astype(int)], jnp.sin(x[0]))

    contents = [traced.trace_function(of(a), STATE) for a in (0.2, 0.3, 0.7, 1.2)]
    assert contents[0].program is contents[1].program
    assert len({id(f.program) for f in contents}) == 3
    for a, f in zip((0.2, 0.3, 0.7, 1.2), contents, strict=True):
        assert f(X) == of(a)(X)


def test_traced_function_refuses_other_shapes():
    with pytest.raises(lt.LiethermoError, match="must be called with arrays of shape"):
        traced.trace_function(function(0.3, [1.0, 2.0, 3.0]), STATE)(jnp.ones(4))


def test_programs_are_unloaded_beyond_the_cache_size(monkeypatch):
    """Different programs are kept up to a bounded number."""
    monkeypatch.setattr(programs, "_program_cache", LRUCache(2))

    @programs.jit_cached
    def power(x, n: int):
        return x**n

    def maps():
        with open("/proc/self/maps") as file:
            return sum(1 for _ in file)

    assert [float(power(jnp.asarray(2.0), n)) for n in range(3, 6)] == [8.0, 16.0, 32.0]
    maps_before = maps()
    assert [float(power(jnp.asarray(2.0), n)) for n in range(6, 26)] == [2.0**n for n in range(6, 26)]
    assert maps() - maps_before < 20
    assert len(programs._program_cache) == 2


@pytest.mark.slow
def test_a_family_built_by_a_new_function_each_time():
    def run(k):
        def family(rate):
            return lt.LiePoissonSystem(
                mf.so(3), lambda p: k * jnp.sum(p**2 * jnp.array([1.0, 2.0, 3.0])), lt.Quadratic(np.ones(3)),
                lt.KillingDissipation(rate),
            )  # fmt: skip

        rates = np.array([0.5, 1.0])
        ensemble_states = lt.ensemble(family, X, (0.0, 1.0), 0.1, parameters=rates, engine="compiled").x
        single_states = [lt.integrate(family(r), X, (0.0, 1.0), 0.1, engine="compiled").x[-1] for r in rates]
        assert np.abs(ensemble_states - single_states).max() < 1e-14

    from liethermo.engines.compiled import step_loop as compiled

    run(0.5)
    n_cached = len(compiled._step_loop_cache)
    run(0.6)
    assert len(compiled._step_loop_cache) == n_cached


@pytest.mark.slow
def test_a_thousand_programs_that_differ(monkeypatch):
    """Dropping a compiled loop of steps unloads its machine code."""
    from liethermo.engines.compiled import step_loop as compiled

    monkeypatch.setattr(compiled, "_step_loop_cache", LRUCache(4))

    def run(i):
        system = lt.MetriplecticSystem(None, lambda x: jnp.sin(x[0]) ** (i + 3), dim=1, validate=False)
        return lt.integrate(system, [0.3], (0.0, 0.2), 0.1, engine="compiled").status.ok

    assert all(map(run, range(20)))
    gc.collect()
    maps_before = count_memory_maps()
    assert all(map(run, range(20, 60)))
    gc.collect()
    assert count_memory_maps() <= maps_before + 400


class Spring(eqx.Module):
    stiffness: float
    exponent: float

    def __call__(self, x):
        power = 2 if self.exponent > 1.0 else 1  # needs the value in Python
        return self.stiffness * x[0] ** power


def test_plain_numbers_of_modules_are_parameters():
    class LinearSpring(eqx.Module):
        stiffness: float

        def __call__(self, x):
            return self.stiffness * x[0] ** 2

    def structure(function):
        return jax.tree_util.tree_structure(eqx.filter(lt.MetriplecticSystem(None, function, dim=1), eqx.is_array))

    assert structure(LinearSpring(1.0)) == structure(LinearSpring(2.0))
    system = lt.MetriplecticSystem(None, LinearSpring(1.5), dim=1)
    assert float(system.energy.function.stiffness) == 1.5
    branching_system = lt.MetriplecticSystem(None, Spring(1.5, 2.0), dim=1)
    assert float(branching_system.energy(jnp.array([2.0]))) == 6.0
