"""Figures of runs and of studies: ``lt.plot``."""

from manifolds._names import public_dir

from .along_time import laws
from .fields import sphere_field
from .studies import study
from .surfaces import momentum_sphere

__all__ = ["laws", "momentum_sphere", "sphere_field", "study"]
__dir__ = public_dir(__all__)
