"""
How do I run a system on a Lie algebra of my own?
=================================================

The oscillator algebra is not in the catalogue. It has a rotation J, the Heisenberg pair Q and P that J turns into each
other, and a centre Z: [J, Q] = P, [J, P] = -Q, [Q, P] = Z. Three lines define it.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

J, Q, P, Z = range(4)
C = np.zeros((4, 4, 4))
C[J, Q, P], C[J, P, Q], C[Q, P, Z] = 1, -1, 1
g = mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="oscillator")

print(f"{g}: solvable {g.is_solvable()}, nilpotent {g.is_nilpotent()}, unimodular {g.is_unimodular()}")

# %%
# The axioms are checked, exactly where the constants are rational. Here Z is no longer central:

C[J, Z, Z] = 1
try:
    mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="mistaken")
except mf.JacobiError as error:
    print(error)

# %%
# Two Casimirs are expected. The linear one is the centre; the quadratic one will be the entropy.

(centre,), (casimir,) = g.casimirs(1), g.casimirs(2)
print(f"{g.casimir_count()} Casimirs: {centre} and {casimir}")

# %%
# Killing dissipation would do nothing here: by Cartan's criterion the Killing form of a solvable algebra vanishes on
# all brackets. The projected metric works on every algebra. Told to preserve the centre as well, it lets Q and P die
# out and J take up their energy.

energy = lt.Quadratic([1.0, 2.0, 2.0, 0.0])
dissipation = lt.ProjectedMetric(preserve=[centre], rate=0.05)
system = lt.LiePoissonSystem(g, energy, entropy=casimir, dissipation=dissipation)
print(system.check())

solution = lt.integrate(system, [0.2, 1.2, 0.0, 1.0], t_span=(0.0, 30.0), step=0.05)
print(solution.audit())

# %%

figure, ax = plt.subplots(layout="constrained")
for component, name, color in zip(solution.x.T, "JQPZ", ("#0072B2", "#E69F00", "#009E73", "0.5"), strict=True):
    ax.plot(solution.t, component, color=color, label=name)
ax.set(xlabel="time", ylabel=r"components of $\mu$", title="Relaxation on the oscillator algebra")
ax.legend(frameon=False, ncols=4, loc="lower right")
ax.spines[["top", "right"]].set_visible(False)
