"""Systems: an energy, an entropy, a Poisson structure and a dissipation, with their laws and their axioms checked."""

from .base import System
from .euler_poincare import EulerPoincareSystem, Legendre
from .evolution import ContactSystem, EvolutionSystem
from .herglotz import Herglotz, ThermodynamicHerglotz
from .lie_poisson import LiePoissonSystem
from .metriplectic import MetriplecticSystem

__all__ = [
    "ContactSystem",
    "EulerPoincareSystem",
    "EvolutionSystem",
    "Herglotz",
    "Legendre",
    "LiePoissonSystem",
    "MetriplecticSystem",
    "System",
    "ThermodynamicHerglotz",
]
