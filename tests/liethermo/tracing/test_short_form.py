"""One line about systems, methods and their parts, for people who print them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing.short_form import short_form

BATHS = lt.HeatBaths(capacity=2.0, temperature=1.0)


@pytest.mark.parametrize(
    ("value", "line"),
    [
        (1 / 3, "0.3333"),
        (jnp.array([1.0, 0.25]), "[1, 0.25]"),
        (np.zeros((20, 30)), "array(20, 30)"),
        ((1, "a", None), "[1, a, None]"),
        (list(range(5)), "[0, 1, 2, … (5 in all)]"),
        ({"a": 1.5}, "{a: 1.5}"),
        (lt.KillingDissipation(0.2), "KillingDissipation(rate=0.2)"),
        (lt.Quadratic(np.array([1.0, 2.0])), "Quadratic(A=[1, 2])"),
        (BATHS, "HeatBaths(capacity=[2], temperature=[1])"),
        (np.array([-0.0, 1.0]), "[0, 1]"),
    ],
    ids=str,
)
def test_values(value, line):
    assert short_form(value) == line


def test_a_system_is_one_line_with_its_parameters():
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), dissipation=lt.DoubleBracket(0.1), baths=BATHS)
    assert repr(body) == (
        "LiePoissonSystem(so(3), energy=Quadratic(A=[1, 2, 3]), dissipation=DoubleBracket(rate=0.1), "
        "baths=HeatBaths(capacity=[2], temperature=[1]))"
    )
    assert str(body) == repr(body)


def test_sums_and_functions_have_their_names():
    def stretching(m):
        return m @ m

    friction = lt.KillingDissipation(0.1) + lt.KillingDissipation(0.2)
    system = lt.LiePoissonSystem(mf.so(3), stretching, lambda m: jnp.log(1 + m @ m), friction)
    assert "energy=Function(function=stretching" in repr(system)
    assert " + KillingDissipation(rate=0.2" in repr(system)


def test_a_traced_system_can_be_printed():
    def line_of(rate):
        lines.append(repr(lt.models.rigid_body((3.0, 2.0, 1.0), rate=rate)))
        return rate

    lines = []
    jax.jit(line_of)(0.1)
    assert "dissipation=KillingDissipation(rate=float64[]" in lines[0]


@pytest.mark.parametrize("build", [lt.models.gas_piston, lt.models.spin_lattice, lt.models.cylinder])
def test_lines_of_models_are_short(build):
    line = repr(build())
    assert "\n" not in line
    assert len(line) < 400


def test_methods_say_their_stages_and_order():
    assert repr(lt.MetriplecticGauss(2)) == "MetriplecticGauss(stages=2)"
    assert repr(lt.MetriplecticRungeKutta(6)) == "MetriplecticRungeKutta(order=6)"
