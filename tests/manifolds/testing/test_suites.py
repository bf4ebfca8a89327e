"""Public property suites: all registered objects pass, and broken objects fail."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds import testing
from tests.cases import ALGEBRAS


def params_by_name(objects):
    return [pytest.param(thing, id=thing.name) for thing in objects]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("g", params_by_name(ALGEBRAS))
def test_algebras(g):
    assert testing.check_algebra(g, degree=2).passed


@pytest.mark.sampled("SL(2)")
@pytest.mark.parametrize("G", params_by_name(mf.registered_groups()))
def test_groups(G):
    assert testing.check_group(G).passed


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("M", params_by_name(mf.registered_spaces()))
def test_spaces(M):
    assert testing.check_space(M).passed


class WrongSignAlgebra(mf.LieAlgebra):
    """Control: ad* has the wrong sign."""

    def ad_star(self, x, mu):
        return -super().ad_star(x, mu)


def test_a_broken_algebra():
    with pytest.raises(testing.PropertyError, match=r"<ad\*_x mu, y> .*FAILS") as failure:
        testing.check_algebra(WrongSignAlgebra(mf.so(3).structure_constants, name="crooked", basis=mf.so(3).basis))
    assert "NOT ALL OF THEM HOLD" in str(failure.value)
    assert not failure.value.report.passed


def test_a_broken_group():
    """Control: an exponential truncated at second order leaves the group."""
    group = mf.SO(3)

    def truncated_exp(algebra, x):
        X = algebra.hat(x)
        return jnp.eye(3) + X + X @ X / 2

    with pytest.raises(testing.PropertyError, match=r"exp x is in the group .*FAILS"):
        testing.check_group(dataclasses.replace(group, name="short", exp_map=truncated_exp))


@jax.tree_util.register_static
class HalfBracketAlgebra(mf.LieAlgebra):
    """Control: the bracket is half of the commutator."""

    def bracket(self, x, y):
        return 0.5 * super().bracket(x, y)


def test_a_group_with_the_bracket_of_another_algebra():
    half_algebra = HalfBracketAlgebra(mf.so(3).structure_constants, name="half", basis=mf.so(3).basis)
    with pytest.raises(testing.PropertyError, match=r"exp u exp v = exp.* FAILS"):
        testing.check_group(dataclasses.replace(mf.SO(3), name="half", algebra=half_algebra))


class MismatchedSphere(mf.Sphere):
    """Control: the metric is not that of the frame."""

    def _inner(self, x, u, v):
        return 2.0 * jnp.sum(u * v, axis=-1)


def test_a_broken_space():
    with pytest.raises(testing.PropertyError, match=r"the frame is orthonormal .*FAILS"):
        testing.check_space(MismatchedSphere(2))


def test_what_is_not_asked_is_said():
    report = testing.check_algebra(mf.LieAlgebra.from_structure_constants(mf.so(3).structure_constants))
    assert "the algebra has none" in str(report)
    assert np.isnan(next(row.value for row in report.rows if row.name == "matrices"))
