"""
To which of three equilibria does a body go?
============================================

The energy of a body has three minima on the sphere of its momentum. A double bracket lowers the energy and conserves
the size of the momentum. Most motions first go round the sphere, so the basins of the three equilibria are wound around
each other.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

AXES = np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])


def energy(mu):
    """Three wells on the sphere, around the equator."""
    return -jnp.exp(4.0 * (AXES @ mu - 1.0)).sum() - 0.1 * mu[2]


body = lt.LiePoissonSystem(mf.so(3), energy, dissipation=lt.DoubleBracket(rate=0.06))

# %%
# The axes of this study are those of the initial states.


def start(point):
    latitude, longitude = (
        jnp.radians(point["latitude"]),
        jnp.radians(point["longitude"]),
    )
    equatorial = jnp.cos(latitude)
    return jnp.stack(
        [
            equatorial * jnp.cos(longitude),
            equatorial * jnp.sin(longitude),
            jnp.sin(latitude),
        ]
    )


study = lt.Study(
    lambda point: body,
    {
        "latitude": np.linspace(-88.5, 88.5, 60),
        "longitude": np.linspace(-178.5, 178.5, 120),
    },
    x0=start,
    t_span=(0.0, 150.0),
    step=0.5,
    measure={"final": "final"},
    units={"latitude": "degrees", "longitude": "degrees"},
)
print(study.run())

# %%
# The colour is the number of the nearest equilibrium at the end of a run.

results = study.results
nearest = np.argmax(results.final.values @ AXES.T, axis=-1)
basin = results.status.copy(data=nearest.astype(float))
basin.attrs = {"long_name": "number of the equilibrium"}
lt.plot.study(results.assign(basin=basin), "basin")
plt.gca().set_title("Basins of attraction on the sphere of momenta")
plt.show()
