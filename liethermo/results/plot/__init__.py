"""Pictures of runs and of studies: ``lt.plot``."""

from manifolds._names import listing

from .along_time import laws
from .fields import sphere_field
from .studies import study
from .surfaces import momentum_sphere

__all__ = ["laws", "momentum_sphere", "sphere_field", "study"]
__dir__ = listing(__all__)
