"""
Two routes to a piston between two gases
========================================

A piston between two gases has three entropies: one for itself and one for each gas. A variational scheme discretises
the variational principle of such a system. A metriplectic method discretises the bracket. Both produce entropy in every
step. The example compares the other laws and the orders.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
from liethermo.models.gases import gas_piston_state

piston = lt.models.gas_piston(friction=5.0, conductance=(2.0, 2.0))
x0, end = gas_piston_state(0.35, (300.0, 320.0, 290.0)), 0.1
reference = lt.integrate(piston, x0, (0.0, end), end / 6400, lt.MetriplecticGauss(3)).x[
    -1
]
size = np.abs(reference)

routes = {
    "scheme 1": lt.VariationalIntegrator.verlet(),
    "scheme 2": lt.VariationalIntegrator.midpoint(),
    "scheme 3": lt.VariationalIntegrator.symmetrised(),
    "metriplectic midpoint": lt.MetriplecticMidpoint(),
    "metriplectic Gauss, order 4": lt.MetriplecticGauss(2),
}
counts = np.array(
    [400, 800, 1600, 3200]
)  # in longer steps the two leading errors of scheme 1 cancel in part
_, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.8), layout="constrained")
for name, method in routes.items():
    runs = [lt.integrate(piston, x0, (0.0, end), end / n, method) for n in counts]
    errors = [np.max(np.abs(run.x[-1] - reference) / size) for run in runs]
    drift = np.abs(runs[0].energy / runs[0].energy[0] - 1.0)
    print(
        f"{name:28} order {np.log2(errors[-2] / errors[-1]):.2f}, energy to"
        f" {drift.max():.0e}, "
        f"least rise of the entropy {np.diff(runs[0].entropy).min():.0e} J/K"
    )
    left.loglog(end / counts, errors, "o-", label=name, markersize=3, linewidth=1.0)
    right.semilogy(runs[0].t, drift + 1e-17, linewidth=0.8)
left.set(xlabel="step (s)", ylabel="relative error at 0.1 s")
left.legend(frameon=False, fontsize="small")
right.set(xlabel="time (s)", ylabel="relative error of the energy, step 0.25 ms")
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
