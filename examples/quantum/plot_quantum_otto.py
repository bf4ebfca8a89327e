"""
How much work does a qubit make of heat?
========================================

An Otto engine with one qubit has four strokes: it takes heat from a hot bath at a high frequency, the frequency is
lowered and work comes out, it gives heat to a cold bath, the frequency is raised again. In theory its efficiency is one
minus the quotient of the frequencies, which is below Carnot's. Each stroke is a run of its own. The work is that of the
time-dependent Hamiltonian.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

excited = np.diag([0.0, 1.0])
lower = np.array([[0, 1], [0, 0]])
low, high = 1.0, 2.0
cold, hot = 0.4, 1.6


def in_touch(frequency, temperature):
    bath = lt.HeatBaths(capacity=np.inf, temperature=temperature)
    return lt.QuantumSystem(
        frequency * excited, lt.ThermalJumps([(lower, 0.3)]), baths=bath
    )


def driven(first, last, time=2.0):
    return lt.QuantumSystem(lambda t: (first + (last - first) * t / time) * excited)


# %%
# A stroke returns the density matrices and the energies of the qubit along its run.


def stroke(system, rho, time, frequency):
    run = lt.integrate(system, system.state(rho), (0.0, time), 0.1)
    rhos = np.asarray(system.density(run.x))
    return rhos, frequency(run.t) * rhos[:, 1, 1].real


heat_in, heat_out = in_touch(high, hot), in_touch(low, cold)
expansion, compression = driven(high, low), driven(low, high)
rho, cycles, figures = np.diag([0.7, 0.3]), [], []
for _ in range(4):
    parts = [
        (heat_in, 8.0, lambda t: high + 0.0 * t),
        (expansion, 2.0, lambda t: high + (low - high) * t / 2.0),
        (heat_out, 8.0, lambda t: low + 0.0 * t),
        (compression, 2.0, lambda t: low + (high - low) * t / 2.0),
    ]
    changes = []
    for system, time, frequency in parts:
        rhos, energy = stroke(system, rho, time, frequency)
        cycles.append(
            (
                np.broadcast_to(
                    frequency(np.linspace(0.0, time, len(energy))), energy.shape
                ),
                rhos[:, 1, 1].real,
            )
        )
        changes.append(energy[-1] - energy[0])
        rho = rhos[-1]
    taken, out = changes[0], -(changes[1] + changes[3])
    figures.append(out / taken)
    print(
        f"heat from the hot bath {taken:.5f}, work {out:.5f}, efficiency"
        f" {out / taken:.6f}"
    )
print(f"in theory {1 - low / high:.6f}, Carnot {1 - cold / hot:.6f}")

# %%
# The last of the four cycles is drawn in full colour, with an arrow on each stroke.

figure, axes = plt.subplots(figsize=(5.0, 3.6), layout="constrained")
for i, (frequency, population) in enumerate(cycles):
    axes.plot(
        frequency,
        population,
        color=("#D55E00", "k", "#0072B2", "k")[i % 4],
        alpha=0.3 + 0.7 * (i >= 12),
    )
    if i >= 12:
        way = np.abs(frequency - frequency[0]) + np.abs(population - population[0])
        k = np.searchsorted(way, 0.5 * way[-1])
        axes.annotate(
            "",
            (frequency[k], population[k]),
            (frequency[k - 1], population[k - 1]),
            arrowprops={"arrowstyle": "-|>", "color": "0.2", "mutation_scale": 14},
        )
axes.set(
    xlabel="frequency",
    ylabel="population of the excited level",
    title="red: hot bath, blue: cold bath",
)
axes.spines[["top", "right"]].set_visible(False)
plt.show()
