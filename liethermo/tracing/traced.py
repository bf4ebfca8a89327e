"""Plain functions as programs with parameters: closures that differ in their numbers alone become one program.

A function made anew in every pass of a loop has a new identity, and whatever was compiled for the last one would not be
found again. What it does is the same: the jaxpr that JAX traces, in which its numbers stand as literals and constants.
Here they are taken out and become the leaves of a pytree; what is left is an object that is one and the same for equal
operations. Tracers that a function closes over are leaves too, where they can be seen and differentiated.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from ..errors import FunctionError


class Content:
    """What a function does to arrays of given shapes, without the numbers in it; equal operations are one object.

    Attributes
    ----------
    closed : ClosedJaxpr
        Its first arguments are the numbers.
    structure : PyTreeDef
        Of the result.
    arguments : tuple of avals
    loops : bool
        Whether it has a loop of unknown length, which JAX differentiates forwards alone.
    """

    def __init__(self, closed: ClosedJaxpr, structure, arguments: tuple, loops: bool):
        self.closed, self.structure, self.arguments, self.loops = closed, structure, arguments, loops

    def __repr__(self) -> str:
        return f"{len(self.closed.eqns)} operations"

    def __copy__(self) -> Content:
        return self

    def __deepcopy__(self, memo) -> Content:
        return self


_contents: weakref.WeakValueDictionary[Hashable, Content] = weakref.WeakValueDictionary()
_lock = threading.Lock()


class _Label:
    """A name, which makes no difference: all labels are equal."""

    def __init__(self, name: str):
        self.name = name

    def __repr__(self) -> str:
        return self.name

    def __eq__(self, other) -> bool:
        return isinstance(other, _Label)

    def __hash__(self) -> int:
        return 0


class Traced(eqx.Module):
    """A function of arrays, traced once, as a pytree of the numbers that it was written with.

    Attributes
    ----------
    numbers : tuple of arrays
        The plain numbers in one array, then the arrays that it closes over.
    content : Content
    """

    numbers: tuple[jax.Array, ...]
    content: Content = eqx.field(static=True)
    label: _Label = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return self.label.name

    def __call__(self, *arguments):
        wanted = self.content.arguments
        given = tuple(map(jnp.asarray, arguments))
        if tuple(np.shape(a) for a in given) != tuple(a.shape for a in wanted):
            raise FunctionError(
                f"{self.label.name} is a function of arrays of shapes {', '.join(str(a.shape) for a in wanted)} in the "
                f"system that it belongs to, not of {', '.join(str(np.shape(a)) for a in given)}"
            )
        values = [*self.numbers, *(a.astype(b.dtype) for a, b in zip(given, wanted, strict=True))]
        run = _looping if self.content.loops else _plain
        return jax.tree_util.tree_unflatten(self.content.structure, run(self.content, values))


def _plain(content: Content, values: Sequence) -> list:
    packed, *rest = values
    scalars = [jax.lax.squeeze(jax.lax.slice(packed, (i,), (i + 1,)), (0,)) for i in range(packed.shape[0])]
    return jaxpr_as_fun(content.closed)(*scalars, *rest)


def _looping(content: Content, values: Sequence) -> list:
    return _forwards(lambda *values: _plain(content, values))(*values)


def _forwards(function: Callable) -> Callable:
    """A function to a list of arrays, each derivative of which is taken forwards, whichever way is asked for.

    A loop of unknown length has no derivative backwards. The tangent is the Jacobian, found forwards, times the
    direction, and that product is linear: it can be transposed. Likewise for the derivatives of the Jacobian.
    """

    @jax.custom_jvp
    def called(*values):
        return function(*values)

    @called.defjvp
    def rule(values, tangents):
        values, tangents = tuple(map(jnp.asarray, values)), tuple(map(jnp.asarray, tangents))
        real = [i for i, v in enumerate(values) if jnp.issubdtype(v.dtype, jnp.inexact)]

        def of_real(*moving):
            whole = list(values)
            for i, v in zip(real, moving, strict=True):
                whole[i] = v
            return function(*whole)

        def tangent(found, columns):
            terms = [
                jnp.tensordot(column, tangents[i], tangents[i].ndim) for i, column in zip(real, columns, strict=True)
            ]
            return sum(terms[1:], terms[0])

        jacobians = _forwards(
            lambda *moving: jax.tree_util.tree_leaves(jax.jacfwd(of_real, tuple(range(len(real))))(*moving))
        )(*(values[i] for i in real))
        found = called(*values)
        columns = [jacobians[k * len(real) : (k + 1) * len(real)] for k in range(len(found))]
        return found, [tangent(f, c) for f, c in zip(found, columns, strict=True)]

    return called


# -- conversion -------------------------------------------------------------------------------------------------------


def traced(function: Callable, *arguments) -> Traced:
    """A function of arrays of these shapes (``jax.ShapeDtypeStruct``) as a pytree of its numbers."""
    closed, found = jax.make_jaxpr(function, return_shape=True)(*arguments)
    lifting = _Lifting()
    jaxpr, constants, numbers = lifting.whole(closed)
    structure = jax.tree_util.tree_structure(found)
    avals = tuple(jax.ShapeDtypeStruct(np.shape(a), a.dtype) for a in arguments)
    key = (_key(ClosedJaxpr(jaxpr, constants)), structure, tuple((a.shape, a.dtype) for a in avals))
    with _lock:
        content = _contents.get(key)
        if content is None:
            content = _contents[key] = Content(ClosedJaxpr(jaxpr, constants), structure, avals, lifting.loops)
    return Traced(numbers, content, _Label(getattr(function, "__name__", type(function).__name__)))


def is_plain(leaf) -> bool:
    """Whether a leaf of a pytree is a function."""
    return callable(leaf) and not isinstance(leaf, type | eqx.Module | jax.Array | np.ndarray)


def converted(tree: Any, use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None) -> tuple[Any, Any]:
    """A pytree with its plain functions traced, and the shapes of what ``use`` returned.

    Plain numbers among its leaves, such as those of an ``equinox.Module`` that is used as a function, become arrays,
    unless Python has to see their values.

    Parameters
    ----------
    tree : pytree
    use : function from such a pytree and arrays
        Calls the functions, as they will be called later: it is traced, to see the shapes of their arguments.
    *shapes : tuple of int
        Of the arrays.
    is_leaf : function, optional
        Of parts to be left alone.
    """
    leaves, structure = jax.tree_util.tree_flatten(tree, is_leaf=is_leaf)
    if any(type(leaf) is float for leaf in leaves):
        try:
            return _watched(leaves, structure, use, shapes, float)
        except (TypeError, ValueError, AttributeError):  # what is wrong without arrays too, shows below
            pass
    return _watched(leaves, structure, use, shapes, None)


def _watched(leaves: list, structure, use: Callable, shapes, number: type | None) -> tuple[Any, Any]:
    """What ``use`` makes of leaves, those of one type of number being arrays, and of functions that are watched."""
    recorders = {id(leaf): _Recorder(leaf) for leaf in leaves if is_plain(leaf)}
    moved = [i for i, leaf in enumerate(leaves) if type(leaf) is number]

    def used(numbers, *arguments):
        watched = [recorders.get(id(leaf), leaf) for leaf in leaves]
        for i, value in zip(moved, numbers, strict=True):
            watched[i] = value
        return use(jax.tree_util.tree_unflatten(structure, watched), *arguments)

    scalar, arguments = jax.ShapeDtypeStruct((), jnp.float64), [jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes]
    found = jax.eval_shape(used, [scalar for _ in moved], *arguments)
    results = [recorders[id(leaf)].result if id(leaf) in recorders else leaf for leaf in leaves]
    with jax.ensure_compile_time_eval():
        for i in moved:
            results[i] = jnp.asarray(np.float64(leaves[i]))
    return jax.tree_util.tree_unflatten(structure, results), found


def settled(tree: Any, use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None) -> Any:
    """As :func:`converted`, the pytree alone; nothing is traced where there is nothing to convert."""
    leaves = jax.tree_util.tree_leaves(tree, is_leaf=is_leaf)
    if not any(is_plain(leaf) or type(leaf) is float for leaf in leaves):
        return tree
    return converted(tree, use, *shapes, is_leaf=is_leaf)[0]


class _Recorder:
    """A plain function in use, traced for the arguments that it is first called with."""

    def __init__(self, function: Callable):
        self.function, self.__name__ = function, getattr(function, "__name__", type(function).__name__)
        self._found: dict[tuple, Traced] = {}
        self._otherwise = False

    @property
    def result(self) -> Callable:
        """The traced function, or the function itself where it is called in more than one way, or not at all."""
        return next(iter(self._found.values())) if len(self._found) == 1 and not self._otherwise else self.function

    def __call__(self, *arguments, **named):
        if named or not all(isinstance(a, jax.Array) for a in arguments):
            self._otherwise = True
            return self.function(*arguments, **named)
        key = tuple((a.shape, a.dtype) for a in arguments)
        if key not in self._found:
            self._found[key] = traced(self.function, *(jax.ShapeDtypeStruct(*k) for k in key))
        return self._found[key](*arguments)


# -- numbers taken out of a jaxpr -------------------------------------------------------------------------------------

CALLS = ("jit", "pjit", "closed_call", "core_call")
"""Primitives that call a jaxpr, which takes their place here."""


class _Lifting:
    """The numbers of a jaxpr made its first arguments: all literals of double precision but zeros, and all constants.

    Zeros stay, since what vanishes belongs to the operations; so do the exponents that have instructions of their own,
    and numbers that truth values or integers come from.
    """

    def __init__(self):
        self.loops = False

    def whole(self, closed: ClosedJaxpr) -> tuple[Jaxpr, list, tuple]:
        """The jaxpr, its remaining constants, and the numbers: scalars in one array, then arrays."""
        body = _Body(self)
        body.bind(closed.jaxpr, closed.consts, closed.jaxpr.invars)
        scalars = [(v, x) for v, x in body.numbers if isinstance(x, float)]
        arrays = [(v, x) for v, x in body.numbers if not isinstance(x, float)]
        invars = [v for v, _ in (*scalars, *arrays)] + list(closed.jaxpr.invars)
        jaxpr = Jaxpr(
            list(body.constants), invars, body.outputs, body.equations, closed.jaxpr.effects, _unnamed(closed.jaxpr)
        )
        with jax.ensure_compile_time_eval():  # numbers, whatever is being traced around
            packed = jnp.asarray(np.array([x for _, x in scalars], dtype=np.float64))
            values = [x if isinstance(x, jax.Array) else jnp.asarray(np.asarray(x)) for _, x in arrays]
        return jaxpr, list(body.constants.values()), (packed, *values)

    def inner(self, closed: ClosedJaxpr) -> tuple[ClosedJaxpr, list[tuple[Var, Any]]]:
        """The jaxpr of a loop or a branch, its numbers in front of its arguments, and those numbers."""
        body = _Body(self)
        fresh = [Var(v.aval) for v in closed.jaxpr.invars]
        body.bind(closed.jaxpr, closed.consts, fresh)
        invars = [v for v, _ in body.numbers] + fresh
        jaxpr = Jaxpr(
            list(body.constants), invars, body.outputs, body.equations, closed.jaxpr.effects, _unnamed(closed.jaxpr)
        )
        return ClosedJaxpr(jaxpr, list(body.constants.values())), body.numbers


class _Body:
    """Equations under construction."""

    def __init__(self, lifting: _Lifting):
        self.lifting = lifting
        self.equations: list[JaxprEqn] = []
        self.numbers: list[tuple[Var, Any]] = []
        self.constants: dict[Var, Any] = {}
        self.outputs: list = []
        self._fixed: dict[
            Var, Any
        ] = {}  # what does not depend on the arguments: a number, or the equation that makes it

    def bind(self, jaxpr: Jaxpr, consts: Sequence, arguments: Sequence) -> None:
        env: dict[Var, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
        self.outputs = self._run(jaxpr, consts, env)

    def _run(self, jaxpr: Jaxpr, consts: Sequence, env: dict[Var, Any]) -> list:
        exponents = {eqn.invars[1] for eqn in jaxpr.eqns if eqn.primitive.name == "pow" and type(eqn.invars[1]) is Var}
        for var, value in zip(jaxpr.constvars, consts, strict=True):
            env[var] = self._constant(var, value, var in exponents)

        def read(atom):
            return atom if isinstance(atom, Literal) else env[atom]

        for eqn in jaxpr.eqns:
            inputs = [read(a) for a in eqn.invars]
            if eqn.primitive.name in CALLS and isinstance(eqn.params.get("jaxpr"), ClosedJaxpr):
                inner = eqn.params["jaxpr"]
                found = self._run(inner.jaxpr, inner.consts, dict(zip(inner.jaxpr.invars, inputs, strict=True)))
                env.update(zip(eqn.outvars, found, strict=True))
                continue
            fixed = self._value_of(eqn, inputs)
            if fixed is not None:
                for var, value in zip(eqn.outvars, fixed, strict=True):
                    env[var] = self._keep(Var(var.aval), value)
                continue
            inputs, params = self._lifted(eqn, inputs)
            outputs = [type(v)(v.aval) for v in eqn.outvars]
            env.update(zip(eqn.outvars, outputs, strict=True))
            self.equations.append(eqn.replace(invars=inputs, outvars=outputs, params=params))
            if all(isinstance(a, Literal) or a in self._fixed for a in inputs) and not eqn.effects:
                self._fixed.update((v, (self.equations[-1], i)) for i, v in enumerate(outputs))
        return [self._number(a.val, a.aval) if _is_number(a) else a for a in map(read, jaxpr.outvars)]

    # -- numbers and constants ------------------------------------------------------------------------------------

    def _number(self, value, aval) -> Var:
        var = Var(aval)
        concrete = np.shape(value) == () and not isinstance(value, jax.Array)
        self.numbers.append((var, float(value) if concrete else value))
        self._fixed[var] = value
        return var

    def _keep(self, var: Var, value) -> Var:
        self.constants[var] = self._fixed[var] = value
        return var

    def _constant(self, var: Var, value, exponent: bool):
        if isinstance(value, jax.core.Tracer):
            return self._number(value, var.aval)
        if getattr(var.aval, "dtype", None) == np.float64 and not exponent:
            return self._number(value if isinstance(value, jax.Array) else np.asarray(value), var.aval)
        return self._keep(Var(var.aval), value)

    def _lifted(self, eqn: JaxprEqn, inputs: list) -> tuple[list, dict]:
        """The inputs and parameters of an equation, its numbers taken out."""
        name, params = eqn.primitive.name, dict(eqn.params)
        more: list = []
        if name == "scan":
            params["jaxpr"], numbers = self.lifting.inner(params["jaxpr"])
            more = self._taken(numbers)
            params["num_consts"] += len(more)
            inputs = more + self._without_numbers(inputs)
        elif name == "cond":
            params["branches"], inputs = self._branches(params["branches"], inputs)
        elif name == "while":
            self.lifting.loops = True
            inputs = self._without_numbers(inputs)
        else:
            if not self.lifting.loops:
                self.lifting.loops = any(_loops(p) for p in params.values())
            keep = name == "pow" and isinstance(inputs[1], Literal) and float(2.0 * inputs[1].val).is_integer()
            inputs = self._without_numbers(inputs[:1]) + inputs[1:] if keep else self._without_numbers(inputs)
        return inputs, params

    def _without_numbers(self, inputs: list) -> list:
        return [self._number(a.val, a.aval) if _is_number(a) else a for a in inputs]

    def _taken(self, numbers: list[tuple[Var, Any]]) -> list[Var]:
        return [self._number(value, var.aval) for var, value in numbers]

    def _branches(self, branches, inputs: list) -> tuple[tuple, list]:
        """Branches of a choice, which all take the numbers of all of them."""
        found = [self.lifting.inner(branch) for branch in branches]
        every = [var for _, numbers in found for var, _ in numbers]
        taken = [atom for _, numbers in found for atom in self._taken(numbers)]
        new = []
        for closed, numbers in found:
            own = closed.jaxpr.invars[len(numbers) :]
            mine = {var for var, _ in numbers}
            front = [var if var in mine else Var(var.aval) for var in every]
            new.append(ClosedJaxpr(closed.jaxpr.replace(invars=[*front, *own]), closed.consts))
        index, *operands = inputs
        return tuple(new), [index, *taken, *self._without_numbers(operands)]

    # -- what follows from numbers alone ----------------------------------------------------------------------------

    def _value_of(self, eqn: JaxprEqn, inputs: list) -> list | None:
        """The values of truths or integers that follow from numbers alone: they belong to the operations."""
        if eqn.effects or all(_is_inexact(v.aval) for v in eqn.outvars):
            return None
        if not any(_is_inexact(a.aval) for a in inputs):
            return None
        if not all(isinstance(a, Literal) or a in self._fixed for a in inputs):
            return None
        memo: dict[Var, Any] = {}

        def value(atom):
            if isinstance(atom, Literal):
                return atom.val
            if atom not in memo:
                found = self._fixed[atom]
                if isinstance(found, tuple):
                    equation, i = found
                    found = _evaluated(equation, [value(a) for a in equation.invars])[i]
                memo[atom] = found
            return memo[atom]

        values = [value(a) for a in inputs]
        if any(isinstance(v, jax.core.Tracer) for v in values):
            return None
        return _evaluated(eqn, values)


def _evaluated(eqn: JaxprEqn, values: Sequence) -> list:
    inputs = [Var(a.aval) for a in eqn.invars]
    jaxpr = Jaxpr([], inputs, eqn.outvars, [eqn.replace(invars=list(inputs))], debug_info=DebugInfo("", "", None, None))
    with jax.ensure_compile_time_eval():
        return jaxpr_as_fun(ClosedJaxpr(jaxpr, []))(*values)


def _unnamed(jaxpr: Jaxpr) -> DebugInfo:
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)  # there are more arguments now


def _is_inexact(aval) -> bool:
    dtype = getattr(aval, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.inexact)


def _is_number(atom) -> bool:
    """Whether it is a literal to be lifted."""
    if not isinstance(atom, Literal) or getattr(atom.aval, "dtype", None) != np.float64:
        return False
    return bool(atom.val != 0.0) and np.shape(atom.val) == ()


def _loops(parameter) -> bool:
    """Whether a parameter of an equation has a jaxpr with a loop of unknown length."""
    if isinstance(parameter, ClosedJaxpr):
        parameter = parameter.jaxpr
    if isinstance(parameter, Jaxpr):
        return any(e.primitive.name == "while" or any(map(_loops, e.params.values())) for e in parameter.eqns)
    return isinstance(parameter, tuple | list) and any(map(_loops, parameter))


# -- keys -------------------------------------------------------------------------------------------------------------


def _key(thing: Any) -> Hashable:
    """A key that is equal for equal operations; where something has none, its identity."""
    if isinstance(thing, ClosedJaxpr):
        return ("closed", _key_of_jaxpr(thing.jaxpr), tuple(map(_key, thing.consts)))
    if isinstance(thing, Jaxpr):
        return _key_of_jaxpr(thing)
    if isinstance(thing, Literal):
        return ("literal", str(thing.aval), np.asarray(thing.val).tobytes())
    if isinstance(thing, jax.core.Tracer):
        return ("is", _Identity(thing))
    if isinstance(thing, jax.Array | np.ndarray | np.generic) or hasattr(thing, "__array__"):
        array = np.asarray(thing)
        return ("array", str(array.dtype), array.shape, array.tobytes())
    if isinstance(thing, tuple | list):
        return (type(thing), *map(_key, thing))
    if isinstance(thing, dict):
        return (dict, *((name, _key(value)) for name, value in sorted(thing.items())))
    if type(thing).__name__ == "WrappedFun":
        return _key_of_rule(thing)
    try:
        hash(thing)
    except TypeError:
        return ("is", _Identity(thing))
    return (type(thing), thing)


def _key_of_jaxpr(jaxpr: Jaxpr) -> Hashable:
    numbering: dict[Var, int] = {}

    def name(atom) -> Hashable:
        return _key(atom) if isinstance(atom, Literal) else numbering.setdefault(atom, len(numbering))

    front = tuple((name(v), str(v.aval)) for v in (*jaxpr.constvars, *jaxpr.invars))
    body = tuple(
        (
            eqn.primitive,
            tuple((k, _key(v)) for k, v in sorted(eqn.params.items())),
            tuple(map(name, eqn.invars)),
            tuple(map(name, eqn.outvars)),
        )
        for eqn in jaxpr.eqns
    )
    return (front, body, tuple(map(name, jaxpr.outvars)))


def _key_of_rule(rule) -> Hashable:
    """A derivative rule of someone's own: the function that was given, where it can be told and is there for good."""
    for _ in range(4):  # JAX wraps it in functions of its own, which are new in every trace
        found = _closed_over(rule.f)
        inner = next((c for c in found if type(c).__name__ == "WrappedFun"), None)
        if inner is None:
            inner = next((g for c in found if callable(c) for g in _closed_over(c) if type(g) is type(rule)), None)
        if inner is None:
            break
        rule = inner
    parameters = tuple(_key(getattr(p, "val", p)) for _, ps in rule.transforms for p in ps if not callable(p))
    return ("rule", rule.f, parameters)


def _closed_over(function) -> list:
    return [cell.cell_contents for cell in getattr(function, "__closure__", None) or () if _filled(cell)]


def _filled(cell) -> bool:
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


class _Identity:
    """A thing that equals itself alone, and is held on to."""

    def __init__(self, thing: Any):
        self.thing = thing

    def __eq__(self, other) -> bool:
        return isinstance(other, _Identity) and self.thing is other.thing

    def __hash__(self) -> int:
        return id(self.thing)
