r"""
Why may a slender satellite spin about its long axis?
=====================================================

A body with friction ends in a spin about its axis of greatest inertia. Some communication satellites are longer than
wide, but they spin about the long axis: their platform is despun, and a damper on it dissipates more than the friction
in the rotor. Likins gave the condition in 1967 (J. Spacecraft and Rockets 4, 1638): the nutation decays if

.. math:: \frac{P_p}{\lambda_p} + \frac{P_r}{\lambda_r} > 0,

where P are the powers that platform and rotor dissipate, and :math:`\lambda = L / I_t - \omega` is the frequency of the
nutation in the part, which turns at the rate :math:`\omega`. In a rotor that is faster than the nutation
:math:`\lambda_r` is negative, and friction there feeds it.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

transverse, axial, rotor = 1.0, 0.6, 0.3  # kg m^2, of the whole and of the rotor
axis = (0.0, 0.0, 1.0)


def satellite(platform_rate, rotor_rate, torque=None):
    """Return the satellite; friction of a rate r damps the nutation by r L lambda."""
    return lt.models.dual_spin(
        (transverse, transverse, axial),
        axis,
        rotor,
        platform_rate=platform_rate,
        rotor_rate=rotor_rate,
        torque=torque,
    )


# %%
# The despin
# ----------
#
# Platform and rotor leave the launcher as one spinning body. A motor speeds the rotor up until the platform stands
# still. Left as one body, the satellite starts to tumble in the same time.

rate, spin, despin_time = 0.05, 1.0, 60.0  # s / kg m^2, rad/s, s
momentum = axial * spin
acceleration = (
    momentum - rotor * spin
) / despin_time  # N m, which leaves all momentum in the rotor
motor = lt.torques.PiecewiseConstant(
    [0.0, despin_time], [(0.0, 0.0, 0.0, acceleration)]
)
x0 = [0.05 * momentum, 0.0, momentum, rotor * spin]
runs = {
    "despun": lt.integrate(satellite(rate, 0.0, motor), x0, (0.0, 400.0), 0.1),
    "spun as one body": lt.integrate(satellite(rate, 0.0), x0, (0.0, 400.0), 0.1),
}
figure, axes = plt.subplots(figsize=(7.0, 3.6))
for name, run in runs.items():
    axes.plot(run.t, np.degrees(lt.bodies.nutation(run, axis)), label=name)
axes.axvspan(0.0, despin_time, color="0.9", label="motor on")
axes.set(xlabel="time (s)", ylabel="nutation (degrees)")
axes.legend()
figure.tight_layout()

final = {
    name: np.degrees(lt.bodies.nutation(run, axis)[-1]) for name, run in runs.items()
}
print({name: f"{angle:.2f} degrees" for name, angle in final.items()})
assert final["despun"] < 1.5
assert final["spun as one body"] > 5.0
assert all(run.audit().passed for run in runs.values())

# %%
# Likins' condition
# -----------------
#
# With the platform at rest, its friction at the rate a and that of the rotor at the rate b change the nutation at the
# rate :math:`-L (a \lambda_p + b \lambda_r)`. The runs reproduce this rate to a thousandth, and the nutation grows
# where the condition predicts it.

shares, measured = np.linspace(0.0, 2.0, 9), []
rotor_speed = momentum / rotor  # rad/s, with the platform at rest
for share in shares:
    run = lt.integrate(
        satellite(rate, share * rate),
        [1e-3 * momentum, 0.0, momentum, momentum],
        (0.0, 40.0),
        0.05,
    )
    angle = lt.bodies.nutation(run, axis)
    measured.append(np.log(angle[-1] / angle[0]) / run.t[-1])
lambda_p, lambda_r = momentum / transverse, momentum / transverse - rotor_speed
expected = -momentum * rate * (lambda_p + shares * lambda_r)
np.testing.assert_allclose(measured, expected, atol=1e-3 * np.abs(expected).max())

figure, axes = plt.subplots(figsize=(7.0, 3.6))
axes.plot(shares, expected, color="0.6", label="energy sink [Likins 1967]")
axes.plot(shares, measured, "o", label="runs")
axes.axhline(0.0, color="black", linewidth=0.8)
axes.set(
    xlabel="friction of the rotor / friction of the platform",
    ylabel="growth of the nutation (1/s)",
)
axes.legend()
figure.tight_layout()

# %%
# What is not reproduced
# ----------------------
#
# The condition and its rates are Likins' own result, but the satellite is fictitious: damping times in flight
# depend on the dissipation in tanks, bearings and dampers, and these powers are not published with the inertias. A
# damper has a frequency of its own, too: friction that follows the motion at once, as here, has none.
