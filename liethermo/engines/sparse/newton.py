"""The sparse engine: systems of any size that know which of their components act on which.

A step is tried by fixed-point iteration, as by the array engine; a stiff one is solved by Newton's method with a sparse
Jacobian matrix. Its entries come from few derivatives: columns that no row has in common are taken in one, and the rows
of hubs, which have many neighbours, are taken by themselves [Curtis, Powell & Reid 1974; Coleman & Verma 1998]. The
Newton iteration runs on the host, where SciPy factorises; all else is the array engine's.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...functions.rounding import with_rounding
from ...integrators import OneStepMethod
from ...systems import System
from ...tracing.programs import program
from ..codes import Code
from ..rules import RULES
from ..stages import Equations, Iteration, Solved, better_start, fixed_point
from ..stepping import State, begin, conclude, equations
from .linear import Compression, Inverse

PATIENT = replace(RULES, newton=80, halvings=12, stale=0.1, large=sys.maxsize)
"""Newton iterations are cheap here: most use factors that are there already, kept from step to step. Their matrix is
formed whatever its size, and a few stiff components of many are not to be lost in a mean."""


class SparseEngine:
    """The engine for one system and method; the factors of its Jacobian matrix are kept from step to step.

    Raises
    ------
    ValueError
        If the system does not know its sparsity.
    """

    name = "sparse"
    portion = 1  # its steps may take seconds: show each, and keep each on Ctrl-C

    def __init__(self, system: System, method: OneStepMethod):
        self.system, self.method = system, method
        pattern = system.sparsity()
        if pattern is None:
            raise ValueError(f"{type(system).__name__} does not know its sparsity")
        self._pattern = pattern
        self._compression: Compression | None = None
        self._inverse: Inverse | None = None
        self._h = np.nan

    def begin(self, x) -> State:
        return begin(self.system, self.method, x)

    def advance(self, state, h, saves, every, noise=None):
        """Keeps no more than it reaches."""
        del noise  # steps with noise are not for this engine
        kept: list[State] = []
        for _ in range(int(saves)):
            for _ in range(int(every)):
                state = self.step(state, h)
                if int(state.status) != Code.COMPLETED:
                    break
            if int(state.status) != Code.COMPLETED:
                break
            kept.append(state)
        x = np.array([np.asarray(s.x) for s in kept]).reshape(len(kept), self.system.dim)
        energy, entropy = (np.array([float(getattr(s, name)) for s in kept]) for name in ("energy", "entropy"))
        return state, (x, energy, entropy, np.ones(len(kept), dtype=bool))

    def ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        states = [self.step(self.begin(jnp.asarray(start)), size) for start, size in zip(x, h, strict=True)]
        solved = np.array([int(s.status) == Code.COMPLETED for s in states])
        return np.where(solved[:, None], np.array([np.asarray(s.x) for s in states]), np.nan)

    def step(self, state: State, h, noise=None) -> State:
        del noise
        h = jnp.asarray(h, dtype=jnp.float64)
        solved = _fixed_point(self.system, self.method, state, h)
        if not bool(solved.converged):
            solved = self._newton(state, h, int(solved.fixed_point))
        return _conclude(self.system, self.method, state, h, solved)

    # -- Newton's method ------------------------------------------------------------------------------------------

    def _newton(self, state: State, h, before: int) -> Solved:
        k, misfit, scale = _better_start(self.system, self.method, state, h)
        s, renew = Iteration.begin(k), float(h) != self._h
        noise = jnp.zeros(())
        while not self._settled(s, scale, misfit, noise) and int(s.iterations) < PATIENT.newton:
            if renew or self._inverse is None:
                self._inverse, self._h = self._inverted(state, h, s.k), float(h)
                if self._inverse is None:
                    break
            found = self._improved(state, h, s, misfit, scale, self._inverse, PATIENT.halvings if renew else 1)
            if found is None and renew:
                s = s._replace(stalled=jnp.asarray(2))  # no step, however short, solves the equations better
                noise = _noise(self.system, self.method, state.x)
                break
            renew = found is None
            if found is not None:
                s, misfit, scale = found
                renew = bool(s.update > PATIENT.stale * s.previous) and float(s.update) > PATIENT.plateau * float(scale)
            if int(s.stalled) >= 2 and not noise and not bool(s.settled(scale, PATIENT)):
                noise = _noise(self.system, self.method, state.x)
        defined = bool(jnp.isfinite(misfit).all())
        return Solved(
            k=s.k,
            converged=jnp.asarray(self._settled(s, scale, misfit, noise) and defined),
            defined=jnp.asarray(defined),
            residual=s.update,
            fixed_point=jnp.asarray(before),
            newton=s.iterations,
            noise=jnp.where(s.settled(scale, PATIENT), 0.0, noise),
        )

    @staticmethod
    def _settled(s: Iteration, scale, misfit, noise) -> bool:
        return bool(s.settled(scale, PATIENT, jnp.max(jnp.abs(misfit)), noise))

    def _improved(self, state, h, s: Iteration, misfit, scale, inverse: Inverse, attempts: int):
        """After a Newton step, halved until the equations are solved better than before; None if that fails.

        At the rounding plateau they are not, and a whole step is taken.
        """
        step = inverse(np.asarray(misfit).ravel()).reshape(s.k.shape)
        if not np.isfinite(step).all():
            return None
        size = float(jnp.linalg.norm(misfit))
        for _ in range(attempts):
            k = s.k - step
            found, new_scale = _misfit(self.system, self.method, state, h, k)
            new_size = float(jnp.linalg.norm(found))
            rounding = float(np.abs(step).max()) <= PATIENT.plateau * float(scale)
            if new_size < size or (rounding and np.isfinite(new_size)):
                return s.after(k, PATIENT), found, new_scale
            step = 0.5 * step
        return None

    def _inverted(self, state, h, k) -> Inverse | None:
        """The inverse of the Jacobian matrix of the misfit; None where there is none."""
        if self._compression is None:
            self._compression = Compression(self._pattern, self.method.stages)

        def push(seed):
            return _pushed(self.system, self.method, state, h, k, seed)

        def pull(seed):
            return _pulled(self.system, self.method, state, h, k, seed)

        try:
            return Inverse(self._compression.matrix(push, pull), self._compression.width)
        except np.linalg.LinAlgError:
            return None


# -- on the device ----------------------------------------------------------------------------------------------------


@program
def _fixed_point(system: System, method: OneStepMethod, state: State, h) -> Solved:
    return fixed_point(_given(system, method, state, h), PATIENT)


def _given(system: System, method: OneStepMethod, state: State, h) -> Equations:
    return equations(system, method, state.x, state.compensation, h, state.k, state.before, PATIENT)


@program
def _conclude(system: System, method: OneStepMethod, state: State, h, solved: Solved) -> State:
    return conclude(system, method, state, h, solved, PATIENT)


def _equations(system: System, method: OneStepMethod, state: State, h):
    """The misfit ``w (slopes(k) - k)``, a guess of k, and the size that the plateau is measured against.

    With the weights w of :meth:`liethermo.System.weights` a stiff step is nearest to linear.
    """
    slopes, guess, scale, *_ = _given(system, method, state, h)

    def misfit(k):
        middle = state.x + (state.compensation + 0.5 * method.increment(h, k))
        return system.weights(middle) * (slopes(k) - k)

    return misfit, guess, scale


@program
def _misfit(system: System, method: OneStepMethod, state: State, h, k) -> tuple[Any, Any]:
    misfit, _, scale = _equations(system, method, state, h)
    return misfit(k), scale(k)


@program
def _noise(system: System, method: OneStepMethod, x) -> Any:
    """The size at which the misfit is rounded."""
    return jnp.max(with_rounding(lambda x: system.weights(x) * system.vector_field(x), x)[1])


@program
def _better_start(system: System, method: OneStepMethod, state: State, h):
    """The predicted slopes, or a step of size zero where that solves the equations better; with misfit and scale."""
    misfit, guess, scale = _equations(system, method, state, h)
    k, found = better_start(misfit, guess)
    return k, found, scale(k)


@program
def _pushed(system: System, method: OneStepMethod, state: State, h, k, seed):
    misfit = _equations(system, method, state, h)[0]
    return jax.jvp(misfit, (k,), (jnp.asarray(seed),))[1]


@program
def _pulled(system: System, method: OneStepMethod, state: State, h, k, seed):
    misfit = _equations(system, method, state, h)[0]
    return jax.vjp(misfit, k)[1](jnp.asarray(seed))[0]
