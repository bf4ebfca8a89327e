"""
Does it agree with QuTiP?
=========================

Operators may be those of QuTiP: a Hamiltonian or a coupling that has a method ``full()`` is read by it, so nothing has
to be converted by hand. Where a bath keeps its temperature the motion is Lindblad's equation, which ``qutip.mesolve``
integrates. The two are compared for a qubit and for chains of levels. Without QuTiP (``pip install qutip``)
the comparison is with the exponential of the generator.
"""

import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg

import liethermo as lt

try:
    import qutip
except ImportError:
    qutip = None

temperature, rate = 0.8, 0.1


def operators(levels):
    """Levels whose distances differ, and a coupling of neighbours; those of QuTiP where it is there."""
    H, V = np.diag(np.cumsum(np.arange(levels) * 0.3 + 0.4)), np.diag(np.sqrt(np.arange(1.0, levels)), 1)
    return (H, V) if qutip is None else (qutip.Qobj(H), qutip.Qobj(V))


def system(levels):
    H, V = operators(levels)
    bath = lt.HeatBaths(capacity=np.inf, temperature=temperature)
    return lt.QuantumSystem(H, lt.ThermalJumps([(V, rate)]), baths=bath)


# %%
# The jumps that Lindblad's equation has: one for each pair of neighbours, up and down.


def jumps(levels):
    H, V = np.diag(np.cumsum(np.arange(levels) * 0.3 + 0.4)), np.diag(np.sqrt(np.arange(1.0, levels)), 1)
    for i in range(levels - 1):
        one, omega = np.zeros((levels, levels)), H[i + 1, i + 1] - H[i, i]
        one[i, i + 1] = V[i, i + 1]
        yield np.sqrt(rate * np.exp(omega / (2 * temperature))) * one
        yield np.sqrt(rate * np.exp(-omega / (2 * temperature))) * one.T


def reference(levels, rho, times):
    H = np.diag(np.cumsum(np.arange(levels) * 0.3 + 0.4))
    if qutip is not None:
        options = {"rtol": 1e-12, "atol": 1e-14, "nsteps": 100_000}
        found = qutip.mesolve(
            qutip.Qobj(H), qutip.Qobj(rho), times, c_ops=[qutip.Qobj(L) for L in jumps(levels)], options=options
        )
        return np.array([state.full() for state in found.states])
    one = np.eye(levels)
    generator = -1j * (np.kron(H, one) - np.kron(one, H.T))
    for L in jumps(levels):
        n = L.T @ L
        generator += np.kron(L, L.conj()) - 0.5 * (np.kron(n, one) + np.kron(one, n.T))
    step, found = scipy.linalg.expm(generator * (times[1] - times[0])), [rho.ravel()]
    for _ in times[1:]:
        found.append(step @ found[-1])
    return np.reshape(found, (-1, levels, levels))


# %%

figure, axes = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
for levels, color in ((2, "#0072B2"), (5, "#D55E00")):
    rng = np.random.default_rng(levels)
    root = rng.normal(size=(levels, levels)) + 1j * rng.normal(size=(levels, levels))
    rho = root @ root.conj().T / np.trace(root @ root.conj().T).real
    q = system(levels)
    solution = lt.integrate(q, q.state(rho), (0.0, 20.0), 0.1, lt.MetriplecticGauss(3))
    ours, other = np.asarray(q.density(solution.x)), reference(levels, rho, solution.t)
    print(f"{levels} levels: largest difference {np.abs(ours - other).max():.1e}, {solution.audit().passed=}")
    axes.plot(solution.t, np.diagonal(ours, axis1=1, axis2=2).real, color=color)
axes.set(xlabel="time", ylabel="populations", title="two and five levels")
axes.spines[["top", "right"]].set_visible(False)
plt.show()
