"""The suite of dissipations."""

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
    """The laws of a dissipation: for discrete gradients instead of gradients, at points, and along runs.

    Parameters
    ----------
    dissipation : Dissipation or System
        One that acts on the dual of a Lie algebra, or a system that has it.
    algebra : LieAlgebra, optional
        Where it is tried, so(3) by default; with an energy that is not quadratic, and a quadratic Casimir for entropy.

    Raises
    ------
    PropertyError
        If it does not keep what it states: its laws, the functions that it has to preserve.
    """
    system = dissipation if isinstance(dissipation, System) else _test_system(dissipation, algebra or mf.so(3))
    if system.dissipation is None:
        raise ValueError("the system has no dissipation")
    suite = Suite(f"{type(system.dissipation).__name__} in a {system.kind}")
    random = np.random.default_rng(seed)
    points = [x for x in system.samples(8, seed) if np.isfinite(np.asarray(system.vector_field(x))).all()]
    acting, lost, made, size = system.dissipation, 0.0, 0.0, 0.0
    for x in points:
        dH, dS, *dL = random.standard_normal((2 + len(acting.preserve), system.dim))
        if system.baths is not None and system.baths.has_positive_temperatures:
            dH[system.body_dim :] = np.abs(dH[system.body_dim :])  # no gradient has temperatures below zero
        force = np.asarray(
            acting.force(system, jnp.asarray(x), jnp.asarray(dH), jnp.asarray(dS), tuple(map(jnp.asarray, dL)))
        )
        scale = float(np.linalg.norm(force))
        lost = max(lost, float(abs(force @ dH) / max(scale * np.linalg.norm(dH), 1e-300)))
        made = min(made, float((force @ dS) / max(scale * np.linalg.norm(dS), 1e-300)))
        size = max(size, scale)
    if acting.energy_law == "conserved" and system.space is None:
        suite.check_small("any vector instead of grad H is in the kernel", lost, 1.0, 1e-12)
    if acting.entropy_law == "nondecreasing" and acting.energy_law == "conserved" and system.space is None:
        suite.check_small("the entropy cannot fall, whatever the vectors", min(made, 0.0), 1.0, 1e-12)
    suite.check_true("it acts", size > 0.0)
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
