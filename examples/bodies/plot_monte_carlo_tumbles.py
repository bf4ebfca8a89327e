r"""
When does a spinning satellite fall into a flat spin?
=====================================================

A long satellite spins about its axis of least inertia, as Explorer 1 did [Bollay 1967]. Internal friction turns it over
into a flat spin. The moments of inertia, the error of pointing at the separation and the spin rate are known only
roughly, so the time of the fall is a distribution. The example runs 2,000 satellites and compares each with a closed
form.

The friction is not that of a real satellite: no measurement exists for this shape. With weaker friction all times
are longer by one factor, because the angle depends on the product of rate and time. :doc:`/tutorials/asteroid_wobble`
compares a run with what was seen of Explorer 1.
"""

import time

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

n = 2_000
rng = np.random.default_rng(1958)
mass, length, radius = 14.0, 2.03, 0.08  # kg, m
nominal = mass * np.array(
    [length**2 / 12.0 + radius**2 / 4.0] * 2 + [radius**2 / 2.0]
)  # kg m^2, a cylinder
moments = nominal * (
    1.0 + 0.03 * rng.standard_normal((n, 2))[:, [0, 0, 1]]
)  # 3 % each, round about the long axis
spin = np.pi * (1.0 + 0.02 * rng.standard_normal(n))  # rad/s: a turn in two seconds
cone = np.radians(
    np.abs(rng.normal(0.0, 1.0, n)) + 0.1
)  # rad, between the long axis and the angular momentum
rate = 0.04  # s / (kg m^2)

L = moments[:, 2] * spin / np.cos(cone)
momenta = L[:, None] * np.stack([np.sin(cone), np.zeros(n), np.cos(cone)], axis=1)


def satellite(p):
    return lt.models.tumbling_body(
        p["inertia"],
        rate=rate,
        capacity=mass * 500.0,
        temperature=300.0,
        attitude=False,
    )


def sideways_excess(x):
    """Return a function that is zero where momentum and long axis are at 45 degrees."""
    return x[0] ** 2 + x[1] ** 2 - x[2] ** 2


begin = time.perf_counter()
flights = lt.ensemble(
    satellite,
    momenta,
    (0.0, 1000.0),
    0.1,
    lt.MetriplecticRungeKutta(8),
    parameters={"inertia": moments},
    until=sideways_excess,
)
print(flights.audit())
print(f"{n} flights in {time.perf_counter() - begin:.0f} s")

# %%
# The angle from the long axis obeys :math:`\tan\theta(t) = \tan\theta_0 \exp(\lambda\, (1/I_3 - 1/I_1)\, L^2 t)`, with
# the rate :math:`\lambda` of the friction. So each satellite is at 45 degrees at a known time.

exact = -np.log(np.tan(cone)) / (
    rate * (1.0 / moments[:, 2] - 1.0 / moments[:, 0]) * L**2
)
print(
    "largest relative error of the 2,000 times: "
    f"{np.abs(flights.event_time / exact - 1.0).max():.0e}"
)
assert np.abs(flights.event_time / exact - 1.0).max() < 1e-5

minutes = flights.event_time / 60.0
low, median, high = np.percentile(minutes, [5.0, 50.0, 95.0])
print(
    f"turned over after {median:.1f} minutes, "
    f"from {low:.1f} to {high:.1f} in 90 of 100 cases"
)

# %%

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
left.hist(minutes, bins=60, color="#0072B2")
left.set(xlabel="time to 45 degrees (minutes)", ylabel="number of satellites")
right.scatter(np.degrees(cone), minutes, s=3.0, color="#D55E00")
right.set(
    xlabel="angle at the separation (degrees)", ylabel="time to 45 degrees (minutes)"
)
for axes in (left, right):
    axes.spines[["top", "right"]].set_visible(False)
plt.show()
