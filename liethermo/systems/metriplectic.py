"""Metriplectic systems on R^n, or on a manifold, with any Poisson structure."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

import manifolds as mf

from ..dissipation.base import Dissipation
from ..errors import InputError
from ..functions.checks import traced_function_and_shape
from .base import System
from .baths import HeatBaths
from .check import MAX_MATRIX_DIM
from .embedded import ChartSystem, EmbeddedSystem


class MetriplecticSystem(System):
    """The most general metriplectic system, with any Poisson structure on R^n or on a manifold [BFM 2.3, §4.4].

    The state moves by ``x' = Pi(x) grad H + K(x) grad S``, with a Poisson tensor Pi and a friction matrix K.

    Parameters
    ----------
    poisson : manifolds.PoissonStructure, or function from x, shape (n,), to a skew (n, n) matrix, or a constant matrix
        Pi. The unit of ``Pi[i, j]`` is that of ``x[i] x[j]`` over energy * time. None means no conservative motion.
    energy, entropy : function from x, shape (n,), to a scalar, or an Energy
        H and S, in any consistent units; they fix the units of the system. The energy may be a function of x and the
        time t: see :class:`liethermo.TimeDependent`.
    dissipation : Dissipation, or a list of them that act together; optional
        The part of the motion that produces entropy or lowers the energy.
    dim : int
        Number of state components; needed if ``poisson`` is a plain function or None, and there is no space.
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points and refuse a system that fails. Turn this off if the functions are not
        defined at normally distributed points, and use ``system.check(points=...)``.
    space : manifolds.Space or manifolds.MatrixGroup, optional
        The manifold of the states: native, a product, or from ``manifolds.from_geomstats``. A group means
        ``manifolds.GroupSpace(group)``. Energy, entropy and momentum maps are then functions of points, shape
        ``(*space.shape)``. Their gradients may be those of the ambient array: only their action on tangent vectors
        matters. Poisson structures and dissipations get flat real arrays, shape (space.size,), as ``space.to_vector``
        makes them: a state x, and covectors that Pi(x) and K(x) map to tangent vectors.
    baths : HeatBaths, optional
        The baths that take the heat of a dissipation that lowers the energy (energy of H, entropies in energy /
        temperature). A state is then x, in one row, followed by the entropies of the baths; ``dim`` counts x alone. If
        the entropies are left out of a state, they are zero.

    Raises
    ------
    CasimirError, AxiomError, FunctionError, InputError

    Examples
    --------
    A particle in a potential, whose friction heats a bath of entropy ``x[2]``:

    >>> system = lt.MetriplecticSystem(
    ...     poisson=np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    ...     energy=lambda x: 0.5 * x[1] ** 2 + 1.0 - jnp.cos(x[0]) + jnp.exp(x[2]),
    ...     entropy=lambda x: x[2],
    ...     dissipation=lt.ProjectedMetric(np.diag([0.0, 1.0, 1.0])),
    ... )
    >>> lt.integrate(system, [1.0, 0.0, 0.0], (0.0, 10.0), 0.05).audit().passed
    True
    """

    def __init__(
        self,
        poisson: mf.PoissonStructure | Callable | None,
        energy,
        entropy=None,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        dim: int | None = None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | mf.MatrixGroup | None = None,
        baths: HeatBaths | None = None,
    ):
        if space is not None:
            space = mf.GroupSpace(space) if isinstance(space, mf.MatrixGroup) else space
            if not isinstance(space, mf.Space):
                raise InputError(
                    f"the space must be a manifolds.Space, such as manifolds.Sphere(2), got {type(space).__name__}; "
                    "for a manifold of geomstats give manifolds.from_geomstats(...)"
                )
            dim = space.size if dim is None else dim
        if dim is None and (poisson is None or (callable(poisson) and not isinstance(poisson, mf.PoissonStructure))):
            raise InputError(
                "the dimension of the state is not known. Give dim=n beside a Poisson tensor that is a function or None"
            )
        if not isinstance(poisson, mf.PoissonStructure):
            poisson = mf.PoissonTensor(poisson, dim) if poisson is not None else mf.NoPoisson(dim)  # type: ignore[arg-type]
        if poisson.dim is None:
            raise InputError("the dimension of the Poisson structure is unknown. Give its dim=")
        if space is not None and poisson.dim != space.size:
            raise InputError(
                f"the Poisson structure must have {space.size} coordinates, one for each real component of a point of "
                f"{space.name}, got {poisson.dim}"
            )
        if dim is not None and dim != poisson.dim:
            raise InputError(f"dim is {dim}, but the Poisson structure has {poisson.dim} coordinates")
        dim = poisson.dim
        if dim <= MAX_MATRIX_DIM:
            traced_function_and_shape(
                poisson.tensor, [(dim,)], [(dim, dim)], "the Poisson tensor", f"a state of shape ({dim},)"
            )
        else:
            at = f"a state and a covector of shape ({dim},)"
            traced_function_and_shape(poisson.sharp, [(dim,), (dim,)], [(dim,)], "Pi(x) of a covector", at)
        self._build(poisson, poisson.dim, energy, entropy, dissipation, momentum_maps, validate, space, baths)

    def local_system(self, x, is_centred: bool = False) -> tuple[System, jax.Array]:
        """Return the system embedded in arrays and x, or the system in a chart around x and the origin of the chart.

        With ``is_centred`` the local system is for use at x alone.
        """
        if self.space is None:
            return self, x
        if self.space.can_be_embedded:
            return EmbeddedSystem(self), x
        coordinates = mf.coordinates_around(mf.RiemannianRetraction(self.space), self.points(x))
        return ChartSystem(self, coordinates, coordinates.centre() if is_centred else None), jnp.zeros(self.space.dim)
