"""
Where does a magnetic field on a sphere come to rest?
=====================================================

A conducting fluid carries its magnetic field along, and the field pulls at the fluid. On the sphere both are functions:
the vorticity, and the potential theta, whose level lines are the lines of the field. Without friction, energy, cross
helicity and every integral of a function of theta are constant. With friction the energy falls. The field lines move
but do not reconnect, so the integrals of theta are still constant. The motion tends to a magnetic equilibrium, in which
the current is a function of theta.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

N = 10
sphere = lt.models.QuantisedSphere(N)
start = sphere.magnetic_state(
    sphere.random(3, (1, 4), 8.0), sphere.random(4, (1, 4), 1.0)
)
ideal = lt.integrate(
    lt.models.magnetic_fluid(N),
    start,
    (0.0, 2.0),
    0.01,
    lt.MetriplecticRungeKutta(4),
    save_every=20,
    engine="array",
)
print(ideal.audit())

# %%
# The double bracket adds friction to this flow.

damped = lt.integrate(
    lt.models.magnetic_fluid(N, rate=0.004),
    start,
    (0.0, 12.0),
    0.01,
    lt.MetriplecticRungeKutta(4),
    save_every=60,
    engine="array",
)
print(f"energy {damped.energy[0]:.3g} to {damped.energy[-1]:.3g}")
for name, series in damped.casimirs.items():
    print(f"{name}: changed by {np.ptp(series) / np.abs(series).max():.0e}")

# %%
# The potential at the start, during the run and at the end.

figure = plt.figure(figsize=(10, 3), layout="constrained")
for place, i in enumerate((0, 4, len(damped.t) - 1), start=1):
    ax = figure.add_subplot(1, 3, place, projection="mollweide")
    lt.plot.sphere_field(
        sphere.on_grid(sphere.magnetic_fields(damped.x[i])[1]),
        ax=ax,
        title=f"t = {damped.t[i]:g}",
    )

# %%
# Current against potential at points of the sphere. In an equilibrium they lie on a curve. The run approaches it.

figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for ax, i in zip(axes, (0, -1), strict=False):
    theta = sphere.magnetic_fields(damped.x[i])[1]
    values = [
        sphere.on_grid(f, (40, 80)).ravel() for f in (theta, sphere.laplacian(theta))
    ]
    ax.plot(*values, ".", ms=1)
    ax.set(xlabel="potential", ylabel="current", title=f"t = {damped.t[i]:g}")
for run, name in ((ideal, "ideal"), (damped, "with friction")):
    axes[2].plot(run.t, run.energy / run.energy[0], label=name)
axes[2].set(xlabel="time", ylabel="energy / initial energy", title="flow and field")
axes[2].legend(frameon=False)
plt.show()
