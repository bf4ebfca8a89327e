"""Parameters that change from call to call, as arguments of machine code; each call tests which code they need."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import replace_fields

from ..engines.compiled.machine_code import PointEvaluator
from ..engines.compiled.parameters import ProgramStructure, parameter_arrays
from ..errors import LiethermoError
from ..systems import System
from ..systems.conservation import AXIOM_TOLERANCE, judge_conservation, rates_of_change
from ..systems.invariants import (
    find_invariants,
    invariants_by_construction,
    n_random_states,
    named_functions,
    random_states,
)
from ..tracing.trace_errors import TRACE_ERRORS
from .named_parameters import find_parameter
from .preparation import prepare_system_and_method
from .problem import Problem

TOLERANCE_FACTOR = 10.0
"""Factor by which the tolerance of the test of conservation is made smaller and larger. Both have to give one verdict:
machine code rounds differently from the test that decides in all other runs."""

SMALLEST_SPEED_RATIO = 1e-4
"""Least speed of a motion that is not rounding, relative to the speed for another gradient of the energy."""

CONSERVED_CODE = 2.0
"""Verdict on a function at a state: conserved by both tolerances. By one of them it is 1, by none 0."""

UNDEFINED_CODE = 3.0
"""Verdict on a function at a state where its rate of change is not a number."""


class VariedParameters:
    """Some parameters of a system, whose values change from call to call.

    The machine code of a step takes the parameters as arguments, but what the system conserves, and which of its
    parameters are zero, are part of the code. Every call tests them for its own values.

    Parameters
    ----------
    system : System
        Not driven, without preserved functions of its dissipation.
    method : OneStepMethod
        The method of the user.
    names : sequence of str

    Attributes
    ----------
    indices : array of int, shape (p,)
        Where the varied entries are among all parameters of the system, one after another.
    entries : array, shape (p,)
        The varied entries, which :meth:`program_key` sets.

    Raises
    ------
    UnsupportedPrimitive
        If the test of conservation cannot be compiled.
    """

    def __init__(self, system: System, method: Any, names: Sequence[str]):
        self._method, self._structure = method, ProgramStructure.from_module(system)
        self._leaves, parameters = parameter_arrays(system), [find_parameter(system, name) for name in names]
        self._varied_leaves = [i for parameter in parameters for i in parameter.leaves]
        ends = np.cumsum([leaf.size for leaf in self._leaves])
        self.indices = np.concatenate([np.arange(ends[i] - self._leaves[i].size, ends[i]) for i in self._varied_leaves])
        self.entries = np.concatenate([self._leaves[i].ravel() for i in self._varied_leaves])
        slots = iter(self._split(self.entries))
        self._slots = [(parameter, [next(slots) for _ in parameter.leaves]) for parameter in parameters]
        self._functions = tuple(
            name for name in named_functions(system) if name not in invariants_by_construction(system)
        )
        self._bath_scales = np.asarray(system.baths.scale)
        self._codes: list[float] = []
        self._test = None
        if self._functions:
            states = random_states(system, n_random_states(system))
            self._test = PointEvaluator(self._verdict_codes, self.entries, states)

    def program_key(self, values: Iterable[Any]) -> Hashable | None:
        """Set the values of the parameters; return a key of the machine code that they need.

        None if a value has another shape or is refused by the constructor of its object, or if what the system
        conserves cannot be decided here.
        """
        for (parameter, slots), value in zip(self._slots, values, strict=True):
            array = np.asarray(value, dtype=np.float64)
            if array.shape != parameter.value.shape:
                return None
            if parameter.condition is not None and not parameter.condition.holds(array):
                return None
            leaf = parameter.to_leaf(array)
            for slot in slots:
                slot[...] = leaf
        if self._test is not None:
            self._codes = self._test().min(axis=0).tolist()
            if not all(code in (0.0, CONSERVED_CODE) for code in self._codes):
                return None
        return (self.entries == 0.0).tobytes(), *self._codes

    def is_program_determined_by_key(self, problem: Problem) -> bool:
        """Return whether the code of a problem depends on the parameters by :meth:`program_key` alone.

        Parameters
        ----------
        problem : Problem
            That of the system with the values of the last key.
        """
        verdicts = find_invariants(problem.system)
        conserved_names = {
            name for name, code in zip(self._functions, self._codes, strict=True) if code == CONSERVED_CODE
        }
        if conserved_names != verdicts.conserved_names & set(self._functions):
            return False

        def is_prepared_alike(entries) -> bool:
            system = replace_fields(self._system(entries), invariant_verdicts=verdicts)
            prepared_system, method = prepare_system_and_method(system, self._method)
            method.check(prepared_system)
            is_same = ProgramStructure.from_module(method).key == ProgramStructure.from_module(problem.method).key
            return prepared_system is system and is_same and not is_traced(method)

        answers = []
        try:  # with entries that have no values, so that nothing can depend on these
            jax.eval_shape(lambda entries: answers.append(is_prepared_alike(entries)), self.entries)
        except (LiethermoError, *TRACE_ERRORS):
            return False
        return answers == [True]

    def _system(self, entries) -> System:
        """Return the system with these varied entries, shape (p,)."""
        leaves: list[Any] = [jnp.asarray(leaf) for leaf in self._leaves]
        for i, leaf in zip(self._varied_leaves, self._split(entries), strict=True):
            leaves[i] = leaf
        return self._structure.rebuild(leaves)

    def _split(self, entries) -> list[Any]:
        """Return the entries, shape (p,), as one array for each varied array of the system."""
        shapes = [self._leaves[i].shape for i in self._varied_leaves]
        ends = np.cumsum([self._leaves[i].size for i in self._varied_leaves]).tolist()
        return [entries[start:end].reshape(s) for start, end, s in zip([0, *ends[:-1]], ends, shapes, strict=True)]

    def _verdict_codes(self, entries, x) -> jax.Array:
        """Return the verdict on each function at the random state x of the first system, shape (functions,)."""
        system = self._system(entries)
        if system.baths.number:  # the entropies of baths scale with their capacities
            x = x.at[system.body_dim :].multiply(system.baths.entropy_scales() / self._bath_scales)
        functions = tuple(named_functions(system)[name] for name in self._functions)
        rates = rates_of_change((system, functions), x)
        # a motion that is the rounding error of zero changes functions, relative to its own speed
        other_gradient = jnp.linalg.norm(system.energy.gradient(x)) * jnp.cos(jnp.arange(1.0, x.shape[0] + 1.0))
        lengths = jnp.stack([jnp.linalg.norm(f.gradient(x)) for f in functions])
        least_scales = SMALLEST_SPEED_RATIO * jnp.linalg.norm(system.poisson.sharp(x, other_gradient)) * lengths
        strict = judge_conservation(rates, AXIOM_TOLERANCE / TOLERANCE_FACTOR)
        loose = judge_conservation(
            rates._replace(scales=rates.scales.at[0].max(least_scales)), AXIOM_TOLERANCE * TOLERANCE_FACTOR
        )
        n_conserving = strict.is_conserved.astype(np.float64) + loose.is_conserved
        return jnp.where(strict.is_defined, n_conserving, UNDEFINED_CODE)
