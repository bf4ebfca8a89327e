r"""
Where does the swing of a warm pendulum go?
===========================================

Two bodies hang on thermoelastic springs, one below the other, without gravity: the double pendulum of Romero (2009). A
spring cools when it is stretched. Heat flows from the warmer spring to the colder one and does not come back. So the
springs stop oscillating without any friction. A rotation remains, since the angular momentum is constant.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

chain = lt.models.thermoelastic_chain(
    bodies=2, dimension=2, stiffness=20.0, expansion=2.0, conductance=1.0
)
first, second = (
    [1.2, 0.0, 0.0, 2.0, 0.0],
    [2.6, 0.2, -0.5, 3.0, 0.0],
)  # q, p and S of each
solution = lt.integrate(
    chain, first + second, t_span=(0.0, 60.0), step=0.02, method=lt.MetriplecticGauss(2)
)

# %%
# Both laws hold at every step. The energy of a spring enters by its squared length, a quadratic function of the state,
# and so the discrete forces act along the springs: the angular momentum is conserved to rounding as well.

print(solution.audit())

# %%

lengths = [
    np.linalg.norm(a, axis=1)
    for a in (solution.x[:, :2], solution.x[:, 5:7] - solution.x[:, :2])
]
temperatures = np.asarray(chain.temperatures(solution.x))
figure, (left, middle, right) = plt.subplots(
    1, 3, figsize=(10.0, 3.4), layout="constrained"
)
late = solution.t > 55.0
for q, color, name in (
    (solution.x[:, :2], "#0072B2", "first"),
    (solution.x[:, 5:7], "#E69F00", "second"),
):
    left.plot(*q[~late].T, color=color, linewidth=0.5, alpha=0.4)
    left.plot(*q[late].T, color=color, label=name)
left.set(aspect="equal", title="paths, the last five units dark", xticks=[], yticks=[])
left.legend(frameon=False, loc="center")
for r, T, color in zip(lengths, temperatures.T, ("#0072B2", "#E69F00"), strict=True):
    middle.plot(solution.t, r, color=color, linewidth=0.8)
    right.plot(solution.t, T, color=color, linewidth=0.8)
middle.set(xlabel="time", title="lengths of the springs")
right.set(xlabel="time", title="temperatures")
for ax in (middle, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
