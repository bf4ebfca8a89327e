"""Isomorphism types: every algebra of the list is recognised in any basis, with special parameters and in sums."""

import itertools

import jax
import numpy as np
import pytest

import manifolds as mf
from manifolds.algebras.patera import CATALOGUE

GRID = {
    "a": (-0.5, 0.3, 1.0),
    "b": (-0.4, 0.7, 1.0),
    "c": (-1.0, 0.6),
    "p": (0.0, 0.5),
    "q": (0.0, -0.8),
    "s": (0.5, 1.0),
    "eps": (1.0, -1.0),
}
SPECIAL = [
    ("A4,9", {"b": 0.0}),
    ("A5,15", {"a": 0.0}),
    ("A5,15", {"a": -1.0}),
    ("A5,13", {"a": -1.0, "p": -0.3, "s": 2.0}),
    ("A5,19", {"a": 0.0, "b": -1.0}),
    ("A5,19", {"a": 2.0, "b": 1.0}),
    ("A5,20", {"a": 0.0}),
    ("A5,20", {"a": 2.0}),
    ("A5,28", {"a": 0.0}),
    ("A5,28", {"a": 2.0}),
    ("A5,30", {"a": 2.0}),
    ("A5,30", {"a": 0.0}),
    ("A5,30", {"a": -1.0}),
    ("A5,32", {"a": 0.0}),
    ("A5,32", {"a": -3.0}),
    ("A5,34", {"a": 0.0}),
    ("A5,33", {"a": 1.0, "b": 1.0}),
    ("A5,35", {"a": 0.0, "b": 2.0}),
    ("A4,11", {"a": 2.0}),
    ("A5,9", {"b": 1.0, "c": 1.0}),
]


def members(name):
    entry = CATALOGUE[name]
    for values in itertools.product(*(GRID[p] for p in entry.parameters)):
        parameters = dict(zip(entry.parameters, values, strict=True))
        if entry.condition(**parameters):
            yield mf.patera(name, **parameters)


def change_bases(g):
    random = np.random.default_rng(g.dim)
    yield g
    shears = np.tril(random.integers(-1, 2, (g.dim, g.dim)), -1) + np.eye(g.dim, dtype=int)
    yield g.change_of_basis(shears @ shears[::-1, ::-1])
    yield g.change_of_basis(random.standard_normal((g.dim, g.dim)) + 2.0 * np.eye(g.dim))


def check_type(g, family):
    types = [h.isomorphism_type() for h in change_bases(g)]
    for t in types:
        assert t.is_known, t
        assert t.name.split("^")[0] == family, (g.name, str(t))
        for parameter, value in t.parameters.items():
            assert abs(value - types[0].parameters[parameter]) < 1e-7, (g.name, str(t), str(types[0]))
    representative = types[0].algebra().isomorphism_type()
    assert representative.name == types[0].name
    for parameter, value in representative.parameters.items():
        assert abs(value - types[0].parameters[parameter]) < 1e-9
    assert len(g.derivations()) == len(types[0].algebra().derivations())


@pytest.mark.sampled(21)
@pytest.mark.parametrize("name", CATALOGUE)
def test_every_member_of_a_family_is_recognised_in_any_basis(name):
    for g in itertools.islice(members(name), 2):
        check_type(g, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, entry in CATALOGUE.items() if len(entry.parameters) > 1])
def test_all_members_of_a_grid_are_recognised(name):
    for g in members(name):
        if name != "A5,33" or 0.0 not in g.isomorphism_type().parameters.values():
            check_type(g, name)


@pytest.mark.parametrize(("name", "parameters"), SPECIAL, ids=str)
def test_special_parameters_are_recognised(name, parameters):
    check_type(mf.patera(name, **parameters), name)


@pytest.mark.parametrize(
    ("g", "text"),
    [
        (mf.so(3), "A3,9"),
        (mf.su(2), "A3,9"),
        (mf.sl(2), "A3,8"),
        (mf.so(2, 1), "A3,8"),
        (mf.se(2), "A3,6"),
        (mf.heisenberg(1), "A3,1"),
        (mf.heisenberg(2), "A5,4"),
        (mf.aff(1), "A2"),
        (mf.gl(2), "A3,8 + A1"),
        (mf.u(2), "A3,9 + A1"),
        (mf.so(4), "2 A3,9"),
        (mf.so(2, 1) ** 2, "2 A3,8"),
        (mf.abelian(4), "4 A1"),
        (mf.bianchi("III"), "A2 + A1"),
        (mf.bianchi("IV"), "A3,2"),
        (mf.bianchi("V"), "A3,3"),
        (mf.bianchi("VI", h=0), "A3,4"),
        (mf.bianchi("VI", h=-0.25), "A3,5^a (a=-0.333333)"),
        (mf.bianchi("VII", h=0), "A3,6"),
        (mf.bianchi("VII", h=0.25), "A3,7^a (a=0.5)"),
        (mf.bianchi("VIII"), "A3,8"),
        (mf.direct_sum(mf.heisenberg(1), mf.abelian(2)), "A3,1 + 2 A1"),
        (mf.direct_sum(mf.aff(1), mf.aff(1)), "2 A2"),
        (mf.direct_sum(mf.aff(1), mf.patera("A3,7", a=0.5)), "A3,7^a (a=0.5) + A2"),
        (mf.direct_sum(mf.aff(1), mf.sl(2)), "A3,8 + A2"),
        (mf.patera("A5,33", a=0.0, b=0.5), "A3,5^a (a=0.5) + A2"),
        (mf.patera("A5,35", a=0.5, b=0.0), "A5,35^a,b (a=0.5, b=0)"),
        (mf.semidirect_sum(mf.sl(2), mf.sl(2).basis), "A5,40"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_types_of_known_algebras(g, text):
    for h in change_bases(g):
        assert str(h.isomorphism_type()) == text


def test_isomorphic_members_have_one_type():
    pairs = [
        (mf.patera("A5,24", eps=1), mf.patera("A5,24", eps=-1)),
        (mf.patera("A5,26", p=0.5, eps=1), mf.patera("A5,26", p=0.5, eps=-1)),
        (mf.patera("A5,32", a=2.0), mf.patera("A5,32", a=0.1)),
        (mf.patera("A4,5", a=0.5, b=0.2), mf.patera("A4,5", a=0.2, b=0.5)),
        (mf.patera("A5,33", a=0.5, b=0.4), mf.patera("A5,33", a=2.0, b=-0.8)),
    ]
    for g, h in pairs:
        assert g.isomorphism_type() == h.isomorphism_type() or str(g.isomorphism_type()) == str(h.isomorphism_type())
    different = mf.patera("A5,32", a=2.0), mf.patera("A5,32", a=-2.0)
    assert different[0].isomorphism_type() != different[1].isomorphism_type()


def test_what_is_not_decided_is_unknown_with_its_reason():
    for g, reason in [(mf.se(3), "dimension 6"), (mf.so(5), "dimension 10"), (mf.heisenberg(3), "dimension 7")]:
        result = g.isomorphism_type()
        assert (result.name, result.summands, result.is_known) == ("unknown", (), False)
        assert reason in result.reason
        with pytest.raises(mf.LieAlgebraError, match="unknown"):
            result.algebra()
    near = mf.patera("A3,5", a=-1.0 + 1.3e-8)
    assert "rounding" in near.isomorphism_type().reason


# -- patera's list: published invariants, checked by SymPy's derivatives, and the functions that the algebras ----------


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


@pytest.mark.sampled(5)
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


@pytest.mark.sampled(3)
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
    with pytest.raises(mf.LieAlgebraError, match=r"e1\*exp\(e2/e1\) is not a Casimir of A3,2"):
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
        ("A3,5", {}, r"has the parameters a, got none\. Write patera\('A3,5', a=…\)"),
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


# -- subspaces of algebras: dimensions from the literature, defining properties by direct sums, in any basis -----------


POINCARE = mf.semidirect_sum(mf.so(3, 1), mf.so(3, 1).basis, name="poincare")

DIMENSIONS = {
    # centre, derivations, radical, nilradical, index; [Humphreys 1972; Patera, Sharp, Winternitz & Zassenhaus 1976;
    # Rais 1978 for the index of semidirect sums]
    mf.so(3): (0, 3, 0, 0, 1),
    mf.sl(2): (0, 3, 0, 0, 1),
    mf.su(3): (0, 8, 0, 0, 2),
    mf.g2(): (0, 14, 0, 0, 2),
    mf.se(2): (0, 4, 3, 2, 1),
    mf.se(3): (0, 7, 3, 3, 2),
    mf.gl(2): (1, 4, 1, 1, 2),
    mf.aff(1): (0, 2, 2, 1, 0),
    mf.aff(2): (0, 6, 3, 2, 0),
    mf.heisenberg(1): (1, 6, 3, 3, 1),
    mf.heisenberg(2): (1, 15, 5, 5, 1),
    mf.galilei(3): (0, 12, 7, 7, 2),
    POINCARE: (0, 11, 4, 4, 2),
    mf.bianchi("V"): (0, 6, 3, 2, 1),
    mf.abelian(3): (3, 9, 3, 3, 3),
}
each_algebra = pytest.mark.parametrize("g", DIMENSIONS, ids=lambda g: g.name)


def dimensions(g):
    return len(g.centre()), len(g.derivations()), len(g.radical()), len(g.nilradical()), g.index()


def change_basis_at_random(g, seed=0, exact=True):
    random = np.random.default_rng(seed)
    if not exact:
        return g.change_of_basis(random.standard_normal((g.dim, g.dim)) + 2.0 * np.eye(g.dim))
    shears = np.tril(random.integers(-1, 2, (g.dim, g.dim)), -1) + np.eye(g.dim, dtype=int)
    return g.change_of_basis(shears @ shears[::-1, ::-1])


def distance_from_span(vectors, rows):
    vectors = np.reshape(vectors, (-1, rows.shape[1]))
    if not len(rows):
        return np.abs(vectors).max(initial=0.0)
    orthonormal = np.linalg.qr(rows.T)[0]
    return np.abs(vectors - vectors @ orthonormal @ orthonormal.T).max(initial=0.0) / np.abs(vectors).max(initial=1.0)


@each_algebra
def test_dimensions_are_those_of_the_literature(g):
    assert dimensions(g) == DIMENSIONS[g]


@pytest.mark.parametrize("g", [g for g in DIMENSIONS if g.dim < 8], ids=lambda g: g.name)
@pytest.mark.parametrize("exact", [True, False])
def test_dimensions_do_not_depend_on_the_basis(g, exact):
    other = change_basis_at_random(g, exact=exact)
    assert (other.rational_constants is not None) == exact or g.is_abelian()
    assert dimensions(other) == DIMENSIONS[g]
    assert [len(rows) for rows in other.derived_ideals()] == g.derived_series()
    assert [len(rows) for rows in other.lower_central_ideals()] == g.lower_central_series()


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("g", [mf.se(3), mf.aff(2), POINCARE, mf.galilei(3)], ids=lambda g: g.name)
def test_levi_subalgebra_is_a_semisimple_complement_of_the_radical(g, exact):
    other = change_basis_at_random(g, 1, exact)
    levi, radical = other.levi_decomposition()
    assert np.linalg.matrix_rank(np.vstack([levi, radical])) == g.dim
    brackets = np.asarray(other.bracket(levi[:, None], levi))
    assert distance_from_span(brackets, levi) < 1e-9  # products of integers up to 1e6 in floats
    images = np.asarray(other.bracket(np.eye(g.dim)[:, None], radical))
    assert distance_from_span(images, radical) < 1e-9
    components = np.linalg.lstsq(levi.T, brackets.reshape(-1, g.dim).T, rcond=None)[0].T
    constants = components.reshape(len(levi), len(levi), len(levi))
    constants = np.where(np.abs(constants) < 1e-9 * np.abs(constants).max(), 0.0, constants)
    killing_form = np.einsum("acd,bdc->ab", constants, constants)
    assert np.linalg.matrix_rank(killing_form, tol=1e-9 * np.abs(killing_form).max()) == len(levi)


def test_exact_rows_are_integers_and_annihilate_exactly():
    g = change_basis_at_random(mf.galilei(2), 3)
    for rows in (g.radical(), g.nilradical(), *g.derived_ideals()):
        assert np.array_equal(rows, np.round(rows))
    for D in g.derivations():
        for a, b in itertools.combinations(np.eye(g.dim), 2):
            defect = D @ np.asarray(g.bracket(a, b)) - g.bracket(D @ a, b) - g.bracket(a, D @ b)
            assert np.abs(defect).max() <= 1e-12 * max(1.0, np.abs(D).max())


def test_centre_commutes_and_derived_ideals_contain_the_brackets():
    g = change_basis_at_random(mf.direct_sum(mf.heisenberg(1), mf.aff(1), mf.abelian(1)), 4)
    centre = g.centre()
    assert len(centre) == 2
    assert not np.asarray(g.bracket(centre[:, None], np.eye(g.dim))).any()
    brackets = np.asarray(g.bracket(np.eye(g.dim)[:, None], np.eye(g.dim)))
    assert distance_from_span(brackets, g.derived_ideals()[1]) < 1e-12
    assert distance_from_span(brackets, g.lower_central_ideals()[2]) > 1e-3  # control: not all are in [g, [g, g]]


def test_orbit_dimensions_are_ranks_at_each_point():
    assert [mf.so(3).orbit_dimension(mu) for mu in ([0, 0, 0], [0, 0, 1], [0.1, 1e-9, 0])] == [0, 2, 2]
    assert [mf.se(3).orbit_dimension(mu) for mu in np.eye(6)] == [2, 2, 2, 4, 4, 4]
    assert mf.su(3).orbit_dimension(np.eye(8)[7]) == 4  # the eighth Gell-Mann matrix has two equal eigenvalues
    assert mf.su(3).orbit_dimension(np.random.default_rng(0).standard_normal(8)) == 6
    with pytest.raises(mf.ShapeError, match=r"shape \(3,\)"):
        mf.so(3).orbit_dimension([1.0, 2.0])
    with pytest.raises(mf.LieAlgebraError, match="finite"):
        mf.so(3).orbit_dimension([np.nan, 0.0, 0.0])


def test_change_of_basis_transforms_brackets_matrices_and_mu():
    g, P = mf.se(3), np.random.default_rng(5).integers(-2, 3, (6, 6)) + 5 * np.eye(6, dtype=int)
    other = g.change_of_basis(P, name="other", basis_names=tuple("abcdef"))
    assert (other.name, other.basis_names) == ("other", tuple("abcdef"))
    assert other.rational_constants is not None
    x, y, mu = np.random.default_rng(6).standard_normal((3, 6))
    np.testing.assert_allclose(other.bracket(x, y) @ P, g.bracket(x @ P, y @ P), atol=1e-12)
    np.testing.assert_allclose(other.ad_star(x, P @ mu), P @ np.asarray(g.ad_star(x @ P, mu)), atol=1e-11)
    np.testing.assert_allclose(other.hat(x), g.hat(x @ P), atol=1e-12)
    back = other.change_of_basis(np.linalg.inv(P))
    np.testing.assert_allclose(back.structure_constants, g.structure_constants, atol=1e-12)
    with pytest.raises(mf.LieAlgebraError, match="linearly dependent"):
        g.change_of_basis(np.ones((6, 6)))
    with pytest.raises(mf.ShapeError, match="matrix of shape"):
        g.change_of_basis(np.eye(5))
