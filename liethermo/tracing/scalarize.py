"""From a traced JAX function of small arrays to a program of scalar instructions, calls and loops.

The jaxpr, derivatives included, is unrolled entry by entry. What is known at compile time is computed then, structural
zeros vanish, equal subexpressions merge and dead ones are dropped, so an ``einsum`` with structure constants becomes
the few products that it stands for. Loops whose length is not known, or that are long, stay loops, and the linear
algebra of larger matrices is called. Complex numbers are pairs. The result is the same to rounding as JAX's, or there
is none.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from manifolds.matrices import chains

from ..errors import InputError, LiethermoError
from . import indexing
from .builder import Builder, EnclosingScope, LimitExceededError, Scalar, constant_array, elementwise, scalar_array
from .complex_numbers import ComplexBuilder, flatten_scalars, scalar_kinds, unflatten_scalars
from .primitives import SUPPORTED_PARAMETERS, UNROLLING_RULES
from .program import Program, ScanLoop, WhileLoop, eliminate_dead_code
from .routines import MIN_ROUTINE_INSTRUCTIONS, call_as_routine, has_matrix_products

MAX_INSTRUCTIONS = 200_000
"""Instructions that a program may have: far more than compile in reasonable time."""

UNKNOWN_ORIGIN = "of unknown origin"

PACKAGE_FOLDERS = Path(__file__).parents[1], Path(chains.__file__).parents[1]
"""Folders of both packages, whose lines are none of the user's."""


class UnsupportedPrimitive(LiethermoError):
    """A function that cannot be unrolled.

    Attributes
    ----------
    primitive : str
        The JAX primitive in the way.
    source_line : str
        The line of the user's code that called for it, as far as JAX knows.
    reason : str
        What about it is not supported, where it is not the primitive as such.
    too_large : bool
        Whether the program is only too long to be unrolled.
    """

    def __init__(self, primitive: str, source_line: str, reason: str = "", too_large: bool = False):
        self.primitive, self.source_line, self.reason, self.too_large = primitive, source_line, reason, too_large
        refusal = f"the compiled engine cannot run the JAX primitive {primitive!r} {reason}".rstrip()
        super().__init__(f"{refusal} ({source_line})")


class CompilerFault(UnsupportedPrimitive):
    """An unexpected exception inside the compiled engine: a fault of this library.

    It is raised in place of the exception, so that the array engine takes over where it may.

    Attributes
    ----------
    error : Exception
    """

    def __init__(self, error: Exception, primitive: str = "", source_line: str = UNKNOWN_ORIGIN):
        super().__init__(primitive, source_line)
        self.error = error
        place = f" on the JAX primitive {primitive!r} ({source_line})" if primitive else ""
        self.args = (
            f"the compiled engine failed{place}: {type(error).__name__}: {str(error).strip()}. "
            "This is a fault of liethermo, please report it",
        )


@contextlib.contextmanager
def report_compiler_faults() -> Iterator[None]:
    """Raise whatever exception the compiler did not expect as a :class:`CompilerFault`."""
    try:
        yield
    except LiethermoError:
        raise
    except Exception as error:
        raise CompilerFault(error) from error


@report_compiler_faults()
def scalarize(
    closed: ClosedJaxpr, fixed_inputs: Sequence | None = None, max_instructions: int = MAX_INSTRUCTIONS
) -> Program:
    """Unroll a closed jaxpr, as ``jax.make_jaxpr`` gives it, into scalar instructions.

    Parameters
    ----------
    closed : ClosedJaxpr
        Of a function of float64 arrays.
    fixed_inputs : sequence, optional
        For each input array None, or an array of its shape: a number fixes that entry at compile time, NaN leaves it to
        run time. (A parameter matrix that is diagonal may as well be so in the program.)
    max_instructions : int
        Largest number of instructions.

    Raises
    ------
    UnsupportedPrimitive
        Where there is no rule for a primitive, where indices depend on the input, or beyond the limit.
    """
    builder = Builder(max_instructions)
    inputs, arguments = [], []
    for i, var in enumerate(closed.jaxpr.invars):
        if var.aval.dtype != np.float64:
            raise InputError(f"argument {i} of a compiled function must be of float64, not of {var.aval.dtype}")
        names = [f"x{i}_{j}" for j in range(math.prod(var.aval.shape))]
        fixed = (
            None if fixed_inputs is None or fixed_inputs[i] is None else np.asarray(fixed_inputs[i], dtype=np.float64)
        )
        entries = (
            names if fixed is None else [n if v != v else v for n, v in zip(names, fixed.ravel().tolist(), strict=True)]
        )
        inputs.append(tuple(names))
        arguments.append(scalar_array(entries, var.aval.shape))
    results = _unroll_jaxpr(builder, closed.jaxpr, closed.consts, arguments)
    outputs = [x.ravel().tolist() for x in results]
    return _collect_program(builder, inputs, outputs, [x.shape for x in results])


def _collect_program(b: Builder, inputs: Sequence, outputs: Sequence[Sequence[Scalar]], shapes: Sequence) -> Program:
    """What a builder has collected, as far as the outputs depend on it."""
    instructions, renamed = eliminate_dead_code(b.instructions, [a for entries in outputs for a in entries])
    return Program(
        tuple(map(tuple, inputs)),
        instructions,
        tuple(tuple(renamed.get(a, a) if type(a) is str else a for a in entries) for entries in outputs),
        tuple(shapes),
    )


def _unroll_jaxpr(b: Builder, jaxpr, consts, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The outputs of a jaxpr as arrays of scalars."""
    values = dict(zip(jaxpr.constvars, map(constant_array, consts), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(v) -> np.ndarray:
        return constant_array(v.val, getattr(v.aval, "dtype", None)) if isinstance(v, Literal) else values[v]

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        try:
            is_complex = _check_equation(eqn)
            control = CONTROL_FLOW_RULES.get(name)
            own = ComplexBuilder(b) if is_complex and control is None else b
            found = (control or UNROLLING_RULES.get(name) or _refuse_primitive)(own, eqn, *map(read, eqn.invars))
            results = _round_to_dtype(b, eqn, found if isinstance(found, list) else [found])
        except NotImplementedError as error:
            raise UnsupportedPrimitive(name, user_source_line(eqn), str(error)) from None
        except UnsupportedPrimitive as inside:
            if inside.source_line != UNKNOWN_ORIGIN:
                raise
            if isinstance(inside, CompilerFault):
                raise CompilerFault(inside.error, inside.primitive, user_source_line(eqn)) from inside.error
            raise UnsupportedPrimitive(
                inside.primitive, user_source_line(eqn), inside.reason, inside.too_large
            ) from None
        except LimitExceededError:
            reason = f"within the size limit: the program exceeds {b.max_instructions} scalar instructions"
            raise UnsupportedPrimitive(name, user_source_line(eqn), reason, too_large=True) from None
        except LiethermoError:
            raise
        except Exception as error:
            raise CompilerFault(error, name, user_source_line(eqn)) from error
        values.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _refuse_primitive(b, eqn, *arguments):
    raise NotImplementedError


def _check_equation(eqn) -> bool:
    """Refuse what the rules were not written for; whether complex numbers are in it."""
    if eqn.primitive.name in UNROLLING_RULES:
        for name, value in eqn.params.items():
            if name not in SUPPORTED_PARAMETERS.split() and value is not None:
                raise NotImplementedError(f"with {name}={value}")
    for var in (*eqn.invars, *eqn.outvars):
        dtype = getattr(var.aval, "dtype", None)
        if getattr(dtype, "kind", None) not in ("f", "i", "u", "b", "c") or dtype in UNSUPPORTED_DTYPES:
            raise NotImplementedError(f"on {var.aval}")
    return any(var.aval.dtype.kind == "c" for var in (*eqn.invars, *eqn.outvars))


UNSUPPORTED_DTYPES = tuple(map(np.dtype, ("float16", "complex64", "uint64")))

MOVE_PRIMITIVES = frozenset(
    "broadcast_in_dim reshape squeeze expand_dims transpose slice concatenate select_n gather".split()
)
"""Primitives that compute nothing: what they move was rounded, or wrapped around, where it was made."""


def _round_to_dtype(b: Builder, eqn, results: list[np.ndarray]) -> list[np.ndarray]:
    """The results as their types hold them: numbers of single precision rounded, integers wrapped around."""
    name, kept = eqn.primitive.name, []
    for var, result in zip(eqn.outvars, results, strict=True):
        dtype = var.aval.dtype
        if not isinstance(result, np.ndarray):  # NumPy makes of an array without axes its entry
            result = scalar_array([result], ())
        assert result.shape == var.aval.shape, f"{name}: {result.shape} is not {var.aval.shape}"
        if name not in MOVE_PRIMITIVES and name not in CONTROL_FLOW_RULES:
            if dtype == np.float32:
                result = elementwise(lambda a: b.op("single", a), result)
            elif (
                dtype.kind in "iu"
                and dtype != np.int64
                and (name in WRAPPING_PRIMITIVES or name == "convert_element_type")
            ):
                bits, signed = 8 * dtype.itemsize, dtype.kind == "i"
                if name in WRAPPING_PRIMITIVES or eqn.invars[0].aval.dtype.kind in "iu":
                    result = elementwise(lambda a, n=bits, s=signed: b.op("wrap", a, n, s), result)
            if dtype.kind == "i":
                limits, numbers = np.iinfo(dtype), [a for a in result.flat if type(a) is not str]
                if not all(limits.min <= a <= limits.max for a in numbers):
                    raise NotImplementedError(f"beyond the range of {dtype}")
        kept.append(result)
    return kept


WRAPPING_PRIMITIVES = frozenset(
    "add sub mul neg abs add_any integer_pow square div rem dot_general conv_general_dilated reduce_sum reduce_prod "
    "cumsum cumprod".split()
) | {"scatter-add", "scatter-sub", "scatter-mul"}
"""Primitives whose results may not fit the type of integers that they are of."""


# -- primitives that contain jaxprs -----------------------------------------------------------------------------------


def _call(b, eqn, *arguments):
    """A function called, once for the same arguments."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    jaxpr = inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner
    entries = tuple(a if type(a) is str else repr(a) for a in flatten_scalars(arguments))
    known = b.call_results.get((id(jaxpr), entries))
    if known is None:  # with the jaxpr, so that no other takes its place
        known = b.call_results[id(jaxpr), entries] = jaxpr, _unroll_call(b, inner, arguments)
    return list(known[1])


def _unroll_call(b, inner, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    if not isinstance(inner, ClosedJaxpr):
        return _unroll_jaxpr(b, inner, (), arguments)
    if has_matrix_products(inner.jaxpr):
        return call_as_routine(b, _unroll_jaxpr, inner, arguments)
    return _unroll_jaxpr(b, inner.jaxpr, inner.consts, arguments)


def _matrix_function_chain(b, eqn, *arguments):
    """Functions of matrices, whose derivatives have been taken: at one place after another, by the same routines."""
    (out,), rank = (var.aval for var in eqn.outvars), arguments[0].ndim - 2
    function, slots = eqn.params["function"], eqn.params["slots"]
    avals = [jax.ShapeDtypeStruct(var.aval.shape[rank:], var.aval.dtype) for var in eqn.invars]
    count, result = len(arguments) - len(slots), np.empty(out.shape, object)
    for place in np.ndindex(*out.shape[:rank]):
        own = [x[tuple(i if n > 1 else 0 for i, n in zip(place, x.shape, strict=False))] for x in arguments]
        given: list[np.ndarray] = []
        kinds_given: list = []
        for x, aval in zip(own[:count], avals, strict=False):  # of equal matrices once, since what is equal merges
            closed = _traced_jaxpr(_prepare_chain_matrix, function, aval)
            given += call_as_routine(b, _unroll_jaxpr, closed, [x])
            kinds_given += closed.out_avals
        closed = _traced_jaxpr(_apply_chain, (function, slots, len(given) // count), *kinds_given, *avals[count:])
        (result[place],) = call_as_routine(b, _unroll_jaxpr, closed, [*given, *own[count:]])
    return result


def _prepare_chain_matrix(function: chains.MatrixFunction, a):
    """What is prepared of a matrix for chains of a function."""
    return function.decompose(a, unrolled=True)


def _apply_chain(chain: tuple[chains.MatrixFunction, tuple[int, ...], int], *arguments):
    """A chain of a function at some slots, from what is prepared of its matrices: so many arrays each."""
    function, slots, each = chain
    end = len(arguments) - len(slots)
    prepared = [arguments[i : i + each] for i in range(0, end, each)]
    return (function.chain(prepared, slots, arguments[end], arguments[end + 1 :], unrolled=True),)


@functools.lru_cache(maxsize=256)
def _traced_jaxpr(function, first, *avals) -> ClosedJaxpr:
    """One object for equal functions, which have one routine."""
    return jax.make_jaxpr(functools.partial(function, first))(*avals)


def _linear_solve(b, eqn, *arguments):
    """The user's way of solving; the matrix is only there for derivatives, and they have been taken."""
    sizes, solve = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
    start = sizes.matvec + sizes.vecmat
    return _unroll_jaxpr(
        b, solve.jaxpr, solve.consts, [*arguments[start : start + sizes.solve], *arguments[sum(sizes) :]]
    )


def _cond(b, eqn, index, *arguments):
    """Every branch, then a choice of results: the branches are pure."""
    avals = [var.aval for var in eqn.outvars]
    branches = eqn.params["branches"]
    which = index.item()
    if type(which) is not str:
        branches = (branches[min(max(which, 0), len(branches) - 1)],)
    *others, chosen = (_unroll_jaxpr(b, branch.jaxpr, branch.consts, arguments) for branch in branches)
    for i in reversed(range(len(others))):
        first = b.op("le", which, i)
        chosen = unflatten_scalars(iter(b.branch(first, flatten_scalars(others[i]), flatten_scalars(chosen))), avals)
    return chosen


class _LoopScope(EnclosingScope):
    """A program inside a loop, while it is made: the scalars around it that it reads are its first input."""

    def import_arrays(self, arrays: Sequence[np.ndarray], avals: Sequence) -> list[np.ndarray]:
        """Arrays as they are known inside."""
        return unflatten_scalars(
            (self.import_scalar(a) if type(a) is str else a for a in flatten_scalars(arrays)), avals
        )

    def unroll_body(self, closed: ClosedJaxpr, arguments: Sequence[np.ndarray]) -> tuple[Builder, list[np.ndarray]]:
        own = Builder(self.builder.max_instructions, self)
        return own, _unroll_jaxpr(own, closed.jaxpr, closed.consts, arguments)

    def variables_read(self, builders: Sequence[Builder], results: Sequence[Scalar]) -> dict[Scalar, str]:
        """What these programs with these results read: other passes have asked for more."""
        names = {*results, *(a for b in builders for i in b.instructions for a in i.args)}
        return {a: name for a, name in self.inner_names.items() if name in names}


class _LoopCarry:
    """What a loop carries. What begins as a number is taken to stay it, until a pass of the loop says otherwise."""

    def __init__(self, start: Sequence[np.ndarray], avals: Sequence):
        self.avals, self.start = avals, flatten_scalars(start)
        self.entries: list[Scalar] = [f"x1_{i}" if type(a) is str else a for i, a in enumerate(self.start)]

    @property
    def arrays(self) -> list[np.ndarray]:
        return unflatten_scalars(iter(self.entries), self.avals)

    def release_changed(self, results: Sequence[np.ndarray]) -> str:
        """Let go of what a pass has changed; the kinds of that, nothing where there was none."""
        changed = [
            i
            for i, (a, new) in enumerate(zip(self.entries, flatten_scalars(results), strict=True))
            if type(a) is not str and (type(new) is str or repr(new) != repr(a))
        ]
        for i in changed:
            self.entries[i] = f"x1_{i}"
        found = scalar_kinds(self.avals)
        return "".join(found[i] for i in changed)

    @property
    def variable_indices(self) -> list[int]:
        return [i for i, a in enumerate(self.entries) if type(a) is str]

    @property
    def kinds(self) -> tuple[str, ...]:
        found = scalar_kinds(self.avals)
        return tuple(found[i] for i in self.variable_indices)

    def final_arrays(self, found: Sequence[Scalar]) -> list[np.ndarray]:
        """What is carried at the end, where those that move are found to be this."""
        whole = list(self.entries)
        for i, a in zip(self.variable_indices, found, strict=True):
            whole[i] = a
        return unflatten_scalars(iter(whole), self.avals)


def _while_loop(b, eqn, *arguments):
    """A loop of unknown length."""
    params, avals = eqn.params, [var.aval for var in eqn.invars]
    n, m = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    inside, carried = _LoopScope(b), _LoopCarry(arguments[m:], avals[m:])
    for_test = inside.import_arrays(arguments[:n], avals[:n])
    for_body = inside.import_arrays(arguments[n:m], avals[n:m])
    test, step = params["cond_jaxpr"], params["body_jaxpr"]
    while True:
        testing, (going,) = inside.unroll_body(test, [*for_test, *carried.arrays])
        making, results = inside.unroll_body(step, [*for_body, *carried.arrays])
        if going.shape:  # several loops beside each other: those that have ended wait
            (own,) = _unroll_jaxpr(making, test.jaxpr, test.consts, [*for_test, *carried.arrays])
            results = [
                elementwise(
                    (ComplexBuilder(making) if aval.dtype.kind == "c" else making).select,
                    np.broadcast_to(_expand_trailing_axes(own, x.ndim), x.shape),
                    x,
                    old,
                )
                for x, old, aval in zip(results, carried.arrays, carried.avals, strict=True)
            ]
        if not carried.release_changed(results):
            break
    goes_on: Scalar = False
    for one in going.ravel().tolist():
        goes_on = testing.op("or", goes_on, one)
    if goes_on is False:
        return list(arguments[m:])
    new = flatten_scalars(results)
    read = inside.variables_read((testing, making), [goes_on, *new])
    inputs = [read.values(), [carried.entries[i] for i in carried.variable_indices]]
    loop = WhileLoop(
        _collect_program(testing, inputs, [[goes_on]], [()]),
        _collect_program(
            making, inputs, [[new[i] for i in carried.variable_indices]], [(len(carried.variable_indices),)]
        ).factor_constants([1]),
        carried.kinds,
    )
    return carried.final_arrays(b.emit_block(loop, *read, *(carried.start[i] for i in carried.variable_indices)))


def _expand_trailing_axes(tests: np.ndarray, ndim: int) -> np.ndarray:
    """Tests along the first axes of an array with more."""
    return tests.reshape(*tests.shape, *[1] * (ndim - tests.ndim))


MAX_SHORT_LOOP_PASSES, MAX_UNROLLED_INSTRUCTIONS = 32, 50_000
"""Passes up to which a loop is short, and instructions, unrolled, from which a short one stays a loop if its passes
differ; others do from LONG on. What is known of single ones, such as zeros, makes unrolled code the faster one. Passes
that count nothing and read no table are alike, and unrolling them gains nothing."""


def _scan(b, eqn, *arguments):
    """A loop of known length: unrolled, or kept where it is long."""
    params = eqn.params
    inner, consts, carried = params["jaxpr"], params["num_consts"], params["num_consts"] + params["num_carry"]
    if params["length"] > 2:
        kept = _scan_as_loop(b, eqn, arguments[:consts], arguments[consts:carried], arguments[carried:])
        if kept is not None:
            return kept
    carry, slices = list(arguments[consts:carried]), arguments[carried:]
    rows = range(params["length"])
    gathered = []
    for i in reversed(rows) if params["reverse"] else rows:
        results = _unroll_jaxpr(
            b, inner.jaxpr, inner.consts, [*arguments[:consts], *carry, *(x[i, ...] for x in slices)]
        )
        carry = results[: len(carry)]
        gathered.append(results[len(carry) :])
    if params["reverse"]:
        gathered.reverse()
    stacked = [
        scalar_array([a for row in gathered for a in row[k].ravel().tolist()], var.aval.shape)
        for k, var in enumerate(eqn.outvars[len(carry) :])
    ]
    return carry + stacked


def _scan_as_loop(b, eqn, constants, start, slices) -> list[np.ndarray] | None:
    """The results of a loop that stays one; None where it is short enough to be unrolled."""
    length, closed, avals = eqn.params["length"], eqn.params["jaxpr"], [var.aval for var in eqn.invars]
    consts, end = len(constants), len(constants) + len(start)
    inside, carried = _LoopScope(b), _LoopCarry(start, avals[consts:end])
    given = inside.import_arrays(constants, avals[:consts])
    rows = [aval.update(shape=aval.shape[1:]) for aval in avals[end:]]
    columns = list(zip(*(flatten_scalars([x[i, ...] for x in slices]) for i in range(length)), strict=True))
    names = [f"x2_{j}" for j in range(len(columns))]
    row = unflatten_scalars(iter(names), rows)
    alike = not columns
    while True:
        own, results = inside.unroll_body(closed, [*given, *carried.arrays, *row])
        if not (changed := carried.release_changed(results[: len(start)])):
            break
        alike = alike and "i" not in changed
    if alike or length > MAX_SHORT_LOOP_PASSES:
        if len(own.instructions) * length <= MIN_ROUTINE_INSTRUCTIONS:
            return None
    else:  # what is known of the pass in the middle, such as its number, says how long unrolled ones are
        middle = (column[length // 2] for column in columns)
        known = (name if type(a) is str else a for name, a in zip(names, middle, strict=True))
        typical, _ = inside.unroll_body(closed, [*given, *carried.arrays, *unflatten_scalars(known, rows)])
        if len(typical.instructions) * length <= MAX_UNROLLED_INSTRUCTIONS:
            return None
    moving, new, made = (
        carried.variable_indices,
        flatten_scalars(results[: len(start)]),
        flatten_scalars(results[len(start) :]),
    )
    read = inside.variables_read([own], [*new, *made])
    inputs = [read.values(), [carried.entries[i] for i in moving], names]
    body = _collect_program(own, inputs, [[new[i] for i in moving], made], [(len(moving),), (len(made),)])
    out = [var.aval for var in closed.jaxpr.outvars[len(start) :]]
    loop = ScanLoop(length, eqn.params["reverse"], body, carried.kinds, scalar_kinds(out))
    tables = [b.table(column) for column in columns]
    found = b.emit_block(loop, *read, *(carried.start[i] for i in moving), *tables)
    rest = found[len(moving) :]
    each = [unflatten_scalars((rest[j * length + i] for j in range(len(made))), out) for i in range(length)]
    stacked = [
        scalar_array([a for row in each for a in row[k].ravel().tolist()], var.aval.shape)
        for k, var in enumerate(eqn.outvars[len(start) :])
    ]
    return carried.final_arrays(found[: len(moving)]) + stacked


def _scatter(b, eqn, x, indices, updates):
    """``scatter``, which replaces entries by updates, or by a function of the entries (``x.at[i].apply``)."""
    own = ComplexBuilder(b) if eqn.invars[0].aval.dtype.kind == "c" else b
    jaxpr, consts = eqn.params["update_jaxpr"], eqn.params["update_consts"]
    if jaxpr is None:
        return indexing.scatter(own, eqn, x, indices, updates, lambda old, new: new)

    def combine(old, new):
        return _unroll_jaxpr(b, jaxpr, consts, [scalar_array([old], ()), scalar_array([new], ())])[0].item()

    return indexing.scatter(own, eqn, x, indices, updates, combine)


CALL_PRIMITIVES = "jit pjit call closed_call core_call custom_jvp_call custom_vjp_call checkpoint remat remat2"
CONTROL_FLOW_RULES = {
    **dict.fromkeys(CALL_PRIMITIVES.split(), _call),
    "custom_linear_solve": _linear_solve,
    chains.chain_p.name: _matrix_function_chain,
    "cond": _cond,
    "scan": _scan,
    "scatter": _scatter,
    "while": _while_loop,
}


def user_source_line(eqn) -> str:
    """The innermost line of a user's that led to an equation, in a function or in a call."""
    for frame in getattr(eqn.source_info.traceback, "frames", ()):
        path = Path(frame.file_name)
        if is_user_file(path):
            return f"{path.name}:{frame.line_num}, in {frame.function_name}"
    return UNKNOWN_ORIGIN


def is_user_file(path: Path) -> bool:
    """Whether a file belongs to a user, and not to this library, to JAX or to equinox."""
    return not {"jax", "jaxlib", "equinox"} & set(path.parts) and not any(map(path.is_relative_to, PACKAGE_FOLDERS))
