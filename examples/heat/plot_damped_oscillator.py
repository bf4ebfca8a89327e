r"""
How well does a step keep up with friction?
===========================================

An oscillator and the bath of temperature :math:`\gamma` that its friction heats are an isolated system. Its energy
:math:`H = p^2/2 + q^2/2 + \gamma S` is constant. Its motion is the evolution field of H on a contact manifold. These
are the runs of Figures 1 and 2 of Anahory Simoes, Martín de Diego, Lainz Valcázar and de León (2020).
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.springs import damped_oscillator_solution

oscillator = lt.models.damped_oscillator(friction=0.1)
print(oscillator.check())

x0 = [0.0, 10.0, 0.0]
solution = lt.integrate(oscillator, x0, t_span=(0.0, 60.0), step=0.1)
print(solution.audit())

# %%
# For this H the midpoint scheme is the closed formula (39) of the paper. The positions follow the exact ones with a
# small delay, as in the midpoint rule. Every step produces heat.

exact = damped_oscillator_solution(solution.t, x0)
error = solution.x - exact
print(
    f"largest errors: q {np.abs(error[:, 0]).max():.3f}, S"
    f" {np.abs(error[:, 2]).max():.3f} of {exact[-1, 2]:.0f}"
)

# %%

figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.4), layout="constrained")
left.plot(solution.t, exact[:, 0], color="0.6", label="exact")
left.plot(
    solution.t, solution.x[:, 0], ".", color="#0072B2", markersize=3, label="h = 0.1"
)
left.set(xlabel="time", ylabel="q", title="Figure 1: position")
left.legend(frameon=False)
right.plot(solution.t, error[:, 2], color="#D55E00")
right.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
right.set(
    xlabel="time", ylabel=r"$S_k - S(t_k)$", title="Figure 2: error of the entropy"
)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
