"""Input of the wrong kind to systems, schemes and models: one line each, before anything runs."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.models.gases import porous_piston_state
from tests.refusals import refusal_test

V = lt.VariationalIntegrator
D = lt.DiscreteHerglotz
M = lt.models
SO3 = mf.so(3)


def L(q, v, S):
    return 0.5 * (v @ v - q @ q) - jnp.exp(S)


@functools.cache
def bodies():
    return [lt.Subsystem(lambda x: jnp.exp(x[0]), 1)] * 2


@functools.cache
def gases():
    return [lt.Subsystem(lambda x: x[1] * jnp.exp(x[0] / x[1]), 2, species=1)] * 2


def twins():
    return [lt.Subsystem(gases()[0].energy, 2, name="a", species=1)] * 2


@functools.cache
def oscillator():
    return lt.SimpleClosedSystem(L, 3, friction=0.1)


@functools.cache
def body():
    return lt.EulerPoincareClosedSystem(SO3, lambda xi, S: 0.5 * xi @ xi - jnp.exp(S), lambda xi, S: -xi)


@functools.cache
def field():
    return lt.EvolutionSystem(lambda q, p, S: 0.5 * (p @ p + q @ q) + jnp.exp(S), 3)


def composed_system(**arguments):
    return lt.ComposedSystem(bodies(), **arguments)


def exchanging(**arguments):
    return lt.ComposedSystem(gases(), validate=False, **arguments)


def with_form(K):
    return lt.MetriplecticSystem(lambda x: jnp.zeros((2, 2)), lambda x: x[0], lambda x: x[1], K, dim=2, validate=False)


def run(system, method):
    return lt.integrate(system, [1.0, 0.0, 0.0], (0.0, 0.2), 0.1, method)


X = np.ones((2, 4))
RUN = np.ones((2, 3))

CASES = {
    # conductances, membranes, reactions
    "four": (
        lambda: composed_system(conductance=lambda a, b, c, d: 1.0),
        "between body 0 and body 1 could not be evaluated",
    ),
    "text": (
        lambda: composed_system(conductance=lambda a, b: "x"),
        "between body 0 and body 1 could not be evaluated at .T_i",
    ),
    "array": (lambda: composed_system(conductance=lambda a, b: jnp.ones(2)), r"must have shape \(\), got \(2,\)"),
    "complex": (lambda: composed_system(conductance=lambda a, b: 1j * a), "must be real, got complex128"),
    "empty edge": (lambda: composed_system(conductance=[()]), r"an edge must be \(i, j, weight\), got \(\)"),
    "long edge": (
        lambda: composed_system(conductance=[(0, 1, 2, lambda a, b: a)]),
        r"an edge must be \(i, j, weight\)",
    ),
    "named edge": (
        lambda: composed_system(conductance=[("a", 1, lambda a, b: a)]),
        r"an edge must be \(i, j, weight\)",
    ),
    "half an edge": (lambda: composed_system(conductance=[(0.5, 1, 1.0)]), r"an edge must be \(i, j, weight\)"),
    "no bodies": (lambda: lt.ComposedSystem(3), "body 0 must be an lt.Subsystem or lt.Copies, got int"),
    "texts": (lambda: lt.ComposedSystem(["a"]), "body 0 must be an lt.Subsystem or lt.Copies, got str"),
    "maps": (
        lambda: composed_system(momentum_maps=3),
        "momentum_maps must be a dict or a sequence of functions, got int",
    ),
    "parameters": (lambda: lt.Copies(2, lambda x, c: c * x[0], 1, "a"), "made of real numbers, got 'a'"),
    "membrane": (
        lambda: exchanging(membranes=[lt.Membrane(0, 1, lambda x: x)]),
        r"permeability of a membrane must have shape \(\), got \(4,\)",
    ),
    "reaction": (
        lambda: exchanging(reactions=[lt.Reaction(0, [1.0], lambda x, y: 1.0)]),
        r"rate of a reaction could not be evaluated at a state of shape \(4,\)",
    ),
    "carried": (lambda: lt.Membrane(0, 1, 1.0, carries=[1.0, 2.0]), "must be one number, got an array of shape"),
    "two of a name": (
        lambda: lt.ComposedSystem(twins(), membranes=[lt.Membrane("a", 1, 1.0)]),
        "'a' is the name of several bodies",
    ),
    # models
    "one conductance": (
        lambda: M.porous_piston(conductance=1.0),
        r"conductance must have shape \(2,\), got",
    ),
    "three": (
        lambda: M.gas_piston(conductance=(1.0, 1.0, 1.0)),
        r"conductance must have shape \(2,\), got",
    ),
    "no mass": (lambda: M.porous_piston(mass=0), "mass must be positive and finite, got 0.0"),
    "mass": (lambda: M.porous_piston(mass="a"), "mass must be made of real numbers, got 'a'"),
    "None": (lambda: M.cylinder(mass=None), "mass must be made of real numbers, got None"),
    "inertia": (lambda: M.rigid_body("a"), "inertia must be made of real numbers, got 'a'"),
    "rate": (lambda: M.rigid_body(rate="a"), "a rate must be made of real numbers, got 'a'"),
    "capacities": (lambda: M.thermo_particles(0), r"capacities must have shape \(1,\), got \(\)"),
    "stoichiometry": (lambda: M.reaction_vessel(1.0), "a row of finite numbers, got 1.0"),
    "energies": (lambda: M.reaction_vessel(energy=(1.0, 2.0)), r"energy must have shape \(3,\), got \(2,\)"),
    "unknown": (
        lambda: porous_piston_state((1, 1), (1, 1), foo=3),
        "porous_piston has no parameter 'foo'. Its parameters are perm",
    ),
    "side": (lambda: porous_piston_state(1.0, (1, 1)), r"temperature\), must have shape \(2,\), got \(\)"),
    "place": (lambda: porous_piston_state((1, 1), (1, 1), q="a"), "q must be made of real numbers, got 'a'"),
    # systems with a Lagrangian, on Lie algebras, with matrices
    "friction": (lambda: lt.SimpleClosedSystem(L, 3, lambda q, v, S: v.foo), "friction could not be evaluated"),
    "heat": (lambda: lt.SimpleClosedSystem(L, 3, heat_power=lambda q, v, S: 1j), "the heat power must be real"),
    "eta": (lambda: lt.ChetaevSystem(L, lambda q, v, S: 1j * v, 3), "eta must be real, got complex128"),
    "external": (
        lambda: lt.EulerPoincareClosedSystem(SO3, body().lagrangian, external=lambda xi, S: 1j * xi),
        "the external force must be real",
    ),
    "K": (lambda: lt.FrictionOperator("a"), "the friction operator K must be made of real numbers, got 'a'"),
    "complex K": (lambda: lt.FrictionOperator(1j * np.eye(2)), "must be made of real numbers, got ndarray"),
    "K(x, y)": (lambda: with_form(lt.FrictionOperator(lambda x, y: x)), "friction operator K could not be evaluated"),
    "quadratic": (lambda: lt.Quadratic([1.0], b=["a"]), "quadratic function must be made of real numbers, got list"),
    # schemes
    "retraction": (
        lambda: V("verlet", retraction=3),
        r"retraction must be a .* or one of 'midpoint', .*, got 3",
    ),
    "of Gauss": (lambda: lt.MetriplecticGauss(2, retraction=3), "or one of"),
    "weight": (lambda: lt.FiniteDifference(0.5, weight="a"), "must be > 0 and finite, got 'a'"),
    "S0": (lambda: V("verlet").state(oscillator(), [1.0], [1.0], [0.0, 1.0], 0.1), "S0 must be one number"),
    "h": (lambda: V("verlet").state(oscillator(), [1.0], [1.0], 0.0, "a"), "the step h must be made of real numbers"),
    "no step": (lambda: V("verlet").energies(oscillator(), RUN, 0.0), "the step h must be finite and not zero, got 0"),
    "one state": (
        lambda: V("verlet").energies(oscillator(), RUN[0], 0.1),
        r"at least two states of a run, shape \(times, 3\), got",
    ),
    "two states": (
        lambda: V("verlet").energies(composed_system(), RUN, 0.1),
        "needs an lt.SimpleClosedSystem, got a Comp",
    ),
    "no system": (lambda: V("verlet").energies(3, RUN, 0.1), "needs an lt.SimpleClosedSystem, got a int"),
    "start": (
        lambda: lt.LieVariational().attitudes(body(), X, 0.1, start=np.eye(2)),
        r"start must have last axes \(3, 3",
    ),
    "attitude that is no number": (
        lambda: lt.LieVariational().attitudes(body(), X, 0.1, start=np.full((3, 3), np.nan)),
        "start must be finite",
    ),
    "one attitude": (
        lambda: lt.LieVariational().attitudes(body(), X[0], 0.1),
        r"at least two states of a run, shape \(times, 4\)",
    ),
    "wrong system": (lambda: lt.LieVariational().attitudes(oscillator(), RUN, 0.1), "got a SimpleClosedSystem"),
    "order": (lambda: D(lambda q0, q1, S, h: S, [2]), r"order must be 1, 2 or 4, got \[2\]"),
    "action": (lambda: run(field(), D(lambda q0, q1, S, h: q0)), r"Lagrangian must have shape \(\), got \(1,\)"),
    "of three": (lambda: run(field(), D(lambda q0, q1, S: S)), "discrete Lagrangian could not be evaluated at .q_0"),
    "midpoint": (lambda: run(field(), D.midpoint(lambda x: x)), "discrete Lagrangian must have shape"),
    "of two": (lambda: run(field(), D.midpoint(lambda q, v: 1.0)), "discrete Lagrangian could not be evaluated"),
    "q1": (
        lambda: D.midpoint(L).state([1.0], [1.0, 2.0], 0.0, 0.1),
        r"q1 must have shape \(1,\) or \(\), got \(2,\)",
    ),
    # algebras
    "no algebra": (lambda: mf.trilinear_form("a"), r"a manifolds.LieAlgebra, such as mf.so\(3\), got 'a'"),
    "number": (lambda: mf.trilinear_form(3), r"a manifolds.LieAlgebra, such as mf.so\(3\), got 3"),
    "NaN": (lambda: mf.trilinear_form(SO3, np.full((3, 3), np.nan)), "must be finite, got .*nan"),
    "complex form": (lambda: mf.trilinear_form(SO3, 1j * np.eye(3)), "must be real, got complex128"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line(case):
    call, words = CASES[case]
    with pytest.raises((lt.LiethermoError, mf.ManifoldsError), match=words) as caught:
        call()
    assert isinstance(caught.value, ValueError | TypeError)
    assert "\n" not in str(caught.value)


def solution():
    return lt.integrate(lt.models.rigid_body((3.0, 2.0, 1.0)), [0.1, 0.2, 1.0], (0.0, 0.1), 0.1)


def study(**options):
    axes = {"a": [1.0]}
    measure = {"q": lambda solution: solution.x[-1, 0]}
    return lt.Study(oscillator(), axes, t_span=(0.0, 1.0), step=0.1, measure=measure, x0=[1.0, 0.0, 0.0], **options)


test_a_path_must_be_a_string_or_a_path = refusal_test(
    {
        "load": (lambda: lt.load(3), "path must be a string or a path, got 3"),
        "load_study": (lambda: lt.load_study(3), "path must be a string or a path, got 3"),
        "Solution.save": (lambda: solution().save(None), "path must be a string or a path, got None"),
        "Study": (lambda: study(store=3), "store must be a string or a path, got 3"),
        "read_graph": (lambda: lt.read_graph(3), "path must be a string or a path, got 3"),
        "Tree.from_urdf": (lambda: lt.bodies.Tree.from_urdf(3), "the source must be a string or a path, got 3"),
        "read_csv": (lambda: lt.bodies.read_csv(3), "path must be a string or a path, got 3"),
        "read_ovf": (lambda: lt.magnetism.read_ovf(3), "path must be a string or a path, got 3"),
        "learn.save": (lambda: lt.learn.save(oscillator(), 3), "path must be a string or a path, got 3"),
        "learn.load": (lambda: lt.learn.load(3, oscillator()), "path must be a string or a path, got 3"),
        "plot": (lambda: lt.plot.laws(solution(), path=3), "path must be a string or a path, got 3"),
    }
)
