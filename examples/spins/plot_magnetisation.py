"""
How far do spins turn to a field?
=================================

Spins are in a field B and in a bath of temperature T. The double bracket turns each spin to the field, and its noise
turns it away. The magnetisation of their equilibrium is Langevin's function ``L(x) = coth x - 1/x`` at
``x = B / (k T)``. The length of a spin is exact on every path.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

system = lt.LiePoissonSystem(
    mf.so(3), lambda s: -s[2], None, lt.DoubleBracket(rate=1.0)
)
start = np.tile([1.0, 0.0, 0.0], (1000, 1))
ratios, found, errors = np.array([0.3, 1.0, 2.0, 4.0, 8.0]), [], []
for i, ratio in enumerate(ratios):
    noise = lt.Fluctuations(seed=i, temperature=1 / ratio)
    spins = lt.ensemble(
        system,
        start,
        (0.0, 8.0),
        0.05 / (1 + 1 / ratio),
        noise=noise,
        outputs="trajectory",
        save_every=8,
    )
    of_each = spins.x[:, spins.t >= 4.0, 2].mean(axis=1)
    found.append(of_each.mean())
    errors.append(2 * of_each.std() / np.sqrt(len(start)))
    print(
        f"B / kT = {ratio}: |s| off by"
        f" {np.abs(np.linalg.norm(spins.x, axis=2) - 1).max():.0e} at most"
    )

# %%

x = np.linspace(0.01, 9.0, 200)
figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
ax.plot(x, 1 / np.tanh(x) - 1 / x, color="k", lw=1.0, label="Langevin: coth x - 1/x")
ax.errorbar(
    ratios,
    found,
    errors,
    fmt="o",
    color="#D55E00",
    label="1,000 spins, two standard errors",
)
ax.set(xlabel="field over temperature", ylabel="magnetisation", title="Spins in a bath")
ax.legend(frameon=False)
ax.spines[["top", "right"]].set_visible(False)
plt.show()
