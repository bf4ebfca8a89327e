"""Systems that several modules of tests share: built when a test asks for them, and once in each process."""

import functools

import liethermo as lt
import manifolds as mf


@functools.cache
def rigid_body() -> lt.LiePoissonSystem:
    """Return the rigid body with internal friction that ``lt.models.rigid_body`` makes by default."""
    return lt.models.rigid_body()


@functools.cache
def oscillator() -> lt.MetriplecticSystem:
    """Return an oscillator of frequency one, with the state (q, p)."""
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x @ x)
