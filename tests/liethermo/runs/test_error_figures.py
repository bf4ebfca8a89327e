"""Adaptive steps reach the tolerance: true errors against it, over ten problems."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from tests.liethermo.integrators.test_convergence import PROBLEMS, SYSTEMS

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)

MIN_RTOL = {2: 1e-6, 4: 1e-8, 6: 1e-10}
"""The smallest tolerance that is tried with a method, by its order: others take 10^4 steps and more."""

METHODS = (
    lt.MetriplecticMidpoint(),
    *map(lt.MetriplecticGauss, (2, 3)),
    *map(lt.MetriplecticRungeKutta, (4, 6, 8)),
    *map(lt.MetriplecticTaylor, (None, 6, 12, 20)),
)

DURATION_FACTOR = 4.0
"""The runs of other tests, in which most of these go less than their own size, are taken so much further."""


def relaxed_body(m):
    rates = m / np.array([5.0, 4.0, 2.0])
    return np.cross(m, rates) + 0.5 * ((rates @ rates) * m - (rates @ m) * rates)


def problems():
    """Systems, their fields written out, where they start and until when they run, one after another."""
    for name, problem in PROBLEMS.items():
        lasts = problem.time if name == "bianchi V" else DURATION_FACTOR * problem.time  # that one runs away at t = 1.6
        yield SYSTEMS[name](), problem.field, problem.start, lasts
    yield lt.models.rigid_body((5.0, 4.0, 2.0), rate=0.5), relaxed_body, (0.2, 1.0, 0.3), 5.0 * DURATION_FACTOR


def flown(field, x, times):
    """By an independent program."""
    span = (0.0, times[-1])
    return solve_ivp(lambda _, x: field(x), span, x, "DOP853", times, rtol=1e-13, atol=1e-15).y.T


def ratios(method, rtol: float) -> list[float]:
    """The largest true errors of runs over those asked for."""
    errors = []
    for system, field, x0, time in problems():
        assert np.abs(np.asarray(system.vector_field(np.array(x0))) - field(np.array(x0))).max() < 1e-14
        run = lt.integrate(system, x0, (0.0, time), lt.Adaptive(rtol), method, engine="compiled")
        errors.append(np.abs(run.x - flown(field, x0, run.t)).max() / (rtol * np.abs(run.x).max()))
    return errors


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_error_of_a_run_is_what_was_asked_for(method):
    """In the median over the problems, and the same share of it at every tolerance: it is proportional to that."""
    error_ratios = {
        rtol: ratios(method, rtol)
        for rtol in TOLERANCES
        if rtol >= MIN_RTOL.get(method.on(lt.models.rigid_body(), rtol).order, 0.0)
    }
    medians = {rtol: float(np.median(values).round(3)) for rtol, values in error_ratios.items()}
    print(method, medians)
    assert min(medians.values()) > 0.05
    assert max(medians.values()) < 3.0
    assert max(medians.values()) < 4.0 * min(medians.values())
    assert 0.1 < np.median(np.concatenate(list(error_ratios.values()))) < 10.0
