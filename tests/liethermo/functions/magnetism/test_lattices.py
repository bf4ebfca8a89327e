"""Crystal lattices: shells beside published coordination numbers, bonds beside all pairs of positions."""

import itertools

import numpy as np
import pytest

import liethermo as lt
from tests.refusals import refusal_test

mag = lt.magnetism

# Coordination numbers and distances in units of a [Ashcroft & Mermin 1976, table 4.1; Kittel 2005, ch. 3]
SHELLS = {
    "chain": [(2, 1.0), (2, 2.0), (2, 3.0)],
    "square": [(4, 1.0), (4, 2**0.5), (4, 2.0), (8, 5**0.5)],
    "triangular": [(6, 1.0), (6, 3**0.5), (6, 2.0), (12, 7**0.5)],
    "honeycomb": [(3, 3**-0.5), (6, 1.0), (3, 2 * 3**-0.5)],
    "kagome": [(4, 0.5), (4, 0.75**0.5), (6, 1.0)],
    "sc": [(6, 1.0), (12, 2**0.5), (8, 3**0.5)],
    "bcc": [(8, 0.75**0.5), (6, 1.0), (12, 2**0.5), (24, 11**0.5 / 2)],
    "fcc": [(12, 0.5**0.5), (6, 1.0), (24, 1.5**0.5), (12, 2**0.5)],
    "hcp": [(12, 1.0), (6, 2**0.5), (2, (8 / 3) ** 0.5), (18, 3**0.5)],
    "diamond": [(4, 3**0.5 / 4), (12, 0.5**0.5), (12, 11**0.5 / 4)],
    "pyrochlore": [(6, 8**-0.5), (12, 0.375**0.5), (12, 0.5**0.5)],
}


@pytest.mark.parametrize("name", SHELLS)
@pytest.mark.parametrize("primitive", [False, True])
def test_shells_have_the_known_neighbours(name, primitive):
    crystal = mag.lattice(name, 2, primitive=primitive)
    expected = SHELLS[name]
    shells = crystal.shells(len(expected))
    assert [shell.coordination for shell in shells] == [count for count, _ in expected]
    np.testing.assert_allclose([shell.distance for shell in shells], [r for _, r in expected], rtol=1e-14)
    assert not crystal.periodic[0] or len(crystal.cells) == len(crystal.vectors)


def pairs_by_distance(crystal, distance):
    """Return the pairs of sites at a distance, with images of periodic axes, each pair of images once."""
    positions = crystal.positions.reshape(-1, 3)
    shifts = itertools.product(*([-1, 0, 1] if periodic else [0] for periodic in crystal.periodic))
    pairs = []
    for shift in shifts:
        translation = np.asarray(shift) * crystal.cells @ crystal.vectors
        r = np.linalg.norm(positions + translation - positions[:, None], axis=-1)
        pairs += [tuple(pair) for pair in np.argwhere(np.abs(r - distance) < 1e-9).tolist()]
    return sorted(tuple(sorted(pair)) for pair in pairs)[::2]  # each bond is found from both ends


@pytest.mark.parametrize("name", SHELLS)
@pytest.mark.parametrize("borders", ["periodic", "open", "mixed"])
def test_bonds_are_the_pairs_at_their_distance(name, borders):
    axes = len(mag.lattice(name, 1).cells)
    periodic = {"periodic": True, "open": False, "mixed": [axis % 2 == 0 for axis in range(axes)]}[borders]
    crystal = mag.lattice(name, (4, 3, 3)[:axes], constant=1.7, periodic=periodic)
    shells = crystal.shells(1 if name in ("chain", "square", "sc", "triangular") else 2)
    for shell in shells[:1] if borders == "open" and axes == 3 else shells:
        pairs = sorted(tuple(sorted(pair)) for pair in shell.site_pairs().tolist())
        assert pairs == pairs_by_distance(crystal, shell.distance)


def test_short_periodic_axes_are_refused_or_counted_with_images():
    for cells, problem in (((1, 5), "a spin with itself"), ((2, 5), "a pair of spins twice")):
        with pytest.raises(lt.LiethermoError, match=problem):
            mag.exchange(mag.lattice("square", cells), 1.0)
        with_images = mag.lattice("square", cells, images=True)
        up = np.tile([0.0, 0.0, 1.0], with_images.site_count)
        assert float(mag.exchange(with_images, 1.0)(up)) == -2.0 * with_images.site_count
        assert (
            len(mag.lattice("square", cells, periodic=(False, True)).shell(1).site_pairs()) == {1: 5, 2: 15}[cells[0]]
        )
    with pytest.raises(lt.LiethermoError, match="a pair of spins twice"):  # of two atoms, by two images
        mag.exchange(mag.lattice("bcc", (1, 3, 3)), 1.0)


@pytest.mark.parametrize(
    ("sites", "pairs"), [((2,), 1), ((1,), 0), ((1, 5), 5), ((2, 5), 15), ((2, 2), 4), ((3, 2), 9), ((4,), 4)]
)
def test_simple_lattices_count_each_pair_once(sites, pairs):
    up = np.tile([0.0, 0.0, 1.0], int(np.prod(sites)))
    assert float(mag.exchange(sites, 1.0)(up)) == -pairs
    with_images = mag.exchange(sites, 1.0, images=True)
    assert float(with_images(up)) == -len(sites) * np.prod(sites)


def test_antisymmetric_bonds_have_one_direction():
    with pytest.raises(lt.LiethermoError, match="two directions for one pair"):
        mag.dzyaloshinskii_moriya((2, 5), (0.0, 0.0, 1.0))
    assert mag.dzyaloshinskii_moriya((2, 5), (0.0, 0.0, 1.0), images=True).is_quadratic
    assert mag.dzyaloshinskii_moriya((2, 5), (0.0, 0.0, 1.0), periodic=(False, True)).is_quadratic
    x_then_y, D = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]), (0.3, -0.2, 0.7)  # D . (s_1 x s_2) is the third component
    bond = mag.lattice("chain", 2, periodic=False)
    for energy in (mag.dzyaloshinskii_moriya(bond, D), mag.dzyaloshinskii_moriya(2, D, periodic=False)):
        assert float(energy(x_then_y)) == pytest.approx(0.7, rel=1e-15)


def test_bonds_by_offset_and_by_distance():
    crystal = mag.lattice("honeycomb", (4, 4))
    nearest = crystal.bonds([(0, 1, (0, 0)), (0, 1, (-1, 0)), (0, 1, (0, -1))])
    np.testing.assert_allclose(np.linalg.norm(nearest.vectors, axis=1), 3**-0.5)
    assert sorted(map(tuple, nearest.site_pairs())) == sorted(map(tuple, crystal.shell(1).site_pairs()))
    assert len(crystal.neighbours(1.0)) == 3 + 6
    np.testing.assert_allclose(crystal.neighbours(0.6).directions @ [0.0, 0.0, 1.0], 0.0)
    square = mag.lattice("square", (4, 4))
    assert len(square.bonds([(1, 0), (0, 1)])) == 2
    np.testing.assert_allclose(square.reciprocal_vectors @ square.vectors.T, 2 * np.pi * np.eye(2), atol=1e-15)
    assert mag.lattice("triangular", 3).cell_volume == pytest.approx(3**0.5 / 2)


def test_vectors_and_a_basis():
    orthorhombic = mag.lattice([(1.0, 0, 0), (0, 2.0, 0), (0, 0, 3.0)], (3, 3, 3), basis=[(0, 0, 0), (0.5, 1.0, 1.5)])
    assert orthorhombic.sites == (3, 3, 3, 2)
    assert [s.coordination for s in orthorhombic.shells(2)] == [2, 8]
    np.testing.assert_allclose(orthorhombic.positions[1, 2, 0, 1], (1.5, 5.0, 1.5))


BAD = {
    "no such crystal": (lambda: mag.lattice("cubic", 3), "no crystal 'cubic'"),
    "a basis of its own": (lambda: mag.lattice("bcc", 3, basis=[(0, 0, 0)]), "a basis of its own"),
    "dependent vectors": (lambda: mag.lattice([(1, 0, 0), (2, 0, 0)], 3), "linearly independent"),
    "two atoms at one place": (
        lambda: mag.lattice(np.eye(3), 3, basis=[(0, 0, 0), (1, 0, 0)]),
        "atoms 0 and 1 of the basis",
    ),
    "cells": (lambda: mag.lattice("sc", (3, 3)), "one for each of the 3 axes"),
    "no cells": (lambda: mag.lattice("sc", 0), "positive integers"),
    "vectors of the plane": (lambda: mag.lattice([(1.0, 0.0)], 3), r"\(1, 3\)"),
    "a bond twice": (lambda: mag.lattice("square", 4).bonds([(1, 0), (-1, 0)]), "given twice"),
    "an atom that is none": (lambda: mag.lattice("square", 4).bonds([(0, 1, (1, 0))]), "two of the 1 atoms"),
    "no bonds": (lambda: mag.lattice("square", 4).neighbours(0.5), "at a distance of at most 0.5"),
    "half a shell": (lambda: mag.lattice("square", 4).shell(0), "positive integer"),
    "offsets": (lambda: mag.lattice("square", 4).bonds([(1, 0, 0)]), "2 integers"),
    "not finite": (lambda: mag.lattice("sc", 3, constant=np.nan), "finite"),
    "borders of a grid": (lambda: mag.exchange(mag.lattice("sc", 3), 1.0, periodic=False), "lt.magnetism.lattice"),
}


test_bad_lattices_are_refused = refusal_test(BAD, error=lt.LiethermoError)


def test_bonds_of_two_shells_that_join_one_pair_are_refused():
    """On a ring of three atoms the second neighbour is the first one of the other direction."""
    ring = mag.lattice("chain", 3)
    for strength in ([1.0, 0.5], {1: 1.0, 2: 0.5}):
        with pytest.raises(lt.LiethermoError, match="a pair of spins twice"):
            mag.exchange(ring, strength)
        with_images = mag.lattice("chain", 3, images=True)
        assert float(mag.exchange(with_images, strength)(np.tile([0.0, 0.0, 1.0], 3))) == -4.5
        assert float(mag.exchange(mag.lattice("chain", 5), strength)(np.tile([0.0, 0.0, 1.0], 5))) == -7.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"periodic": "no"}, "periodic must be True or False"),
        ({"periodic": (True, None, False)}, "periodic must be True or False"),
        ({"images": "no"}, "images must be True or False"),
        ({"primitive": 1}, "primitive must be True or False"),
        ({"constant": -1.0}, "the constant of a lattice must be one positive"),
        ({"constant": "x"}, "the constant of a lattice must be made of real numbers"),
        ({"constant": [1.0, 2.0, 3.0]}, "the constant of a lattice must be one positive"),
        ({"crystal": "hcp", "c_over_a": -1.0}, "c_over_a must be one positive"),
        ({"crystal": 1j}, "the vectors of a lattice must be made of real numbers"),
        ({"crystal": np.eye(3), "basis": "x"}, "the basis of a lattice must be made of real numbers"),
    ],
)
def test_wrong_kinds_of_arguments_are_refused(arguments, message):
    with pytest.raises(lt.InputError, match=message):
        mag.lattice(**{"crystal": "fcc", "cells": 3} | arguments)
    assert mag.lattice("fcc", 3, periodic=np.array([True, False, True])).periodic == (True, False, True)


def test_bad_bonds_are_refused():
    crystal = mag.lattice("sc", 3)
    for pairs in (3, None, "abc", [(np.nan, 0, 1)], [(0.5, 0, 1)], [(0, 0.5, (1, 0, 0))], [("0", 0, (1, 0, 0))]):
        with pytest.raises(lt.InputError, match="bond"):
            crystal.bonds(pairs)
    for distance in (-1.0, np.inf, np.nan, "x", [1.0]):
        with pytest.raises(lt.InputError, match="the distance of neighbours"):
            crystal.neighbours(distance)
    with pytest.raises(lt.InputError, match="the edges of a mesh must be made of real numbers"):
        mag.mesh((2, 2, 2), "x")
