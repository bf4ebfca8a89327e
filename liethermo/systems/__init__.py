"""Systems: an energy, an entropy, a Poisson structure and a dissipation, with their laws and their axioms checked."""

from .attitude import MOMENTUM_LESS_IMPULSE, SPATIAL_MOMENTUM, AttitudeSystem, TurningSystem, momentum_system_of
from .base import System
from .baths import HeatBaths
from .chart import ChartSystem
from .chetaev import ChetaevSystem
from .composed.bodies import Copies, Subsystem
from .composed.matter import Membrane, Reaction
from .composed.system import ComposedSystem
from .domain import Domain
from .driven import DrivenSystem, make_autonomous
from .embedded import EmbeddedSystem, embed_in_arrays
from .equilibria import Equilibria, Equilibrium, equilibria, steady_state
from .euler_poincare import EulerPoincareSystem, Legendre
from .euler_poincare_closed import EulerPoincareClosedSystem
from .evolution import ContactSystem, EvolutionSystem
from .herglotz import Herglotz, ThermodynamicHerglotz
from .lie_poisson import LiePoissonSystem
from .linearisation import Linearisation, Stability, linearise
from .metriplectic import MetriplecticSystem
from .quantum import QuantumSystem
from .rotating_frame import RotatingFrame
from .simple_closed import SimpleClosedSystem
from .spins import SpinSystem

__all__ = [
    "MOMENTUM_LESS_IMPULSE",
    "SPATIAL_MOMENTUM",
    "AttitudeSystem",
    "ChartSystem",
    "ChetaevSystem",
    "ComposedSystem",
    "ContactSystem",
    "Copies",
    "Domain",
    "DrivenSystem",
    "EmbeddedSystem",
    "Equilibria",
    "Equilibrium",
    "EulerPoincareClosedSystem",
    "EulerPoincareSystem",
    "EvolutionSystem",
    "HeatBaths",
    "Herglotz",
    "Legendre",
    "LiePoissonSystem",
    "Linearisation",
    "Membrane",
    "MetriplecticSystem",
    "QuantumSystem",
    "Reaction",
    "RotatingFrame",
    "SimpleClosedSystem",
    "SpinSystem",
    "Stability",
    "Subsystem",
    "System",
    "ThermodynamicHerglotz",
    "TurningSystem",
    "embed_in_arrays",
    "equilibria",
    "linearise",
    "make_autonomous",
    "momentum_system_of",
    "steady_state",
]
