r"""
How does a pendulum that swings in all directions come to rest in a gas?
========================================================================

A bob on a rod moves on a sphere. It swings in a gas, and its friction warms the gas. The positions are points of the
sphere, given as unit vectors. There are no angles, and so no pole at which angles fail. The Lagrangian, the friction
and the entropy are written as on :math:`\mathbb R^3`,

.. math::
   L = \tfrac12 m |v|^2 - m g q_3 - U(S), \qquad F = -r v, \qquad U(S) = C T_0 e^{S/C},

with the rod of length 1. Only the derivatives of these functions along the sphere matter.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

m, g, r, C, T0 = 1.0, 9.81, 0.25, 40.0, 300.0  # kg, m/s^2, kg/s, J/K, K


def lagrangian(q, v, S):
    return 0.5 * m * v @ v - m * g * q[2] - C * T0 * jnp.exp(S / C)


pendulum = lt.SimpleClosedSystem(lagrangian, friction=r, space=mf.Sphere(2))

# %%
# For comparison, SciPy solves the equations of two angles at a tolerance of 1e-13: :math:`\theta` from the upward
# vertical, and :math:`\varphi` around it.


def in_angles(t, y):
    theta, _, w, u, S = y
    sin, cos = np.sin(theta), np.cos(theta)
    w_dot = sin * cos * u**2 + g * sin - r / m * w
    u_dot = -2.0 * cos / sin * w * u - r / m * u
    return [w, u, w_dot, u_dot, r * (w**2 + sin**2 * u**2) / (T0 * np.exp(S / C))]


def on_sphere(y):
    theta, phi, w, u, S = y
    q = np.array(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    )
    down = np.array(
        [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]
    )
    v = w * down + np.sin(theta) * u * np.array([-np.sin(phi), np.cos(phi), 0.0])
    return np.concatenate([q, v, [S]])


y0, end = [1.9, 0.0, 0.0, 2.5, 0.0], 4.0
x0 = on_sphere(y0)
reference = on_sphere(
    solve_ivp(in_angles, (0.0, end), y0, method="DOP853", rtol=1e-13, atol=1e-13).y[
        :, -1
    ]
)

# %%
# The points of the variational schemes stay on the sphere to rounding, and the entropy never falls, but the energy is
# conserved only approximately. The metriplectic methods also conserve the energy to rounding. The errors fall with the
# step according to the order of each method.

methods = {
    "scheme 1": lt.VariationalIntegrator.verlet(),
    "scheme 2": lt.VariationalIntegrator.midpoint(),
    "scheme 2, geodesics": lt.VariationalIntegrator.midpoint(retraction="exp"),
    "scheme 3": lt.VariationalIntegrator.symmetrised(),
    "Gauss, order 4": lt.MetriplecticGauss(2),
}
counts = np.array([40, 80, 160, 320])
errors = {}
for name, method in methods.items():
    runs = [lt.integrate(pendulum, x0, (0.0, end), end / n, method) for n in counts]
    errors[name] = np.array([np.abs(run.x[-1] - reference).max() for run in runs])
    q, v = runs[0].x[:, :3], runs[0].x[:, 3:6]
    print(
        f"{name:20} order {np.log2(errors[name][-2] / errors[name][-1]):.2f}, "
        f"energy to {np.ptp(runs[0].energy) / np.abs(runs[0].energy).max():.0e}, "
        f"least rise of the entropy {np.diff(runs[0].entropy).min():.0e}, "
        "off the sphere"
        f" {max(np.abs((q**2).sum(1) - 1).max(), np.abs((q * v).sum(1)).max()):.0e}"
    )

# %%
# The figure shows the path from above, the energies, and the errors.

run = lt.integrate(pendulum, x0, (0.0, 40.0), 0.02, lt.MetriplecticGauss(2))
T = T0 * np.exp(run.x[:, 6] / C)
lost = 0.5 * m * (run.x[:, 3:6] ** 2).sum(1) + m * g * run.x[:, 2]

_, (left, middle, right) = plt.subplots(1, 3, figsize=(11.0, 3.6), layout="constrained")
left.plot(run.x[:, 0], run.x[:, 1], linewidth=0.8)
left.set(xlabel="$q_1$", ylabel="$q_2$", aspect="equal", title="seen from above")
middle.plot(run.t, lost[0] - lost, label="lost by the bob")
middle.plot(run.t, C * (T - T[0]), "--", label="gained by the gas")
middle.set(xlabel="time (s)", ylabel="energy (J)", title="what becomes of the energy")
middle.legend(frameon=False)
for name, error in errors.items():
    right.loglog(end / counts, error, "o-", label=name, linewidth=1.0, markersize=3)
right.set(xlabel="step (s)", ylabel="error at 4 s", title="against two angles")
right.legend(frameon=False, fontsize="small")
for ax in (left, middle, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
