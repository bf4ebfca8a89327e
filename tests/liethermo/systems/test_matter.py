"""Bodies that exchange matter: membranes and reactions, their laws, and where they come to rest."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from liethermo.dissipation.bodies import Process, conserved_number_combinations
from liethermo.models.gases import porous_piston_state
from liethermo.systems.invariants import recorded_functions_with_verdicts
from tests.refusals import refusal_test

piston, vessel = functools.cache(lt.models.porous_piston), functools.cache(lt.models.reaction_vessel)
GAS = lt.models.IdealMixture(np.array([1.5, 1.5, 2.5]), np.array([0.0, 0.0, -2.0]), np.array([0.0, 0.0, 0.5]))


@functools.cache
def start():
    return porous_piston_state((1.5, 1.2), (0.8, 0.7), 0.9)


def gas_state():
    N = jnp.array([1.0, 0.7, 0.1])
    return np.array([float(GAS.entropy_at(0.8, N, 1.0)), *N, 20.0 * np.log(1.5)])


def piston_by_hand(t, y):
    """The default porous piston, written out."""
    S_l, N_l, q, v, S_p, S_r, N_r = y
    T = lambda S, n: np.exp((S / n[0] + np.log(n[0] / n[1])) / 1.5)  # noqa: E731
    left, right = (N_l, q), (N_r, 2.0 - q)
    T_l, T_r, T_p = T(S_l, left), T(S_r, right), np.exp(S_p)
    mu_l, mu_r = (2.5 * T - T * (1.5 * np.log(T) - np.log(N / V)) for T, (N, V) in ((T_l, left), (T_r, right)))
    e = 0.5 * (mu_l + mu_r)
    J = 0.05 * (e * (1.0 / T_l - 1.0 / T_r) - (mu_l / T_l - mu_r / T_r))
    force = N_l * T_l / q - N_r * T_r / (2.0 - q) - 0.5 * v
    warmed = (0.5 * v * v + 0.5 * (T_l - T_p) + 0.5 * (T_r - T_p)) / T_p
    of_left = ((e - mu_l) * J + 0.5 * (T_p - T_l)) / T_l
    return [of_left, J, v, force, warmed, (-(e - mu_r) * J + 0.5 * (T_p - T_r)) / T_r, -J]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "order"),
    [(lt.MetriplecticGauss(2), 4.0), (lt.MetriplecticMidpoint(), 2.0), (lt.MetriplecticRungeKutta(6), 6.0)],
    ids=str,
)
def test_a_porous_piston_against_its_equations_written_out(method, order):
    exact = solve_ivp(piston_by_hand, (0.0, 2.0), start(), method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    runs = [lt.integrate(piston(), start(), (0.0, 2.0), h, method) for h in (0.05, 0.025)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2, errors
    audit = runs[0].audit()
    assert audit.energy_drift < 1e-14
    assert np.diff(runs[0].entropy).min() > 0.0
    assert np.ptp(piston().numbers_of_particles(runs[0].x).sum(axis=1)) < 1e-14


@pytest.mark.slow
def test_a_porous_piston_rests_at_equal_densities():
    """Temperatures, pressures and chemical potentials agree; both laws hold on the way."""
    run = lt.integrate(piston(), start(), (0.0, 200.0), 0.1)
    assert run.audit().passed
    end = run.x[-1]
    T, mu = np.asarray(piston().temperatures(end)), np.asarray(piston().chemical_potentials(end))
    assert np.ptp(T) < 1e-12
    assert np.ptp(mu) < 1e-12
    assert end[1] / end[2] == pytest.approx(2.3 / 2.0, rel=1e-12)
    assert end[6] / (2.0 - end[2]) == pytest.approx(2.3 / 2.0, rel=1e-12)
    assert abs(end[1] - 1.5) > 0.01  # particles have passed


def test_the_law_of_mass_action():
    """The densities at rest are those of K(T), which the model computes from standard potentials; atoms are counted."""
    run = lt.integrate(vessel(), gas_state(), (0.0, 300.0), 0.1)
    assert run.audit().passed
    end = run.x[-1]
    T = np.asarray(vessel().temperatures(end))
    assert np.ptp(T) < 1e-12
    assert end[3] / (end[1] * end[2]) == pytest.approx(
        float(GAS.equilibrium_constant(T[0], (-1.0, -1.0, 1.0))), rel=1e-12
    )
    for name, (C, kept) in recorded_functions_with_verdicts(vessel()).items():
        assert kept, name
        assert np.ptp(np.asarray(C(run.x))) < 1e-14
    assert len(recorded_functions_with_verdicts(vessel())) == 2  # A + C and B + C
    assert abs(end[3] - 0.1) > 0.1


@pytest.mark.slow
def test_rates_of_mass_action():
    """``L = (k_f n_A n_B - k_b n_C) T / A`` gives the rates themselves, and is positive on either side of rest."""

    def L(x):
        T = GAS.temperature(x[0], x[1:4], 1.0)
        K = GAS.equilibrium_constant(T, (-1.0, -1.0, 1.0))
        rate = x[1] * x[2] - x[3] / K  # k_f = 1
        affinity = T * jnp.log(x[1] * x[2] * K / x[3])
        return rate * T / affinity

    body = lt.Subsystem(lambda x: GAS.internal_energy(x[0], x[1:], 1.0), 4, species=3)
    system = lt.ComposedSystem([body], reactions=[lt.Reaction(0, (-1, -1, 1), L)], validate=False)
    for N in ([1.0, 0.7, 0.1], [0.1, 0.1, 3.0]):
        x = np.array([float(GAS.entropy_at(0.8, jnp.array(N), 1.0)), *N])
        K = float(GAS.equilibrium_constant(0.8, (-1.0, -1.0, 1.0)))
        assert np.allclose(system.vector_field(x)[3], N[0] * N[1] - N[2] / K, rtol=1e-12)
        assert lt.integrate(system, x, (0.0, 1.0), 0.05).audit().passed


@pytest.mark.slow
def test_particles_that_carry_entropy():
    """Between equal chemical potentials over T, what they carry alone decides; the energy is exact either way."""
    gas = lambda: lt.Subsystem(lambda x: GAS.internal_energy(x[0], jnp.append(x[1:], jnp.ones(2)), 1.0), 2, species=1)  # noqa: E731
    x = np.array([1.0, 1.0, 1.3, 0.9])
    fluxes = []
    for carries in (0.0, 2.0):
        membranes = [lt.Membrane(0, 1, 0.1, carries=carries)]
        system = lt.ComposedSystem([gas(), gas()], membranes=membranes, validate=False)
        T, mu = np.asarray(system.temperatures(x)), np.asarray(system.chemical_potentials(x))
        e = mu.mean() + carries * T.mean()
        J = 0.1 * (e * (1.0 / T[0] - 1.0 / T[1]) - (mu[0] / T[0] - mu[1] / T[1]))
        assert np.allclose(system.vector_field(x)[1], J, rtol=1e-13)
        assert abs(float(system.energy.gradient(x) @ system.vector_field(x))) < 1e-15
        assert lt.integrate(system, x, (0.0, 5.0), 0.1).audit().passed
        fluxes.append(J)
    assert abs(fluxes[1] - fluxes[0]) > 1e-3


def test_numbers_that_no_process_changes():
    """2 A -> B and B + C -> D: two are left, by hand (A + 2 B + 2 D and C + D)."""
    processes = [
        Process(nu, (1.0,), (0.0,), jnp.zeros(()), jnp.ones(()))
        for nu in ((-2.0, 1.0, 0.0, 0.0), (0.0, -1.0, -1.0, 1.0))
    ]
    found = conserved_number_combinations(processes, 4)
    assert np.allclose(found, [[1.0, 2.0, 0.0, 2.0], [0.0, 0.0, 1.0, 1.0]])
    assert np.allclose(conserved_number_combinations([], 2), np.eye(2))


@functools.cache
def stone():
    return lt.Subsystem(lambda x: jnp.exp(x[0]), 1)


test_bad_input = refusal_test(
    (lambda: lt.Subsystem(None, 3, species=1), "moving wall as a body of its own"),
    (lambda: lt.ComposedSystem([stone(), stone()], membranes=[lt.Membrane(0, 1, 0.1)]), "has 0 kinds of particles"),
    (
        lambda: lt.ComposedSystem([stone()], membranes=[lt.Membrane(0, 0, 0.1)]),
        "two bodies, got body 0 twice",
    ),
    (lambda: lt.ComposedSystem([stone()], membranes=[lt.Membrane("top", 0, 0.1)]), "no body 'top'"),
    (lambda: lt.ComposedSystem([stone()], reactions=[lt.Reaction(0, (-1, 1), 0.1)]), "0 stoichiometric numbers, got 2"),
    (lambda: lt.Membrane(0, 1, -0.1), "must be >= 0"),
    (lambda: lt.Reaction(0, (-1, 1), [0.1, 0.2]), "one number"),
)
