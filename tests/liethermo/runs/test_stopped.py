"""Runs that are stopped from outside keep the states saved so far, and the status says why they ended."""

import multiprocessing
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.select_engine import EngineWithFallback
from liethermo.integrators import reference
from tests.systems import rigid_body

X0 = np.array([0.1, 1.0, 0.1])


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("error", "why"),
    [
        (KeyboardInterrupt(), "by the user"),
        (MemoryError(), "no memory left"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory"), "no memory left"),
    ],
)
def test_fixed_steps(monkeypatch, error, why):
    advance, calls = EngineWithFallback.advance_trajectory, []

    def fail_third_advance(self, *arguments):
        calls.append(1)
        if len(calls) == 3:
            raise error
        return advance(self, *arguments)

    monkeypatch.setattr(EngineWithFallback, "advance_trajectory", fail_third_advance)
    monkeypatch.setattr(EngineWithFallback, "max_saves_per_call", property(lambda self: 10))
    whole_run = lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.1, engine="array")
    assert whole_run.status.code == "interrupted"
    assert why in whole_run.status.message
    assert len(whole_run.t) == len(whole_run.x) == len(whole_run.energy) == 21
    monkeypatch.undo()
    assert np.array_equal(lt.integrate(rigid_body(), X0, (0.0, 2.0), 0.1, engine="array").x, whole_run.x)


def test_adaptive_steps(monkeypatch):
    from liethermo.runs.run import Run

    append, calls = Run._save_accepted_steps, []

    def fail_second_append(self, *arguments):
        calls.append(1)
        if len(calls) == 2:
            raise MemoryError
        return append(self, *arguments)

    monkeypatch.setattr(Run, "_save_accepted_steps", fail_second_append)
    solution = lt.integrate(rigid_body(), X0, (0.0, 500.0), lt.Adaptive(1e-9))
    assert "no memory left" in solution.status.message
    assert 1 < len(solution.t) == len(solution.x) == len(solution.energy)


def test_another_error_is_not_hidden(monkeypatch):
    def raise_unknown_error(self, *arguments):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")

    monkeypatch.setattr(EngineWithFallback, "advance_trajectory", raise_unknown_error)
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.1)


def test_the_reference_solver(monkeypatch):
    field, calls = reference._vector_field, []

    def interrupt_field(*arguments):
        calls.append(1)
        if len(calls) == 200:
            raise KeyboardInterrupt
        return field(*arguments)

    monkeypatch.setattr(reference, "_vector_field", interrupt_field)
    solution = lt.integrate(rigid_body(), X0, (0.0, 50.0), 0.1, lt.Reference(1e-9))
    assert solution.status.code == "interrupted"
    assert "stopped by the user after t =" in solution.status.message
    assert 2 < len(solution.t) == len(solution.x) < 501
    monkeypatch.undo()
    whole_run = lt.integrate(rigid_body(), X0, (0.0, 50.0), 0.1, lt.Reference(1e-9))
    assert np.array_equal(whole_run.x[: len(solution.x)], solution.x)


# -- processes that are forked ----------------------------------------------------------------------------------------


FORKED_SCRIPT = """
import multiprocessing, os, signal, sys
import liethermo as lt
body, x0 = lt.models.rigid_body(), [0.1, 1.0, 0.1]
lt.integrate(body, x0, (0.0, 1.0), 0.1)
child = os.fork()
if child == 0:
    signal.alarm(60)
    lt.integrate(body, x0, (0.0, 2.0), 0.1)  # a program that there is
    try:
        lt.integrate(body, x0, (0.0, 1.0), 0.1, lt.MetriplecticRungeKutta(8)).audit()
    except RuntimeError as error:
        print(type(error).__name__, error)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_does_not_wait_for_ever():
    run = [sys.executable, "-W", "ignore", "-c", FORKED_SCRIPT]
    completed_process = subprocess.run(run, capture_output=True, text=True, check=False, timeout=120)
    assert completed_process.returncode == 0, completed_process.stderr
    assert completed_process.stdout.startswith("ForkError this process was forked after JAX had run")
    assert 'get_context("spawn")' in completed_process.stdout
    assert issubclass(mf.ForkError, RuntimeError)


def _entropy_of_run(rate: float) -> float:
    return float(lt.integrate(lt.models.rigid_body(rate=rate), X0, (0.0, 1.0), 0.1).entropy[-1])


def test_processes_of_their_own_are_no_fork():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(_entropy_of_run, [0.5]) == [_entropy_of_run(0.5)]
