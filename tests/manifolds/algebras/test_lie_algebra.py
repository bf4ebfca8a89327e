"""Lie algebras: every registered one passes the property tests, and controls fail them."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf
from tests.cases import ALGEBRAS, algebra_id, tolerance

seeds = st.integers(0, 10**6)
each_algebra = pytest.mark.parametrize("g", ALGEBRAS, ids=algebra_id)


def random_elements(g, seed, count):
    return np.random.default_rng(seed).standard_normal((count, g.dim))


def is_close(a, b, scale=1.0):
    return np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0) <= tolerance("axiom") * scale


# -- beside the property suite, which tests/manifolds/testing runs on every algebra -----------------------------------


@each_algebra
def test_forms_and_matrices(g):
    """The trilinear form is ``kappa(x, [y, z])``, totally skew (BFM Remark 3.3); every registered algebra has
    matrices."""
    kappa, form = g.killing_form(), mf.trilinear_form(g)
    assert is_close(form, np.einsum("ad,bcd->abc", kappa, g.structure_constants), max(1.0, np.abs(kappa).max()))
    assert is_close(form, -np.swapaxes(form, 0, 1), max(1.0, np.abs(kappa).max()))
    assert g.basis is not None
    if not g.is_semisimple():
        with pytest.raises(mf.LieAlgebraError, match="not semisimple"):
            g.cartan_involution()


# -- structure ----------------------------------------------------------------------------------------------------

STRUCTURE = {
    # name: (semisimple, compact type, solvable, nilpotent, unimodular), from the literature
    "so(3)": (1, 1, 0, 0, 1),
    "so(4)": (1, 1, 0, 0, 1),
    "so(5)": (1, 1, 0, 0, 1),
    "so(2)": (0, 0, 1, 1, 1),
    "so(2,1)": (1, 0, 0, 0, 1),
    "so(3,1)": (1, 0, 0, 0, 1),
    "su(2)": (1, 1, 0, 0, 1),
    "su(3)": (1, 1, 0, 0, 1),
    "su(4)": (1, 1, 0, 0, 1),
    "sl(2)": (1, 0, 0, 0, 1),
    "sl(3)": (1, 0, 0, 0, 1),
    "sp(1)": (1, 0, 0, 0, 1),
    "sp(2)": (1, 0, 0, 0, 1),
    "g2": (1, 1, 0, 0, 1),
    "gl(1)": (0, 0, 1, 1, 1),
    "gl(2)": (0, 0, 0, 0, 1),
    "u(2)": (0, 0, 0, 0, 1),
    "se(2)": (0, 0, 1, 0, 1),
    "se(3)": (0, 0, 0, 0, 1),
    "heisenberg(1)": (0, 0, 1, 1, 1),
    "heisenberg(2)": (0, 0, 1, 1, 1),
    "galilei(2)": (0, 0, 1, 0, 1),
    "galilei(3)": (0, 0, 0, 0, 1),
    "aff(1)": (0, 0, 1, 0, 0),
    "aff(2)": (0, 0, 0, 0, 0),
    "abelian(1)": (0, 0, 1, 1, 1),
    "abelian(3)": (0, 0, 1, 1, 1),
    "bianchi('I')": (0, 0, 1, 1, 1),
    "bianchi('II')": (0, 0, 1, 1, 1),
    "bianchi('III')": (0, 0, 1, 0, 0),
    "bianchi('IV')": (0, 0, 1, 0, 0),
    "bianchi('V')": (0, 0, 1, 0, 0),
    "bianchi('VI', h=0)": (0, 0, 1, 0, 1),
    "bianchi('VI', h=-0.25)": (0, 0, 1, 0, 0),
    "bianchi('VI', h=-0.5)": (0, 0, 1, 0, 0),
    "bianchi('VII', h=0)": (0, 0, 1, 0, 1),
    "bianchi('VII', h=1)": (0, 0, 1, 0, 0),
    "bianchi('VII', h=0.3)": (0, 0, 1, 0, 0),
    "bianchi('VIII')": (1, 0, 0, 0, 1),
    "bianchi('IX')": (1, 1, 0, 0, 1),
    "so(3) + heisenberg(1)": (0, 0, 0, 0, 1),
    "sl(2) x R^2": (0, 0, 0, 0, 1),
}
"""Predicates of each algebra from the literature: semisimple, compact type, solvable, nilpotent, unimodular."""


@each_algebra
def test_structural_predicates(g):
    predicates = (g.is_semisimple(), g.is_compact_type(), g.is_solvable(), g.is_nilpotent(), g.is_unimodular())
    assert predicates == tuple(map(bool, STRUCTURE[g.name]))


def structure(g):
    """Return all properties of the structure that do not depend on a basis."""
    return {
        "abelian": g.is_abelian(),
        "semisimple": g.is_semisimple(),
        "compact": g.is_compact_type(),
        "solvable": g.is_solvable(),
        "nilpotent": g.is_nilpotent(),
        "unimodular": g.is_unimodular(),
        "derived series": g.derived_series(),
        "lower central series": g.lower_central_series(),
        "signature": g.killing_signature(),
        "Casimirs": g.casimir_count(),
    }


def random_basis(dim, rng, condition=1e2):
    """Return a random basis with this condition number, as columns."""
    left_rotation, right_rotation = (np.linalg.qr(rng.standard_normal((dim, dim)))[0] for _ in range(2))
    return left_rotation * np.geomspace(1.0, 1.0 / condition, dim) @ right_rotation


def change_basis(g, columns):
    """Return the algebra in the basis of the columns, from floating-point constants."""
    constants = np.einsum(
        "ai,bj,abc,kc->ijk", columns, columns, g.structure_constants, np.linalg.inv(columns), optimize=True
    )
    return mf.LieAlgebra.from_structure_constants((constants - constants.swapaxes(0, 1)) / 2, name=f"{g.name} moved")


def upper_triangular_algebra(n):
    units = [np.eye(n)[:, [i]] * np.eye(n)[j] for i in range(n) for j in range(i + 1, n)]
    return mf.LieAlgebra.from_matrices(units, name=f"upper triangular {n}")


@pytest.mark.parametrize("g", [*ALGEBRAS, upper_triangular_algebra(5)], ids=algebra_id)
def test_structure_does_not_depend_on_the_basis(g):
    """Random bases are scaled by one factor, and each element by its own."""
    rng, expected_structure = np.random.default_rng(20), structure(g)
    for scale in (1e-6, 1.0, 1e6):
        assert structure(change_basis(g, scale * random_basis(g.dim, rng))) == expected_structure
    units = 10.0 ** rng.uniform(-3, 3, g.dim)
    assert structure(change_basis(g, np.diag(units))) == expected_structure
    assert structure(change_basis(g, random_basis(g.dim, rng) * units)) == expected_structure


def test_a_nilpotent_algebra_with_rounding_is_not_semisimple():
    """The Killing form is rounding, of either sign, as only the scale of the constants shows."""
    g = mf.heisenberg(1)
    for seed in range(10):
        h = change_basis(g, np.random.default_rng(seed).standard_normal((3, 3)))
        assert not h.is_semisimple()
        assert not h.is_compact_type()
        assert h.is_nilpotent()


def test_matrices_that_commute_to_rounding():
    """Commutators that are rounding become zero constants, instead of constants that violate the Jacobi identity."""
    rng = np.random.default_rng(22)
    columns = random_basis(6, rng, 1e3)
    diagonal = [columns * rng.standard_normal(6) @ np.linalg.inv(columns) for _ in range(4)]
    assert mf.LieAlgebra.from_matrices(diagonal).is_abelian()


@pytest.mark.parametrize("scale", [1e-12, 1e-5, 1e7])
def test_matrices_of_any_size(scale):
    """Closure, dependence and zero constants are judged relative to the size of the matrices."""
    g = mf.LieAlgebra.from_matrices(scale * np.asarray(mf.so(3).basis))
    np.testing.assert_allclose(g.structure_constants, scale * mf.so(3).structure_constants, rtol=1e-14)
    assert g.is_compact_type()
    units = scale * np.array([1.0, 1e-9, 1e3])
    h = mf.LieAlgebra.from_matrices(units[:, None, None] * np.asarray(mf.sl(2).basis))
    assert structure(h) == structure(mf.sl(2))
    with pytest.raises(mf.ClosureError, match="leaves the span"):
        mf.LieAlgebra.from_matrices(scale * np.asarray(mf.so(3).basis)[:2])
    with pytest.raises(mf.ClosureError, match="e2 is the zero matrix"):
        mf.LieAlgebra.from_matrices(scale * np.asarray([np.eye(2), np.zeros((2, 2))]))
    with pytest.raises(mf.LieAlgebraError, match="not in g"):
        g.vee(scale * np.eye(3))


def test_cartan_involution_in_a_basis_of_any_scale():
    g, rng = mf.sl(3), np.random.default_rng(21)
    for columns in (1e-6 * random_basis(8, rng, 10.0), np.diag(10.0 ** rng.uniform(-3, 3, 8))):
        h = change_basis(g, columns)
        theta = h.cartan_involution()
        assert np.abs(theta @ theta - np.eye(8)).max() < 1e-8 * np.abs(theta).max() ** 2
        form, units = -h.killing_form() @ theta, np.linalg.norm(columns, axis=0)
        assert np.linalg.eigvalsh((form + form.T) / 2 / np.outer(units, units)).min() > 1e-3


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "g", [mf.sl(2), mf.sl(3), mf.sp(2), mf.so(3, 1), mf.direct_sum(mf.so(3), mf.sl(2))], ids=algebra_id
)
@given(seed=seeds)
def test_cartan_involution_without_matrices_in_a_skew_basis(g, seed):
    """The construction from constants alone does not depend on a lucky basis."""
    change = np.eye(g.dim) + 0.3 * np.random.default_rng(seed).standard_normal((g.dim, g.dim))
    constants = np.einsum("ai,bj,abc,kc->ijk", change, change, g.structure_constants, np.linalg.inv(change))
    oblique_algebra = mf.LieAlgebra.from_structure_constants((constants - constants.swapaxes(0, 1)) / 2)
    theta = oblique_algebra.cartan_involution()
    form = -oblique_algebra.killing_form() @ theta
    assert np.abs(theta @ theta - np.eye(g.dim)).max() < 1e-8
    assert np.linalg.eigvalsh((form + form.T) / 2).min() > 0


def test_conventions():
    """The signs and orders are those that other code relies on."""
    assert np.array_equal(mf.so(3).bracket([1, 0, 0], [0, 1, 0]), [0, 0, 1])
    assert np.array_equal(mf.su(2).structure_constants, mf.so(3).structure_constants)
    x, mu = np.array([0.3, -0.2, 0.9]), np.array([0.1, 0.7, -0.4])
    assert is_close(mf.so(3).ad_star(x, mu), np.cross(mu, x))
    assert is_close(mf.so(3).hat(x) @ mu, np.cross(x, mu))
    assert np.array_equal(mf.so(3).killing_form(), -2 * np.eye(3))
    rotation, translation = np.eye(6)[0], np.eye(6)[4]
    assert np.array_equal(mf.se(3).bracket(rotation, translation), np.eye(6)[5])
    assert np.array_equal(mf.gl(2).basis[1], [[0, 1], [0, 0]])
    assert mf.sp(2).dim == 10
    f = mf.su(3).structure_constants
    assert f[3, 4, 7] == pytest.approx(np.sqrt(3) / 2)
    assert f[0, 1, 2] == 1.0
    assert f[0, 3, 6] == pytest.approx(0.5)
    assert np.array_equal(mf.bianchi("III").structure_constants, mf.bianchi("VI", h=-1).structure_constants)
    assert np.array_equal(mf.bianchi("IX").structure_constants, mf.so(3).structure_constants)


def test_sums():
    g = mf.direct_sum(mf.so(3), mf.sl(2))
    assert g.dim == 6
    assert is_close(g.bracket(np.eye(6)[0], np.eye(6)[4]), 0.0)
    assert is_close(g.bracket(np.eye(6)[3], np.eye(6)[4])[3:], mf.sl(2).bracket([1, 0, 0], [0, 1, 0]))
    motions = mf.semidirect_sum(mf.so(3), mf.so(3).hat)
    assert motions == mf.se(3)
    assert hash(motions) == hash(mf.se(3))
    assert (
        mf.semidirect_sum(mf.so(3), np.zeros((3, 2, 2))).basis is not None
    )  # not faithful: the matrices of g help out
    with pytest.raises(mf.RepresentationError, match=r"rho\(e1\), rho\(e2\)"):
        mf.semidirect_sum(mf.so(3), 2 * np.asarray(mf.so(3).basis))
    with pytest.raises(mf.ShapeError):
        mf.semidirect_sum(mf.so(3), np.zeros((2, 2, 2)))


def test_semidirect_sums_by_derivations():
    """An algebra acts on another: the oscillator algebra is R acting on heisenberg(1) by a rotation of q and p."""
    rotation = np.zeros((1, 3, 3))
    rotation[0, 1, 0], rotation[0, 0, 1] = 1.0, -1.0
    line, heisenberg = mf.abelian(1), mf.heisenberg(1)
    g = mf.semidirect_sum(line, rotation, ideal=heisenberg)
    assert (g.name, g.dim, g.derived_series(), g.casimir_count()) == ("abelian(1) x heisenberg(1)", 4, [4, 3, 1, 0], 2)
    assert np.array_equal(g.bracket([1, 0, 0, 0], [0, 1, 0, 0]), [0, 0, 1, 0])
    assert np.array_equal(g.bracket([0, 1, 0, 0], [0, 0, 1, 0]), [0, 0, 0, 1])
    assert str(g.casimirs(2)[0]) == "2*mu1*mu4 + mu2**2 + mu3**2"
    assert g.basis is None  # a centre: the adjoint matrices are not faithful
    # sl(2) acts on heisenberg(1) too: on the plane of q and p, and z is left alone
    plane = np.zeros((3, 3, 3))
    plane[:, :2, :2] = mf.sl(2).basis
    jacobi = mf.semidirect_sum(mf.sl(2), plane, "jacobi", ideal=heisenberg)
    assert (jacobi.name, jacobi.dim, jacobi.is_unimodular(), jacobi.casimir_count()) == ("jacobi", 6, True, 2)
    # an algebra acts on itself by its adjoint matrices; g x g is then so(3) + so(3) in another basis
    so3 = mf.so(3)
    twice = mf.semidirect_sum(so3, so3.ad, ideal=so3)
    assert structure(twice) == structure(mf.so(4))
    x, y = random_elements(twice, 3, 2)
    assert is_close(twice.vee(twice.hat(x) @ twice.hat(y) - twice.hat(y) @ twice.hat(x)), twice.bracket(x, y), 100.0)
    # on an abelian ideal it is the sum with a vector space
    assert np.array_equal(
        mf.semidirect_sum(so3, so3.basis, ideal=mf.abelian(3)).structure_constants, mf.se(3).structure_constants
    )
    scaling = np.diag([1.0, 1.0, 1.0])[None]  # z must scale by 2
    with pytest.raises(
        mf.RepresentationError, match=r"rho\(e1\) .* not a derivation D of heisenberg\(1\): D \[u1, u2\]"
    ):
        mf.semidirect_sum(line, scaling, ideal=heisenberg)
    with pytest.raises(mf.RepresentationError, match="not a representation"):
        mf.semidirect_sum(so3, 2 * so3.ad(np.eye(3)), ideal=so3)
    with pytest.raises(mf.ShapeError, match=r"shape \(1, 3, 3\)"):
        mf.semidirect_sum(line, np.zeros((1, 2, 2)), ideal=heisenberg)
    with pytest.raises(mf.ComponentError, match="ideal"):
        mf.semidirect_sum(line, rotation, ideal=heisenberg.structure_constants)


def test_names_of_basis_elements():
    g = mf.se(2).with_basis_names("L", "Px", "Py")
    assert g == mf.se(2)
    assert hash(g) == hash(mf.se(2))
    [F] = g.casimirs(2)
    assert str(F) == "Px**2 + Py**2"
    assert mf.se(2).casimirs(2)[0] == F
    assert str(mf.se(2).casimirs(2)[0]) == "mu2**2 + mu3**2"  # although both are remembered
    assert str(2 * F * F - 1) == "2*Px**4 + 4*Px**2*Py**2 + 2*Py**4 - 1"
    assert [str(dF) for dF in F.gradient()] == ["0", "2*Px", "2*Py"]
    constants_algebra = mf.LieAlgebra.from_structure_constants(g.structure_constants, basis_names=g.basis_names)
    matrix_algebra = mf.LieAlgebra.from_matrices(g.basis, basis_names=["L", "Px", "Py"])
    assert constants_algebra.basis_names == matrix_algebra.basis_names == ("L", "Px", "Py")
    spin = mf.so(3).with_basis_names("Sx", "Sy", "Sz")
    direct_sum = mf.direct_sum(g, spin)
    assert direct_sum.basis_names == ("L", "Px", "Py", "Sx", "Sy", "Sz")
    assert mf.direct_sum(spin, spin).basis_names is None
    assert mf.direct_sum(spin, mf.so(3)).basis_names is None
    assert mf.semidirect_sum(spin, spin.ad, ideal=mf.so(3).with_basis_names("a", "b", "c")).basis_names[3:] == tuple(
        "abc"
    )
    sextic = mf.g2().with_basis_names(*"abcdefghijklmn").casimirs(6)[0]
    assert sextic.names == tuple("abcdefghijklmn")
    for names in (("a", "b"), ("a", "b", "b"), ("a", "b", "1"), ("a", "b", 3), "abc"):
        with pytest.raises(mf.ParameterError, match="3 basis elements need 3 different names"):
            mf.LieAlgebra.from_matrices(g.basis, basis_names=names)


# -- what is refused ----------------------------------------------------------------------------------------------


def changed_se3_constants(change):
    """Return the constants of se(3) after a change; so(3) is a poor control, since it passes almost any Jacobi test."""
    constants = mf.se(3).structure_constants.astype(int).astype(object)
    change(constants)
    return constants


def test_jacobi_failure_names_the_triple():
    def change(C):
        C[0, 1, 2], C[1, 0, 2] = 2, -2

    with pytest.raises(mf.JacobiError, match=r"\(e1, e2, e4\).*checked exactly") as caught:
        mf.LieAlgebra.from_structure_constants(changed_se3_constants(change))
    assert caught.value.indices == (0, 1, 3)
    assert caught.value.residual == 1.0
    assert isinstance(caught.value, ValueError)


def test_jacobi_is_exact_for_fractions():
    """A residual of 1e-14 fails the exact check, though it would pass a tolerance."""
    tiny = Fraction(1, 10**14)

    def change(C):
        C[0, 1, 2] += tiny
        C[1, 0, 2] -= tiny

    with pytest.raises(mf.JacobiError):
        mf.LieAlgebra.from_structure_constants(changed_se3_constants(change))
    thirds = mf.se(3).structure_constants.astype(int).astype(object) * Fraction(1, 3)
    assert mf.LieAlgebra.from_structure_constants(thirds).rational_constants.denominator == 3


def test_antisymmetry_failure_names_the_pair():
    constants = np.zeros((2, 2, 2))
    constants[0, 1, 1] = 1.0
    with pytest.raises(mf.AntisymmetryError, match=r"\[e1, e2\]"):
        mf.LieAlgebra.from_structure_constants(constants)


@pytest.mark.parametrize(
    ("constants", "error"),
    [
        (np.zeros((2, 3, 2)), mf.ShapeError),
        (np.zeros((0, 0, 0)), mf.ShapeError),
        (1j * mf.so(3).structure_constants, mf.ComponentError),
        (np.full((2, 2, 2), np.nan), mf.ComponentError),
        ([[["a"]]], mf.ComponentError),
        ([[[1, 2], [3]]], mf.ComponentError),
    ],
)
def test_unusable_constants(constants, error):
    with pytest.raises(error):
        mf.LieAlgebra.from_structure_constants(constants)


def test_matrices_that_are_no_basis():
    E = np.asarray(mf.sl(2).basis)
    with pytest.raises(mf.ClosureError, match=r"\[e1, e2\] leaves the span"):
        mf.LieAlgebra.from_matrices(E[1:])
    with pytest.raises(mf.ClosureError, match="linearly dependent"):
        mf.LieAlgebra.from_matrices([E[0], E[1], E[2], E[0] + E[1]])
    with pytest.raises(mf.ShapeError):
        mf.LieAlgebra.from_matrices(np.zeros((2, 3)))
    # i times a real form is independent over the reals: sl(2, C) as a real algebra
    assert mf.LieAlgebra.from_matrices(np.concatenate([E, 1j * E])).dim == 6


def test_arguments_are_checked():
    g = mf.so(3)
    with pytest.raises(mf.ShapeError, match="last axis 3"):
        g.bracket([1, 2], [1, 2, 3])
    with pytest.raises(mf.ComponentError, match="real"):
        g.ad(np.ones(3) * 1j)
    with pytest.raises(mf.LieAlgebraError, match="not in so"):
        g.vee(np.eye(3))
    with pytest.raises(mf.LieAlgebraError, match="from_matrices"):
        mf.LieAlgebra.from_structure_constants(g.structure_constants).hat([1, 2, 3])
    with pytest.raises(ValueError, match="read-only"):
        g.structure_constants[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    "call",
    [
        lambda: mf.so(1),
        lambda: mf.su(1),
        lambda: mf.sl(True),
        lambda: mf.sp(1.5),
        lambda: mf.bianchi("X"),
        lambda: mf.bianchi("VI"),
        lambda: mf.bianchi("V", h=1.0),
        lambda: mf.bianchi("VI", h=0.5),
        lambda: mf.bianchi("VII", h=-0.5),
    ],
)
def test_catalogue_parameters(call):
    with pytest.raises(mf.ParameterError):
        call()


@given(seed=seeds)
def test_random_rational_algebras_keep_their_identity(seed):
    """A rational change of basis gives an algebra that is found rational again and passes the exact check."""
    rng = np.random.default_rng(seed)
    g = mf.se(2)
    triangular = np.triu(rng.integers(-3, 4, (3, 3)), 1) + np.eye(3, dtype=int)
    inverse = np.round(np.linalg.inv(triangular)).astype(int)
    C = np.einsum("ia,jb,abc,ck->ijk", triangular, triangular, g.structure_constants.astype(int), inverse)
    assert mf.LieAlgebra.from_structure_constants(C).rational_constants is not None
    assert mf.LieAlgebra.from_structure_constants(C.astype(float)).rational_constants is not None


# -- algebras from tables of brackets, compared to arrays of structure constants written by hand -----------------------


ENGEL = {("e1", "e2"): "e3", ("e1", "e3"): {"e4": 2}}


def test_table_fills_in_the_opposite_brackets():
    C = np.zeros((4, 4, 4))
    C[0, 1, 2], C[0, 2, 3] = 1, 2
    g = mf.LieAlgebra.from_brackets(ENGEL, name="engel")
    assert (g.name, g.basis_names) == ("engel", ("e1", "e2", "e3", "e4"))
    assert g == mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1))


def test_names_are_ordered_by_their_numbers_or_as_they_occur():
    assert mf.LieAlgebra.from_brackets({("e10", "e2"): "e1"}).basis_names == ("e1", "e2", "e10")
    assert mf.LieAlgebra.from_brackets({("q", "p"): "z"}).basis_names == ("q", "p", "z")
    line_and_plane = mf.LieAlgebra.from_brackets({("q", "p"): "z"}, basis=("z", "t", "p", "q"))
    assert line_and_plane.structure_constants[3, 2, 0] == 1.0
    assert line_and_plane.dim == 4
    assert mf.LieAlgebra.from_brackets({}, basis=("x", "y")).is_abelian()


def test_fractions_stay_exact_and_minus_signs_are_read():
    g = mf.LieAlgebra.from_brackets({("a", "b"): {"a": Fraction(1, 3)}, ("c", "b"): "-c"}, basis="abc")
    assert g.rational_constants is not None
    assert g.rational_constants.denominator == 3
    assert g.structure_constants[2, 1, 2] == -1.0
    assert mf.LieAlgebra.from_brackets({("a", "b"): {"a": 2**0.5}}).rational_constants is None


def test_entries_that_repeat_each_other_are_accepted_and_contradictions_are_not():
    repeated = ENGEL | {("e2", "e1"): "-e3", ("e4", "e4"): 0}
    assert mf.LieAlgebra.from_brackets(repeated) == mf.LieAlgebra.from_brackets(ENGEL)
    with pytest.raises(mf.AntisymmetryError, match=r"\[e1, e2\] = 'e3' contradicts \[e2, e1\] = 'e3'"):
        mf.LieAlgebra.from_brackets(ENGEL | {("e2", "e1"): "e3"})
    with pytest.raises(mf.AntisymmetryError, match=r"\[e1, e1\] must be zero"):
        mf.LieAlgebra.from_brackets({("e1", "e1"): "e2"})


def test_violation_of_jacobi_names_the_users_elements():
    with pytest.raises(mf.JacobiError, match=r"fails for \(x, y, z\)") as caught:
        mf.LieAlgebra.from_brackets({("x", "y"): {"z": 1, "y": 1}, ("y", "z"): "x", ("z", "x"): "y"}, basis="xyz")
    assert caught.value.indices == (0, 1, 2)


@pytest.mark.parametrize(
    ("brackets", "basis", "error", "message"),
    [
        ([("e1", "e2")], None, mf.ParameterError, "must be a dictionary"),
        ({"e1": "e2"}, None, mf.ParameterError, "pair of names"),
        ({("e1", "e2"): 3}, None, mf.ComponentError, "must be a name such as"),
        ({("e1", "e2"): {"e3": 1j}}, None, mf.ComponentError, "finite real number"),
        ({("e1", "e2"): {"e3": np.nan}}, None, mf.ComponentError, "finite real number"),
        ({("e1", "e2"): "e3"}, ("e1", "e2"), mf.ParameterError, "'e3', which is not in basis="),
        ({("e1", "e2"): "2 e3"}, None, mf.ComponentError, "dictionary such as"),
        ({("e1", "e2"): "e3 + e4"}, None, mf.ComponentError, "one name such as"),
        ({}, None, mf.ParameterError, "has no elements"),
    ],
)
def test_faults_of_a_table_are_named(brackets, basis, error, message):
    with pytest.raises(error, match=message):
        mf.LieAlgebra.from_brackets(brackets, basis=basis)


def test_casimirs_up_to_a_degree_are_those_of_each_degree():
    engel = mf.LieAlgebra.from_brackets(ENGEL)
    assert engel.casimirs(max_degree=3) == engel.casimirs(1) + engel.casimirs(2) + engel.casimirs(3)
    assert engel.casimirs() == engel.casimirs(max_degree=4)
    assert list(map(str, engel.casimirs())) == ["e4", "4*e2*e4 - e3**2"]
    assert [F.degree for F in mf.so(5).casimirs()] == [2, 4]
    copies = mf.so(3) ** 3
    assert copies.casimirs(max_degree=2) == copies.casimirs(2)
    with pytest.warns(mf.NoPolynomialCasimirWarning, match="up to degree 4"):
        assert mf.bianchi("V").casimirs() == []
    with pytest.raises(mf.ParameterError, match="not both"):
        engel.casimirs(2, max_degree=2)
    with pytest.raises(mf.ParameterError, match="max_degree must be an integer"):
        engel.casimirs(max_degree=0)
