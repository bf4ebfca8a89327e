"""State spaces: every registered one passes the property tests and agrees with geomstats; the cut locus; refusals.

geomstats, an implementation by other people, is the reference for exponential, logarithm, distance and transport.
"""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

import geomstats.geometry.euclidean as gs_euclidean
import geomstats.geometry.full_rank_correlation_matrices as gs_correlation
import geomstats.geometry.grassmannian as gs_grassmannian
import geomstats.geometry.hyperboloid as gs_hyperboloid
import geomstats.geometry.hypersphere as gs_hypersphere
import geomstats.geometry.nfold_manifold as gs_nfold
import geomstats.geometry.product_manifold as gs_product
import geomstats.geometry.spd_matrices as gs_spd
import geomstats.geometry.special_euclidean as gs_se
import geomstats.geometry.special_orthogonal as gs_so
import geomstats.geometry.stiefel as gs_stiefel
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf
from liethermo.tracing.scalarize import scalarize
from tests.cases import max_abs

TOLERANCES = {
    # name: (bound, what was measured and why)
    "member": (3e-15, "relative residual of a computed point; at most 9e-16 seen"),
    "exact": (1e-14, "results of order one; at most 4e-15 seen, roundings of a distance near pi"),
    "hyperbolic": (4e-14, "times cosh(distance from the apex)^2, as for all coordinates there; at most 8e-15 seen"),
    "spd": (4e-14, "entries up to 20, and products of five such matrices; at most 1e-14 seen"),
    "correlation": (3e-15, "times the condition number; at most 4e-16 seen in 1200 points"),
    "grassmann": (1e-13, "angles up to 81 degrees, whose tangents amplify; at most 3e-14 seen"),
    "oracle": (5e-14, "against geomstats, a few times its own roundings; at most 1e-14 seen"),
    "oracle_log": (1e-11, "against geomstats where its logarithm iterates, to 1e-13"),
    "ladder": (1e-6, "against two pole ladders of geomstats, extrapolated; at most 3e-7 seen"),
    "cut": (5e-15, "times 1 / distance from the cut locus; at most 1e-15 seen"),
    "derivative": (2e-14, "first and second derivatives of log(exp(c)) = c; at most 4e-15 seen"),
    "drift": (2e-15, "relative residual after 10^5 steps, as after one; at most 9e-16 seen"),
}

seeds = st.integers(0, 10**6)
BATCH_SIZE = 3
SLOW_SPACE_NAMES = (
    "S^1",
    "S^3",
    "SO(4)",
    "SU(2)",
    "SU(3)",
    "SE(2)",
    "SE(3)",
    "St(4, 2)",
    "SO(3) x R^3",
    "Heisenberg(1)",
    "SL(2)",
    "Corr(3)",
    "Fl(1, 1, 2)",
    "T S^2",
)
"""Spaces whose tests are all slow: together they compile for more than a minute."""

FACTORWISE_SPACES = (mf.Product, mf.Power, mf.SpecialEuclidean)
"""Spaces that bound each factor by itself, so that a step may be longer than the injectivity radius."""


def space_param(space, is_slow=False):
    return pytest.param(space, id=space.name, marks=[pytest.mark.slow] if is_slow else [])


SPACES = [space_param(space, is_slow=space.name in SLOW_SPACE_NAMES) for space in mf.registered_spaces()]


def is_close(a, b, name="exact", scale=1.0) -> bool:
    return max_abs(np.asarray(a) - np.asarray(b)) <= TOLERANCES[name][0] * scale


NAME_PART_BY_TOLERANCE = {"spd": "SPD", "grassmann": "Gr("}
"""Part of the name of the spaces that have a tolerance of their own."""


def tolerance_and_scale(space, *points) -> tuple[str, float]:
    """Return the name of the tolerance that holds in a space, and its scale for these points."""
    if "H^" in space.name:
        return "hyperbolic", max(max_abs(np.asarray(x)[..., 0]) for x in points) ** 2
    if space.name == "SL(2)":  # the condition number of such a matrix
        return "exact", max(max_abs(x) for x in points) ** 2
    if "Corr" in space.name:  # coordinates are entries of a Cholesky factor over its diagonal: eps / L_ii^2
        return "correlation", max(max_abs(np.linalg.cond(x)) for x in points)
    return next(
        (name, 1.0) for name in ("spd", "grassmann", "exact") if NAME_PART_BY_TOLERANCE.get(name, "") in space.name
    )


def random_points(space, seed):
    """Return random points as NumPy arrays, since JAX would compile each operation anew for each shape."""
    return np.asarray(space.random(seed, (BATCH_SIZE,)))


def unit_vectors(space, seed, x):
    """Return random unit tangent vectors at x."""
    c = np.random.default_rng(seed).standard_normal((BATCH_SIZE, space.dim))
    return np.asarray(space.from_coordinates(x, c / np.linalg.norm(c, axis=1, keepdims=True)))


def pairing(space, alpha, v):
    return np.sum(np.asarray(alpha) * np.asarray(v), axis=tuple(range(-len(space.shape), 0))).real


def ambient_arrays(space, seed):
    real, imaginary = np.random.default_rng(seed).standard_normal((2, BATCH_SIZE, *space.shape))
    return real + 1j * imaginary if space.dtype.kind == "c" else real


def skip_without_geodesics(space):
    if not space.has_geodesics:
        pytest.skip(f"{space.name} has no geodesics in closed form")


@pytest.fixture(scope="module", params=SPACES)
def S(request):
    """Return each registered space; with module scope pytest runs all tests of one space together, on its compiled
    maps."""
    return request.param


# -- every registered space: points, vectors, metric ------------------------------------------------------------------


@pytest.mark.sampled(1)
@given(seed=seeds)
def test_points(S, seed):
    x = random_points(S, seed)
    assert x.shape == (BATCH_SIZE, *S.shape)
    assert x.dtype == S.dtype
    assert bool(S.belongs(x, TOLERANCES["member"][0]).all())
    assert is_close(S.project(x), x)
    shifted = x + 0.01 * ambient_arrays(S, seed)
    projections = np.asarray(S.project(shifted))
    assert bool(S.belongs(projections, TOLERANCES["member"][0]).all())
    assert max_abs(projections - x) < 0.1 * np.sqrt(np.prod(S.shape)) * max(1.0, max_abs(x))
    assert np.array_equal(S.point(shifted, project=True), projections)
    if not isinstance(S, mf.Euclidean):  # control: the residual sees the way off
        assert not bool(S.belongs(shifted, 1e-4).all())


@pytest.mark.sampled(2)
@given(seed=seeds)
def test_tangent_vectors(S, seed):
    x, w = random_points(S, seed), ambient_arrays(S, seed)
    c = np.random.default_rng(seed).standard_normal((BATCH_SIZE, S.dim))
    v = np.asarray(S.from_coordinates(x, c))
    tolerance = tolerance_and_scale(S, x)
    assert is_close(S.project_tangent(x, v), v, *tolerance)
    assert is_close(S.coordinates(x, v), c, *tolerance)
    assert is_close(S.from_coordinates(x, S.coordinates(x, v)), v, *tolerance)
    assert is_close(np.einsum("ba,ba...->b...", c, S.frame(x)), v, *tolerance)
    tangent_part = np.asarray(S.project_tangent(x, w))  # orthogonally, in the ambient space
    assert is_close(pairing(S, np.conj(w - tangent_part), v), 0.0, tolerance[0], tolerance[1] * max_abs(v))
    assert is_close(S.project_tangent(x, tangent_part), tangent_part, *tolerance)


@pytest.mark.sampled(2)
@given(seed=seeds)
def test_metric(S, seed):
    x, alpha = random_points(S, seed), ambient_arrays(S, seed)
    c, d = np.random.default_rng(seed).standard_normal((2, BATCH_SIZE, S.dim))
    u, v = np.asarray(S.from_coordinates(x, c)), S.from_coordinates(x, d)
    name, scale = tolerance_and_scale(S, x)
    scale *= S.dim
    assert is_close(S.inner(x, u, v), (c * d).sum(axis=1), name, scale)  # the frame is orthonormal
    assert is_close(S.norm(x, u), np.linalg.norm(c, axis=1), name, scale)
    assert is_close(pairing(S, S.flat(x, u), v), S.inner(x, u, v), name, scale)
    assert is_close(S.sharp(x, S.flat(x, u)), u, name, scale)
    size = max(1.0, max_abs(x)) ** 2
    assert is_close(S.inner(x, S.sharp(x, alpha), v), pairing(S, alpha, v), name, scale * size)


# -- every registered space: geodesics --------------------------------------------------------------------------------


def geodesic_lengths(space):
    return (1e-3, 0.5, 0.9 * min(space.injectivity_radius(), 3.0))


@pytest.mark.sampled(1)
@given(seed=seeds)
def test_exp_and_log(S, seed):
    skip_without_geodesics(S)
    x = random_points(S, seed)
    direction = unit_vectors(S, seed + 1, x)
    for length in geodesic_lengths(S):
        v = length * direction
        y = np.asarray(S.exp(x, v))
        tolerance = tolerance_and_scale(S, x, y)
        assert bool(S.belongs(y, TOLERANCES["member"][0]).all())
        assert is_close(S.coordinates(x, np.asarray(S.log(x, y)) - v), 0.0, *tolerance)
        assert is_close(S.distance(x, y), length, *tolerance)
        assert is_close(S.distance(y, x), length, *tolerance)
        has_other_reach = isinstance(S, FACTORWISE_SPACES) or S.metric == "left-invariant"
        assert has_other_reach or is_close(S.reach(x, v), length / S.injectivity_radius(), *tolerance)
    assert is_close(S.exp(x, np.zeros_like(x)), x, *tolerance_and_scale(S, x))
    assert max_abs(S.distance(x, x)) < 1e-14


@pytest.mark.sampled(4)
@given(seed=seeds)
def test_parallel_transport(S, seed):
    skip_without_geodesics(S)
    x = random_points(S, seed)
    u, w = unit_vectors(S, seed + 1, x), unit_vectors(S, seed + 2, x)
    for length in geodesic_lengths(S):
        v = length * unit_vectors(S, seed + 3, x)
        y = np.asarray(S.exp(x, v))
        tu, tw, tv = (np.asarray(S.transport(x, v, a)) for a in (u, w, v))
        minus_tv = -tv
        tolerance = tolerance_and_scale(S, x, y)
        assert is_close(S.project_tangent(y, tu), tu, *tolerance)
        assert is_close(S.inner(y, tu, tw), S.inner(x, u, w), *tolerance)
        assert is_close(
            S.coordinates(y, np.asarray(S.log(y, x)) - minus_tv), 0.0, *tolerance
        )  # it transports its velocity
        u_again = np.asarray(S.transport(y, minus_tv, tu))
        assert is_close(S.coordinates(x, u_again - u), 0.0, tolerance[0], 4 * tolerance[1] ** 2)
        half = S.exp(x, 0.5 * v)
        tu_in_two_steps = S.transport(half, 0.5 * np.asarray(S.transport(x, 0.5 * v, v)), S.transport(x, 0.5 * v, u))
        assert is_close(tu_in_two_steps, tu, tolerance[0], 4 * tolerance[1] ** 2)


@pytest.mark.sampled(4)
@given(seed=seeds)
def test_midpoints(S, seed):
    skip_without_geodesics(S)
    x = random_points(S, seed)
    for length in geodesic_lengths(S)[1:]:
        v = length * unit_vectors(S, seed + 1, x)
        y = S.exp(x, v)
        z, tolerance = S.midpoint(x, y), tolerance_and_scale(S, x, y)
        assert is_close(z, S.exp(x, 0.5 * v), *tolerance)
        assert is_close(z, S.midpoint(y, x), *tolerance)


# -- geomstats as the oracle ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Twin:
    """Geomstats manifold with the points, and up to a factor the metric, of a native space."""

    build: Callable
    scale: float = 1.0  # its metric over the native one
    transport: str = "closed form"  # or how else it is to be had


def correlation_twin():
    space = gs_correlation.FullRankCorrelationMatrices(3, equip=False)
    space.equip_with_metric(gs_correlation.EuclideanCholeskyMetric)
    return space


def tight_stiefel_twin():
    space = gs_stiefel.Stiefel(4, 2)
    space.metric.log_solver.tol = 1e-13  # 1e-8 by default
    return space


TWINS = {
    "R^3": Twin(lambda: gs_euclidean.Euclidean(3)),
    "S^1": Twin(lambda: gs_hypersphere.Hypersphere(1)),
    "S^2": Twin(lambda: gs_hypersphere.Hypersphere(2)),
    "S^3": Twin(lambda: gs_hypersphere.Hypersphere(3)),
    "H^2": Twin(lambda: gs_hyperboloid.Hyperboloid(2)),
    "SO(3)": Twin(lambda: gs_so.SpecialOrthogonal(3)),
    "SO(4)": Twin(lambda: gs_so.SpecialOrthogonal(4)),
    "SE(2)": Twin(lambda: gs_se.SpecialEuclidean(2), scale=np.nan),  # its metric is that of the length sqrt(2): below
    "SE(3)": Twin(lambda: gs_se.SpecialEuclidean(3), scale=np.nan),
    "SPD(3)": Twin(lambda: gs_spd.SPDMatrices(3)),
    "St(4, 2)": Twin(tight_stiefel_twin, transport="ladder"),
    "Gr(3, 1)": Twin(lambda: gs_grassmannian.Grassmannian(3, 1)),
    "Gr(4, 2)": Twin(lambda: gs_grassmannian.Grassmannian(4, 2)),
    "Corr(3)": Twin(correlation_twin),
    "Oblique(3, 2)": Twin(lambda: gs_nfold.NFoldManifold(gs_hypersphere.Hypersphere(2), 2), transport="none"),
    "(S^2)^4": Twin(lambda: gs_nfold.NFoldManifold(gs_hypersphere.Hypersphere(2), 4), transport="none"),
    "S^2 x R^3": Twin(
        lambda: gs_product.ProductManifold((gs_hypersphere.Hypersphere(2), gs_euclidean.Euclidean(3))),
        transport="none",
    ),
    "SO(3) x R^3": Twin(
        lambda: gs_product.ProductManifold((gs_so.SpecialOrthogonal(3), gs_euclidean.Euclidean(3))), transport="none"
    ),
}
"""Twin of each registered space, by name."""

REASON_FOR_NO_TWIN = {
    "R^2 x 2": "as R^3",
    "SU(2)": "geomstats has no SU(n): compared with the sphere S^3 below",
    "SU(3)": "geomstats has no SU(n): compared with its totally geodesic subgroup SO(3) below",
    "Heisenberg(1)": "its exponential is that of the group, with a test suite of its own",
    "SL(2)": "likewise",
    "Fl(1, 1, 2)": "geomstats has no flags: see test_homogeneous for what has other names",
    "level set": "geomstats has none of one's own: see test_level_set for a sphere as one",
    "T S^2": "it stands for phase spaces: see test_configurations for the motions on them",
}
"""Reason why a registered space has no twin."""


def test_every_space_has_a_twin_or_a_reason():
    names = {space.name for space in mf.registered_spaces()}
    missing, extra = names - set(TWINS) - set(REASON_FOR_NO_TWIN), (set(TWINS) | set(REASON_FOR_NO_TWIN)) - names
    assert not missing, f"add the space of geomstats to TWINS, or a reason to REASON_FOR_NO_TWIN: {sorted(missing)}"
    assert not extra, f"no such space is registered: {sorted(extra)}"


@pytest.mark.sampled(4)
def test_geomstats_agrees(S):
    if S.name not in TWINS:
        pytest.skip(REASON_FOR_NO_TWIN.get(S.name, "it is in neither list, which another test reports"))
    twin = TWINS[S.name]
    twin_space = twin.build()
    x, name = random_points(S, 7), "oracle_log" if S.name.startswith("St") else "oracle"
    u = unit_vectors(S, 8, x)

    def theirs(a):  # their products of spaces with points of equal shape stack them
        return np.asarray(a).reshape(BATCH_SIZE, *twin_space.shape)

    def ours(a):
        return np.asarray(a).reshape(BATCH_SIZE, *S.shape)

    for length in (0.1, 0.7 * min(S.injectivity_radius(), 3.0)):
        v = length * unit_vectors(S, 9, x)
        y = np.asarray(S.exp(x, v))
        a, b, c, d = map(theirs, (x, y, u, v))
        scale = tolerance_and_scale(S, x, y)[1] * max(1.0, max_abs(y)) ** 2
        assert is_close(y, ours(twin_space.metric.exp(d, a)), "oracle", scale)
        assert is_close(S.log(x, y), ours(twin_space.metric.log(b, a)), name, scale)
        if np.isfinite(twin.scale):
            assert is_close(S.distance(x, y) * np.sqrt(twin.scale), twin_space.metric.dist(a, b), name, scale)
            inner = S.inner(x, u, v)
            assert is_close(inner * twin.scale, twin_space.metric.inner_product(c, d, a), "oracle", scale)
        if twin.transport == "closed form":
            assert is_close(
                S.transport(x, v, u), twin_space.metric.parallel_transport(c, a, direction=d), "oracle", scale
            )
    if twin.transport == "ladder":
        v = 0.25 * v

        def ladder(rungs):
            result = twin_space.metric.ladder_parallel_transport(u[0], x[0], v[0], n_rungs=rungs, alpha=2)
            return result["transported_tangent_vec"]

        coarse, fine, exact = ladder(8), ladder(16), S.transport(x, v, u)[0]
        assert is_close((4 * fine - coarse) / 3, exact, "ladder")
        assert not is_close(fine, exact, "ladder")  # control: the extrapolation is needed


@pytest.mark.slow
def test_rigid_motions_with_the_metric_of_geomstats():
    """The Frobenius product is twice the native metric, if a length sqrt(2) counts as one radian."""
    S, twin_space = mf.SpecialEuclidean(2, 2**0.5), gs_se.SpecialEuclidean(2)
    x, y = random_points(S, 1), random_points(S, 2)
    assert is_close(S.distance(x, y) * 2**0.5, twin_space.metric.dist(x, y), "oracle")


@pytest.mark.slow
def test_su2_is_a_sphere_of_radius_two():
    S, sphere = mf.SpecialUnitary(2), mf.Sphere(3)

    def matrix(q):
        a, b = q[..., 0] + 1j * q[..., 1], q[..., 2] + 1j * q[..., 3]
        return np.stack([np.stack([a, b], -1), np.stack([-b.conj(), a.conj()], -1)], -2)

    q = random_points(sphere, 3)
    u = unit_vectors(sphere, 4, q)
    for length in (0.1, 2.5):
        v = length * unit_vectors(sphere, 5, q)
        y = np.asarray(sphere.exp(q, v))
        assert is_close(S.exp(matrix(q), matrix(v)), matrix(y))
        assert is_close(S.log(matrix(q), matrix(y)), matrix(v))
        assert is_close(S.distance(matrix(q), matrix(y)), 2 * length)
        assert is_close(S.inner(matrix(q), matrix(u), matrix(v)), 4 * sphere.inner(q, u, v))
        assert is_close(S.transport(matrix(q), matrix(v), matrix(u)), matrix(np.asarray(sphere.transport(q, v, u))))


@pytest.mark.slow
def test_so3_is_totally_geodesic_in_su3():
    S, real = mf.SpecialUnitary(3), mf.SpecialOrthogonal(3)
    x = random_points(real, 3)
    u, v = unit_vectors(real, 4, x), 2.5 * unit_vectors(real, 5, x)
    y = np.asarray(real.exp(x, v))
    assert is_close(S.exp(x, v), y)
    assert is_close(S.log(x, y), v)
    assert is_close(S.inner(x, u, v), 4 * real.inner(x, u, v))
    assert is_close(S.transport(x, v, u), real.transport(x, v, u))


@pytest.mark.slow
def test_stiefel_in_brief():
    """A short test, because the full suite on St(4, 2) is slow."""
    S, twin_space = mf.Stiefel(3, 2), gs_stiefel.Stiefel(3, 2)
    x = random_points(S, 1)
    v = 2.0 * unit_vectors(S, 2, x)
    y = np.asarray(S.exp(x, v))
    assert is_close(y, twin_space.metric.exp(v, x))
    assert is_close(S.log(x, y), v)
    assert is_close(S.norm(x, v), 2.0)


@pytest.mark.slow
def test_a_stiefel_manifold_of_single_columns_is_a_sphere():
    S, sphere = mf.Stiefel(3, 1), mf.Sphere(2)
    x = random_points(sphere, 3)
    u, v = unit_vectors(sphere, 4, x), 2.9 * unit_vectors(sphere, 5, x)
    y = np.asarray(sphere.exp(x, v))
    assert is_close(S.exp(x[..., None], v[..., None]), y[..., None])
    assert is_close(S.log(x[..., None], y[..., None]), v[..., None], "cut", 5.0)
    assert is_close(
        S.transport(x[..., None], v[..., None], u[..., None]), np.asarray(sphere.transport(x, v, u))[..., None]
    )


# -- accuracy where formulas break down -------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "space",
    [space_param(mf.Sphere(2)), space_param(mf.SpecialOrthogonal(3)), space_param(mf.SpecialUnitary(2), is_slow=True)],
)
def test_just_inside_the_cut_locus(space):
    """The direction is known to a rounding of the points over their distance from the cut locus; exp(log) is exact."""
    x = random_points(space, 11)
    for gap in (1e-1, 1e-3, 1e-5, 1e-7):
        v = (space.injectivity_radius() - gap) * unit_vectors(space, 12, x)
        y = np.asarray(space.exp(x, v))
        log = np.asarray(space.log(x, y))
        assert is_close(log, v, "cut", 1 / gap)
        assert is_close(space.norm(x, log), space.injectivity_radius() - gap, "exact")
        assert is_close(space.exp(x, log), y)
        assert is_close(space.distance(x, y), space.injectivity_radius() - gap)


def test_distant_positive_definite_matrices():
    space = mf.SPD(3)
    x = random_points(space, 15)
    for factor in (1e-10, 1e10):  # logarithms with entries up to 60
        assert is_close(space.log(x, factor * x), np.log(factor) * x, "spd", scale=3.0)
        assert is_close(space.distance(x, factor * x), 3**0.5 * abs(np.log(factor)), "spd", scale=3.0)


def test_neighbours_keep_their_relative_accuracy():
    """The chord is exact, and no cancellation follows."""
    for space in (mf.Sphere(2), mf.Hyperbolic(2), mf.Euclidean(3)):
        x = random_points(space, 13) if space.name != "H^2" else np.tile([1.0, 0.0, 0.0], (BATCH_SIZE, 1))
        y = np.asarray(space.exp(x, 1e-8 * unit_vectors(space, 14, x)))
        chord = np.linalg.norm(y - x, axis=1)  # of what rounding has made of y
        assert np.abs(np.asarray(space.distance(x, y)) / chord - 1).max() < 1e-15
        assert np.abs(np.asarray(space.norm(x, space.log(x, y))) / chord - 1).max() < 1e-15


@pytest.mark.parametrize("space", [space_param(space, is_slow=True) for space in mf.registered_spaces()])
def test_derivatives_at_zero_and_elsewhere(space):
    """``c -> log(exp(c))`` is the identity: its first derivative is I and its second 0, forward and reverse."""
    skip_without_geodesics(space)
    x = space.random(21)

    def round_trip(c):
        y = space.exp(x, space.from_coordinates(x, c))
        return space.coordinates(x, space.log(x, y))

    first_derivative, reverse_derivative = jax.jit(jax.jacfwd(round_trip)), jax.jit(jax.jacrev(round_trip))
    second_derivative = jax.jit(jax.jacfwd(jax.jacfwd(round_trip)))
    for c in (np.zeros(space.dim), 0.4 * np.random.default_rng(1).standard_normal(space.dim)):
        assert is_close(first_derivative(c), np.eye(space.dim), "derivative")
        assert is_close(reverse_derivative(c), np.eye(space.dim), "derivative")
        assert is_close(second_derivative(c), 0.0, "derivative")


@pytest.mark.parametrize(
    "space",
    [
        space_param(mf.Sphere(2)),
        *(
            space_param(space, is_slow=True)
            for space in (
                mf.SpecialOrthogonal(3),
                mf.SpecialEuclidean(3),
                mf.SpecialUnitary(2),
                mf.Stiefel(4, 2),
            )
        ),
    ],
)
def test_points_do_not_drift_off(space):
    """Each step returns to the space to rounding; without that Newton step a formula would add up its errors."""
    steps = 100_000

    def run(exp):
        def step(x, key):
            c = 0.1 * jax.random.normal(key, (space.dim,))
            return exp(x, space._from_coordinates(x, c)), None

        return jax.lax.scan(step, start, jax.random.split(jax.random.key(0), steps))[0]

    start = space.random(0)
    assert float(space.residual(jax.jit(lambda: run(space._exp))())) <= TOLERANCES["drift"][0]
    if isinstance(space, mf.SpecialOrthogonal):  # control
        naive = jax.jit(lambda: run(lambda x, v: x @ space.group.exp(space._velocity(x, v))))()
        assert float(space.residual(naive)) > 5 * TOLERANCES["drift"][0]


# -- programs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space",
    [
        space_param(mf.Sphere(2)),
        space_param(mf.Sphere(2) ** 2, is_slow=True),
        space_param(mf.Hyperbolic(2), is_slow=True),
        space_param(mf.SpecialOrthogonal(3), is_slow=True),
        space_param(mf.SpecialEuclidean(3), is_slow=True),
        space_param(mf.SPD(2), is_slow=True),
    ],
)
def test_closed_forms_unroll_into_scalar_programs(space):
    x = np.asarray(space.random(0))
    v, u = (
        np.asarray(space.from_coordinates(x, c)) for c in 0.3 * np.random.default_rng(0).standard_normal((2, space.dim))
    )
    y = np.asarray(space.exp(x, v))

    def everything(x, v, u, y):
        derivative = jax.jvp(lambda v: space.exp(x, v), (v,), (u,))[1]
        log, transported_u, middle = space.log(x, y), space.transport(x, v, u), space.midpoint(x, y)
        return derivative, log, transported_u, middle, space.sharp(x, u), space.frame(x), space.inner(x, u, v)

    unrolled_results = scalarize(jax.make_jaxpr(everything)(x, v, u, y)).evaluate(x, v, u, y)
    for a, b in zip(unrolled_results, jax.jit(everything)(x, v, u, y), strict=True):
        assert is_close(a, b, *tolerance_and_scale(space, x, y))


@pytest.mark.slow
def test_batches_broadcast_and_compile():
    space = mf.Sphere(2) * mf.Hyperbolic(2)
    x, y = space.random(0, (2, 1)), space.random(1, (3,))
    v = space.log(x, y)
    assert v.shape == (2, 3, *space.shape)
    assert is_close(v[1, 2], space.log(x[1, 0], y[2]))
    assert is_close(space.exp(x, v), np.broadcast_to(y, v.shape))
    assert space.distance(x, y).shape == space.reach(x, v).shape == space.belongs(space.exp(x, v)).shape == (2, 3)
    assert space.frame(x).shape == (2, 1, space.dim, *space.shape)
    assert is_close(jax.jit(jax.vmap(space.log))(x[:, 0], y[:2]), space.log(x[:, 0], y[:2]))
    single = x[0, 0]  # a constant of the program, checked while it is traced
    assert is_close(jax.jit(lambda y: space.log(single, y))(y[0]), space.log(single, y[0]))


def test_under_tracing_what_is_not_defined_is_nan():
    space = mf.Sphere(2)
    x = np.array([0.0, 0.0, 1.0])
    y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert np.isnan(jax.jit(space.log)(x, y)).any(axis=1).tolist() == [False, True]
    assert np.isnan(jax.jit(space.midpoint)(x, y)).any(axis=1).tolist() == [False, True]
    assert is_close(space.distance(x, y), [np.pi / 2, np.pi])


@pytest.mark.slow
def test_product_parts():
    space = mf.Sphere(2) * mf.Euclidean(2) * mf.SpecialUnitary(2)
    assert space.name == "S^2 x R^2 x SU(2)"
    assert (space.dim, space.shape, space.dtype) == (7, (9,), np.complex128)
    x = space.random(0, (4,))
    parts = space.split(x)
    assert [part.shape for part in parts] == [(4, 3), (4, 2), (4, 2, 2)]
    assert [part.dtype.kind for part in parts] == ["f", "f", "c"]
    assert np.array_equal(space.join(*parts), x)
    assert not bool(space.belongs(x + 1j * np.eye(9)[0]).any())  # where the factor is real
    assert (mf.Sphere(2) ** 3).dim == 6
    assert (mf.Sphere(2) * (mf.Euclidean(1) * mf.Sphere(1))).factors[1:] == (mf.Euclidean(1), mf.Sphere(1))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("space", [mf.SpecialOrthogonal(3), mf.SpecialEuclidean(3, 0.5)], ids=lambda S: S.name)
def test_a_rotation_by_pi_has_a_logarithm(space):
    n = space.shape[0]
    x, y = np.eye(n), np.diag([1.0, -1.0, -1.0, 1.0][:n])
    assert float(space.distance(x, y)) == pytest.approx(np.pi, rel=1e-15)
    assert is_close(space.exp(x, space.log(x, y)), y)
    assert float(space.velocity(x, space.log(x, y))[0]) == pytest.approx(np.pi, rel=1e-15)  # of -pi and pi


def test_importing_manifolds_does_not_import_geomstats():
    program = "import manifolds, sys; sys.exit('geomstats' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
