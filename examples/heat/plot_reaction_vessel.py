r"""
How far does a reaction go in a vessel that it heats?
=====================================================

In a vessel A and B combine to C, and C decays again. The reaction releases energy and warms the mixture, and the
mixture warms the jacket of the vessel. The warmer it is, the less C there is in the end. The law of mass action,

.. math::
   \frac{n_C}{n_A n_B} = K(T),

has a constant that falls with the temperature. This law is not an input. The system has an energy, an entropy, and
a reaction that acts as a friction between chemical potentials.
"""

import matplotlib.pyplot as plt
import numpy as np

import liethermo as lt

nu = (-1.0, -1.0, 1.0)
vessel = lt.models.reaction_vessel(nu)
gas, volume = vessel.subsystems[0].energy.function.gas, 1.0


def state(T, numbers):
    """All at one temperature; the jacket has U = C exp(S / C) with C = 20."""
    return np.array(
        [
            float(gas.entropy_at(T, np.asarray(numbers), volume)),
            *numbers,
            20.0 * np.log(T),
        ]
    )


# %%
# The runs start from mixtures of different temperatures, each with equally many particles of A and B.

_, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
found = []
for T in (0.4, 0.6, 0.9, 1.3, 2.0):
    run = lt.integrate(
        vessel, state(T, (1.0, 1.0, 0.01)), (0.0, 300.0), 0.05, lt.MetriplecticGauss(2)
    )
    A, B, C = vessel.numbers_of_particles(run.x[-1]) / volume
    end = float(vessel.temperatures(run.x[-1])[0])
    K = float(gas.equilibrium_constant(end, nu))
    found.append((end, C / (A * B)))
    print(
        f"from T = {T}: ends at {end:.4f}, n_C / (n_A n_B) = {C / (A * B):.4g}, "
        f"K(T) = {K:.4g}, "
        f"relative difference {abs(C / (A * B) / K - 1.0):.0e}; "
        f"energy to {np.ptp(run.energy) / abs(run.energy[0]):.0e}, "
        f"least rise of the entropy {np.diff(run.entropy).min():.0e}"
    )
    left.plot(run.t, run.x[:, 3], label=f"T = {T:g}")
left.set(xlabel="time", ylabel="particles of C", xlim=(0.0, 60.0))
left.legend(frameon=False)
T = np.linspace(0.3, 2.3, 200)
right.semilogy(
    T,
    [float(gas.equilibrium_constant(t, nu)) for t in T],
    color="0.7",
    linewidth=3,
    label="mass action",
)
right.semilogy(*zip(*found, strict=True), "o", label="runs, in the end")
right.set(xlabel="temperature", ylabel="$n_C / (n_A n_B)$")
right.legend(frameon=False)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
plt.show()
