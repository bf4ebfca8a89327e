"""Isomorphism types: every algebra of the list is recognised in any basis, with special parameters and in sums."""

import itertools

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


def change_bases(g, count=1):
    random = np.random.default_rng(g.dim)
    yield g
    for _ in range(count):
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
