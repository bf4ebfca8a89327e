"""
How does a spin come to rest on its sphere?
===========================================

A spin is a unit vector s, and ``s' = s x grad H`` moves it along the lines of constant energy of the sphere. With
damping it moves to the least energy. In this example the lost energy heats a bath of temperature T = exp(S), and spin
and bath are an isolated system: the state is a point of S^2 x R, the energy of the whole is constant, and the entropy S
grows.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

space = mf.Sphere(2) * mf.Euclidean(1)
easy_axis, field = 1.5, jnp.array([0.6, 0.0, 0.2])


def spin_energy(s):
    """An easy axis along e3 with a term of fourth order, in a tilted field."""
    return -easy_axis * (s[..., 2] ** 2 / 2 + s[..., 2] ** 4 / 4) - s[..., :3] @ field


system = lt.MetriplecticSystem(
    poisson=mf.LiePoisson(
        mf.direct_sum(mf.so(3), mf.abelian(1))
    ),  # the bath has no motion of its own
    energy=lambda x: spin_energy(x) + jnp.exp(x[3]),
    entropy=lambda x: x[3],
    dissipation=lt.ProjectedMetric(rate=0.03),  # of the metric of the space
    space=space,
)
print(system.check())

# %%
# The scheme runs in the chart ``v -> exp_s(v)`` of the sphere, around another point at every step. Points stay on the
# sphere and the laws hold to rounding; nothing is projected.

start = np.array([np.sin(1.45), 0.0, np.cos(1.45), 0.0])
solution = lt.integrate(system, start, (0.0, 60.0), 0.1, lt.MetriplecticGauss(2))
print(solution.audit())
print(
    "off the sphere by at most"
    f" {np.abs(np.linalg.norm(solution.x[:, :3], axis=1) - 1).max():.0e}"
)

# %%

figure = plt.figure(figsize=(9, 4), layout="constrained")
ax = figure.add_subplot(1, 2, 1, projection="3d", computed_zorder=False)
ax.view_init(35, -50)
u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 120), np.linspace(0, np.pi, 60))
sphere = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1)
energies = np.asarray(spin_energy(sphere))
shade = plt.get_cmap("Blues_r")(
    0.2 + 0.8 * (energies - energies.min()) / np.ptp(energies)
)
ax.plot_surface(
    *np.moveaxis(sphere, -1, 0), facecolors=shade, rstride=1, cstride=1, shade=False
)
elevation, azimuth = np.radians([35, -50])
eye = np.array(
    [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
)
spins = np.asarray(solution.x[:, :3])
seen = np.where(
    (spins @ eye > 0)[:, None], spins, np.nan
)  # not what is behind the sphere
ax.plot(*seen.T, color="#D55E00", lw=1.0)
ax.scatter(*spins[0], facecolor="white", edgecolor="#D55E00", s=30, label="start")
ax.scatter(*spins[-1], color="#D55E00", s=30, depthshade=False, label="at rest")
directions = {"easy axis": np.array([0.0, 0.0, 1.0]), "field": np.asarray(field)}
for name, direction in directions.items():
    direction = direction / np.linalg.norm(direction)
    ax.quiver(*direction, *(0.45 * direction), color="k", lw=1.2)
    ax.text(*(1.55 * direction), name, ha="center")
ax.legend(frameon=False, loc="lower left")
ax.set_box_aspect((1, 1, 1), zoom=1.2)
ax.set(title="Path of the spin; dark: low energy")
ax.set_axis_off()

right = figure.add_subplot(1, 2, 2)
spin, bath = np.asarray(spin_energy(solution.x)), np.exp(solution.x[:, 3])
for series, name, color in (
    (spin, "spin", "#0072B2"),
    (bath, "bath", "#D55E00"),
    (spin + bath, "sum", "0.3"),
):
    right.plot(solution.t, series, color=color, label=name)
right.set(
    xlabel="time",
    ylabel="energy",
    title="The bath gains the energy that the spin loses",
)
right.legend(frameon=False, loc="upper right", bbox_to_anchor=(1.0, 0.9))
right.spines[["top", "right"]].set_visible(False)
plt.show()
