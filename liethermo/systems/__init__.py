"""Systems: an energy, an entropy, a Poisson structure and a dissipation, with their laws and their axioms checked."""

from .base import System
from .composed import ComposedSystem, Subsystem
from .euler_poincare import EulerPoincareSystem, Legendre
from .euler_poincare_closed import EulerPoincareClosedSystem
from .evolution import ContactSystem, EvolutionSystem
from .herglotz import Herglotz, ThermodynamicHerglotz
from .lie_poisson import LiePoissonSystem
from .metriplectic import MetriplecticSystem
from .simple_closed import SimpleClosedSystem

__all__ = [
    "ComposedSystem",
    "ContactSystem",
    "EulerPoincareClosedSystem",
    "EulerPoincareSystem",
    "EvolutionSystem",
    "Herglotz",
    "Legendre",
    "LiePoissonSystem",
    "MetriplecticSystem",
    "SimpleClosedSystem",
    "Subsystem",
    "System",
    "ThermodynamicHerglotz",
]
