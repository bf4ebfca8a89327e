"""Systems: an energy, an entropy, a Poisson structure and a dissipation, with their laws and their axioms checked."""

from .attitude import MOMENTUM_LESS_IMPULSE, SPATIAL_MOMENTUM, AttitudeChartSystem, AttitudeSystem, momentum_system_of
from .base import System
from .baths import HeatBaths
from .composed.bodies import Copies, Membrane, Reaction, Subsystem
from .composed.system import ComposedSystem
from .domain import Domain
from .driven import DrivenSystem, make_autonomous
from .embedded import ChartSystem, EmbeddedSystem, embed_in_arrays
from .equilibria import Equilibria, Equilibrium, equilibria, steady_state
from .euler_poincare import EulerPoincareClosedSystem, EulerPoincareSystem, Legendre
from .evolution import ContactSystem, EvolutionSystem
from .hamiltonian import RotatingFrame
from .herglotz import Herglotz, ThermodynamicHerglotz
from .lie_poisson import LiePoissonSystem
from .linearisation import Linearisation, Stability, linearise
from .metriplectic import MetriplecticSystem
from .quantum import QuantumSystem
from .simple_closed import ChetaevSystem, SimpleClosedSystem
from .spins import SpinSystem

__all__ = [
    "MOMENTUM_LESS_IMPULSE",
    "SPATIAL_MOMENTUM",
    "AttitudeChartSystem",
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
    "embed_in_arrays",
    "equilibria",
    "linearise",
    "make_autonomous",
    "momentum_system_of",
    "steady_state",
]
