"""Homogeneous spaces compared to the same spaces under other names; the suite of spaces runs on flags too."""

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
            "not a subalgebra.*add what",
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
