r"""
How fast does sloshing fuel damp a nutation?
============================================

A satellite spins about its axis of greatest inertia, and the axis is tilted by a few degrees from the angular momentum.
The fuel in its tank moves like a pendulum in the centrifugal field. The viscosity of the fuel lowers the energy, while
the angular momentum in space is constant, so the nutation decays. A tree of two bodies has the whole motion. For small
angles the equations are linear, and an eigenvalue gives the damping time.

The numbers are those of a satellite of medium size, not of a named one: published damping times of satellites in flight
depend on data of their tanks that are not published with them.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

spin = 0.6  # rad/s
M, bus_inertia = (
    400.0,
    np.array([90.0, 95.0, 120.0]),
)  # kg, kg m^2, of the satellite without the fuel
m, a, length, damping = (
    30.0,
    0.5,
    0.3,
    1.5,
)  # kg; distance of the pivot from the axis, m; m; N m s

tree = lt.bodies.Tree()
tree.add("bus", mass=M, inertia=bus_inertia)
pivot = lt.bodies.Hinge(at=(a, 0.0, 0.0), axis=(0.0, -1.0, 0.0), damping=damping)
tree.add("fuel", mass=m, centre=(length, 0.0, 0.0), parent="bus", joint=pivot)
system = tree.system(baths=lt.HeatBaths(capacity=2e4, temperature=290.0))

x0 = system.state(angular_velocity=(0.02, 0.0, spin))
solution = lt.integrate(
    system, x0, (0.0, 2400.0), 0.25, lt.MetriplecticGauss(2), save_every=4
)
print(solution.audit())

# %%
# Linear theory. The fuel, at :math:`\rho = (b, 0, z)` with :math:`b = a + l`, :math:`z = l \theta`, has the reduced
# mass :math:`\mu = m M / (m + M)`. To first order in :math:`\Omega_1, \Omega_2, z` the angular
# momentum is :math:`L_1 = I_1 \Omega_1 - \mu b s z`, :math:`L_2 = I_2 \Omega_2 - \mu b \dot z`,
# :math:`L_3 = I_3 s`, and
#
# .. math::
#
#     \dot L_1 = s L_2 - L_3 \Omega_2, \quad \dot L_2 = L_3 \Omega_1 - s L_1, \quad
#     \mu (\ddot z - b \dot\Omega_2 + s b\, \Omega_1) = -\mu s^2 \frac{b}{l} z - \frac{c}{l^2} \dot z .
#
# The centrifugal field :math:`s^2 b` takes the place of gravity in the stiffness of the pendulum.

b, mu, s = a + length, m * M / (m + M), spin
I1, I2, I3 = bus_inertia + mu * b**2 * np.array([0.0, 1.0, 1.0])
left = np.array(  # times the rates of (Omega_1, Omega_2, z, z')
    [
        [I1, 0.0, -mu * b * s, 0.0],
        [0.0, I2, 0.0, -mu * b],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, -mu * b, 0.0, mu],
    ]
)
right = np.array(
    [
        [0.0, s * I2 - I3 * s, 0.0, -s * mu * b],
        [I3 * s - s * I1, 0.0, s**2 * mu * b, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [-mu * s * b, 0.0, -mu * s**2 * b / length, -damping / length**2],
    ]
)
roots = np.linalg.eigvals(np.linalg.solve(left, right))
slowest = roots[np.argmax(roots.real)]
period = 2.0 * np.pi / abs(slowest.imag)
print(
    f"linear theory: nutation period {period:.1f} s, "
    f"damping time {-1.0 / slowest.real:.0f} s"
)

# %%
# In the run the nutation angle is the angle between the axis 3 of the satellite and the angular momentum.

nutation = np.degrees(
    np.arctan2(np.linalg.norm(solution.x[:, :2], axis=1), solution.x[:, 2])
)
tops = (
    np.nonzero((nutation[1:-1] > nutation[:-2]) & (nutation[1:-1] >= nutation[2:]))[0]
    + 1
)
late = tops[solution.t[tops] > 600.0]
damping_time = -1.0 / np.polyfit(solution.t[late], np.log(nutation[late]), 1)[0]
print(f"the run:       damping time {damping_time:.0f} s")
warmer = np.asarray(system.temperatures(solution.x))[-1, 0] - 290.0
print(
    f"the fuel is {warmer:.2e} K warmer, "
    f"and the energy has changed by {np.ptp(solution.energy):.0e} J"
)
assert abs(damping_time * -slowest.real - 1.0) < 0.02

# %%

figure, (top, bottom) = plt.subplots(
    2, 1, figsize=(7.0, 5.0), sharex=True, layout="constrained"
)
top.plot(
    solution.t, nutation, color="#0072B2", linewidth=0.8, label="tree of two bodies"
)
start = np.searchsorted(solution.t[tops], 600.0)
envelope = nutation[tops[start]] * np.exp(
    slowest.real * (solution.t - solution.t[tops[start]])
)
top.plot(solution.t, envelope, color="#D55E00", label="envelope of linear theory")
top.set(ylabel="nutation (degrees)")
top.legend(frameon=False)
bottom.plot(
    solution.t, np.degrees(solution.joints["fuel"]), color="#009E73", linewidth=0.8
)
bottom.set(xlabel="time (s)", ylabel="angle of the fuel (degrees)")
for axes in (top, bottom):
    axes.spines[["top", "right"]].set_visible(False)
plt.show()
