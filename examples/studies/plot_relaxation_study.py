"""
How long does a body take to relax?
===================================

A body with friction inside, left to itself, ends by spinning about its axis of greatest inertia: its angular momentum
stays, and its kinetic energy becomes heat. How long that takes depends on its inertias and on the rate of the friction:
a grid of 50 by 20 runs.
"""

import numpy as np

import liethermo as lt

# %%
# A study takes a function from a point of the grid to a system, the axes, and what is to be kept of each run. The heat
# capacity is large, so that the body hardly gets warmer; nobody asks for its attitude here.


def body(point):
    return lt.models.tumbling_body((1.0, point["ratio"], 0.5), rate=point["rate"], capacity=100.0, attitude=False)


study = lt.Study(
    body,
    {"ratio": np.linspace(0.55, 0.95, 50), "rate": np.geomspace(0.05, 1.0, 20)},
    x0=[0.1, 0.2, 1.0],
    t_span=(0.0, 800.0),
    step=0.2,
    measure={"tau": "relaxation_time"},
    names={"ratio": "middle moment of inertia, of the greatest", "rate": "rate of friction"},
)
print(study.run())

# %%
# The results have the axes as coordinates; a picture of them has contours of equal times.

lt.plot.study(study.results)

# %%
# The larger the rate the shorter the time, nearly in inverse proportion: weak friction moves the energy as a function
# of the rate times the time alone. The body begins near its axis of least inertia, and stays there the longer the less
# the middle moment differs from the least. The spots in the picture are bodies that come near their middle axis, where
# the motion is slow, and linger.

tau = study.results.tau
print(f"tau * rate, for the least and the largest rate: {(tau * tau.rate)[25, [0, -1]].values.round(2)}")
print(f"and for the least and the largest middle moment: {(tau * tau.rate)[[0, -1], 0].values.round(2)}")
print(study.audit())
