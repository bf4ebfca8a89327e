"""
Where does a piston stop that lets the gas through?
===================================================

Two gases push a piston to the place where their pressures agree. If the piston has pores, particles pass from the
higher to the lower chemical potential too, and in the end both densities are equal. Then no force acts on the piston,
at any position. So its final position depends on how fast the gas leaks while the piston moves.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.gases import porous_piston_state

x0 = porous_piston_state(
    left=(2.0, 1.4), right=(1.0, 0.8)
)  # (particles, temperature), the piston in the middle
permeabilities = (0.0, 0.02, 0.1, 1.0)

_, axes = plt.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")
for L in permeabilities:
    system = lt.models.porous_piston(permeability=L)
    run = lt.integrate(system, x0, (0.0, 400.0), 0.05, lt.MetriplecticGauss(2))
    S_l, N_l, q, p, S_p, S_r, N_r = run.x.T
    T, mu = system.temperatures(run.x[-1]), system.chemical_potentials(run.x[-1])
    print(
        f"L = {L:4}: stops at q = {q[-1]:.4f}, densities {N_l[-1] / q[-1]:.4f} and"
        f" {N_r[-1] / (2 - q[-1]):.4f}, "
        f"temperatures within {np.ptp(T):.0e}, chemical potentials {np.ptp(mu):.0e};"
        " particles kept to "
        f"{np.ptp(N_l + N_r):.0e}, energy to"
        f" {np.ptp(run.energy) / abs(run.energy[0]):.0e}, "
        f"least rise of the entropy {np.diff(run.entropy).min():.0e}"
    )
    seen = run.t < 60.0
    axes[0].plot(run.t[seen], q[seen], label=f"L = {L:g}")
    axes[1].plot(run.t[seen], (N_l / q - N_r / (2.0 - q))[seen])
    axes[2].plot(run.t[seen], run.entropy[seen] - run.entropy[0])
for ax, label in zip(
    axes,
    ("place of the piston", "difference of densities", "entropy made"),
    strict=True,
):
    ax.set(xlabel="time", ylabel=label)
    ax.spines[["top", "right"]].set_visible(False)
axes[0].legend(frameon=False)
plt.show()

# %%
# Without pores the piston rests where the pressures agree, two thirds along the cylinder, as the gases have two and one
# particle. With pores the densities agree as well. The laws and the number of particles hold to rounding in all runs:
# the membrane acts as a friction between chemical potentials, in the same form as the friction of the piston.
