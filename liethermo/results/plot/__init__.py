"""Figures of runs and of studies: ``lt.plot``."""

from manifolds._arguments import module_dir_function

from .along_time import invariants, laws, projection
from .studies import study
from .surfaces import bloch_ball, momentum_sphere, sphere_field

__all__ = ["bloch_ball", "invariants", "laws", "momentum_sphere", "projection", "sphere_field", "study"]
__dir__ = module_dir_function(__all__)
