"""A function that was traced before is traced again for a new system, since globals that it reads may change."""

import pickle
import types

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

SPAN = (0.0, 0.5)
STEP = 0.1
MU = np.array([0.3, -0.4, 0.8])
BODY = {"algebra": mf.so(3), "energy": lt.Quadratic([1.0, 2.0, 3.0])}

k = 1.0
"""Global that the functions below read, and that the tests change."""


def end_state(system, x0, **options):
    return lt.integrate(system, x0, SPAN, STEP, progress=False, **options).x[-1]


def rigid_body(**options):
    return lt.LiePoissonSystem(BODY["algebra"], BODY["energy"], **options)


def energy(mu):
    return k * jnp.sum(mu**2) / 2 + 0.3 * mu[0] ** 4 + k * mu[1] * mu[2]


def timed_energy(mu, t):
    return energy(mu) * (1.0 + 0.1 * k * t)


def entropy(mu):
    return jnp.sum(mu**2) / 2 * k


def matrix(x):
    return k * jnp.diag(jnp.array([0.0, 1.0])) * (1.0 + x[0] ** 2)


def tensor(x):
    return k * (1.0 + x[0] ** 2) * jnp.array([[0.0, 1.0], [-1.0, 0.0]])


def perpendicular_operator(mu):
    """Return v v^T with v orthogonal to the gradient of the energy."""
    v = jnp.cross(mu * jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, 0.0, 1.0]))
    return k * jnp.outer(v, v)


def cometric(x):
    return k * jnp.eye(3) * (1.0 + x[0] ** 2)


def torque(t, mu):
    return k * jnp.array([jnp.cos(t), 0.0, mu[0]])


def torque_in_space(t, mu, g):
    return k * g[0]


def event(x):
    return x[0] - 0.1 * k


def bath(y):
    return jnp.exp(y / k)


def lagrangian(xi):
    return 0.5 * k * jnp.sum(xi**2) + 0.5 * xi[0] ** 2


def closed_lagrangian(q, v, S):
    return 0.5 * v @ v - 0.5 * k * q @ q - jnp.exp(S)


def friction(q, v, S):
    return -k * v


def hamiltonian(x):
    return 0.5 * x[1] ** 2 + 0.5 * k * x[0] ** 2 + 0.1 * x[2]


def drive(t):
    return k * jnp.sin(t)


def measure(solution):
    return k * float(solution.x[-1, 0])


def potential(p):
    return 0.5 * k * jnp.sum(p**2) + 0.25 * jnp.sum(p**2) ** 2


def squares(x):
    return jnp.sum(x**2) - 1.0 - 0.5 * (k - 1.0)


def oscillator(K, **options):
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x @ x, dissipation=K, **options)


def build(p):
    return lt.LiePoissonSystem(mf.so(3), lambda m: k * p["a"] * m[0] ** 2 + m[1] ** 2)


def start(p):
    return k * p["a"] * MU


def study(build, x0, **options):
    definition = lt.Study(
        build, {"a": [0.5, 1.0]}, x0=x0, t_span=SPAN, step=STEP, measure=options.pop("measure", {"x": "final"})
    )
    definition.run(progress=False)
    return definition.results.x.values


def qubit(f):
    sz, sx = np.diag([0.5, -0.5]), np.array([[0.0, 0.5], [0.5, 0.0]])
    system = lt.QuantumSystem([sz, (sx, f)])
    return end_state(system, system.state(np.diag([0.9, 0.1])))


USES = {
    "energy": (energy, lambda f: end_state(lt.LiePoissonSystem(mf.so(3), f), MU)),
    "energy of a general system": (energy, lambda f: float(gradient_system(f).energy.value(jnp.asarray(MU)))),
    "energy of time": (timed_energy, lambda f: end_state(lt.LiePoissonSystem(mf.so(3), f), MU)),
    "entropy": (entropy, lambda f: end_state(rigid_body(entropy=f, dissipation=lt.KillingDissipation(0.2)), MU)),
    "Poisson tensor": (tensor, lambda f: end_state(lt.MetriplecticSystem(f, plane_energy, dim=2), MU[:2])),
    "friction": (matrix, lambda f: end_state(oscillator(lt.Friction(f), baths=lt.HeatBaths(1.0)), MU[:2])),
    "friction operator": (
        perpendicular_operator,
        lambda f: end_state(rigid_body(entropy=fixed_entropy, dissipation=lt.FrictionOperator(f)), MU),
    ),
    "cometric": (
        cometric,
        lambda f: end_state(rigid_body(entropy=fixed_entropy, dissipation=lt.ProjectedMetric(f)), MU),
    ),
    "torque": (torque, lambda f: end_state(rigid_body(torque=f), MU)),
    "torque in space": (torque_in_space, lambda f: end_state(rigid_body(torque=f, group=mf.SO(3)), MU)),
    "until": (event, lambda f: lt.integrate(rigid_body(), MU, (0.0, 50.0), STEP, until=f).t[-1]),
    "until, adaptive": (event, lambda f: lt.integrate(rigid_body(), MU, (0.0, 50.0), lt.Adaptive(1e-6), until=f).t[-1]),
    "until, ensemble": (event, lambda f: lt.ensemble(rigid_body(), MU, (0.0, 50.0), STEP, until=f).end_time),
    "bath": (
        bath,
        lambda f: end_state(rigid_body(dissipation=lt.DoubleBracket(0.3), baths=lt.HeatBaths(energy=f)), MU),
    ),
    "Lagrangian": (lagrangian, lambda f: end_state(lt.EulerPoincareSystem(mf.so(3), f), MU)),
    "Lagrangian of a closed system": (
        closed_lagrangian,
        lambda f: end_state(lt.SimpleClosedSystem(f, dim=3), [0.3, 0.1, 0.2]),
    ),
    "friction of a closed system": (
        friction,
        lambda f: end_state(lt.SimpleClosedSystem(fixed_lagrangian, friction=f, dim=3), [0.3, 0.1, 0.2]),
    ),
    "contact Hamiltonian": (hamiltonian, lambda f: end_state(lt.ContactSystem(f, dim=3), [0.3, 0.1, 0.2])),
    "drive": (drive, qubit),
    "preserve": (
        entropy,
        lambda f: float(lt.MetriplecticGauss(1, preserve=[f]).functions[0].value(jnp.asarray(MU))),
    ),
    "builder": (build, lambda f: lt.ensemble(f, MU, SPAN, STEP, parameters={"a": np.array([0.5, 1.0])}).x),
    "builder of a study": (build, lambda f: study(f, MU)),
    "x0 of a study": (start, lambda f: study(fixed_build, f)),
    "measure of a study": (measure, lambda f: study(fixed_build, MU, measure={"x": f})),
    "dissipation potential": (
        potential,
        lambda f: end_state(rigid_body(entropy=fixed_entropy, dissipation=lt.DissipationPotential(f)), MU),
    ),
    "level set": (squares, lambda f: mf.LevelSet(f, (3,)).project(np.array([0.5, 0.5, 0.9]))),
}


def plane_energy(x):
    return 0.5 * x[0] ** 2 + 0.5 * x[1] ** 2


def fixed_entropy(mu):
    return jnp.log(1.0 + mu @ mu)


def fixed_lagrangian(q, v, S):
    return 0.5 * v @ v - 0.5 * q @ q - jnp.exp(S)


def fixed_build(p):
    return lt.LiePoissonSystem(mf.so(3), lambda m: p["a"] * m[0] ** 2 + m[1] ** 2)


def gradient_system(f):
    return lt.MetriplecticSystem(None, f, dim=3)


def untraced_copy(function):
    """Return the function as a new object that was never traced."""
    return types.FunctionType(function.__code__, function.__globals__, function.__name__)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", USES)
def test_changed_globals_take_effect(monkeypatch, name):
    function, use = USES[name]
    initial = np.asarray(use(function))
    monkeypatch.setitem(globals(), "k", 1.7)
    new_result, expected = np.asarray(use(function)), np.asarray(use(untraced_copy(function)))
    assert np.array_equal(new_result, expected), (initial, new_result, expected)
    assert not np.array_equal(new_result, initial)


class ScaledSquare:
    """A callable object with an attribute that changes."""

    def __init__(self):
        self.factor = 1.0

    def __call__(self, mu):
        return self.factor * mu @ mu + mu[0] ** 2

    def method(self, mu):
        return self(mu)


@pytest.mark.parametrize(
    "of", [lambda obj: obj, lambda obj: obj.method, lambda obj: types.MethodType(ScaledSquare.method, obj)]
)
def test_changed_attributes_take_effect(of):
    callable_object, same_factor = ScaledSquare(), ScaledSquare()
    initial = end_state(lt.LiePoissonSystem(mf.so(3), of(callable_object)), MU)
    callable_object.factor = same_factor.factor = 3.0
    new_system = lt.LiePoissonSystem(mf.so(3), of(callable_object))
    assert float(new_system.energy.value(MU)) == pytest.approx(3.0 * MU @ MU + MU[0] ** 2, rel=1e-15)
    assert np.array_equal(end_state(new_system, MU), end_state(lt.LiePoissonSystem(mf.so(3), of(same_factor)), MU))
    assert np.array_equal(initial, end_state(lt.LiePoissonSystem(mf.so(3), of(ScaledSquare())), MU))


def test_existing_system_keeps_the_old_function(monkeypatch):
    """A system keeps the function as it was when the system was made."""
    system = lt.LiePoissonSystem(mf.so(3), energy)
    old_end = end_state(system, MU)
    monkeypatch.setitem(globals(), "k", 1.7)
    assert np.array_equal(end_state(system, MU), old_end)
    assert not np.array_equal(end_state(lt.LiePoissonSystem(mf.so(3), energy), MU), old_end)


def test_level_sets_differ_after_their_function_has_changed(monkeypatch):
    space, equal_space = mf.LevelSet(squares, 3), mf.LevelSet(untraced_copy(squares), 3)
    assert space == equal_space
    assert hash(space) == hash(equal_space)
    monkeypatch.setitem(globals(), "k", 1.7)
    changed_space = mf.LevelSet(squares, 3)
    assert changed_space != space
    x = np.array([0.5, 0.5, 0.9])
    assert np.linalg.norm(space.project(x)) == pytest.approx(1.0, rel=1e-14)
    assert np.linalg.norm(changed_space.project(x)) == pytest.approx(np.sqrt(1.35), rel=1e-14)
    assert pickle.loads(pickle.dumps(changed_space)) == changed_space
