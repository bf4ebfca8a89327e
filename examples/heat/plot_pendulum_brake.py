r"""
A pendulum warms its brake: damping and heat capacity from data
===============================================================

An eddy-current brake damps a pendulum, and the energy of the swing warms the copper of the brake. One sensor records
the angle in degrees. Another sensor records the temperature of the copper in °C, ten times less often. The fit below
finds the damping and the heat capacity together. The fitted system conserves the total energy exactly, so the copper
receives the energy that the swing loses.

The state is :math:`(q, p, S)`: the angle, its momentum :math:`m l^2 \dot q`, and the entropy of the copper, whose
temperature is :math:`T = T_0 \exp(S / C)`. It depends on the capacity :math:`C`, a parameter of the fit.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

MASS, LENGTH, GRAVITY, ROOM = 0.5, 0.4, 9.81, 293.15  # kg, m, m/s^2, K
DAMPING, CAPACITY = 6e-3, 3.0  # N m s, and J/K: 8 g of copper

# %%
# The data come from another program: SciPy integrates :math:`m l^2 \ddot q = -m g l \sin q - \gamma \dot q` and
# :math:`C \dot T = \gamma \dot q^2`. The errors are 0.3° and 0.01 K. Missing temperatures are NaN.

random = np.random.default_rng(3)
t = np.sort(random.uniform(0.0, 20.0, 300))


def motion(t, state):
    q, v, _ = state
    return [
        v,
        -GRAVITY / LENGTH * np.sin(q) - DAMPING / (MASS * LENGTH**2) * v,
        DAMPING * v**2 / CAPACITY,
    ]


q, v, T = solve_ivp(
    motion, (0.0, 20.0), [1.2, 0.0, ROOM], "DOP853", t, rtol=1e-11, atol=1e-12
).y
angle = np.degrees(q) + 0.3 * random.standard_normal(len(t))
temperature = T - 273.15 + 0.01 * random.standard_normal(len(t))
temperature[np.arange(len(t)) % 10 != 0] = np.nan
table = {"time [s]": t, "angle [deg]": angle, "temperature [degC]": temperature}

# %%
# The model, and what the sensors show of it. Units in the labels are converted: to radians and kelvins here.


def pendulum(p):
    def energy(x):
        return x[1] ** 2 / (2 * MASS * LENGTH**2) - MASS * GRAVITY * LENGTH * jnp.cos(
            x[0]
        )

    brake = lt.HeatBaths(p["capacity"], ROOM)
    return lt.MetriplecticSystem(
        mf.Canonical(1),
        energy,
        dissipation=lt.Friction([0.0, p["damping"]]),
        baths=brake,
    )


def sensors(x, p):
    return {"angle": x[0], "temperature": ROOM * jnp.exp(x[2] / p["capacity"])}


guess = {"damping": 0.01, "capacity": 1.0}
found = lt.learn.fit(pendulum, table, parameters=guess, positive=True, observe=sensors)
print(found.training)
interval = found.training.confidence_interval(0.95)
for name, low, high, true in zip(
    found.training.names, *interval, (DAMPING, CAPACITY), strict=True
):
    print(f"{name}: {low:.3g} to {high:.3g}, true {true:.3g}")

# %%
# The fitted system is an ordinary one. Its run conserves the energy to rounding, and its entropy never falls.

run = lt.integrate(
    found,
    found.training.initial_states[0],
    (t[0], t[-1]),
    0.02,
    lt.MetriplecticGauss(2),
)
print(run.audit())

# %%

figure, (above, below) = plt.subplots(
    2, figsize=(7, 4.4), sharex=True, layout="constrained"
)
above.plot(t, angle, ".", color="tab:gray", markersize=4)
above.plot(run.t, np.degrees(run.x[:, 0]), color="tab:blue", linewidth=0.8)
above.set(ylabel="angle (degrees)")
below.plot(t, temperature, ".", color="tab:gray")
below.plot(
    run.t,
    ROOM * np.exp(run.x[:, 2] / np.asarray(found.training.values[1])) - 273.15,
    color="tab:orange",
)
below.set(xlabel="time (s)", ylabel="temperature (°C)")
plt.show()
