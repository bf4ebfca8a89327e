"""The public suites: everything that is registered goes through, and broken objects do not."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds import testing


def named(objects):
    return [pytest.param(thing, id=thing.name) for thing in objects]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("g", named(mf.registered()))
def test_algebras(g):
    assert testing.check_algebra(g, degree=2).passed


@pytest.mark.sampled("SO(3)")
@pytest.mark.parametrize("G", named(mf.registered_groups()))
def test_groups(G):
    assert testing.check_group(G).passed


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("M", named(mf.registered_spaces()))
def test_spaces(M):
    assert testing.check_space(M).passed


class Crooked(mf.LieAlgebra):
    """Control: its ad* has the other sign."""

    def ad_star(self, x, mu):
        return -super().ad_star(x, mu)


def test_a_broken_algebra():
    with pytest.raises(testing.PropertyError, match=r"<ad\*_x mu, y> .*FAILS") as failure:
        testing.check_algebra(Crooked(mf.so(3).structure_constants, name="crooked", basis=mf.so(3).basis))
    assert "NOT ALL OF THEM HOLD" in str(failure.value)
    assert not failure.value.report.passed


def test_a_broken_group():
    """Control: an exponential of second order leaves the group."""
    good = mf.SO(3)

    def short(algebra, x):
        X = algebra.hat(x)
        return jnp.eye(3) + X + X @ X / 2

    with pytest.raises(testing.PropertyError, match=r"exp x is in the group .*FAILS"):
        testing.check_group(dataclasses.replace(good, name="short", exp_map=short))


class Slanted(mf.Sphere):
    """Control: its metric is not the one of its frame."""

    def _inner(self, x, u, v):
        return 2.0 * jnp.sum(u * v, axis=-1)


def test_a_broken_space():
    with pytest.raises(testing.PropertyError, match=r"the frame is orthonormal .*FAILS"):
        testing.check_space(Slanted(2))


def test_what_is_not_asked_is_said():
    report = testing.check_algebra(mf.LieAlgebra.from_structure_constants(mf.so(3).structure_constants))
    assert "the algebra has none" in str(report)
    assert np.isnan(next(row.value for row in report.rows if row.name == "matrices"))
