"""Figures of runs and of studies: ``lt.plot``."""

from manifolds._names import public_dir

from .along_time import laws
from .bloch import bloch_ball
from .fields import sphere_field
from .projections import invariants, projection
from .studies import study
from .surfaces import momentum_sphere

__all__ = ["bloch_ball", "invariants", "laws", "momentum_sphere", "projection", "sphere_field", "study"]
__dir__ = public_dir(__all__)
