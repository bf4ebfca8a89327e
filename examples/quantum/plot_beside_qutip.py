"""
Does it agree with QuTiP?
=========================

Operators of QuTiP need no conversion: the library reads a Hamiltonian or a coupling by its method ``full()``. If a bath
keeps its temperature, the motion is Lindblad's equation, which ``qutip.mesolve`` integrates. The example compares the
two for a qubit, for two coupled qubits, and for a chain of five levels. Without QuTiP, which the extra ``quantum``
installs, the comparison is with the exponential of the generator.
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
lower, one = np.array([[0.0, 1.0], [0.0, 0.0]]), np.eye(2)


def chain(levels):
    """Levels whose distances differ, and a coupling of neighbours."""
    return np.diag(np.cumsum(np.arange(levels) * 0.3 + 0.4)), [
        np.diag(np.sqrt(np.arange(1.0, levels)), 1)
    ]


def two_qubits():
    """Two qubits that exchange their excitation, each with a coupling to the bath."""
    first, second = np.kron(lower, one), np.kron(one, lower)
    H = (
        0.7 * first.T @ first
        + 0.9 * second.T @ second
        + 0.2 * (first.T @ second + second.T @ first)
    )
    return H, [first, second]


CASES = {"a qubit": chain(2), "two qubits": two_qubits(), "five levels": chain(5)}


def system(H, couplings):
    if qutip is not None:
        H, couplings = qutip.Qobj(H), [qutip.Qobj(V) for V in couplings]
    bath = lt.HeatBaths(capacity=np.inf, temperature=temperature)
    return lt.QuantumSystem(
        H, lt.ThermalJumps([(V, rate) for V in couplings]), baths=bath
    )


# %%
# Lindblad's equation has jumps of one frequency each: in the eigenvectors of the Hamiltonian the entries of a coupling
# with the same difference of energies. Each jump comes with its adjoint, and the two rates are in detailed balance.


def jumps(H, couplings):
    energies, vectors = np.linalg.eigh(H)
    gaps = energies[None, :] - energies[:, None]
    for V in couplings:
        inside = vectors.T @ V @ vectors
        for omega in np.unique(np.round(gaps[np.abs(inside) > 1e-12], 9)):
            part = (
                vectors @ np.where(np.abs(gaps - omega) < 1e-6, inside, 0.0) @ vectors.T
            )
            yield np.sqrt(rate * np.exp(omega / (2 * temperature))) * part
            yield np.sqrt(rate * np.exp(-omega / (2 * temperature))) * part.T


def reference(H, couplings, rho, times):
    found, operators = [rho.ravel()], list(jumps(H, couplings))
    if qutip is not None:
        options = {"rtol": 1e-12, "atol": 1e-14, "nsteps": 100_000}
        run = qutip.mesolve(
            qutip.Qobj(H),
            qutip.Qobj(rho),
            times,
            [qutip.Qobj(L) for L in operators],
            options=options,
        )
        return np.array([state.full() for state in run.states])
    n = len(H)
    generator = -1j * (np.kron(H, np.eye(n)) - np.kron(np.eye(n), H.T))
    for L in operators:
        square = L.T @ L
        generator += np.kron(L, L) - 0.5 * (
            np.kron(square, np.eye(n)) + np.kron(np.eye(n), square.T)
        )
    step = scipy.linalg.expm(generator * (times[1] - times[0]))
    for _ in times[1:]:
        found.append(step @ found[-1])
    return np.reshape(found, (-1, n, n))


# %%

figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.2), layout="constrained", sharey=True)
for ax, (name, (H, couplings)) in zip(axes, CASES.items(), strict=True):
    rng = np.random.default_rng(len(H))
    root = rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)
    rho = root @ root.conj().T / np.trace(root @ root.conj().T).real
    q = system(H, couplings)
    solution = lt.integrate(
        q, q.state(rho), (0.0, 20.0), 0.25, lt.MetriplecticRungeKutta(8)
    )
    ours, other = (
        np.asarray(q.density(solution.x)),
        reference(H, couplings, rho, solution.t),
    )
    print(
        f"{name}: largest difference {np.abs(ours - other).max():.1e},"
        f" {solution.audit().passed=}"
    )
    ax.plot(solution.t, np.diagonal(ours, axis1=1, axis2=2).real)
    ax.set(xlabel="time", title=name)
    ax.spines[["top", "right"]].set_visible(False)
axes[0].set(ylabel="populations")
plt.show()
