"""Matrix groups: every registered one passes the property tests; closed forms equal general ones; controls fail."""

from dataclasses import replace
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf
from manifolds.groups import maps

TOLERANCES = {
    # name: (bound, what was measured and why)
    "member": (5e-15, "at most 2e-15 seen: roundings of g^T g at a rotation by 3, or of a product"),
    "roundtrip": (5e-15, "log(exp(x)) - x, |x| <= 1.5; at most 1e-15 seen, a few roundings times cond(g)"),
    "product": (5e-14, "up to four factors of norm 5 each, noncompact; at most 1.2e-14 seen"),
    "adjoint": (5e-15, "Ad(exp x) - expm(ad x), relative; at most 1e-15 seen"),
    "reference": (1e-14, "relative to SciPy's expm and logm; at most 2e-15 seen"),
    "derivative": (8e-15, "automatic derivatives against exact ones, of order one; at most 2e-15 seen"),
    "central_difference": (3e-8, "with step 1e-4; at most 8e-9 seen, h^2/6 times the third derivative"),
    "half_turn": (1e-14, "within 1e-7 of the half turn in SO, SE, SU; at most 2e-15 seen, roundings of pi"),
    "half_turn_condition": (3e-14, "times 1/gap; at most 7e-15 seen, a few roundings of g"),
}

seeds = st.integers(0, 10**6)
BATCH_SIZE = 4


def is_close(a, b, name, scale=1.0):
    return np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0) <= TOLERANCES[name][0] * scale


def elements(group, seed, count=1, size=1.0):
    """Return batches of algebra elements of Euclidean norm ``size``; log is defined for sizes below pi / 2."""
    x = np.random.default_rng(seed).standard_normal((count, BATCH_SIZE, group.dim))
    x *= size / np.linalg.norm(x, axis=-1, keepdims=True)
    return x if count > 1 else x[0]


def duals(group, seed):
    return np.random.default_rng(10_000 + seed).standard_normal((BATCH_SIZE, group.dim))


SLOW_GROUPS = ("SO(2)", "SO(4)", "SE(2)", "SL(3)", "GL(2)", "Heisenberg(2)")
"""Groups whose tests are slow; one or two of each family are in the default tier."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(g, marks=pytest.mark.slow if g.name in SLOW_GROUPS else ()) for g in mf.registered_groups()],
    ids=lambda group: group.name,
)
def G(request):
    """Return each registered group; with module scope pytest runs all tests of one group together, on its compiled
    maps."""
    return request.param


# -- every registered group: exp, log, products -----------------------------------------------------------------------


@pytest.mark.sampled(1)
@given(seed=seeds)
def test_exp_lands_in_the_group(G, seed):
    for size in (1e-3, 1.0, 3.0):
        g = G.exp(elements(G, seed, size=size))
        assert g.shape == (BATCH_SIZE, G.matrix_size, G.matrix_size)
        assert bool(G.belongs(g, TOLERANCES["member"][0]).all())
    assert np.array_equal(G.exp(np.zeros((BATCH_SIZE, G.dim)))[0], G.identity)


@pytest.mark.sampled(1)
@given(seed=seeds)
def test_log_inverts_exp(G, seed):
    for size in (1e-3, 0.5, 1.5):
        x = elements(G, seed, size=size)
        assert is_close(G.log(G.exp(x)), x, "roundtrip")


@given(seed=seeds)
def test_group_axioms_and_one_parameter_subgroups(G, seed):
    x, y, z = elements(G, seed, 3)
    g, h, k = G.exp(x), G.exp(y), G.exp(z)
    assert is_close(G.compose(G.exp(0.3 * x), G.exp(0.7 * x)), g, "product")
    assert is_close(G.compose(g, G.inverse(g)), G.identity, "product")
    assert is_close(G.compose(G.inverse(g), g), G.identity, "product")
    assert is_close(G.compose(G.compose(g, h), k), G.compose(g, G.compose(h, k)), "product")
    assert is_close(G.inverse(G.compose(g, h)), G.compose(G.inverse(h), G.inverse(g)), "product")
    assert bool(G.belongs(G.compose(g, h), TOLERANCES["member"][0]).all())
    assert bool(G.belongs(G.inverse(g), TOLERANCES["member"][0]).all())


def slope(sizes, errors):
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


SIZES = np.array([0.2, 0.1, 0.05, 0.025])


# -- every registered group: adjoint and coadjoint action -------------------------------------------------------------


@pytest.mark.sampled(1)
@given(seed=seeds)
def test_adjoint_action(G, seed):
    x, y, z = elements(G, seed, 3)
    g, h = G.exp(x), G.exp(y)
    conjugate = g @ G.algebra.hat(z) @ G.inverse(g)
    assert is_close(jnp.einsum("...ab,...b->...a", G.Ad(g), z), G.algebra.vee(conjugate), "product")
    assert is_close(G.Ad(G.compose(g, h)), G.Ad(g) @ G.Ad(h), "product")
    expected_action = scipy.linalg.expm(np.asarray(G.algebra.ad(x)))
    assert is_close(G.Ad(g), expected_action, "adjoint", np.abs(expected_action).max())


@pytest.mark.sampled(7)
@given(seed=seeds)
def test_coadjoint_action(G, seed):
    (x, y), mu = elements(G, seed, 2), duals(G, seed)
    g, h = G.exp(x), G.exp(y)

    def pairing(mu, x):
        return (np.asarray(mu) * x).sum(axis=-1)

    adjoint_y = np.einsum("...ab,...b->...a", G.Ad(g), y)
    assert is_close(pairing(G.Ad_star(g, mu), y), pairing(mu, adjoint_y), "product")
    assert is_close(G.Ad_star(G.compose(g, h), mu), G.Ad_star(h, G.Ad_star(g, mu)), "product")
    if not G.algebra.is_abelian():  # control: the action of the inverse, another convention in use, is not dual
        assert not is_close(pairing(G.Ad_star(G.inverse(g), mu), y), pairing(mu, adjoint_y), "product", 1e6)


# -- every registered group: Cayley -----------------------------------------------------------------------------------


@pytest.mark.sampled(2)
def test_cayley(G):
    if G.name in ("SL(3)", "SU(3)"):
        for call in (lambda: G.cayley(np.zeros(G.dim)), lambda: G.inverse_cayley(G.identity)):
            with pytest.raises(mf.LieAlgebraError, match=r"does not take s[lu].3. into S[LU]\(3\).*use exp"):
                call()
        return
    x = elements(G, 3)
    g, X = G.cayley(x), np.asarray(G.algebra.hat(x))
    identity = np.eye(G.matrix_size)
    assert bool(G.belongs(g, TOLERANCES["member"][0]).all())
    assert is_close(g, np.linalg.solve(identity - X / 2, identity + X / 2), "product")
    assert is_close(G.cayley(-x), G.inverse(g), "product")
    assert is_close(G.inverse_cayley(g), x, "product")
    x = x[:1] * SIZES[:, None]
    errors = np.abs(G.cayley(x) - G.exp(x)).max(axis=(-2, -1))
    if G.algebra.is_nilpotent() and not G.algebra.is_abelian():  # X^3 = 0, and the two agree
        assert is_close(errors, 0.0, "member")
    else:
        assert abs(slope(SIZES, errors) - 3) < 0.2


GROUPS_WITH_ADJOINT_CAYLEY = (
    "SO(2)",
    "SO(3)",
    "SO(4)",
    "SE(2)",
    "SE(3)",
    "SU(2)",
    "SL(2)",
    "GL(2)",
    "Heisenberg(1)",
    "Heisenberg(2)",
)
"""Groups in which Cayley's map of ad x is an adjoint action, listed by hand."""


@pytest.mark.sampled(1)
def test_adjoint_cayley(G):
    if G.name not in GROUPS_WITH_ADJOINT_CAYLEY:
        with pytest.raises(mf.LieAlgebraError, match=r"an adjoint action does not take .* misses by 0\.0.*use exp"):
            G.adjoint_cayley(np.zeros(G.dim))
        return
    x, mu = elements(G, 3), duals(G, 3)
    g, ad = G.adjoint_cayley(x), np.asarray(G.algebra.ad(x))
    identity = np.eye(G.dim)
    assert bool(G.belongs(g, TOLERANCES["member"][0]).all())
    assert is_close(G.Ad(g), np.linalg.solve(identity - ad / 2, identity + ad / 2), "product")
    nu = np.asarray(G.Ad_star(g, mu))
    assert is_close(nu, mu + G.algebra.ad_star(x, (mu + nu) / 2), "product")  # a step of the midpoint scheme
    if not G.algebra.is_abelian():  # where every map will do; else the same by way of the exponential
        assert is_close(G.adjoint_cayley(x / 2), maps.adjoint_cayley(G.algebra, x / 2), "product")
    gaps = np.abs(G.adjoint_cayley(x[:1] * SIZES[:, None]) - G.exp(x[:1] * SIZES[:, None])).max(axis=(-2, -1))
    assert gaps[-1] < 2e-15 or abs(slope(SIZES, gaps) - 3) < 0.2
    assert G.cayley_is_adjoint() == bool(is_close(G.cayley(x), g, "product"))


@pytest.mark.sampled(1)
def test_maps_stay_in_the_group(G):
    """The measured defects of the maps agree with the declarations of the constructor."""
    tolerance = TOLERANCES["member"][0]
    assert G.map_defect("exp") <= tolerance
    assert (G.map_defect("cayley") <= tolerance) is (G.cayley_map is not None)
    assert (G.map_defect("adjoint_cayley") <= tolerance) is (G.adjoint_cayley_map is not None)


@pytest.mark.sampled(5)
def test_restoring_squares_the_distance(G):
    g = np.asarray(G.exp(elements(G, 20)))
    restored = np.asarray(G.restore_map(g + 1e-5 * np.random.default_rng(0).standard_normal(g.shape)))
    assert is_close(G.restore_map(g), g, "product")
    assert bool(G.belongs(restored, 1e-8).all())


# -- every registered group: arrays, derivatives, compiled programs ---------------------------------------------------


def test_exp_and_log_equal_scipy(G):
    x = elements(G, 4)
    g = np.asarray(G.exp(x))
    expected_elements = scipy.linalg.expm(np.asarray(G.algebra.hat(x)))
    assert is_close(g, expected_elements, "reference", np.abs(expected_elements).max())
    logarithms = np.stack([scipy.linalg.logm(one) for one in g])
    assert is_close(G.algebra.hat(G.log(g)), logarithms, "reference")


@pytest.mark.sampled(3)
def test_elements_of_a_batch_do_not_meet(G):
    x, mu = elements(G, 5), duals(G, 5)
    g = G.exp(x)
    copies = np.stack([g[2]] * BATCH_SIZE)
    assert is_close(G.exp(np.stack([x[2]] * BATCH_SIZE)), copies, "member")
    assert is_close(G.log(copies), np.stack([G.log(g)[2]] * BATCH_SIZE), "roundtrip")
    assert is_close(G.Ad(copies), np.stack([G.Ad(g)[2]] * BATCH_SIZE), "product")
    assert is_close(G.Ad_star(copies, mu)[1], G.Ad_star(np.stack([g[2], g[2], g[0], g[1]]), mu)[1], "product")
    assert G.belongs(g).shape == (BATCH_SIZE,)


@pytest.mark.sampled(6)
def test_tiny_elements_keep_their_digits(G):
    x = elements(G, 8, size=1e-9)
    X = np.asarray(G.algebra.hat(x))
    is_off_diagonal = ~np.eye(G.matrix_size, dtype=bool)
    assert is_close(G.exp(x)[:, is_off_diagonal], (X + X @ X / 2)[:, is_off_diagonal], "roundtrip", 1e-9)


# -- every registered group: the edge of the domain of log ------------------------------------------------------------

PLANE_ROTATION = {
    "SO(2)": [1.0],
    "SO(3)": [0.0, 0.0, 1.0],
    "SO(4)": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "SE(2)": [1.0, 0.0, 0.0],
    "SE(3)": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
    "SU(2)": [0.0, 0.0, 2.0],
    "SU(3)": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3.0**0.5],
    "SL(2)": [0.0, 1.0, -1.0],
    "SL(3)": [0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0],
    "Sp(2)": [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0],
    "GL(2)": [0.0, 1.0, -1.0, 0.0],
}
"""Algebra element with the eigenvalues i and -i, in every group that rotates a plane; in SU(3) with i and -i/2."""

ELEMENTS_WITHOUT_LOG = {
    "SO(3)": [(np.diag([1.0, 1.0, -1.0]), "relative distance 2,")],
    "SO(4)": [(-np.eye(4), "eigenvalue -1")],
    "SU(2)": [(-np.eye(2), "eigenvalue -1")],
    "SL(2)": [(np.diag([-2.0, -0.5]), "eigenvalue -2 at the angle 3.1415926536")],
    "GL(2)": [(np.diag([3.0, -2.0]), "eigenvalue -2 .*det g = -6;")],
}
"""Matrices without a principal logarithm, and a part of the message."""


@pytest.mark.sampled(2)
def test_log_up_to_the_half_turn(G):
    """The error is rounding in compact directions; in others the condition number of the logarithm is 1/gap."""
    if G.algebra.is_nilpotent() and not G.algebra.is_abelian():
        assert G.name not in PLANE_ROTATION  # log is defined on the whole of a Heisenberg group
        return
    compact = G.name[:2] in ("SO", "SE", "SU")
    plane = np.asarray(G.Ad(G.exp(elements(G, 14)))) @ PLANE_ROTATION[G.name]
    for gap in (1e-2, 1e-4, 1e-6, 1e-7):
        x = (pi - gap) * plane
        name, scale = ("half_turn", 1.0) if compact else ("half_turn_condition", 1 / gap)
        assert is_close(G.log(G.exp(x)), x, name, scale)
    for gap in (1e-9, 0.0) if compact else ():  # elsewhere rounding has split the pair already
        g = G.exp((pi - gap) * plane)
        if G.name.startswith("SU"):
            with pytest.raises(
                mf.DomainError, match=r"has the eigenvalue -1.* at the angle 3\.14159.*below pi - 1e-08, since.*: take"
            ):
                G.log(g)
        else:
            assert is_close(G.exp(G.log(g)), g, "half_turn", 10.0)
    for matrix, message in ELEMENTS_WITHOUT_LOG.get(G.name, []):
        with pytest.raises(mf.DomainError, match=rf"g\[0\] .*{message}"):
            G.log([matrix] * BATCH_SIZE)


@pytest.mark.sampled("group1-3")
@pytest.mark.parametrize(
    ("group", "count"), [(mf.SO(2), 1), (mf.SO(3), 3), (mf.SO(4), 6), (mf.SE(2), 1), (mf.SE(3), 3)]
)
def test_one_of_the_two_logarithms_of_a_half_turn(group, count):
    """The logarithm is pi times the axis with positive first component, whatever the rounding; its derivative is right
    too."""
    for i in range(count):
        axis = np.eye(count)[i] if count > 3 else np.eye(count)[i] + 0.3 * np.arange(count) * (np.arange(count) > i)
        axis /= np.linalg.norm(axis)
        expected_log = np.concatenate([pi * axis, np.zeros(group.dim - count)])
        turns = expected_log * np.array([1.0, -1.0, 1.0 - 1e-10, -1.0 + 1e-10, 1.0 + 1e-15, 1.0 - 1e-15])[:, None]
        logs = np.asarray(group.log(group.exp(turns)))
        assert np.abs(logs - expected_log).max() < 1e-9
        assert is_close(group.exp(logs), group.exp(turns), "half_turn", 10.0)
    g = group.exp(expected_log)
    derivative = jax.jvp(group.log, (g,), (g @ group.algebra.hat(expected_log / pi),))[1]
    assert is_close(derivative, expected_log / pi, "derivative", 10.0)


def test_the_logarithm_at_a_half_turn_of_an_affine_motion():
    """For the screw of SE(3) and the rotation about a point of SE(2) the translation counts too."""
    for group, count in ((mf.SE(2), 1), (mf.SE(3), 3)):
        x = np.concatenate([pi * np.ones(count) / np.sqrt(count), [0.3, -0.7, 0.2][: group.dim - count]])
        assert is_close(group.log(group.exp(x)), x, "half_turn", 10.0)


# -- every registered group: what is refused --------------------------------------------------------------------------


@pytest.mark.sampled(3)
def test_off_the_group(G):
    g = np.array(G.exp(elements(G, 10)))
    if G.name.startswith("GL"):
        g[1] = 0.0
    else:
        g[1] *= 1.001  # moves the determinant, the last row or the diagonal of every other group
    assert G.belongs(g).tolist() == [True, False, True, True]
    with pytest.raises(mf.DomainError, match=r"g\[1\] is not in the group: relative distance .* tolerance 1e-08"):
        G.log(g)
    g[1] = np.nan
    assert not G.belongs(g)[1]
    with pytest.raises(mf.DomainError, match=r"g\[1\] has entries that are not finite"):
        G.log(g)


def test_wrong_shapes_and_kinds(G):
    with pytest.raises(mf.ShapeError, match="last axis"):
        G.exp(np.zeros(G.dim + 1))
    for operation in (G.log, G.inverse, G.Ad, G.belongs):
        with pytest.raises(mf.ShapeError, match="last axes"):
            operation(np.zeros((G.matrix_size, G.matrix_size + 1)))
    with pytest.raises(mf.ComponentError):
        G.exp(np.zeros(G.dim, dtype=complex))
    if G.name.startswith("SU"):
        assert bool(G.belongs(np.eye(G.matrix_size)))
    else:
        with pytest.raises(mf.ComponentError, match="must be real"):
            G.log(np.eye(G.matrix_size, dtype=complex))


# -- groups of one's own ----------------------------------------------------------------------------------------------


def test_a_group_whose_cayley_map_leaves_it():
    """The general Cayley map is the default of a new group, but it leaves SL(3)."""
    group = mf.MatrixGroup("mine", mf.sl(3), lambda g: jnp.abs(jnp.linalg.det(g) - 1.0))
    for call in (lambda: group.cayley(np.zeros(8)), lambda: jax.jit(group.cayley)(np.zeros(8))):
        with pytest.raises(mf.LieAlgebraError, match=r"sl\(3\) into mine: .* misses by 0\.0\d+ .*use exp") as info:
            call()
        assert info.value.tolerance < 1e-3 < info.value.residual
    assert group.map_defect("exp") < 1e-14
    assert not group.cayley_is_adjoint()
    with pytest.raises(mf.LieAlgebraError, match="has no cayley_map"):
        replace(mf.SO(3), cayley_map=None).cayley(np.zeros(3))


# -- particular groups ------------------------------------------------------------------------------------------------


PROGRAMS = [mf.SO(3), mf.SE(3), mf.SU(2), mf.Heisenberg(1), mf.SL(2)]
"""Groups that cover every closed form and the general functions, for properties of programs rather than of groups."""
each_program = pytest.mark.parametrize("group", PROGRAMS, ids=lambda group: group.name)


@pytest.mark.sampled(1)
@each_program
def test_gradient_of_log_after_exp_is_that_of_the_identity(group):
    """At zero, near it and elsewhere; vmap is used, so that it is compared to batches too."""

    def pairing(x, mu):
        return jnp.dot(mu, group.log(group.exp(x)))

    vmap_value_and_grad, mu = jax.jit(jax.vmap(jax.value_and_grad(pairing))), duals(group, 6)
    for size in (0.0, 1e-10, 1.0):
        x = elements(group, 7, size=size)
        value, gradient = vmap_value_and_grad(x, mu)
        assert is_close(value, (mu * x).sum(axis=-1), "roundtrip")
        assert is_close(gradient, mu, "derivative")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("group", [mf.SO(3), mf.SL(2)], ids=lambda group: group.name)
def test_batches_equal_loops(group):
    x, mu = elements(group, 5).reshape(2, 2, -1), duals(group, 5)[0]
    g = group.exp(x)
    assert g.shape == (2, 2, group.matrix_size, group.matrix_size)
    assert is_close(g[1, 0], group.exp(x[1, 0]), "member")
    assert is_close(group.Ad(g)[1, 0], group.Ad(g[1, 0]), "product")
    assert is_close(group.Ad_star(g, mu)[1, 0], group.Ad_star(g[1, 0], mu), "product")
    assert group.belongs(g).shape == (2, 2)
    assert group.belongs(g[0, 0]).shape == ()


@pytest.mark.sampled(2)
@each_program
def test_compiled_programs_make_no_lapack_calls(group):
    """Two LAPACK calls in one program can wait for each other forever (see manifolds.matrices.linear.solve)."""

    def everything(x):
        return group.Ad(group.inverse(group.cayley(group.log(group.exp(x)))))

    assert "lapack" not in jax.jit(everything).lower(elements(group, 9)).as_text()


@pytest.mark.slow
def test_second_derivatives():
    group = mf.SO(3)
    x, mu = elements(group, 11)[0], duals(group, 11)[0]
    shift = group.exp(elements(group, 12)[0])

    def f(x):
        return jnp.dot(mu, group.log(group.compose(group.exp(x), shift)))

    derivatives = jax.jit(lambda x: (jax.jacrev(f)(x), jax.jacfwd(jax.jacrev(f))(x)))
    h = 1e-4
    for point in (x, np.zeros(group.dim)):
        gradient, hessian = derivatives(point)
        rates = [(f(point + h * e) - f(point - h * e)) / (2 * h) for e in np.eye(group.dim)]
        assert is_close(gradient, rates, "central_difference")
        assert is_close(hessian, hessian.T, "derivative")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("group", [mf.SO(3), mf.SL(2)], ids=lambda group: group.name)
def test_log_is_nan_under_tracing_where_it_would_raise(group):
    g = np.array(group.exp(elements(group, 14)))
    g[1] *= 1.001
    g[2] = np.diag([-1.0, -1.0, 1.0][: group.matrix_size])  # a half turn in SO(3), none at all in SL(2)
    is_nan = np.isnan(jax.jit(group.log)(g)).any(axis=1).tolist()
    assert is_nan == [False, True, group.name == "SL(2)", False]


@pytest.mark.parametrize(
    ("group", "x", "eigenvalue"),
    [(mf.GL(1), [2.0], "2"), (mf.GL(1), [-2.0], "-2"), (mf.SL(2), [2.0, 0.0, 0.0], "-?2")],
)
def test_poles_of_the_cayley_map(group, x, eigenvalue):
    with pytest.raises(mf.DomainError, match=f"x\\[1\\] has the eigenvalue {eigenvalue},.*shorten x or use exp"):
        group.cayley([np.zeros(group.dim), x])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("n", [2, 3, 4])
def test_inverse_cayley_near_the_half_turn(n):
    """The values 2 tan(a/2) grow without bound, and with them the condition number of the map."""
    group, x = mf.SO(n), np.eye(mf.SO(n).dim)[0]
    for length in (1e2, 1e4, 1e6):
        x_again = group.inverse_cayley(group.cayley(length * x))
        assert is_close(x_again, length * x, "half_turn_condition", length**2)
    half_turn = np.diag([-1.0, -1.0, *[1.0] * (n - 2)])
    with pytest.raises(
        mf.DomainError, match=r"g\[1\] has the eigenvalue -1.*inverse Cayley map needs no eigenvalue -1"
    ):
        group.inverse_cayley([np.eye(n), half_turn])


def test_inverse_cayley_beyond_a_rotation_by_pi():
    """SU(2) covers the rotations twice, so its inverse Cayley map reaches angles up to 2 pi."""
    group = mf.SU(2)
    x = np.array([[0.0, 0.0, length] for length in (1e-9, 1.0, 4.0, 4.1, 40.0)])
    assert is_close(
        group.inverse_cayley(group.cayley(x)) / (1 + x[:, 2:] ** 2 / 16), x / (1 + x[:, 2:] ** 2 / 16), "member"
    )
    with pytest.raises(mf.DomainError, match="inverse_cayley"):
        group.inverse_cayley(-np.eye(2))


def test_adjoint_action_off_the_group():
    with pytest.raises(mf.DomainError, match=r"Ad on SO\(3\): g is not in the group: relative distance 1,"):
        mf.SO(3).Ad([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def test_an_element_that_is_constant_in_a_compiled_program_is_checked_while_it_is_traced():
    group, mu = mf.SO(3), np.array([1.0, 2.0, 3.0])
    g, not_in_group = group.exp([0.3, -0.2, 0.5]), 2 * group.identity
    assert is_close(jax.jit(lambda mu: group.Ad_star(g, mu))(mu), group.Ad_star(g, mu), "member")
    with pytest.raises(mf.DomainError, match="not in the group"):
        jax.jit(lambda mu: group.Ad_star(not_in_group, mu))(mu)


def test_random_elements():
    group = mf.SU(2)
    g = group.random(3, (2, 5))
    assert g.shape == (2, 5, 2, 2)
    assert bool(group.belongs(g).all())
    assert np.array_equal(g, group.random(jax.random.key(3), (2, 5)))
    assert group.random(3).shape == (2, 2)


def test_groups_are_static_and_compare_by_value():
    twins = list(zip(mf.registered_groups(), mf.registered_groups(), strict=True))
    for group_a, group_b in twins:
        assert group_a is not group_b
        assert group_a == group_b
        assert hash(group_a) == hash(group_b)
        assert jax.tree_util.tree_leaves(group_a) == []
    assert len({one for one, _ in twins}) == len(twins)
    group = mf.SO(3)
    assert is_close(jax.jit(lambda group, x: group.exp(x))(group, np.zeros(3)), group.identity, "member")
    assert repr(group) == "MatrixGroup('SO(3)', dim=3)"


def test_inverse_of_a_singular_matrix():
    with pytest.raises(mf.DomainError, match=r"GL\(2\): g\[1\] has no inverse"):
        mf.GL(2).inverse([np.eye(2), [[1.0, 2.0], [2.0, 4.0]]])


def test_log_of_large_and_small_scales():
    group = mf.GL(2)
    factors = np.array([1e-100, 1e-10, 1e10, 1e100])
    expected_logs = np.log(factors)[:, None] * np.array([1.0, 0.0, 0.0, 1.0])
    assert is_close(group.log(factors[:, None, None] * np.eye(2)), expected_logs, "roundtrip", 100.0)


def test_a_group_of_ones_own():
    """An algebra with matrices and a defect are enough, as the docstring promises."""
    group = mf.MatrixGroup("Aff+(1)", mf.aff(1), lambda g: jnp.abs(g[..., 1, :] - jnp.array([0.0, 1.0])).max(axis=-1))
    x = elements(group, 13)
    g = group.exp(x)
    assert is_close(group.log(g), x, "roundtrip")
    assert is_close(g[:, 0, 0], np.exp(x[:, 0]), "member")
    assert bool(group.belongs(group.inverse(g)).all())


@pytest.mark.parametrize(
    "defect",
    [
        lambda g: jnp.abs(g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0] - 1.0),
        lambda g: jnp.abs(jnp.linalg.det(g) - 1.0).max(),
    ],
    ids=["by entries", "a maximum over all"],
)
def test_a_defect_of_one_matrix_is_applied_to_each(defect):
    group = mf.MatrixGroup("mine", mf.sl(2), defect)
    assert group.map_defect("exp") < 1e-14
    g = np.stack([np.eye(2), 2.0 * np.eye(2), np.diag([2.0, 0.5])])
    assert group.belongs(g).tolist() == [True, False, True]
    assert group == mf.MatrixGroup("mine", mf.sl(2), defect)


def test_a_defect_with_an_index_out_of_range_is_refused():
    with pytest.raises(IndexError, match="defect of the group mine has the index 2 of an axis with 2 entries"):
        mf.MatrixGroup("mine", mf.sl(2), lambda g: jnp.abs(g[1, 1] * g[2, 2] - 1.0))


@pytest.mark.parametrize(
    ("defect", "fault"), [(lambda g: float(g[0, 0]), "an error"), (lambda g: g - 1.0, r"an array of shape \(2, 2\)")]
)
def test_what_is_no_defect(defect, fault):
    with pytest.raises(
        mf.LieAlgebraError, match=f"^the defect of mine must be a number for a matrix.* it gives {fault}$"
    ):
        mf.MatrixGroup("mine", mf.sl(2), defect)
