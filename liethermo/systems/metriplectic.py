"""Metriplectic systems on R^n with any Poisson structure."""

from __future__ import annotations

from collections.abc import Callable

import manifolds as mf

from ..dissipation import Dissipation
from ..errors import InputError
from .base import System, square_field


class MetriplecticSystem(System):
    """``x' = Pi(x) grad H + K(x) grad S`` on R^n [BFM 2.3].

    Parameters
    ----------
    poisson : manifolds.PoissonStructure, or function from x, shape (n,), to a skew (n, n) matrix, or a constant matrix
    energy, entropy : function from x, shape (n,), to a scalar, or an Energy
    dissipation : Dissipation, optional
    dim : int
        Number of state components; needed where ``poisson`` is a plain function.
    momentum_maps : dict of functions, or a sequence of them
    validate : bool
        Test the axioms at a few random points and refuse a system that fails. Turn off where the functions are not
        defined at normally distributed points, and use ``system.check(points=...)``.

    Raises
    ------
    CasimirError, AxiomError, FunctionError, InputError
    """

    def __init__(
        self,
        poisson: mf.PoissonStructure | Callable,
        energy,
        entropy=None,
        dissipation: Dissipation | None = None,
        dim: int | None = None,
        momentum_maps=(),
        validate: bool = True,
    ):
        if not isinstance(poisson, mf.PoissonStructure):
            poisson = mf.PoissonTensor(poisson, dim)
        if poisson.dim is None:
            raise InputError(
                "the dimension of the state is not known: give dim=n beside a Poisson tensor that is a function"
            )
        if dim is not None and dim != poisson.dim:
            raise InputError(f"dim is {dim}, but the Poisson structure has {poisson.dim} coordinates")
        square_field(poisson.tensor, poisson.dim, "the Poisson tensor")
        self._build(poisson, poisson.dim, energy, entropy, dissipation, momentum_maps, validate)
