"""Plain functions as programs with parameters: closures that differ only in their numbers become one program.

A function that is made anew in every pass of a loop has a new identity, so its compiled program would not be found
again. But it has the same jaxpr, except for the numbers that are its literals and constants. These are taken out and
become the leaves of a pytree; the rest is one object for equal operations. Tracers that a function closes over are
leaves too, so they can be differentiated.
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
from .short_form import callable_name
from .trace_errors import check_precision, check_returned_value


class TracedProgram:
    """The operations of a function of arrays of given shapes, without its numbers; equal operations are one object.

    Attributes
    ----------
    closed_jaxpr : ClosedJaxpr
        The numbers are its first arguments.
    result_structure : PyTreeDef
        Structure of the result.
    argument_avals : tuple of avals
    has_while_loop : bool
        Whether there is a loop of unknown length, which JAX can differentiate in forward mode only.
    """

    def __init__(self, closed_jaxpr: ClosedJaxpr, structure, avals: tuple, has_while_loop: bool):
        self.closed_jaxpr, self.result_structure, self.argument_avals, self.has_while_loop = (
            closed_jaxpr,
            structure,
            avals,
            has_while_loop,
        )

    def __repr__(self) -> str:
        return f"{len(self.closed_jaxpr.eqns)} operations"

    def __copy__(self) -> TracedProgram:
        return self

    def __deepcopy__(self, memo) -> TracedProgram:
        return self


_traced_programs: weakref.WeakValueDictionary[Hashable, TracedProgram] = weakref.WeakValueDictionary()
_lock = threading.Lock()


class _NonComparingLabel:
    """A name for messages that does not affect comparisons: all labels are equal."""

    def __init__(self, name: str):
        self.name = name

    def __repr__(self) -> str:
        return self.name

    def __eq__(self, other) -> bool:
        return isinstance(other, _NonComparingLabel)

    def __hash__(self) -> int:
        return 0


class TracedFunction(Module):
    """A function of arrays, traced once, as a pytree of its numbers.

    Attributes
    ----------
    numbers : tuple of arrays
        The Python numbers in one array, then the arrays that the function closes over.
    program : TracedProgram
    label : _NonComparingLabel
        Name of the function, for messages.
    """

    numbers: tuple[jax.Array, ...]
    program: TracedProgram = eqx.field(static=True)
    label: _NonComparingLabel = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return self.label.name

    def __call__(self, *arguments):
        expected_avals = self.program.argument_avals
        arrays = tuple(map(jnp.asarray, arguments))
        if tuple(np.shape(a) for a in arrays) != tuple(a.shape for a in expected_avals):
            expected_shapes = ", ".join(str(a.shape) for a in expected_avals)
            raise FunctionError(
                f"{self.label.name} must be called with arrays of shape {expected_shapes}, as in its system, "
                f"got {', '.join(str(np.shape(a)) for a in arrays)}"
            )
        values = [*self.numbers, *(a.astype(b.dtype) for a, b in zip(arrays, expected_avals, strict=True))]
        run = _run_with_forward_mode_derivatives if self.program.has_while_loop else _run_program
        return jax.tree_util.tree_unflatten(self.program.result_structure, run(self.program, values))


def _run_program(program: TracedProgram, values: Sequence) -> list:
    """Return the results of a program for its numbers and arguments; the first value holds all Python numbers."""
    number_array, *arrays = values
    scalars = [jax.lax.squeeze(jax.lax.slice(number_array, (i,), (i + 1,)), (0,)) for i in range(number_array.shape[0])]
    return jaxpr_as_fun(program.closed_jaxpr)(*scalars, *arrays)


def _run_with_forward_mode_derivatives(program: TracedProgram, values: Sequence) -> list:
    """Return the results of a program with a loop of unknown length, whose derivatives JAX takes in forward mode."""
    return _with_forward_mode_derivatives(lambda *values: _run_program(program, values))(*values)


def _with_forward_mode_derivatives(function: Callable) -> Callable:
    """Return a function whose derivatives are computed in forward mode, also where JAX asks for reverse mode.

    A loop of unknown length cannot be differentiated in reverse mode. The tangent is the Jacobian, computed in forward
    mode, times the direction; this product is linear, so JAX can transpose it. The Jacobian is wrapped in the same way,
    for higher derivatives.
    """

    @jax.custom_jvp
    def evaluate(*values):
        return function(*values)

    @evaluate.defjvp
    def jvp_rule(values, tangents):
        values, tangents = tuple(map(jnp.asarray, values)), tuple(map(jnp.asarray, tangents))
        inexact_indices = [i for i, v in enumerate(values) if jnp.issubdtype(v.dtype, jnp.inexact)]

        def evaluate_inexact(*inexact_values):
            full_values = list(values)
            for i, v in zip(inexact_indices, inexact_values, strict=True):
                full_values[i] = v
            return function(*full_values)

        def directional_derivative(columns):
            terms = [
                jnp.tensordot(column, tangents[i], tangents[i].ndim)
                for i, column in zip(inexact_indices, columns, strict=True)
            ]
            return sum(terms[1:], terms[0])

        jacobians = _with_forward_mode_derivatives(
            lambda *inexact_arrays: jax.tree_util.tree_leaves(
                jax.jacfwd(evaluate_inexact, tuple(range(len(inexact_indices))))(*inexact_arrays)
            )
        )(*(values[i] for i in inexact_indices))
        outputs = evaluate(*values)
        columns = [jacobians[k * len(inexact_indices) : (k + 1) * len(inexact_indices)] for k in range(len(outputs))]
        return outputs, list(map(directional_derivative, columns))

    return evaluate


# -- conversion -------------------------------------------------------------------------------------------------------


def trace_function(function: Callable, *arguments) -> TracedFunction:
    """Trace a function of arrays of given shapes (``jax.ShapeDtypeStruct``); return it as a pytree of its numbers."""
    is_library_code = is_library_object(function)
    name = callable_name(function)

    def evaluate(*values):  # a new function object: JAX caches traces by it, and globals that it reads may change
        result = function(*values)
        check_returned_value(result, name)
        return result

    with contextlib.nullcontext() if is_library_code else user_settings():
        closed_jaxpr, result_shapes = jax.make_jaxpr(evaluate, return_shape=True)(*arguments)
    if not is_library_code:
        check_precision(closed_jaxpr.jaxpr, name)
    check_indices(closed_jaxpr)
    lifter = ConstantLifter()
    jaxpr, constants, numbers = lifter.lift_numbers(closed_jaxpr)
    structure = jax.tree_util.tree_structure(result_shapes)
    avals = tuple(jax.ShapeDtypeStruct(np.shape(a), a.dtype) for a in arguments)
    key = (content_key(ClosedJaxpr(jaxpr, constants)), structure, tuple((a.shape, a.dtype) for a in avals))
    with _lock:
        program = _traced_programs.get(key)
        if program is None:
            program = _traced_programs[key] = TracedProgram(
                ClosedJaxpr(jaxpr, constants), structure, avals, lifter.has_while_loop
            )
    return TracedFunction(numbers, program, _NonComparingLabel(name))


def _defining_module(function: Callable) -> str:
    """Return the name of the module that defines a function or the class of an object."""
    return getattr(function, "__module__", None) or type(function).__module__


def is_library_object(function: Any) -> bool:
    """Return whether a function, or the class of an object, is defined in this library."""
    return _defining_module(function).split(".")[0] in ("liethermo", "manifolds")


def _check_indices_in_use(tree: Any, example_use: Callable, shapes: Sequence[tuple[int, ...]]) -> None:
    """Raise IndexOutOfRangeError if a user's object has a constant index out of range; skip what cannot be traced."""
    try:
        closed_jaxpr = jax.make_jaxpr(lambda *a: example_use(tree, *a))(
            *(jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes)
        )
    except Exception:
        return
    check_indices(closed_jaxpr)


def is_plain_function(leaf) -> bool:
    """Return whether a leaf of a pytree is a plain function: callable, but not a class, module or array."""
    return callable(leaf) and not isinstance(leaf, type | eqx.Module | jax.Array | np.ndarray)


def trace_callables_and_result_shapes(
    tree: Any, example_use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None
) -> tuple[Any, Any]:
    """Return a pytree with its plain functions traced, and the shapes of the result of ``example_use``.

    Python floats among its leaves, such as fields of an ``equinox.Module`` that is used as a function, become arrays
    unless Python needs their values.

    Parameters
    ----------
    tree : pytree
    example_use : function from such a pytree and arrays
        Calls the functions as they will be called later; it is traced to find the shapes of their arguments.
    *shapes : tuple of int
        Shapes of the arrays.
    is_leaf : function, optional
        Identifies parts of the tree that are left unchanged.
    """
    leaves, structure = jax.tree_util.tree_flatten(tree, is_leaf=is_leaf)
    if any(type(leaf) is float for leaf in leaves):
        try:
            return _trace_with_recorders(leaves, structure, example_use, shapes, float)
        except (TypeError, ValueError, AttributeError):  # an error that does not come from the arrays is raised below
            pass
    return _trace_with_recorders(leaves, structure, example_use, shapes, None)


def _trace_with_recorders(
    leaves: list, structure, example_use: Callable, shapes, number_type: type | None
) -> tuple[Any, Any]:
    """Trace ``example_use`` with recorders in place of plain functions, and arrays in place of leaves of
    ``number_type``."""
    recorders = {id(leaf): _CallRecorder(leaf) for leaf in leaves if is_plain_function(leaf)}
    number_indices = [i for i, leaf in enumerate(leaves) if type(leaf) is number_type]

    def run_example_use(numbers, *arguments):
        recorded_leaves = [recorders.get(id(leaf), leaf) for leaf in leaves]
        for i, value in zip(number_indices, numbers, strict=True):
            recorded_leaves[i] = value
        return example_use(jax.tree_util.tree_unflatten(structure, recorded_leaves), *arguments)

    scalar, arguments = jax.ShapeDtypeStruct((), jnp.float64), [jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes]
    closed_jaxpr, result_shapes = jax.make_jaxpr(run_example_use, return_shape=True)(
        [scalar for _ in number_indices], *arguments
    )
    check_indices(closed_jaxpr)
    traced_leaves = [
        recorders[id(leaf)].traced_or_original_function if id(leaf) in recorders else leaf for leaf in leaves
    ]
    with jax.ensure_compile_time_eval():
        for i in number_indices:
            traced_leaves[i] = jnp.asarray(np.float64(leaves[i]))
    return jax.tree_util.tree_unflatten(structure, traced_leaves), result_shapes


def has_plain_functions_or_floats(tree: Any, is_leaf: Callable | None = None) -> bool:
    """Return whether a pytree has plain functions, which are to be traced, or Python floats among its leaves."""
    leaves = jax.tree_util.tree_leaves(tree, is_leaf=is_leaf)
    return any(is_plain_function(leaf) or type(leaf) is float for leaf in leaves)


def trace_callables(tree: Any, example_use: Callable, *shapes: tuple[int, ...], is_leaf: Callable | None = None) -> Any:
    """Return a pytree with its plain functions traced, as :func:`trace_callables_and_result_shapes` does.

    A tree without plain functions and floats is returned unchanged; an object of the user's is checked for constant
    indices out of range.
    """
    if not has_plain_functions_or_floats(tree, is_leaf):
        if not is_library_object(tree):
            _check_indices_in_use(tree, example_use, shapes)
        return tree
    return trace_callables_and_result_shapes(tree, example_use, *shapes, is_leaf=is_leaf)[0]


class _CallRecorder:
    """A plain function that traces itself for the shapes of the arguments with which it is called."""

    def __init__(self, function: Callable):
        self.function, self.__name__ = function, callable_name(function)
        self._traced_functions: dict[tuple, TracedFunction] = {}
        self._is_called_otherwise = False

    @property
    def traced_or_original_function(self) -> Callable:
        """Return the traced function, or the function itself if it was never called, or in more than one way."""
        return (
            next(iter(self._traced_functions.values()))
            if len(self._traced_functions) == 1 and not self._is_called_otherwise
            else self.function
        )

    def __call__(self, *arguments, **keywords):
        if keywords or not all(isinstance(a, jax.Array) for a in arguments):
            self._is_called_otherwise = True
            return self.function(*arguments, **keywords)
        key = tuple((a.shape, a.dtype) for a in arguments)
        if key not in self._traced_functions:
            self._traced_functions[key] = trace_function(self.function, *(jax.ShapeDtypeStruct(*k) for k in key))
        return self._traced_functions[key](*arguments)
