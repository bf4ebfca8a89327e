"""Conversion of a traced JAX function of small arrays to a program of scalar instructions, calls and loops.

The jaxpr, derivatives included, is unrolled entry by entry. Constants are folded, structural zeros vanish, equal
subexpressions merge and dead ones are dropped, so an ``einsum`` with structure constants becomes a few products. Long
loops, and loops of unknown length, stay loops, and larger matrices are passed to LAPACK. Complex numbers are pairs. The
result equals JAX's to rounding; a function that cannot be converted is refused.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from manifolds._jaxprs import CALL_PRIMITIVES, UNKNOWN_ORIGIN, user_source_line
from manifolds.matrices import chains

from ..errors import InputError, LiethermoError
from . import indexing
from .builder import (
    EnclosingScope,
    LimitExceededError,
    ProgramBuilder,
    Scalar,
    constant_array,
    map_elementwise,
    scalar_array,
)
from .complex_numbers import ComplexBuilder, flatten_scalars, real_scalar_kinds, unflatten_scalars
from .primitives import SUPPORTED_PARAMETERS, UNROLLING_RULES
from .program import Program, ScanLoop, WhileLoop, eliminate_dead_code_and_rename
from .routines import MIN_ROUTINE_INSTRUCTIONS, call_routine_or_unroll
from .searches import aval_dtype, has_large_matrix_products

MAX_INSTRUCTIONS = 200_000
"""Largest number of instructions of a program: far more than compile in reasonable time."""


class UnsupportedPrimitive(LiethermoError):
    """Error that a function cannot be unrolled.

    Attributes
    ----------
    primitive : str
        The unsupported JAX primitive.
    source_line : str
        The line of the user's code that led to it, if JAX knows it.
    reason : str
        The unsupported use of the primitive; empty if the primitive itself is unsupported.
    too_large : bool
        Whether the function is only too long to be unrolled.
    """

    def __init__(self, primitive: str, source_line: str, reason: str = "", too_large: bool = False):
        self.primitive, self.source_line, self.reason, self.too_large = primitive, source_line, reason, too_large
        refusal = f"the compiled engine cannot run the JAX primitive {primitive!r} {reason}".rstrip()
        super().__init__(f"{refusal} ({source_line})")


class CompilerFault(UnsupportedPrimitive):
    """Error that an unexpected exception occurred inside the compiled engine: a fault of this library.

    It replaces the exception, so that the array engine can take over.

    Attributes
    ----------
    error : Exception
    """

    def __init__(self, error: Exception, primitive: str = "", source_line: str = UNKNOWN_ORIGIN):
        super().__init__(primitive, source_line)
        self.error = error
        location = f" on the JAX primitive {primitive!r} ({source_line})" if primitive else ""
        self.args = (
            f"the compiled engine failed{location}: {type(error).__name__}: {str(error).strip()}. "
            "This is a fault of liethermo, please report it",
        )


@contextlib.contextmanager
def report_compiler_faults() -> Iterator[None]:
    """Raise any unexpected exception as a :class:`CompilerFault`."""
    try:
        yield
    except LiethermoError:
        raise
    except Exception as error:
        raise CompilerFault(error) from error


@report_compiler_faults()
def scalarize(
    closed_jaxpr: ClosedJaxpr, fixed_inputs: Sequence | None = None, max_instructions: int = MAX_INSTRUCTIONS
) -> Program:
    """Unroll a closed jaxpr, as returned by ``jax.make_jaxpr``, into scalar instructions.

    Parameters
    ----------
    closed_jaxpr : ClosedJaxpr
        Jaxpr of a function of float64 arrays.
    fixed_inputs : sequence, optional
        For each input array None, or an array of its shape: a number fixes that entry at compile time, NaN leaves it to
        run time. (The zeros of a diagonal parameter matrix, for example, then shorten the program.)
    max_instructions : int
        Largest number of instructions.

    Raises
    ------
    UnsupportedPrimitive
        If a primitive has no rule, or the program exceeds the limit.
    """
    builder = ProgramBuilder(max_instructions)
    inputs, arguments = [], []
    for i, var in enumerate(closed_jaxpr.jaxpr.invars):
        if var.aval.dtype != np.float64:
            raise InputError(f"argument {i} of a compiled function must have dtype float64, got {var.aval.dtype}")
        names = [f"x{i}_{j}" for j in range(math.prod(var.aval.shape))]
        fixed_entries = (
            None if fixed_inputs is None or fixed_inputs[i] is None else np.asarray(fixed_inputs[i], dtype=np.float64)
        )
        entries = (
            names
            if fixed_entries is None
            else [n if v != v else v for n, v in zip(names, fixed_entries.ravel().tolist(), strict=True)]
        )
        inputs.append(tuple(names))
        builder.fixed_inputs += (None if fixed_entries is None else fixed_entries.ravel(),)
        arguments.append(scalar_array(entries, var.aval.shape))
    results = _unroll_jaxpr(builder, closed_jaxpr.jaxpr, closed_jaxpr.consts, arguments)
    outputs = [x.ravel().tolist() for x in results]
    return _collect_program(builder, inputs, outputs, [x.shape for x in results])


def _collect_program(
    builder: ProgramBuilder, inputs: Sequence, outputs: Sequence[Sequence[Scalar]], output_shapes: Sequence
) -> Program:
    """Return the program of the instructions that a builder has collected, without those that no output needs."""
    instructions, new_names = eliminate_dead_code_and_rename(
        builder.instructions, [a for entries in outputs for a in entries]
    )
    return Program(
        tuple(map(tuple, inputs)),
        instructions,
        tuple(tuple(new_names.get(a, a) if type(a) is str else a for a in entries) for entries in outputs),
        tuple(output_shapes),
    )


def _unroll_jaxpr(builder: ProgramBuilder, jaxpr, consts, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Unroll a jaxpr; return its outputs as arrays of scalars."""
    values = dict(zip(jaxpr.constvars, map(constant_array, consts), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(v) -> np.ndarray:
        return constant_array(v.val, aval_dtype(v.aval)) if isinstance(v, Literal) else values[v]

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        try:
            is_complex = _check_and_return_is_complex(eqn)
            control_rule = CONTROL_FLOW_RULES.get(name)
            eqn_builder = ComplexBuilder(builder) if is_complex and control_rule is None else builder
            outputs = (control_rule or UNROLLING_RULES.get(name) or _refuse_primitive)(
                eqn_builder, eqn, *map(read, eqn.invars)
            )
            results = _round_to_dtype(builder, eqn, outputs if isinstance(outputs, list) else [outputs])
        except NotImplementedError as error:
            raise UnsupportedPrimitive(name, user_source_line(eqn), str(error)) from None
        except UnsupportedPrimitive as inner_error:
            if inner_error.source_line != UNKNOWN_ORIGIN:
                raise
            if isinstance(inner_error, CompilerFault):
                raise CompilerFault(
                    inner_error.error, inner_error.primitive, user_source_line(eqn)
                ) from inner_error.error
            raise UnsupportedPrimitive(
                inner_error.primitive, user_source_line(eqn), inner_error.reason, inner_error.too_large
            ) from None
        except LimitExceededError:
            reason = f"within the size limit: the program exceeds {builder.max_instructions} scalar instructions"
            raise UnsupportedPrimitive(name, user_source_line(eqn), reason, too_large=True) from None
        except LiethermoError:
            raise
        except Exception as error:
            raise CompilerFault(error, name, user_source_line(eqn)) from error
        values.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _refuse_primitive(builder, eqn, *arguments):
    """Raise NotImplementedError: the unrolling rule of a primitive that has none."""
    raise NotImplementedError


def _check_and_return_is_complex(eqn) -> bool:
    """Raise NotImplementedError for an equation that no rule handles; return whether it has complex numbers."""
    if eqn.primitive.name in UNROLLING_RULES:
        for name, value in eqn.params.items():
            if name not in SUPPORTED_PARAMETERS.split() and value is not None:
                raise NotImplementedError(f"with {name}={value}")
    for var in (*eqn.invars, *eqn.outvars):
        dtype = aval_dtype(var.aval)
        if not isinstance(dtype, np.dtype) or dtype.kind not in "fiubc" or dtype in UNSUPPORTED_DTYPES:
            raise NotImplementedError(f"on {var.aval}")
    return any(var.aval.dtype.kind == "c" for var in (*eqn.invars, *eqn.outvars))


UNSUPPORTED_DTYPES = tuple(map(np.dtype, ("float16", "complex64", "uint64")))
"""Types that scalar programs cannot represent."""

MOVE_PRIMITIVES = frozenset(
    "broadcast_in_dim reshape squeeze expand_dims transpose slice concatenate select_n gather".split()
)
"""Primitives that compute nothing: their entries were rounded or wrapped where they were computed."""


def _round_to_dtype(builder: ProgramBuilder, eqn, results: list[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an operation rounded to their data types: float32 rounded, integers wrapped around."""
    name, rounded_results = eqn.primitive.name, []
    for var, result in zip(eqn.outvars, results, strict=True):
        dtype = var.aval.dtype
        if not isinstance(result, np.ndarray):  # NumPy replaces a 0-d object array by its entry
            result = scalar_array([result], ())
        assert result.shape == var.aval.shape, f"{name}: {result.shape} is not {var.aval.shape}"
        if name not in MOVE_PRIMITIVES and name not in CONTROL_FLOW_RULES:
            if dtype == np.float32:
                result = map_elementwise(lambda a: builder.op("single", a), result)
            elif (
                dtype.kind in "iu"
                and dtype != np.int64
                and (name in WRAPPING_PRIMITIVES or name == "convert_element_type")
            ):
                bits, is_signed = 8 * dtype.itemsize, dtype.kind == "i"
                if name in WRAPPING_PRIMITIVES or eqn.invars[0].aval.dtype.kind in "iu":
                    result = map_elementwise(lambda a, n=bits, s=is_signed: builder.op("wrap", a, n, s), result)
            if dtype.kind == "i":
                limits, constants = np.iinfo(dtype), [a for a in result.flat if type(a) is not str]
                if not all(limits.min <= a <= limits.max for a in constants):
                    raise NotImplementedError(f"beyond the range of {dtype}")
        rounded_results.append(result)
    return rounded_results


WRAPPING_PRIMITIVES = frozenset(
    "add sub mul neg abs add_any integer_pow square div rem dot_general conv_general_dilated reduce_sum reduce_prod "
    "cumsum cumprod".split()
) | {"scatter-add", "scatter-sub", "scatter-mul"}
"""Primitives whose integer results may exceed the range of their type."""


# -- primitives that contain jaxprs -----------------------------------------------------------------------------------


def _unroll_call_equation(builder, eqn, *arguments):
    """Unroll an equation that calls a jaxpr; calls of one jaxpr with equal arguments are unrolled once."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    jaxpr = inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner
    entries = tuple(a if type(a) is str else repr(a) for a in flatten_scalars(arguments))
    entry = builder.call_results.get((id(jaxpr), entries))
    if entry is None:  # the entry holds the jaxpr, so that no other object takes its id
        entry = builder.call_results[id(jaxpr), entries] = jaxpr, _unroll_call(builder, inner, arguments)
    return list(entry[1])


def _unroll_call(builder, inner, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Unroll a jaxpr that an equation calls, as a routine if it has products of matrices; return its outputs."""
    if not isinstance(inner, ClosedJaxpr):
        return _unroll_jaxpr(builder, inner, (), arguments)
    if has_large_matrix_products(inner.jaxpr):
        return call_routine_or_unroll(builder, _unroll_jaxpr, inner, arguments)
    return _unroll_jaxpr(builder, inner.jaxpr, inner.consts, arguments)


def _unroll_divided_difference_chain(builder, eqn, *arguments):
    """Unroll a chain of divided differences of a matrix function, by routines that all chains share."""
    (out_aval,), rank = (var.aval for var in eqn.outvars), arguments[0].ndim - 2
    function, slots = eqn.params["function"], eqn.params["slots"]
    avals = [jax.ShapeDtypeStruct(var.aval.shape[rank:], var.aval.dtype) for var in eqn.invars]
    n_matrices, result = len(arguments) - len(slots), np.empty(out_aval.shape, object)
    for index in np.ndindex(*out_aval.shape[:rank]):
        operands = [x[tuple(i if n > 1 else 0 for i, n in zip(index, x.shape, strict=False))] for x in arguments]
        decompositions: list[np.ndarray] = []
        decomposition_avals: list = []
        # equal matrices are decomposed once, because equal calls merge
        for x, aval in zip(operands[:n_matrices], avals, strict=False):
            closed_jaxpr = _cached_jaxpr(_decompose_matrix, function, aval)
            decompositions += call_routine_or_unroll(builder, _unroll_jaxpr, closed_jaxpr, [x])
            decomposition_avals += closed_jaxpr.out_avals
        closed_jaxpr = _cached_jaxpr(
            _divided_differences_from_decompositions,
            (function, slots, len(decompositions) // n_matrices),
            *decomposition_avals,
            *avals[n_matrices:],
        )
        (result[index],) = call_routine_or_unroll(
            builder, _unroll_jaxpr, closed_jaxpr, [*decompositions, *operands[n_matrices:]]
        )
    return result


def _decompose_matrix(matrix_function: chains.MatrixFunction, matrix):
    """Return the arrays that decompose a matrix, from which divided differences of a matrix function are computed."""
    return matrix_function.decompose(matrix, unrolled=True)


def _divided_differences_from_decompositions(
    function_slots_and_count: tuple[chains.MatrixFunction, tuple[int, ...], int], *arguments
):
    """Return a chain of divided differences of a matrix function.

    The arguments are the arrays of the decompositions of its matrices, then the operands of the chain.
    """
    function, slots, n_arrays = function_slots_and_count
    end = len(arguments) - len(slots)
    decompositions = [arguments[i : i + n_arrays] for i in range(0, end, n_arrays)]
    return (function.chain(decompositions, slots, arguments[end], arguments[end + 1 :], unrolled=True),)


@functools.lru_cache(maxsize=256)
def _cached_jaxpr(function, static_argument, *avals) -> ClosedJaxpr:
    """Return the jaxpr of a function with a static argument; equal functions share one cached jaxpr and routine."""
    return jax.make_jaxpr(functools.partial(function, static_argument))(*avals)


def _unroll_linear_solve(builder, eqn, *arguments):
    """Unroll ``custom_linear_solve`` by its jaxpr ``solve``; its other jaxprs serve derivatives, already taken."""
    lengths, solve = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
    solve_start = lengths.matvec + lengths.vecmat
    return _unroll_jaxpr(
        builder,
        solve.jaxpr,
        solve.consts,
        [*arguments[solve_start : solve_start + lengths.solve], *arguments[sum(lengths) :]],
    )


def _unroll_cond(builder, eqn, branch_index, *arguments):
    """Unroll every branch of a ``cond`` (they are pure functions), and return the results of the selected one."""
    avals = [var.aval for var in eqn.outvars]
    branches = eqn.params["branches"]
    branch_index = branch_index.item()
    if type(branch_index) is not str:
        branches = (branches[min(max(branch_index, 0), len(branches) - 1)],)
    *other_results, result = (_unroll_jaxpr(builder, branch.jaxpr, branch.consts, arguments) for branch in branches)
    for i in reversed(range(len(other_results))):
        is_branch = builder.op("le", branch_index, i)
        result = unflatten_scalars(
            iter(builder.select_side(is_branch, flatten_scalars(other_results[i]), flatten_scalars(result))), avals
        )
    return result


class _LoopScope(EnclosingScope):
    """The scope of a loop body: the outer scalars that the body reads are its first input."""

    def import_arrays(self, arrays: Sequence[np.ndarray], avals: Sequence) -> list[np.ndarray]:
        """Return arrays of values from outside the loop, as symbols by which its body refers to them."""
        return unflatten_scalars(
            (self.import_scalar(a) if type(a) is str else a for a in flatten_scalars(arrays)), avals
        )

    def unroll_body(
        self, closed_jaxpr: ClosedJaxpr, arguments: Sequence[np.ndarray]
    ) -> tuple[ProgramBuilder, list[np.ndarray]]:
        """Unroll the body of the loop once; return the builder that holds its instructions, and its results."""
        body_builder = ProgramBuilder(self.builder.max_instructions, self)
        return body_builder, _unroll_jaxpr(body_builder, closed_jaxpr.jaxpr, closed_jaxpr.consts, arguments)

    def outer_scalars_read(self, builders: Sequence[ProgramBuilder], results: Sequence[Scalar]) -> dict[Scalar, str]:
        """Return the inner names of the outer scalars that the instructions of a loop body read, by outer scalar."""
        names = {*results, *(a for builder in builders for i in builder.instructions for a in i.args)}
        return {a: name for a, name in self.inner_names.items() if name in names}


class _LoopCarry:
    """The carry of a loop: entries that start as constants stay constants until a pass of the loop changes them."""

    def __init__(self, start: Sequence[np.ndarray], avals: Sequence):
        self.avals, self.start = avals, flatten_scalars(start)
        self.entries: list[Scalar] = [f"x1_{i}" if type(a) is str else a for i, a in enumerate(self.start)]

    @property
    def arrays(self) -> list[np.ndarray]:
        """Arrays of scalars of the carry."""
        return unflatten_scalars(iter(self.entries), self.avals)

    def release_constants_and_return_kinds(self, results: Sequence[np.ndarray]) -> str:
        """Turn constants of the carry that a pass changes into variables; return their kinds, "" if there are none."""
        changed_indices = [
            i
            for i, (a, new) in enumerate(zip(self.entries, flatten_scalars(results), strict=True))
            if type(a) is not str and (type(new) is str or repr(new) != repr(a))
        ]
        for i in changed_indices:
            self.entries[i] = f"x1_{i}"
        entry_kinds = real_scalar_kinds(self.avals)
        return "".join(entry_kinds[i] for i in changed_indices)

    @property
    def variable_indices(self) -> list[int]:
        """Indices of the entries that are not constant."""
        return [i for i, a in enumerate(self.entries) if type(a) is str]

    @property
    def variable_kinds(self) -> tuple[str, ...]:
        """Kinds of the entries that are not constant."""
        entry_kinds = real_scalar_kinds(self.avals)
        return tuple(entry_kinds[i] for i in self.variable_indices)

    def final_arrays(self, final_values: Sequence[Scalar]) -> list[np.ndarray]:
        """Return the final carry, from the final values of its variable entries."""
        entries = list(self.entries)
        for i, a in zip(self.variable_indices, final_values, strict=True):
            entries[i] = a
        return unflatten_scalars(iter(entries), self.avals)


def _unroll_while_loop(builder, eqn, *arguments):
    """Write a ``while`` loop as one block of the program; return its final carry as arrays of scalars."""
    params, avals = eqn.params, [var.aval for var in eqn.invars]
    n_test_constants, carry_start = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    scope, carry = _LoopScope(builder), _LoopCarry(arguments[carry_start:], avals[carry_start:])
    test_constants = scope.import_arrays(arguments[:n_test_constants], avals[:n_test_constants])
    body_constants = scope.import_arrays(arguments[n_test_constants:carry_start], avals[n_test_constants:carry_start])
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    while True:
        test_builder, (test_values,) = scope.unroll_body(test, [*test_constants, *carry.arrays])
        body_builder, results = scope.unroll_body(body, [*body_constants, *carry.arrays])
        if test_values.shape:  # a batch of loops: finished lanes keep their values
            (lane_tests,) = _unroll_jaxpr(body_builder, test.jaxpr, test.consts, [*test_constants, *carry.arrays])
            results = [
                map_elementwise(
                    (ComplexBuilder(body_builder) if aval.dtype.kind == "c" else body_builder).select,
                    np.broadcast_to(_append_unit_axes(lane_tests, x.ndim), x.shape),
                    x,
                    old,
                )
                for x, old, aval in zip(results, carry.arrays, carry.avals, strict=True)
            ]
        if not carry.release_constants_and_return_kinds(results):
            break
    is_running: Scalar = False
    for lane_test in test_values.ravel().tolist():
        is_running = test_builder.op("or", is_running, lane_test)
    if is_running is False:
        return list(arguments[carry_start:])
    next_carry = flatten_scalars(results)
    variables = scope.outer_scalars_read((test_builder, body_builder), [is_running, *next_carry])
    inputs = [variables.values(), [carry.entries[i] for i in carry.variable_indices]]
    loop = WhileLoop(
        _collect_program(test_builder, inputs, [[is_running]], [()]),
        _collect_program(
            body_builder, inputs, [[next_carry[i] for i in carry.variable_indices]], [(len(carry.variable_indices),)]
        ).regroup_constant_factors([1]),
        carry.variable_kinds,
    )
    return carry.final_arrays(builder.emit_block(loop, *variables, *(carry.start[i] for i in carry.variable_indices)))


def _append_unit_axes(array: np.ndarray, ndim: int) -> np.ndarray:
    """Return an array with axes of length one appended, so that it has ``ndim`` axes."""
    return array.reshape(*array.shape, *[1] * (ndim - array.ndim))


MAX_SHORT_LOOP_PASSES = 32
"""Largest number of passes of a loop that is unrolled although it has many instructions."""

MAX_UNROLLED_INSTRUCTIONS = 50_000
"""Largest number of instructions to which a short loop with different passes is unrolled.

Constants of single passes, such as zeros, make the unrolled code faster. Passes that count nothing and read no table
are equal, so unrolling them gains nothing: they stay a loop above :data:`.routines.MIN_ROUTINE_INSTRUCTIONS`, as a long
loop does.
"""


def _unroll_scan(builder, eqn, *arguments):
    """Unroll a ``scan``, or write it as one block if it is long; return its results as arrays of scalars."""
    params = eqn.params
    inner, n_consts, carry_end = params["jaxpr"], params["num_consts"], params["num_consts"] + params["num_carry"]
    if params["length"] > 2:
        loop_results = _emit_scan_loop_if_long(
            builder, eqn, arguments[:n_consts], arguments[n_consts:carry_end], arguments[carry_end:]
        )
        if loop_results is not None:
            return loop_results
    carry, tables = list(arguments[n_consts:carry_end]), arguments[carry_end:]
    rows = range(params["length"])
    row_outputs = []
    for i in reversed(rows) if params["reverse"] else rows:
        results = _unroll_jaxpr(
            builder, inner.jaxpr, inner.consts, [*arguments[:n_consts], *carry, *(x[i, ...] for x in tables)]
        )
        carry = results[: len(carry)]
        row_outputs.append(results[len(carry) :])
    if params["reverse"]:
        row_outputs.reverse()
    stacked_outputs = [
        scalar_array([a for row in row_outputs for a in row[k].ravel().tolist()], var.aval.shape)
        for k, var in enumerate(eqn.outvars[len(carry) :])
    ]
    return carry + stacked_outputs


def _emit_scan_loop_if_long(builder, eqn, constants, carry_start, row_tables) -> list[np.ndarray] | None:
    """Emit a ``scan`` as one loop block and return its results; None if it is short enough to be unrolled."""
    length, closed_jaxpr, avals = eqn.params["length"], eqn.params["jaxpr"], [var.aval for var in eqn.invars]
    n_consts, carry_end = len(constants), len(constants) + len(carry_start)
    scope, carry = _LoopScope(builder), _LoopCarry(carry_start, avals[n_consts:carry_end])
    loop_constants = scope.import_arrays(constants, avals[:n_consts])
    row_avals = [aval.update(shape=aval.shape[1:]) for aval in avals[carry_end:]]
    columns = list(zip(*(flatten_scalars([x[i, ...] for x in row_tables]) for i in range(length)), strict=True))
    names = [f"x2_{j}" for j in range(len(columns))]
    row = unflatten_scalars(iter(names), row_avals)
    passes_agree = not columns
    while True:
        pass_builder, results = scope.unroll_body(closed_jaxpr, [*loop_constants, *carry.arrays, *row])
        if not (changed_kinds := carry.release_constants_and_return_kinds(results[: len(carry_start)])):
            break
        passes_agree = passes_agree and "i" not in changed_kinds
    if passes_agree or length > MAX_SHORT_LOOP_PASSES:
        if len(pass_builder.instructions) * length <= MIN_ROUTINE_INSTRUCTIONS:
            return None
    else:  # the constants of the middle pass, such as its index, show how long unrolled passes are
        middle_row = (column[length // 2] for column in columns)
        known_row = (name if type(a) is str else a for name, a in zip(names, middle_row, strict=True))
        middle_builder, _ = scope.unroll_body(
            closed_jaxpr, [*loop_constants, *carry.arrays, *unflatten_scalars(known_row, row_avals)]
        )
        if len(middle_builder.instructions) * length <= MAX_UNROLLED_INSTRUCTIONS:
            return None
    variable_indices, next_carry, row_results = (
        carry.variable_indices,
        flatten_scalars(results[: len(carry_start)]),
        flatten_scalars(results[len(carry_start) :]),
    )
    variables = scope.outer_scalars_read([pass_builder], [*next_carry, *row_results])
    inputs = [variables.values(), [carry.entries[i] for i in variable_indices], names]
    body = _collect_program(
        pass_builder,
        inputs,
        [[next_carry[i] for i in variable_indices], row_results],
        [(len(variable_indices),), (len(row_results),)],
    )
    row_output_avals = [var.aval for var in closed_jaxpr.jaxpr.outvars[len(carry_start) :]]
    loop = ScanLoop(length, eqn.params["reverse"], body, carry.variable_kinds, real_scalar_kinds(row_output_avals))
    tables = [builder.make_table(column) for column in columns]
    loop_results = builder.emit_block(loop, *variables, *(carry.start[i] for i in variable_indices), *tables)
    stacked_entries = loop_results[len(variable_indices) :]
    row_arrays = [
        unflatten_scalars((stacked_entries[j * length + i] for j in range(len(row_results))), row_output_avals)
        for i in range(length)
    ]
    stacked_outputs = [
        scalar_array([a for row in row_arrays for a in row[k].ravel().tolist()], var.aval.shape)
        for k, var in enumerate(eqn.outvars[len(carry_start) :])
    ]
    return carry.final_arrays(loop_results[: len(variable_indices)]) + stacked_outputs


def _unroll_scatter(builder, eqn, x, indices, updates):
    """Unroll ``scatter``, which replaces entries by updates or by a function of the entries (``x.at[i].apply``)."""
    entry_builder = ComplexBuilder(builder) if eqn.invars[0].aval.dtype.kind == "c" else builder
    jaxpr, consts = eqn.params["update_jaxpr"], eqn.params["update_consts"]
    if jaxpr is None:
        return indexing.scatter(entry_builder, eqn, x, indices, updates, lambda old_entry, update: update)

    def combine(old_entry, update):
        return _unroll_jaxpr(builder, jaxpr, consts, [scalar_array([old_entry], ()), scalar_array([update], ())])[
            0
        ].item()

    return indexing.scatter(entry_builder, eqn, x, indices, updates, combine)


CONTROL_FLOW_RULES = {
    **dict.fromkeys(CALL_PRIMITIVES, _unroll_call_equation),
    "custom_linear_solve": _unroll_linear_solve,
    chains.chain_p.name: _unroll_divided_difference_chain,
    "cond": _unroll_cond,
    "scan": _unroll_scan,
    "scatter": _unroll_scatter,
    "while": _unroll_while_loop,
}
