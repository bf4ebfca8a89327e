r"""
The inertias of a thrown book from a gyroscope
==============================================

A book that is thrown with a spin about its middle axis turns over in flight: the Dzhanibekov effect, or tennis racket
theorem. A phone between its pages records the angular velocity. From this record alone the fit below finds the ratios
of the three moments of inertia, with their standard errors. A free body has the same motion with all inertias
multiplied by a number, so no gyroscope determines more than the ratios.

The state of the system is the angular momentum :math:`\mu`, but the sensor shows :math:`\omega_i = \mu_i / I_i`. So the
observation depends on the parameters of the fit.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt

# %%
# The file comes from another program: SciPy integrates Euler's equations for the angular velocity of a book of
# 24 cm × 17 cm × 3 cm. The sensor writes degrees per second, at irregular times in milliseconds, with noise of 1 deg/s.

sides = np.array([0.24, 0.17, 0.03])
a, b, c = (sides**2).sum() - sides**2  # about the long, the middle and the short side
random = np.random.default_rng(7)
t = np.sort(random.uniform(0.0, 2.0, 200))


def euler(t, omega):
    x, y, z = omega
    return [(b - c) / a * y * z, (c - a) / b * z * x, (a - b) / c * x * y]


omega = solve_ivp(
    euler, (0.0, 2.0), [0.05, 11.0, 0.1], "DOP853", t, rtol=1e-11, atol=1e-12
).y.T
readings = np.degrees(omega) + random.standard_normal(omega.shape)
header = "time [ms],gx [deg/s],gy [deg/s],gz [deg/s]"
np.savetxt(
    "throw.csv",
    np.column_stack([1e3 * t, readings]),
    fmt="%.3f",
    delimiter=",",
    header=header,
    comments="",
)

# %%
# The fit needs a function that builds the body, one that returns what the sensor shows, and a guess of the two ratios.
# The names in the observation are those of the columns. The units in their labels are converted.


def body(p):
    return lt.models.free_rigid_body((p["I1/I2"], 1.0, p["I3/I2"]))


def gyroscope(x, p):
    return {"gx": x[0] / p["I1/I2"], "gy": x[1], "gz": x[2] / p["I3/I2"]}


guess = {"I1/I2": 0.7, "I3/I2": 1.2}
found = lt.learn.fit(
    body, "throw.csv", parameters=guess, positive=True, observe=gyroscope
)
print(found.training)

# %%
# The true ratios lie in the intervals of 95 %.

interval = found.training.confidence_interval(0.95)
for name, low, high, true in zip(
    found.training.names, *interval, (a / b, c / b), strict=True
):
    print(f"{name}: {low:.4f} to {high:.4f}, true {true:.4f}")

# %%

table = lt.learn.read_data("throw.csv")[0]
x0 = found.training.initial_states[0]
times = np.linspace(table.t[0], table.t[-1], 400)
fitted = np.asarray(
    lt.flow(
        found, x0, (times[0], times[-1]), 0.005, lt.MetriplecticGauss(2), save_at=times
    )
)
inertia = 1.0 / np.asarray(found.energy.A)
figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
for i, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
    axes.plot(table.t, np.degrees(table.x[:, i]), ".", color=colour, markersize=4)
    axes.plot(
        times,
        np.degrees(fitted[:, i] / inertia[i]),
        color=colour,
        label=rf"$\omega_{i + 1}$",
    )
axes.set(
    xlabel="time (s)",
    ylabel="angular velocity (deg/s)",
    title="Readings (dots) and the fitted motion (lines)",
)
axes.legend(ncol=3, loc="upper right")
plt.show()

# %%
# A real throw
# ------------
#
# Bubbar and Zhu (`2025 <https://doi.org/10.14288/1.0448943>`_) threw a tennis racket with a phone on it, and measured
# its moments of inertia with pendulums: :math:`I_1 = 20.7 \pm 3.8`, :math:`I_2 = 18.8 \pm 5.7` and
# :math:`I_3 = 1.391 \pm 0.076\ \mathrm{g\,m^2}`, so :math:`I_1/I_3 = 14.9 \pm 2.8` and
# :math:`I_2/I_3 = 13.5 \pm 4.2`. Four of their throws, read from the file of the phone and fitted by these lines, give
# :math:`14.7 \pm 0.4` and :math:`13.7 \pm 0.4`.
