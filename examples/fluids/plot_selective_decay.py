"""
Where does a decaying flow on a sphere end?
===========================================

An ideal fluid on the sphere conserves its energy and the integral of every function of its vorticity. A real fluid
first loses enstrophy, in filaments that are too fine to be seen, while its energy is nearly constant. This is
*selective decay*. This example computes it by a metriplectic system on the dual of su(N), Zeitlin's model of the fluid.
The vorticity is an N by N matrix W. The energy is constant to rounding, and the enstrophy falls in every step, by a
``K`` of commutators with the stream function P. It falls until ``[P, W] = 0``. Then the flow is steady, and its
vorticity is a function of its stream function.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

N = 20
system = lt.models.zeitlin(N, decay="enstrophy", rate=0.3)
sphere = lt.models.QuantisedSphere(N)
start = sphere.random(seed=3, degrees=(2, 8), enstrophy=40.0)
solution = lt.integrate(
    system,
    start,
    (0.0, 60.0),
    0.04,
    lt.MetriplecticRungeKutta(4),
    save_every=125,
    engine="array",
)
print(solution.audit())

# %%
# The vorticity at the start, during the run and at the end, on the whole sphere in an equal-area projection. Small
# vortices disappear, and the remaining ones are as large as the sphere.

figure = plt.figure(figsize=(10, 3), layout="constrained")
shown = (0, 2, len(solution.t) - 1)
for place, i in enumerate(shown, start=1):
    ax = figure.add_subplot(1, 3, place, projection="mollweide")
    lt.plot.sphere_field(
        sphere.on_grid(solution.x[i]), ax=ax, title=f"t = {solution.t[i]:g}"
    )

# %%
# Every point of the sphere has a vorticity and a stream function. At the start they make a cloud, at the end a curve.
# The curve is not a straight line: the flow becomes steady before its enstrophy is the least possible for its energy.


def scatter_of_levels(mu):
    """Return the relative scatter of the vorticity at equal stream function."""
    omega, psi = (
        sphere.on_grid(f, (40, 80)).ravel() for f in (mu, sphere.inverse_laplacian(mu))
    )
    order = np.argsort(psi)
    bins = np.array_split(omega[order], 60)
    return np.sqrt(np.mean([np.var(b) for b in bins]) / np.var(omega))


figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for ax, i in zip(axes, (0, -1), strict=True):
    mu = solution.x[i]
    psi, omega = (
        sphere.on_grid(f, (40, 80)).ravel() for f in (sphere.inverse_laplacian(mu), mu)
    )
    ax.plot(psi, omega, ".", ms=1)
    ax.set(xlabel="stream function", ylabel="vorticity", title=f"t = {solution.t[i]:g}")
print(
    "spread about a curve:",
    *(f"{scatter_of_levels(solution.x[i]):.1e}" for i in (0, -1)),
)

# %%
# The figure shows the energy, which is constant to rounding, and the enstrophy.

energy, enstrophy = solution.energy, -solution.entropy
print(
    f"energy drift {np.abs(energy / energy[0] - 1).max():.0e}, enstrophy"
    f" {enstrophy[0]:.3g} to {enstrophy[-1]:.3g}"
)
plt.show()
