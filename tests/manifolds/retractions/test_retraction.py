"""Retraction maps: inverses, agreement with the exponential to the stated order, symmetry, and refused steps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from liethermo.tracing.scalarize import scalarize
from tests.cases import max_abs

TOLERANCES = {
    # name: (bound, what was measured and why)
    "exact": (2e-14, "results of order one; at most 4e-15 seen"),
    "derivative": (1e-14, "of a chart at zero; at most 2e-15 seen"),
}
BATCH_SIZE = 3
SIZES = np.array([0.2, 0.1, 0.05, 0.025])

S2 = mf.Sphere(2)
SO3 = mf.SpecialOrthogonal(3)
SU2 = mf.SpecialUnitary(2)
SE3 = mf.SpecialEuclidean(3)
SPD2 = mf.SPD(2)
R3 = mf.Euclidean(3)

CASES = [
    # kind, space, the exponent of |v| in the distance to the Riemannian map (None: equal), by hand; slow or not
    ("exp", S2, None, False),
    ("exp", mf.Hyperbolic(2), None, False),
    ("exp", mf.Stiefel(4, 2), None, True),
    ("euclidean", R3, None, False),
    ("euclidean", SPD2, 2, True),
    ("group_exp", SO3, None, True),
    ("group_exp", SE3, 2, True),
    ("cayley", SO3, 3, True),
    ("cayley", SU2, 3, True),
    ("cayley", SE3, 2, True),
    ("cayley", mf.SpecialOrthogonal(4), 3, True),
    ("cayley", SO3 * R3, 3, True),
    ("cayley", SO3**2, 3, True),
]


def is_close(a, b, name="exact", scale=1.0) -> bool:
    return max_abs(np.asarray(a) - np.asarray(b)) <= TOLERANCES[name][0] * scale


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(case[:3], id=f"{case[0]}-{case[1].name}", marks=[pytest.mark.slow] if case[3] else [])
        for case in CASES
    ],
)
def case(request):
    return request.param


def sample(space, length, seed=0):
    """Return random points and tangent vectors of the given length."""
    z = np.asarray(space.random(seed, (BATCH_SIZE,)))
    c = np.random.default_rng(seed).standard_normal((BATCH_SIZE, space.dim))
    return z, np.asarray(space.from_coordinates(z, length * c / np.linalg.norm(c, axis=1, keepdims=True)))


def chart_and_midpoint(kind, space):
    chart = mf.retraction(space, kind)
    return chart, mf.retraction(space, "midpoint" if kind == "exp" else f"midpoint_{kind}")


@pytest.mark.sampled(1)
def test_identity_at_zero(case):
    """The defining property of a retraction: ``point(z, 0) = z``, with the derivative the identity."""
    kind, space, _ = case
    z, w = sample(space, 1.0)
    chart, midpoint = chart_and_midpoint(kind, space)
    zero = np.zeros_like(z)
    for R in (chart, midpoint):
        for end in R(z, zero):
            assert is_close(end, z)
    assert is_close(chart.differential(z, zero, w), w, "derivative")
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(jnp.abs(chart.point(z, v)) ** 2)))(zero)
    assert np.isfinite(gradient).all()


def test_inverse(case):
    kind, space, _ = case
    z, v = sample(space, 0.8)
    for R in chart_and_midpoint(kind, space):
        for h in (1.0, 0.1):
            x, y = R(z, v, h)
            base, velocity = R.inverse(x, y, h)
            assert is_close(base, z)
            assert is_close(velocity, v, scale=1 / h)
            for end, end_again in zip((x, y), R(base, velocity, h), strict=True):
                assert is_close(end, end_again)
        assert is_close(R(z, h * v)[1], R(z, v, h)[1])


def test_agreement_with_the_riemannian_map(case):
    kind, space, exponent = case
    z, v = sample(space, 1.0, seed=1)
    for R, riemannian in zip(chart_and_midpoint(kind, space), chart_and_midpoint("exp", space), strict=True):
        gaps = [
            max(max_abs(a - b) for a, b in zip(R(z, size * v), riemannian(z, size * v), strict=True)) for size in SIZES
        ]
        if exponent is None:
            assert max(gaps) <= TOLERANCES["exact"][0]
            assert R.order == math.inf
        else:
            assert abs(np.polyfit(np.log(SIZES), np.log(gaps), 1)[0] - exponent) < 0.2
            assert R.order == exponent - 1


def test_symmetry(case):
    kind, space, _ = case
    z, v = sample(space, 0.8)
    chart, midpoint = chart_and_midpoint(kind, space)
    assert midpoint.symmetric
    assert not chart.symmetric
    x, y = midpoint(z, v)
    for end, reversed_end in zip(midpoint(z, -v), (y, x), strict=True):
        assert np.array_equal(end, reversed_end)
    base, velocity = midpoint.inverse(y, x)
    assert is_close(base, z)
    assert is_close(velocity, -v)
    assert max_abs(chart(z, -v)[0] - chart(z, v)[1]) > 0.1  # control
    for end, sign in ((x, -0.5), (y, 0.5)):  # as printed [BFM 4.8]
        assert np.array_equal(end, chart.point(z, sign * v))


def test_the_paper_s_two_maps():
    z, v = np.array([0.0, 0.0, 1.0]), np.array([np.pi / 2, 0.0, 0.0])
    x, y = mf.retraction(S2, "exp")(z, v, 0.5)
    assert is_close(x, z)
    assert is_close(y, [np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
    x, y = mf.retraction(S2)(z, v)
    assert is_close(x, [-np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
    assert is_close(y, [np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])


# -- domains ----------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("R", "limit"),
    [
        # the length of a step at which its inverse ceases to be defined, by hand
        (mf.retraction(S2, "exp"), math.pi),
        (mf.retraction(S2, "midpoint"), math.pi),
        (mf.retraction(SO3, "midpoint_cayley"), 4.0),  # 4 tan(pi/4), where the half steps are quarter turns
        (mf.retraction(SPD2, "euclidean"), 1.0),
        (mf.retraction(SPD2, "midpoint_euclidean"), 2.0),
        pytest.param(mf.retraction(SO3, "group_exp"), math.pi, marks=pytest.mark.slow),
        pytest.param(mf.retraction(SU2, "midpoint_cayley"), 8.0, marks=pytest.mark.slow),
    ],
    ids=repr,
)
def test_a_step_beyond_the_domain(R, limit):
    z, direction = sample(R.space, 1.0)
    assert is_close(R.reach(z, direction, 0.5), 0.5 / limit)
    inner_length = 0.999 * limit
    x, y = R(z, direction, inner_length)
    assert is_close(R.inverse(x, y)[1], inner_length * direction, scale=1e3)
    with pytest.raises(mf.DomainError, match=r"the step h v\[0\] is 1\.001 times as long .* Use a smaller step"):
        R(z, direction, 1.001 * limit)
    reach = jax.jit(R.reach)(z, direction, 1.001 * limit)  # how to ask under tracing, where nothing raises
    assert is_close(reach, 1.001)
    assert np.isfinite(jax.jit(R)(z, direction, 1.001 * limit)[1]).all()


@pytest.mark.slow
def test_cayley_covers_all_but_the_half_turns():
    R = mf.retraction(SO3, "cayley")
    z, direction = sample(SO3, 1.0)
    for length in (10.0, 1000.0):
        y = R.point(z, length * direction)
        assert is_close(R.vector(z, y), length * direction, scale=length**2)
    assert max_abs(R.reach(z, 1e6 * direction)) == 0.0
    with pytest.raises(mf.DomainError, match=r"the inverse of CayleyRetraction\(x, y\) is not defined.*eigenvalue -1"):
        R.vector(np.eye(3), np.diag([1.0, -1.0, -1.0]))


def test_antipodes_and_points_off_the_space():
    north = np.array([0.0, 0.0, 1.0])
    for R in (mf.retraction(S2, "exp"), mf.retraction(S2, "midpoint")):
        with pytest.raises(mf.DomainError, match="antipode"):
            R.inverse(north, -north)
        assert np.isnan(jax.jit(R.inverse)(north, -north)[1]).any()
        with pytest.raises(mf.OffManifoldError, match="z is off"):
            R(2 * north, 0 * north)
        with pytest.raises(mf.OffManifoldError, match="not tangent"):
            R(north, north)
    with pytest.raises(mf.DomainError, match="not defined"):  # no tangent plane is projected onto the other half
        mf.retraction(S2, "projection").vector(north, np.array([0.6, 0.0, -0.8]))


def test_spaces_that_lack_a_retraction():
    for kind in ("group_exp", "cayley", "midpoint_cayley"):
        with pytest.raises(mf.SpaceError, match=r"S\^2 is not a group"):
            mf.retraction(S2, kind)
    with pytest.raises(mf.SpaceError, match="not an open set of arrays"):
        mf.retraction(S2, "euclidean")
    with pytest.raises(mf.SpaceError, match=r"S\^2 is not a group"):
        mf.retraction(SO3 * S2, "cayley")
    with pytest.raises(mf.LieAlgebraError, match="does not take su"):
        mf.retraction(mf.SpecialUnitary(3), "cayley")
    with pytest.raises(mf.ParameterError, match=r"kind must be one of midpoint, exp, euclidean.*, got 'exponential'"):
        mf.retraction(S2, "exponential")
    with pytest.raises(mf.SpaceError, match="must be a Chart"):
        mf.MidpointRetraction(mf.retraction(S2))
    with pytest.raises(mf.SpaceError, match="must be a state space, got MatrixGroup"):
        mf.CayleyRetraction(mf.SO(3))


# -- programs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "R",
    [
        mf.retraction(S2, "midpoint"),
        mf.retraction(SO3, "cayley"),
        pytest.param(mf.retraction(SE3, "midpoint_cayley"), marks=pytest.mark.slow),
        pytest.param(mf.retraction(SO3 * R3, "midpoint_cayley"), marks=pytest.mark.slow),
    ],
    ids=repr,
)
def test_retractions_unroll_into_scalar_programs(R):
    z, v = (a[0] for a in sample(R.space, 0.8))

    def everything(z, v):
        x, y = R(z, v)
        return x, y, *R.inverse(x, y), R.chart.differential(z, v, 2.0 * v)

    unrolled_results = scalarize(jax.make_jaxpr(everything)(z, v)).evaluate(z, v)
    for a, b in zip(unrolled_results, jax.jit(everything)(z, v), strict=True):
        assert is_close(a, b)


def test_retractions_are_static_and_print():
    R = mf.retraction(S2)
    assert mf.MidpointRetraction(mf.RiemannianRetraction(mf.Sphere(2))) == R
    assert hash(R) == hash(mf.retraction(mf.Sphere(2)))
    assert repr(R) == "MidpointRetraction(RiemannianRetraction(S^2))"
    assert R.chart.chart is R.chart
    assert jax.tree_util.tree_leaves(R) == []
