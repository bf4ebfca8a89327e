"""Metriplectic systems on the dual of a Lie algebra."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced

from ..dissipation.base import Dissipation
from ..errors import InputError
from ..functions.checks import check_scalar, recognised
from ..functions.energy import Energy, as_energy
from .base import System
from .baths import HeatBaths


class LiePoissonSystem(System):
    """``mu' = ad*_{grad H} mu + K grad S`` on g* [BFM 3.1, §3].

    On copies of an algebra, ``g ** sites``, a state is an array of shape ``(*sites, g.dim)``: so functions are handed
    it, and so solutions have it. What is written for components in one row stays so: ``lt.Quadratic``, terms on
    components (``lt.Each``, ``.on(...)``), Casimirs of the algebra and matrices of dissipations.

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
    energy : function from mu, shape ``algebra.shape``, to a scalar, or an Energy
        Or of mu and the time t: see :class:`liethermo.TimeDependent`.
    entropy : likewise, optional
        A Casimir function of the algebra (checked).
    dissipation : Dissipation, or a list of them that act together; optional
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points and refuse a system that fails.
    group : manifolds.MatrixGroup, optional
        A group of this algebra, or of the summand that it begins with where the other is abelian, as of a body with
        wheels inside: :func:`liethermo.integrate` then returns attitudes g(t) beside mu(t), with
        ``g' = g hat(xi)``. There xi is :meth:`transport`: the gradient of H, and what friction inside adds to it. It
        is the body's, so that the momentum in space is ``Ad_star(inverse(g), mu)``, constant where no torque acts.
    reconstruction : {"coadjoint", "cayley", "exp"}, optional
        How; by default so that the spatial momentum of a free body is kept, where the group has such a way, else by
        Cayley's map where that stays in the group. See :class:`liethermo.WithAttitude`.
    baths : HeatBaths, optional
        What takes the heat of a dissipation that lowers the energy. A state is then mu, in one row, followed by the
        entropies of the baths; mu alone stands for one with all of these zero.

    Raises
    ------
    CasimirError
        If the entropy is not a Casimir.
    IndefiniteError, AxiomError, FunctionError, InputError
        If the dissipation, a function or the group does not fit.
    manifolds.LieAlgebraError
        If the reconstruction asked for leaves the group.
    """

    algebra: mf.LieAlgebra = eqx.field(static=True)
    group: mf.MatrixGroup | None = eqx.field(static=True)
    reconstruction: str | None = eqx.field(static=True)

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
    ):
        if not isinstance(algebra, mf.LieAlgebra):
            raise InputError(f"the algebra must be a manifolds.LieAlgebra, not {type(algebra).__name__}")
        self.algebra = algebra
        self.group, self.reconstruction = group, _checked_reconstruction(algebra, group, reconstruction)
        poisson = mf.LiePoisson(algebra)
        self._build(poisson, algebra.dim, energy, entropy, dissipation, momentum_maps, validate, baths=baths)
        if group is not None and self.is_driven:
            raise InputError("attitudes are reconstructed for energies that do not depend on time: leave out the group")

    @property
    def sites(self) -> tuple[int, ...]:
        return () if self.baths is not None else self.algebra.shape[:-1]

    def field(self, x, dH, dS, dL=()):
        """``ad*_dH (x + F) + force``: as for every system, with the forces that are coadjoint actions joined to one."""
        if self.dissipation is None or self.dissipation.momentum(dH, jnp.zeros_like(dH)) is None:
            return super().field(x, dH, dS, dL)
        action = self.algebra.action(dH)
        turned = jnp.zeros_like(dH) if dS is None else action.bracket(dS)
        return action.ad_star(x + self.dissipation.momentum(dH, turned))

    @property
    def inertia(self) -> np.ndarray | None:
        if not _of_a_body(self.algebra) or is_traced(self.energy) or self.is_driven:
            return None
        energy = self.without_baths().energy
        if not energy.is_quadratic:
            return None
        still = jnp.zeros(self.algebra.dim)
        squares = np.asarray(jax.jacfwd(energy.gradient)(still))  # its inverse is that of the parts moving freely
        if np.linalg.eigvalsh(squares)[0] <= 0.0 or np.asarray(energy.gradient(still)).any():
            return None
        return np.linalg.inv(squares)[:3, :3]

    def casimirs(self) -> dict[str, Energy]:
        found = _recorded_casimirs(self.algebra, self.algebra.basis_names)
        return found if self.baths is None else {name: self._of_body(C) for name, C in found.items()}

    @property
    def has_all_casimirs(self) -> bool:
        return _spans_all_casimirs(self.algebra)


def _checked_reconstruction(algebra: mf.LieAlgebra, group, reconstruction: str | None) -> str | None:
    """The way to reconstruct attitudes in a group of the algebra; None without a group."""
    if group is None:
        if reconstruction is not None:
            raise InputError("a reconstruction needs a group to live in: give group=..., such as manifolds.SO(3)")
        return None
    if not isinstance(group, mf.MatrixGroup):
        raise InputError(f"the group must be a manifolds.MatrixGroup such as SO(3), not {type(group).__name__}")
    if not _acts(group.algebra, algebra):
        raise InputError(f"{group.name} is not a group of {algebra.name}: the structure constants differ")
    if reconstruction is None:
        reconstruction = _best_reconstruction(group)
    if reconstruction not in _MAPS:
        raise InputError(f"the reconstruction is {', '.join(map(repr, _MAPS))}, not {reconstruction!r}")
    group._need(_MAPS[reconstruction])
    return reconstruction


def _acts(own: mf.LieAlgebra, algebra: mf.LieAlgebra) -> bool:
    """Whether an algebra is a group's own, or the sum of that and an abelian one: of parts that turn inside a body."""
    n, more = own.dim, algebra.dim - own.dim
    if more < 0 or (more > 0 and (len(algebra.shape) != 1 or algebra.dim > LARGEST_BODY)):
        return False
    if more == 0 and algebra.shape != own.shape:
        return False
    C = np.zeros((algebra.dim,) * 3)
    C[:n, :n, :n] = own.structure_constants
    return np.allclose(algebra.structure_constants, C, rtol=0.0, atol=1e-12)


_MAPS = {"coadjoint": "adjoint_cayley", "cayley": "cayley", "exp": "exp"}
"""The map from the algebra to the group that a reconstruction takes its steps by."""


def _best_reconstruction(group: mf.MatrixGroup) -> str:
    """The one that keeps spatial momenta; else the cheapest that stays in the group."""
    if group.cayley_is_adjoint():
        return "cayley"
    return next(kind for kind, map_ in _MAPS.items() if kind == "exp" or group._stays(map_))


@functools.lru_cache(maxsize=64)
def _of_a_body(algebra: mf.LieAlgebra) -> bool:
    """Whether the algebra is so(3), or its sum with an abelian one: that of parts that turn inside a body."""
    return algebra.dim >= 3 and _acts(mf.so(3), algebra)


LARGEST_BODY = 64
"""Components of the momentum of a body with parts inside, at most."""


@functools.lru_cache(maxsize=64)
def _recorded_casimirs(algebra: mf.LieAlgebra, names: tuple[str, ...] | None) -> dict[str, Energy]:
    del names  # equal algebras may differ in the names of their basis elements, and their Casimirs print with those
    found: dict[str, Energy] = {}
    with jax.ensure_compile_time_eval():  # what is found while something is traced is kept for later
        for name, casimir in algebra.leading_casimirs():
            function = check_scalar(as_energy(casimir, "a Casimir"), algebra.dim, "a Casimir")
            found[name] = recognised(function, algebra.dim)
    return found


@functools.lru_cache(maxsize=64)
def _spans_all_casimirs(algebra: mf.LieAlgebra) -> bool:
    """Whether the gradients of the recorded Casimirs span the kernel of the Poisson tensor at a random point."""
    found, x = (
        _recorded_casimirs(algebra, algebra.basis_names).values(),
        np.random.default_rng(0).standard_normal(algebra.dim),
    )
    if not found or len(found) < algebra.casimir_count():
        return False
    with jax.ensure_compile_time_eval():
        gradients = np.array([C.gradient(jnp.asarray(x)) for C in found])
    lengths = np.linalg.norm(gradients, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(gradients / lengths, tol=1e-9)) == algebra.casimir_count()
