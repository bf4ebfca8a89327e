"""
Where does a covariance of given energy have most entropy?
==========================================================

A Gaussian cloud with the covariance P, a positive definite matrix, has the entropy log det P / 2, and in a harmonic
trap with the stiffness A the energy tr(A P) / 2. At a given energy the entropy is largest if P is a multiple of the
inverse of A. This is equipartition. The gradient flow of the entropy at constant energy, in the affine-invariant metric
of the positive definite matrices, leads there. This flow is a metriplectic system without conservative motion.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

stiffness = np.diag([1.0, 2.0, 4.0])


def entropy(P):
    return 0.5 * jnp.log(jnp.dot(P[0], jnp.cross(P[1], P[2])))


system = lt.MetriplecticSystem(
    poisson=None,
    energy=lambda P: 0.5 * jnp.sum(stiffness * P),
    entropy=entropy,
    dissipation=lt.ProjectedMetric(normalized=True, rate=2.0),
    space=mf.SPD(3),
)

turn = np.asarray(mf.SO(3).exp(np.array([0.5, 0.8, -0.3])))
start = turn @ np.diag([0.02, 0.1, 1.2]) @ turn.T
solution = lt.integrate(system, start, (0.0, 16.0), 0.1)
print(solution.audit())

# %%
# The run reaches the known limit:

P = np.asarray(system.points(solution.x))
limit = np.linalg.inv(stiffness) * 2 * solution.energy[0] / 3
print(f"distance to equipartition: {float(system.space.distance(P[-1], limit)):.1e}")

# %%
# The figure shows the cloud as an ellipsoid whose axes are the standard deviations.

figure = plt.figure(figsize=(10, 5.5), layout="constrained")
u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, np.pi, 30))
ball = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)])
for place, moment in enumerate((0.0, 1.0, 3.0, 16.0)):
    i = int(np.argmin(np.abs(solution.t - moment)))
    ax = figure.add_subplot(2, 4, place + 1, projection="3d")
    surface = np.einsum("ij,juv->iuv", np.linalg.cholesky(P[i]), ball)
    ax.plot_surface(*surface, color="#0072B2", rstride=1, cstride=1)
    limits = (-0.9, 0.9)
    ax.set(xlim=limits, ylim=limits, zlim=limits, title=f"t = {solution.t[i]:g}")
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()

left, right = figure.add_subplot(2, 2, 3), figure.add_subplot(2, 2, 4)
left.plot(solution.t, 0.5 * np.einsum("ij,tji->ti", stiffness, P * np.eye(3)))
left.set(xlabel="time", ylabel="energy of each coordinate", title="Equipartition")
right.plot(solution.t, solution.entropy, color="#D55E00")
right.axhline(float(entropy(limit)), color="0.5", ls="--", lw=1)
right.set(xlabel="time", ylabel="entropy")
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
