"""A message names the cause and the cure, and the cure works: each test follows the advice that it is given."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

START = np.array([0.1, 0.2, 1.0])
SPAN = (0.0, 1.0)
STEP = 0.1


def body(energy, **options):
    return lt.LiePoissonSystem(mf.so(3), energy, **options)


def run(system, x0=START, span=SPAN, step=STEP, method=None, **options):
    return lt.integrate(system, x0, span, step, method, **options)


def torque_of(f):
    return body(lambda m: m @ m, torque=f)


def friction_of(f):
    return body(lambda m: m @ m, entropy=lambda m: m @ m, dissipation=lt.FrictionOperator(f, rate=0.1), validate=False)


def event_of(f):
    return run(body(lambda m: m @ m + m[0] ** 2), until=f)


def tensor_of(f):
    return lt.MetriplecticSystem(f, lambda x: x @ x, dim=2, validate=False)


# -- functions --------------------------------------------------------------------------------------------------------


def with_if(m):
    if m[0] > 0.0:
        return m[0] ** 2
    return m[1] ** 2


def function_without_return(m):
    m[0] ** 2


FUNCTIONS = {
    # what is wrong: (how it is used, the function, what the message says, what it recommends)
    "numpy": (body, lambda m: np.sin(m[0]) + m @ m, "NumPy.*np.sin by jnp.sin", lambda m: jnp.sin(m[0]) + m @ m),
    "math": (body, lambda m: math.sin(m[0]) + m @ m, "math.sin by jnp.sin", lambda m: jnp.sin(m[0]) + m @ m),
    "if": (body, with_if, "`if`.*jnp.where or jax.lax.cond", lambda m: jnp.where(m[0] > 0.0, m[0] ** 2, m[1] ** 2)),
    "if, by cond": (
        body,
        with_if,
        "jax.lax.cond",
        lambda m: jax.lax.cond(m[0] > 0.0, lambda m: m[0] ** 2, lambda m: m[1] ** 2, m),
    ),
    "max": (body, lambda m: max(m[0], m[1]) ** 2, "jnp.maximum", lambda m: jnp.maximum(m[0], m[1]) ** 2),
    "index": (
        body,
        lambda m: [1.0, 2.0, 3.0][jnp.argmax(m)] * m @ m,
        "Python integer.*jax.numpy",
        lambda m: jnp.array([1.0, 2.0, 3.0])[jnp.argmax(m)] * m @ m,
    ),
    "mask": (body, lambda m: jnp.sum(m[m > 0] ** 2), "jnp.where", lambda m: jnp.sum(jnp.where(m > 0, m, 0.0) ** 2)),
    "return": (body, function_without_return, "returns None. Add the missing `return`", lambda m: m[0] ** 2),
    "float32": (
        body,
        lambda m: jnp.sum(m.astype(jnp.float32) ** 2 * jnp.array([1.0, 2.0, 3.0])),
        r"float32.*Leave out float32, such as astype\(jnp.float32\)",
        lambda m: jnp.sum(m**2 * jnp.array([1.0, 2.0, 3.0])),
    ),
    "torque": (
        torque_of,
        lambda t, m: np.array([np.sin(t), 0.0, 0.0]),
        "the torque.*np.sin by jnp.sin",
        lambda t, m: jnp.array([jnp.sin(t), 0.0, 0.0]),
    ),
    "torque without return": (torque_of, lambda t, m: None, "the torque.*returns None", lambda t, m: 0.1 * m),
    "friction": (friction_of, lambda m: np.outer(m, m), "friction operator K.*NumPy", lambda m: jnp.outer(m, m)),
    "event without return": (event_of, function_without_return, "the event function.*returns None", lambda m: m[0]),
    "several events": (event_of, lambda m: m, r"one number, got shape \(3,\)", lambda m: jnp.min(m)),
    "several events, their product": (
        event_of,
        lambda m: m - 0.15,
        "a list of functions",
        lambda m: jnp.prod(m - 0.15),
    ),
    "Poisson tensor": (
        tensor_of,
        lambda x: np.array([[0.0, x[0]], [-x[0], 0.0]]),
        "the Poisson tensor.*NumPy",
        lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]) * x[0],
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_that_cannot_be_traced(name):
    use, wrong_function, message, right_function = FUNCTIONS[name]
    with pytest.raises(lt.FunctionError, match=message) as caught:
        use(wrong_function)
    cause, _, jax_text = str(caught.value).partition(" JAX reports: ")
    assert "Tracer" not in cause
    assert "\n" not in jax_text
    use(right_function)


def test_the_line_is_named():
    with pytest.raises(lt.FunctionError, match=r"\(test_messages.py:\d+, in with_if\)"):
        body(with_if)


TWO = np.array([0, 1])


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        (lambda m: m.at[1].apply(jnp.sin), lambda m: m.at[1].set(jnp.sin(m[1]))),
        (lambda m: m.at[TWO].multiply(m[1:]), lambda m: m.at[TWO].set(m[TWO] * m[1:])),
    ],
    ids=["apply", "multiply"],
)
def test_a_change_of_entries_that_jax_cannot_differentiate(change, advice):
    with pytest.raises(lt.FunctionError, match=r"Replace x\.at\[i\]\.apply\(f\) by x\.at\[i\]\.set\(f\(x\[i\]\)\)"):
        body(lambda m: jnp.sum(change(m) ** 2))
    solution = run(body(lambda m: jnp.sum(advice(m) ** 2)))
    assert solution.audit().passed
    run(body(lambda m: jnp.sum((m.at[1].multiply(2.0)) ** 2)))


def test_numbers_in_single_precision_are_no_fault():
    """Arrays of float32 in a closure are exact numbers; so is a mean of truth values."""
    weights = jnp.array([1.0, 2.0, 3.0], dtype=jnp.float32)
    system = body(lambda m: jnp.sum(weights * m**2) + 0.5 * jnp.mean(m > -99.0))
    assert run(system).audit().passed


# -- calls ------------------------------------------------------------------------------------------------------------


def end_of(call, **options):
    return lambda x: call(lt.models.rigid_body((3.0, 2.0, 1.0)), x, SPAN, STEP, **options)


@pytest.mark.parametrize(
    "transform", [jax.jit, lambda f: jax.grad(lambda x: f(x)[0]), jax.jacfwd], ids=["jit", "grad", "jacfwd"]
)
def test_a_run_inside_of_jax(transform):
    """The message names lt.flow, which works in the place of integrate."""
    with pytest.raises(lt.InputError, match=r"a run needs numbers.*lt\.flow\(system, x0, t_span, step, method\)"):
        transform(lambda x: end_of(lt.integrate)(x).x[-1])(jnp.asarray(START))
    assert np.isfinite(transform(end_of(lt.flow))(jnp.asarray(START))).all()


def test_an_ensemble_inside_of_jax():
    starts = jnp.asarray(np.random.default_rng(0).standard_normal((2, 3)))
    with pytest.raises(lt.InputError, match=r"a run needs numbers.*lt\.flow"):
        jax.jit(lambda x: end_of(lt.ensemble)(x).x)(starts)
    assert jax.jit(jax.vmap(end_of(lt.flow)))(starts).shape == (2, 3)


def test_a_parameter_that_is_differentiated():
    def end(call, rate):
        return call(lt.models.rigid_body((3.0, 2.0, 1.0), rate=rate), START, SPAN, STEP)

    with pytest.raises(lt.InputError, match=r"lt\.flow"):
        jax.grad(lambda rate: end(lt.integrate, rate).x[-1][0])(0.2)
    assert np.isfinite(jax.grad(lambda rate: end(lt.flow, rate)[0])(0.2))


@pytest.mark.parametrize("method", [lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)], ids=str)
def test_a_small_tolerance_with_a_low_order(method):
    """The message names a method of high order, which reaches the end with as many steps as are allowed."""
    system, step = lt.models.rigid_body((3.0, 2.0, 1.0)), lt.Adaptive(1e-10, most_steps=300)
    advice = r"Use lt\.Metriplectic\w+\(\d\), of order 8"
    with pytest.raises(
        lt.ConvergenceError, match=rf"has order {method.order}, too low for rtol=1e-10\. {advice}"
    ) as caught:
        run(system, span=(0.0, 20.0), step=step, method=method)
    words = str(caught.value)
    better = lt.MetriplecticRungeKutta(8) if "lt.MetriplecticRungeKutta(8)" in words else lt.MetriplecticGauss(4)
    assert better.order == 8
    assert run(system, span=(0.0, 20.0), step=step, method=better).status.ok


# -- times ------------------------------------------------------------------------------------------------------------

SUM = 0.1 + 0.1 + 0.1
"""A rounding above 0.3."""


def test_times_that_are_a_rounding_beyond_the_end_are_the_end():
    system = lt.models.rigid_body((3.0, 2.0, 1.0))
    assert SUM > 0.3
    for step in (STEP, lt.Adaptive(1e-6)):
        run_ = run(system, span=(0.0, 0.3), step=step, save_at=[0.1, SUM])
        assert run_.t.tolist() == [0.0, 0.1, 0.3]
    assert lt.scipy.solve_ivp(system, (0.0, 0.3), START, t_eval=[0.1, SUM]).t.tolist() == [0.1, 0.3]
    ensemble = lt.ensemble(system, START, (0.0, 0.3), STEP, save_at=[0.1, SUM])
    assert ensemble.t.tolist() == [0.0, 0.1, 0.3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"save_at": [0.5, 1.5]}, r"save_at must be times of t_span = \(0, 1\), got 1.5, outside of it"),
        ({"save_at": [0.5], "save_every": 0}, "save_every must be a positive integer"),
        ({"step": 0.0}, "step must be positive and finite, got 0$"),
        ({"step": "0.1"}, "step must be a number, got '0.1'"),
        ({"span": ("0", "1")}, r"t_span must be two numbers \(start, end\), got \('0', '1'\)"),
        ({"span": 1.0}, r"t_span must be two numbers \(start, end\), got 1.0"),
        ({"span": 1.0, "step": lt.Adaptive(1e-6)}, r"t_span must be two numbers \(start, end\), got 1.0"),
        ({"span": "ab", "step": lt.Adaptive(1e-6)}, r"t_span must be two numbers \(start, end\), got 'ab'"),
        ({"span": (1.0, 0.0)}, r"t_span must be finite and increasing, got \(1, 0\)"),
    ],
)
def test_times_that_cannot_be_used(options, message):
    with pytest.raises(lt.InputError, match=message):
        run(lt.models.rigid_body((3.0, 2.0, 1.0)), **options)


@pytest.mark.parametrize("span", [[0.0, 1.0], np.array([0.0, 1.0]), (0, 1)], ids=str)
def test_a_span_may_be_any_pair_of_numbers(span):
    assert run(lt.models.rigid_body((3.0, 2.0, 1.0)), span=span).t[-1] == 1.0
    assert run(lt.models.rigid_body((3.0, 2.0, 1.0)), span=span, step=lt.Adaptive(1e-6)).t[-1] == 1.0


def test_a_torque_frozen_at_one_time_is_not_run():
    """Its work would be missing, so that the laws would hold for another motion."""
    push = lt.torques.ConstantInBody([0.1, 0.0, 0.0])
    for torque, arguments in ((push, (0.3,)), (lambda t, mu, A: A[0], (0.3, np.eye(3)))):
        system = body(lambda m: m @ m, torque=torque, group=mf.SO(3))
        frozen_system = system.at_time(*arguments)
        assert np.isfinite(frozen_system.vector_field(jnp.asarray(START))).all()
        for attempt in (run, lambda s: lt.flow(s, START, SPAN, STEP), lambda s: lt.ensemble(s, [START], SPAN, STEP)):
            with pytest.raises(lt.InputError, match=r"frozen it\. Run the system itself"):
                attempt(frozen_system)
        assert run(system).audit().passed
