"""What every system has in common: ``x' = Pi(x) dH + force(x; dH, dS)`` and the laws that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import manifolds as mf
from manifolds._arrays import real_array

from ..dissipation import Dissipation, Law
from ..energy import Energy, as_energy, check_scalar, is_traced, on_points, recognised, traced_energies
from ..engine.interpret import at_points
from ..engine.traced import settled
from ..errors import AxiomError, CasimirError, FunctionError, InputError
from .check import AXIOM_TOLERANCE, CheckReport, check_system


class System(eqx.Module):
    """A metriplectic system on R^n or on a manifold [BFM §2.3]; see the subclasses for how to build one.

    On a manifold states, covectors and velocities are the arrays of the space, flat and real
    (``space.to_vector``): covectors act on tangent vectors alone, and velocities are tangent.

    A system is a pytree: its parameters (those of ``lt.Quadratic``, the rates, the arrays of ``equinox`` modules
    used as functions) are leaves, which can be swept, batched and differentiated.

    Attributes
    ----------
    poisson : manifolds.PoissonStructure
    energy, entropy : Energy
        Callable on states of shape (..., n). ``entropy`` is None for a system without one.
    dissipation : Dissipation or None
    momentum_maps : dict of Energy
        Further functions that are claimed to be conserved, by name.
    dim : int
        Number of state components.
    space : manifolds.Space or None
        The state space, where it is not R^n.
    """

    poisson: mf.PoissonStructure
    energy: Energy
    entropy: Energy | None
    dissipation: Dissipation | None
    momentum_maps: dict[str, Energy]
    dim: int = eqx.field(static=True)
    space: mf.Space | None = eqx.field(static=True)

    production_name: ClassVar[str] = "dS/dt"
    domain: ClassVar[str] = ""
    """What a state of the system has to have beyond finite components, in words."""

    def _build(self, poisson, dim, energy, entropy, dissipation, momentum_maps, validate, space=None) -> None:
        """Shared by the constructors of the subclasses, after they have set what is their own."""
        self.dim, self.space = dim, space
        self.poisson = settled(poisson, lambda poisson, x: poisson.sharp(x, x), (dim,))
        self.energy = check_scalar(on_points(as_energy(energy, "the energy"), space), dim, "the energy")
        self.entropy = None
        if entropy is not None:
            self.entropy = check_scalar(on_points(as_energy(entropy, "the entropy"), space), dim, "the entropy")
        if not isinstance(momentum_maps, Mapping):
            momentum_maps = {getattr(J, "__name__", f"J{i + 1}"): J for i, J in enumerate(momentum_maps)}
        roles = {name: f"momentum map {name!r}" for name in momentum_maps}
        self.momentum_maps = {
            name: check_scalar(on_points(as_energy(J, roles[name]), space), dim, roles[name])
            for name, J in momentum_maps.items()
        }
        if space is None:  # in a chart no function is quadratic
            self.energy = recognised(self.energy, dim)
            self.entropy = None if self.entropy is None else recognised(self.entropy, dim)
        if dissipation is not None and not isinstance(dissipation, Dissipation):
            raise InputError(
                f"dissipation must be a Dissipation of this library or None, not {type(dissipation).__name__}"
            )
        if dissipation is not None and self.entropy is None and dissipation.needs_entropy:
            raise InputError(f"{type(dissipation).__name__} drives the entropy up, so the system needs an entropy")
        self.dissipation = None
        if dissipation is not None:
            dissipation = traced_energies(dissipation, dim, "a preserved function")
            self.dissipation = self._traced_dissipation(dissipation.prepared(self))
        if validate and not is_traced(self):
            self._validate()

    def _traced_dissipation(self, dissipation: Dissipation) -> Dissipation:
        """The dissipation with its plain functions traced for the arguments that its force gives them."""

        def force(dissipation, x):
            return dissipation.force(self, x, x, x, (x,) * len(dissipation.preserve))

        return settled(dissipation, force, (self.dim,), is_leaf=lambda part: isinstance(part, Energy))

    @property
    def unrollable(self) -> bool:
        """Whether the compiled engine is worth trying: False where the system is known to need a loop."""
        return self.space is None or (self.space.smooth and self.space.dtype.kind != "c")

    @property
    def smooth(self) -> bool:
        """Whether the vector field can be differentiated twice and more."""
        return self.space is None or self.space.smooth

    def sparsity(self) -> scipy.sparse.csr_array | None:
        """Which components of the field depend on which of the state, discrete gradients included; None if not known.

        A pattern, shape (n, n). Large systems that know it are solved by sparse Newton iteration.
        """
        return None

    def weights(self, x) -> jax.Array:
        """Factors of the components of the field, at a state, in which it depends on the state most nearly linearly.

        Newton's method is applied to the equations of a stiff step multiplied by these, shape (n,).
        """
        return jnp.ones_like(x)

    # -- dynamics -------------------------------------------------------------------------------------------------

    def field(self, x, dH, dS, dL=()) -> jax.Array:
        """``Pi(x) dH + force(x; dH, dS, dL)``, shape (n,), for gradients continuous or discrete.

        This is the one definition of the dynamics; integrators differ in the gradients they hand it.
        """
        motion = self.poisson.sharp(x, dH)
        return motion if self.dissipation is None else motion + self.dissipation.force(self, x, dH, dS, dL)

    def vector_field(self, x) -> jax.Array:
        """``x'`` at a state or a batch of states, shape (..., n)."""
        x = self.state(x, batch=True)
        return jnp.vectorize(self._vector_field, signature="(n)->(n)")(x)

    def entropy_production(self, x) -> jax.Array:
        """The rate of growth of the entropy, ``grad S @ x'``, shape (...)."""
        entropy = self._needed_entropy()
        return jnp.vectorize(lambda y: jnp.dot(entropy.gradient(y), self._vector_field(y)), signature="(n)->()")(
            self.state(x, batch=True)
        )

    def friction_matrix(self, x) -> jax.Array:
        """The matrix K(x) of the symmetric bracket, shape (n, n), where the force is ``K(x) grad S``."""
        x = self.state(x)
        if self.dissipation is None:
            return jnp.zeros((self.dim, self.dim))
        force, dH, dL = self.dissipation.force, self.energy.gradient(x), self._preserved_gradients(x)
        return jax.jacfwd(lambda dS: force(self, x, dH, dS, dL))(jnp.zeros(self.dim))

    # -- the manifold ---------------------------------------------------------------------------------------------

    def points(self, x) -> jax.Array:
        """State vectors, shape (..., n), as points of the space, shape ``(..., *space.shape)``."""
        return jnp.asarray(x) if self.space is None else self.space.from_vector(x)

    def raised(self, x, alpha) -> jax.Array:
        """The tangent vector that the metric of the space makes of a covector, shape (n,); itself on R^n."""
        if self.space is None:
            return alpha
        return self.space.to_vector(self.space._sharp(self.points(x), self.points(alpha).conj()))

    def lowered(self, x, v) -> jax.Array:
        """The covector that the metric of the space makes of a tangent vector: the inverse of :meth:`raised`."""
        if self.space is None:
            return v
        return self.space.to_vector(self.space._flat(self.points(x), self.points(v)).conj())

    def tangent(self, x, w) -> jax.Array:
        """The tangent vector nearest to an array, shape (n,); itself on R^n."""
        if self.space is None:
            return w
        return self.space.to_vector(self.space._project_tangent(self.points(x), self.points(w)))

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Random states, shape (count, n): normal with standard deviation ``scale``, or the space's own points."""
        if self.space is None:
            return scale * np.random.default_rng(seed).standard_normal((count, self.dim))
        return np.asarray(self.space.to_vector(self.space.random(seed, (count,))))

    def local(self, x, centred: bool = False) -> tuple[System, jax.Array]:
        """This system near a state in as many coordinates as it has dimensions, and those of the state.

        With ``centred``, for use at that state alone.
        """
        return self, x

    def presented(self, solution: Any) -> Any:
        """A solution of this system, as its user is to see it."""
        return solution

    def here(self, x) -> System:
        """The same system, for use at one state: what its Pi and K have in common there is computed once."""
        return self

    @property
    def preserved(self) -> tuple[Energy, ...]:
        """The functions that the dissipation is told to preserve besides the energy."""
        return () if self.dissipation is None else self.dissipation.preserve

    @property
    def energy_law(self) -> Law | None:
        """ "conserved", "nonincreasing" under double-bracket dissipation, or None where there is no guarantee."""
        return "conserved" if self.dissipation is None else self.dissipation.energy_law

    @property
    def entropy_law(self) -> Law | None:
        """ "nondecreasing", "conserved", or None where there is no entropy or no guarantee."""
        if self.entropy is None:
            return None
        return "conserved" if self.dissipation is None else self.dissipation.entropy_law

    def invariants(self) -> dict[str, tuple[Energy, bool]]:
        """Further functions worth recording along a run, by name, each with whether the system conserves it.

        Momentum maps are claimed to be conserved. What the dissipation preserves is a constant only if the motion keeps
        it too, and a Casimir only if the dissipation does: that is found out at random points.
        """
        found = {f"preserved {i + 1}": L for i, L in enumerate(self.preserved)} | self._casimirs()
        constant = self.conserves(tuple(found.values()))
        claimed = {name: (J, True) for name, J in self.momentum_maps.items()}
        return claimed | {name: (f, kept) for (name, f), kept in zip(found.items(), constant, strict=True)}

    def conserves(self, functions: tuple[Energy, ...]) -> list[bool]:
        """Whether each function is constant along the vector field, at random points inside its domain."""
        if not functions:
            return []
        points = self.samples(8)
        rates, sizes = at_points(_rates_of_change, (self, functions), points)
        inside = np.isfinite(rates)
        return [
            bool(use.any() and (np.abs(rate) <= AXIOM_TOLERANCE * size)[use].all())
            for rate, size, use in zip(rates.T, sizes.T, inside.T, strict=True)
        ]

    @property
    def ledger(self) -> dict[str, Energy]:
        """What the system receives from outside, recorded along a run, by name."""
        return {}

    def _casimirs(self) -> dict[str, Energy]:
        """Casimirs of the Poisson structure worth recording."""
        return {}

    # -- checks ---------------------------------------------------------------------------------------------------

    def state(self, x, batch: bool = False) -> jax.Array:
        """``x`` as a state of this system: real doubles, finite, shape (n,), or (..., n) with ``batch``.

        On a manifold it may have the shape of points too, and has to be one.

        Raises
        ------
        InputError, manifolds.OffManifoldError
        """
        if not isinstance(x, jax.Array):
            try:
                x = np.asarray(x)
            except (TypeError, ValueError) as error:
                raise InputError(f"a state is a rectangular array of real numbers: {error}") from None
            if x.dtype.kind not in "fiubc":
                raise InputError(f"a state is an array of real numbers, not of {x.dtype}")
        if self.space is not None and x.shape[-len(self.space.shape) :] == self.space.shape:
            x = self.space.to_vector(x)
        if jnp.iscomplexobj(x):
            raise InputError(f"a state is real, not {x.dtype}; take the real part if that is meant")
        if x.shape[-1:] != (self.dim,) or (x.ndim > 1 and not batch):
            expected = f"(..., {self.dim})" if batch else f"({self.dim},)"
            raise InputError(f"a state of this system has shape {expected}, not {x.shape}")
        if isinstance(x, jax.core.Tracer):
            return x.astype(jnp.float64)
        numbers = np.asarray(x)
        if not np.isfinite(numbers).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
            raise InputError(f"the state is not finite: component {where} is {numbers[where]}")
        if self.space is not None:
            self.space.point(self.points(numbers))
        return real_array(x)

    def check(self, points=None, samples: int = 16, seed: int = 0, scale: float = 1.0) -> CheckReport:
        """Test the axioms of a metriplectic system at given or random points; the report prints as a table.

        Parameters
        ----------
        points : array, shape (m, n), optional
            Where to test. By default ``samples`` normally distributed points of standard deviation ``scale``.
        samples, seed, scale
            Of the random points.

        Returns
        -------
        CheckReport
            ``.passed``, ``.rows`` (axiom, residual, tolerance, passed, note).
        """
        return check_system(self, points, samples, seed, scale)

    def outside(self, x) -> str:
        """Why a state lies outside the domain of the system, in words; empty where it does not."""
        del x
        return ""

    def own_residuals(self, x) -> dict[str, jax.Array]:
        """Residuals at x of axioms that only this kind of system has, relative to what cancels, by their names."""
        del x
        return {}

    def _validate(self) -> None:
        """Raise where an axiom fails at random points: called by the constructors, so that no bad system exists."""
        for row in check_system(self, None, 4, 0, 1.0).rows:
            if row.passed is not False:
                continue
            kind = CasimirError if row.axiom == "Pi grad S = 0" else AxiomError
            raise kind(
                f"{row.axiom} fails: residual {row.residual:.3g}, tolerance {row.tolerance:.1g}. {row.note}".rstrip()
                + " (validate=False builds the system all the same)",
                residual=row.residual,
                tolerance=row.tolerance,
            )

    def _vector_field(self, x) -> jax.Array:
        dS = jnp.zeros_like(x) if self.entropy is None else self.entropy.gradient(x)
        gradients = self.energy.gradient(x), dS, *self._preserved_gradients(x)
        dH, dS, *dL = (alpha if self.space is None else self.lowered(x, self.raised(x, alpha)) for alpha in gradients)
        return self.field(x, dH, dS, tuple(dL))

    def _preserved_gradients(self, x) -> tuple[jax.Array, ...]:
        return tuple(L.gradient(x) for L in self.preserved)

    def _needed_entropy(self) -> Energy:
        if self.entropy is None:
            raise InputError("this system has no entropy")
        return self.entropy


def _rates_of_change(model: tuple[System, tuple[Energy, ...]], x):
    """The rate of change of each function along the vector field, and the size of what cancels in it."""
    system, functions = model
    velocity, gradients = system.vector_field(x), jnp.stack([f.gradient(x) for f in functions])
    speed = jnp.linalg.norm(velocity)
    speed += jnp.linalg.norm(system.poisson.tensor(x) @ jnp.abs(system.energy.gradient(x)))
    return gradients @ velocity, jnp.linalg.norm(gradients, axis=1) * speed


def square_field(function: Callable, dim: int, what: str) -> None:
    """Raise unless ``function`` maps a state to a (dim, dim) matrix."""
    try:
        shape = jax.eval_shape(lambda x: jnp.asarray(function(x)), jax.ShapeDtypeStruct((dim,), jnp.float64)).shape
    except (TypeError, ValueError, IndexError) as error:
        raise FunctionError(f"{what} could not be evaluated on a state of shape ({dim},): {error}") from error
    if shape != (dim, dim):
        raise FunctionError(f"{what} must return a ({dim}, {dim}) matrix, but it returns shape {shape}")


__all__ = ["AXIOM_TOLERANCE", "System", "square_field"]
