"""Property suites of Lie algebras, matrix groups and state spaces, and their report."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from .._tables import TableRow, Tabular
from ..algebras.casimirs import NoPolynomialCasimirWarning
from ..algebras.lie_algebra import LieAlgebra
from ..errors import LieAlgebraError, ManifoldsError
from ..groups.matrix_group import MatrixGroup
from ..retractions.charts import ProjectionRetraction
from ..retractions.retraction import coordinates_around
from ..spaces.base import Space


@dataclass(frozen=True)
class Report(Tabular):
    """Properties of an object with their residuals and limits. Printing it gives a table."""

    of: str
    rows: tuple[TableRow, ...]

    @property
    def passed(self) -> bool:
        return all(row.passed is not False for row in self.rows)

    def _table_content(self) -> tuple[tuple[TableRow, ...], tuple[str, str, str], str]:
        footer = "all of them hold" if self.passed else "NOT ALL OF THEM HOLD"
        return self.rows, (f"properties of {self.of}", "residual", "allowed"), footer


class PropertyError(ManifoldsError, AssertionError):
    """Raised when an object lacks a property that all of its kind have.

    Attributes
    ----------
    report : Report
    """

    def __init__(self, report: Report):
        self.report = report
        super().__init__(f"\n{report}")


class Suite:
    """Collector of the rows of a report; :meth:`report` raises PropertyError if one of them fails."""

    def __init__(self, of: str):
        self.of = of
        self.rows: list[TableRow] = []

    def check_small(self, name: str, residual, size=1.0, allowed: float = 1e-12, note: str = "") -> None:
        """Check that the largest entry of a residual is at most ``allowed``, relative to ``size``."""
        value = float(np.abs(np.asarray(residual)).max(initial=0.0)) / max(float(np.max(size)), 1e-300)
        self.rows.append(TableRow(name, value, allowed, bool(value <= allowed), note))

    def check_equal(self, name: str, a, b, allowed: float = 1e-12) -> None:
        """Check that two arrays are equal, relative to the largest of their entries and 1."""
        a, b = np.asarray(a), np.asarray(b)
        if a.shape != b.shape:
            self.check_true(name, False, f"shapes {a.shape} and {b.shape}")
            return
        scale = max(1.0, *(float(np.abs(v).max(initial=0.0)) for v in (a, b)))
        self.check_small(name, a - b, scale, allowed)

    def check_true(self, name: str, holds, note: str = "") -> None:
        """Check that a property holds."""
        self.rows.append(TableRow(name, 0.0 if holds else 1.0, 0.0, bool(holds), note))

    def skip_check(self, name: str, reason: str) -> None:
        """Record a property that is not checked for this object, with the reason."""
        self.rows.append(TableRow(name, float("nan"), None, None, reason))

    def report(self) -> Report:
        """Return the report; raise PropertyError unless every property holds."""
        report = Report(self.of, tuple(self.rows))
        if not report.passed:
            raise PropertyError(report)
        return report


BATCH_SHAPE = (4, 3)
"""Shape of the batch of random elements."""


def check_algebra(g: LieAlgebra, degree: int = 3, seed: int = 0) -> Report:
    """Check axioms, duality, forms, matrices and Casimirs of a Lie algebra at random elements.

    Parameters
    ----------
    g : LieAlgebra
        The algebra to test.
    degree : int
        Casimirs are looked for up to this degree.
    seed : int
        Seed of the random elements.

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
    _check_casimirs(suite, g, degree, mu.reshape(-1, g.dim))
    return suite.report()


def _check_casimirs(suite: Suite, g: LieAlgebra, degree: int, mu: np.ndarray) -> None:
    """Check that the Casimirs up to a degree are invariant at the points mu, and count the independent ones."""
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


BATCH_SIZE = 4
"""Number of random elements of a group, and of random points of a space."""


def check_group(G: MatrixGroup, size: float = 0.5, seed: int = 0) -> Report:
    """Check the exponential, logarithm, products and actions of a group, and that its maps stay in it.

    Parameters
    ----------
    G : MatrixGroup
        The group to test.
    size : float
        Size of the random elements of the algebra; below the radius in which the logarithm is defined.
    seed : int
        Seed of the random elements.

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


DIVERGENCE_TOLERANCE = 1e-8
"""Largest error of a divergence, compared to that by finite differences."""


def check_space(M: Space, length: float = 0.5, seed: int = 0, allowed: float = 1e-12) -> Report:
    """Check points, tangent vectors, metric and, if the space has geodesics, exponential, logarithm and transport.

    Parameters
    ----------
    M : Space
        The space to test.
    length : float
        Length of the geodesics; at most 0.45 times the injectivity radius is used.
    seed : int
        Seed of the random points.
    allowed : float
        Largest residual, relative to the squared size of the points.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    """
    suite, random = Suite(M.name), np.random.default_rng(seed)
    x = np.asarray(M.random(seed, (BATCH_SIZE,)))
    c, d = random.standard_normal((2, BATCH_SIZE, M.dim))
    u, v = (np.asarray(M.from_coordinates(x, w)) for w in (c, d))
    noise = random.standard_normal(x.shape)
    scale = max(1.0, float(np.abs(x).max())) ** 2 * max(1, M.dim)
    suite.check_true("shape and kind of random points", x.shape == (BATCH_SIZE, *M.shape) and x.dtype == M.dtype)
    suite.check_true("random points are in the space", bool(np.all(M.belongs(x))))
    suite.check_small("a point is its own projection", M.project(x) - x, scale, allowed)
    shifted = x + 0.01 * noise
    suite.check_true("projections are in the space", bool(np.all(M.belongs(M.project(shifted)))))
    if bool(np.all(M.belongs(shifted, 1e-4))):
        suite.skip_check("a point off the space is seen", "every array is a point")
    suite.check_small("to_vector, from_vector", M.from_vector(M.to_vector(x)) - x, scale, allowed)
    suite.check_small("tangent vectors are their own projections", M.project_tangent(x, u) - u, scale, allowed)
    suite.check_small("coordinates of vectors", np.asarray(M.coordinates(x, u)) - c, scale, allowed)
    frame = np.einsum("ba,ba...->b...", c, M.frame(x))
    suite.check_small("the frame spans the coordinates", frame - u, scale, allowed)
    suite.check_small("the frame is orthonormal", np.asarray(M.inner(x, u, v)) - (c * d).sum(1), scale, allowed)
    suite.check_small(
        "the metric is symmetric", np.asarray(M.inner(x, u, v)) - np.asarray(M.inner(x, v, u)), scale, allowed
    )
    suite.check_small("norms", np.asarray(M.norm(x, u)) ** 2 - np.asarray(M.inner(x, u, u)), scale, allowed)
    axes = tuple(range(-len(M.shape), 0))
    pairing = np.sum(np.asarray(M.flat(x, u)) * v, axis=axes).real
    suite.check_small("flat(u) v = <u, v>", pairing - np.asarray(M.inner(x, u, v)), scale, allowed)
    suite.check_small("sharp inverts flat", np.asarray(M.sharp(x, M.flat(x, u))) - u, scale, allowed)
    R = np.asarray(
        M.isotropic(x[:, None], np.broadcast_to(np.eye(M.isotropic_size), (BATCH_SIZE, *[M.isotropic_size] * 2)))
    )
    products = [np.asarray(M.inner(np.broadcast_to(x[:, None], R.shape), R, w[:, None])) for w in (u, v)]
    suite.check_small(
        "isotropic: R R^T inverts the metric", (products[0] * products[1]).sum(1) - (c * d).sum(1), scale, 10 * allowed
    )
    if M.has_geodesics or M._has_induced_metric:
        mixing_matrix = jnp.asarray(random.standard_normal((M.size, M.size))) / M.size

        def field(y):
            return M._project_tangent(y, M.from_vector(mixing_matrix @ jnp.tanh(M.to_vector(y))))

        residual = np.asarray(jax.jit(partial(M.divergence, field))(x[0])) - divergence_in_coordinates(M, field, x[0])
        suite.check_small("divergences are those of the volume", residual, scale, DIVERGENCE_TOLERANCE)
    if M.can_be_embedded:
        original_change, correction_change, tangent_change = _constraint_changes(M, x, noise)
        suite.check_small(
            "corrections change the equations by what is asked", correction_change - original_change, scale, allowed
        )
        suite.check_small("what is along the space changes no equation", tangent_change, scale, allowed)
    if not M.has_geodesics:
        suite.skip_check("geodesics", "the space has none of its own: its charts project")
        return suite.report()
    reach = min(length, 0.45 * M.injectivity_radius(x[0]))
    v_short = (reach / np.linalg.norm(c, axis=1)).reshape(-1, *(1,) * len(M.shape)) * u
    y = np.asarray(M.exp(x, v_short))
    scale = max(1.0, float(np.abs(x).max()), float(np.abs(y).max())) ** 2 * max(1, M.dim)
    suite.check_true("exp is in the space", bool(np.all(M.belongs(y))))
    suite.check_small("exp 0", M.exp(x, np.zeros_like(x)) - x, scale, allowed)
    suite.check_small("log inverts exp", np.asarray(M.log(x, y)) - v_short, scale, 10 * allowed)
    if M.metric == "left-invariant":
        suite.skip_check("distance and transport", "one-parameter subgroups are not the geodesics of this metric")
        return suite.report()
    suite.check_small(
        "distance is the length of the geodesic", np.asarray(M.distance(x, y)) - reach, scale, 10 * allowed
    )
    suite.check_small(
        "distance is symmetric", np.asarray(M.distance(y, x)) - np.asarray(M.distance(x, y)), scale, 10 * allowed
    )
    transported_u, transported_v = (np.asarray(M.transport(x, v_short, w)) for w in (u, v))
    suite.check_small(
        "transported vectors are tangent",
        np.asarray(M.project_tangent(y, transported_u)) - transported_u,
        scale,
        10 * allowed,
    )
    product_change = np.asarray(M.inner(y, transported_u, transported_v)) - np.asarray(M.inner(x, u, v))
    suite.check_small("transport keeps inner products", product_change, scale, 10 * allowed)
    half = np.asarray(M.exp(x, 0.5 * v_short))
    suite.check_small("midpoints", np.asarray(M.midpoint(x, y)) - half, scale, 10 * allowed)
    return suite.report()


def _constraint_changes(M: Space, x, w) -> list[np.ndarray]:
    """Return the changes of the constraints along w, along the correction by these changes, and along tangential w."""

    @jax.jit
    def changes_along_three_vectors(x, w):
        change_along = lambda v: jax.jvp(M._constraints, (x,), (v + jnp.zeros_like(x),))[1]  # noqa: E731
        return change_along(w), change_along(M._correction(x, change_along(w))), change_along(M._tangential_part(x, w))

    return [np.asarray(c) for c in changes_along_three_vectors(x, np.asarray(w, dtype=M.dtype))]


def divergence_in_coordinates(M: Space, field, x, step: float = 2e-3) -> float:
    """Return ``d(sqrt(g) X^i)/dc_i / sqrt(g)`` in coordinates around a point, by differences of order four."""
    coordinates = coordinates_around(ProjectionRetraction(M), x)

    @jax.jit
    def volume_and_weighted_components(c):
        place = coordinates.at(c)
        frame = M._frame(place.point)
        volume = 1.0 / jnp.abs(jnp.linalg.det(jax.vmap(place.lower)(frame)))
        return volume, volume * place.lower(field(place.point))

    total, axes = 0.0, step * np.eye(M.dim)
    for i, e in enumerate(axes):
        near_flux, far_flux = (
            volume_and_weighted_components(k * e)[1][i] - volume_and_weighted_components(-k * e)[1][i] for k in (1, 2)
        )
        total += float((8.0 * near_flux - far_flux) / (12.0 * step))
    return total / float(volume_and_weighted_components(np.zeros(M.dim))[0])
