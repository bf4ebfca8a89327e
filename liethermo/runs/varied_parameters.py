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
from ..systems.conservation import AXIOM_TOLERANCE, function_rates_of_change, judge_conservation
from ..systems.invariants import (
    candidate_invariants,
    find_invariants,
    invariants_by_construction,
    n_test_states_per_scale,
    random_test_states,
)
from ..tracing.trace_errors import TRACE_ERRORS
from .named_parameters import require_parameter
from .preparation import prepare_system_and_method
from .problem import Problem

TOLERANCE_FACTOR = 10.0
"""Factor by which the tolerance of the test of conservation is reduced and enlarged. Both must give the same verdict:
machine code rounds differently from the test that decides in all other runs."""

SMALLEST_SPEED_RATIO = 1e-4
"""Smallest speed of a motion above rounding, relative to the speed for another gradient of the energy."""

CONSERVED_CODE = 2.0
"""Verdict that a function is conserved at a state by both tolerances; 1 means by one of them, 0 by none."""

UNDEFINED_CODE = 3.0
"""Verdict on a function at a state where its rate of change is not a number."""


class VariedParameters:
    """Named parameters of a system as arguments of machine code, with values that change from call to call.

    The set of conserved functions and the set of parameters that are zero are part of the code. So every call tests
    both for its own values.

    Parameters
    ----------
    system : System
        Not driven, without preserved functions of its dissipation.
    method : OneStepMethod
        The method of the user.
    parameter_names : sequence of str

    Attributes
    ----------
    indices : array of int, shape (p,)
        Indices of the varied entries among all parameters of the system in one row.
    entries : array, shape (p,)
        The varied entries, which :meth:`set_values_and_get_program_key` sets.

    Raises
    ------
    UnsupportedPrimitive
        If the test of conservation cannot be compiled.
    """

    def __init__(self, system: System, method: Any, parameter_names: Sequence[str]):
        self._method, self._structure = method, ProgramStructure.from_module(system)
        self._leaves, parameters = (
            parameter_arrays(system),
            [require_parameter(system, name) for name in parameter_names],
        )
        self._varied_leaves = [i for parameter in parameters for i in parameter.leaf_indices]
        ends = np.cumsum([leaf.size for leaf in self._leaves])
        self.indices = np.concatenate([np.arange(ends[i] - self._leaves[i].size, ends[i]) for i in self._varied_leaves])
        self.entries = np.concatenate([self._leaves[i].ravel() for i in self._varied_leaves])
        slots = iter(self._unflatten_varied_arrays(self.entries))
        self._slots = [(parameter, [next(slots) for _ in parameter.leaf_indices]) for parameter in parameters]
        self._functions = tuple(
            name for name in candidate_invariants(system) if name not in invariants_by_construction(system)
        )
        self._bath_scales = np.asarray(system.baths.constant_entropy_scales)
        self._codes: list[float] = []
        self._test = None
        if self._functions:
            states = random_test_states(system, n_test_states_per_scale(system))
            self._test = PointEvaluator(self._conservation_verdict_codes, self.entries, states)

    def set_values_and_get_program_key(self, parameter_values: Iterable[Any]) -> Hashable | None:
        """Set the values of the parameters, and return a key of the machine code that they need.

        The key is None if a value has another shape or is refused by the constructor of its object, or if the test of
        conservation is inconclusive.
        """
        for (parameter, slots), value in zip(self._slots, parameter_values, strict=True):
            array = np.asarray(value)
            if array.dtype.kind not in "fiub" or array.shape != parameter.value.shape:  # which a new propagator reports
                return None
            if parameter.condition is not None and not parameter.condition.holds(array):
                return None
            leaf = parameter.to_stored_array(array)
            for slot in slots:
                slot[...] = leaf
        if self._test is not None:
            self._codes = self._test().min(axis=0).tolist()
            if not all(code in (0.0, CONSERVED_CODE) for code in self._codes):
                return None
        return (self.entries == 0.0).tobytes(), *self._codes

    def is_program_determined_by_key(self, problem: Problem) -> bool:
        """Return whether the code of a problem is the same for all parameter values with the last key.

        Parameters
        ----------
        problem : Problem
            The problem of the system with the values of the last key.
        """
        verdicts = find_invariants(problem.system)
        conserved_names = {
            name for name, code in zip(self._functions, self._codes, strict=True) if code == CONSERVED_CODE
        }
        if conserved_names != verdicts.conserved_names & set(self._functions):
            return False

        def has_same_program(entries) -> bool:
            """Return whether the system with these entries is prepared as the problem is, for the same program."""
            system = replace_fields(self._system_with_entries(entries), invariant_verdicts=verdicts)
            prepared_system, method = prepare_system_and_method(system, self._method)
            method.check(prepared_system)
            is_same = ProgramStructure.from_module(method).key == ProgramStructure.from_module(problem.method).key
            return prepared_system is system and is_same and not is_traced(method)

        answers = []
        try:  # with entries that have no values, so that nothing can depend on these
            jax.eval_shape(lambda entries: answers.append(has_same_program(entries)), self.entries)
        except (LiethermoError, *TRACE_ERRORS):
            return False
        return answers == [True]

    def _system_with_entries(self, entries) -> System:
        """Return the system with these entries, shape (p,), of the varied parameters."""
        leaves: list[Any] = [jnp.asarray(leaf) for leaf in self._leaves]
        for i, leaf in zip(self._varied_leaves, self._unflatten_varied_arrays(entries), strict=True):
            leaves[i] = leaf
        return self._structure.rebuild(leaves)

    def _unflatten_varied_arrays(self, entries) -> list[Any]:
        """Return the entries, shape (p,), as a list with one array for each varied array of the system."""
        shapes = [self._leaves[i].shape for i in self._varied_leaves]
        ends = np.cumsum([self._leaves[i].size for i in self._varied_leaves]).tolist()
        return [entries[start:end].reshape(s) for start, end, s in zip([0, *ends[:-1]], ends, shapes, strict=True)]

    def _conservation_verdict_codes(self, entries, x) -> jax.Array:
        """Return codes, shape (functions,), that say whether each function is conserved at a random state x."""
        system = self._system_with_entries(entries)
        if system.baths.number:  # the entropies of baths scale with their capacities
            x = x.at[system.body_dim :].multiply(system.baths.entropy_scales() / self._bath_scales)
        functions = tuple(candidate_invariants(system)[name] for name in self._functions)
        rates = function_rates_of_change((system, functions), x)
        # a motion that is the rounding error of zero changes functions, relative to its own speed
        other_gradient = jnp.linalg.norm(system.energy.gradient(x)) * jnp.cos(jnp.arange(1.0, x.shape[0] + 1.0))
        lengths = jnp.stack([jnp.linalg.norm(f.gradient(x)) for f in functions])
        least_scales = SMALLEST_SPEED_RATIO * jnp.linalg.norm(system.poisson.sharp(x, other_gradient)) * lengths
        strict_verdict = judge_conservation(rates, AXIOM_TOLERANCE / TOLERANCE_FACTOR)
        loose_verdict = judge_conservation(
            rates._replace(scales=rates.scales.at[0].max(least_scales)), AXIOM_TOLERANCE * TOLERANCE_FACTOR
        )
        n_conserving = strict_verdict.is_conserved.astype(np.float64) + loose_verdict.is_conserved
        return jnp.where(strict_verdict.is_defined, n_conserving, UNDEFINED_CODE)
