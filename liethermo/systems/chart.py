"""``ChartSystem``: a system on a manifold in the coordinates of a chart, for the methods of vector spaces.

Functions are pulled back by ``c -> point(c)``, the Poisson tensor and the dissipation by the inverse of its derivative
[:doc:`/explanation/exact_laws`]. Pi remains a Poisson tensor, K remains symmetric and semidefinite, and their kernels
contain the gradients of the pulled-back functions. A method therefore obeys on the manifold every law that it obeys in
R^dim.
"""

from __future__ import annotations

import jax

import manifolds as mf
from manifolds.structures.poisson import PoissonBySharp

from ..dissipation.base import LiftedDissipation, LiftedGeometry
from ..functions.energy import Energy
from .base import System
from .interface import EngineHints


class ChartSystem(System):
    """A system on a manifold in coordinates c of a chart, shape (dim,).

    Parameters
    ----------
    system : System
        A system on a manifold.
    coordinates : manifolds.Coordinates
    place : manifolds.Place, optional
        Fixed point at which Pi and K are evaluated, instead of the point with the coordinates c.
    start : array, optional
        State vector at the start of the step, for a system that serves one step.
    """

    manifold: System
    coordinates: mf.Coordinates
    place: mf.Place | None
    start: jax.Array | None

    def __init__(self, system: System, coordinates: mf.Coordinates, place: mf.Place | None = None, start=None):
        assert system.space is not None
        self.manifold, self.coordinates, self.place, self.start = system, coordinates, place, start
        self.dim, self.space, self.momentum_maps = system.space.dim, None, {}
        self.energy = self.pullback(system.energy)
        self.entropy = None if system.entropy is None else self.pullback(system.entropy)
        trivial = isinstance(system.poisson, mf.NoPoisson)
        self.poisson = mf.NoPoisson(self.dim) if trivial else _ChartPoisson(system, coordinates, place)
        self.momentum_maps = {name: self.pullback(J) for name, J in system.momentum_maps.items()}
        self.dissipation = _ChartDissipation.lift_terms(system.dissipation, self.pullback, system, coordinates, place)
        self.preserved_labels, self.invariant_verdicts = system.preserved_labels, system.invariant_verdicts

    def pullback(self, energy: Energy) -> Energy:
        """Return a function of coordinates from a function of states."""
        space = self.manifold.space
        assert space is not None
        return energy.map_terms(lambda term: term.pullback_to_chart(self.coordinates, space, self.start))

    @property
    def hints(self) -> EngineHints:
        return super().hints._replace(is_smooth=self.manifold.hints.is_smooth)

    def freeze_at(self, x) -> System:
        if self.place is not None:
            return self
        return ChartSystem(self.manifold, self.coordinates, self.coordinates.at(x), self.start)

    def field(self, x, dH, dS, dL=()):
        point = _ChartPoint(self.manifold, self.coordinates, self.place, x)
        dS, dL = None if dS is None else point.lift(dS), tuple(map(point.lift, dL))
        return point.lower(self.manifold.field(point.state, point.lift(dH), dS, dL))


class _ChartPoint:
    """A point of the manifold with the maps between covectors and velocities of coordinates and of states."""

    def __init__(self, system: System, coordinates: mf.Coordinates, place: mf.Place | None, c):
        assert system.space is not None
        self._space, self._place = system.space, coordinates.at(c) if place is None else place
        self.state = self._space.to_vector(self._place.point)

    def lift(self, alpha):
        return self._space.to_vector(self._place.lift(alpha).conj())

    def lower(self, v):
        return self._place.lower(self._space.from_vector(v))


class _ChartPoisson(PoissonBySharp):
    system: System
    coordinates: mf.Coordinates
    place: mf.Place | None

    @property
    def dim(self) -> int:
        assert self.system.space is not None
        return self.system.space.dim

    def sharp(self, x, alpha):
        point = _ChartPoint(self.system, self.coordinates, self.place, x)
        return point.lower(self.system.poisson.sharp(point.state, point.lift(alpha)))


class _ChartDissipation(LiftedDissipation):
    system: System
    coordinates: mf.Coordinates
    place: mf.Place | None

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        point = _ChartPoint(self.system, self.coordinates, self.place, x)
        return LiftedGeometry(self.system, point.state, point.lift, point.lower)

    def divergence(self, system, x):
        """Return the divergence with respect to the volume of the manifold."""
        return self.inner.divergence(self.system, _ChartPoint(self.system, self.coordinates, self.place, x).state)
