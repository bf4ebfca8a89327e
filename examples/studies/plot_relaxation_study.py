"""
How long does a body take to relax?
===================================

A body with internal friction and without torque ends in a spin about its axis of greatest inertia. Its angular momentum
is constant, and kinetic energy becomes heat. The duration depends on its inertias and on the rate of friction. The
study is a grid of 50 by 20 runs.
"""

import numpy as np

import liethermo as lt

# %%
# A study takes a function from a point of the grid to a system, the axes, and the measures of each run. The heat
# capacity is large, so the body hardly gets warmer. The attitude is left out.


def body(point):
    return lt.models.tumbling_body(
        (1.0, point["ratio"], 0.5), rate=point["rate"], capacity=100.0, attitude=False
    )


study = lt.Study(
    body,
    {"ratio": np.linspace(0.55, 0.95, 50), "rate": np.geomspace(0.05, 1.0, 20)},
    x0=[0.1, 0.2, 1.0],
    t_span=(0.0, 800.0),
    step=0.2,
    measure={"tau": "relaxation_time"},
    names={
        "ratio": "middle moment of inertia, of the greatest",
        "rate": "rate of friction",
    },
)
print(study.run())

# %%
# The results have the axes as coordinates; a picture of them has contours of equal times.

lt.plot.study(study.results)

# %%
# The time is nearly inversely proportional to the rate: with weak friction the energy is a function of rate times time
# alone. The body begins near its axis of least inertia. It stays there longer if the middle moment is close to the
# least. The spots in the picture are bodies that come near their middle axis, where the motion is slow.

tau = study.results.tau
print(
    "tau * rate, for the least and the largest rate:"
    f" {(tau * tau.rate)[25, [0, -1]].values.round(2)}"
)
print(
    "and for the least and the largest middle moment:"
    f" {(tau * tau.rate)[[0, -1], 0].values.round(2)}"
)
print(study.audit())
