"""
Inertias and a rate from a noisy record
=======================================

Derivatives of a trajectory by its parameters make fits possible. Morrison's rigid body relaxes, and its momentum is
recorded with noise of two per cent. Least squares finds the moments of inertia and the rate of dissipation again, with
the Jacobian from ``lt.flow``: it differentiates the discrete flow itself, by the implicit function theorem.

The equations contain the inverses of the inertias and the momentum, so the record determines all three inertias.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares

import liethermo as lt

TRUE = np.array([10.0, 5.0, 1.0, 0.3])  # three moments of inertia and the rate
X0, SPAN, STEP, EVERY = jnp.array([0.3, 1.0, 0.4]), (0.0, 40.0), 0.1, 4


@jax.jit
def momenta(parameters):
    """The momenta along the run, shape (times, 3)."""
    body = lt.models.rigid_body(parameters[:3], parameters[3])
    return lt.flow(body, X0, SPAN, STEP, save_every=EVERY)


# %%
# The record is the true motion with noise.

noise = 0.02
record = momenta(TRUE) + noise * np.random.default_rng(0).standard_normal(
    momenta(TRUE).shape
)

# %%
# The fit, from a guess that is wrong by up to a factor of two. Logarithms keep the parameters positive.

jacobian = jax.jit(jax.jacfwd(lambda logarithms: momenta(jnp.exp(logarithms)).ravel()))
fit = least_squares(
    lambda logarithms: np.asarray(momenta(jnp.exp(logarithms)) - record).ravel(),
    np.log([7.0, 4.0, 1.3, 0.6]),
    jac=lambda logarithms: np.asarray(jacobian(logarithms)),
)
found = np.exp(fit.x)
deviation = found * noise * np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
for name, value, error, truth in zip(
    ("I1", "I2", "I3", "rate"), found, deviation, TRUE, strict=True
):
    print(f"{name:>4} = {value:7.4f} ± {error:.4f}   (true {truth:g})")

# %%
times = np.arange(len(record)) * STEP * EVERY
figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
for i, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
    axes.plot(times, record[:, i], ".", color=colour, markersize=3, alpha=0.6)
    axes.plot(times, momenta(found)[:, i], color=colour, label=f"$\\Pi_{i + 1}$")
axes.set(
    xlabel="time", ylabel="momentum", title="Record (dots) and fitted motion (lines)"
)
axes.legend(ncol=3, loc="lower right")
plt.show()
