"""Systems as SymPy expressions: proofs of their laws, energies from SymPy, and descriptions of problems."""

from __future__ import annotations

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

import liethermo as lt
import manifolds as mf

GENERAL = lt.LiePoissonSystem(
    mf.so(3),
    lambda x: jnp.cosh(x[0]) + x[1] ** 4 / 3 + jnp.sin(x[2]) + x @ x,
    lambda x: jnp.log(1.0 + x @ x),
    lt.ProjectedMetric(),
)


def test_the_laws_are_proved_in_symbols():
    symbolic = lt.sympy.expressions(lt.models.rigid_body((3, 2, 1)))
    rate = sum(sympy.diff(symbolic.energy, x) * f for x, f in zip(symbolic.variables, symbolic.field, strict=True))
    assert sympy.simplify(rate) == 0
    production = sum(
        sympy.diff(symbolic.entropy, x) * f for x, f in zip(symbolic.variables, symbolic.field, strict=True)
    )
    assert sympy.simplify(production) != 0
    assert symbolic.energy == sum(
        x**2 / sympy.Integer(2 * i) for x, i in zip(symbolic.variables, (3, 2, 1), strict=True)
    )


def test_expressions_have_the_values_of_the_functions():
    symbolic = lt.sympy.expressions(GENERAL, names=("a", "b", "c"))
    assert [str(x) for x in symbolic.variables] == ["a", "b", "c"]
    at = np.array([0.3, -0.4, 0.7])
    numbers = dict(zip(symbolic.variables, at, strict=True))
    field = [float(f.subs(numbers)) for f in symbolic.field]
    assert np.allclose(field, GENERAL.vector_field(jnp.array(at)), rtol=1e-13, atol=1e-15)
    assert float(symbolic.energy.subs(numbers)) == pytest.approx(float(GENERAL.energy.value(at)), rel=1e-14)
    assert symbolic.entropy is not None
    assert float(symbolic.entropy.subs(numbers)) == pytest.approx(float(GENERAL.entropy.value(at)), rel=1e-14)


def test_a_mask_of_constants_has_expressions():
    """A mask that is an array of booleans is a constant of the program: its entries are SymPy's true and false."""
    mask = np.array([True, False, True])
    body = lt.LiePoissonSystem(mf.so(3), lambda m: jnp.sum(jnp.where(mask & (m > 0.0), m**2, 2.0 * m**2)))
    symbolic = lt.sympy.expressions(body)
    for state in ([0.3, 0.4, -0.7], [-0.3, -0.4, 0.7]):
        expected = sum(x**2 if is_masked and x > 0.0 else 2.0 * x**2 for x, is_masked in zip(state, mask, strict=True))
        numbers = dict(zip(symbolic.variables, state, strict=True))
        assert float(symbolic.energy.subs(numbers)) == pytest.approx(expected, rel=1e-14)


def test_an_energy_from_sympy_runs():
    a, b, c = x = sympy.symbols("a b c", real=True)
    g = mf.so(3)
    quadratic = lt.sympy.function(a**2 / 2 + b**2 / 4 + c**2 / 6, x)
    assert isinstance(quadratic, mf.Polynomial)
    general = lt.sympy.function(a**2 / 2 + sympy.cosh(b) + c**4, x)
    for energy in (quadratic, general):
        system = lt.LiePoissonSystem(g, energy, g.casimirs(2)[0], lt.KillingDissipation(0.1))
        assert lt.integrate(system, [0.1, 0.2, 1.0], (0.0, 2.0), 0.1).audit().passed
    with pytest.raises(lt.InputError, match="k in"):
        lt.sympy.function(sympy.Symbol("k") * a, x)


@pytest.mark.parametrize(
    ("expression", "name"),
    [
        (lambda x, y: sympy.LambertW(x) + y, "LambertW"),
        (lambda x, y: y * sympy.Function("f")(x), "f"),
        (lambda x, y: sympy.exp(sympy.fresnels(x)) + y, "fresnels"),
        (lambda x, y: sympy.Integral(sympy.exp(-(y**2)), (y, 0, x)), "Integral"),
    ],
)
def test_a_function_that_jax_lacks_is_named(expression, name):
    x, y = sympy.symbols("x y")
    with pytest.raises(lt.InputError, match=f"^{name} in .* has no counterpart in JAX"):
        lt.sympy.function(expression(x, y), (x, y))


def test_special_functions_are_those_of_jax():
    x, y = sympy.symbols("x y")
    f = lt.sympy.function(sympy.erf(x) + sympy.gamma(y) + sympy.loggamma(y), (x, y))
    exact = math.erf(0.3) + math.gamma(1.7) + math.lgamma(1.7)
    assert float(jax.jit(f)(jnp.array([0.3, 1.7]))) == pytest.approx(exact, rel=1e-14)


def test_a_problem_written_down_is_the_problem(tmp_path):
    system, x0 = lt.models.rigid_body((3, 2, 1), rate=0.5), [0.1, 0.2, 1.0]
    file = lt.sympy.write(lt.sympy.describe(system, x0, (0.0, 5.0), "relaxed body"), tmp_path / "body.json")
    problem = json.loads(file.read_text())
    assert problem["format"] == "liethermo-problem-1"
    assert [1, 2, 3, "1"] in problem["lie_algebra"]["structure_constants"]
    assert problem["reference"]["apart"] < 1e-10

    variables = sympy.symbols(problem["variables"], real=True)  # a stranger reads it
    names = dict(zip(problem["variables"], variables, strict=True))
    field = sympy.lambdify(variables, [sympy.sympify(f["sympy"], names) for f in problem["field"]])
    from scipy.integrate import solve_ivp

    run = solve_ivp(
        lambda t, y: field(*y), problem["t_span"], problem["initial_state"], "DOP853", rtol=1e-12, atol=1e-13
    )
    assert np.abs(run.y[:, -1] - problem["reference"]["state"]).max() < 1e-9


def test_an_energy_that_depends_on_time_has_expressions_at_one_time():
    driven = lt.LiePoissonSystem(mf.so(3), lt.TimeDependent(lambda x, t: (1.0 + t) * x @ x / 2))
    with pytest.raises(lt.InputError, match="at_time"):
        lt.sympy.expressions(driven)
    x1 = sympy.Symbol("x1", real=True)
    assert lt.sympy.expressions(driven.at_time(1.0)).energy.coeff(x1, 2) == 1
