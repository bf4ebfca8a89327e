"""A domain wall in a field, in SI units, beside the solution of Schryer & Walker 1974."""

import math

import numpy as np
import pytest

import liethermo as lt

STIFFNESS = 1.3e-11
"""Exchange stiffness (J / m)."""

EASY = 4e5
"""Constant of the easy axis z (J / m^3)."""

HARD = 8e4
"""Constant of the hard axis y (J / m^3)."""

SATURATION = 8e5
"""Saturation magnetisation (A / m)."""

ALPHA = 0.2
"""Gilbert's damping constant."""

WALKER_FIELD = ALPHA * HARD / SATURATION
"""Field (T) above which the wall turns, ``alpha K_y / M``."""


def run_wall(share: float, angle: float, time: float, edge: float = 2e-9):
    """Return times (s) and positions (m) of a wall in a share of Walker's field, from a plane at an angle."""
    mag, count = lt.magnetism, int(320e-9 / edge)
    box = mag.mesh((count, 1, 1), edge)
    moment = SATURATION * box.cell_volume
    energy = [
        mag.continuum_exchange(box, STIFFNESS),
        mag.anisotropy(box, EASY * box.cell_volume),
        mag.anisotropy(box, -HARD * box.cell_volume, (0.0, 1.0, 0.0)),
        mag.zeeman(box, (0.0, 0.0, share * WALKER_FIELD), moment),
    ]
    motion = mag.units("SI").gilbert(ALPHA, moment)
    system = lt.SpinSystem(box, energy, lt.LandauLifshitz(motion.rate), ratio=motion.ratio)
    x = box.positions[:, 0, 0, 0] / wall_width(angle)
    m = np.zeros((count, 1, 1, 3))
    m[:, 0, 0, 2] = np.tanh(x[count // 4] - x)  # the field drives the wall along +x
    transverse = np.sqrt(1.0 - m[:, 0, 0, 2] ** 2)
    m[:, 0, 0, 0], m[:, 0, 0, 1] = transverse * math.cos(angle), transverse * math.sin(angle)
    run = lt.integrate(system, system.state(m), (0.0, time), 1e5 * edge**2, lt.MetriplecticRungeKutta(4), save_every=25)
    assert (np.diff(run.energy) < 0.0).all()
    return run.t, 0.5 * edge * np.asarray(system.spins(run.x))[:, :, 0, 0, 2].sum(axis=1)


def wall_width(angle: float) -> float:
    """Return the width (m) of a wall whose plane has an angle to the x axis."""
    return math.sqrt(STIFFNESS / (EASY + HARD * math.sin(angle) ** 2))


def mobility() -> float:
    """Return ``gamma / alpha`` (1 / (T s))."""
    return lt.magnetism.units("SI").gamma() / ALPHA


@pytest.mark.sampled(1)
@pytest.mark.parametrize("share", [0.5, 0.95])
@pytest.mark.parametrize(("edge", "rtol"), [(2e-9, 0.025), pytest.param(1e-9, 0.006, marks=pytest.mark.slow)])
def test_a_wall_below_walkers_field_moves_at_its_velocity(share, edge, rtol):
    """``v = gamma width(phi) B / alpha`` with ``sin 2 phi = B / B_W``; the error of cells is 1.7 % at 2 nm, O(edge^2).

    The wall has a width of 5 to 6 nm.
    """
    angle = 0.5 * math.asin(share)
    t, x = run_wall(share, angle, 8e-10, edge)
    late = t > 4e-10
    velocity = np.polyfit(t[late], x[late], 1)[0]
    assert velocity == pytest.approx(mobility() * wall_width(angle) * share * WALKER_FIELD, rel=rtol)


@pytest.mark.slow
def test_a_wall_above_walkers_field_turns_and_is_slower():
    """The mean velocity is ``gamma width (B - sqrt(B^2 - B_W^2) / (1 + alpha^2)) / alpha`` for a small hard axis.

    The width changes by 9 % as the wall turns; a control, the velocity of a wall that does not turn, is far off.
    """
    B = 1.5 * WALKER_FIELD
    root = math.sqrt(B**2 - WALKER_FIELD**2)
    gamma = lt.magnetism.units("SI").gamma()
    period = math.pi * (1.0 + ALPHA**2) / (gamma * root)
    t, x = run_wall(1.5, 0.25 * math.pi, 2.0 * period)
    velocity = (x[-1] - np.interp(t[-1] - period, t, x)) / period
    expected = mobility() * wall_width(0.25 * math.pi) * (B - root / (1.0 + ALPHA**2))
    assert velocity == pytest.approx(expected, rel=0.03)
    assert velocity < 0.6 * mobility() * wall_width(0.25 * math.pi) * B
    assert (np.diff(x) < 0.0).any()  # it even moves back


ANGSTROM = {"SI": 1e-10, "meV": 1.0}
"""One angstrom in the length of each system of units."""


@pytest.mark.parametrize("name", ANGSTROM)
def test_a_wall_of_atoms_has_its_width_in_units(name):
    """``m_z = tanh(x / delta)`` with ``delta = a sqrt(J / 2 K)``, 55.9 angstrom; atoms change it by 0.03 %.

    J is 300 k kelvin and K 0.3 k kelvin an atom, and a is 2.5 angstrom. The change is ``(a / delta)^2 / 6``.
    """
    mag, u = lt.magnetism, lt.magnetism.units(name)
    J, K, a = u.thermal_energy(300.0), u.thermal_energy(0.3), 2.5 * ANGSTROM[name]
    chain = mag.lattice("chain", 240, constant=a, periodic=False)
    x = chain.positions[:, 0] - chain.positions[:, 0].mean()
    start = np.zeros((240, 3))
    start[:, 2] = np.clip(x / (40 * a), -1.0, 1.0)
    start[:, 0] = np.sqrt(1.0 - start[:, 2] ** 2)
    wall = mag.minimise([mag.exchange(chain, J), mag.anisotropy(chain, K)], start, 1e-9)
    near = np.abs(x) < 20 * a
    width = 1.0 / np.polyfit(x[near], np.arctanh(wall.spins[near, 2]), 1)[0]
    assert width == pytest.approx(55.901699 * ANGSTROM[name], rel=6e-4)


@pytest.mark.parametrize("name", ANGSTROM)
def test_a_spiral_of_atoms_has_its_pitch_in_units(name):
    """Spins turn by ``arctan(D / J)`` from one atom to the next, so the pitch is ``2 pi a / arctan(D / J)``.

    J is 300 k kelvin and D 60 k kelvin a bond; a is 2.5 angstrom, and the pitch 79.6 angstrom. With D > 0 along x the
    spins turn by the negative angle about x.
    """
    mag, u = lt.magnetism, lt.magnetism.units(name)
    J, D, a = u.thermal_energy(300.0), u.thermal_energy(60.0), 2.5 * ANGSTROM[name]
    chain = mag.lattice("chain", 64, constant=a, periodic=False)
    angle = -2.0 * math.pi * np.arange(64) / 60.0  # too slow a turn
    start = np.stack([0.1 * np.cos(7.0 * angle), np.cos(angle), np.sin(angle)], axis=-1)
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    energy = [mag.exchange(chain, J), mag.dzyaloshinskii_moriya(chain.shell(1), [D, 0.0, 0.0])]
    spiral = mag.minimise(energy, start, 1e-11)
    turns = np.diff(np.unwrap(np.arctan2(spiral.spins[:, 2], spiral.spins[:, 1]))) / (2.0 * math.pi)
    np.testing.assert_allclose(a / turns, -79.5760719 * ANGSTROM[name] * np.ones(63), rtol=1e-6)
    np.testing.assert_allclose(spiral.spins[:, 0], 0.0, atol=1e-6)
