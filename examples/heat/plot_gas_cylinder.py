r"""
Where do work and heat from outside go?
=======================================

A gas under a piston that rubs on its cylinder is pushed by the air outside and heated for two seconds. The system is
not isolated: a ledger in its state records the work and the heat that it receives, and its energy less the ledger is
constant. The audit shows how well a discretisation closes this balance.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.gases import cylinder_rest

pressure, heat_capacity = (
    1.0e5,
    2.5 * 8.31446261815324,
)  # Pa; of one mole at constant pressure, J/K


def heater(q, v, S, t):
    """500 W until t = 2 s (W)."""
    return 250.0 * (1.0 - jnp.tanh(20.0 * (t - 2.0)))


gas = lt.models.cylinder(
    mass=20.0, friction=150.0, pressure=pressure, heat_power=heater
)
x0 = cylinder_rest(pressure, T=300.0)
solution = lt.integrate(
    gas, x0, (0.0, 6.0), 0.01, lt.VariationalIntegrator.symmetrised()
)
print(
    solution.audit(energy=1e-6)
)  # of a variational scheme, which does not keep it to rounding

# %%
# Halving the step quarters the defect of the balance: the scheme has order 2.

for step in (0.02, 0.01, 0.005):
    run = lt.integrate(
        gas, x0, (0.0, 6.0), step, lt.VariationalIntegrator.symmetrised()
    )
    print(
        f"step {step:5}: balance closed to {run.audit().energy_drift:.1e} of the energy"
    )

# %%
# From rest to rest at constant pressure all heat goes into the enthalpy, for every friction:

work, heat = (solution.casimirs[name] for name in ("work received", "heat received"))
temperature = np.asarray(gas.temperature(solution.x))
print(
    f"temperature at the end {temperature[-1]:.4f} K, expected"
    f" {300.0 + heat[-1] / heat_capacity:.4f} K"
)

# %%

figure, (left, middle, right) = plt.subplots(
    1, 3, figsize=(10.0, 3.2), layout="constrained"
)
left.plot(solution.t, solution.x[:, 0], color="#0072B2")
left.set(xlabel="time (s)", title="height of the piston (m)")
middle.plot(solution.t, temperature, color="#D55E00")
middle.set(xlabel="time (s)", title="temperature (K)")
own = np.asarray(gas.mechanical_energy(solution.x))
for label, series, color in (
    ("energy of the gas", own - own[0], "0.2"),
    ("heat received", heat, "#D55E00"),
    ("work received", work, "#0072B2"),
):
    right.plot(solution.t, series, color=color, label=label)
right.set(xlabel="time (s)", title="ledger (J)")
right.legend(frameon=False)
for ax in (left, middle, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
