"""
How do two bodies come to one temperature?
==========================================

Two bodies of temperatures 273.15 and 300 exchange heat by Fourier's law. The total energy is constant, the total
entropy grows at every step, and the temperatures meet at their mean. These are the runs of Figures 3 and 4 of Anahory
Simoes, Martín de Diego, Lainz Valcázar and de León (2020).
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.thermo_particles import thermo_particles_solution

bodies = lt.models.thermo_particles(capacities=(1.0, 1.0), conductance=1.0)
solution = lt.integrate(bodies, np.log([273.15, 300.0]), t_span=(0.0, 50.0), step=0.1)
print(solution.audit())

# %%
# Heat flows between the *discrete* temperatures of a step, the components of the discrete gradient of the energy. This
# makes the entropy grow by :math:`h k (T_a - T_b)^2 / (T_a T_b)` exactly, for every energy and every step.

temperatures = np.asarray(bodies.temperatures(solution.x))
exact = thermo_particles_solution(solution.t, [273.15, 300.0])
print(f"at the end {temperatures[-1]}, in equilibrium {(273.15 + 300.0) / 2}")
print(f"largest error on the way: {np.abs(temperatures - exact).max():.3f}")

# %%
# The temperatures are equal after a tenth of the run. The rest shows that nothing drifts.

early = solution.t <= 5.0
figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.4), layout="constrained")
left.plot(
    solution.t[early],
    solution.entropy[early] - solution.entropy[0],
    ".-",
    color="#009E73",
    markersize=4,
)
left.set(xlabel="time", ylabel="growth of $S_a + S_b$", title="Figure 3: total entropy")
for T, curve, name, color in zip(
    temperatures.T, exact.T, "ab", ("#0072B2", "#D55E00"), strict=True
):
    right.plot(solution.t[early], curve[early], color="0.6", linewidth=1)
    right.plot(
        solution.t[early], T[early], ".", color=color, markersize=4, label=f"$T_{name}$"
    )
right.set(xlabel="time", title="Figure 4: temperatures (lines: exact)")
right.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
