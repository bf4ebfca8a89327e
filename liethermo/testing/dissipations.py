"""Property suite of dissipations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.testing import Report, Suite

from ..dissipation.base import Dissipation
from ..functions.energy import Quadratic
from ..systems import LiePoissonSystem, System
from .runs import SUITE_METHODS, check_laws_along_run, default_step, random_start


def check_dissipation(dissipation: Dissipation | System, algebra: mf.LieAlgebra | None = None, seed: int = 0) -> Report:
    """Check the laws of a dissipation at random points, with arbitrary vectors for gradients, and along runs.

    Parameters
    ----------
    dissipation : Dissipation or System
        A dissipation on the dual of a Lie algebra, or a system that contains it.
    algebra : LieAlgebra, optional
        The algebra of the test system, so(3) by default. Its energy is not quadratic, its entropy a quadratic Casimir.

    Raises
    ------
    PropertyError
        If it violates a law that it states, or changes a function that it must preserve.
    """
    system = dissipation if isinstance(dissipation, System) else _test_system(dissipation, algebra or mf.so(3))
    if system.dissipation is None:
        raise ValueError("the system has no dissipation")
    suite = Suite(f"{type(system.dissipation).__name__} in a {system.kind}")
    random = np.random.default_rng(seed)
    points = [x for x in system.samples(8, seed) if np.isfinite(np.asarray(system.vector_field(x))).all()]
    tested, max_energy_rate, min_entropy_rate, max_force = system.dissipation, 0.0, 0.0, 0.0
    for x in points:
        dH, dS, *dL = random.standard_normal((2 + len(tested.preserve), system.dim))
        if system.baths is not None and system.baths.has_positive_temperatures:
            dH[system.body_dim :] = np.abs(dH[system.body_dim :])  # no gradient has temperatures below zero
        force = np.asarray(
            tested.force(system, jnp.asarray(x), jnp.asarray(dH), jnp.asarray(dS), tuple(map(jnp.asarray, dL)))
        )
        scale = float(np.linalg.norm(force))
        max_energy_rate = max(max_energy_rate, float(abs(force @ dH) / max(scale * np.linalg.norm(dH), 1e-300)))
        min_entropy_rate = min(min_entropy_rate, float((force @ dS) / max(scale * np.linalg.norm(dS), 1e-300)))
        max_force = max(max_force, scale)
    if tested.energy_law == "conserved" and system.space is None:
        suite.check_small("any vector instead of grad H is in the kernel", max_energy_rate, 1.0, 1e-12)
    if tested.entropy_law == "nondecreasing" and tested.energy_law == "conserved" and system.space is None:
        suite.check_small("the entropy cannot fall, whatever the vectors", min(min_entropy_rate, 0.0), 1.0, 1e-12)
    suite.check_true("it acts", max_force > 0.0)
    suite.rows += system.check(seed=seed).rows
    x0 = random_start(system, seed)
    h = default_step(system, x0)
    for method in SUITE_METHODS:
        check_laws_along_run(suite, system, method, x0, h, f"{method}: ")
    return suite.report()


def _test_system(dissipation: Dissipation, g: mf.LieAlgebra) -> LiePoissonSystem:
    quadratic = g.casimirs(2)
    if not quadratic:
        raise ValueError(f"{g.name} has no quadratic Casimir: give a system that has the dissipation")
    weights = np.linspace(1.0, 2.0, g.dim)

    def energy(mu):
        return 0.5 * jnp.sum(weights * mu * mu) + 0.1 * jnp.cos(mu[0] + 0.5 * mu[-1])

    entropy = np.sum([jax.hessian(F)(jnp.zeros(g.dim)) for F in quadratic], axis=0)
    return LiePoissonSystem(g, energy, Quadratic(entropy), dissipation)
