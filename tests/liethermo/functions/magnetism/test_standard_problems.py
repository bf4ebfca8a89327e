"""Standard problem 3 of µMAG: the cube in which a flower and a vortex have one energy, beside published solutions."""

import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism


def rest_of_cube(length: float, count: int, is_vortex: bool):
    """Return the energy density and the mean of the spins at rest in a cube of ``count**3`` cells.

    Lengths are in ``l = sqrt(A / K_d)`` and energies in ``K_d = mu_0 M^2 / 2``. The anisotropy is ``0.1 K_d``, along z.
    """
    box = mag.mesh((count,) * 3, length / count)
    volume = box.cell_volume
    exchange = mag.continuum_exchange(box, 1.0)
    easy_axis = mag.anisotropy(box, 0.1 * volume)
    r = box.positions.reshape(count, count, count, 3)
    r = (r - r.mean(axis=(0, 1, 2))) / length
    if is_vortex:
        start = np.stack([np.full(r.shape[:-1], 0.1), -r[..., 2], r[..., 1]], axis=-1)
    else:
        start = np.array([0.0, 0.0, 1.0]) + 0.02 * r * np.sign(r[..., 2:])
    start /= np.linalg.norm(start, axis=-1, keepdims=True)
    rest = mag.minimise([exchange, easy_axis, mag.demagnetisation(box, 1.0, constant=2.0)], start, 1e-6)
    aligned = np.tile([0.0, 0.0, 1.0], count**3)
    offset = float(exchange(aligned)) + float(easy_axis(aligned))
    return (rest.energy - offset) / length**3, rest.spins.mean(axis=(0, 1, 2))


def cube_of_one_energy(count: int):
    """Return the edge of the cube, and the energy density there, by two lengths near the published one."""
    lengths = np.array([8.4, 8.55])
    flower, vortex = (np.array([rest_of_cube(L, count, kind)[0] for L in lengths]) for kind in (False, True))
    share = (flower - vortex)[0] / ((flower - vortex)[0] - (flower - vortex)[1])
    return lengths[0] + share * np.ptp(lengths), flower[0] + share * (flower[1] - flower[0])


@pytest.mark.slow
def test_a_flower_and_a_vortex_have_one_energy_in_the_published_cube():
    """The published edge is 8.47, the energy 0.3027, the means 0.971 and 0.352 [Rave, Fabian & Hubert 1998].

    The errors of cells fall with the square of their edges, so values on 10 and 14 cells an edge are extrapolated.
    """

    def extrapolate(coarse, fine):
        return fine + (fine - coarse) / (1.4**2 - 1.0)

    (length, energy), (fine_length, fine_energy) = cube_of_one_energy(10), cube_of_one_energy(14)
    assert extrapolate(length, fine_length) == pytest.approx(8.47, abs=0.005)
    assert extrapolate(energy, fine_energy) == pytest.approx(0.3027, abs=1e-4)
    flowers, vortices = ([rest_of_cube(8.47, count, kind)[1] for count in (10, 14)] for kind in (False, True))
    assert extrapolate(flowers[0][2], flowers[1][2]) == pytest.approx(0.971, abs=5e-4)
    assert extrapolate(vortices[0][0], vortices[1][0]) == pytest.approx(0.352, abs=1e-3)
    assert np.abs([*flowers[1][:2], *vortices[1][1:]]).max() < 1e-6
    assert abs(length - 8.47) > 0.05  # a control: without extrapolation ten cells are not enough
