"""Numbers taken out of a jaxpr: programs that differ in them alone become one, with parameters."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from manifolds._content_keys import content_key
from manifolds.matrices.exponential import expm

MAX_INLINE_NUMBERS = 64
"""Numbers that are no table yet: what they are made from may be shorter."""

CALL_PRIMITIVES = ("jit", "pjit", "closed_call", "core_call")
"""Primitives that call a jaxpr, which takes their place here."""


class ConstantLifter:
    """The numbers of a jaxpr made its first arguments: all literals of double precision but zeros, and all constants.

    Zeros stay, since what vanishes belongs to the operations; so do the exponents that have instructions of their own,
    and numbers that truth values or integers come from.
    """

    def __init__(self):
        self.has_while_loop = False

    def lift_jaxpr(self, closed: ClosedJaxpr) -> tuple[Jaxpr, list, tuple]:
        """The jaxpr, its remaining constants, and the numbers: scalars in one array, then arrays."""
        body = _LiftedBody(self)
        body.append_jaxpr(closed.jaxpr, closed.consts, closed.jaxpr.invars)
        used = {a for eqn in body.equations for a in eqn.invars if type(a) is Var} | {
            a for a in body.outputs if type(a) is Var
        }
        body.numbers = [(v, x) for v, x in body.numbers if v in used]
        scalars = [(v, x) for v, x in body.numbers if isinstance(x, float)]
        arrays = [(v, x) for v, x in body.numbers if not isinstance(x, float)]
        invars = [v for v, _ in (*scalars, *arrays)] + list(closed.jaxpr.invars)
        jaxpr = Jaxpr(
            list(body.constants),
            invars,
            body.outputs,
            body.equations,
            closed.jaxpr.effects,
            _debug_info_without_names(closed.jaxpr),
        )
        with jax.ensure_compile_time_eval():  # numbers, whatever is being traced around
            packed = jnp.asarray(np.array([x for _, x in scalars], dtype=np.float64))
            values = [x if isinstance(x, jax.Array) else jnp.asarray(np.asarray(x)) for _, x in arrays]
        return jaxpr, list(body.constants.values()), (packed, *values)

    def lift_inner_jaxpr(self, closed: ClosedJaxpr) -> tuple[ClosedJaxpr, list[tuple[Var, Any]]]:
        """The jaxpr of a loop or a branch, its numbers in front of its arguments, and those numbers."""
        body = _LiftedBody(self)
        fresh = [Var(v.aval) for v in closed.jaxpr.invars]
        body.append_jaxpr(closed.jaxpr, closed.consts, fresh)
        invars = [v for v, _ in body.numbers] + fresh
        jaxpr = Jaxpr(
            list(body.constants),
            invars,
            body.outputs,
            body.equations,
            closed.jaxpr.effects,
            _debug_info_without_names(closed.jaxpr),
        )
        return ClosedJaxpr(jaxpr, list(body.constants.values())), body.numbers


class _LiftedBody:
    """Equations under construction."""

    def __init__(self, lifting: ConstantLifter):
        self.lifter = lifting
        self.equations: list[JaxprEqn] = []
        self.numbers: list[tuple[Var, Any]] = []
        self.constants: dict[Var, Any] = {}
        self.outputs: list = []
        self._argument_free: dict[
            Var, Any
        ] = {}  # what does not depend on the arguments: a number, or the equation that makes it

    def append_jaxpr(self, jaxpr: Jaxpr, consts: Sequence, arguments: Sequence) -> None:
        env: dict[Var, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
        self.outputs = self._append_equations(jaxpr, consts, env)

    def _append_equations(self, jaxpr: Jaxpr, consts: Sequence, env: dict[Var, Any]) -> list:
        named = [
            (eqn.invars, FORMULA_INPUTS[eqn.primitive.name])
            for eqn in jaxpr.eqns
            if eqn.primitive.name in FORMULA_INPUTS
        ]
        formulas = {inputs[place] for inputs, (place, _) in named if type(inputs[place]) is Var}
        for var, value in zip(jaxpr.constvars, consts, strict=True):
            env[var] = self._lift_or_keep(var, value, var in formulas)

        def read(atom):
            return atom if isinstance(atom, Literal) else env[atom]

        for eqn in jaxpr.eqns:
            inputs = [read(a) for a in eqn.invars]
            if eqn.primitive.name in CALL_PRIMITIVES and isinstance(eqn.params.get("jaxpr"), ClosedJaxpr):
                inner = _expm_substitute(eqn) or eqn.params["jaxpr"]
                found = self._append_equations(
                    inner.jaxpr, inner.consts, dict(zip(inner.jaxpr.invars, inputs, strict=True))
                )
                env.update(zip(eqn.outvars, found, strict=True))
                continue
            fixed = self._constant_outputs(eqn, inputs)
            if fixed is not None:
                for var, value in zip(eqn.outvars, fixed, strict=True):
                    inexact = _is_inexact(var.aval)
                    env[var] = (
                        self._lift_number(value, var.aval) if inexact else self._keep_constant(Var(var.aval), value)
                    )
                continue
            inputs, params = self._lift_equation(eqn, inputs)
            outputs = [type(v)(v.aval) for v in eqn.outvars]
            env.update(zip(eqn.outvars, outputs, strict=True))
            self.equations.append(eqn.replace(invars=inputs, outvars=outputs, params=params))
            if all(isinstance(a, Literal) or a in self._argument_free for a in inputs) and not eqn.effects:
                self._argument_free.update((v, (self.equations[-1], i)) for i, v in enumerate(outputs))
        return [self._lift_number(a.val, a.aval) if _is_liftable_literal(a) else a for a in map(read, jaxpr.outvars)]

    # -- numbers and constants ------------------------------------------------------------------------------------

    def _lift_number(self, value, aval) -> Var:
        var = Var(aval)
        concrete = np.shape(value) == () and not isinstance(value, jax.Array)
        self.numbers.append((var, float(value) if concrete else value))
        self._argument_free[var] = value
        return var

    def _keep_constant(self, var: Var, value) -> Var:
        self.constants[var] = self._argument_free[var] = value
        return var

    def _lift_or_keep(self, var: Var, value, formula: bool):
        if isinstance(value, jax.core.Tracer):
            return self._lift_number(value, var.aval)
        if getattr(var.aval, "dtype", None) == np.float64 and not formula:
            return self._lift_number(value if isinstance(value, jax.Array) else np.asarray(value), var.aval)
        return self._keep_constant(Var(var.aval), value)

    def _lift_equation(self, eqn: JaxprEqn, inputs: list) -> tuple[list, dict]:
        """The inputs and parameters of an equation, its numbers taken out."""
        name, params = eqn.primitive.name, dict(eqn.params)
        more: list = []
        if name == "scan":
            params["jaxpr"], numbers = self.lifter.lift_inner_jaxpr(params["jaxpr"])
            more = self._lift_inner_numbers(numbers)
            params["num_consts"] += len(more)
            inputs = more + self._lift_literals(inputs)
        elif name == "cond":
            params["branches"], inputs = self._lift_branches(params["branches"], inputs)
        elif name == "while":
            self.lifter.has_while_loop = True
            inputs = self._lift_literals(inputs)
        else:
            if not self.lifter.has_while_loop:
                self.lifter.has_while_loop = any(_has_while_loop(p) for p in params.values())
            place = _formula_input_index(name, inputs)
            inputs = [a if i == place else self._lift_literals([a])[0] for i, a in enumerate(inputs)]
        return inputs, params

    def _lift_literals(self, inputs: list) -> list:
        return [self._lift_number(a.val, a.aval) if _is_liftable_literal(a) else a for a in inputs]

    def _lift_inner_numbers(self, numbers: list[tuple[Var, Any]]) -> list[Var]:
        return [self._lift_number(value, var.aval) for var, value in numbers]

    def _lift_branches(self, branches, inputs: list) -> tuple[tuple, list]:
        """Branches of a choice, which all take the numbers of all of them."""
        found = [self.lifter.lift_inner_jaxpr(branch) for branch in branches]
        every = [var for _, numbers in found for var, _ in numbers]
        taken = [atom for _, numbers in found for atom in self._lift_inner_numbers(numbers)]
        new = []
        for closed, numbers in found:
            own = closed.jaxpr.invars[len(numbers) :]
            mine = {var for var, _ in numbers}
            front = [var if var in mine else Var(var.aval) for var in every]
            new.append(ClosedJaxpr(closed.jaxpr.replace(invars=[*front, *own]), closed.consts))
        index, *operands = inputs
        return tuple(new), [index, *taken, *self._lift_literals(operands)]

    # -- what follows from numbers alone ----------------------------------------------------------------------------

    def _constant_outputs(self, eqn: JaxprEqn, inputs: list) -> list | None:
        """The values of truths or integers that follow from numbers alone: they belong to the operations.

        Or those of large arrays of numbers: a table is kept as it is, not what it is made from.
        """
        table = all(map(_is_table, eqn.outvars)) and any(math.prod(a.aval.shape) > MAX_INLINE_NUMBERS for a in inputs)
        if eqn.effects or (all(_is_inexact(v.aval) for v in eqn.outvars) and not table):
            return None
        if not any(_is_inexact(a.aval) for a in inputs) and not table:
            return None
        if not all(isinstance(a, Literal) or a in self._argument_free for a in inputs):
            return None
        memo: dict[Var, Any] = {}

        def value(atom):
            if isinstance(atom, Literal):
                return atom.val
            if atom not in memo:
                found = self._argument_free[atom]
                if isinstance(found, tuple):
                    equation, i = found
                    found = _evaluate_equation(equation, [value(a) for a in equation.invars])[i]
                memo[atom] = found
            return memo[atom]

        values = [value(a) for a in inputs]
        if any(isinstance(v, jax.core.Tracer) for v in values):
            return None
        return _evaluate_equation(eqn, values)


def _expm_substitute(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """What takes the place of a function of JAX that unrolls badly, above all its derivatives: the exponential."""
    if eqn.params.get("name") != "expm" or len(eqn.invars) != 1:
        return None
    aval: Any = eqn.invars[0].aval
    known, own = _expm_jaxprs(jax.ShapeDtypeStruct(aval.shape, aval.dtype))
    return own if known is not None and content_key(eqn.params["jaxpr"]) == known else None


@functools.lru_cache(maxsize=64)
def _expm_jaxprs(shape) -> tuple[Hashable, ClosedJaxpr | None]:
    """A key of what JAX's does to an array, where that can be traced, and the operations of ours."""
    outer = jax.make_jaxpr(jax.scipy.linalg.expm)(shape)
    found = [eqn for eqn in outer.eqns if eqn.params.get("name") == "expm"]
    if len(found) != 1:
        return None, None
    return content_key(found[0].params["jaxpr"]), jax.make_jaxpr(expm)(shape)


def _evaluate_equation(eqn: JaxprEqn, values: Sequence) -> list:
    inputs = [Var(a.aval) for a in eqn.invars]
    jaxpr = Jaxpr([], inputs, eqn.outvars, [eqn.replace(invars=list(inputs))], debug_info=DebugInfo("", "", None, None))
    with jax.ensure_compile_time_eval():
        return jaxpr_as_fun(ClosedJaxpr(jaxpr, []))(*values)


def _debug_info_without_names(jaxpr: Jaxpr) -> DebugInfo:
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)  # there are more arguments now


def _is_inexact(aval) -> bool:
    dtype = getattr(aval, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.inexact)


def _is_table(var: Var) -> bool:
    aval: Any = var.aval
    return getattr(aval, "dtype", None) == np.float64 and aval.size > MAX_INLINE_NUMBERS


def _is_liftable_literal(atom) -> bool:
    """Whether it is a literal to be lifted."""
    if not isinstance(atom, Literal) or getattr(atom.aval, "dtype", None) != np.float64:
        return False
    return bool(atom.val != 0.0) and np.shape(atom.val) == ()


FORMULA_INPUTS = {"pow": (1, 2.0), "polygamma": (0, 1.0)}
"""Which input says by what formula a primitive is computed: where so many times the number is an integer."""


def _formula_input_index(name: str, inputs: list) -> int | None:
    """The place of an input that is to stay a number, if there is one."""
    place, times = FORMULA_INPUTS.get(name, (0, 0.0))
    known = times and isinstance(inputs[place], Literal)
    return place if known and float(times * np.real(inputs[place].val)).is_integer() else None


def _has_while_loop(parameter) -> bool:
    """Whether a parameter of an equation has a jaxpr with a loop of unknown length."""
    if isinstance(parameter, ClosedJaxpr):
        parameter = parameter.jaxpr
    if isinstance(parameter, Jaxpr):
        return any(e.primitive.name == "while" or any(map(_has_while_loop, e.params.values())) for e in parameter.eqns)
    return isinstance(parameter, tuple | list) and any(map(_has_while_loop, parameter))
