"""Random systems against their vector fields in NumPy, integrated by DOP853.

The fields are written from the conventions page alone: structure constants from commutators of matrices in a random
basis, gradients by hand, each dissipation by its formula. Neither the brackets of the library nor its gradients take
part. Method, engine, dissipation, drive and kind of step are random too.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

# -- algebras ---------------------------------------------------------------------------------------------------------


def _unit(i, j, n):
    return np.outer(np.eye(n)[i], np.eye(n)[j])


def _rotations(n, size):
    return [_unit(i, j, size) - _unit(j, i, size) for i in range(n) for j in range(i)]


MATRICES = {
    "so(3)": _rotations(3, 3),
    "so(4)": _rotations(4, 4),
    "sl(2)": [_unit(0, 1, 2), _unit(1, 0, 2), np.diag([1.0, -1.0])],
    "se(3)": [*_rotations(3, 4), *(_unit(i, 3, 4) for i in range(3))],
    "heisenberg": [_unit(0, 1, 3), _unit(1, 2, 3), _unit(0, 2, 3)],
}
SEMISIMPLE = ("so(3)", "so(4)", "sl(2)")


def structure_constants(name: str, rng) -> np.ndarray:
    """Return ``C[a, b, c]`` of ``[e_a, e_b] = C[a, b, c] e_c`` in a random basis."""
    basis = np.array(MATRICES[name])
    n = len(basis)
    matrices = np.tensordot(np.eye(n) + 0.3 * rng.standard_normal((n, n)) / np.sqrt(n), basis, 1)
    columns = matrices.reshape(n, -1).T
    brackets = np.einsum("aij,bjk->abik", matrices, matrices)
    brackets = (brackets - brackets.swapaxes(0, 1)).reshape(n * n, -1)
    return np.linalg.lstsq(columns, brackets.T, rcond=None)[0].T.reshape(n, n, n)


# -- systems ----------------------------------------------------------------------------------------------------------


@dataclass
class RandomCase:
    """A system of the library, its field in NumPy, and a start."""

    system: lt.systems.System
    field: object
    start: np.ndarray
    label: str


def draw_case(seed: int) -> RandomCase:
    rng = np.random.default_rng(seed)
    name = str(rng.choice(list(MATRICES)))
    C = structure_constants(name, rng)
    n = len(C)
    root = rng.standard_normal((n, n)) / np.sqrt(n)
    A, b, c, d = root @ root.T + np.eye(n), *(0.5 * rng.standard_normal((3, n)))
    quartic, driven = 0.1 * rng.random(), bool(rng.random() < 0.3)
    amplitude, frequency = 0.2 * rng.random(), 1.0 + rng.random()

    def static_energy(x):
        return 0.5 * x @ (A @ x) + b @ x + 0.3 * jnp.cos(c @ x) + quartic * (d @ x) ** 4

    def energy(x, t):
        return static_energy(x) + amplitude * jnp.cos(frequency * t) * (c @ x)

    def dH(x, t):
        gradient = A @ x + b - 0.3 * np.sin(c @ x) * c + 4.0 * quartic * (d @ x) ** 3 * d
        return gradient + (amplitude * np.cos(frequency * t) * c if driven else 0.0)

    def tensor(x):
        return np.einsum("abc,c->ba", C, x)  # (ad*_xi mu)_b = C[a, b, c] xi_a mu_c

    kinds = ["none", "double bracket", "double bracket with a bath", "torque"]
    if name in SEMISIMPLE:
        kinds += ["killing", "projected", "inner product", "sum"]
    kind = str(rng.choice(kinds))
    if kind == "torque":
        driven = False
    casimir = np.linalg.inv(np.einsum("acd,bdc->ab", C, C)) if name in SEMISIMPLE else np.zeros((n, n))
    if name in SEMISIMPLE:
        casimir = casimir / np.abs(casimir).max()
    metric, rate, weight = _metric(rng, n), 0.1 + 0.2 * rng.random(), rng.uniform(0.5, 1.5)

    def entropy(x):
        value = 0.5 * x @ (casimir @ x)
        return weight * value + 0.5 * jnp.sin(value)

    def dS(x):
        return (weight + 0.5 * np.cos(0.5 * x @ (casimir @ x))) * (casimir @ x)

    def inner_product_force(form):
        """Return the force of ``<F, eta> = form(eta, [xi, dS])`` in the motion ``ad*_xi (mu + F)``."""

        def force(x, xi):
            F = form @ np.einsum("abc,a,b->c", C, xi, dS(x))
            return tensor(F) @ xi

        return force

    def projected_force(x, xi):
        g = metric
        return (xi @ g @ xi) * (g @ dS(x)) - (xi @ g @ dS(x)) * (g @ xi)

    def double_bracket_force(x, xi):
        return tensor(x) @ (metric @ (tensor(x) @ xi))

    killing = np.einsum("acd,bdc->ab", C, C)
    compact = np.linalg.eigvalsh(-killing)[0] > 0.0
    form = -killing if compact else metric
    options, forces = {}, []
    if kind == "killing":
        options["dissipation"] = lt.KillingDissipation(rate) if compact else lt.InnerProductDissipation(rate * form)
        forces = [(rate, inner_product_force(form))]
    elif kind == "inner product":
        options["dissipation"], forces = (
            lt.InnerProductDissipation(rate * metric),
            [(rate, inner_product_force(metric))],
        )
    elif kind == "projected":
        options["dissipation"], forces = lt.ProjectedMetric(metric, rate=rate), [(rate, projected_force)]
    elif kind == "sum":
        options["dissipation"] = lt.InnerProductDissipation(rate * metric) + lt.ProjectedMetric(metric, rate=rate)
        forces = [(rate, inner_product_force(metric)), (rate, projected_force)]
    elif kind.startswith("double"):
        options["dissipation"], forces = lt.DoubleBracket(rate, metric), [(rate, double_bracket_force)]
    if kind in ("killing", "inner product", "projected", "sum"):
        options["entropy"] = entropy
    if kind == "torque":
        options["torque"] = lambda t, mu: amplitude * (jnp.cos(frequency * t) * c - 0.5 * mu)
    bath = kind.endswith("bath")
    capacity, temperature = rng.uniform(0.5, 2.0, 2)
    if bath:
        options["baths"] = lt.HeatBaths(capacity, temperature)

    def field(t, z):
        x, xi = z[:n], dH(z[:n], t)
        rates = [r * force(x, xi) for r, force in forces]
        motion = tensor(x) @ xi + sum(rates, np.zeros(n))
        if kind == "torque":
            motion = motion + amplitude * (np.cos(frequency * t) * c - 0.5 * x)
        if not bath:
            return motion
        return np.append(motion, -xi @ rates[0] / (temperature * np.exp(z[n] / capacity)))

    g = mf.LieAlgebra.from_structure_constants(C, name="drawn")
    system = lt.LiePoissonSystem(g, energy if driven else static_energy, **options)
    start = rng.standard_normal(n)
    start *= rng.uniform(0.5, 1.0) / np.linalg.norm(start)
    return RandomCase(system, field, np.append(start, 0.0) if bath else start, f"{name}, {kind}{', driven' * driven}")


def _metric(rng, n):
    root = rng.standard_normal((n, n)) / np.sqrt(n)
    return root @ root.T + 0.5 * np.eye(n)


# -- runs -------------------------------------------------------------------------------------------------------------

TIME = 1.0
METHODS = [
    lt.MetriplecticMidpoint(),
    lt.MetriplecticMidpoint("coordinate_increment"),
    lt.MetriplecticMidpoint("mean_value"),
    lt.MetriplecticGauss(1),
    lt.MetriplecticGauss(2),
    lt.MetriplecticGauss(3),
    lt.MetriplecticRungeKutta(4),
    lt.MetriplecticRungeKutta(6),
    lt.MetriplecticRungeKutta(8),
    lt.MetriplecticTaylor(8),
]
STEPS = {1: 4000, 2: 400, 4: 100, 6: 50, 8: 40}
MAX_ERRORS = {1: 5e-4, 2: 3e-5, 4: 3e-6, 6: 1e-8, 8: 1e-9}
"""Largest relative errors over the time 1, by order; three times the largest seen."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", range(30))
def test_random_systems_follow_their_fields(seed):
    case = draw_case(seed)
    rng = np.random.default_rng(1000 + seed)
    method = METHODS[seed % len(METHODS)]
    engine = str(rng.choice(["array", "compiled"]))
    adaptive = method.order >= 4 and rng.random() < 0.4
    step = lt.Adaptive(1e-8) if adaptive else TIME / STEPS[method.order]
    reference = solve_ivp(case.field, (0.0, TIME), case.start, method="DOP853", rtol=1e-12, atol=1e-14)
    assert reference.success
    run = lt.integrate(case.system, case.start, (0.0, TIME), step, method, engine=engine)
    error = np.abs(run.x[-1] - reference.y[:, -1]).max() / np.abs(reference.y).max()
    assert error < (1e-7 if adaptive else MAX_ERRORS[method.order]), (case.label, str(method), engine, error)
    assert run.audit().passed, (case.label, str(run.audit()))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", [1, 2])
def test_control_another_field_is_seen(seed):
    """Control: with a field that is 2 % off the comparison fails."""
    case = draw_case(seed)
    reference = solve_ivp(
        lambda t, z: 1.02 * np.asarray(case.field(t, z)), (0.0, TIME), case.start, method="DOP853", rtol=1e-12
    )
    run = lt.integrate(case.system, case.start, (0.0, TIME), 0.01, lt.MetriplecticGauss(2))
    assert np.abs(run.x[-1] - reference.y[:, -1]).max() > 1e-3
