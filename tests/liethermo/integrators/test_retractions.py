"""Every space with each of its retractions: a run in charts ends where a run without charts does."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from manifolds.retractions.charts import RETRACTIONS
from tests.cases import covering

METHODS = {
    "gauss": (lt.MetriplecticGauss, (2,), 1e-5),
    "midpoint": (lt.MetriplecticMidpoint, (), 5e-4),
    "explicit": (lt.MetriplecticRungeKutta, (4,), 1e-5),
}
"""Class, arguments, and largest error of two steps of 0.02; at most 2e-6 seen, and 1.2e-4 on flags."""


def retraction_names(space) -> list[str]:
    """Return the names of the retractions of a space, by the table of its page."""
    factors = space.factors if isinstance(space, mf.Product) else (space,)
    names = ["exp", "midpoint", "projection"] if space.has_geodesics else ["projection"]
    if all(isinstance(factor, mf.Euclidean | mf.SPD) for factor in factors):
        names += ["euclidean", "midpoint_euclidean"]
    if all(isinstance(factor, mf.Euclidean | mf.GroupSpace) for factor in factors):
        names += ["group_exp", "midpoint_group_exp"]
        names += [] if space.name == "SU(3)" else ["cayley", "midpoint_cayley"]
    return names


def cases():
    """Return every space with each of its retractions; the projection runs with all methods on some space."""
    for space in mf.registered_spaces():
        for kind in retraction_names(space):
            methods = ["midpoint"] if kind.startswith("midpoint") else ["gauss"]
            for method in METHODS if kind == "projection" else methods:
                yield pytest.param(space, kind, method, id=f"{space.name}-{kind}-{method}")


def keys(space, kind, method):
    return (type(space), kind), (type(space), method)


@pytest.mark.slow
def test_each_space_has_the_retractions_of_its_page_and_no_others():
    for space in mf.registered_spaces():
        for kind in set(RETRACTIONS) - set(retraction_names(space)):
            with pytest.raises(mf.ManifoldsError):
                mf.retraction(space, kind)


def gradient_flow(space) -> lt.MetriplecticSystem:
    """Return a gradient flow; on a quotient the energy is a function of its classes."""
    weights = np.random.default_rng(0).standard_normal(space.shape)

    def energy(x):
        if isinstance(space, mf.Homogeneous):
            first_column = space.from_vector(space.to_vector(x))[:, :1]
            return jnp.sum(weights[:, :1] * (first_column @ first_column.T) @ np.ones((space.shape[0], 1)))
        return jnp.sum(weights * x).real

    return lt.MetriplecticSystem(None, energy, dissipation=lt.Friction(), space=space, validate=False)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("space", "kind", "method"), covering(cases(), keys))
def test_a_run_in_charts_ends_where_one_without_does(space, kind, method):
    """The steps without charts are ten times as short, and of another method."""
    build, arguments, max_error = METHODS[method]
    system, start = gradient_flow(space), np.asarray(space.to_vector(space.random(5)))
    run = lt.integrate(system, start, (0.0, 0.04), 0.02, build(*arguments, retraction=kind))
    embedded_method = (
        lt.MetriplecticRungeKutta(6) if space.can_be_embedded else lt.MetriplecticRungeKutta(6, retraction="exp")
    )
    reference = lt.integrate(system, start, (0.0, 0.04), 0.002, embedded_method)
    assert float(space.residual(system.points(run.x[-1]))) < 1e-14
    ends = [system.points(solution.x[-1]) for solution in (run, reference)]
    if isinstance(space, mf.Flag):  # a chart by projection leaves the horizontal way: the class is what is compared
        ends = [space.projectors(end) for end in ends]
    assert np.abs(np.asarray(ends[0] - ends[1])).max() < max_error * max(1.0, np.abs(start).max())
    assert np.abs(run.x[-1] - start).max() > 2 * max_error  # control: it moves


def test_taylor_steps_name_the_chart_that_has_no_series():
    space = mf.SPD(2)
    system, start = gradient_flow(space), space.random(5)
    with pytest.raises(lt.LiethermoError, match=r"(?s)RiemannianRetraction.*leave out retraction="):
        lt.integrate(system, start, (0.0, 0.04), 0.02, lt.MetriplecticTaylor(4, retraction="exp"))


@pytest.mark.slow
def test_the_advice_for_taylor_steps_works():
    space = mf.SPD(2)
    system, start = gradient_flow(space), space.random(5)
    ends = [
        lt.integrate(system, start, (0.0, 0.04), 0.01, method).x[-1]
        for method in (
            lt.MetriplecticTaylor(6),
            lt.MetriplecticGauss(2, retraction="exp"),
            lt.MetriplecticRungeKutta(4, retraction="exp"),
        )
    ]
    assert np.abs(ends[1] - ends[0]).max() < 1e-6 > np.abs(ends[2] - ends[0]).max()
