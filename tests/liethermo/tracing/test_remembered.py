"""Caches of results for systems and methods: hits for the same or equal objects, and for no others."""

from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing import programs
from liethermo.tracing.caching import MAX_CACHED_RESULTS, LRUCache, memoize, pytree_key_or_none


def counting_function():
    calls = []

    @memoize
    def function(*arguments):
        calls.append(arguments)
        return len(calls)

    return function, calls


def test_results_are_cached_by_identity():
    function, calls = counting_function()
    body, other_body = lt.models.rigid_body(), lt.models.rigid_body(rate=2.0)
    assert [function(body), function(other_body), function(body), function(body, other_body)] == [1, 2, 1, 3]
    assert len(calls) == 3


def test_results_are_cached_by_content():
    """A method written out in each call is as fast as one object that is reused."""
    function, calls = counting_function()
    assert [function(lt.models.rigid_body(), lt.MetriplecticTaylor(n)) for n in (6, 6, 8, 6)] == [1, 1, 2, 1]
    distinct_arguments = (jnp.zeros(2), jnp.zeros(2, dtype=int), jnp.zeros((1, 2)), 1, 1.0, True)
    assert [function(a) for a in distinct_arguments] == [3, 4, 5, 6, 7, 8], "types and shapes are content"
    assert len(calls) == 8


def test_a_new_object_does_not_match_a_cached_id():
    """The cache keeps arguments alive as long as their results, so that no new object has their id."""
    function, _ = counting_function()
    assert [function((float(i),)) for i in range(2 * MAX_CACHED_RESULTS)] == list(range(1, 2 * MAX_CACHED_RESULTS + 1))


def test_mutable_and_traced_arguments_are_not_cached():
    """A NumPy array may be modified between two runs; a tracer has no value."""
    function, calls = counting_function()
    weights = np.ones(3)
    assert [function(weights), function(weights)] == [1, 2]
    jax.jit(lambda x: (function(x), function(x), x)[2])(1.0)
    assert len(calls) == 4


class WeightedEnergy(eqx.Module):
    weights: np.ndarray

    def __call__(self, mu):
        return 0.5 * jnp.sum(self.weights * mu**2)


@pytest.mark.slow
def test_a_run_sees_parameters_that_were_changed_in_place():
    energy = WeightedEnergy(np.array([1.0, 2.0, 3.0]))
    system = lt.LiePoissonSystem(mf.so(3), energy)
    states_before = [
        lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, engine=e).x[-1] for e in ("array", "compiled")
    ]
    energy.weights[:] = [3.0, 1.0, 2.0]
    states_after = [
        lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, engine=e).x[-1] for e in ("array", "compiled")
    ]
    assert np.abs(states_before[0] - states_before[1]).max() < 1e-14
    assert np.abs(states_after[0] - states_after[1]).max() < 1e-14
    assert np.abs(states_after[0] - states_before[0]).max() > 0.1


def test_fingerprints():
    """Fingerprints compare arrays by value; an unhashable object has none."""
    keys = [pytree_key_or_none(lt.MetriplecticGauss(2, preserve=lt.Quadratic(np.ones(3)))) for _ in range(2)]
    assert keys[0] == keys[1]
    assert keys[0] != pytree_key_or_none(lt.MetriplecticGauss(2, preserve=lt.Quadratic(2 * np.ones(3))))
    assert pytree_key_or_none({1}) is None


@pytest.mark.slow
def test_a_method_with_arrays_of_its_own_can_be_compiled():
    system = lt.LiePoissonSystem(mf.so(3), lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0])))
    method = lt.MetriplecticGauss(1, preserve=lt.Quadratic(np.ones(3)))
    a, b = (lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, method, engine=e) for e in ("array", "compiled"))
    assert np.abs(a.x - b.x).max() < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticGauss(2)], ids=str)
def test_one_program_serves_all_calls(method, monkeypatch):
    """The span, the outputs and the tolerance are arguments of the program, whether Python or NumPy numbers."""
    traces, trace = Counter(), programs._ArrayFunction.__call__

    def count_trace(array_function, dynamic):
        traces[array_function] += 1
        return trace(array_function, dynamic)

    monkeypatch.setattr(programs._ArrayFunction, "__call__", count_trace)
    monkeypatch.setattr(programs, "_program_cache", LRUCache(programs.MAX_CACHED_PROGRAMS))
    body, x0, h = lt.models.rigid_body(rate=0.2), np.array([0.1, 0.2, 1.0]), 0.05
    for span in (1.0, 1.02):
        arguments = body, x0, (0.0, span)
        for step, options in (
            (h, {}),
            (np.float64(h), {"save_at": [0.33, 0.5]}),
            (h, {"until": lt.Relaxed(1e-9)}),
            (lt.Adaptive(1e-5 * span), {}),
        ):
            lt.integrate(*arguments, step, method, engine="array", **options)
        for step, options in ((h, {}), (h, {"save_at": [0.33, 0.5]}), (lt.Adaptive(1e-5 * span), {})):
            lt.ensemble(body, np.tile(x0, (8, 1)), (0.0, span), step, method, engine="array", **options)
    names = {array_function.__name__ for array_function in traces}
    assert {"advance", "advance_adaptive", "_advance_batch", "_advance_batch_program"} <= names
    assert not [array_function.__name__ for array_function, count in traces.items() if count > 1]
