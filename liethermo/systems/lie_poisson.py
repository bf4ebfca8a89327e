"""Metriplectic systems on the dual of a Lie algebra."""

from __future__ import annotations

import functools
import math
import warnings

import equinox as eqx
import jax.numpy as jnp

import manifolds as mf

from ..dissipation import Dissipation
from ..energy import Energy, as_energy
from ..errors import InputError
from .base import System

RECORDED_MONOMIALS = 400
"""Casimirs are looked for and recorded up to the degree whose monomials number at most this many (a second's work)."""


class LiePoissonSystem(System):
    """``mu' = ad*_{grad H} mu + K grad S`` on g* [BFM 3.1, §3].

    Parameters
    ----------
    algebra : manifolds.LieAlgebra
    energy : function from mu, shape (dim,), to a scalar, or an Energy
    entropy : likewise, optional
        A Casimir function of the algebra (checked).
    dissipation : Dissipation, optional
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points and refuse a system that fails.

    Raises
    ------
    CasimirError
        If the entropy is not a Casimir.
    IndefiniteError, AxiomError, FunctionError, InputError
        If the dissipation or a function does not fit.
    """

    algebra: mf.LieAlgebra = eqx.field(static=True)

    def __init__(
        self,
        algebra: mf.LieAlgebra,
        energy,
        entropy=None,
        dissipation: Dissipation | None = None,
        momentum_maps=(),
        validate: bool = True,
    ):
        if not isinstance(algebra, mf.LieAlgebra):
            raise InputError(f"the algebra must be a manifolds.LieAlgebra, not {type(algebra).__name__}")
        self.algebra = algebra
        self._build(mf.LiePoisson(algebra), algebra.dim, energy, entropy, dissipation, momentum_maps, validate)

    def field(self, x, dH, dS, dL=()):
        """``ad*_dH (x + F) + force``: as for every system, with the forces that are coadjoint actions joined to one."""
        if self.dissipation is None or self.dissipation.momentum(dH, jnp.zeros_like(dH)) is None:
            return super().field(x, dH, dS, dL)
        ad = self.algebra.ad(dH)
        return ad.T @ (x + self.dissipation.momentum(dH, ad @ dS))

    def _casimirs(self) -> dict[str, Energy]:
        return _recorded_casimirs(self.algebra)


@functools.cache
def _recorded_casimirs(algebra: mf.LieAlgebra) -> dict[str, Energy]:
    found: dict[str, Energy] = {}
    count = algebra.casimir_count()
    for degree in range(1, algebra.dim + 1):
        if len(found) >= count or math.comb(algebra.dim + degree - 1, degree) > RECORDED_MONOMIALS:
            break
        with warnings.catch_warnings():  # an algebra without polynomial Casimirs has simply none to record
            warnings.simplefilter("ignore", mf.NoPolynomialCasimirWarning)
            casimirs = algebra.casimirs(degree)
        for i, casimir in enumerate(casimirs):
            text = str(casimir)
            name = text if len(text) <= 60 else f"Casimir {i + 1} of degree {degree}"
            found[name] = as_energy(casimir, "a Casimir")
    return found
