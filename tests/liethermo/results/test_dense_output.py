"""Dense output: states between the steps have the order of the method and obey its laws, compared with SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

import liethermo as lt
import manifolds as mf

INERTIA = np.array([3.0, 2.0, 1.0])


def kinetic(p):
    return 0.5 * jnp.sum(p * p / INERTIA) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1])


def momentum_system(**options):
    return lt.LiePoissonSystem(
        mf.so(3), kinetic, lambda p: jnp.log(1.0 + p @ p), lt.ProjectedMetric(rate=0.3), **options
    )


SYSTEMS = {
    "so(3)": momentum_system,
    "sphere": lambda: lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), kinetic, space=mf.Sphere(2), validate=False),
    "attitude": lambda: momentum_system(group=mf.SO(3)),
}


@functools.cache
def system_of(name):
    return SYSTEMS[name]()


START = np.array([0.6, 0.64, 0.48])
END = 4.0
TIMES = np.linspace(0.0, END, 64)[1:-1]  # none at the end of a step

METHODS = {  # each with a step whose error is far above rounding
    "RK4": (lt.MetriplecticRungeKutta(4), 0.4),
    "RK6": (lt.MetriplecticRungeKutta(6), 0.8),
    "RK8": (lt.MetriplecticRungeKutta(8), 1.0),
    "Gauss1": (lt.MetriplecticGauss(1), 0.2),
    "Gauss2": (lt.MetriplecticGauss(2), 0.4),
    "Gauss3": (lt.MetriplecticGauss(3), 0.8),
    "Taylor6": (lt.MetriplecticTaylor(6), 0.8),
}


@functools.cache
def exact_states(name):
    """Return the momenta at TIMES: an attitude does not change them, and on the sphere there is no friction."""
    body = lt.LiePoissonSystem(mf.so(3), kinetic) if name == "sphere" else system_of("so(3)")

    field = jax.jit(lambda x: body.vector_field(x))
    return solve_ivp(lambda _, x: np.asarray(field(x)), (0.0, END), START, "DOP853", TIMES, rtol=1e-13, atol=1e-15).y.T


CASE_IDS = [f"{system}-{method}" for system in SYSTEMS for method in METHODS]


@pytest.mark.sampled("so(3)-RK8", "attitude-RK4")
@pytest.mark.parametrize("case", CASE_IDS, ids=CASE_IDS)
def test_the_order_and_the_laws_of_the_method_hold_between_its_steps(case):
    name, method = case.split("-")
    system, (method, h), errors = system_of(name), METHODS[method], []
    for step in (h, h / 2):
        run = lt.integrate(system, START, (0.0, END), step, method, dense=True)
        states = run(TIMES)
        assert np.array_equal(run(run.t), run.x)
        errors.append(np.abs(states - exact_states(name)).max())
        energies = np.asarray(system.energy(states))
        assert np.ptp(np.append(energies, run.energy[0])) < 4e-15
        if system.entropy is not None:
            entropies = np.asarray(system.entropy(states))
            entropies_before = run.entropy[np.searchsorted(run.t, TIMES, side="right") - 1]
            assert (entropies - entropies_before).min() > -4e-16
    assert np.log2(errors[0] / errors[1]) > method.order - 0.8, errors
    assert errors[1] > 1e-12, "rounding tells nothing of an order"


def test_control_the_cubic_between_has_an_order_of_its_own():
    """Control: the cubic Hermite interpolant of the steps has order 4, whatever the method."""
    system, (method, h), errors = system_of("so(3)"), METHODS["RK8"], []
    for step in (h, h / 2):
        run = lt.integrate(system, START, (0.0, END), step, method)
        slopes = np.array([np.asarray(system.vector_field(x)) for x in run.x])
        errors.append(np.abs(CubicHermiteSpline(run.t, run.x, slopes)(TIMES) - exact_states("so(3)")).max())
    assert np.log2(errors[0] / errors[1]) < 5.0


@pytest.mark.parametrize("engine", ["compiled", "array"])
def test_states_between_adaptive_steps(engine):
    """Dense output of adaptive steps takes times of any shape, refuses extrapolation, and is NaN if a step fails."""
    run = lt.integrate(
        system_of("so(3)"),
        START,
        (0.0, END),
        lt.Adaptive(1e-8),
        lt.MetriplecticRungeKutta(4),
        dense=True,
        engine=engine,
    )
    assert run(1.0).shape == (3,)
    assert run(np.ones((2, 5))).shape == (2, 5, 3)
    assert np.array_equal(run(1.0), run([[1.0]])[0, 0])
    with pytest.raises(lt.InputError, match=r"t must be from 0 to 4, .*, got 4\.1"):
        run(4.1)
    assert run.dense is not None
    assert np.isnan(run.dense.step_ends(run.x[:1], np.array([1e6]))).all()
