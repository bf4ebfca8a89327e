r"""
How does a body in space come to spin about one axis?
=====================================================

A rigid body has three wheels that rub in their bearings. Its angular momentum and its total energy are constant: the
lost kinetic energy heats the body. Its equations are Euler-Poincaré equations with entropy on :math:`so(3) + R^3`, and
their variational principle, discretised through the Cayley map, conserves the spatial momentum exactly. Such a scheme
conserves the energy only approximately: its error, in the right panel, is of second order in the step.
``lt.MetriplecticGauss()`` conserves the energy to rounding.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.body_with_wheels import body_with_wheels_rest

body, method, h = lt.models.body_with_wheels(friction=0.05), lt.LieVariational(), 0.05
# The body spins about its middle axis, which is unstable; its wheels do not turn in it.
x0 = [0.05, 1.0, 0.05, 0.0, 0.0, 0.0, 0.0]
solution = lt.integrate(body, x0, (0.0, 150.0), h, method, engine="array")
# A variational scheme conserves the energy only approximately.
print(solution.audit(energy=1e-3))

# %%
# The momentum as seen from the body moves to the axis of greatest inertia. The attitudes of the body transform it to
# space, where it is constant.

attitudes = method.attitudes(body, solution.x, h)[:, :3, :3]
momenta = np.asarray(body.momenta(solution.x))[:, :3]
spatial = np.einsum("kij,kj->ki", attitudes, momenta)
print(f"the spatial momentum moves by {np.abs(spatial - spatial[0]).max():.1e}")

# %%
# The final state is known in closed form.

temperature = np.asarray(body.temperature(solution.x))
expected = body_with_wheels_rest(np.linalg.norm(momenta[0]), solution.energy[0])
print(f"temperature at the end {temperature[-1]:.5f}, expected {expected:.5f}")

# %%

figure, (left, middle, right) = plt.subplots(
    1, 3, figsize=(10.0, 3.2), layout="constrained"
)
for i, color in enumerate(("#D55E00", "#0072B2", "#009E73")):
    left.plot(solution.t, momenta[:, i], color=color, label=f"axis {i + 1}")
    left.plot(solution.t, spatial[:, i], color=color, linestyle=":")
left.set(xlabel="time", title="momentum (dotted: in space)")
left.legend(frameon=False)
middle.plot(solution.t, temperature, color="#D55E00")
middle.axhline(expected, color="0.7", linewidth=0.8)
middle.set(xlabel="time", title="temperature")
error = solution.energy / solution.energy[0] - 1.0
right.plot(solution.t, 1e4 * error, color="0.2")
right.set(xlabel="time", title="relative energy error / $10^{-4}$")
for ax in (left, middle, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
