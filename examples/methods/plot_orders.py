"""
Order after order, with both laws exact
=======================================

``MetriplecticGauss`` of s stages is of order 2s. Two systems test this, in which neither the energy nor the
entropy is quadratic: a body with an anharmonic energy on so(3)*, and a top-like system on se(3)* whose entropy is a
function of a Casimir.
The error falls as h to the power 2s. At every point of the picture, also for the longest steps, the energy is constant
to rounding and the entropy grows.
"""

import itertools

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

# %%
# The two systems follow.

so3, se3 = mf.so(3), mf.se(3)
length = se3.casimirs(degree=2)[
    0
]  # of the translation part, or its product with the rotation part

anharmonic = lt.LiePoissonSystem(
    so3,
    energy=lambda m: (
        0.5 * jnp.sum(m**2 / jnp.array([3.0, 2.0, 1.0]))
        + 0.1 * m[0] ** 4
        + 0.05 * jnp.cos(m[1])
    ),
    entropy=lambda m: jnp.log(1.0 + m @ m),
    dissipation=lt.ProjectedMetric(rate=0.3),
)
top = lt.LiePoissonSystem(
    se3,
    energy=lambda m: (
        0.5 * jnp.sum(m[:3] ** 2 / jnp.array([1.0, 1.5, 2.0]))
        + jnp.sin(m[5])
        + 0.3 * m[3] ** 2
    ),
    entropy=lambda m: jnp.log(1.0 + length(m) ** 2),
    dissipation=lt.ProjectedMetric(rate=0.1),
)
cases = [
    ("anharmonic body, so(3)*", anharmonic, [0.8, 0.5, 0.9]),
    ("top with dissipation, se(3)*", top, [0.4, 0.3, 0.8, 0.3, 0.2, 0.9]),
]

# %%
# The errors at t = 4 are relative to a run with far smaller steps.

STAGES, COUNTS, END = (1, 2, 3, 4), (4, 8, 16, 32, 64), 4.0
figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
for panel, (title, system, x0) in zip(axes, cases, strict=True):
    reference = lt.integrate(
        system, x0, (0.0, END), END / 256, lt.MetriplecticGauss(4), engine="compiled"
    ).x[-1]
    print(title)
    for stages in STAGES:
        errors = []
        for count in COUNTS:
            run = lt.integrate(
                system,
                x0,
                (0.0, END),
                END / count,
                lt.MetriplecticGauss(stages),
                engine="compiled",
            )
            audit = run.audit()
            assert audit.energy_drift < 1e-14
            assert audit.entropy_min_increment > -1e-15
            errors.append(np.abs(run.x[-1] - reference).max())
        seen = [np.log2(a / b) for a, b in itertools.pairwise(errors) if b > 1e-13]
        print(
            f"  {stages} stages: observed orders"
            f" {', '.join(f'{order:.2f}' for order in seen)}"
        )
        steps = END / np.array(COUNTS)
        panel.loglog(steps, errors, "o-", label=f"s = {stages}")
        panel.loglog(
            steps,
            errors[0] * (steps / steps[0]) ** (2 * stages),
            ":",
            color="grey",
            linewidth=0.8,
        )
    panel.set_xscale("log", base=2)
    panel.set(title=title, xlabel="step h", ylim=(1e-15, 1.0))
axes[0].set_ylabel("error at t = 4")
figure.legend(
    *axes[0].get_legend_handles_labels(),
    title="dotted:\nh to the 2s",
    loc="outside right center",
)
plt.show()
