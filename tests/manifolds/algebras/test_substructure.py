"""Subspaces of algebras: dimensions from the literature, defining properties by direct sums, in any basis."""

import itertools

import numpy as np
import pytest

import manifolds as mf

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
