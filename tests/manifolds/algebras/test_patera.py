"""Patera's list: published invariants, checked by SymPy's derivatives, and the functions that the algebras carry."""

import jax
import numpy as np
import pytest

import manifolds as mf
from manifolds.algebras.patera import CATALOGUE

sympy = pytest.importorskip("sympy")

VALUES = {"a": 0.5, "b": 0.4, "c": -0.3, "p": 0.7, "q": 0.2, "s": 0.6, "eps": 1.0}
"""Generic values, allowed in every family."""

LITERATURE_INVARIANTS = {
    # invariants of Patera, Sharp, Winternitz & Zassenhaus (1976), tables I and II, in their own form
    "A3,1": ["e1"],
    "A3,2": ["e1*exp(-e2/e1)"],
    "A3,3": ["e2/e1"],
    "A3,4": ["e1*e2"],
    "A3,5": ["e2*e1**(-a)"],
    "A3,6": ["e1**2 + e2**2"],
    "A3,7": ["(e1**2 + e2**2)*((e1 + I*e2)/(e1 - I*e2))**(I*a)"],
    "A3,8": ["2*e2**2 + e1*e3 + e3*e1"],
    "A3,9": ["e1**2 + e2**2 + e3**2"],
    "A4,1": ["e1", "e2**2 - 2*e1*e3"],
    "A4,2": ["e2**a/e1", "e2*exp(-e3/e2)"],
    "A4,3": ["e2", "e1*exp(-e3/e2)"],
    "A4,4": ["e1*exp(-e2/e1)", "(e2**2 - 2*e1*e3)/e1**2"],
    "A4,5": ["e1**a/e2", "e1**b/e3"],
    "A4,6": ["e1**(2*b/a)/(e2**2 + e3**2)", "e1**(2/a)*((e2 + I*e3)/(e2 - I*e3))**I"],
    "A4,7": [],
    "A4,8": ["e1", "e2*e3 + e3*e2 - 2*e1*e4"],
    "A4,9": [],
    "A4,10": ["e1", "2*e1*e4 + e2**2 + e3**2"],
    "A4,11": [],
    "A4,12": [],
    "A5,1": ["e1", "e2", "e2*e3 - e1*e4"],
    "A5,2": ["e1", "e2**2 - 2*e1*e3", "e2**3 + 3*e1**2*e4 - 3*e1*e2*e3"],
    "A5,3": ["e1", "e2", "e3**2 + 2*e2*e5 - 2*e1*e4"],
    "A5,4": ["e1"],
    "A5,7": ["e1**a/e2", "e1**b/e3", "e1**c/e4"],
    "A5,8": ["e1", "e3**c/e4", "e3*exp(-e2/e1)"],
    "A5,10": ["e1", "e2**2 - 2*e1*e3", "e4*exp(-e2/e1)"],
    "A5,19": ["e4**a/e1**b"],
    "A5,20": ["e1*exp(-a*e4/e1)"],
    "A5,30": ["(e2**2 - 2*e1*e3)**(a + 1)/e1**(2*a)"],
    "A5,33": ["e1**b*e2**a/e3"],
    "A5,36": ["(e2*e3 + e1*e5)/e1"],
    "A5,37": ["(e2**2 + e3**2 + 2*e1*e5)/e1"],
    "A5,38": ["e3"],
    "A5,40": ["e4*(e4*e1 - e5*e2) - e5**2*e3"],
}


def member(name):
    return mf.patera(name, **{p: VALUES[p] for p in CATALOGUE[name].parameters})


def coadjoint_derivatives(g, expression, variables, point):
    """Return the derivatives of a SymPy expression along the coadjoint vector fields ``sum C_ij^k e_k d/de_j``."""
    C = g.structure_constants
    values = dict(zip(variables, map(sympy.Float, point), strict=True))
    gradient = [complex(sympy.diff(expression, x).subs(values)) for x in variables]
    return np.einsum("ijk,k,j->i", C, point, gradient), np.linalg.norm(gradient)


def symbols(dim):
    return sympy.symbols(f"e1:{dim + 1}", real=True)


@pytest.mark.parametrize("name", LITERATURE_INVARIANTS)
def test_published_invariants_are_annihilated_and_complete(name):
    g, variables = member(name), symbols(int(name[1]))
    numbers = {sympy.Symbol(p): v for p, v in VALUES.items()}
    point = np.random.default_rng(1).uniform(0.3, 1.2, g.dim)
    gradients = []
    meanings = {str(x): x for x in variables}
    for text in LITERATURE_INVARIANTS[name]:
        expression = sympy.sympify(text, locals=meanings).subs(numbers)
        residual, size = coadjoint_derivatives(g, expression, variables, point)
        assert np.abs(residual).max() <= 1e-12 * max(1.0, size), text
        values = dict(zip(variables, point, strict=True))
        gradients.append([complex(sympy.diff(expression, x).subs(values)) for x in variables])
    rank = np.linalg.matrix_rank(np.array(gradients)) if gradients else 0
    assert rank == len(LITERATURE_INVARIANTS[name]) == g.index()
    # the functions that the algebra carries depend on these
    for invariant in g.invariants:
        own = np.asarray(jax.grad(invariant)(point))
        stacked = np.array([*gradients, own])
        assert np.linalg.matrix_rank(stacked, tol=1e-9 * np.abs(stacked).max()) == rank, str(invariant)


@pytest.mark.sampled(12)
@pytest.mark.parametrize("name", CATALOGUE)
def test_carried_invariants_are_casimirs_by_symbolic_derivatives(name):
    g = member(name)
    assert len(g.invariants) == g.index() == len(g.leading_casimirs())
    variables, point = symbols(g.dim), np.random.default_rng(2).uniform(0.3, 1.2, g.dim)
    for invariant in g.invariants:
        expression = mf.sympy.expression(invariant, variables)
        residual, size = coadjoint_derivatives(g, expression, variables, point)
        assert np.abs(residual).max() <= 1e-12 * max(1.0, size), str(invariant)
        by_sympy = float(expression.subs(dict(zip(variables, point, strict=True))))
        np.testing.assert_allclose(float(invariant(point)), by_sympy, rtol=1e-13)


def test_a_change_of_basis_carries_the_invariants():
    g, P = (
        member("A5,16"),
        np.array([[1, 1, 0, 0, 0], [0, 1, 0, 2, 0], [0, 0, 1, 0, 0], [1, 0, 0, 1, 0], [0, 0, 1, 0, 1]]),
    )
    other, mu = g.change_of_basis(P), np.linspace(0.3, 1.1, 5)
    assert len(other.leading_casimirs()) == other.index() == 3
    for F, G in zip(g.invariants, other.invariants, strict=True):
        np.testing.assert_allclose(G(P @ mu), F(mu), rtol=1e-13)
        assert np.abs(other.ad_star(jax.grad(G)(P @ mu), P @ mu)).max() < 1e-12
    assert g.change_of_basis(P) == other


def test_wrong_sign_is_no_casimir():
    """Control: the check of an invariant refuses the invariants of the algebra with another sign."""
    with pytest.raises(mf.LieAlgebraError, match=r"e1\*exp\(e2/e1\) is no Casimir of A3,2"):
        mf.patera("A3,2").with_invariants(mf.Formula("e1*exp(e2/e1)", ("e1", "e2", "e3")))


@pytest.mark.parametrize(
    "values",
    [
        ("A5,17", {"p": 0.0, "q": 0.3, "s": 0.5}),
        ("A5,17", {"p": 0.0, "q": 0.0, "s": 0.5}),
        ("A5,35", {"a": 0.0, "b": 0.7}),
        ("A5,19", {"a": 0.0, "b": 1.0}),
        ("A4,6", {"a": -1.0, "b": 0.0}),
        ("A5,32", {"a": 0.0}),
    ],
    ids=str,
)
def test_special_parameters_have_all_invariants(values):
    g = mf.patera(values[0], **values[1])
    gradients = np.array([jax.grad(F)(np.linspace(0.3, 1.1, g.dim)) for _, F in g.leading_casimirs()])
    assert np.linalg.matrix_rank(gradients, tol=1e-9) == g.index()


def test_two_rotations_of_irrational_ratio_have_two_functions():
    g = mf.patera("A5,17", p=0.0, q=0.0, s=2**-0.5)
    assert (len(g.invariants), g.index()) == (2, 3)


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("A6,1", {}, "name must be one of"),
        ("A3,5", {}, r"has the parameters a, got none; write patera\('A3,5', a=…\)"),
        ("A3,1", {"a": 1.0}, "has no parameters"),
        ("A3,5", {"a": 1.0}, r"needs 0 < \|a\| < 1, got a=1"),
        ("A5,20", {"a": np.inf}, "must be finite"),
    ],
)
def test_faults_of_a_name_are_told(name, parameters, message):
    with pytest.raises(mf.ParameterError, match=message):
        mf.patera(name, **parameters)


def test_formulas_refuse_anything_but_functions_of_the_names():
    for text in ("__import__('os')", "e1.real", "e4", "e1 if e2 else e3", "[e1]", "e1 +"):
        with pytest.raises(mf.ParameterError, match="formula"):
            mf.Formula(text, ("e1", "e2", "e3"))
    formula = mf.Formula("atan2(e2, e1)", ("e1", "e2"))
    assert formula == mf.Formula("atan2(e2, e1)", ("e1", "e2"))
    assert formula(np.ones((4, 2))).shape == (4,)
