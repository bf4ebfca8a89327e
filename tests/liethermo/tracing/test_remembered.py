"""What is kept between calls for systems and methods: found again for the same objects, and for no others."""

from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing import programs
from liethermo.tracing.caching import MAX_CACHED_RESULTS, LRUCache, fingerprint, memoize


def counted():
    calls = []

    @memoize
    def function(*arguments):
        calls.append(arguments)
        return len(calls)

    return function, calls


def test_the_same_objects_are_found_again():
    function, calls = counted()
    first, second = lt.models.rigid_body(), lt.models.rigid_body(rate=2.0)
    assert [function(first), function(second), function(first), function(first, second)] == [1, 2, 1, 3]
    assert len(calls) == 3


def test_others_of_the_same_content_are_found_too():
    """A method that is written out in each call costs what one that is kept does."""
    function, calls = counted()
    assert [function(lt.models.rigid_body(), lt.MetriplecticTaylor(n)) for n in (6, 6, 8, 6)] == [1, 1, 2, 1]
    one = (jnp.zeros(2), jnp.zeros(2, dtype=int), jnp.zeros((1, 2)), 1, 1.0, True)
    assert [function(a) for a in one] == [3, 4, 5, 6, 7, 8], "types and shapes are content"
    assert len(calls) == 8


def test_no_object_takes_the_place_of_another():
    """Objects are kept alive as long as what was found for them, and both for so long only."""
    function, _ = counted()
    assert [function((float(i),)) for i in range(2 * MAX_CACHED_RESULTS)] == list(range(1, 2 * MAX_CACHED_RESULTS + 1))


def test_what_can_change_is_not_remembered():
    """An array of NumPy, which may be written to between two runs, and what is being traced."""
    function, calls = counted()
    weights = np.ones(3)
    assert [function(weights), function(weights)] == [1, 2]
    jax.jit(lambda x: (function(x), function(x), x)[2])(1.0)
    assert len(calls) == 4


class Weighted(eqx.Module):
    weights: np.ndarray

    def __call__(self, mu):
        return 0.5 * jnp.sum(self.weights * mu**2)


@pytest.mark.slow
def test_a_run_sees_parameters_that_were_changed_in_place():
    energy = Weighted(np.array([1.0, 2.0, 3.0]))
    system = lt.LiePoissonSystem(mf.so(3), energy)
    before = [lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, engine=e).x[-1] for e in ("array", "compiled")]
    energy.weights[:] = [3.0, 1.0, 2.0]
    after = [lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, engine=e).x[-1] for e in ("array", "compiled")]
    assert np.abs(before[0] - before[1]).max() < 1e-14
    assert np.abs(after[0] - after[1]).max() < 1e-14
    assert np.abs(after[0] - before[0]).max() > 0.1


def test_fingerprints():
    """By the values of arrays; None for what has no identity that lasts."""
    same = [fingerprint(lt.MetriplecticGauss(2, preserve=lt.Quadratic(np.ones(3)))) for _ in range(2)]
    assert same[0] == same[1]
    assert same[0] != fingerprint(lt.MetriplecticGauss(2, preserve=lt.Quadratic(2 * np.ones(3))))
    assert fingerprint({1}) is None


@pytest.mark.slow
def test_a_method_with_arrays_of_its_own_can_be_compiled():
    system = lt.LiePoissonSystem(mf.so(3), lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0])))
    method = lt.MetriplecticGauss(1, preserve=lt.Quadratic(np.ones(3)))
    a, b = (lt.integrate(system, [0.1, 1.0, 0.2], (0.0, 1.0), 0.1, method, engine=e) for e in ("array", "compiled"))
    assert np.abs(a.x - b.x).max() < 1e-14


@pytest.mark.parametrize(
    "method", [lt.MetriplecticRungeKutta(4), pytest.param(lt.MetriplecticGauss(2), marks=pytest.mark.slow)], ids=str
)
def test_one_program_serves_all_calls(method, monkeypatch):
    """Whatever the span, the outputs and the tolerance: numbers of Python are no types of their own."""
    traces, trace = Counter(), programs._ArrayFunction.__call__

    def counted(whole, dynamic):
        traces[whole] += 1
        return trace(whole, dynamic)

    monkeypatch.setattr(programs._ArrayFunction, "__call__", counted)
    monkeypatch.setattr(programs, "_programs", LRUCache(programs.MAX_CACHED_PROGRAMS))
    body, x0, h = lt.models.rigid_body(rate=0.2), np.array([0.1, 0.2, 1.0]), 0.05
    for span in (1.0, 1.02):
        given = body, x0, (0.0, span)
        for step, options in (
            (h, {}),
            (np.float64(h), {"save_at": [0.33, 0.5]}),
            (h, {"until": lt.Relaxed(1e-9)}),
            (lt.Adaptive(1e-5 * span), {}),
        ):
            lt.integrate(*given, step, method, engine="array", **options)
        for step, options in ((h, {}), (h, {"save_at": [0.33, 0.5]}), (lt.Adaptive(1e-5 * span), {})):
            lt.ensemble(body, np.tile(x0, (8, 1)), (0.0, span), step, method, engine="array", **options)
    names = {whole.__name__ for whole in traces}
    assert {"advance", "follow", "advance_all", "_follow_all"} <= names
    assert not [whole.__name__ for whole, number in traces.items() if number > 1]
