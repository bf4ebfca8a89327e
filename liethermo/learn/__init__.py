"""Fit parameters and neural networks of systems to data; both laws hold by construction before, during and after."""

from manifolds._arguments import module_dir_function

from .files import load, save
from .fitting import fit
from .identifiability import Determined, Fits, determined, several
from .parts import Energy, Entropy, Friction, Learned, Metriplectic, Poisson
from .records import Records, Trajectory, read_data
from .training import ConfidenceInterval, FitWarning, Training

__all__ = [
    "ConfidenceInterval",
    "Determined",
    "Energy",
    "Entropy",
    "FitWarning",
    "Fits",
    "Friction",
    "Learned",
    "Metriplectic",
    "Poisson",
    "Records",
    "Training",
    "Trajectory",
    "determined",
    "fit",
    "load",
    "read_data",
    "save",
    "several",
]
__dir__ = module_dir_function(__all__)
