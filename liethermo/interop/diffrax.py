"""Systems and steps for diffrax: ``diffrax.diffeqsolve(lt.diffrax.Term(system), lt.diffrax.Solver(method), ...)``.

diffrax is an optional package; this module imports it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp

from manifolds._arguments import module_dir_function

from ..errors import InputError
from ..functions.checks import trace_energies
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..integrators.base import has_error_estimate
from ..runs.flow import differentiable_step, initial_carry
from ..systems import System

__all__ = ["Solver", "Term"]
__dir__ = module_dir_function(__all__)


class Term(diffrax.ODETerm):
    """The vector field of a system as a diffrax term, for the solvers of diffrax and for :class:`Solver`.

    Parameters
    ----------
    system : System
        Its parameters are leaves of the term, so ``jax.grad`` and ``jax.vmap`` apply to them.
    """

    system: System

    def __init__(self, system: System):
        self.system = system
        self.vector_field = _raise_unbound_field

    def vf(self, t, y, args):
        """Return the vector field at a state, shape (n,)."""
        return self.system.vector_field(y, t if self.system.is_driven else None)


def _raise_unbound_field(t, y, args):
    raise NotImplementedError("Term.vf knows the system")


class Solver(diffrax.AbstractAdaptiveSolver):
    """A method of this library as a solver of diffrax; the laws hold at every step that diffrax accepts.

    Implicit steps are differentiated by the implicit function theorem, so reverse mode works with diffrax's default
    adjoint. Interpolation between steps is by cubic Hermite polynomials, outside of the laws.

    Parameters
    ----------
    method : OneStepMethod, optional
        ``MetriplecticGauss(1)`` by default.
    """

    method: OneStepMethod

    term_structure: ClassVar = Term
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def __init__(self, method: OneStepMethod | None = None):
        self.method = DEFAULT_METHOD if method is None else method

    def order(self, terms) -> int:
        """Return the order of accuracy of the method."""
        return self.method.order

    def error_order(self, terms) -> int:
        """Return the power of h with which the estimate of the local error decreases."""
        return self.order(terms) + 1

    def init(self, terms, t0, t1, y0, args) -> Any:
        """Return the initial carry of a run besides its state: the compensation and the slopes of the last two
        steps."""
        del t0, t1, args
        system, method = self._system_and_method(terms)
        return initial_carry(system, method, y0)[1:]

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """Take one step; return state, error estimate, dense output, carry, and whether its equations were solved."""
        system, method = self._system_and_method(terms)
        h = getattr(terms, "direction", 1) * (t1 - t0)  # diffrax wraps a term to reverse time
        compensation, k, previous_slopes = solver_state
        y1, *state = differentiable_step(system, method, (y0, compensation, k, previous_slopes), h)
        is_solved = jnp.isfinite(jnp.sum(y1))
        slopes = state[1]
        error = (
            method.error(system, y0, compensation, jnp.abs(h), slopes) if has_error_estimate(method) else jnp.zeros(())
        )
        estimate = jax.lax.stop_gradient(jnp.full_like(y0, jnp.where(is_solved, error, jnp.inf)))
        field = system.vector_field
        dense = {"y0": y0, "y1": y1, "k": h * jnp.stack([field(y0), field(y1)])}
        result = diffrax.RESULTS.where(is_solved, diffrax.RESULTS.successful, diffrax.RESULTS.nonlinear_divergence)
        return y1, estimate, dense, tuple(state), result

    def func(self, terms, t0, y0, args):
        """Return the vector field of the terms at a state, shape (n,)."""
        return terms.vf(t0, y0, args)

    def _system_and_method(self, terms) -> tuple[System, OneStepMethod]:
        system = getattr(terms, "term", terms).system
        if system.is_driven:
            raise InputError(
                "an energy that depends on time needs a clock and a ledger in the state. Use lt.integrate or lt.flow"
            )
        return system, trace_energies(self.method.on(system), system.dim)
