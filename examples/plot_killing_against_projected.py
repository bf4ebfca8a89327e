r"""
Is Killing dissipation the same as the projected metric?
========================================================

Both keep the energy and raise a Casimir. On so(3) they are one and the same, up to a factor. On larger algebras they
differ, and need not even come to rest in the same place.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf


def bodies(g):
    """The body of inertias 1 to 3 on a compact algebra, with either dissipation; S is the quadratic Casimir."""
    inertia = np.linspace(1.0, 3.0, g.dim)
    rate = -1.0 / g.killing_form()[0, 0]  # makes -rate * kappa the dot product in these bases
    for name, dissipation in ("Killing", lt.KillingDissipation(rate)), ("projected", lt.ProjectedMetric()):
        yield name, lt.LiePoissonSystem(g, lt.Quadratic(1 / inertia), lt.Quadratic(np.ones(g.dim)), dissipation)


# %%
# On so(3) the two vector fields agree to rounding; on su(3) they do not.

random = np.random.default_rng(0)
for g in mf.so(3), mf.su(3):
    mu = random.standard_normal((100, g.dim))
    (_, killing), (_, projected) = bodies(g)
    difference = np.abs(killing.vector_field(mu) - projected.vector_field(mu)).max()
    print(f"{g.name}: largest difference of the vector fields {difference:.1e}")

# %%
# Killing dissipation produces the entropy :math:`|[\Omega, \mu]|^2`, with :math:`\Omega = \nabla H`. It stops wherever
# :math:`\Omega` and :math:`\mu` commute, and there the free motion stops too: at the first relative equilibrium that
# attracts. On so(3) commuting vectors are parallel, and this is the state of largest entropy. In su(3) they need
# not be. The projected metric does not rest until :math:`\Omega` is parallel to :math:`\mu`.

figure, axes = plt.subplots(1, 2, sharey=True, figsize=(8.0, 3.6), layout="constrained")
for ax, g in zip(axes, (mf.so(3), mf.su(3)), strict=True):
    mu = random.standard_normal(g.dim)
    for (name, body), color in zip(bodies(g), ("#0072B2", "#E69F00"), strict=True):
        solution = lt.integrate(body, mu / np.linalg.norm(mu), t_span=(0.0, 150.0), step=0.1)
        largest = 3.0 * solution.energy[0]
        speed = np.linalg.norm(body.algebra.ad_star(body.energy.gradient(solution.x[-1]), solution.x[-1]))
        print(
            f"{g.name}, {name}: {largest - solution.entropy[-1]:.1e} below the largest entropy, |[Ω, μ]| = {speed:.1e}"
        )
        dashes = "--" if name == "projected" else "-"
        ax.semilogy(solution.t, largest - solution.entropy, dashes, color=color, linewidth=2, label=name)
    ax.set(title=g.name, xlabel="time")
    ax.spines[["top", "right"]].set_visible(False)
axes[0].set_ylabel(r"$S_\mathrm{max} - S$")
axes[0].set_ylim(bottom=1e-14)
axes[1].legend(frameon=False)
