"""Algebras from tables of brackets, compared to arrays of structure constants written by hand."""

from fractions import Fraction

import numpy as np
import pytest

import manifolds as mf

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
        ({("e1", "e2"): "2 e3"}, None, mf.ParameterError, "different names"),
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
