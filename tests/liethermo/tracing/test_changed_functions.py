"""A function that was traced before is traced again for a new system: what it reads may have changed since."""

import pickle
import types

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

SPAN, STEP = (0.0, 0.5), 0.1
MU = np.array([0.3, -0.4, 0.8])
BODY = {"algebra": mf.so(3), "energy": lt.Quadratic([1.0, 2.0, 3.0])}

k = 1.0
"""What the functions below read, and what changes."""


def end(system, x0, **options):
    return lt.integrate(system, x0, SPAN, STEP, progress=False, **options).x[-1]


def body(**options):
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


def across(mu):
    """Two squares of a vector that is orthogonal to the gradient of the energy."""
    v = jnp.cross(mu * jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, 0.0, 1.0]))
    return k * jnp.outer(v, v)


def projected(x):
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
    described = lt.Study(
        build, {"a": [0.5, 1.0]}, x0=x0, t_span=SPAN, step=STEP, measure=options.pop("measure", {"x": "final"})
    )
    described.run(progress=False)
    return described.results.x.values


def qubit(f):
    sz, sx = np.diag([0.5, -0.5]), np.array([[0.0, 0.5], [0.5, 0.0]])
    system = lt.QuantumSystem([sz, (sx, f)])
    return end(system, system.state(np.diag([0.9, 0.1])))


USES = {
    "energy": (energy, lambda f: end(lt.LiePoissonSystem(mf.so(3), f), MU)),
    "energy of a general system": (energy, lambda f: float(oscillator3(f).energy.value(jnp.asarray(MU)))),
    "energy of time": (timed_energy, lambda f: end(lt.LiePoissonSystem(mf.so(3), f), MU)),
    "entropy": (entropy, lambda f: end(body(entropy=f, dissipation=lt.KillingDissipation(0.2)), MU)),
    "Poisson tensor": (tensor, lambda f: end(lt.MetriplecticSystem(f, energy2, dim=2), MU[:2])),
    "friction": (matrix, lambda f: end(oscillator(lt.Friction(f), baths=lt.HeatBaths(1.0)), MU[:2])),
    "friction operator": (
        across,
        lambda f: end(body(entropy=entropy_fixed, dissipation=lt.FrictionOperator(f)), MU),
    ),
    "cometric": (
        projected,
        lambda f: end(body(entropy=entropy_fixed, dissipation=lt.ProjectedMetric(f)), MU),
    ),
    "torque": (torque, lambda f: end(body(torque=f), MU)),
    "torque in space": (torque_in_space, lambda f: end(body(torque=f, group=mf.SO(3)), MU)),
    "until": (event, lambda f: lt.integrate(body(), MU, (0.0, 50.0), STEP, until=f).t[-1]),
    "until, adaptive": (event, lambda f: lt.integrate(body(), MU, (0.0, 50.0), lt.Adaptive(1e-6), until=f).t[-1]),
    "until, ensemble": (event, lambda f: lt.ensemble(body(), MU, (0.0, 50.0), STEP, until=f).end_time),
    "bath": (
        bath,
        lambda f: end(body(dissipation=lt.DoubleBracket(0.3), baths=lt.HeatBaths(energy=f)), MU),
    ),
    "Lagrangian": (lagrangian, lambda f: end(lt.EulerPoincareSystem(mf.so(3), f), MU)),
    "Lagrangian of a closed system": (
        closed_lagrangian,
        lambda f: end(lt.SimpleClosedSystem(f, dim=3), [0.3, 0.1, 0.2]),
    ),
    "friction of a closed system": (
        friction,
        lambda f: end(lt.SimpleClosedSystem(fixed_lagrangian, friction=f, dim=3), [0.3, 0.1, 0.2]),
    ),
    "contact Hamiltonian": (hamiltonian, lambda f: end(lt.ContactSystem(f, dim=3), [0.3, 0.1, 0.2])),
    "drive": (drive, qubit),
    "preserve": (
        entropy,
        lambda f: float(lt.MetriplecticGauss(1, preserve=[f]).functions[0].value(jnp.asarray(MU))),
    ),
    "builder": (build, lambda f: lt.ensemble(f, MU, SPAN, STEP, parameters={"a": np.array([0.5, 1.0])}).x),
    "builder of a study": (build, lambda f: study(f, MU)),
    "x0 of a study": (start, lambda f: study(build_fixed, f)),
    "measure of a study": (measure, lambda f: study(build_fixed, MU, measure={"x": f})),
    "dissipation potential": (
        potential,
        lambda f: end(body(entropy=entropy_fixed, dissipation=lt.DissipationPotential(f)), MU),
    ),
    "level set": (squares, lambda f: mf.LevelSet(f, (3,)).project(np.array([0.5, 0.5, 0.9]))),
}


def energy2(x):
    return 0.5 * x[0] ** 2 + 0.5 * x[1] ** 2


def entropy_fixed(mu):
    return jnp.log(1.0 + mu @ mu)


def fixed_lagrangian(q, v, S):
    return 0.5 * v @ v - 0.5 * q @ q - jnp.exp(S)


def build_fixed(p):
    return lt.LiePoissonSystem(mf.so(3), lambda m: p["a"] * m[0] ** 2 + m[1] ** 2)


def oscillator3(f):
    return lt.MetriplecticSystem(None, f, dim=3)


def renewed(function):
    """The function as an object that was never traced."""
    return types.FunctionType(function.__code__, function.__globals__, function.__name__)


@pytest.mark.sampled(10)
@pytest.mark.parametrize("name", USES)
def test_it_is_traced_again(monkeypatch, name):
    function, use = USES[name]
    first = np.asarray(use(function))
    monkeypatch.setitem(globals(), "k", 1.7)
    again, expected = np.asarray(use(function)), np.asarray(use(renewed(function)))
    assert np.array_equal(again, expected), (first, again, expected)
    assert not np.array_equal(again, first)


class Scaled:
    """A callable object whose attribute changes."""

    def __init__(self):
        self.factor = 1.0

    def __call__(self, mu):
        return self.factor * mu @ mu + mu[0] ** 2

    def method(self, mu):
        return self(mu)


@pytest.mark.parametrize(
    "of", [lambda obj: obj, lambda obj: obj.method, lambda obj: types.MethodType(Scaled.method, obj)]
)
def test_attributes_are_read_again(of):
    scaled, fresh = Scaled(), Scaled()
    first = end(lt.LiePoissonSystem(mf.so(3), of(scaled)), MU)
    scaled.factor = fresh.factor = 3.0
    again = lt.LiePoissonSystem(mf.so(3), of(scaled))
    assert float(again.energy.value(MU)) == pytest.approx(3.0 * MU @ MU + MU[0] ** 2, rel=1e-15)
    assert np.array_equal(end(again, MU), end(lt.LiePoissonSystem(mf.so(3), of(fresh)), MU))
    assert np.array_equal(first, end(lt.LiePoissonSystem(mf.so(3), of(Scaled())), MU))


def test_the_old_system_stays_as_it_was(monkeypatch):
    """A system has the function as it was when the system was made; an equal one is run by the same programs."""
    old = lt.LiePoissonSystem(mf.so(3), energy)
    before = end(old, MU)
    monkeypatch.setitem(globals(), "k", 1.7)
    assert np.array_equal(end(old, MU), before)
    assert not np.array_equal(end(lt.LiePoissonSystem(mf.so(3), energy), MU), before)


def test_level_sets_of_one_function_differ_where_it_has_changed(monkeypatch):
    first, same = mf.LevelSet(squares, 3), mf.LevelSet(renewed(squares), 3)
    assert first == same
    assert hash(first) == hash(same)
    monkeypatch.setitem(globals(), "k", 1.7)
    other = mf.LevelSet(squares, 3)
    assert other != first
    x = np.array([0.5, 0.5, 0.9])
    assert np.linalg.norm(first.project(x)) == pytest.approx(1.0, rel=1e-14)
    assert np.linalg.norm(other.project(x)) == pytest.approx(np.sqrt(1.35), rel=1e-14)
    assert pickle.loads(pickle.dumps(other)) == other
