"""Constant indices out of range are refused by name when a function is traced; intended ones are accepted."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import liethermo as lt
import manifolds as mf
from liethermo.errors import IndexOutOfRangeError
from liethermo.learn.observation import make_observation
from liethermo.tracing.index_check import check_indices

X = jnp.array([0.4, 0.5, -0.3])
TABLE = np.array([0, 3])
DROP = {"mode": "drop"}
NEIGHBOURS = np.array([[1, 3], [0, 2], [1, 3]])

INVALID_ACCESSES = {
    # name: (function of three components, the index as written, length of the axis)
    "one beyond": (lambda m: m[3], 3, 3),
    "from the end": (lambda m: m[-4], -4, 3),
    "of a matrix": (lambda m: jnp.outer(m, m)[1, 5], 5, 3),
    "a column": (lambda m: jnp.outer(m, m)[:, 3], 3, 3),
    "a table": (lambda m: m[TABLE], 3, 3),
    "a table, half of it masked": (
        lambda m: jnp.sum(jnp.where(NEIGHBOURS < 4, m[NEIGHBOURS], 0.0)),
        3,
        3,
    ),
    "a table from the end": (lambda m: m[np.array([-4, 0])], -4, 3),
    "an integer of JAX": (lambda m: m[jnp.int32(7)], 7, 3),
    "in a function that is jitted": (lambda m: jax.jit(lambda a: a[3])(m), 3, 3),
    "in a function that is mapped": (lambda m: jax.vmap(lambda row: row[3])(jnp.outer(m, m)), 3, 3),
    "in a loop": (lambda m: lax.fori_loop(0, 2, lambda i, s: s + m[3], 0.0), 3, 3),
    "in a branch": (lambda m: lax.cond(m[0] > 0, lambda a: a[3], lambda a: a[0], m), 3, 3),
    "in a derivative": (jax.grad(lambda m: m[3] ** 2), 3, 3),
    "of a constant": (lambda m: m[0] * jnp.ones((3, 4))[0, 4], 4, 4),
    "dynamic_slice": (lambda m: lax.dynamic_slice(m, (3,), (1,)), 3, 3),
    "promised to be inside": (lambda m: m.at[3].get(mode="promise_in_bounds"), 3, 3),
    "a table that is counted": (lambda m: m[jnp.arange(1, 4)], 3, 3),
    "a table that is computed": (lambda m: m[2 * jnp.arange(3) - 5], -5, 3),
    "taken": (lambda m: jnp.take(m, 3), 3, 3),
    "taken, a table": (lambda m: jnp.take(m, TABLE), 3, 3),
    "taken along an axis": (lambda m: jnp.take_along_axis(m, TABLE, 0), 3, 3),
    "taken along a later axis": (lambda m: jnp.take(jnp.outer(m, m), jnp.array([5]), axis=1), 5, 3),
    "taken, in a function that is jitted": (lambda m: jax.jit(lambda a: jnp.take(a, 3))(m), 3, 3),
    "set": (lambda m: m.at[3].set(m[0]), 3, 3),
    "set from the end": (lambda m: m.at[-4].set(1.0), -4, 3),
    "add": (lambda m: m.at[3].add(m[0]), 3, 3),
    "subtract": (lambda m: m.at[7].subtract(m[0], unique_indices=True), 7, 3),
    "multiply": (lambda m: m.at[3].multiply(2.0), 3, 3),
    "divide": (lambda m: m.at[3].divide(2.0), 3, 3),
    "power": (lambda m: m.at[3].power(2), 3, 3),
    "min": (lambda m: m.at[3].min(0.0), 3, 3),
    "max": (lambda m: m.at[3].max(0.0), 3, 3),
    "apply": (lambda m: m.at[3].apply(jnp.sin), 3, 3),
    "set, a table": (lambda m: m.at[TABLE].set(1.0), 3, 3),
    "add, a table that is counted": (lambda m: m.at[jnp.arange(1, 4)].add(1.0), 3, 3),
    "set in a matrix": (lambda m: jnp.zeros((3, 4)).at[1, 4].set(m[0]), 4, 4),
    "set a row": (lambda m: jnp.outer(m, m).at[3].set(m), 3, 3),
    "set a column": (lambda m: jnp.outer(m, m).at[:, 3].set(m), 3, 3),
    "set in a function that is mapped": (
        lambda m: jax.vmap(lambda row: row.at[3].set(0.0))(jnp.outer(m, m)),
        3,
        3,
    ),
    "set in a loop": (lambda m: lax.fori_loop(0, 2, lambda i, a: a.at[3].add(1.0), m), 3, 3),
    "set in a derivative": (jax.grad(lambda m: jnp.sum(m.at[3].set(m[0]) ** 2)), 3, 3),
    "scatter": (
        lambda m: lax.scatter_add(m, jnp.array([3]), m[0], lax.ScatterDimensionNumbers((), (0,), (0,))),
        3,
        3,
    ),
}

INTENDED_ACCESSES = {
    "inside": lambda m: m[2] + m[-3],
    "clip": lambda m: m.at[3].get(mode="clip"),
    "fill": lambda m: m.at[3].get(mode="fill", fill_value=0.0),
    "drop": lambda m: m.at[3].set(1.0, mode="drop"),
    "drop, over two lines": lambda m: m.at[jnp.array([0, 3])].add(
        jnp.stack([m[0], m[1]]),
        mode="drop",
    )[0],
    "drop, among other options": lambda m: m.at[3].add(1.0, **DROP),
    "drop, in a function that is jitted": lambda m: jax.jit(lambda a: a.at[3].mul(2.0, mode="drop"))(m),
    "drop, in a derivative": jax.grad(lambda m: jnp.sum(m.at[3].set(m[0], mode="drop") ** 2)),
    "fill, in a derivative": jax.grad(lambda m: jnp.nan_to_num(jnp.take(m, 3, mode="fill")) + m[0] ** 2),
    "segments": lambda m: jax.ops.segment_sum(m, np.array([0, 1, 3]), 3),
    "set inside": lambda m: m.at[2].set(1.0).at[-3].add(2.0).at[TABLE - 1].mul(3.0),
    "set a slice": lambda m: m.at[1:7].set(0.0),
    "set with a mask": lambda m: m.at[np.array([True, False, True])].set(0.0),
    "set at a computed index": lambda m: m.at[jnp.argmax(m) + 3].set(0.0),
    "insert": lambda m: jnp.insert(m, 3, 1.0) + jnp.append(m, 0.0),
    "clip, a table": lambda m: m.at[TABLE].get(mode="clip"),
    "clip, set": lambda m: m.at[TABLE].set(1.0, mode="clip"),
    "take, clip": lambda m: jnp.take(m, 3, mode="clip"),
    "take, fill": lambda m: jnp.take(m, TABLE, mode="fill"),
    "computed": lambda m: m[jnp.argmax(m) + 3],
    "counted": lambda m: lax.fori_loop(0, 4, lambda i, s: s + m[i], 0.0),
    "neighbours that some do not have": lambda m: jnp.where(NEIGHBOURS < 3, m[NEIGHBOURS], 0.0).sum(),
    "neighbours, in a function that is jitted": lambda m: jax.jit(
        lambda a: jnp.where(NEIGHBOURS < 3, a[NEIGHBOURS], 0.0) ** 2
    )(m),
    "neighbours, outside of the domain": lambda m: (
        jnp.sqrt(1.0 - m @ m) * jnp.where(NEIGHBOURS < 3, m[NEIGHBOURS], 0.0).sum()
    ),
    "masked": lambda m: jnp.where(jnp.arange(3) < 2, m[jnp.arange(3) + 1], 0.0),
    "a slice": lambda m: m[1:7],
    "interp": lambda m: jnp.interp(m[0], m, m) + jnp.convolve(m, m)[0] + jnp.roll(m, 5)[0] + jnp.diff(m)[0],
}


@pytest.mark.parametrize("name", INVALID_ACCESSES)
def test_an_index_out_of_range_is_found(name):
    function, index, axis_length = INVALID_ACCESSES[name]
    with pytest.raises(IndexOutOfRangeError, match=f"the index {index} of an axis with {axis_length} entries") as error:
        check_indices(jax.make_jaxpr(function)(X))
    assert (error.value.index, error.value.size) == (index, axis_length)
    assert error.value.where.startswith("test_index_check.py:")


@pytest.mark.parametrize("name", INTENDED_ACCESSES)
def test_intended_accesses_pass(name):
    check_indices(jax.make_jaxpr(INTENDED_ACCESSES[name])(X))


def energy(m):
    return 0.5 * (m[0] ** 2 + 2.0 * m[1] ** 2 + 3.0 * m[2] ** 2)


class ScaledComponent(eqx.Module):
    scale: float

    def __call__(self, m):
        return self.scale * m[3] ** 2


class UserDissipation(lt.KillingDissipation):
    """A user's dissipation with an index out of range."""

    def force(self, system, x, *arguments):
        return x[3] * super().force(system, x, *arguments)


def body(H=energy, **options):
    return lt.LiePoissonSystem(mf.so(3), H, **options)


def body_with_bath(**options):
    return body(dissipation=lt.DoubleBracket(0.1), baths=lt.HeatBaths(1.0, 1.0), **options)


ROLES = {
    "energy": (lambda: body(lambda m: m[3] ** 2), "the energy, a function of a state of shape"),
    "energy of time": (lambda: body(lambda m, t: m[3] * t), "the energy"),
    "energy, a module": (lambda: body(ScaledComponent(2.0)), "the energy"),
    "energy beside a bath": (
        lambda: body(lambda x: energy(x) + x[3], dissipation=lt.DoubleBracket(0.1), baths=lt.HeatBaths(1.0, 1.0)),
        "the energy",
    ),
    "entropy": (lambda: body(entropy=lambda m: m[3], dissipation=lt.KillingDissipation(0.1)), "the entropy"),
    "friction": (
        lambda: body(entropy=lambda m: m @ m, dissipation=lt.FrictionOperator(lambda m: jnp.eye(3) * m[3])),
        "the friction operator K, at a state of shape",
    ),
    "dissipation of the user's": (
        lambda: body(entropy=lambda m: m @ m, dissipation=UserDissipation(0.1)),
        "has the index 3",
    ),
    "Poisson tensor": (
        lambda: lt.MetriplecticSystem(poisson=lambda x: jnp.zeros((3, 3)) * x[3], energy=energy, dim=3),
        "the Poisson tensor",
    ),
    "dissipation potential": (
        lambda: body(
            entropy=lambda m: m @ m,
            dissipation=lt.DissipationPotential(lambda f: jnp.sum(f**2) + f[9], lt.KillingDissipation(0.1)),
        ),
        "has the index 9",
    ),
    "torque": (
        lambda: body(torque=lambda t, m: jnp.zeros(3).at[3].set(t)),
        "the torque, at a momentum of shape .*JAX would change no entry",
    ),
    "torque on spins": (
        lambda: lt.SpinSystem(2, lambda s: s[0, 2], torque=lambda t, s: s.at[2].set(0.0)),
        "the torque, at spins of shape",
    ),
    "temperature of a bath": (
        lambda: body(
            dissipation=lt.DoubleBracket(0.1), baths=lt.HeatBaths(np.inf, lambda t: t + jnp.array([1.0, 2.0])[2])
        ),
        "the temperature of bath 0",
    ),
    "force": (
        lambda: lt.EulerPoincareSystem(mf.so(3), lambda xi: xi @ xi, force=lambda xi: -xi.at[3].mul(2.0)),
        "the force F, at a velocity of shape",
    ),
    "external force": (
        lambda: lt.SimpleClosedSystem(
            lambda q, v, S: 0.5 * v[0] ** 2 - S, 3, 0.1, external=lambda q, v, S: jnp.zeros(1).at[1].set(q[0])
        ),
        "has the index 1 of an axis with 1 entry, which",
    ),
    "momentum map": (lambda: body(momentum_maps=[lambda m: m[3]]), "momentum map"),
    "observation": (
        lambda: make_observation(body(), None, lambda x: x[:1] + x[5]),
        "observe, at a state of shape",
    ),
    "event": (lambda: lt.integrate(body(), X, (0.0, 1.0), 0.1, until=lambda m: m[3]), "the event function"),
    "event, array engine": (
        lambda: lt.integrate(body(), X, (0.0, 1.0), 0.1, until=lambda m: m[3], engine="array"),
        "the event function",
    ),
    "event, ensemble": (lambda: lt.ensemble(body(), [X, X], (0.0, 1.0), 0.1, until=lambda m: m[3]), "the event"),
    "event beyond the bath": (
        lambda: lt.integrate(body_with_bath(), X, (0.0, 1.0), 0.1, until=lambda x: x[4]),
        "index 4",
    ),
}


@pytest.mark.parametrize("make_table", [np.array, jnp.array])
def test_a_table_of_indices_in_an_energy_is_refused_by_name(make_table):
    """The energy is traced while something else is, and the check read a traced number then."""
    with pytest.raises(IndexOutOfRangeError, match=r"the energy, .* has the index 3 of an axis with 3 entries"):
        body(lambda m: jnp.sum(m[make_table([0, 3])]) ** 2)
    body(lambda m: jnp.sum(jnp.where(NEIGHBOURS < 3, m[make_table(NEIGHBOURS)], 0.0) ** 2))


@pytest.mark.parametrize("role", ROLES)
def test_every_function_of_a_user_is_checked(role):
    make, message = ROLES[role]
    with pytest.raises(lt.LiethermoError, match=message) as caught:
        make()
    assert isinstance(caught.value, IndexError | TypeError)
    assert "Python counts from 0, so the last index is " in str(caught.value)


def test_advised_mode_works():
    """The index mode that the message suggests is accepted, and gives the entry that JAX would take."""
    system = body(lambda m: energy(m) + m.at[3].get(mode="clip"))
    assert float(system.energy.value(X)) == float(energy(X) + X[2])


def test_an_event_sees_the_entropy_of_a_bath():
    solution = lt.integrate(body_with_bath(), X, (0.0, 10.0), 0.1, until=lambda x: x[3] - 0.001)
    assert solution.status.code == "event"


@pytest.mark.parametrize("method", ["set", "add", "mul"])
def test_advised_mode_works_where_entries_are_written(method):
    """Without ``mode`` the index is refused with the advice; with it, the array stays as it is."""
    with pytest.raises(IndexOutOfRangeError, match=r'JAX would change no entry .*, write mode="drop"'):
        body(lambda m: jnp.sum(getattr(m.at[3], method)(2.0) ** 2))
    system = body(lambda m: jnp.sum(getattr(m.at[3], method)(2.0, mode="drop") ** 2))
    assert float(system.energy.value(X)) == pytest.approx(0.4**2 + 0.5**2 + 0.3**2, rel=1e-15)


def test_a_second_function_that_takes_an_entry_is_judged_by_its_own_line():
    """JAX keeps the jaxpr of ``jnp.take``, with the line that called it first."""

    def fills(m):
        return jnp.nan_to_num(jnp.take(m, 3, mode="fill"))

    def forgets(m):
        return jnp.take(m, 3)

    for function in (fills, forgets, fills):
        jaxpr = jax.make_jaxpr(function)(X)
        if function is fills:
            check_indices(jaxpr)
        else:
            with pytest.raises(IndexOutOfRangeError, match=r'forgets\).*read NaN .*, write mode="fill"'):
                check_indices(jaxpr)
