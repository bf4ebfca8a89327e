"""Metriplectic systems on the dual of a Lie algebra."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced

from ..dissipation.base import Dissipation
from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.energy import Energy, make_energy
from ..tracing.caching import memoize
from ..tracing.interpret import evaluate_at_points
from .baths import BathEntropy, HeatBaths
from .body_states import append_bath_entropies, checked_velocity, is_state_given_by_velocity, momentum_of_velocity
from .interface import TORQUE_FREE_LAWS, BodyKinematics, OrbitLevels, TorqueLaws
from .torque import (
    MAX_ARGUMENTS,
    MAX_ARGUMENTS_WITHOUT_ATTITUDE,
    TorqueSystem,
    begins_with_rotations,
    evaluate_torque,
    torque_free_components,
    torque_name,
    traced_torque_and_argument_counts,
)


class LiePoissonSystem(TorqueSystem):
    """A system on the dual of a Lie algebra, such as a rigid body, a spin or a fluid, with dissipation [BFM 3.1, §3].

    The momentum mu moves by ``mu' = ad*_{grad H} mu + K grad S``: along its coadjoint orbit by the energy H, and by the
    dissipation K towards more entropy S.

    On copies of an algebra, ``g ** sites``, a state is an array of shape ``(*sites, g.dim)``, in functions and in
    solutions. Flat states are used by ``lt.Quadratic``, by terms on components (``lt.Each``, ``.on(...)``), by Casimirs
    of the algebra and by matrices of dissipations.

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
        The Lie algebra g. Its structure constants are numbers without a unit.
    energy : function from mu, shape ``algebra.shape``, to a scalar, or an Energy
        H, or a function of mu and t (:class:`liethermo.TimeDependent`). The unit of H over that of mu is 1 / time.
    entropy : function from mu to a scalar, or an Energy; optional
        S, a Casimir function of the algebra (checked), in any unit of entropy, or dimensionless.
    dissipation : Dissipation, or a list of them that act together; optional
        The part of the motion that produces entropy or lowers the energy.
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points and refuse a system that fails.
    group : manifolds.MatrixGroup, optional
        A group of this algebra. If the algebra is a sum with an abelian one, as for a body with internal wheels, the
        group may be that of the first summand. :func:`liethermo.integrate` then returns attitudes g(t) too, with
        ``g' = g hat(xi)``. Here xi is the gradient of H plus the velocity that internal friction adds. The momentum in
        space is ``Ad_star(inverse(g), mu)``, and it is constant if no torque acts.
    reconstruction : {"coadjoint", "cayley", "exp"}, optional
        The map of the attitude. The default conserves the spatial momentum of a free body, if the group has such a
        map; otherwise it is Cayley's map, or ``"exp"``, which stays in every group.
    baths : HeatBaths, optional
        The baths that take the heat of a dissipation that lowers the energy. A state is then mu, in one row, followed
        by the entropies of the baths (energy / temperature), which are zero if they are left out.
    torque : function of (t, mu), (t, mu, attitude) or (t, mu, attitude, velocity), or a list of them; optional
        An external torque, ``mu' = ad*_xi mu + torque``: a dual vector of the shape of mu (energy, if xi is 1 / time).
        ``lt.torques`` has ready ones. The attitude has shape (m, m); the velocity is ``dH/dmu``, for drag. The torque
        does the work W, ``W' = xi . torque``: the energy less W is constant, and Casimirs are not. It must conserve the
        momentum maps. The arrays of an ``equinox.Module`` are parameters, such as ``"torque.moment"``.

    Raises
    ------
    CasimirError, IndefiniteError, AxiomError, FunctionError, InputError, manifolds.LieAlgebraError
        If the entropy is not a Casimir, or the dissipation, a function, the group or its reconstruction does not fit.

    Examples
    --------
    >>> energy = lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0]))
    >>> friction, baths = lt.DoubleBracket(rate=0.08), lt.HeatBaths(capacity=2.0)
    >>> system = lt.LiePoissonSystem(
    ...     mf.so(3), energy, dissipation=friction, baths=baths, group=mf.SO(3)
    ... )
    >>> system.state(angular_velocity=(0.1, 0.2, 0.5)).shape, bool(system.check().passed)
    ((4,), True)
    """

    algebra: mf.LieAlgebra = eqx.field(static=True)
    group: mf.MatrixGroup | None = eqx.field(static=True)
    reconstruction: str | None = eqx.field(static=True)
    torque_argument_counts: tuple[int, ...] = eqx.field(static=True)
    torque_free_components: tuple[int, ...] = eqx.field(static=True)

    @property
    def lie_algebra(self) -> mf.LieAlgebra:
        return self.algebra

    @property
    def matrix_group(self) -> mf.MatrixGroup | None:
        return self.group

    def __init__(
        self,
        algebra: mf.LieAlgebra,
        energy,
        entropy=None,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        momentum_maps=(),
        validate: bool = True,
        group: mf.MatrixGroup | None = None,
        reconstruction: str | None = None,
        baths: HeatBaths | None = None,
        torque=None,
    ):
        if not isinstance(algebra, mf.LieAlgebra):
            raise InputError(f"the algebra must be a manifolds.LieAlgebra, got {type(algebra).__name__}")
        self.algebra = algebra
        self.group, self.reconstruction = group, _resolve_reconstruction(algebra, group, reconstruction)
        self._set_torque(torque)
        poisson = mf.LiePoisson(algebra)
        self._build(poisson, algebra.dim, energy, entropy, dissipation, momentum_maps, validate, baths=baths)

    @property
    def sites(self) -> tuple[int, ...]:
        return () if self.baths.number else self.algebra.shape[:-1]

    def _field_without_torque(self, x, dH, dS, dL):
        # all forces that are coadjoint actions are computed by one action, ad*_dH (x + F)
        if self.total_dissipation.added_momentum(dH, jnp.zeros_like(dH)) is None:
            return super()._field_without_torque(x, dH, dS, dL)
        action = self.algebra.action(dH)
        bracket = jnp.zeros_like(dH) if dS is None else action.bracket(dS)
        return action.ad_star(x + self.total_dissipation.added_momentum(dH, bracket))

    @property
    def inertia(self) -> np.ndarray | None:
        if not _is_body_algebra(self.algebra) or is_traced(self.energy) or self.energy.depends_on_time:
            return None
        energy = self.drop_baths().energy
        return _inertia_tensor(energy, self.algebra.dim) if energy.is_quadratic else None

    @property
    def body_kinematics(self) -> BodyKinematics:
        parts = body_velocity_slices(self.algebra)
        quantities = BodyKinematics(
            {name: lambda x, part=part: self.energy.gradient(x)[part] for name, part in parts.items()}
        )
        if "rotor_rates" not in parts:
            return quantities
        rotors = parts["rotor_rates"]  # if the total momentum is near zero, those of body and rotors cancel
        return quantities._replace(momentum_scale=lambda x: jnp.max(jnp.abs(x[rotors])))

    def state(
        self,
        x=None,
        batch: bool = False,
        *,
        angular_velocity=None,
        rotor_rates=None,
        temperature=None,
        t=None,
        degrees: bool = False,
    ) -> jax.Array:
        """Return ``x`` as a checked state, or the state of a rigid body with a given angular velocity.

        Parameters
        ----------
        x : array, shape (n,), or (..., n) with ``batch``; optional
            A state. InputError if it is none, or if both or neither of it and the angular velocity are given.
        batch, degrees : bool
            Whether leading axes are several states, and whether the rates are in degrees / time.
        angular_velocity : array, shape (3,), or (..., 3) with ``batch``; optional
            Omega in body axes (rad / time), instead of x. The momentum is the one at which ``dH/dmu = (Omega, w)``.
        rotor_rates : array, shape (k,), or (..., k) with ``batch``; optional
            w, the rates of rotors relative to the body (rad / time), or other velocities; zero by default.
        temperature, t : float, or array, shape (baths,), and float; optional
            Temperatures of the baths, by default those at zero entropy, and the time, if the energy depends on it.
        """
        details = {"rotor_rates": rotor_rates, "temperature": temperature, "degrees": degrees or None}
        if not is_state_given_by_velocity(self, x, angular_velocity, "momentum", **details):
            return super().state(x, batch)
        velocity = checked_velocity(angular_velocity, rotor_rates, self.algebra.dim, batch, degrees)
        momentum = self.momentum_of_velocity(velocity, t)
        return super().state(append_bath_entropies(momentum, self.baths, temperature), batch)

    def momentum_of_velocity(self, xi, t=None) -> jax.Array:
        """Return the momentum mu, shape (..., algebra.dim), at which ``dH/dmu`` is xi; t is for an H(mu, t)."""
        energy = self.drop_baths().energy
        if energy.depends_on_time:
            if t is None:
                raise InputError("the energy depends on time, so the state needs its time t=")
            energy = energy.at_time(t)
        return momentum_of_velocity(energy, jnp.asarray(xi))

    # -- the torque -----------------------------------------------------------------------------------------------

    def bind_attitude(self, attitude) -> LiePoissonSystem:
        """Return the system itself, because without a clock the attitude of its torque is frozen already."""
        return self

    def _set_torque(self, torque) -> None:
        """Set the fields of the torque; the algebra and the group must be set before."""
        self.torque, self.torque_argument_counts = traced_torque_and_argument_counts(torque, self.algebra, self.group)
        self.torque_free_components = ()
        if torque is not None:
            model = self.torque, self.torque_argument_counts
            self.torque_free_components = torque_free_components(*model, self.algebra, self.group)
        self.torque_arguments = None

    @property
    def torque_laws(self) -> TorqueLaws:
        if self.torque is None:
            return TORQUE_FREE_LAWS
        n_momenta = self.algebra.dim if self.group is None else self.group.dim
        torque_free_components, names = self.torque_free_components, self.algebra.basis_names
        takes_attitude = max(self.torque_argument_counts) > MAX_ARGUMENTS_WITHOUT_ATTITUDE
        return TorqueLaws(
            torque_name(self.torque),
            has_impulse=not set(range(n_momenta)) <= set(torque_free_components),
            needs_attitude=takes_attitude and not self.has_fixed_attitude,
            changed_casimirs=frozenset(self.momentum_casimirs())
            - _names_of_casimirs_depending_only_on(self.algebra, names, torque_free_components),
        )

    def _torque_at(self, x, t, attitude):
        if attitude is not None:  # without it XLA crashes on products of many such matrices with vectors
            attitude = jax.lax.optimization_barrier(attitude)
        n = self.algebra.dim
        mu, counts = x[:n].reshape(self.algebra.shape), self.torque_argument_counts
        needs_velocity = max(counts) == MAX_ARGUMENTS
        velocity = self.energy.gradient(x)[:n].reshape(self.algebra.shape) if needs_velocity else None
        return evaluate_torque(self.torque, counts, t, mu, attitude, velocity).ravel()

    @property
    def entropy_law(self):
        """Law of the entropy; None if a torque acts on momenta that the entropy depends on."""
        law = super().entropy_law
        return law if self.torque is None or isinstance(self.entropy, BathEntropy) else None

    def casimirs(self) -> dict[str, Energy]:
        casimirs = self.momentum_casimirs()
        return {name: C.on(range(self.body_dim)) for name, C in casimirs.items()} if self.baths.number else casimirs

    def momentum_casimirs(self) -> dict[str, Energy]:
        """Return the known Casimirs, by name, as functions of mu without baths."""
        return _leading_casimirs(self.algebra, self.algebra.basis_names)

    @property
    def orbit_levels(self) -> OrbitLevels:
        n_momenta, casimirs, _ = super().orbit_levels
        if self.group is not None:
            n_momenta = self.group.dim
            casimirs = _names_of_casimirs_depending_on_first(self.algebra, self.algebra.basis_names, n_momenta)
        return OrbitLevels(n_momenta, casimirs, _are_all_casimirs_known(self.algebra))


def _resolve_reconstruction(algebra: mf.LieAlgebra, group, reconstruction: str | None) -> str | None:
    """Return the checked name of a reconstruction, by default the best for the group; None without a group."""
    if group is None:
        if reconstruction is not None:
            raise InputError("reconstruction= needs group=, for example manifolds.SO(3)")
        return None
    if not isinstance(group, mf.MatrixGroup):
        raise InputError(f"the group must be a manifolds.MatrixGroup such as SO(3), got {type(group).__name__}")
    if not _extends_algebra(group.algebra, algebra):
        raise InputError(f"{group.name} is not a group of {algebra.name}: the structure constants differ")
    if reconstruction is None:
        reconstruction = _default_reconstruction(group)
    if reconstruction not in _RECONSTRUCTION_MAPS:
        choices = ", ".join(map(repr, _RECONSTRUCTION_MAPS))
        raise InputError(f"the reconstruction must be one of {choices}, got {reconstruction!r}")
    group._require_map(_RECONSTRUCTION_MAPS[reconstruction])
    return reconstruction


def _extends_algebra(group_algebra: mf.LieAlgebra, algebra: mf.LieAlgebra) -> bool:
    """Return whether ``algebra`` equals ``group_algebra``, or its direct sum with an abelian algebra."""
    n, n_internal = group_algebra.dim, algebra.dim - group_algebra.dim
    if n_internal < 0 or (n_internal > 0 and (len(algebra.shape) != 1 or algebra.dim > MAX_BODY_DIM)):
        return False
    if n_internal == 0 and algebra.shape != group_algebra.shape:
        return False
    C = np.zeros((algebra.dim,) * 3)
    C[:n, :n, :n] = group_algebra.structure_constants
    return np.allclose(algebra.structure_constants, C, rtol=0.0, atol=1e-12)


_RECONSTRUCTION_MAPS = {"coadjoint": "adjoint_cayley", "cayley": "cayley", "exp": "exp"}
"""Map from the algebra to the group that each reconstruction uses."""


def _default_reconstruction(group: mf.MatrixGroup) -> str:
    """Return the reconstruction that conserves spatial momenta, or else the cheapest that stays in the group."""
    if group.cayley_is_adjoint():
        return "cayley"
    return next(kind for kind, map_ in _RECONSTRUCTION_MAPS.items() if kind == "exp" or group._has_map_into_group(map_))


@memoize
def _inertia_tensor(energy: Energy, dim: int) -> np.ndarray | None:
    """Return the tensor of inertia, shape (3, 3), of a quadratic energy; None if it is not a kinetic energy."""
    (gradient,), (hessian,) = evaluate_at_points(_gradient_and_hessian, energy, np.zeros((1, dim)))
    if np.linalg.eigvalsh(hessian)[0] <= 0.0 or gradient.any():
        return None
    inertia = np.linalg.inv(hessian)[:3, :3]
    inertia.flags.writeable = False  # the result is cached
    return inertia


def _gradient_and_hessian(energy: Energy, x) -> tuple[jax.Array, jax.Array]:
    """Return the gradient, shape (n,), and the Hessian, shape (n, n), of an energy at x."""
    return energy.gradient(x), jax.jacfwd(energy.gradient)(x)


@functools.lru_cache(maxsize=64)
@functools.lru_cache(maxsize=64)
def body_velocity_slices(algebra: mf.LieAlgebra) -> Mapping[str, slice]:
    """Return slices of a velocity for ``angular_velocity`` and ``rotor_rates``, by name; {} if it is no body."""
    if not begins_with_rotations(algebra):
        return {}
    has_rotors = algebra.dim > 3 and _is_body_algebra(algebra)
    return {"angular_velocity": slice(3)} | ({"rotor_rates": slice(3, algebra.dim)} if has_rotors else {})


def _is_body_algebra(algebra: mf.LieAlgebra) -> bool:
    """Return whether the algebra is so(3), or its direct sum with an abelian algebra of internal parts."""
    return algebra.dim >= 3 and _extends_algebra(mf.so(3), algebra)


MAX_BODY_DIM = 64
"""Largest number of momenta of a body with internal parts."""


@functools.lru_cache(maxsize=64)
def _leading_casimirs(algebra: mf.LieAlgebra, basis_names: tuple[str, ...] | None) -> dict[str, Energy]:
    """Return, by name, the Casimirs of an algebra that are of low degree and quick to evaluate, as energies."""
    del basis_names  # a key of the cache: equal algebras may differ in the names with which their Casimirs print
    casimirs: dict[str, Energy] = {}
    with jax.ensure_compile_time_eval():  # the cache outlives any trace
        for name, casimir in algebra.leading_casimirs():
            function = checked_energy(make_energy(casimir, "a Casimir"), algebra.dim, "a Casimir")
            casimirs[name] = with_polynomial_degrees(function, algebra.dim)
    return casimirs


@functools.lru_cache(maxsize=64)
def _names_of_casimirs_depending_on_first(
    algebra: mf.LieAlgebra, basis_names: tuple[str, ...] | None, n: int
) -> frozenset[str]:
    """Return the names of the Casimirs that depend on the first n components of a momentum."""
    x = np.random.default_rng(0).standard_normal(algebra.dim)
    with jax.ensure_compile_time_eval():
        casimirs = _leading_casimirs(algebra, basis_names).items()
        return frozenset(name for name, C in casimirs if bool(C.gradient(jnp.asarray(x))[:n].any()))


@functools.lru_cache(maxsize=64)
def _names_of_casimirs_depending_only_on(
    algebra: mf.LieAlgebra, basis_names: tuple[str, ...] | None, indices: tuple[int, ...]
) -> frozenset[str]:
    """Return the names of the Casimirs that depend on no components except those with the given indices."""
    x, complement = np.random.default_rng(0).standard_normal(algebra.dim), np.delete(np.arange(algebra.dim), indices)
    with jax.ensure_compile_time_eval():
        casimirs = _leading_casimirs(algebra, basis_names).items()
        return frozenset(name for name, C in casimirs if not bool(C.gradient(jnp.asarray(x))[complement].any()))


@functools.lru_cache(maxsize=64)
def _are_all_casimirs_known(algebra: mf.LieAlgebra) -> bool:
    """Return whether the gradients of the known Casimirs span the kernel of the Poisson tensor at a random point."""
    casimirs = _leading_casimirs(algebra, algebra.basis_names).values()
    x = np.random.default_rng(0).standard_normal(algebra.dim)
    if not casimirs or len(casimirs) < algebra.casimir_count():
        return False
    with jax.ensure_compile_time_eval():
        gradients = np.array([C.gradient(jnp.asarray(x)) for C in casimirs])
    lengths = np.linalg.norm(gradients, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(gradients / lengths, tol=1e-9)) == algebra.casimir_count()
