"""Homogeneous spaces compared to the same spaces under other names; means and dispersions of points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

MAX_ERROR = 1e-12
"""Largest error of points, vectors and distances of order one; at most 3e-15 seen."""


def plane_generator(n: int, i: int, j: int) -> np.ndarray:
    rotation = np.zeros((n, n))
    rotation[i, j], rotation[j, i] = -1.0, 1.0
    return rotation


def unit_tangent_vectors(space, x, *seeds):
    tangent_vectors = [np.asarray(space.random_tangent(seed, x)) for seed in seeds]
    return [v / float(space.norm(x, v)) for v in tangent_vectors]


def is_close(a, b) -> bool:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max()) <= MAX_ERROR


CASES = {
    "sphere": (3, [plane_generator(3, 0, 1)], mf.Sphere(2), lambda x: x[..., 2]),
    "frames": (4, [plane_generator(4, 2, 3)], mf.Stiefel(4, 2), lambda x: x[..., :2]),
}
"""Size of the group, stabilizer, equal space, and the linear map to that space."""


@pytest.mark.parametrize("case", [pytest.param(name, marks=[pytest.mark.slow][: name == "frames"]) for name in CASES])
def test_other_names_of_the_same(case):
    n, stabilizer, quotient, to_quotient = CASES[case]
    space = mf.Homogeneous(mf.SO(n), stabilizer)
    assert space.dim == quotient.dim
    x = np.asarray(space.random(1))
    u, v = unit_tangent_vectors(space, x, 2, 3)
    y = space.exp(x, v)
    assert is_close(quotient.exp(to_quotient(x), to_quotient(v)), to_quotient(y))
    assert is_close(space.inner(x, u, v), quotient.inner(to_quotient(x), to_quotient(u), to_quotient(v)))
    assert is_close(
        to_quotient(space.transport(x, v, u)), quotient.transport(to_quotient(x), to_quotient(v), to_quotient(u))
    )
    assert is_close(space.log(x, y), v)
    h = mf.SO(n).exp(np.asarray(mf.so(n).vee(0.7 * np.array(stabilizer[0]))))
    assert is_close(space.distance(x @ h, y), quotient.distance(to_quotient(x), to_quotient(y)))
    assert not is_close(
        space.group_space.distance(x @ h, y), quotient.distance(to_quotient(x), to_quotient(y))
    )  # control


def test_flags_of_two_pieces_are_subspaces():
    flags, subspaces = mf.Flag(1, 2), mf.Grassmann(3, 1)
    x = np.asarray(flags.random(1))
    (v,) = unit_tangent_vectors(flags, x, 2)
    y = flags.exp(x, v)
    subspace_x, subspace_y = (flags.projectors(z)[0] for z in (x, y))
    assert is_close(subspaces.distance(subspace_x, subspace_y), np.sqrt(2.0) * flags.distance(x, y))
    assert is_close(flags.projectors(x).sum(axis=0), np.eye(3))


def test_a_run_depends_on_the_class_alone():
    """Two elements of one class lead to equal flags, energies and entropies."""
    space, A = mf.Flag(1, 2), np.array([[3.0, 0.3, 0.1], [0.3, 2.0, 0.4], [0.1, 0.4, 1.0]])
    B = np.diag([0.2, 1.0, -0.5])
    system = lt.MetriplecticSystem(
        None,
        lambda x: jnp.sum(B * space.projectors(x)[0]),
        lambda x: jnp.sum(A * space.projectors(x)[0]),
        lt.ProjectedMetric(),
        space=space,
    )
    x = np.asarray(space.random(1))
    h = np.eye(3)
    h[1:, 1:] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    runs = [lt.integrate(system, z, (0.0, 1.0), 0.05, lt.MetriplecticRungeKutta(4)) for z in (x, x @ h)]
    assert all(run.audit().passed for run in runs)
    ends = [space.projectors(system.points(run.x[-1])) for run in runs]
    assert is_close(*ends)
    assert not is_close(runs[0].x[-1], runs[1].x[-1])


@pytest.mark.parametrize("is_product", [False, True])
def test_functions_that_are_not_of_classes_are_refused(is_product):
    """An entry of the rotation, which a turn within a piece changes; in a product too. The square of a row is
    accepted."""
    space = mf.Flag(1, 2) * mf.Euclidean(1) if is_product else mf.Flag(1, 2)

    def rotation(x):
        return space.split(x)[0] if is_product else x

    def build(energy):
        return lt.MetriplecticSystem(None, energy, lambda x: rotation(x)[2, 0] ** 2, lt.ProjectedMetric(), space=space)

    assert build(lambda x: rotation(x)[0, 0] + jnp.sum(rotation(x)[1, 1:] ** 2)).check().passed
    with pytest.raises(lt.AxiomError, match=r"functions of classes fails: residual 0.*projectors of a flag") as refusal:
        build(lambda x: rotation(x)[0, 1])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: mf.Homogeneous(mf.SL(2), []), mf.SpaceError, r"group must be SO\(n\) or SU\(n\), got SL\(2\)"),
        (
            lambda: mf.Homogeneous(mf.SO(3), [plane_generator(3, 0, 1), plane_generator(3, 1, 2)]),
            mf.ParameterError,
            "not a subalgebra.*Add the missing directions",
        ),
        (
            lambda: mf.Homogeneous(mf.SO(3), [plane_generator(3, 0, 1)] * 2),
            mf.ParameterError,
            "2 matrices .* span 1 dimensions only",
        ),
        (lambda: mf.Homogeneous(mf.SO(3), [np.eye(2)]), mf.ParameterError, r"shape \(k, 3, 3\), got \(1, 2, 2\)"),
        (
            lambda: mf.Homogeneous(mf.SO(3), [np.eye(3)]),
            mf.ParameterError,
            r"matrix 0 .* not in the algebra of SO\(3\)",
        ),
        (lambda: mf.Homogeneous(mf.SO(2), [plane_generator(2, 0, 1)]), mf.ParameterError, "quotient is a single point"),
        (lambda: mf.Flag(3), mf.ParameterError, "at least two steps"),
        (lambda: mf.Correlation(2).point([[1.0, 1.5], [1.5, 1.0]]), mf.OffManifoldError, "least eigenvalue -0.5"),
        (lambda: mf.Correlation(2).point([[2.0, 0.5], [0.5, 2.0]]), mf.OffManifoldError, "residual 1, tolerance"),
    ],
)
def test_refusals(build, error, message):
    with pytest.raises(error, match=message) as refusal:
        build()
    assert "\n" not in str(refusal.value)


SPACES = [mf.Sphere(2), mf.SpecialOrthogonal(3), mf.SPD(3), mf.Hyperbolic(2)]


def cloud(space, seed, size=12):
    rng = np.random.default_rng(seed)
    centre = space.random(seed)
    return space.exp(centre, space.from_coordinates(centre, 0.4 * rng.standard_normal((size, space.dim))))


def twin(space):
    from geomstats.geometry.hyperboloid import Hyperboloid
    from geomstats.geometry.hypersphere import Hypersphere
    from geomstats.geometry.spd_matrices import SPDAffineMetric, SPDMatrices
    from geomstats.geometry.special_orthogonal import SpecialOrthogonal

    if isinstance(space, mf.SPD):
        spd = SPDMatrices(n=3, equip=False)
        spd.equip_with_metric(SPDAffineMetric)
        return spd
    if isinstance(space, mf.SpecialOrthogonal):
        return SpecialOrthogonal(n=3, point_type="matrix")
    return (Hypersphere if isinstance(space, mf.Sphere) else Hyperboloid)(dim=2)


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_the_mean_is_that_of_geomstats(space):
    """To the accuracy of its descent; by its logarithms our mean is stationary to rounding."""
    from geomstats.learning.frechet_mean import FrechetMean

    points, twin_space = np.asarray(cloud(space, 1)), twin(space)
    mean = np.asarray(mf.frechet_mean(space, points))
    estimator = FrechetMean(twin_space).set(epsilon=1e-12, max_iter=200)
    assert np.abs(mean - estimator.fit(points).estimate_).max() < 1e-5
    assert np.abs(twin_space.metric.log(points, mean).mean(axis=0)).max() < 1e-13


@pytest.mark.sampled("H^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_no_point_nearby_is_better(space):
    rng, points = np.random.default_rng(0), cloud(space, 2)
    weights = rng.uniform(0.1, 1.0, len(points))
    mean = mf.frechet_mean(space, points, weights)
    min_dispersion = mf.dispersion(space, points, weights)
    assert min_dispersion == pytest.approx(float(mf.dispersion(space, points, weights, mean)), rel=1e-13)
    for direction in rng.standard_normal((5, space.dim)):
        neighbour = space.exp(mean, space.from_coordinates(mean, 0.05 * direction / np.linalg.norm(direction)))
        assert mf.dispersion(space, points, weights, neighbour) > min_dispersion + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES[::2], ids=lambda s: s.name)
def test_means_and_dispersions_can_be_traced(space):
    """Results under jit and vmap equal those without; derivatives agree with differences along geodesics."""
    points, centre = cloud(space, 3, size=6), space.random(3)
    weights = jnp.arange(1.0, 7.0)
    mean = jax.jit(lambda x, w: mf.frechet_mean(space, x, w))(points, weights)
    np.testing.assert_allclose(mean, mf.frechet_mean(space, points, weights), rtol=0, atol=3e-15)
    jitted_dispersion = jax.jit(lambda x, w: mf.dispersion(space, x, w))
    assert float(jitted_dispersion(points, weights)) == pytest.approx(
        float(mf.dispersion(space, points, weights)), rel=1e-14
    )
    dispersions = jax.vmap(lambda w: mf.dispersion(space, points, w))(jnp.stack([weights, jnp.ones(6)]))
    np.testing.assert_allclose(
        dispersions, [jitted_dispersion(points, weights), mf.dispersion(space, points)], rtol=1e-14
    )

    rng = np.random.default_rng(4)
    directions = jnp.asarray(rng.standard_normal((6, space.dim)))
    points_at = jax.vmap(lambda x, c, s: space.exp(x, space.from_coordinates(x, s * c)), (0, 0, None))
    dispersion_at = lambda s: mf.dispersion(space, points_at(points, directions, s), weights)  # noqa: E731
    h = 1e-3
    value_below, value_at_zero, value_above = (float(dispersion_at(s)) for s in (-h, 0.0, h))
    first_derivative, second_derivative = jax.grad(dispersion_at)(0.0), jax.grad(jax.grad(dispersion_at))(0.0)
    assert float(first_derivative) == pytest.approx((value_above - value_below) / (2 * h), rel=1e-4, abs=1e-6)
    assert float(second_derivative) == pytest.approx((value_above - 2 * value_at_zero + value_below) / h**2, rel=1e-4)
    means = lambda s: mf.frechet_mean(space, points_at(points, directions, s), weights)  # noqa: E731
    slope = jax.jvp(means, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (means(h) - means(-h)) / (2 * h), rtol=1e-3, atol=1e-4)
    dispersion_from_centre = jax.jit(lambda x: mf.dispersion(space, points, None, x))(centre)
    assert float(dispersion_from_centre) == pytest.approx(float(mf.dispersion(space, points, None, centre)), rel=1e-14)


def test_a_traced_mean_that_does_not_come_to_rest_is_nan():
    """Antipodal points have no mean; without tracing they raise an error."""
    pole = jnp.array([0.0, 0.0, 1.0])
    assert np.isnan(jax.jit(lambda x: mf.frechet_mean(mf.Sphere(2), x))(jnp.stack([pole, -pole]))).all()
    with pytest.raises(mf.ManifoldsError):
        mf.frechet_mean(mf.Sphere(2), jnp.stack([pole, -pole]))


@pytest.mark.slow
def test_closed_forms():
    """Rotations about one axis by angles, and points of R^2."""
    angles = np.array([0.1, 0.4, 1.0])
    turns = mf.SO(3).exp(angles[:, None] * np.array([0.0, 0.6, 0.8]))
    space = mf.SpecialOrthogonal(3)
    assert np.abs(mf.frechet_mean(space, turns) - mf.SO(3).exp(0.5 * np.array([0.0, 0.6, 0.8]))).max() < 1e-14
    assert float(mf.dispersion(space, turns)) == pytest.approx(angles.var(), rel=1e-13)
    plane = np.array([[0.0, 1.0], [2.0, 5.0]])
    assert np.array_equal(mf.frechet_mean(mf.Euclidean(2), plane, [3.0, 1.0]), [0.5, 2.0])


def test_what_has_no_mean():
    sphere = mf.Sphere(2)
    poles = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    with pytest.raises(mf.DomainError, match="antipode"):
        mf.frechet_mean(sphere, poles)
    with pytest.raises(mf.ParameterError, match="points must not be empty"):
        mf.frechet_mean(sphere, np.zeros((0, 3)))
    with pytest.raises(mf.ParameterError, match="one weight for each point"):
        mf.frechet_mean(sphere, poles, [1.0])
    with pytest.raises(mf.ParameterError, match="not negative"):
        mf.frechet_mean(sphere, poles, [1.0, -1.0])
    with pytest.raises(mf.OffManifoldError):
        mf.frechet_mean(sphere, 2.0 * poles)
