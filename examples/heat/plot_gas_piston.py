"""
Where does a piston between two gases stop?
===========================================

A piston that conducts heat and rubs on its cylinder separates two gases of different temperature and amount. First the
pressures become equal. Then heat spreads, and the piston drifts until the temperatures are equal too.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.gases import gas_piston_equilibrium, gas_piston_state

moles = (1.0, 2.0)
piston = lt.models.gas_piston(moles, mass=2.0, conductance=(5.0, 5.0), friction=40.0)
x0 = gas_piston_state(0.5, temperatures=(400.0, 300.0, 250.0), moles=moles)
solution = lt.integrate(piston, x0, t_span=(0.0, 60.0), step=0.01)
print(solution.audit())

# %%
# The end is known in closed form: equal pressures and temperatures at the given energy.

position, temperature = gas_piston_equilibrium(solution.energy[0], moles)
found = piston.temperatures(solution.x[-1])
print(f"position {solution.x[-1, 1]:.6f} (equilibrium {position:.6f})")
print(f"temperatures {np.round(found, 4)} (equilibrium {temperature:.4f})")

# %%

T = np.asarray(piston.temperatures(solution.x))
figure, (left, middle, right) = plt.subplots(
    1, 3, figsize=(10.0, 3.2), layout="constrained"
)
early = solution.t <= 1.5
left.plot(solution.t[early], solution.x[early, 1], color="#0072B2")
left.set(xlabel="time (s)", title="position (m), at first")
middle.plot(solution.t, solution.x[:, 1], color="#0072B2")
middle.axhline(position, color="0.7", linewidth=0.8)
middle.set(xlabel="time (s)", title="position (m)")
for name, series, color in zip(
    piston.names, T.T, ("#D55E00", "0.5", "#0072B2"), strict=True
):
    right.plot(solution.t, series, color=color, label=name)
right.axhline(temperature, color="0.7", linewidth=0.8)
right.set(xlabel="time (s)", title="temperatures (K)")
right.legend(frameon=False)
for ax in (left, middle, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
