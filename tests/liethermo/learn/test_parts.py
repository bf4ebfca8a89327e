"""Systems with networks in them obey both laws whatever the weights are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.learn.parts import learned_mask
from liethermo.runs.preparation import prepare_for_method

from . import cases


def _failed_axioms(system):
    return {row.axiom for row in system.check().rows if row.passed is False}


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("construction", "dim", "failed_rows"), [("skew", 4, {"Jacobi"}), ("projected", 3, set())])
def test_the_laws_hold_before_training(construction, dim, failed_rows):
    """With every part learned. The Jacobi identity is not built in, and the check says so.

    In three dimensions a skew tensor with a gradient in its kernel is a Poisson tensor.
    """
    friction = lt.learn.Friction(dim, rank=2, construction=construction, width=4)
    system = lt.learn.Metriplectic(dim, friction=friction, width=4, seed=3)
    assert _failed_axioms(system) == failed_rows
    run = lt.integrate(system, [0.3, -0.2, 0.5, 0.1][:dim], (0.0, 4.0), 0.1, method=lt.MetriplecticGauss(1))
    assert np.ptp(run.energy) < 2e-14 * max(1.0, abs(run.energy[0]))
    assert (np.diff(run.entropy) > 0.0).all()


@pytest.mark.parametrize(
    ("poisson", "dim"),
    [(mf.Canonical(1), 3), (lt.learn.Poisson.lie_poisson(mf.so(3), 4), 4), (lt.learn.Poisson.canonical(1), 2)],
)
def test_known_tensors_are_poisson(poisson, dim):
    entropy = (lambda x: x[-1]) if poisson.dim != dim or dim > 2 else None
    if dim == 2:  # a canonical tensor alone has no other entropy than a constant
        entropy = lambda x: 0.0 * x[0]  # noqa: E731
    system = lt.learn.Metriplectic(dim, entropy=entropy, poisson=poisson, width=8)
    assert _failed_axioms(system) == set()


def test_an_entropy_that_the_motion_would_change_is_refused():
    with pytest.raises(lt.CasimirError):
        lt.learn.Metriplectic(3, poisson=mf.Canonical(1), width=4)
    entropy = lt.learn.Entropy(1, width=4).on([2])
    assert _failed_axioms(lt.learn.Metriplectic(3, entropy=entropy, poisson=mf.Canonical(1), width=4)) == set()


def test_a_friction_off_another_energy_is_found():
    """The control: the kernel of the friction is that of the energy, not of any function."""

    class PermutedFriction(lt.learn.Friction):
        def force(self, system, x, dH, dS, dL):
            return super().force(system, x, jnp.roll(dH, 1), dS, dL)

    system = lt.learn.Metriplectic(3, friction=PermutedFriction(3, width=8), width=8)
    assert {"K grad H = 0", "energy law"} <= _failed_axioms(system)


def test_the_factor_is_that_of_the_friction():
    system = lt.learn.Metriplectic(3, friction=lt.learn.Friction(3, rank=2, construction="projected", width=8), width=8)
    x = jnp.array([0.3, -0.2, 0.5])
    columns = system.dissipation.factor_columns(x, system.energy.gradient(x))
    np.testing.assert_allclose(columns @ columns.T, system.friction_matrix(x), atol=1e-14)
    factor = system.dissipation.factor_at_state(system, x)
    np.testing.assert_allclose(factor.times(jnp.array([1.0, -2.0])), columns @ np.array([1.0, -2.0]), atol=1e-15)


def test_known_terms_stay_and_marked_ones_are_learned():
    energy = lt.Quadratic(np.ones(2)).on([0, 1]) + lt.learn.Energy(2, width=5, depth=1).on([0, 2])
    system = lt.learn.Metriplectic(3, energy=energy, entropy=cases.entropy, poisson=mf.Canonical(1), friction=None)
    leaves = jax.tree_util.tree_leaves(jax.tree_util.tree_map(lambda m: m, learned_mask(system)))
    assert sum(leaves) == 4  # two layers, each a matrix and a vector
    assert not any(jax.tree_util.tree_leaves(learned_mask(lt.models.rigid_body())))


@pytest.mark.parametrize("order", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_a_plain_step_is_the_step_but_for_rounding(order):
    """Its end misses the levels by the square of what the first correction does."""
    system = cases.oscillator(2.0, 0.3)
    x = jnp.array([0.7, -0.4, 0.1])
    run, method = prepare_for_method(system, lt.MetriplecticRungeKutta(order))
    step_without_compensation = jax.jit(lambda h: method.step_without_compensation(run, x, h))
    for h in (0.2, 0.1):
        whole_run = lt.flow(system, x, (0.0, h), h, method=lt.MetriplecticRungeKutta(order))
        assert np.abs(step_without_compensation(h) - whole_run).max() < 10.0 * h ** (2 * order + 2) + 1e-15


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: lt.learn.Energy(lt.Quadratic(np.ones(2))), "Add known terms"),
        (lambda: lt.learn.Energy(0), "number of components must be a positive integer, got 0"),
        (lambda: lt.learn.Friction(3, construction="other"), "'skew' or 'projected'"),
        (lambda: lt.learn.Friction(3, rank=0), "rank must be a positive integer"),
        (lambda: lt.learn.Metriplectic(4, friction=lt.learn.Friction(3)), "3 components, but the state has 4"),
        (lambda: lt.learn.Metriplectic(2, poisson=mf.Canonical(2)), "4 coordinates, more than the 2"),
        (lambda: lt.learn.Metriplectic(4, poisson=lt.learn.Poisson(3)), "dim is 4, but the Poisson structure has 3"),
        (lambda: lt.learn.Metriplectic(2, friction="some"), "got 'some'"),
    ],
)
def test_what_cannot_be_used_is_refused(call, words):
    with pytest.raises(lt.InputError, match=words) as raised:
        call()
    assert "\n" not in str(raised.value)
