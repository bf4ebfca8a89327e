"""Systems: an energy, an entropy, a Poisson structure and a dissipation, with their laws and their axioms checked."""

from .attitude import AttitudeSystem
from .base import System
from .chart import ChartSystem
from .euler_poincare import EulerPoincareSystem, Legendre
from .lie_poisson import LiePoissonSystem
from .metriplectic import MetriplecticSystem

__all__ = [
    "AttitudeSystem",
    "ChartSystem",
    "EulerPoincareSystem",
    "Legendre",
    "LiePoissonSystem",
    "MetriplecticSystem",
    "System",
]
