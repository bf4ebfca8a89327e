"""Distances: derivatives of their squares at equal points, and values at all scales and at cut loci.

The references are Hessians known by definition, mpmath, and points made from the angles between them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.cases import max_abs

TOLERANCES = {
    # name: (bound, what was measured and why)
    "gradient": (1e-15, "of a squared distance where both points are one; at most 1e-16 seen"),
    "hessian": (2e-14, "less twice the metric; at most 5e-15 seen, in SU(2)"),
    "angle": (1e-14, "distances up to 6 that are made from angles; at most 2e-15 seen"),
    "way": (1e-14, "exp(x, log(x, y)) less y; at most 2e-15 seen"),
    "far": (1e-15, "times the largest coordinate, as the angle of a point is rounded; at most 7e-16 seen"),
}


def tolerance(name: str) -> float:
    return TOLERANCES[name][0]


# -- derivatives at equal points ---------------------------------------------------------------------------------------

COMPOSED_SPACES = [
    mf.Sphere(2) * mf.SPD(2),
    mf.Hyperbolic(2) ** 2,
    mf.SPD(2) ** 2,
    mf.Grassmann(3, 1) * mf.Sphere(1),
    mf.Power(mf.Sphere(2) * mf.Euclidean(1), 2),
]
QUICK_SPACE_NAMES = ("R^3", "S^2", "(S^2)^4", "Oblique(3, 2)")
SPACES = [
    pytest.param(space, id=space.name, marks=[] if space.name in QUICK_SPACE_NAMES else [pytest.mark.slow])
    for space in (*mf.registered_spaces(), *COMPOSED_SPACES)
    if space.has_geodesics
]


@pytest.mark.parametrize("space", SPACES)
def test_the_square_of_a_distance_has_twice_the_metric_as_hessian(space):
    """As an ambient function of either point. Its gradient vanishes, so its Hessian on tangent vectors is covariant."""
    c = np.asarray(space.random(3))
    start, frame = space.to_vector(c), np.asarray(space.to_vector(space.frame(c)))
    for square in (
        lambda x: space.distance(space.from_vector(x), c) ** 2,
        lambda x: space.distance(c, space.from_vector(x)) ** 2,
    ):
        gradient = jax.jit(jax.grad(square))
        assert max_abs(frame @ gradient(start)) < tolerance("gradient")
        hessian = frame @ np.asarray(jax.jit(jax.jacfwd(gradient))(start)) @ frame.T
        assert max_abs(hessian - 2.0 * np.eye(space.dim)) < tolerance("hessian")


def test_a_distance_of_zero_is_zero():
    for space in (mf.Sphere(2), mf.Hyperbolic(2), mf.Euclidean(3), mf.Oblique(3, 2)):
        x = space.random(0)
        assert float(space.distance(x, x)) == 0.0 == float(space.squared_distance(x, x))


@pytest.mark.slow
def test_derivatives_of_every_order_at_equal_points():
    """Along a geodesic from c the square is t^2: its derivatives are 0, 2, 0, 0, 0 at t = 0."""
    space = mf.Sphere(2)
    c = space.random(1)
    v = space.from_coordinates(c, jnp.eye(space.dim)[0])

    def derivative_of(f):
        return lambda t: jax.jvp(f, (t,), (1.0,))[1]

    functions = [lambda t: space._distance(space._exp(c, t * v), c) ** 2]
    for _ in range(5):
        functions.append(derivative_of(functions[-1]))
    derivatives = jax.jit(lambda t: jnp.stack([f(t) for f in functions[1:]]))(0.0)
    assert np.abs(np.asarray(derivatives) - [0.0, 2.0, 0.0, 0.0, 0.0]).max() < 1e-12


@pytest.mark.parametrize(
    ("method", "max_difference"),
    [
        (lt.MetriplecticGauss(2), 1e-11),
        pytest.param(lt.MetriplecticMidpoint(), 1e-7, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticRungeKutta(4), 1e-9, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticTaylor(4), 1e-11, marks=pytest.mark.slow),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_run_from_the_centre_of_a_potential_of_the_distance(method, max_difference):
    """The energy of a spin is the squared distance from its start, with a field that moves it away.

    The tolerance is the error of the method: the two energies differ off the sphere, where stages are.
    """
    space, c = mf.Sphere(2), np.array([0.6, 0.64, 0.48])
    field = np.array([0.3, -0.2, 0.5])

    def energy(s):
        return space.distance(s, c) ** 2 + field @ s

    def smooth_energy(
        s,
    ):  # the same, written with the angle's cosine: acos(u)^2 has a series at 1, unlike JAX's derivative
        gap = 1.0 - s @ c
        series = 2.0 * gap + gap**2 / 3.0 + 4.0 * gap**3 / 45.0 + gap**4 / 35.0 + 16.0 * gap**5 / 1575.0
        return series + field @ s

    runs = [
        lt.integrate(
            lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), H, space=space, validate=False), c, (0.0, 0.2), 0.02, method
        )
        for H in (energy, smooth_energy)
    ]
    assert np.isfinite(runs[0].x).all()
    assert max_abs(runs[0].x - runs[1].x) < max_difference
    assert max_abs(runs[0].x[-1] - c) > 0.05  # control: it moves


# -- hyperbolic space, far out -----------------------------------------------------------------------------------------


def hyperbolic_point(r, angle):
    space = np.sinh(r) * np.array([np.cos(angle), np.sin(angle)])
    return np.concatenate([[np.hypot(1.0, np.hypot(*space))], space])


def exact_hyperbolic_distance(x, y) -> float:
    """Return the distance of the points above the given coordinates, which are taken as exact."""
    with mpmath.workdps(150):
        p, q = ([mpmath.mpf(float(a)) for a in z[1:]] for z in (x, y))
        x0, y0 = (mpmath.sqrt(1 + sum(a * a for a in z)) for z in (p, q))
        return float(mpmath.re(mpmath.acosh(x0 * y0 - sum(a * b for a, b in zip(p, q, strict=True)))))


def test_hyperbolic_distances_at_all_scales():
    space = mf.Hyperbolic(2)
    pairs = [
        (hyperbolic_point(r, 0.3), hyperbolic_point(r + s, 0.3 + angle))
        for r in (0.0, 1e-9, 0.1, 1.0, 1.3, 1.4, 3.0, 8.0, 18.0, 25.0)
        for s in (0.0, 1e-8, 1e-3, 1.0, 10.0, 40.0)
        for angle in (0.0, 1e-12, 1e-8, 1e-3, 0.5, 2.0, np.pi)
    ]
    x, y = (np.array(points) for points in zip(*pairs, strict=True))
    exact = np.array([exact_hyperbolic_distance(a, b) for a, b in pairs])
    min_cosh = np.minimum(x[:, 0], y[:, 0])
    for a, b in ((x, y), (y, x)):
        distances = np.asarray(space.distance(a, b))
        assert (np.abs(distances - exact) <= tolerance("far") * (min_cosh + exact)).all()
        has_digits = a[:, 0] < 1e9  # further out vectors have no digits
        log_lengths = np.asarray(space._norm(a, space._log(a, b)))
        assert (np.abs(log_lengths - exact) <= 10 * tolerance("far") * a[:, 0] * (1.0 + exact))[has_digits].all()


def test_hyperbolic_points_ten_apart_far_out():
    """On a ray distances are differences of radii; from radius 18 on the difference of two squares was 0."""
    space = mf.Hyperbolic(2)
    for r in (17.0, 18.0, 19.0, 20.0, 25.0):
        assert abs(float(space.distance(hyperbolic_point(r, 0.0), hyperbolic_point(r + 10.0, 0.0))) - 10.0) < 1e-13


@pytest.mark.parametrize("n", [2, 3, 6])
def test_hyperbolic_points_on_one_ray_at_any_radius(n):
    """Rounding of the coordinates turns the directions by 1e-16, which is 325 units of length at radius 200."""
    space, rng = mf.Hyperbolic(n), np.random.default_rng(n)
    directions = [np.eye(n)[0], np.eye(n)[-1], *rng.standard_normal((4, n))]
    cases = [
        (u, r, d) for u in directions for r in (35.0, 36.0, 50.0, 100.0, 200.0, 340.0) for d in (0.1, 1.0, 7.0, 12.0)
    ]
    units, r, d = (np.array(a) for a in zip(*cases, strict=True))
    units = units / np.linalg.norm(units, axis=1, keepdims=True)
    x, y = (np.column_stack([np.cosh(a), np.sinh(a)[:, None] * units]) for a in (r, r + d))
    for distances in (space.distance(x, y), space.distance(y, x)):
        assert (np.abs(distances - d) < 1e-15 * (r + d)).all()
    opposite = y * np.array([1.0, *-np.ones(n)])
    assert np.asarray(space.distance(x, opposite)) == pytest.approx(2 * r + d, rel=1e-14)
    x, y = (np.array([np.cosh(r), *(np.sinh(r) * u)]) for r, u in ((200.0, np.eye(n)[0]), (203.0, np.eye(n)[1])))
    assert float(space.distance(x, y)) == pytest.approx(403.0 - np.log(2.0), rel=1e-14)  # a right angle between them


def test_hyperbolic_points_beyond_the_range_of_squares():
    """Up to radius 354 all maps work; farther points are refused with their distance from the apex and the limit."""
    space, apex = mf.Hyperbolic(2), np.array([1.0, 0.0, 0.0])
    x = hyperbolic_point(353.9, 0.0)
    assert float(space.distance(apex, x)) == pytest.approx(353.9, rel=1e-15)
    assert float(space.distance(x, x * [1.0, -1.0, 1.0])) == pytest.approx(707.8, rel=1e-15)
    assert np.asarray(space.exp(apex, [0.0, 353.9, 0.0])) == pytest.approx(x, rel=1e-12)
    for r in (354.1, 356.0, 500.0, 709.0):
        y, message = hyperbolic_point(r, 0.0), rf"is {r:g} from the apex or farther.*Use points within 354"
        for call in (lambda y=y: space.point(y), lambda y=y: space.log(apex, y)):
            with pytest.raises(mf.DomainError, match=message):
                call()
    with pytest.raises(mf.DomainError, match=r"cannot be projected: it is 500.* from the apex"):
        space.project(hyperbolic_point(500.0, 0.0))
    with pytest.raises(mf.DomainError, match=r"exp\(x, v\) exceeds the range of double precision"):
        space.exp(apex, [0.0, 400.0, 0.0])


def test_hyperbolic_derivatives_far_out():
    """The branches of the formula for far points are smooth at equal radii too: the Hessian is twice the metric."""
    space = mf.Hyperbolic(2)
    c = space.point([0.0, 3.0, 4.0], project=True)
    frame = np.asarray(space.frame(c))
    hessian = jax.jit(jax.hessian(lambda x: space.distance(x, c) ** 2))(c)
    assert max_abs(frame @ hessian @ frame.T - 2.0 * np.eye(2)) < 5e-14
    y = np.array([c[0], c[2], c[1]])  # of the same radius
    gradient = np.asarray(jax.jit(jax.grad(lambda x: space.distance(x, y) ** 2))(c))
    assert max_abs(frame @ gradient + 2.0 * np.asarray(space.coordinates(c, space.log(c, y)))) < 1e-13


# -- cut loci ----------------------------------------------------------------------------------------------------------


def subspaces(n, p, angles, seed):
    """Return two subspaces with given principal angles, as projectors."""
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((n, n)))[0]
    x, y = q[:, :p], q[:, :p].copy()
    for i, t in enumerate(angles):
        y[:, i] = np.cos(t) * q[:, i] + np.sin(t) * q[:, p + i]
    return [(a @ a.T + (a @ a.T).T) / 2 for a in (x, y)]


@pytest.mark.parametrize(
    ("n", "p"), [(3, 1), pytest.param(4, 2, marks=pytest.mark.slow), pytest.param(6, 3, marks=pytest.mark.slow)]
)
def test_grassmann_near_a_right_angle(n, p):
    space = mf.Grassmann(n, p)
    other_angles = [0.3, 1.1][: p - 1]
    for gap in (1.0, 1e-2, 1e-5, 3e-8, 1e-8, 1e-10, 1e-12, 0.0):
        x, y = subspaces(n, p, [np.pi / 2 - gap, *other_angles], seed=int(1e3 * gap))
        length = np.sqrt(2.0 * ((np.pi / 2 - gap) ** 2 + np.sum(np.square(other_angles))))
        assert abs(float(space.distance(x, y)) - length) < tolerance("angle")
        if gap == 0.0:
            for function in (space.log, space.midpoint):
                with pytest.raises(mf.DomainError, match="right angle"):
                    function(x, y)
            continue
        z = space.midpoint(x, y)
        assert abs(float(space.distance(x, z)) - length / 2) < tolerance("angle")
        assert abs(float(space.distance(y, z)) - length / 2) < tolerance("angle")
        v = space.log(x, y)
        assert abs(float(space.norm(x, v)) - length) < tolerance("angle")
        assert max_abs(np.asarray(space.exp(x, v)) - y) < tolerance("way")


@pytest.mark.parametrize("n", [1, 2, 7])
def test_sphere_near_the_antipode(n):
    space = mf.Sphere(n)
    q = np.linalg.qr(np.random.default_rng(n).standard_normal((n + 1, n + 1)))[0]
    for gap in (1e-2, 1e-6, 3e-8, 1e-8, 1e-10, 1e-12, 1e-13):
        x, y = q[0], np.sin(gap) * q[1] - np.cos(gap) * q[0]
        z, v = space.midpoint(x, y), space.log(x, y)
        assert abs(float(space.norm(x, v)) - (np.pi - gap)) < tolerance("angle")
        assert max_abs(np.asarray(space.exp(x, v)) - y) < tolerance("way")
        for end in (x, y):
            assert abs(float(space.distance(end, z)) - (np.pi - gap) / 2) < tolerance("angle")
    for function in (space.log, space.midpoint):
        with pytest.raises(mf.DomainError, match="of the antipode of x"):
            function(q[0], -q[0])


def test_grassmann_neighbours_keep_their_relative_accuracy():
    space = mf.Grassmann(3, 1)
    for gap in (1e-4, 1e-7, 1e-10):
        x, y = (np.diag([1.0, 0.0, 0.0]), np.outer(*2 * [np.array([np.cos(gap), np.sin(gap), 0.0])]))
        assert abs(float(space.distance(x, y)) / (np.sqrt(2.0) * gap) - 1.0) < 1e-15
        assert abs(float(space.norm(x, space.log(x, y))) / (np.sqrt(2.0) * gap) - 1.0) < 1e-15


def rotation_by_angles(angles, n, seed):
    g = np.eye(n)
    for i, t in enumerate(angles):
        g[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]]
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((n, n)))[0]
    return q @ g @ q.T


@pytest.mark.parametrize("n", [3, pytest.param(4, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_rotations_at_half_turns(n):
    """Two half turns have a continuum of logarithms, but the distance is ``pi sqrt(2)``."""
    space, x = mf.SpecialOrthogonal(n), np.asarray(mf.SpecialOrthogonal(n).random(1))
    other_angles = [0.7] * (n // 2 - 1)
    cases = [[np.pi - gap, *other_angles] for gap in (1e-3, 1e-6, 3e-8, 0.0)]
    if n > 3:
        cases += [[np.pi, np.pi], [np.pi - 1e-9, np.pi - 1e-7], [1e-9, np.pi - 1e-6]]
    for angles in cases:
        y = np.asarray(space.project(x @ rotation_by_angles(angles, n, seed=2)))
        assert abs(float(space.distance(x, y)) - np.linalg.norm(angles)) < tolerance("angle")
    rigid = mf.SpecialEuclidean(3, 2.0)
    a, b = np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])
    b[:3, 3] = [2.0, 0.0, 0.0]
    assert abs(float(rigid.distance(a, b)) - np.sqrt(np.pi**2 + 1.0)) < tolerance("angle")


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_unitary_matrices_at_half_turns(n):
    space, x = mf.SpecialUnitary(n), np.asarray(mf.SpecialUnitary(n).random(1))
    random = np.random.default_rng(3).standard_normal((2, n, n))
    q = np.linalg.qr(random[0] + 1j * random[1])[0]
    pair = lambda t: [t, -t] + [0.0] * (n - 2)  # noqa: E731
    cases = [pair(np.pi - gap) for gap in (1e-3, 1e-6, 0.0)] + [pair(1e-9)]
    cases += [[np.pi, -np.pi / 2, -np.pi / 2], [1.0, -1.5, 0.5]] if n == 3 else []
    for angles in cases:
        y = np.asarray(space.project(x @ (q * np.exp(1j * np.array(angles))) @ q.conj().T))
        assert abs(float(space.distance(x, y)) - np.sqrt(2.0) * np.linalg.norm(angles)) < tolerance("angle")


@pytest.mark.slow
def test_a_logarithm_that_is_not_in_the_algebra_is_refused():
    """The angles 2.5, 2.5 and 2 pi - 5 are below pi, but their sum is 2 pi: the trace was dropped, silently."""
    g = np.diag(np.exp(1j * np.array([2.5, 2.5, -5.0])))
    with pytest.raises(mf.DomainError, match=r"angles sum to 6\.28"):
        mf.SU(3).log(g)
    with pytest.raises(mf.DomainError, match=r"angles sum to 6\.28"):
        mf.SpecialUnitary(3).distance(np.eye(3), g)
    half_way = np.diag(np.exp(0.5j * np.array([2.5, 2.5, -5.0])))  # what the message says
    x = mf.SU(3).log(mf.SU(3).compose(mf.SU(3).inverse(half_way), g))
    assert max_abs(half_way @ np.asarray(mf.SU(3).exp(x)) - g) < 1e-14


def test_positive_definite_matrices_at_all_scales():
    """Along ``x = g D g^T`` the distance is that of the logarithms of D, however ill-conditioned g is."""
    space, random = mf.SPD(3), np.random.default_rng(5)
    for size in (1e-12, 1e-6, 1e-2, 1.0, 10.0):
        logs = size * random.standard_normal(3)
        q = np.linalg.qr(random.standard_normal((3, 3)))[0]
        y = q @ np.diag(np.exp(logs)) @ q.T
        assert abs(float(space.distance(np.eye(3), (y + y.T) / 2)) - np.linalg.norm(logs)) < 4e-14 * (
            1.0 + np.exp(size)
        )
    g = np.diag([1e-6, 1.0, 1e6])
    x, y = g @ g, g @ np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 3.0]]) @ g
    middle_matrix = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 3.0]])
    expected_distance = np.linalg.norm(np.log(np.linalg.eigvalsh(middle_matrix)))
    assert abs(float(space.distance(x, y)) - expected_distance) < 1e-14 * 10
    assert abs(float(space.distance(y, x)) - expected_distance) < 1e-14 * 10


# -- grassmann manifolds compared to geomstats; the suite of spaces runs on them by registration -----------------------


@pytest.mark.slow
def test_against_geomstats():
    from geomstats.geometry.grassmannian import Grassmannian

    theirs, ours = Grassmannian(4, 2).metric, mf.Grassmann(4, 2)
    x = np.asarray(ours.random(0))
    u, v = np.asarray(ours.random_tangent(2, x)), 0.4 * np.asarray(ours.random_tangent(1, x))
    y = np.asarray(ours.exp(x, v))
    assert np.abs(theirs.exp(v, x) - y).max() < 1e-12
    assert np.abs(theirs.log(y, x) - ours.log(x, y)).max() < 1e-12
    assert abs(theirs.dist(x, y) - ours.distance(x, y)) < 1e-12
    assert np.abs(theirs.parallel_transport(u, x, direction=v) - ours.transport(x, v, u)).max() < 1e-12


def test_subspaces_and_their_angles():
    space = mf.Grassmann(3, 1)
    x, y = space.subspace(np.array([[1.0], [0.0], [0.0]])), space.subspace(np.array([[1.0], [1.0], [0.0]]))
    assert abs(float(space.distance(x, y)) - np.sqrt(2.0) * np.pi / 4.0) < 1e-15 * 4
    with pytest.raises(mf.DomainError, match="right angle"):
        space.log(x, space.subspace(np.array([[0.0], [0.0], [2.0]])))
    with pytest.raises(mf.ParameterError, match="p must be less than n"):
        mf.Grassmann(3, 3)
    assert not bool(space.belongs(np.diag([1.0, 1.0, 0.0])))  # a projector, to a plane


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticGauss(2)], ids=str)
def test_a_run_finds_the_dominant_subspace(method):
    """The gradient flow of tr(A x) ends at the eigenvectors of the two largest eigenvalues."""
    space, A = mf.Grassmann(4, 2), np.diag([4.0, 3.0, 1.0, 0.5]) + 0.2
    system = lt.MetriplecticSystem(None, lambda x: -(A * x).sum(), dissipation=lt.Friction(), space=space)
    run = lt.integrate(system, space.random(0), (0.0, 15.0), 0.05, method)
    vectors = np.linalg.eigh(A)[1][:, -2:]
    assert np.abs(system.points(run.x[-1]) - vectors @ vectors.T).max() < 1e-9
    assert float(space.residual(system.points(run.x)).max()) < 1e-14
