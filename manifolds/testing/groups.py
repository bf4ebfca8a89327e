"""Property suite of matrix groups."""

from __future__ import annotations

import numpy as np

from ..errors import LieAlgebraError
from ..groups.matrix_group import MatrixGroup
from .report import Report, Suite

BATCH_SIZE = 4
"""Number of random elements."""


def check_group(G: MatrixGroup, size: float = 0.5, seed: int = 0) -> Report:
    """Check the exponential, logarithm, products and actions of a group, and that its maps stay in it.

    Parameters
    ----------
    G : MatrixGroup
    size : float
        Size of the random elements of the algebra; below the radius in which the logarithm is defined.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    """
    suite, random, g = Suite(G.name), np.random.default_rng(seed), G.algebra
    x, y, z = size * random.standard_normal((3, BATCH_SIZE, g.dim)) / np.sqrt(g.dim)
    mu = random.standard_normal((BATCH_SIZE, g.dim))
    a, b, c = G.exp(x), G.exp(y), G.exp(z)
    identity = np.broadcast_to(np.asarray(G.identity), np.shape(a))
    for name, element in {
        "exp x": a,
        "a b": G.compose(a, b),
        "a^-1": G.inverse(a),
        "random": G.random(seed, (3,)),
    }.items():
        suite.check_true(f"{name} is in the group", bool(np.all(G.belongs(element))))
    if any(row.passed is False for row in suite.rows):  # the other maps refuse what is not in the group
        return suite.report()
    suite.check_equal("exp 0 = 1", G.exp(np.zeros(g.dim)), G.identity)
    suite.check_equal("log exp x = x", G.log(a), x, 1e-11)
    suite.check_equal("exp(0.3 x) exp(0.7 x) = exp x", G.compose(G.exp(0.3 * x), G.exp(0.7 * x)), a)
    suite.check_equal("a a^-1 = 1", G.compose(a, G.inverse(a)), identity)
    suite.check_equal("(a b) c = a (b c)", G.compose(G.compose(a, b), c), G.compose(a, G.compose(b, c)))
    conjugate = a @ g.hat(z) @ G.inverse(a)
    adjoint_z = np.einsum("...ab,...b->...a", G.Ad(a), z)
    suite.check_equal("hat(Ad_a z) = a hat(z) a^-1", adjoint_z, g.vee(conjugate), 1e-11)
    suite.check_equal("Ad(a b) = Ad(a) Ad(b)", G.Ad(G.compose(a, b)), G.Ad(a) @ G.Ad(b), 1e-11)
    pairing = (np.asarray(G.Ad_star(a, mu)) * z).sum(-1)
    suite.check_equal("<Ad*_a mu, z> = <mu, Ad_a z>", pairing, (mu * adjoint_z).sum(-1), 1e-11)
    h = 1e-4
    rate = (G.Ad_star(G.exp(h * x), mu) - G.Ad_star(G.exp(-h * x), mu)) / (2 * h)
    suite.check_equal("d/dt Ad*_exp(tx) mu = ad*_x mu", rate, g.ad_star(x, mu), 1e-6)
    sizes = np.array([0.2, 0.1])
    u, v = x[:1] * sizes[:, None] / size, y[:1] * sizes[:, None] / size
    remainder = G.log(G.compose(G.exp(u), G.exp(v))) - (u + v + g.bracket(u, v) / 2)
    residuals = np.abs(np.asarray(remainder)).max(axis=-1)
    is_third_order = residuals[1] <= max(residuals[0] / 5.0, 1e-12)  # of third order: a factor of 8
    suite.check_true("exp u exp v = exp(u + v + [u, v]/2 + third order)", is_third_order)
    for kind in ("cayley", "adjoint_cayley"):
        if (defect := G.map_defect(kind)) > 1e-10:
            suite.skip_check(f"the {kind} map", f"leaves the group by {defect:.1g}, so that it is not used")
    try:
        suite.check_equal("inverse Cayley of Cayley", G.inverse_cayley(G.cayley(x)), x, 1e-11)
    except LieAlgebraError as error:
        suite.skip_check("inverse Cayley of Cayley", str(error)[:60])
    return suite.report()
