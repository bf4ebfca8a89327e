"""Numbers taken out of a jaxpr: programs that differ only in their numbers become one program with parameters."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun, jaxprs_in_params

from manifolds._content_keys import content_key
from manifolds.matrices.exponential import expm

from .searches import aval_dtype, has_while_loop

MAX_INLINE_NUMBERS = 64
"""Largest number of entries of an array that is recomputed from its origin; a larger one is stored as a table."""

CALL_PRIMITIVES = ("jit", "pjit", "closed_call", "core_call")
"""Primitives that call a jaxpr, which is inlined."""


class ConstantLifter:
    """Turns the numbers of a jaxpr (its constants and nonzero float64 literals) into its first arguments.

    Zeros stay, because vanishing terms belong to the operations. Exponents with instructions of their own stay too, and
    so do numbers from which truth values or integers are computed.
    """

    def __init__(self):
        self.has_while_loop = False

    def lift_numbers(self, closed_jaxpr: ClosedJaxpr) -> tuple[Jaxpr, list, tuple]:
        """Return the jaxpr with its numbers as arguments, its other constants, and the numbers as arrays."""
        body = _LiftedBody(self)
        body.append_and_set_outputs(closed_jaxpr.jaxpr, closed_jaxpr.consts, closed_jaxpr.jaxpr.invars)
        used_vars = {a for eqn in body.equations for a in eqn.invars if type(a) is Var} | {
            a for a in body.outputs if type(a) is Var
        }
        body.numbers = [(v, x) for v, x in body.numbers if v in used_vars]
        scalars = [(v, x) for v, x in body.numbers if isinstance(x, float)]
        arrays = [(v, x) for v, x in body.numbers if not isinstance(x, float)]
        invars = [v for v, _ in (*scalars, *arrays)] + list(closed_jaxpr.jaxpr.invars)
        jaxpr = Jaxpr(
            list(body.constants),
            invars,
            body.outputs,
            body.equations,
            closed_jaxpr.jaxpr.effects,
            _debug_info_without_names(closed_jaxpr.jaxpr),
        )
        with jax.ensure_compile_time_eval():  # concrete values, even inside another trace
            number_array = jnp.asarray(np.array([x for _, x in scalars], dtype=np.float64))
            values = [x if isinstance(x, jax.Array) else jnp.asarray(np.asarray(x)) for _, x in arrays]
        return jaxpr, list(body.constants.values()), (number_array, *values)

    def lift_inner_jaxpr(self, closed_jaxpr: ClosedJaxpr) -> tuple[ClosedJaxpr, list[tuple[Var, Any]]]:
        """Return the jaxpr of a loop or branch with its numbers as first arguments, and these numbers."""
        body = _LiftedBody(self)
        argument_vars = [Var(v.aval) for v in closed_jaxpr.jaxpr.invars]
        body.append_and_set_outputs(closed_jaxpr.jaxpr, closed_jaxpr.consts, argument_vars)
        invars = [v for v, _ in body.numbers] + argument_vars
        jaxpr = Jaxpr(
            list(body.constants),
            invars,
            body.outputs,
            body.equations,
            closed_jaxpr.jaxpr.effects,
            _debug_info_without_names(closed_jaxpr.jaxpr),
        )
        return ClosedJaxpr(jaxpr, list(body.constants.values())), body.numbers


class _LiftedBody:
    """Equations, numbers and constants of a jaxpr under construction."""

    def __init__(self, lifter: ConstantLifter):
        self.lifter = lifter
        self.equations: list[JaxprEqn] = []
        self.numbers: list[tuple[Var, Any]] = []
        self.constants: dict[Var, Any] = {}
        self.outputs: list = []
        # variables that do not depend on the arguments: a number, or (equation, index of its output)
        self._argument_free: dict[Var, Any] = {}

    def append_and_set_outputs(self, jaxpr: Jaxpr, consts: Sequence, arguments: Sequence) -> None:
        """Append the equations of a jaxpr, with its numbers lifted, and store the atoms of its outputs."""
        env: dict[Var, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
        self.outputs = self._append_equations(jaxpr, consts, env)

    def _append_equations(self, jaxpr: Jaxpr, consts: Sequence, env: dict[Var, Any]) -> list:
        """Append the equations of a jaxpr, with calls inlined and numbers lifted; return the atoms of its outputs."""
        formula_uses = [
            (eqn.invars, FORMULA_INPUTS[eqn.primitive.name])
            for eqn in jaxpr.eqns
            if eqn.primitive.name in FORMULA_INPUTS
        ]
        formula_vars = {
            inputs[input_index] for inputs, (input_index, _) in formula_uses if type(inputs[input_index]) is Var
        }
        for var, value in zip(jaxpr.constvars, consts, strict=True):
            env[var] = self._lift_or_keep(var, value, var in formula_vars)

        def read(atom):
            return atom if isinstance(atom, Literal) else env[atom]

        for eqn in jaxpr.eqns:
            inputs = [read(a) for a in eqn.invars]
            if eqn.primitive.name in CALL_PRIMITIVES and isinstance(eqn.params.get("jaxpr"), ClosedJaxpr):
                inner = _replacement_for_jax_expm(eqn) or eqn.params["jaxpr"]
                results = self._append_equations(
                    inner.jaxpr, inner.consts, dict(zip(inner.jaxpr.invars, inputs, strict=True))
                )
                env.update(zip(eqn.outvars, results, strict=True))
                continue
            constant_values = self._folded_outputs_or_none(eqn, inputs)
            if constant_values is not None:
                for var, value in zip(eqn.outvars, constant_values, strict=True):
                    inexact = _is_inexact(var.aval)
                    env[var] = (
                        self._lift_number(value, var.aval) if inexact else self._keep_constant(Var(var.aval), value)
                    )
                continue
            inputs, params = self._lifted_inputs_and_params(eqn, inputs)
            outputs = [type(v)(v.aval) for v in eqn.outvars]
            env.update(zip(eqn.outvars, outputs, strict=True))
            self.equations.append(eqn.replace(invars=inputs, outvars=outputs, params=params))
            if all(isinstance(a, Literal) or a in self._argument_free for a in inputs) and not eqn.effects:
                self._argument_free.update((v, (self.equations[-1], i)) for i, v in enumerate(outputs))
        return [self._lift_number(a.val, a.aval) if _is_liftable_literal(a) else a for a in map(read, jaxpr.outvars)]

    # -- numbers and constants ------------------------------------------------------------------------------------

    def _lift_number(self, value, aval) -> Var:
        """Record a number as an argument; return the variable that stands for it."""
        var = Var(aval)
        is_concrete = np.shape(value) == () and not isinstance(value, jax.Array)
        self.numbers.append((var, float(value) if is_concrete else value))
        self._argument_free[var] = value
        return var

    def _keep_constant(self, var: Var, value) -> Var:
        """Record a value as a constant of the jaxpr; return its variable."""
        self.constants[var] = self._argument_free[var] = value
        return var

    def _lift_or_keep(self, var: Var, value, must_stay_constant: bool):
        """Lift a constant if it is a tracer or a float64 array that need not stay constant; return its variable."""
        if isinstance(value, jax.core.Tracer):
            return self._lift_number(value, var.aval)
        if aval_dtype(var.aval) == np.float64 and not must_stay_constant:
            return self._lift_number(value if isinstance(value, jax.Array) else np.asarray(value), var.aval)
        return self._keep_constant(Var(var.aval), value)

    def _lifted_inputs_and_params(self, eqn: JaxprEqn, inputs: list) -> tuple[list, dict]:
        """Return the inputs and parameters of an equation, with its numbers as variables."""
        name, params = eqn.primitive.name, dict(eqn.params)
        number_vars: list = []
        if name == "scan":
            params["jaxpr"], numbers = self.lifter.lift_inner_jaxpr(params["jaxpr"])
            number_vars = self._lift_inner_numbers(numbers)
            params["num_consts"] += len(number_vars)
            inputs = number_vars + self._lift_literals(inputs)
        elif name == "cond":
            params["branches"], inputs = self._lift_branches(params["branches"], inputs)
        elif name == "while":
            self.lifter.has_while_loop = True
            inputs = self._lift_literals(inputs)
        else:
            if not self.lifter.has_while_loop:
                self.lifter.has_while_loop = any(map(has_while_loop, jaxprs_in_params(params)))
            formula_index = _index_of_input_kept_literal(name, inputs)
            inputs = [a if i == formula_index else self._lift_literals([a])[0] for i, a in enumerate(inputs)]
        return inputs, params

    def _lift_literals(self, inputs: list) -> list:
        """Return the inputs of an equation, with nonzero float64 literals replaced by variables of lifted numbers."""
        return [self._lift_number(a.val, a.aval) if _is_liftable_literal(a) else a for a in inputs]

    def _lift_inner_numbers(self, numbers: list[tuple[Var, Any]]) -> list[Var]:
        """Lift the numbers of an inner jaxpr to this level too; return their variables at this level."""
        return [self._lift_number(value, var.aval) for var, value in numbers]

    def _lift_branches(self, branches, inputs: list) -> tuple[tuple, list]:
        """Return the branches of a ``cond``, each with the numbers of all branches as arguments, and the inputs."""
        lifted_branches = [self.lifter.lift_inner_jaxpr(branch) for branch in branches]
        number_vars = [var for _, numbers in lifted_branches for var, _ in numbers]
        outer_vars = [atom for _, numbers in lifted_branches for atom in self._lift_inner_numbers(numbers)]
        extended_branches = []
        for closed_jaxpr, numbers in lifted_branches:
            argument_vars = closed_jaxpr.jaxpr.invars[len(numbers) :]
            branch_vars = {var for var, _ in numbers}
            leading_vars = [var if var in branch_vars else Var(var.aval) for var in number_vars]
            extended_branches.append(
                ClosedJaxpr(closed_jaxpr.jaxpr.replace(invars=[*leading_vars, *argument_vars]), closed_jaxpr.consts)
            )
        index, *operands = inputs
        return tuple(extended_branches), [index, *outer_vars, *self._lift_literals(operands)]

    # -- constant folding -----------------------------------------------------------------------------------------

    def _folded_outputs_or_none(self, eqn: JaxprEqn, inputs: list) -> list | None:
        """Return the values of an equation's outputs if they are to be folded into constants, or None.

        Folded are truth values and integers that are computed from known numbers, and tables that are made from large
        arrays: a table is stored as a whole.
        """
        makes_table = all(map(_is_large_float64, eqn.outvars)) and any(
            math.prod(a.aval.shape) > MAX_INLINE_NUMBERS for a in inputs
        )
        if eqn.effects or (all(_is_inexact(v.aval) for v in eqn.outvars) and not makes_table):
            return None
        if not any(_is_inexact(a.aval) for a in inputs) and not makes_table:
            return None
        if not all(isinstance(a, Literal) or a in self._argument_free for a in inputs):
            return None
        memo: dict[Var, Any] = {}

        def evaluate_atom(atom):
            if isinstance(atom, Literal):
                return atom.val
            if atom not in memo:
                definition = self._argument_free[atom]
                if isinstance(definition, tuple):
                    equation, i = definition
                    definition = _evaluate_equation(equation, [evaluate_atom(a) for a in equation.invars])[i]
                memo[atom] = definition
            return memo[atom]

        values = [evaluate_atom(a) for a in inputs]
        if any(isinstance(v, jax.core.Tracer) for v in values):
            return None
        return _evaluate_equation(eqn, values)


def _replacement_for_jax_expm(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """Return the library's matrix exponential if an equation calls JAX's, whose derivatives unroll badly; else None."""
    if eqn.params.get("name") != "expm" or len(eqn.invars) != 1:
        return None
    aval: Any = eqn.invars[0].aval
    jax_key, substitute = _jax_expm_key_and_replacement(jax.ShapeDtypeStruct(aval.shape, aval.dtype))
    return substitute if jax_key is not None and content_key(eqn.params["jaxpr"]) == jax_key else None


@functools.lru_cache(maxsize=64)
def _jax_expm_key_and_replacement(shape) -> tuple[Hashable, ClosedJaxpr | None]:
    """Return a key of JAX's ``expm`` for this shape, and the jaxpr that replaces it; None for both if not found."""
    outer = jax.make_jaxpr(jax.scipy.linalg.expm)(shape)
    expm_equations = [eqn for eqn in outer.eqns if eqn.params.get("name") == "expm"]
    if len(expm_equations) != 1:
        return None, None
    return content_key(expm_equations[0].params["jaxpr"]), jax.make_jaxpr(expm)(shape)


def _evaluate_equation(eqn: JaxprEqn, values: Sequence) -> list:
    """Return the results of one equation for these values of its inputs, computed now."""
    inputs = [Var(a.aval) for a in eqn.invars]
    jaxpr = Jaxpr([], inputs, eqn.outvars, [eqn.replace(invars=list(inputs))], debug_info=DebugInfo("", "", None, None))
    with jax.ensure_compile_time_eval():
        return jaxpr_as_fun(ClosedJaxpr(jaxpr, []))(*values)


def _debug_info_without_names(jaxpr: Jaxpr) -> DebugInfo:
    """Return the debug information of a jaxpr without the names of its arguments and results."""
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)  # the arguments have changed


def _is_inexact(aval) -> bool:
    """Return whether an abstract value holds real or complex numbers."""
    dtype = aval_dtype(aval)
    return dtype is not None and jnp.issubdtype(dtype, jnp.inexact)


def _is_large_float64(var: Var) -> bool:
    """Return whether a variable is a float64 array of more than MAX_INLINE_NUMBERS entries."""
    aval: Any = var.aval
    return aval_dtype(aval) == np.float64 and aval.size > MAX_INLINE_NUMBERS


def _is_liftable_literal(atom) -> bool:
    """Return whether an atom is a literal that is lifted: a nonzero scalar of double precision."""
    if not isinstance(atom, Literal) or aval_dtype(atom.aval) != np.float64:
        return False
    return bool(atom.val != 0.0) and np.shape(atom.val) == ()


FORMULA_INPUTS = {"pow": (1, 2.0), "polygamma": (0, 1.0)}
"""Input that selects the formula of a primitive, and a factor; it stays a constant if their product is an integer."""


def _index_of_input_kept_literal(name: str, inputs: list) -> int | None:
    """Return the index of the input of a primitive that must stay a literal because it selects a formula, or None."""
    index, factor = FORMULA_INPUTS.get(name, (0, 0.0))
    is_literal = factor and isinstance(inputs[index], Literal)
    return index if is_literal and float(factor * np.real(inputs[index].val)).is_integer() else None
