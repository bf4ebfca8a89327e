r"""
Is Killing dissipation the same as the projected metric?
========================================================

Both dissipations conserve the energy and raise a Casimir. On so(3) they are equal up to a factor. On larger algebras
they differ and may even have different states of rest.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf


def bodies(g, inertia):
    """Return the body with either dissipation; S is the quadratic Casimir."""
    rate = (
        -1.0 / g.killing_form()[0, 0]
    )  # makes -rate * kappa the dot product in these bases
    dissipations = {
        "Killing": lt.KillingDissipation(rate),
        "projected": lt.ProjectedMetric(),
    }
    return {
        name: lt.LiePoissonSystem(
            g, lt.Quadratic(1 / inertia), lt.Quadratic(np.ones(g.dim)), dissipation
        )
        for name, dissipation in dissipations.items()
    }


# %%
# On so(3) the two vector fields agree to rounding; on su(3) they do not.

random = np.random.default_rng(0)
for g in mf.so(3), mf.su(3):
    inertia = np.linspace(1.0, 3.0, g.dim)
    pair = bodies(g, inertia)
    mu = random.standard_normal((100, g.dim))
    difference = np.abs(
        pair["Killing"].vector_field(mu) - pair["projected"].vector_field(mu)
    ).max()
    print(f"{g.name}: the vector fields differ by {difference:.1e} at most")

# %%
# Killing dissipation produces the entropy :math:`|[\Omega, \mu]|^2`, with :math:`\Omega = \nabla H`. It stops wherever
# :math:`\Omega` and :math:`\mu` commute, and there the free motion stops too: at a relative equilibrium. On so(3)
# commuting vectors are parallel, and the attracting state has the largest entropy. On su(3) commuting elements need not
# be parallel. The projected metric rests only where :math:`\Omega` is parallel to :math:`\mu`.

figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.6), layout="constrained")
styles = {
    "Killing": {"color": "#0072B2"},
    "projected": {"color": "#E69F00", "linestyle": "--"},
}
mu = random.standard_normal(g.dim)
for name, body in pair.items():
    solution = lt.integrate(
        body, mu / np.linalg.norm(mu), t_span=(0.0, 400.0), step=0.1
    )
    print(f"{name}:\n{solution.audit()}\n")
    largest = inertia.max() * solution.energy[0]
    free_motion = np.linalg.norm(g.ad_star(solution.x / inertia, solution.x), axis=-1)
    left.semilogy(solution.t, largest - solution.entropy, label=name, **styles[name])
    right.semilogy(solution.t, free_motion, label=name, **styles[name])
left.set(xlabel="time", title=r"entropy still to gain, $S_\mathrm{max} - S$")
right.set(xlabel="time", title=r"speed of the free motion, $|[\Omega, \mu]|$")
left.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
