r"""
A body from its attitude alone
==============================

A satellite with internal friction tumbles. A camera sees its attitude, and nothing else. What are its moments of
inertia, and how strong is the friction?

No torque acts, so the momentum in space is constant. In body axes the momentum is then :math:`\mu(t) = R(t)^T \pi`,
with one unknown vector :math:`\pi`. The body turns with the velocity :math:`\xi + \sigma`, its ``transport``, which a
spline through the attitudes gives. Least squares then finds three moments of inertia, a rate and the direction of
:math:`\pi`. Attitudes do not determine the mass, so inertias are relative to :math:`|\pi|`.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, RotationSpline

import liethermo as lt

INERTIA, RATE, START = np.array([1.0, 0.8, 0.55]), 0.15, np.array([0.3, 0.5, 0.9])
method = lt.MetriplecticRungeKutta(8)
body = lt.models.tumbling_body(INERTIA, rate=RATE)
run = lt.integrate(body, START, (0.0, 20.0), 0.1, method)

# %%
# The record has attitudes with errors of 1e-4 radians, and the angular velocities of a spline through them.

random = np.random.default_rng(0)
seen = Rotation.from_matrix(run.attitude) * Rotation.from_rotvec(
    1e-4 * random.standard_normal((len(run.t), 3))
)
spline = RotationSpline(run.t, seen)
turned = seen.as_matrix()
h = 1e-4  # the velocity in body axes, by a difference of the spline
velocity = (spline(run.t[2:-2] - h).inv() * spline(run.t[2:-2] + h)).as_rotvec() / (
    2 * h
)

# %%
# The motion of a body with other numbers. The unknowns are the logarithms of four numbers, and :math:`\pi`, of length
# 1.


def with_numbers(logs):
    return lt.models.tumbling_body(jnp.exp(logs[:3]), rate=jnp.exp(logs[3]))


@jax.jit
def missed(unknown):
    own, pi = with_numbers(unknown[:4]), unknown[4:] / jnp.linalg.norm(unknown[4:])

    def angular_velocity(mu):
        x = jnp.append(mu, 0.0)
        return own.attitude_velocity_from_gradients(
            x, own.energy.gradient(x), own.entropy.gradient(x)
        )

    return (
        jax.vmap(angular_velocity)(jnp.einsum("tij,i->tj", turned[2:-2], pi)) - velocity
    ).ravel()


jacobian = jax.jit(jax.jacfwd(missed))
starts = [np.r_[np.zeros(4), axis] for axis in (*np.eye(3), *-np.eye(3))]
fits = [
    least_squares(lambda u: np.asarray(missed(u)), u, lambda u: np.asarray(jacobian(u)))
    for u in starts
]
best = min(fits, key=lambda fit: fit.cost)
scale = np.linalg.norm(START)
inertia, rate = np.exp(best.x[:3]) * scale, np.exp(best.x[3]) / scale
print("inertias", inertia.round(4), "true", INERTIA)
print("rate    ", rate.round(4), "true", RATE)

# %%
# The fitted body continues to tumble. Its laws hold for all errors of the fit.

found = lt.models.tumbling_body(inertia, rate=rate)
start = run.attitude[0].T @ best.x[4:] / np.linalg.norm(best.x[4:]) * scale
forecast = lt.integrate(found, start, (0.0, 60.0), 0.1, method)
true = lt.integrate(body, START, (0.0, 60.0), 0.1, method)
print(forecast.audit())

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
axes.plot(true.t, np.degrees(lt.bodies.nutation(true)), "k", label="true")
axes.plot(
    forecast.t,
    np.degrees(lt.bodies.nutation(forecast)),
    "--",
    label="from the attitudes of the first third",
)
axes.axvspan(0.0, 20.0, alpha=0.1)
axes.set(xlabel="time", ylabel="nutation (degrees)")
axes.legend()
plt.show()
