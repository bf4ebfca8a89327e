r"""
Which systems show the good long-time behaviour?
================================================

A variational scheme of a mechanical system without friction conserves an energy near the true one for a very long time.
Its error oscillates and does not grow. Gay-Balmaz and Yoshimura observe the same in two systems with friction, and ask
for which systems it holds. This study looks at schemes 2 and 3 over friction, stiffness and step, in these systems:

- a spring *beside* a gas: friction warms the gas, and the gas does nothing to the motion;
- a spring *against* a gas: the pressure of the gas moves the mass, and the heat changes the pressure;
- either *driven* by a periodic force, so that it never comes to rest.

The measure is the error of the energy of system and surroundings, the mean of the last 200 steps less the first value,
so that oscillations cancel, relative to the mechanical energy :math:`\tfrac12 k x_0^2` at the start.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

STEPS, WINDOW, CAPACITY, START = 32_768, 200, 10.0, 0.3  # the gas has U = C exp(S / C)


def spring(p, pressure=0.0, force=0.0):
    """A mass on a spring, in units of time in which each step has the size 1.

    The step is in parts of a radian of the spring, the friction in parts of the
    critical one, and the force, of half the frequency, in parts of the first pull.
    """
    h, k, C = p["step"] / jnp.sqrt(p["stiffness"]), p["stiffness"], CAPACITY

    def lagrangian(q, v, S):
        gas = C * jnp.exp(S / C) * (1.0 + q[0]) ** (-pressure)
        return 0.5 * v @ v / h**2 - 0.5 * k * q @ q - gas

    rate = 2.0 * p["friction"] * jnp.sqrt(k) / h
    drive = (
        (lambda q, v, S, t: force * k * START * jnp.cos(0.5 * p["step"] * t)[None])
        if force
        else None
    )
    return lt.SimpleClosedSystem(
        lagrangian,
        3,
        friction=lambda q, v, S: -rate * v,
        external=drive,
        validate=False,
    )


KINDS = {
    "beside": lambda p: spring(p),
    "against": lambda p: spring(p, pressure=2.0 / 3.0),
    "beside, driven": lambda p: spring(p, force=0.1),
    "against, driven": lambda p: spring(p, pressure=2.0 / 3.0, force=0.1),
}
SCHEMES = {
    "scheme 2": lt.VariationalIntegrator.midpoint(),
    "scheme 3": lt.VariationalIntegrator.symmetrised(),
}
AXES = {
    "step": [0.05, 0.1, 0.2],  # times the frequency of the spring
    "stiffness": [3.0, 30.0],  # the first energy is 0.014 and 0.14 of that of the gas
    "friction": [0.0, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 3.0],
}

# Means over windows that end after 1/16, 1/4 and all of the steps: what grows, grows between them.
ends = STEPS // np.array([16, 4, 1])
times = np.concatenate([[0.0], *(np.arange(end - WINDOW + 1, end + 1) for end in ends)])
found = {}
for kind, build in KINDS.items():
    for name, scheme in SCHEMES.items():
        study = lt.Study(
            build,
            AXES,
            x0=[START, 0.0, 0.0],
            t_span=(0.0, float(STEPS)),
            step=1.0,
            method=scheme,
            measure={
                "energy": lt.At(times, "energy"),
                "rise": "least_entropy_increment",
                "made": "entropy_change",
            },
        )
        print(kind, name, study.run())
        found[kind, name] = study.results

# %%
# The figure shows the remaining error over the friction, for each kind and scheme, the three steps and the stiffest
# spring.

stiffness = np.array(AXES["stiffness"])


def left(results):
    """Return the relative errors after the three windows, shape (*axes, 3)."""
    energy = results.energy.values
    windows = (
        energy[..., 1:].reshape(*energy.shape[:-1], 3, WINDOW).mean(axis=-1)
        - energy[..., :1]
    )
    return windows / (0.5 * stiffness[:, None, None] * START**2)


_, axes = plt.subplots(1, 4, figsize=(12.0, 3.6), sharey=True, layout="constrained")
for ax, kind in zip(axes, KINDS, strict=True):
    for name, marker in zip(SCHEMES, "os", strict=True):
        errors = left(found[kind, name])
        rises = found[kind, name].rise.values
        print(
            f"{kind}, {name}: the entropy rises by {np.nanmin(rises):.0e} or more in"
            " each step"
        )
        for i, (step, color) in enumerate(
            zip(AXES["step"], ("#0072B2", "#009E73", "#D55E00"), strict=True)
        ):
            seen = np.abs(errors[i, -1, 1:, -1])
            filled = color if marker == "o" else "none"
            ax.loglog(
                AXES["friction"][1:],
                seen,
                marker,
                color=color,
                markerfacecolor=filled,
                label=f"{name}, step {step:g}",
            )
            quarter, whole = errors[i, -1, :, 1], errors[i, -1, :, 2]
            with np.errstate(invalid="ignore", divide="ignore"):
                growth = whole / quarter
            print(f"  step {step:4}: left", *(f"{e:9.1e}" for e in whole))
            print(
                "    over that after a quarter of the time",
                *(f"{g:6.2f}" for g in growth),
            )
    ax.set(title=f"spring {kind}", xlabel="friction, parts of critical")
    ax.spines[["top", "right"]].set_visible(False)
axes[0].set(ylabel="error of the energy that is left")
axes[0].legend(frameon=False, fontsize="x-small")
plt.show()

# %%
# The results are relative to the initial mechanical energy and hold for the stiffest spring:
#
# - *Without a drive nothing grows.* Once the mass has come to rest, the error is the same after a quarter of the time
#   and after all of it, to a percent, for both schemes. Beside a gas it is at most 4.5e-6 for scheme 2 and 9.1e-6 for
#   scheme 3, at the step 0.2. The heat causes this error, which falls as the square of the step and, for weak friction,
#   of the friction. With a spring ten times as soft, which produces less heat relative to the energy of the gas, the
#   error is a hundredth. Without friction scheme 2 conserves the energy of this linear spring to rounding; the energy
#   of scheme 3 oscillates within 5e-3.
# - *Against a gas*, where the heat acts back on the motion, the error is larger, 3.8e-5 at the step 0.2, and weak
#   friction does not reduce it, because the oscillations in the gas cause it. This error does not grow either.
# - *Driven*, with heat produced all the time, the energy of scheme 3 drifts. The error grows in proportion to the time,
#   to 5.2e-2 of the initial energy at the step 0.2 and critical friction, and falls as the square of the step. It is
#   equally large beside a gas and against one. The drift of scheme 2 is far smaller: beside a gas its error does not
#   grow, and against a gas it grows by 45 % during the last three quarters of the run, to 6e-6.
#
# So systems that come to rest show the good behaviour. Scheme 2, which evaluates forces and heat at one point, shows
# nearly all of it in driven systems too. The entropy falls in no step of any run.
