"""
How much does a piston between two gases jitter?
================================================

Two gases push a piston from both sides. Its mean position is where the pressures agree, but molecules hit it, and so it
never rests. The size of its motion follows from the entropy: a displacement d changes the entropy of the gases by
``-d^2 / 2 (n_l R / q^2 + n_r R / (L - q)^2)``, so the variance of the position is k over that bracket. With the real k
the motion is smaller than an atom. This example uses a larger k, as for gases of few molecules. The total energy is
exact on every path.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.gases import GAS_CONSTANT, gas_piston_state

moles, k = (1.0, 2.0), 1e-3
system = lt.models.gas_piston(moles=moles, conductance=(100.0, 100.0))
place = moles[0] / sum(moles)
start = np.tile(gas_piston_state(place, (300.0, 300.0, 300.0), moles=moles), (200, 1))
noise = lt.Fluctuations(boltzmann=k, seed=0)
pistons = lt.ensemble(
    system, start, (0.0, 1.2), 2e-3, noise=noise, outputs="trajectory", save_every=3
)
print(pistons.audit())

variance = k / (
    moles[0] * GAS_CONSTANT / place**2 + moles[1] * GAS_CONSTANT / (1 - place) ** 2
)
late = pistons.x[:, pistons.t >= 0.5, 1] - place
print(
    f"standard deviation of the place: {late.std():.3e} m, by the entropy"
    f" {np.sqrt(variance):.3e} m"
)

# %%

figure, (left, right) = plt.subplots(
    1, 2, figsize=(9, 3.5), layout="constrained", sharey=True
)
for path in pistons.x[:2]:
    left.plot(pistons.t, 1e3 * (path[:, 1] - place), lw=0.8)
left.set(xlabel="time (s)", ylabel="off its place (mm)", title="Two pistons")
d = np.linspace(-4, 4, 200) * np.sqrt(variance)
right.hist(
    1e3 * late.ravel(),
    60,
    density=True,
    orientation="horizontal",
    color="#56B4E9",
    label="200 pistons",
)
normal = np.exp(-(d**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
right.plot(normal / 1e3, 1e3 * d, color="k", lw=1.0, label="by the entropy")
right.set(xlabel="density (1 / mm)", title="Where they are")
right.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
