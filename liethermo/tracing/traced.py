"""Plain functions as programs with parameters: closures that differ in their numbers alone become one program.

A function made anew in every pass of a loop has a new identity, and whatever was compiled for the last one would not be
found again. What it does is the same: the jaxpr that JAX traces, in which its numbers stand as literals and constants.
Here they are taken out and become the leaves of a pytree; what is left is an object that is one and the same for equal
operations. Tracers that a function closes over are leaves too, where they can be seen and differentiated.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from manifolds._content_keys import content_key
from manifolds._precision import user_settings
from manifolds._pytree_module import Module

from ..errors import FunctionError
from .index_check import check_indices
from .lifting import ConstantLifter
from .trace_errors import check_not_none, check_precision


class TracedProgram:
    """What a function does to arrays of given shapes, without the numbers in it; equal operations are one object.

    Attributes
    ----------
    closed_jaxpr : ClosedJaxpr
        Its first arguments are the numbers.
    result_structure : PyTreeDef
        Of the result.
    argument_avals : tuple of avals
    has_while_loop : bool
        Whether it has a loop of unknown length, which JAX differentiates forwards alone.
    """

    def __init__(self, closed: ClosedJaxpr, structure, arguments: tuple, loops: bool):
        self.closed_jaxpr, self.result_structure, self.argument_avals, self.has_while_loop = (
            closed,
            structure,
            arguments,
            loops,
        )

    def __repr__(self) -> str:
        return f"{len(self.closed_jaxpr.eqns)} operations"

    def __copy__(self) -> TracedProgram:
        return self

    def __deepcopy__(self, memo) -> TracedProgram:
        return self


_traced_programs: weakref.WeakValueDictionary[Hashable, TracedProgram] = weakref.WeakValueDictionary()
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


class TracedFunction(Module):
    """A function of arrays, traced once, as a pytree of the numbers that it was written with.

    Attributes
    ----------
    numbers : tuple of arrays
        The plain numbers in one array, then the arrays that it closes over.
    program : Content
    """

    numbers: tuple[jax.Array, ...]
    program: TracedProgram = eqx.field(static=True)
    label: _Label = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return self.label.name

    def __call__(self, *arguments):
        wanted = self.program.argument_avals
        given = tuple(map(jnp.asarray, arguments))
        if tuple(np.shape(a) for a in given) != tuple(a.shape for a in wanted):
            raise FunctionError(
                f"{self.label.name} is a function of arrays of shapes {', '.join(str(a.shape) for a in wanted)} in the "
                f"system that it belongs to, not of {', '.join(str(np.shape(a)) for a in given)}"
            )
        values = [*self.numbers, *(a.astype(b.dtype) for a, b in zip(given, wanted, strict=True))]
        run = _run_with_while_loop if self.program.has_while_loop else _run_program
        return jax.tree_util.tree_unflatten(self.program.result_structure, run(self.program, values))


def _run_program(content: TracedProgram, values: Sequence) -> list:
    packed, *rest = values
    scalars = [jax.lax.squeeze(jax.lax.slice(packed, (i,), (i + 1,)), (0,)) for i in range(packed.shape[0])]
    return jaxpr_as_fun(content.closed_jaxpr)(*scalars, *rest)


def _run_with_while_loop(content: TracedProgram, values: Sequence) -> list:
    return _forward_differentiable(lambda *values: _run_program(content, values))(*values)


def _forward_differentiable(function: Callable) -> Callable:
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

        def evaluate_inexact(*moving):
            whole = list(values)
            for i, v in zip(real, moving, strict=True):
                whole[i] = v
            return function(*whole)

        def tangent(found, columns):
            terms = [
                jnp.tensordot(column, tangents[i], tangents[i].ndim) for i, column in zip(real, columns, strict=True)
            ]
            return sum(terms[1:], terms[0])

        jacobians = _forward_differentiable(
            lambda *moving: jax.tree_util.tree_leaves(jax.jacfwd(evaluate_inexact, tuple(range(len(real))))(*moving))
        )(*(values[i] for i in real))
        found = called(*values)
        columns = [jacobians[k * len(real) : (k + 1) * len(real)] for k in range(len(found))]
        return found, [tangent(f, c) for f, c in zip(found, columns, strict=True)]

    return called


# -- conversion -------------------------------------------------------------------------------------------------------


def trace_function(function: Callable, *arguments) -> TracedFunction:
    """A function of arrays of these shapes (``jax.ShapeDtypeStruct``) as a pytree of its numbers."""
    ours = _is_library_object(function)
    name = getattr(function, "__name__", type(function).__name__)

    def evaluate(*values):  # anew: JAX keeps the trace of a function object, and what the function reads may change
        result = function(*values)
        check_not_none(result, name)
        return result

    with contextlib.nullcontext() if ours else user_settings():
        closed, found = jax.make_jaxpr(evaluate, return_shape=True)(*arguments)
    if not ours:
        check_precision(closed.jaxpr, name)
    check_indices(closed)
    lifting = ConstantLifter()
    jaxpr, constants, numbers = lifting.lift_jaxpr(closed)
    structure = jax.tree_util.tree_structure(found)
    avals = tuple(jax.ShapeDtypeStruct(np.shape(a), a.dtype) for a in arguments)
    found_by = (content_key(ClosedJaxpr(jaxpr, constants)), structure, tuple((a.shape, a.dtype) for a in avals))
    with _lock:
        content = _traced_programs.get(found_by)
        if content is None:
            content = _traced_programs[found_by] = TracedProgram(
                ClosedJaxpr(jaxpr, constants), structure, avals, lifting.has_while_loop
            )
    return TracedFunction(numbers, content, _Label(name))


def _defining_module(function: Callable) -> str:
    """Where a function, or the class of one, is defined."""
    return getattr(function, "__module__", None) or type(function).__module__


def _is_library_object(function: Any) -> bool:
    """Whether a function, or the class of an object, is defined in this library."""
    return _defining_module(function).split(".")[0] in ("liethermo", "manifolds")


def _check_indices_of(tree: Any, use: Callable, shapes: Sequence[tuple[int, ...]]) -> None:
    """Check the indices in a class of the user's, where it can be traced; where not, its use will say so."""
    try:
        closed = jax.make_jaxpr(lambda *a: use(tree, *a))(*(jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes))
    except Exception:
        return
    check_indices(closed)


def is_plain_function(leaf) -> bool:
    """Whether a leaf of a pytree is a function."""
    return callable(leaf) and not isinstance(leaf, type | eqx.Module | jax.Array | np.ndarray)


def trace_callables_with_result(
    tree: Any, use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None
) -> tuple[Any, Any]:
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
            return _trace_with_recorders(leaves, structure, use, shapes, float)
        except (TypeError, ValueError, AttributeError):  # what is wrong without arrays too, shows below
            pass
    return _trace_with_recorders(leaves, structure, use, shapes, None)


def _trace_with_recorders(leaves: list, structure, use: Callable, shapes, number: type | None) -> tuple[Any, Any]:
    """What ``use`` makes of leaves, those of one type of number being arrays, and of functions that are watched."""
    recorders = {id(leaf): _CallRecorder(leaf) for leaf in leaves if is_plain_function(leaf)}
    moved = [i for i, leaf in enumerate(leaves) if type(leaf) is number]

    def use_leaves(numbers, *arguments):
        watched = [recorders.get(id(leaf), leaf) for leaf in leaves]
        for i, value in zip(moved, numbers, strict=True):
            watched[i] = value
        return use(jax.tree_util.tree_unflatten(structure, watched), *arguments)

    scalar, arguments = jax.ShapeDtypeStruct((), jnp.float64), [jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes]
    closed, found = jax.make_jaxpr(use_leaves, return_shape=True)([scalar for _ in moved], *arguments)
    check_indices(closed)
    results = [recorders[id(leaf)].result if id(leaf) in recorders else leaf for leaf in leaves]
    with jax.ensure_compile_time_eval():
        for i in moved:
            results[i] = jnp.asarray(np.float64(leaves[i]))
    return jax.tree_util.tree_unflatten(structure, results), found


def trace_callables(tree: Any, use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None) -> Any:
    """As :func:`converted`, the pytree alone; nothing is traced where there is nothing to convert."""
    leaves = jax.tree_util.tree_leaves(tree, is_leaf=is_leaf)
    if not any(is_plain_function(leaf) or type(leaf) is float for leaf in leaves):
        if not _is_library_object(tree):
            _check_indices_of(tree, use, shapes)
        return tree
    return trace_callables_with_result(tree, use, *shapes, is_leaf=is_leaf)[0]


class _CallRecorder:
    """A plain function in use, traced for the arguments that it is first called with."""

    def __init__(self, function: Callable):
        self.function, self.__name__ = function, getattr(function, "__name__", type(function).__name__)
        self._traced_functions: dict[tuple, TracedFunction] = {}
        self._is_called_otherwise = False

    @property
    def result(self) -> Callable:
        """The traced function, or the function itself where it is called in more than one way, or not at all."""
        return (
            next(iter(self._traced_functions.values()))
            if len(self._traced_functions) == 1 and not self._is_called_otherwise
            else self.function
        )

    def __call__(self, *arguments, **named):
        if named or not all(isinstance(a, jax.Array) for a in arguments):
            self._is_called_otherwise = True
            return self.function(*arguments, **named)
        key = tuple((a.shape, a.dtype) for a in arguments)
        if key not in self._traced_functions:
            self._traced_functions[key] = trace_function(self.function, *(jax.ShapeDtypeStruct(*k) for k in key))
        return self._traced_functions[key](*arguments)
