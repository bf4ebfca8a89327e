"""The flow as a differentiable function: its derivatives are those of the discrete flow."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import liethermo as lt
import manifolds as mf
from liethermo.runs import flow as flow_module
from liethermo.runs.flow_derivatives import solve_with_implicit_derivative

X0 = jnp.array([0.3, 1.0, 0.2])
PARAMETERS = jnp.array([10.0, 5.0, 1.0, 1.0])


def body(parameters):
    return lt.models.rigid_body(parameters[:3], parameters[3])


def nonlinear(parameters):
    inertia = parameters[:3]
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / inertia) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1]),
        lambda p: jnp.log(1.0 + p @ p),
        lt.ProjectedMetric(rate=parameters[3]),
    )


@pytest.mark.slow
def test_the_same_steps_as_integrate():
    """5.05 is no multiple of the step."""
    path = lt.flow(body(PARAMETERS), X0, (0.0, 5.05), 0.1, save_every=10)
    solution = lt.integrate(body(PARAMETERS), X0, (0.0, 5.05), 0.1, save_every=10, engine="array")
    assert path.shape == solution.x.shape
    assert np.abs(path - solution.x).max() < 1e-14
    assert np.array_equal(lt.flow(body(PARAMETERS), X0, (0.0, 5.05), 0.1), path[-1])


@pytest.mark.parametrize(
    ("build", "method"),
    [(body, lt.MetriplecticMidpoint()), pytest.param(nonlinear, lt.MetriplecticGauss(2), marks=pytest.mark.slow)],
    ids=["midpoint", "gauss"],
)
def test_derivatives_against_differences(build, method):
    """By initial state and parameters, forwards and backwards."""

    @jax.jit
    def end(parameters, x0):
        return lt.flow(build(parameters), x0, (0.0, 3.0), 0.1, method)

    forwards = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(PARAMETERS, X0)
    backwards = jax.jit(jax.jacrev(end, argnums=(0, 1)))(PARAMETERS, X0)
    for argument, (a, b) in enumerate(zip(forwards, backwards, strict=True)):
        assert np.abs(a - b).max() < 1e-12 * np.abs(a).max()
        for i in range(a.shape[1]):
            arguments = [PARAMETERS, X0]
            size = 1e-5 * float(jnp.abs(arguments[argument][i]))
            shifted_arguments = [[*arguments], [*arguments]]
            for sign, version in zip((1.0, -1.0), shifted_arguments, strict=True):
                version[argument] = arguments[argument].at[i].add(sign * size)
            difference = (end(*shifted_arguments[0]) - end(*shifted_arguments[1])) / (2 * size)
            assert np.abs(difference - a[:, i]).max() < 1e-7 * np.abs(a).max()


@pytest.mark.slow
def test_the_energy_is_conserved_in_every_derivative():
    """``dH(x(t)) / dx0 = dH / dx0``: the law holds for neighbouring trajectories too."""
    system = body(PARAMETERS)
    gradient = jax.grad(lambda x0: system.energy.value(lt.flow(system, x0, (0.0, 3.0), 0.1)))(X0)
    assert np.abs(gradient - system.energy.gradient(X0)).max() < 1e-13


def test_a_batch():
    states = jnp.asarray(np.random.default_rng(0).standard_normal((4, 3)))
    ends = jax.jit(jax.vmap(lambda x: lt.flow(body(PARAMETERS), x, (0.0, 2.0), 0.1)))(states)
    single_runs = lt.ensemble(body(PARAMETERS), states, (0.0, 2.0), 0.1).x
    assert np.abs(ends - single_runs).max() < 1e-13


@pytest.mark.slow
def test_newton_is_compiled_where_a_step_needs_it(monkeypatch):
    """Newton's method is two thirds of a program, and not in that of a derivative, whose slopes are known."""

    class NewtonCompiled(Exception):
        pass

    def raise_needed(equations):
        raise NewtonCompiled

    monkeypatch.setattr(flow_module, "solve_stages_or_nan", raise_needed)

    def end(x, h=0.125):
        return jnp.sum(lt.flow(nonlinear(PARAMETERS), x, (0.0, 4 * h), h) ** 3)

    assert np.isfinite(end(X0))
    assert np.isfinite(jax.grad(end)(X0)).all()
    with pytest.raises(NewtonCompiled):
        end(X0, 40.0)


def test_a_step_that_cannot_be_solved_gives_nan():
    system = lt.LiePoissonSystem(mf.so(3), lambda p: jnp.sum(jnp.sin(40.0 * p)), lt.Quadratic(np.ones(3)))
    assert np.isnan(lt.flow(system, [0.3, 1.0, -0.2], (0.0, 500.0), 50.0)).all()
    with pytest.raises(lt.InputError, match="positive"):
        lt.flow(system, X0, (0.0, 1.0), -0.1)


# -- parameters in closures ------------------------------------------------------------------------------------------


def system_with_closures(p, entropy=True):
    """p stands in closures alone, the energy's and, where there is one, the entropy's and the dissipation's."""
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda x: 0.5 * jnp.sum(x * x / jnp.array([3.0, 2.0, 1.0])) + p[0] * x[0] ** 4,
        (lambda x: p[1] * x @ x) if entropy else None,
        lt.ProjectedMetric(cometric=lambda x: p[1] * jnp.eye(3)) if entropy else None,
        momentum_maps={"square": lambda x: p[0] * x @ x} if not entropy else {},
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("entropy", [True, False], ids=["relaxing", "conservative"])
def test_a_system_that_closes_over_tracers(entropy):
    """The system is built under every transformation, with the field that numbers in place of tracers give."""

    def speed(p):
        return system_with_closures(p, entropy).vector_field(X0)

    p, d = jnp.array([0.3, 0.5]), jnp.array([1e-4, -2e-4])
    difference = 0.5 * (speed(p + d) - speed(p - d))
    for derivative in (
        jax.jacfwd(speed)(p) @ d,
        jax.jacrev(speed)(p) @ d,
        jax.jit(jax.jacfwd(speed))(p) @ d,
        0.5 * jnp.array([1.0, -1.0]) @ jax.vmap(speed)(jnp.stack([p + d, p - d])),
    ):
        assert np.abs(derivative - difference).max() < 1e-10
    traced_systems = []
    jax.eval_shape(lambda p: traced_systems.append(system_with_closures(p, entropy).energy.is_quadratic), p)
    assert traced_systems == [False]


@pytest.mark.slow
@pytest.mark.parametrize("entropy", [True, False], ids=["relaxing", "free"])
def test_derivatives_by_parameters_in_a_closure(entropy):
    """Outside of jit, backwards; against differences of the flow."""

    def end(p):
        return lt.flow(system_with_closures(p, entropy), X0, (0.0, 0.5), 0.1)[0]

    p, d = jnp.array([0.3, 0.5]), jnp.array([1e-5, -2e-5])
    difference = 0.5 * (end(p + d) - end(p - d))
    assert np.abs(jax.grad(end)(p) @ d - difference) < 1e-6 * np.abs(difference)


@pytest.mark.slow
def test_closures_in_a_batch_and_in_jit():
    def end(p):
        return lt.flow(system_with_closures(p), X0, (0.0, 0.5), 0.1)

    p = jnp.array([[0.3, 0.5], [0.4, 0.6]])
    alone = jnp.stack([end(p[0]), end(p[1])])
    assert np.abs(jax.vmap(end)(p) - alone).max() < 1e-15
    assert np.abs(jax.jit(end)(p[0]) - alone[0]).max() < 1e-15


def test_a_body_of_traced_numbers():
    """In a tuple, as in an array."""

    def rates(build):
        return jax.jacfwd(lambda p: build(p).vector_field(X0))(10.0)

    one = rates(lambda p: lt.models.rigid_body((p, 5.0, 1.0), p / 10.0))
    assert np.array_equal(one, rates(lambda p: body(jnp.stack([p, 5.0, 1.0, p / 10.0]))))
    assert np.abs(one).max() > 0.0


MODELS = {
    "rigid_body": lambda p: lt.models.rigid_body((p, 5.0, 1.0), p),
    "free_rigid_body": lambda p: lt.models.free_rigid_body((p, 5.0, 1.0)),
    "damped_oscillator": lambda p: lt.models.damped_oscillator(p, p, p),
    "gas_piston": lambda p: lt.models.gas_piston(mass=p),
    "mass_spring_gas": lambda p: lt.models.mass_spring_gas(mass=p, friction=p),
    "cylinder": lambda p: lt.models.cylinder(mass=p, friction=p, pressure=p, heat_power=p),
    "heat_grid": lambda p: lt.models.heat_grid((2, 2), p, p),
    "body_with_wheels": lambda p: lt.models.body_with_wheels((p, 2.0, 1.0), (p, p, p), p),
    "thermoelastic_chain": lambda p: lt.models.thermoelastic_chain(stiffness=p, conductance=p, gravity=p),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_models_of_traced_numbers(name):
    """Every parameter may be a tracer, and the field is the one with the number in its place."""
    p = 1.2
    system = MODELS[name](p)
    x = 0.5 + 0.05 * np.arange(system.dim)
    expected = system.vector_field(x)
    field = jax.jit(lambda p: MODELS[name](p).vector_field(x))(p)
    assert np.abs(field - expected).max() < 1e-14 * np.abs(expected).max()


# -- derivatives of derivatives --------------------------------------------------------------------------------------


def root(p, x):
    """y with ``y + p sin(y) / 2 = x``, three times over in a loop."""

    def solve(parameters, guess):
        p, x = parameters
        return jax.lax.while_loop(lambda c: c[0] < 60, lambda c: (c[0] + 1, x - 0.5 * p * jnp.sin(c[1])), (0, guess))[1]

    def misfit(parameters, y):
        p, x = parameters
        return y + 0.5 * p * jnp.sin(y) - x

    return jax.lax.scan(
        lambda x, _: (solve_with_implicit_derivative(solve, misfit, (p, x), x), None), x[None], length=3
    )[0][0]


@pytest.mark.slow
def test_implicit_functions_have_derivatives_of_derivatives():
    """In every combination of modes, through a loop and in a batch."""
    p, x = 0.7, np.array([0.3, 1.0])
    y, y_first, second = x, np.ones(2), np.zeros(2)
    for _ in range(3):
        y = np.array([scipy.optimize.brentq(lambda y, x=x: y + 0.5 * p * np.sin(y) - x, -2.0, 2.0) for x in y])
        slope = 1.0 / (1.0 + 0.5 * p * np.cos(y))
        y_first, second = slope * y_first, 0.5 * p * np.sin(y) * slope**3 * y_first**2 + slope * second
    modes = jax.jacfwd, jax.jacrev
    for outer, inner in itertools.product(modes, modes):
        slopes = inner(root, 1)
        derivatives = [jax.jit(jax.vmap(f, (None, 0)))(p, x) for f in (slopes, outer(slopes, 1))]
        assert np.abs(derivatives[0] - y_first).max() < 1e-12
        assert np.abs(derivatives[1] - second).max() < 1e-12
    guess_derivative = jax.grad(
        lambda guess: solve_with_implicit_derivative(lambda p, guess: p, lambda p, y: y - p, p, guess)
    )(0.0)
    assert guess_derivative == 0.0
    second_derivatives = (
        jax.jit(jax.jacrev(jax.jacrev(root, 0), 0))(p, x[0]),
        jax.jit(jax.jacfwd(jax.jacfwd(root, 0), 0))(p, x[0]),
    )
    assert np.abs(second_derivatives[0] - second_derivatives[1]) < 1e-12


@pytest.mark.slow
def test_second_derivatives():
    """In every combination of modes, by state and by a parameter in a closure."""

    def end(y):
        return lt.flow(system_with_closures(jnp.stack([y[3], 0.5])), y[:3], (0.0, 0.3), 0.1)[0]

    y = jnp.append(X0, 0.3)
    forwards, backwards = jax.jacfwd, jax.jacrev
    hessians = [a(b(end))(y) for a in (forwards, backwards) for b in (forwards, backwards)]
    for hessian in hessians:
        assert np.abs(hessian - hessians[0]).max() < 1e-12 * np.abs(hessians[0]).max()
    gradient, size = jax.jit(jax.grad(end)), 1e-5
    differences = np.stack([(gradient(y + size * e) - gradient(y - size * e)) / (2 * size) for e in np.eye(4)])
    assert np.abs(differences - hessians[0]).max() < 1e-8 * np.abs(hessians[0]).max()


# -- loops of unknown length ------------------------------------------------------------------------------------------


def looping(p):
    """``p**3 x_0^2 / 2 + cos(x_1)``, by a loop of unknown length."""

    def energy(x):
        product = jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * p), (0, 0.5 * x[0] ** 2))[1]
        return product + jnp.cos(x[1])

    return lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.5))


def unrolled_system(p):
    energy = lambda x: 0.5 * p**3 * x[0] ** 2 + jnp.cos(x[1])  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.5))


@pytest.mark.slow
def test_a_loop_of_unknown_length_in_an_energy():
    """Such a loop has no derivative backwards in JAX; here its derivatives are taken forwards in every mode."""
    modes = jax.jacfwd, jax.jacrev
    for derivative in (lambda f: f, *modes, *(lambda f, a=a, b=b: a(b(f)) for a in modes for b in modes)):
        a, b = (
            derivative(lambda p, build=build: build(p).vector_field(X0))(1.2) for build in (looping, unrolled_system)
        )
        assert np.abs(a - b).max() < 1e-12


@pytest.mark.slow
def test_a_flow_with_a_loop_of_unknown_length():
    a, b = (
        jax.value_and_grad(lambda p, build=build: lt.flow(build(p), X0, (0.0, 0.3), 0.1)[0])(1.2)
        for build in (looping, unrolled_system)
    )
    assert np.abs(np.subtract(a, b)).max() < 1e-13
    solution = lt.integrate(looping(1.2), X0, (0.0, 0.3), 0.1, engine="array")
    assert np.abs(solution.x[-1, 0] - a[0]) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        lt.MetriplecticGauss(1),
        lt.MetriplecticGauss(2),
        lt.MetriplecticMidpoint(),
    ],
    ids=str,
)
def test_the_derivative_at_an_equilibrium(method):
    """Quotients are 0/0 where nothing moves: the Jacobian is that of differences, and near ``expm`` of the field's."""

    def energy(m):
        return 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.1 * m[0] ** 4

    friction = lt.ProjectedMetric(rate=0.3)
    system = lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + jnp.dot(m, m)), friction)
    x, h = jnp.array([1.0, 0.0, 0.0]), 0.1
    end = jax.jit(lambda y: lt.flow(system, y, (0.0, h), h, method))
    derivative = np.asarray(jax.jit(jax.jacfwd(end))(x))
    steps = 1e-5 * np.eye(3)
    differences = np.stack([(np.asarray(end(x + d)) - np.asarray(end(x - d))) / 2e-5 for d in steps], axis=1)
    assert np.abs(derivative - differences).max() <= 1e-8
    exact = scipy.linalg.expm(h * np.asarray(jax.jacfwd(system.vector_field)(x)))
    assert np.abs(derivative - exact).max() <= 0.02 * h ** (method.order + 1)
    assert np.abs(exact - np.eye(3)).max() > 0.01


def test_a_system_has_the_parameters_of_the_object_whose_method_is_its_energy():
    """So one program serves many of them, and their derivatives are known."""

    def end(factor):
        system = lt.LiePoissonSystem(mf.so(3), energy=lt.Quadratic(jnp.diag(factor / jnp.array([3.0, 2.0, 1.0]))).value)
        return lt.flow(system, jnp.array([0.3, 0.5, 0.2]), (0.0, 0.3), 0.1)

    derivative = jax.jacfwd(end)(jnp.ones(3))
    h = 1e-6
    columns = [(end(jnp.ones(3) + h * e) - end(jnp.ones(3) - h * e)) / (2 * h) for e in np.eye(3)]
    assert np.abs(derivative - np.stack(columns, axis=1)).max() < 1e-9
    assert np.abs(derivative).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_found_at_once(order, monkeypatch):
    """They are those of the program that a transformation goes through, by states and by parameters together."""

    def end(y):
        return lt.flow(
            nonlinear(jnp.append(y[3] * PARAMETERS[:3], 0.5)), y[:3], (0.0, 0.2), 0.1, lt.MetriplecticGauss(2)
        )

    def nth_derivative(y):
        derivative = end
        for _ in range(order):
            derivative = jax.jacfwd(derivative)
        return derivative(y)

    y = jnp.append(X0, 1.0)
    derivatives = nth_derivative(y)
    monkeypatch.setattr(flow_module, "MAX_FORWARD_DERIVATIVES", 0)
    through = nth_derivative(y)
    assert np.abs(derivatives - through).max() < 1e-12 * np.abs(through).max()
    assert np.abs(through).max() > 1e-3


@pytest.mark.slow
def test_a_linearised_flow_in_another_program():
    """The residuals of a linearised flow can be a part of any program."""
    x, v = X0, jnp.array([0.1, -0.2, 0.3])
    end = lambda x: lt.flow(body(PARAMETERS), x, (0.0, 0.3), 0.1)  # noqa: E731
    _, push = jax.linearize(end, x)
    _, pull = jax.vjp(end, x)
    assert np.abs(jax.jit(push)(v) - jax.jvp(end, (x,), (v,))[1]).max() < 1e-15
    assert np.abs(jax.jit(lambda v: jax.jvp(end, (x,), (v,))[1])(v) - push(v)).max() < 1e-14
    assert abs(jax.jit(pull)(v)[0] @ v - v @ push(v)) < 1e-15
    assert np.abs(jax.jit(lambda: end(x))() - end(x)).max() < 1e-15


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"system": lambda x: x}, "needs a system.*got function"),
        ({"method": "DOP853"}, "must be an integrator.*got 'DOP853'"),
        ({"method": lt.Reference()}, "Reference runs single trajectories"),
        ({"step": lt.Adaptive(1e-6)}, "needs a fixed step.*lt.integrate"),
    ],
    ids=["system", "name", "reference", "adaptive"],
)
def test_what_is_for_another_kind_of_run(arguments, message):
    with pytest.raises(lt.InputError, match=message):
        lt.flow(**({"system": body(PARAMETERS), "x0": X0, "t_span": (0.0, 1.0), "step": 0.1} | arguments))


def test_times_are_not_differentiated():
    for derivative in (
        lambda: jax.grad(lambda h: lt.flow(body(PARAMETERS), X0, (0.0, 1.0), h)[0])(0.1),
        lambda: jax.jit(lambda T: lt.flow(body(PARAMETERS), X0, (0.0, T), 0.1))(1.0),
    ):
        with pytest.raises(lt.InputError, match=r"got traced values.*vector_field at the end"):
            derivative()


@pytest.mark.slow
def test_derivatives_in_other_units():
    """States of 1e20 and parameters of 1e-20 together: each derivative is that in units of one."""

    def end(y):
        return lt.flow(lt.LiePoissonSystem(mf.so(3), lambda m: 0.5 * jnp.sum(m * m * y[3:])), y[:3], (0.0, 1.0), 0.1)

    y, units = jnp.append(X0, 1.0 / PARAMETERS[:3]), np.repeat([1e20, 1e-20], 3)
    first_derivative, second = (derivative(y) for derivative in (jax.jacfwd(end), jax.hessian(end)))
    assert np.abs(jax.jacfwd(end)(units * y) * units / 1e20 - first_derivative).max() < 1e-15
    assert np.abs(jax.hessian(end)(units * y) * units[:, None] * units / 1e20 - second).max() < 1e-14
    assert np.abs(second).max() > 0.1
