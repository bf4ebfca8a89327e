"""
How do I run a system on a Lie algebra of my own?
=================================================

The oscillator algebra is not in the catalogue. Its basis consists of a rotation J, a Heisenberg pair Q and P that J
rotates, and a central element Z: [J, Q] = P, [J, P] = -Q, [Q, P] = Z. Three lines define it.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt
import manifolds as mf

J, Q, P, Z = range(4)
C = np.zeros((4, 4, 4))
C[J, Q, P], C[J, P, Q], C[Q, P, Z] = 1, -1, 1
g = mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="oscillator")

print(
    f"{g}: solvable {g.is_solvable()}, nilpotent {g.is_nilpotent()}, unimodular"
    f" {g.is_unimodular()}"
)

# %%
# The library checks the axioms, exactly if the constants are rational. In this wrong version Z is not central:

C[J, Z, Z] = 1
try:
    mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="mistaken")
except mf.JacobiError as error:
    print(error)

# %%
# There are two independent Casimirs. The linear one is Z, and the quadratic one will be the entropy.

(centre,), (casimir,) = g.casimirs(1), g.casimirs(2)
print(f"{g.casimir_count()} Casimirs: {centre} and {casimir}")

# %%
# Killing dissipation would do nothing here: by Cartan's criterion the Killing form of a solvable algebra vanishes on
# all brackets. The projected metric works on every algebra. If it preserves Z as well, Q and P decay and J takes up
# their energy.

energy = lt.Quadratic([1.0, 2.0, 2.0, 0.0])
dissipation = lt.ProjectedMetric(preserve=[centre], rate=0.05)
system = lt.LiePoissonSystem(g, energy, entropy=casimir, dissipation=dissipation)
print(system.check())

solution = lt.integrate(system, [0.2, 1.2, 0.0, 1.0], t_span=(0.0, 30.0), step=0.05)
print(solution.audit())

# %%

figure, ax = plt.subplots(layout="constrained")
for component, name, color in zip(
    solution.x.T, "JQPZ", ("#0072B2", "#E69F00", "#009E73", "0.5"), strict=True
):
    ax.plot(solution.t, component, color=color, label=name)
ax.set(
    xlabel="time",
    ylabel=r"components of $\mu$",
    title="Relaxation on the oscillator algebra",
)
ax.legend(frameon=False, ncols=4, loc="lower right")
ax.spines[["top", "right"]].set_visible(False)
plt.show()
