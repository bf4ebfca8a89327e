"""Many spins component by component: the functions, steps and derivatives are those of states that are site by site."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines import array_engine
from liethermo.engines.solver_options import DEFAULT_OPTIONS
from liethermo.engines.step import initial_run_state_program, reorder_components, take_step
from liethermo.functions.gradients import DISCRETE_GRADIENTS, discrete_gradients_at_stages
from liethermo.functions.on_spaces import spins_to_component_order, spins_to_site_order
from liethermo.integrators.base import pullback_method
from liethermo.integrators.tableaus import gauss_tableau, kronrod_rule
from liethermo.systems.spins import reorder_spins
from tests.cases import BuiltOnUse, few_combinations

from .test_spins import ENERGIES, SITES, unit

COUNT = 12
RANDOM = np.random.default_rng(11)
RATES = 0.1 + RANDOM.random(SITES)


def quartic(s):
    return jnp.sum(s[..., 0] ** 4 * jnp.roll(s[..., 2], 1, axis=0))


def spins(*terms, baths=None, dissipation=None, **more):
    energy = sum(terms[1:], terms[0])
    return lt.SpinSystem(SITES, energy, dissipation, baths, **more)


LATTICE = ("exchange", "diagonal neighbours", "DMI", "anisotropy", "Zeeman")


def of(*names):
    return [ENERGIES[name][0] for name in names]


def quartic_energy():
    return lt.functions.energy.Function(quartic)


SYSTEMS = BuiltOnUse(
    {
        **{name: lambda name=name: spins(*of(name)) for name in ENERGIES},
        "all together": lambda: spins(*of(*LATTICE, "edges"), dissipation=lt.LandauLifshitz(RATES)),
        "minus": lambda: spins(-of("exchange")[0]),
        "a row of the sites": lambda: spins(lt.magnetism.exchange(COUNT, 0.3), lt.magnetism.exchange(SITES, 0.4)),
        "some of the sites": lambda: spins(lt.magnetism.exchange(5, 0.3)),
        "a function": lambda: spins(
            lt.magnetism.exchange(SITES, 0.3), quartic_energy(), dissipation=lt.LandauLifshitz(0.1)
        ),
        "baths": lambda: spins(
            *of(*LATTICE),
            baths=lt.HeatBaths(capacity=[3.0, 5.0], number=2),
            dissipation=lt.LandauLifshitz(RATES, np.arange(COUNT).reshape(SITES) % 2),
            ratio=RATES,
        ),
        "one bath": lambda: spins(*of(*LATTICE), baths=lt.HeatBaths(), dissipation=lt.LandauLifshitz(0.2)),
        "a function with a bath": lambda: spins(
            quartic_energy(), baths=lt.HeatBaths(), dissipation=lt.LandauLifshitz(RATES)
        ),
    }
)
METHODS = [
    lt.MetriplecticMidpoint(),
    lt.MetriplecticMidpoint("mean_value"),
    lt.MetriplecticGauss(1),
    lt.MetriplecticGauss(2),
    lt.MetriplecticRungeKutta(4),
]


def state(system, seed=0):
    x = system.samples(1, seed)[0]
    return jnp.asarray(x)


@jax.jit
def evaluate_functions(system, x, d, compensation, k):
    """Return the values that a step asks of a system: two numbers, the rounding scale, and vectors."""
    A, b, _ = gauss_tableau(2)
    energy = system.energy
    gradients = [
        scheme(energy, x, d, compensation)
        for scheme in DISCRETE_GRADIENTS.values()
        if scheme.is_coordinate_order_independent
    ]
    stages = discrete_gradients_at_stages(energy, x, compensation, 0.1, k, A, b, kronrod_rule(2))
    vectors = jnp.stack([energy.gradient(x), system.vector_field(x), *gradients, *stages])
    return jnp.stack([energy.value(x), energy.sensitivity(x)]), energy.rounding_scale(x), vectors


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SYSTEMS)
def test_functions_are_the_same(name):
    system = SYSTEMS[name]
    found_values, x = reorder_spins(system), state(system)
    d, compensation, k = (scale * jnp.asarray(RANDOM.standard_normal(shape)) for scale, shape in shapes(x.size))
    one = evaluate_functions(system, x, d, compensation, k)
    other = evaluate_functions(found_values.system, *map(found_values.reorder_state, (x, d, compensation, k)))
    assert found_values.system.energy.is_quadratic == system.energy.is_quadratic
    np.testing.assert_allclose(other[0], one[0], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found_values.restore_state(other[2]), one[2], rtol=1e-12, atol=1e-13)
    assert 0.3 < float(other[1] / one[1]) < 3.0  # the size of a rounding, which sums have in another order


def shapes(n):
    return (0.1, (n,)), (1e-17, (n,)), (1.0, (2, n))


@pytest.mark.slow
@few_combinations(name=["all together", "a function", "baths", "one bath"], method=METHODS)
def test_steps_are_the_same(name, method):
    system, h = SYSTEMS[name], jnp.asarray(0.02)
    method = method.on(system)
    found_values = reorder_spins(system)
    one = initial_run_state_program(system, method, state(system))
    other = initial_run_state_program(
        found_values.system, pullback_method(method, found_values), found_values.reorder_state(state(system))
    )
    step = jax.jit(take_step)
    for _ in range(3):
        one, other = (
            step(system, method, one, h),
            step(found_values.system, pullback_method(method, found_values), other, h),
        )
    assert int(one.status) == int(other.status) == 0
    for name in ("x", "energy", "entropy", "largest_energy_increment", "energy_sensitivity"):
        ours = getattr(other, name)
        np.testing.assert_allclose(
            found_values.restore_state(ours) if name == "x" else ours, getattr(one, name), rtol=1e-11, atol=1e-13
        )


N_LARGE = 400


def ring(**changes):
    return lt.models.spin_lattice(N_LARGE, anisotropy_constant=0.1, rate=0.2, **changes)


@pytest.mark.slow
@pytest.mark.parametrize("method", [METHODS[0], *METHODS[3:], lt.MetriplecticTaylor(4)], ids=str)
def test_a_run_of_a_large_system_is_in_that_order_and_no_user_sees_it(method, monkeypatch):
    system = ring()
    x0 = system.state(unit(N_LARGE))
    assert x0.size > DEFAULT_OPTIONS.rms_norm_dim
    run = (system, x0, (0.0, 0.2), 0.05, method)
    found_values = lt.integrate(*run)
    assert found_values.audit().passed
    np.testing.assert_allclose(np.linalg.norm(system.spins(found_values.x), axis=-1), 1.0, atol=1e-14)
    monkeypatch.setattr("liethermo.engines.step.reorder_spins", lambda system: None)
    jax.clear_caches()
    np.testing.assert_allclose(found_values.x, lt.integrate(*run).x, rtol=1e-11, atol=1e-13)
    jax.clear_caches()


@pytest.mark.slow
def test_levels_keep_their_places():
    """Levels of an explicit method are no components of a state."""
    system, method = ring(), lt.MetriplecticRungeKutta(4)
    own = method.on(system)
    first = initial_run_state_program(system, own, jnp.asarray(system.state(unit(N_LARGE))))
    _, _, inside, back = reorder_components(system, own, first)
    np.testing.assert_array_equal(inside.k[3], first.k[3])
    for name, value in first._asdict().items():
        np.testing.assert_array_equal(getattr(back(inside), name), value)


@pytest.mark.slow
def test_adaptive_steps_are_the_same(monkeypatch):
    def path():
        system = ring()
        return lt.integrate(system, system.state(unit(N_LARGE)), (0.0, 0.2), lt.Adaptive(1e-6), METHODS[-1]).x[-1]

    found_values = path()
    monkeypatch.setattr("liethermo.engines.step.reorder_spins", lambda system: None)
    jax.clear_caches()
    np.testing.assert_allclose(found_values, path(), rtol=1e-10, atol=1e-12)
    jax.clear_caches()


@pytest.mark.slow
def test_noise_is_that_of_sites_whatever_the_order(monkeypatch):
    def path():
        system = ring()
        noise = lt.Fluctuations(1e-3, seed=1)
        return lt.integrate(system, system.state(unit(N_LARGE)), (0.0, 0.2), 0.05, noise=noise).x[-1]

    found_values = path()
    monkeypatch.setattr("liethermo.engines.step.reorder_spins", lambda system: None)
    jax.clear_caches()
    np.testing.assert_allclose(found_values, path(), rtol=1e-11, atol=1e-13)
    jax.clear_caches()


@pytest.mark.slow
def test_a_scheme_that_takes_coordinates_in_their_order_keeps_it():
    system, method = SYSTEMS["one bath"], lt.MetriplecticMidpoint("coordinate_increment")
    first = initial_run_state_program(system, method, state(system))
    assert reorder_components(system, method, first, replace(DEFAULT_OPTIONS, rms_norm_dim=1))[0] is system
    assert (
        reorder_components(system, lt.MetriplecticMidpoint(), first, replace(DEFAULT_OPTIONS, rms_norm_dim=1))[0]
        is not system
    )


@pytest.mark.slow
def test_derivatives_go_through():
    system, method = ring(), lt.MetriplecticMidpoint()
    x0, v = jnp.asarray(system.state(unit(N_LARGE))), jnp.asarray(RANDOM.standard_normal(3 * N_LARGE + 1))

    def end(x):
        return lt.flow(system, x, (0.0, 0.1), 0.05, method)

    found_values = jax.jvp(end, (x0,), (v,))[1]
    h = 1e-5
    np.testing.assert_allclose(found_values, (end(x0 + h * v) - end(x0 - h * v)) / (2 * h), rtol=1e-5, atol=1e-6)


def test_what_has_no_other_order():
    assert mf.Spins(3).is_component_major is False
    assert reorder_spins(ring(baths=False)) is not None
    other = lt.SpinSystem(3, lt.magnetism.zeeman(3, (0.0, 0.0, 1.0)), lt.DoubleBracket())
    assert reorder_spins(other) is None  # what that does with components is not known
    assert reorder_spins(reorder_spins(ring()).system) is None
    driven = lt.SpinSystem(3, lambda s, t: t * jnp.sum(s))
    assert reorder_spins(driven) is None
    assert reorder_spins(lt.models.rigid_body()) is None

    class DoubledFriction(lt.LandauLifshitz):
        def force(self, system, x, dH, dS, dL):
            return 2.0 * super().force(system, x, dH, dS, dL)

    mine = lt.SpinSystem(3, lt.magnetism.zeeman(3, (0.0, 0.0, 1.0)), DoubledFriction(0.1))
    assert type(mine.dissipation) is DoubledFriction  # which may say something else of components
    assert reorder_spins(mine) is None
    once = lt.SpinSystem(3, lt.magnetism.zeeman(3, (0.0, 0.0, 1.0)), lt.LandauLifshitz(0.1))
    x, motion = state(mine), mine.poisson.sharp(state(mine), mine.energy.gradient(state(mine)))
    np.testing.assert_allclose(mine.vector_field(x) - motion, 2.0 * (once.vector_field(x) - motion), atol=1e-15)


def test_the_two_orders():
    x = np.arange(14.0)
    assert spins_to_component_order(x, 4).tolist() == [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11, 12, 13]
    np.testing.assert_array_equal(spins_to_site_order(spins_to_component_order(np.stack([x, -x]), 4), 4), [x, -x])


@pytest.mark.slow
def test_control_a_wrong_order_is_seen():
    """Steps from a state in the other order, taken for one that is not."""
    system = ring()
    found_values = reorder_spins(system)
    first = initial_run_state_program(system, lt.MetriplecticMidpoint(), jnp.asarray(system.state(unit(N_LARGE))))
    right = array_engine.take_steps_and_save(
        system, lt.MetriplecticMidpoint(), first, *map(jnp.asarray, (0.05, 1, 1)), 1
    )[0]
    wrong = first._replace(x=found_values.reorder_state(first.x))
    other = array_engine.take_steps_and_save(
        system, lt.MetriplecticMidpoint(), wrong, *map(jnp.asarray, (0.05, 1, 1)), 1
    )[0]
    assert np.abs(right.x - found_values.restore_state(other.x)).max() > 1e-3
