"""
Where does a magnet lose its order?
===================================

The energy of spins on a cubic lattice favours parallel neighbours, and the noise of a bath of constant temperature
disorders them. The magnet has a transition at ``k T / J = 1.4429``: below this temperature the spins point in one
direction. At the transition Binder's cumulant of the magnetisation hardly depends on the size of the lattice. These
runs are short. :doc:`/explanation/magnet` has long runs with error bars and compares them with Monte Carlo.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

temperatures, step, every = np.array([1.2, 1.36, 1.4429, 1.55, 1.75]), 0.025, 20


def magnetisations(length, temperature, steps=1600):
    """Return the square of the mean spin of a run without its beginning."""
    sites = (length,) * 3
    magnet = lt.models.spin_lattice(
        sites, rate=2.0, baths=lt.HeatBaths(np.inf, temperature)
    )
    up = np.tile([0.0, 0.0, 1.0], (*sites, 1))
    run = lt.integrate(
        magnet,
        magnet.state(up),
        (0.0, steps * step),
        step,
        noise=lt.Fluctuations(seed=length),
        save_every=every,
        engine="array",
    )
    mean = np.asarray(magnet.spins(run.x)).mean(axis=(1, 2, 3))
    energy = (
        run.energy - temperature * run.x[:, -1]
    )  # of the spins: what the bath has is T times its entropy
    assert np.ptp(run.energy) < 1e-12 * abs(run.energy[0])
    return (mean**2).sum(axis=1)[10:], energy[10:] / length**3


# %%
# The figure shows magnetisation, specific heat and cumulant of two lattices.

figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for length, colour in ((4, "#0072B2"), (6, "#D55E00")):
    squares, energies = zip(
        *(magnetisations(length, T) for T in temperatures), strict=True
    )
    m = [np.sqrt(square).mean() for square in squares]
    c = [
        energy.var() * length**3 / T**2
        for energy, T in zip(energies, temperatures, strict=True)
    ]
    U = [1 - (square**2).mean() / (3 * square.mean() ** 2) for square in squares]
    for ax, values in zip(axes, (m, c, U), strict=True):
        ax.plot(temperatures, values, "o-", color=colour, label=f"{length}³ spins")
for ax, name in zip(
    axes, ("magnetisation", "specific heat", "Binder's cumulant"), strict=True
):
    ax.axvline(1.4429, color="0.6", lw=0.8)
    ax.set(xlabel="kT / J", ylabel=name)
    ax.spines[["top", "right"]].set_visible(False)
axes[0].legend(frameon=False)
plt.show()
