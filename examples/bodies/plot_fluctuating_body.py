"""
How does a body fluctuate about its axis?
=========================================

The dissipation of Morrison's rigid body (1986) turns it to the axis of its largest moment of inertia, where the entropy
``S = 2 |mu|^2`` is largest for its energy. With the noise that belongs to the dissipation the momentum wanders over its
energy surface. Its distribution tends to the measure ``exp(S / k)`` on this surface. On every path the energy is
constant to rounding.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

moments = np.array([3.0, 2.0, 1.0])
body = lt.LiePoissonSystem(
    mf.so(3),
    lt.Quadratic(1 / moments),
    lt.Quadratic(4 * np.ones(3)),
    lt.KillingDissipation(0.5),
)
start = np.tile([0.0, 0.0, 1.0], (2000, 1))
noise = lt.Fluctuations(boltzmann=1.0, seed=0)
bodies = lt.ensemble(
    body, start, (0.0, 8.0), 0.05, noise=noise, outputs="trajectory", save_every=4
)
print(bodies.audit())

# %%
# The exact distribution: uniform directions u give points on the energy ellipsoid, distributed as in a thin shell. Each
# point has the weight ``exp(S / k)``.

u = np.random.default_rng(1).standard_normal((400_000, 3))
points = np.sqrt(moments) * u / np.linalg.norm(u, axis=1, keepdims=True)
weights = np.exp(2.0 * (points**2).sum(axis=1))
late = bodies.x[:, bodies.t >= 4.0].reshape(-1, 3)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for path in bodies.x[:3]:
    left.plot(bodies.t, path[:, 0], lw=1.0)
left.set(xlabel="time", ylabel="momentum along the first axis", title="Three bodies")
bins = np.linspace(-np.sqrt(3), np.sqrt(3), 41)
right.hist(late[:, 0], bins, density=True, color="#56B4E9", label="2,000 bodies")
right.hist(
    points[:, 0],
    bins,
    weights=weights,
    density=True,
    histtype="step",
    color="k",
    label="exp(S / k)",
)
right.set(
    xlabel="momentum along the first axis", title="Either end of the axis is as good"
)
right.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
