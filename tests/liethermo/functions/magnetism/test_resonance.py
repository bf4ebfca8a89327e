"""The standard problem of ferromagnetic resonance beside OOMMF [Baker et al., J. Magn. Magn. Mater. 421 (2017) 428]."""

import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism
MU0 = 4e-7 * np.pi

CELLS = (24, 24, 2)
"""Cells of 5 nm of a film of 120 nm x 120 nm x 10 nm."""

FIELD = 8e4
"""Size of the applied field (A / m); its direction turns a little when the film has come to rest."""

FIRST_DIRECTION = (0.81345856316858023, 0.58162287266553481, 0.0)
SECOND_DIRECTION = (0.81923192051904048, 0.57346234436332832, 0.0)

OOMMF_MEANS = {
    5e-12: (0.7866698756101197, 0.59294533828153517, 0.00085506213483207939),
    5e-11: (0.79549404960057202, 0.58100936467559583, 0.00096629844607472651),
    1e-10: (0.78911967212797796, 0.58957160370321049, -0.0016194556754544726),
    2e-10: (0.79350175444401438, 0.58372201539268709, -0.0012619329068711404),
    3.5e-10: (0.78830069467336028, 0.59075905813884011, -0.0013747985907354356),
    5e-10: (0.78984131100935429, 0.58872237960884444, 0.0010318502241859514),
}
"""Means of the spins by the time (s), of the file ``reference_data/oommf/dynamic_txyz.txt`` that belongs to the paper
[github.com/fangohr/micromagnetic-standard-problem-ferromagnetic-resonance]."""


def film(direction):
    """Return the film of the problem in a field, with the gyromagnetic ratio of the file, 2.210173e5 m / (A s)."""
    g = 2.210173e5 / MU0 / mag.units("SI").gamma(1.0)
    return lt.models.micromagnet(CELLS, 5e-9, alpha=0.008, field=MU0 * FIELD * np.array(direction), g=g)


@pytest.mark.slow
def test_the_film_rings_as_in_oommf():
    """Both programs have the same cells and the same tensor of the field, so their means agree to seven digits.

    The peaks of the paper are at 8.25 and 11.25 GHz, of 20 ns and so in steps of 0.05 GHz. Here 5 ns are enough, since
    the motion decays in one.
    """
    start = np.tile(FIRST_DIRECTION, (*CELLS, 1))
    rest = mag.minimise(film(FIRST_DIRECTION).energy, start, 1e-8)
    system = film(SECOND_DIRECTION)
    run = lt.integrate(
        system, system.state(rest.spins), (0.0, 5e-9), 2.5e-13, lt.MetriplecticRungeKutta(4), save_every=20
    )
    assert (np.diff(run.energy) < 0.0).all()
    means = np.asarray(system.spins(run.x)).mean(axis=(1, 2, 3))
    for time, oommf_mean in OOMMF_MEANS.items():
        np.testing.assert_allclose(means[np.argmin(np.abs(run.t - time))], oommf_mean, atol=1e-7)
    y = means[:-1, 1] - means[-1, 1]
    window, n_padded = np.hanning(2 * len(y))[len(y) :], 16 * len(y)
    frequencies, power = np.fft.rfftfreq(n_padded, run.t[1]) * 1e-9, np.abs(np.fft.rfft(y * window, n_padded))
    peaks = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]))
    peak_indices = peaks[np.argsort(power[peaks])[-2:]]
    np.testing.assert_allclose(np.sort(frequencies[peak_indices]), [8.25, 11.25], atol=0.06)
