"""Homogeneous spaces against those that some are under other names; the suite of spaces runs on flags as well."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

EXACT = 1e-12
"""Of points, vectors and distances of order one; at most 3e-15 seen."""


def turn(n: int, i: int, j: int) -> np.ndarray:
    found = np.zeros((n, n))
    found[i, j], found[j, i] = -1.0, 1.0
    return found


def vectors(space, x, *seeds):
    found = [np.asarray(space.random_tangent(seed, x)) for seed in seeds]
    return [v / float(space.norm(x, v)) for v in found]


def close(a, b) -> bool:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max()) <= EXACT


CASES = {
    "sphere": (3, [turn(3, 0, 1)], mf.Sphere(2), lambda x: x[..., 2]),
    "frames": (4, [turn(4, 2, 3)], mf.Stiefel(4, 2), lambda x: x[..., :2]),
}
"""The group, the stabilizer, the space that its quotient is, and the map to it, which is linear."""


@pytest.mark.parametrize("case", [pytest.param(name, marks=[pytest.mark.slow][: name == "frames"]) for name in CASES])
def test_other_names_of_the_same(case):
    n, stabilizer, other, down = CASES[case]
    space = mf.Homogeneous(mf.SO(n), stabilizer)
    assert space.dim == other.dim
    x = np.asarray(space.random(1))
    u, v = vectors(space, x, 2, 3)
    y = space.exp(x, v)
    assert close(other.exp(down(x), down(v)), down(y))
    assert close(space.inner(x, u, v), other.inner(down(x), down(u), down(v)))
    assert close(down(space.transport(x, v, u)), other.transport(down(x), down(v), down(u)))
    assert close(space.log(x, y), v)
    h = mf.SO(n).exp(np.asarray(mf.so(n).vee(0.7 * np.array(stabilizer[0]))))
    assert close(space.distance(x @ h, y), other.distance(down(x), down(y)))
    assert not close(space.group_space.distance(x @ h, y), other.distance(down(x), down(y)))  # control


def test_flags_of_two_pieces_are_subspaces():
    flags, subspaces = mf.Flag(1, 2), mf.Grassmann(3, 1)
    x = np.asarray(flags.random(1))
    (v,) = vectors(flags, x, 2)
    y = flags.exp(x, v)
    before, after = (flags.projectors(z)[0] for z in (x, y))
    assert close(subspaces.distance(before, after), np.sqrt(2.0) * flags.distance(x, y))
    assert close(flags.projectors(x).sum(axis=0), np.eye(3))


def test_a_run_depends_on_the_class_alone():
    """Two elements of one class: the flags that they lead to are the same, and so are energy and entropy."""
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
    assert close(*ends)
    assert not close(runs[0].x[-1], runs[1].x[-1])


@pytest.mark.parametrize("many", [False, True])
def test_functions_that_are_not_of_classes_are_refused(many):
    """An entry of the rotation, which a turn within a piece changes; in a product too. The square of a row does not."""
    space = mf.Flag(1, 2) * mf.Euclidean(1) if many else mf.Flag(1, 2)

    def rotation(x):
        return space.split(x)[0] if many else x

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
            lambda: mf.Homogeneous(mf.SO(3), [turn(3, 0, 1), turn(3, 1, 2)]),
            mf.ParameterError,
            "no subalgebra.*add what",
        ),
        (
            lambda: mf.Homogeneous(mf.SO(3), [turn(3, 0, 1)] * 2),
            mf.ParameterError,
            "2 matrices .* span 1 dimensions only",
        ),
        (lambda: mf.Homogeneous(mf.SO(3), [np.eye(2)]), mf.ParameterError, r"shape \(k, 3, 3\), got \(1, 2, 2\)"),
        (
            lambda: mf.Homogeneous(mf.SO(3), [np.eye(3)]),
            mf.ParameterError,
            r"matrix 0 .* not in the algebra of SO\(3\)",
        ),
        (lambda: mf.Homogeneous(mf.SO(2), [turn(2, 0, 1)]), mf.ParameterError, "quotient is a single point"),
        (lambda: mf.Flag(3), mf.ParameterError, "at least two steps"),
        (lambda: mf.Correlation(2).point([[1.0, 1.5], [1.5, 1.0]]), mf.OffManifoldError, "least eigenvalue -0.5"),
        (lambda: mf.Correlation(2).point([[2.0, 0.5], [0.5, 2.0]]), mf.OffManifoldError, "residual 1, tolerance"),
    ],
)
def test_refusals(build, error, message):
    with pytest.raises(error, match=message) as refusal:
        build()
    assert "\n" not in str(refusal.value)
