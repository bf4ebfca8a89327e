"""Fit systems with neural networks to data; both laws hold by construction before, during and after training."""

from manifolds._names import public_dir

from .files import load, save
from .fitting import fit
from .identifiability import Determined, Fits, determined, several
from .model import Metriplectic
from .networks import Learned
from .parts import Energy, Entropy, Friction, Poisson
from .training import FitWarning, Training

__all__ = [
    "Determined",
    "Energy",
    "Entropy",
    "FitWarning",
    "Fits",
    "Friction",
    "Learned",
    "Metriplectic",
    "Poisson",
    "Training",
    "determined",
    "fit",
    "load",
    "save",
    "several",
]
__dir__ = public_dir(__all__)
