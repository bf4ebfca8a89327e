"""What is asked for is what comes: true errors of adaptive steps against the tolerance, over ten problems."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from tests.liethermo.integrators.test_convergence import PROBLEMS, SYSTEMS

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)

LEAST = {2: 1e-8, 4: 1e-10}
"""The smallest tolerance that is tried with a method, by its order: others take 10^4 steps and more."""

STEPS = 6
"""Steps of a run whose errors are found."""

METHODS = lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)


def relaxed_body(m):
    rates = m / np.array([5.0, 4.0, 2.0])
    return np.cross(m, rates) + 0.5 * ((rates @ rates) * m - (rates @ m) * rates)


def problems():
    for name, problem in PROBLEMS.items():
        yield SYSTEMS[name](), problem.field, problem.start, problem.time
    yield lt.models.rigid_body((5.0, 4.0, 2.0), rate=0.5), relaxed_body, (0.2, 1.0, 0.3), 5.0


def flown(field, x, t):
    """By an independent program."""
    return solve_ivp(lambda _, x: field(x), (0.0, t), x, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]


def ratios(method, rtol: float) -> tuple[list[float], list[float]]:
    """True errors over those asked for: of steps from the middle of each run, and at the ends of the runs."""
    steps, ends = [], []
    for system, field, x0, time in problems():
        assert np.abs(np.asarray(system.vector_field(np.array(x0))) - field(np.array(x0))).max() < 1e-14
        run = lt.integrate(system, x0, (0.0, time), lt.Adaptive(rtol), method, engine="compiled")
        ends.append(np.abs(run.x[-1] - flown(field, x0, time)).max() / (rtol * np.abs(run.x).max()))
        full = range(1, max(2, len(run.t) - 3))  # the first tries, and the last are cut to arrive
        for i in np.unique(np.linspace(full[0], full[-1], STEPS).astype(int)):
            true = np.abs(run.x[i + 1] - flown(field, run.x[i], run.t[i + 1] - run.t[i])).max()
            steps.append(true / (rtol * np.abs(run.x[i : i + 2]).max()))
    return steps, ends


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_median_error_is_what_was_asked_for(method):
    """To a factor of ten, over all problems and tolerances.

    Of implicit methods in a step; the errors of all steps add up to what there is at the end. The estimate of explicit
    ones is the more careful, and what was asked for is there at the end.
    """
    found = {rtol: ratios(method, rtol) for rtol in TOLERANCES if rtol >= LEAST.get(method.order, 0.0)}
    table = {rtol: [float(np.median(values).round(2)) for values in both] for rtol, both in found.items()}
    print(method, table)
    steps, ends = (np.concatenate([both[i] for both in found.values()]) for i in (0, 1))
    assert 0.1 < np.median(ends if method.explicit else steps) < 10.0, table
    assert np.median(steps) < 1.0, table
