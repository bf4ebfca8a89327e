"""The functions that a system conserves: declared, found out, or undecidable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.systems.invariants import (
    are_conserved,
    preserved_function_names,
    recorded_functions_with_verdicts,
    resolve_invariants_near,
    undecided_function_names,
)

EPS = np.finfo(float).eps


CENTRE = np.array([3.0, 3.0, 3.0])


def log_inside_ball(x):
    """Defined in a ball that random points do not meet; its derivative is finite outside too."""
    return jnp.log(1.0 - (x - CENTRE) @ (x - CENTRE))


def total(x):
    return jnp.sum(x)


def system_in_ball(dissipation=None):
    """Friction that keeps the sum."""
    dissipation = (
        lt.ProjectedMetric(preserve=(total,), rate=0.3, normalized=True) if dissipation is None else dissipation
    )
    energy = lambda x: x @ jnp.array([1.0, 2.0, 4.0])  # noqa: E731
    return lt.MetriplecticSystem(None, energy, log_inside_ball, dissipation, dim=3, validate=False)


def test_what_is_declared_is_held_where_nothing_can_be_evaluated():
    system = system_in_ball()
    assert not np.isfinite(log_inside_ball(jnp.asarray(system.samples(8)[0])))
    assert system.first_integrals() == {"total"}
    assert are_conserved(system, (lt.Function(total), lt.Function(lambda x: x[0] ** 2))) == [True, None]
    run = lt.integrate(system, [3.5, 2.7, 3.2], (0.0, 10.0), 0.1, lt.MetriplecticRungeKutta(4))
    assert np.abs(run.casimirs["total"] - 9.4).max() <= 64 * EPS


def test_what_cannot_be_evaluated_is_found_out_near_states_that_are_given():
    system, x0 = system_in_ball(), np.array([3.5, 2.7, 3.2])
    square = lt.Function(lambda x: x[0] ** 2)
    assert are_conserved(system, (lt.Function(total), square), near_states=x0) == [True, False]


class Half(lt.Dissipation):
    """Friction that is defined for states of positive components, and keeps what it keeps without saying so."""

    def force(self, system, x, dH, dS, dL):
        return 0.0 * dS


def test_unknown_is_a_row_of_its_own():
    """The Casimir is neither conserved nor not: the start is on the edge, where the entropy has no derivative."""
    system = lt.LiePoissonSystem(mf.so(3), lambda m: 0.5 * m[2], lambda m: jnp.log(m[0] - 1e6), Half(), validate=False)
    (name,) = system.casimirs()
    assert undecided_function_names(system) == {name}
    assert recorded_functions_with_verdicts(system)[name][1] is None
    assert resolve_invariants_near(system, np.array([2e6, 1.0, 1.0])).first_integrals() == {name}


def test_it_is_known_without_random_points_after_a_pytree_is_taken_apart():
    system = system_in_ball()
    again = jax.tree_util.tree_unflatten(*reversed(jax.tree_util.tree_flatten(system)))
    assert preserved_function_names(again) == preserved_function_names(system)
    assert again.first_integrals() == system.first_integrals()


# -- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, -3.0, 1e20])
def test_two_dissipations_that_preserve_one_quantity_give_it_one_name(scale):
    first, second = (lambda x: x[0] + x[1]), (lambda x: scale * (x[1] + x[0]))
    friction = lt.ProjectedMetric(preserve=(first,), rate=0.1) + lt.ProjectedMetric(preserve=(second,), rate=0.2)
    system = lt.MetriplecticSystem(None, lambda x: x[2] ** 2, lambda x: -x @ x, friction, dim=3)
    assert preserved_function_names(system) == ("preserved 1", "preserved 1")
    assert list(system.functions()) == ["preserved 1"]


def test_a_casimir_or_a_momentum_map_gives_its_name():
    def trace(x):
        return 2.0 * x[8]

    system = lt.LiePoissonSystem(
        mf.u(3), lambda x: x @ jnp.arange(9.0), lambda x: -x @ x + 0.0 * x[0], None, validate=False
    )
    named = lt.LiePoissonSystem(
        mf.u(3), system.energy, lambda x: -x @ x, lt.ProjectedMetric(preserve=trace), validate=False
    )
    assert preserved_function_names(named) == ("mu9",)
    friction = lt.ProjectedMetric(preserve=(lambda x: x[0] + x[1], total))
    energy, maps = (lambda x: x[2] ** 2), {"J": lambda x: 5.0 * (x[0] + x[1])}
    own = lt.MetriplecticSystem(None, energy, lambda x: -x @ x, friction, dim=4, momentum_maps=maps, validate=False)
    assert preserved_function_names(own) == ("J", "total")
    assert list(own.functions()) == ["J", "total"]


def test_other_functions_keep_names_of_their_own():
    friction = lt.ProjectedMetric(preserve=(lambda x: x[0], lambda x: x[0] ** 2 + x[1]))
    system = lt.MetriplecticSystem(None, lambda x: x[2] ** 2, lambda x: -x @ x, friction, dim=4, validate=False)
    assert preserved_function_names(system) == ("preserved 1", "preserved 2")


# -- what the Gauss methods hold --------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("stages", [1, 2])
def test_a_linear_function_that_the_dissipation_preserves_is_kept_to_rounding(stages):
    """Two spins with all of their momentum about one axis kept, by the motion and by the friction."""

    def energy(x):
        return jnp.cos(3.0 * x[:3] @ x[3:]) + jnp.exp(x[0] ** 2 + x[1] ** 2) + 0.3 * (x[2] + x[5])

    def axial_momentum(x):
        return x[2] + x[5]

    friction = lt.ProjectedMetric(preserve=axial_momentum, rate=0.05, normalized=True)
    algebra = mf.direct_sum(mf.so(3), mf.so(3))
    system = lt.LiePoissonSystem(algebra, energy, lambda x: -jnp.log(1.0 + x @ x * (x @ x)), friction, validate=False)
    run = lt.integrate(system, [0.3, 0.4, 0.5, -0.2, 0.6, 0.1], (0.0, 10.0), 0.2, lt.MetriplecticGauss(stages))
    assert np.abs(run.casimirs["axial_momentum"] - 0.6).max() <= 1e-14
    assert next(row for row in run.audit().rows if row.law == "drift of axial_momentum").passed
