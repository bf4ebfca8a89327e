"""Steepest entropy ascent of a density matrix."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..errors import InputError
from ..functions.density import DensityMatrixFunction, positive_part
from ..functions.energy import Energy, Function
from ..functions.frames import OrthonormalFrame, gram_schmidt
from .base import Dissipation
from .checks import RATE_CONDITION, checked_rate
from .operators import Operator, checked_hermitian, get_density_structure


class SteepestEntropyAscent(Dissipation):
    """Steepest entropy ascent of an isolated quantum system [Beretta 1984].

    ``K = rate P^T L P`` with the metric ``L A = (rho A + A rho) / 2`` and P the projector, orthogonal for L, off the
    energy, the trace and the other preserved functions. An eigenvalue of rho that is zero stays zero. So a state keeps
    its rank, and a pure state moves by the Hamiltonian alone. For such states use ``lt.VonNeumann(floor=...)`` and
    ``lt.MetriplecticMidpoint``, which keeps the rank to rounding; other methods keep it to their order. A run does not
    start if the Hamiltonian rotates the eigenvectors of the eigenvalue zero, as for most pure states: the error of a
    step would grow there.

    Parameters
    ----------
    rate : float, >= 0
        The rate gamma of the ascent (1 / time).
    preserve : list of matrices, shape (N, N), or of functions from rho, shape (N, N), to a scalar; optional
        Observables ``tr(rho A)``, or other functions, that are conserved.

    Examples
    --------
    >>> qutrit = lt.QuantumSystem(np.diag([0.0, 1.0, 3.0]), lt.SteepestEntropyAscent(0.5))
    >>> run = lt.integrate(qutrit, qutrit.state(np.diag([0.5, 0.2, 0.3])), (0.0, 40.0), 0.1)
    >>> populations = np.diag(qutrit.density(run.x[-1])).real
    >>> ratios = np.log(populations[:2] / populations[1:]) / [1.0, 2.0]
    >>> bool(abs(ratios[0] - ratios[1]) < 1e-4)  # a Gibbs state
    True
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    functions: tuple[Any, ...]

    def __init__(self, rate=1.0, preserve=()):
        self.rate = checked_rate(rate)
        self.functions = tuple(
            f if callable(f) else Operator(checked_hermitian(f, f"preserve[{i}]")) for i, f in enumerate(preserve)
        )

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return tuple(f for f in self.functions if isinstance(f, Energy))

    def bind_to(self, system):
        get_density_structure(system, "SteepestEntropyAscent")
        return self

    def bind_to_structure(self, structure: mf.DensityMatrices) -> SteepestEntropyAscent:
        """Return this dissipation with its preserved functions made functions of the state vectors of ``structure``."""
        functions = []
        for i, f in enumerate(self.functions):
            if isinstance(f, Operator):
                if np.shape(f) != (structure.size,) * 2:
                    raise InputError(
                        f"preserve[{i}] must have the shape of the Hamiltonian, {(structure.size,) * 2}, "
                        f"got {np.shape(f)}"
                    )
                f = Function(_Observable(jnp.asarray(structure.vector(np.asarray(f)))))
            elif not isinstance(f, Energy):
                f = Function(DensityMatrixFunction(f, structure))
            functions.append(f)
        bound_ascent = SteepestEntropyAscent(self.rate)
        object.__setattr__(bound_ascent, "functions", tuple(functions))
        return bound_ascent

    def force(self, system, x, dH, dS, dL):
        frame, apply_metric = self._constraint_frame_and_metric_map(system, x, dH, dL)
        force = frame.project_off_transposed(apply_metric(frame.project_off(dS[: system.body_dim])))
        return jnp.pad(self.rate * force, (0, system.dim - system.body_dim))

    def ascent_direction(self, system, x, dH, dS, dL) -> jax.Array:
        """Return ``P dS``, shape (N^2,): the gradient of the entropy without its components along preserved ones."""
        frame, _ = self._constraint_frame_and_metric_map(system, x, dH, dL)
        return frame.project_off(dS[: system.body_dim])

    def _constraint_frame_and_metric_map(self, system, x, dH, dL) -> tuple[OrthonormalFrame, Callable]:
        """Return the frame of the preserved gradients, orthonormal in the metric L, and the map that applies L."""
        structure, n = system.structure, system.body_dim
        rho = positive_part(structure.matrix(x[:n]))  # a negative eigenvalue would fall ever faster

        def apply_metric(alpha):  # the Hermitian part of rho A has both terms
            return structure.vector(rho @ structure.matrix(alpha))

        trace_gradient = jnp.asarray(np.where(np.arange(n) < structure.size, 1.0, 0.0))
        return gram_schmidt((trace_gradient, dH[:n], *(L[:n] for L in dL)), metric_map=apply_metric), apply_metric


class _Observable(eqx.Module):
    """The observable ``tr(rho A)`` of a state whose first coordinates are those of rho."""

    coordinates: jax.Array

    def __call__(self, x):
        return jnp.dot(self.coordinates, x[: self.coordinates.shape[0]])
