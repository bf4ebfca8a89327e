"""
What does a relaxing body look like from outside?
=================================================

The momentum of a body is given in body axes. If the system has a group, the integrator returns the attitude too: the
rotation g(t) from the body to space. A box that spins about its middle axis tumbles. Nothing acts on it from outside,
so its angular momentum in space, ``g mu``, is constant. Internal friction turns its kinetic energy into heat, until the
box spins about its axis of greatest inertia.
"""

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import liethermo as lt
import manifolds as mf

edges = np.array([2.0, 1.2, 0.4])  # of the box, along the axes of the body
inertia = (np.sum(edges**2) - edges**2) / 4
system = lt.models.tumbling_body(inertia, rate=0.15)
solution = lt.integrate(system, [0.02, 1.0, 0.02], (0.0, 60.0), 0.05)
print(solution.audit())
print(
    "largest distance from the rotations:"
    f" {float(mf.SO(3).defect(solution.attitude).max()):.0e}"
)

# %%
# The momentum in space is constant, and the heat grows by the loss of kinetic energy.

momentum = solution.x[:, :3]
in_space = np.einsum("tij,tj->ti", solution.attitude, momentum)
kinetic = 0.5 * np.sum(momentum**2 / inertia, axis=1)
print(f"the momentum in space changes by {np.abs(in_space - in_space[0]).max():.0e}")
print(
    f"kinetic energy from {kinetic[0]:.4f} to {kinetic[-1]:.4f}; the least that it can"
    f" be: {0.5 / inertia.max():.4f}"
)
print(
    "angle from the shortest edge:"
    f" {np.degrees(lt.bodies.nutation(solution)[[0, -1]]).round(1)} degrees"
)

# %%
# The figure shows the box from outside, with its angular momentum. The momentum is fixed, and the box turns about it.
# At first the middle edge is along the momentum, in the end the shortest edge. The initial state decides which end
# of that edge is ahead.

corners = (
    np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * edges / 2
)
faces = [
    [0, 1, 3, 2],
    [4, 5, 7, 6],
    [0, 1, 5, 4],
    [2, 3, 7, 6],
    [0, 2, 6, 4],
    [1, 3, 7, 5],
]
colors = ["#0072B2", "#0072B2", "#E69F00", "#E69F00", "#009E73", "#009E73"]

figure = plt.figure(figsize=(10, 6), layout="constrained")
times = np.concatenate([np.linspace(4.0, 10.0, 4), np.linspace(54.0, 60.0, 4)])
for place, moment in enumerate(times):
    i = int(np.argmin(np.abs(solution.t - moment)))
    ax = figure.add_subplot(3, 4, place + 1, projection="3d", computed_zorder=False)
    box = corners @ solution.attitude[i].T
    ax.add_collection3d(
        Poly3DCollection(box[faces], facecolors=colors, edgecolors="white", alpha=0.95)
    )
    ax.quiver(
        0,
        0,
        0,
        *(1.5 * in_space[i] / np.linalg.norm(in_space[i])),
        color="#D55E00",
        lw=2,
        zorder=9,
    )
    limits = (-1.1, 1.1)
    ax.set(xlim=limits, ylim=limits, zlim=limits, title=f"t = {solution.t[i]:.0f}")
    ax.set_box_aspect((1, 1, 1), zoom=0.85)
    ax.view_init(25, 25)
    ax.set_axis_off()

bottom = figure.add_subplot(3, 1, 3)
axes = ("longest", "#0072B2"), ("middle", "#E69F00"), ("shortest", "#009E73")
for component, (name, color) in zip(momentum.T, axes, strict=True):
    bottom.plot(solution.t, component, color=color, label=f"along the {name} edge")
bottom.set(xlabel="time", ylabel="momentum in the body")
bottom.legend(frameon=False, ncols=3)
bottom.spines[["top", "right"]].set_visible(False)
plt.show()
