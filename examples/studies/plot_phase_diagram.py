"""
Where does a body with a flywheel settle?
=========================================

A wheel inside a body turns about its third axis at a constant momentum. A torque that does no work, as in Morrison's
rigid body (1986), brings the body with its wheel to the state of greatest entropy, ``|mu|^2 / 2``, at its energy. For a
strong wheel that is the spin about the axis of the wheel; for a weak one the momentum tilts towards the axis of
greatest inertia. How far it tilts is an order parameter, and 100,000 runs are its phase diagram.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

ENERGY = 0.5


def gyrostat(point):
    """Return the energy of the body with the moments of inertia (I, 0.9, 1)."""
    inverse = jnp.stack([1.0 / point["inertia"], 1.0 / 0.9, 1.0])
    wheel = jnp.stack([0.0, 0.0, point["wheel"]])
    return lt.LiePoissonSystem(
        mf.so(3),
        energy=lt.Quadratic(inverse, -inverse * wheel),
        entropy=lt.Quadratic(np.ones(3)),
        dissipation=lt.KillingDissipation(1.0),
    )


def start(point):
    """A momentum of the same energy at every point, between all axes."""
    inverse = jnp.stack([1.0 / point["inertia"], 1.0 / 0.9, 1.0])
    direction = jnp.array([0.6, 0.3, 0.2])
    a, b = (
        (inverse * direction**2).sum() / 2,
        inverse[2] * point["wheel"] * direction[2],
    )
    return direction * (b + jnp.sqrt(b * b + 4.0 * a * ENERGY)) / (2.0 * a)


study = lt.Study(
    gyrostat,
    {"wheel": np.linspace(0.0, 2.0, 250), "inertia": np.linspace(1.05, 2.0, 400)},
    x0=start,
    t_span=(0.0, 60.0),
    step=0.2,
    measure={"final": "final"},
    names={"wheel": "momentum of the wheel", "inertia": "greatest moment of inertia"},
)
print(study.run())

# %%
# The tilt is the sine of the angle between the momentum and the axis of the wheel. The spin about that axis has the
# greatest entropy where :math:`w^2 ((I - 1)^{-2} - 1) \ge 2 E`: the dashed line.

results = study.results
final = results.final
tilt = np.sqrt(
    1.0 - final.isel(final_component=2) ** 2 / (final**2).sum("final_component")
)
tilt.attrs["long_name"] = "tilt of the momentum from the axis of the wheel"
lt.plot.study(results.assign(tilt=tilt), "tilt", contours=0)
inertia = np.linspace(1.05, 1.88, 200)
plt.plot(inertia, np.sqrt(2.0 * ENERGY / ((inertia - 1.0) ** -2 - 1.0)), "w--")

# %%
# The laws hold in all runs.

print(study.audit())
plt.show()
