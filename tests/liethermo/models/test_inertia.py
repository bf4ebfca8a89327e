"""Moments and tensors of inertia in every model and helper."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import liethermo as lt
from liethermo.models.body_with_wheels import body_with_wheels_rest
from liethermo.models.inertia import InertiaWarning
from liethermo.models.rotors import spin_temperature

MOMENTS = np.array([1.5, 2.0, 3.0])
TURN = Rotation.from_euler("zyx", [0.4, 0.2, -0.3]).as_matrix()
TENSOR = TURN @ np.diag(MOMENTS) @ TURN.T

OMEGA = np.array([0.3, -0.2, 0.5])

BUILDERS = {
    "rigid_body": lambda inertia: lt.models.rigid_body(inertia),
    "free_rigid_body": lambda inertia: lt.models.free_rigid_body(inertia),
    "tumbling_body": lambda inertia: lt.models.tumbling_body(inertia, rate=0.1),
    "damper_wheel": lambda inertia: lt.models.damper_wheel(inertia, TURN[:, 1]),
    "ring_damper": lambda inertia: lt.models.ring_damper(inertia, TURN[:, 1]),
    "dual_spin": lambda inertia: lt.models.dual_spin(inertia, TURN[:, 1]),
    "reaction_wheels": lambda inertia: lt.models.reaction_wheels(inertia, TURN.T),
    "body_with_wheels": lambda inertia: lt.models.body_with_wheels(inertia, (0.3, 0.3, 0.3)),
    "gravity gradient": lambda inertia: lt.torques.GravityGradient(inertia, 0.1),
    "periods": lambda inertia: lt.bodies.periods(inertia, [0.1, 0.2, 1.0]),
    "rate_of": lambda inertia: lt.bodies.rate_of(10.0, inertia, 1.0),
    "spin_temperature": lambda inertia: spin_temperature(1.0, 2.0, inertia),
    "body_with_wheels_rest": lambda inertia: body_with_wheels_rest(1.0, 2.0, inertia),
}
MODELS = [*BUILDERS][:8]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MODELS)
def test_a_tensor_is_the_body_in_turned_axes(name):
    """The angular momentum of a body is that of the same body in principal axes, turned."""
    turned = BUILDERS[name](TENSOR)
    build = BUILDERS[name]
    if name in ("damper_wheel", "ring_damper", "dual_spin"):
        build = lambda inertia: getattr(lt.models, name)(inertia, (0.0, 1.0, 0.0))  # noqa: E731
    elif name == "reaction_wheels":
        build = lambda inertia: lt.models.reaction_wheels(inertia)  # noqa: E731
    straight = build(MOMENTS)
    if name == "body_with_wheels":  # its state is the angular velocity; its wheels are about body axes, all alike
        f, g = (s.vector_field(s.state(angular_velocity=w)) for s, w in ((turned, OMEGA), (straight, TURN.T @ OMEGA)))
    else:
        f, g = (s.vector_field(s.state(angular_velocity=w)) for s, w in ((turned, OMEGA), (straight, TURN.T @ OMEGA)))
        momentum = turned.state(angular_velocity=OMEGA)[:3]
        assert np.allclose(momentum, TENSOR @ OMEGA, atol=1e-14)
    assert np.allclose(f[:3], TURN @ g[:3], atol=1e-14)
    if name != "body_with_wheels":
        assert np.allclose(f[3:], g[3:], atol=1e-14)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", BUILDERS)
def test_what_is_no_tensor_is_refused_and_what_no_body_has_is_warned_of(name):
    asymmetric = np.diag(MOMENTS) + 0.1 * np.eye(3, k=1)
    with pytest.raises(lt.InputError, match=r"symmetric|shape|positive"):
        BUILDERS[name](asymmetric)
    with pytest.raises(lt.InputError, match="positive"):
        BUILDERS[name](np.array([1.0, -2.0, 3.0]))
    with pytest.warns(InertiaWarning, match="no rigid body has"):
        BUILDERS[name](np.array([1.0, 1.1, 9.0]))
    with pytest.warns(InertiaWarning, match="no rigid body has"):
        BUILDERS[name](np.array([[1.0, -0.5, 0.0], [-0.5, 2.0, 0.0], [0.0, 0.0, 9.0]]))


@pytest.mark.parametrize("name", ["periods", "rate_of", "spin_temperature"])
def test_helpers_give_for_a_tensor_what_they_give_for_its_moments(name):
    if name == "periods":
        values = lt.bodies.periods(TENSOR, TURN @ [0.1, 0.2, 1.0])
        expected = lt.bodies.periods(MOMENTS, [0.1, 0.2, 1.0])
        assert np.allclose([*values], [*expected])
    else:
        assert np.allclose(BUILDERS[name](TENSOR), BUILDERS[name](MOMENTS))
    assert np.shape(BUILDERS[name](TENSOR)[0] if name == "periods" else BUILDERS[name](TENSOR)) == ()


def test_a_tensor_is_never_taken_for_the_moments_of_three_bodies():
    system = lt.models.free_rigid_body(MOMENTS, attitude=True, torque=lt.torques.GravityGradient(MOMENTS, 0.1))
    with pytest.raises(lt.InputError, match="tensor of inertia of one body"):
        lt.ensemble(system, OMEGA, (0.0, 0.1), 0.1, parameters={"torque.inertia": TENSOR})
    three = np.array([MOMENTS, MOMENTS[::-1], MOMENTS])  # bodies, since this is not symmetric
    assert len(lt.ensemble(system, OMEGA, (0.0, 0.1), 0.1, parameters={"torque.inertia": three})) == 3
    assert np.shape(lt.bodies.periods(three, OMEGA).rotation) == (3,)
    # rows of a tensor in a builder: at least one of them is refused, or warned of
    rows = np.array([[2.0, 0.5, 0.5], [0.5, 2.0, 0.5], [0.5, 0.5, 2.0]])
    with pytest.warns(InertiaWarning):
        lt.ensemble(lambda row: lt.models.tumbling_body(row, rate=0.1), OMEGA, (0.0, 0.1), 0.1, parameters=rows)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("tensor", [False, True])
@pytest.mark.parametrize("model", ["free_rigid_body", "tumbling_body"])
def test_a_slender_rod_turns_steadily(model, tensor):
    inertia = TURN @ np.diag([0.0, 2.0, 2.0]) @ TURN.T if tensor else np.array([0.0, 2.0, 2.0])
    axes = TURN if tensor else np.eye(3)
    rod = getattr(lt.models, model)(inertia, attitude=True, **({"rate": 0.1} if model == "tumbling_body" else {}))
    omega = axes @ [0.0, 0.3, -0.4]
    x0 = rod.state(angular_velocity=omega)
    assert np.allclose(x0[:3], 2.0 * omega, atol=1e-15)
    solution = lt.integrate(rod, x0, (0.0, 2.0), 0.1, lt.MetriplecticGauss(2))
    assert np.abs(lt.bodies.angular_velocity(solution) - omega).max() < 1e-15
    turned = Rotation.from_rotvec(solution.t[:, None] * omega).as_matrix()
    assert np.abs(solution.attitude - turned).max() < 1e-8  # steps of 0.1, order 4
    with pytest.raises(lt.InputError, match="cannot turn about it"):
        rod.state(angular_velocity=axes @ [0.1, 0.3, -0.4])


def test_a_rod_is_allowed_only_where_its_axis_plays_no_part():
    assert np.allclose(lt.torques.GravityGradient([0.0, 2.0, 2.0], 0.1)(0.0, np.zeros(3), TURN), [0.0] * 3, atol=0.1)
    for name in ("periods", "rate_of", "body_with_wheels"):
        with pytest.raises(lt.InputError, match="positive"):
            BUILDERS[name](np.array([0.0, 2.0, 2.0]))
    with pytest.raises(lt.InputError, match="positive"):
        lt.models.free_rigid_body([0.0, 1.0, 2.0])  # a lamina in its axis is no rod


def test_principal_axes_of_moments_are_those_of_their_diagonal_tensor():
    for part, expected in zip(
        lt.bodies.principal_axes([3.0, 2.0, 4.0]), lt.bodies.principal_axes(np.diag([3.0, 2.0, 4.0])), strict=True
    ):
        np.testing.assert_array_equal(part, expected)
    with pytest.raises(lt.InputError, match=r"\(3,\) or"):
        lt.bodies.principal_axes([3.0, 2.0])
