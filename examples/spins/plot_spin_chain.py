"""
How does a chain of spins order itself?
=======================================

The energy of a ring of spins favours parallel neighbours: ``H = -sum s_i . s_(i+1)`` and a weak easy axis. Damping
turns the energy of the disordered spins into heat of a bath with the entropy S. The state space is a power of the
sphere times a line, and nothing else changes: the copies of the sphere run as one batch.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

count = 40
spins = mf.Sphere(2) ** count
space = spins * mf.Euclidean(1)


def chain_energy(x):
    s = x[: 3 * count].reshape(count, 3)
    return -jnp.sum(s * jnp.roll(s, 1, axis=0)) - 0.1 * jnp.sum(s[:, 2] ** 2)


def turn(x, alpha):
    """Apply the Poisson structure: ``s_i x alpha_i``, and zero for the bath."""
    s, a = (y[:-1].reshape(count, 3) for y in (x, alpha))
    return jnp.append(jnp.cross(s, a).ravel(), 0.0)


capacity = 20.0
system = lt.MetriplecticSystem(
    mf.PoissonMap(turn, space.size),
    lambda x: chain_energy(x) + capacity * jnp.exp(x[-1] / capacity),
    lambda x: x[-1],
    lt.ProjectedMetric(rate=0.15),
    space=space,
    validate=False,  # the matrices that the check looks at are large here
)

# %%

start = space.join(spins.random(3), [0.0])
solution = lt.integrate(system, start, (0.0, 60.0), 0.05, save_every=4, engine="array")
print(solution.audit())
assert np.asarray(spins.belongs(solution.x[:, :-1].reshape(-1, count, 3))).all()

# %%
# Domains form, up and down the easy axis, and their walls move until they meet.

s = solution.x[:, :-1].reshape(-1, count, 3)
figure, (top, bottom) = plt.subplots(
    2, 1, figsize=(8, 6), height_ratios=(2, 1), sharex=True, layout="constrained"
)
image = top.imshow(
    s[..., 2].T,
    extent=(0, solution.t[-1], 0, count),
    aspect="auto",
    origin="lower",
    cmap="RdBu",
    vmin=-1,
    vmax=1,
)
figure.colorbar(image, ax=top, label="$s_3$")
top.set(ylabel="spin", title="A ring of spins, damped")
heat = capacity * (np.exp(solution.entropy / capacity) - 1)
bottom.plot(
    solution.t, solution.energy - capacity - heat, color="#0072B2", label="of the chain"
)
bottom.plot(solution.t, heat, color="#D55E00", label="heat in the bath")
bottom.set(xlabel="time", ylabel="energy")
bottom.legend(frameon=False)
bottom.spines[["top", "right"]].set_visible(False)
plt.show()
