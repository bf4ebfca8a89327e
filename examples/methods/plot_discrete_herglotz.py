r"""
What does a variational integrator lose?
========================================

The discrete Herglotz integrator comes from a discrete Lagrangian, not from a discrete gradient. On the damped
oscillator it is cheap and explicit, and its path is accurate. But it obeys neither law exactly. These are the runs of
Figures 5 and 6 of Anahory Simoes, Martín de Diego, Lainz Valcázar and de León (2020).
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.springs import damped_oscillator_solution

gamma, h = 0.1, 0.1


def action(q0, q1, S0, h):
    """Of one step, by the midpoint rule [SML Example 7]."""
    return (
        (q1 - q0) @ (q1 - q0) / (2 * h) - h * (q1 + q0) @ (q1 + q0) / 8 - h * gamma * S0
    )


oscillator, herglotz = (
    lt.models.damped_oscillator(friction=gamma),
    lt.DiscreteHerglotz(action),
)

# %%
# The paper starts from two positions. The state after them has the momentum that belongs to the action.

x1 = herglotz.state(q0=0.0, q1=1.0, S0=0.0, h=h)
print(f"after the first step: q, p, S = {np.round(x1, 4)}")
variational = lt.integrate(oscillator, x1, (h, 80.0 + h), h, herglotz)
metriplectic = lt.integrate(oscillator, x1, (h, 80.0 + h), h)
exact = damped_oscillator_solution(variational.t - h, x1)

# %%
# The audit shows more than the picture. The energy oscillates and settles a sixtieth below its initial value. In some
# steps, where the motion turns, the entropy falls.

print(variational.audit())

# %%

figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.4), layout="constrained")
left.plot(variational.t, exact[:, 0], color="0.6", label="exact")
left.plot(
    variational.t,
    variational.x[:, 0],
    ".",
    color="#0072B2",
    markersize=3,
    label="discrete Herglotz",
)
left.set(xlabel="time", ylabel="q", title="Figure 5: position")
left.legend(frameon=False)
right.plot(
    variational.t, variational.energy, color="#0072B2", label="discrete Herglotz"
)
right.plot(
    metriplectic.t, metriplectic.energy, color="#E69F00", label="metriplectic midpoint"
)
right.set(xlabel="time", ylabel="H", title="Figure 6: energy")
right.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
