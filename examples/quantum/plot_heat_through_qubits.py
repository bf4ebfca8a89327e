"""
What does heat do on its way through two qubits?
================================================

Two qubits are coupled, and each has a bath. Heat flows from the hot bath into the first qubit, to the second, and into
the cold bath. The baths are of finite size, so the flow ends. In the end the cold bath has gained more entropy than the
hot bath has lost.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

H = np.diag([0.0, 1.0])
lower = np.array([[0, 1], [0, 0]])


def part(temperature, name):
    bath = lt.HeatBaths(capacity=2.0, temperature=temperature)
    return lt.QuantumSystem(
        H, lt.ThermalJumps([(lower, 0.2)]), baths=bath, names=[name]
    )


pair = (part(2.0, "hot") * part(0.5, "cold")).coupled(
    0.1 * (np.kron(lower, lower.T) + np.kron(lower.T, lower))
)
start = np.kron(np.diag([0.6, 0.4]), np.diag([0.9, 0.1]))
solution = lt.integrate(pair, pair.state(start), (0.0, 150.0), 0.25)
print(solution.audit())

# %%
# Each entropy is relative to its initial value.

baths = solution.x[:, -2:] - solution.x[0, -2:]
whole = solution.entropy - solution.entropy[0]
qubits = whole - baths.sum(axis=1)
temperatures = np.asarray(pair.temperatures(solution.x))
print(f"temperatures at the end: {temperatures[-1]}")

# %%

figure, axes = plt.subplots(1, 2, figsize=(8.5, 3.4), layout="constrained")
axes[0].plot(solution.t, temperatures[:, 0], color="#D55E00", label="hot bath")
axes[0].plot(solution.t, temperatures[:, 1], color="#0072B2", label="cold bath")
axes[0].set(xlabel="time", ylabel="temperature")
axes[0].legend(frameon=False)
axes[1].plot(solution.t, baths[:, 0], color="#D55E00", label="hot bath")
axes[1].plot(solution.t, baths[:, 1], color="#0072B2", label="cold bath")
axes[1].plot(solution.t, qubits, color="#009E73", label="qubits")
axes[1].plot(solution.t, whole, "k--", label="all")
axes[1].set(xlabel="time", ylabel="entropy since the start")
axes[1].legend(frameon=False)
for ax in axes:
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
