"""
How long may a step be when heat spreads?
=========================================

Neighbouring bodies of a grid exchange their heat in a time c/k. The whole grid reaches one temperature only after a
time that grows with the square of its width. An implicit step may be a hundred times longer than c/k, and both laws
still hold. The Jacobian matrix of such a step is sparse, and the engine solves it as a sparse matrix.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.thermo_particles import heat_grid_solution

shape = (60, 60)
grid = lt.models.heat_grid(shape, capacity=1.0, conductance=1.0)
x, y = np.meshgrid(np.arange(60), np.arange(60), indexing="ij")
start = (
    280.0
    + 40.0 * np.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 50.0)
    + 15.0 * (1.0 + np.tanh((y - 40) / 4.0))
)
solution = lt.integrate(grid, np.log(start).ravel(), t_span=(0.0, 800.0), step=10.0)
print(solution.audit())

# %%
# The exact temperatures are sums of cosines. The midpoint scheme has no numerical damping. So the initial temperatures
# must be smooth on the scale to which heat spreads in a step.

late = np.exp(solution.x[-1]).reshape(shape)
exact = heat_grid_solution(800.0, start)
print(
    f"largest error at the end: {np.abs(late - exact).max():.3f}, of"
    f" {np.ptp(exact):.1f} between warmest and coldest"
)
print(f"iterations a step: {solution.stats.iterations_per_step:.0f}")

# %%

figure, axes = plt.subplots(
    1, 4, figsize=(10.0, 2.8), layout="constrained", width_ratios=(1, 1, 1, 1.2)
)
for ax, step in zip(axes, (0, 10, 80), strict=False):
    image = ax.imshow(
        np.exp(solution.x[step]).reshape(shape).T,
        vmin=280,
        vmax=320,
        cmap="inferno",
        origin="lower",
    )
    ax.set(title=f"t = {solution.t[step]:.0f}", xticks=[], yticks=[])
figure.colorbar(image, ax=axes[2], label="temperature")
axes[3].plot(
    solution.t,
    solution.entropy - solution.entropy[0],
    ".-",
    color="#009E73",
    markersize=4,
)
axes[3].set(xlabel="time", title="growth of the entropy")
axes[3].spines[["top", "right"]].set_visible(False)
plt.show()
