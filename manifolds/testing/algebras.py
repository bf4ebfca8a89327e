"""Property suite of Lie algebras."""

from __future__ import annotations

import warnings

import jax
import numpy as np

from ..algebras.casimirs import NoPolynomialCasimirWarning
from ..algebras.lie_algebra import LieAlgebra
from ..errors import LieAlgebraError
from .report import Report, Suite

BATCH_SHAPE = (4, 3)
"""Shape of the batch of random elements."""


def check_algebra(g: LieAlgebra, degree: int = 3, seed: int = 0) -> Report:
    """Check axioms, duality, forms, matrices and Casimirs of a Lie algebra at random elements.

    Parameters
    ----------
    g : LieAlgebra
    degree : int
        Casimirs are looked for up to this degree.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    """
    suite, random = Suite(g.name), np.random.default_rng(seed)
    x, y, z, mu = random.standard_normal((4, *BATCH_SHAPE, g.dim))
    unit = max(1.0, float(np.abs(g.structure_constants).max()))
    bracket = g.bracket
    suite.check_small("[x, y] = -[y, x]", bracket(x, y) + bracket(y, x), unit)
    jacobi = bracket(bracket(x, y), z) + bracket(bracket(y, z), x) + bracket(bracket(z, x), y)
    suite.check_small("Jacobi", jacobi, 100 * unit**2)
    adx, ady = g.ad(x), g.ad(y)
    suite.check_small("ad(x) y = [x, y]", np.einsum("...ab,...b->...a", adx, y) - bracket(x, y), 10 * unit)
    suite.check_small("ad [x, y] = [ad x, ad y]", g.ad(bracket(x, y)) - (adx @ ady - ady @ adx), 100 * unit**2)
    dual = (np.asarray(g.ad_star(x, mu)) * y).sum(-1) - (mu * np.asarray(bracket(x, y))).sum(-1)
    suite.check_small("<ad*_x mu, y> = <mu, [x, y]>", dual, 100 * unit)
    kappa = g.killing_form()
    traces = np.einsum("acd,bdc->ab", g.structure_constants, g.structure_constants)
    suite.check_equal("Killing form = tr(ad ad)", kappa, traces)
    form = np.einsum("...a,ab,...b->...", bracket(x, y), kappa, z)
    cyclic_form = np.einsum("...a,ab,...b->...", x, kappa, bracket(y, z))
    suite.check_small("Killing form is invariant", form - cyclic_form, 100 * unit * max(1.0, np.abs(kappa).max()))
    single_bracket = np.asarray(bracket(x[2, 1], y[2, 1]))
    suite.check_small("batches equal loops", np.asarray(bracket(x, y))[2, 1] - single_bracket, 10 * unit)
    suite.check_small("vmap equals batches", jax.vmap(jax.vmap(bracket))(x, y) - bracket(x, y), 10 * unit)
    if g.basis is None:
        suite.skip_check("matrices", "the algebra has none")
    else:
        X, Y = g.hat(x), g.hat(y)
        scale = max(1.0, float(np.abs(X).max())) ** 2 * g.dim
        suite.check_small("hat [x, y] = [hat x, hat y]", g.hat(bracket(x, y)) - (X @ Y - Y @ X), 10 * scale)
        suite.check_small("vee hat x = x", g.vee(X) - x, 10 * scale)
    if g.is_semisimple():
        theta = g.cartan_involution()
        suite.check_equal("Cartan involution: theta^2 = 1", theta @ theta, np.eye(g.dim), 1e-9)
        automorphism_residual = bracket(x @ theta.T, y @ theta.T) - np.asarray(bracket(x, y)) @ theta.T
        suite.check_small(
            "Cartan involution: automorphism", automorphism_residual, 100 * unit * np.abs(theta).max() ** 2, 1e-9
        )
        suite.check_true("Cartan involution: -kappa(x, theta x) > 0", np.linalg.eigvalsh(-kappa @ theta)[0] > 0.0)
    _casimirs(suite, g, degree, mu.reshape(-1, g.dim))
    return suite.report()


def _casimirs(suite: Suite, g: LieAlgebra, degree: int, mu: np.ndarray) -> None:
    gradients = []
    for d in range(1, degree + 1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NoPolynomialCasimirWarning)
            try:
                polynomials = g.casimirs(d)
            except LieAlgebraError as error:
                suite.skip_check(f"Casimirs of degree {d}", str(error))
                continue
        for F in polynomials:
            gradient = np.asarray(jax.vmap(jax.grad(F))(mu))
            scale = np.linalg.norm(gradient, axis=1) * np.linalg.norm(mu, axis=1)
            residual = np.linalg.norm(g.ad_star(gradient, mu), axis=1) / np.where(scale > 0.0, scale, 1.0)
            unit = max(1.0, float(np.abs(g.structure_constants).max()))
            suite.check_small(f"Casimir {str(F)[:40]}", residual, unit)
            gradients.append(gradient[0])
    count = g.casimir_count()
    rank = np.linalg.matrix_rank(np.array(gradients), tol=1e-6) if gradients else 0
    suite.check_true("as many independent Casimirs as are counted, or fewer", rank <= count, f"{rank} of {count}")
