"""The array engine's solver where a step has too many unknowns for a matrix."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.base import Dissipation
from liethermo.engines import array
from liethermo.engines.krylov import krylov
from liethermo.engines.rules import RULES
from liethermo.engines.stages import Equations, solve_stages
from liethermo.engines.stepping import begin

COUNT = 5_000


class Damping(Dissipation):
    """Of the spins along ``s x (s x dH)``, which heats a bath with the entropy x[-1]: as a user would write it."""

    rate: jax.Array

    def force(self, system, x, dH, dS, dL):
        s, a, b = (y[:-1].reshape(-1, 3) for y in (x, dH, dS))
        torque = jnp.cross(s, a)
        pull = dH[-1] * jnp.cross(s, b) - dS[-1] * torque
        return jnp.append((self.rate * jnp.cross(pull, s)).ravel(), -self.rate / dH[-1] * jnp.sum(torque * pull))


def ring(count, exchange=1.0):
    """A ring of spins with exchange and an easy axis, written with plain functions of a state in R^(3 count + 1)."""

    def energy(x):
        s = x[:-1].reshape(-1, 3)
        bath = count * jnp.exp(x[-1] / count)
        return bath - exchange * jnp.sum(s * jnp.roll(s, 1, axis=0)) - 0.1 * jnp.sum(s[:, 2] ** 2)

    def turned(x, alpha):
        s, a = (y[:-1].reshape(-1, 3) for y in (x, alpha))
        return jnp.append(jnp.cross(s, a).ravel(), 0.0)

    return lt.MetriplecticSystem(
        mf.PoissonMap(turned, 3 * count + 1), energy, lambda x: x[-1], Damping(jnp.asarray(0.1)), validate=False
    )


def disorder(count, seed=0):
    s = np.random.default_rng(seed).standard_normal((count, 3))
    return np.append((s / np.linalg.norm(s, axis=1)[:, None]).ravel(), 0.0)


@pytest.mark.slow
def test_many_damped_spins_take_long_steps():
    """One spin of so many always has an update that shrinks late; steps of 1.0 need Newton's method."""
    system, x = ring(COUNT), disorder(COUNT)
    for h, steps in ((0.1, 20), (1.0, 3)):
        solution = lt.integrate(system, x, (0.0, steps * h), h, save_every=steps, engine="array")
        energy, stats = solution.energy, solution.stats
        assert abs(energy[-1] - energy[0]) <= 1e-13 * abs(energy[0])
        assert stats.least_entropy_increment > 1.0
        assert (stats.newton_iterations > 0) == (h == 1.0)
        s = solution.x[-1, :-1].reshape(-1, 3)
        assert np.abs(np.linalg.norm(s, axis=1) - 1.0).max() < 1e-14


def stiff(n, rate):
    """A chain of heat, of rates up to 4 ``rate``, beside a rotation: the misfit of a midpoint step is linear."""
    rng = np.random.default_rng(0)
    source = jnp.asarray(rng.standard_normal((1, n)))

    def slopes(k):
        x = 0.5 * k
        flow = rate * (jnp.roll(x, 1, axis=1) + jnp.roll(x, -1, axis=1) - 2.0 * x)
        return source + flow + 0.2 * (jnp.roll(x, 1, axis=1) - jnp.roll(x, -1, axis=1))

    return slopes, source


def solved(slopes, guess, rules=RULES):
    def inverted(k):
        product = jax.linearize(lambda k: slopes(k) - k, k)[1]
        return lambda found: krylov(product, found, rules)

    n = guess.shape[1]
    measure = rules.size(n)
    return solve_stages(Equations(slopes, guess, lambda k: 1.0 + measure(k), inverted), rules)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 10.0, 1000.0])
def test_stiff_equations_are_solved_to_rounding_without_their_matrix(rate):
    slopes, guess = stiff(1_500, rate)
    found = solved(slopes, guess)
    matrix = np.eye(1_500) - np.asarray(jax.jacfwd(lambda k: slopes(k[None])[0])(jnp.zeros(1_500)))
    exact = np.linalg.solve(matrix, np.asarray(slopes(jnp.zeros_like(guess)))[0])
    assert bool(found.converged)
    assert np.abs(np.asarray(found.k)[0] - exact).max() < 1e-12
    assert (int(found.newton) > 0) == (rate > 1.0)


def test_it_is_said_where_the_equations_are_not_solved():
    slopes, guess = stiff(1_500, 1000.0)
    few = replace(RULES, products=2, newton=2, halvings=0)
    assert not bool(solved(slopes, guess, few).converged)
    assert not bool(solved(lambda k: 2.0 * k * k + 1.0, guess).converged)  # there is no such k


@pytest.mark.slow
def test_the_work_does_not_depend_on_how_many_copies_there_are():
    """Of a ring that fills the state so many times over: sizes are means, so the iterations are the same."""
    one = disorder(400)[:-1]
    counts = []
    for copies in (1, 8):
        system, x = ring(400 * copies, 3.0), np.append(np.tile(one, copies), 0.0)
        method = lt.MetriplecticGauss(1).on(system)
        state = begin(system, method, x)
        after = array.ArrayEngine(system, method).step(state, 0.2)
        assert int(after.status) == 0
        counts.append((int(after.fixed_point), int(after.newton)))
    assert counts[0][1] > 0
    assert abs(counts[0][0] - counts[1][0]) <= 1
    assert abs(counts[0][1] - counts[1][1]) <= 1


def test_krylov_solves_what_dense_elimination_solves():
    rng = np.random.default_rng(1)
    skew = rng.standard_normal((60, 60))
    matrix = jnp.asarray(np.eye(60) + 0.3 * (skew - skew.T))
    b = jnp.asarray(rng.standard_normal(60))
    x = krylov(lambda v: matrix @ v, b, replace(RULES, forcing=1e-12, kept=60))
    np.testing.assert_allclose(x, np.linalg.solve(matrix, b), atol=1e-11)
    short = krylov(lambda v: matrix @ v, b, replace(RULES, forcing=1e-3, kept=2))
    assert np.linalg.norm(matrix @ short - b) <= 1.01e-3 * np.linalg.norm(b)
    assert not np.asarray(krylov(lambda v: matrix @ v, jnp.zeros(60), RULES)).any()
