"""Time integration that obeys the two laws of thermodynamics exactly, on Lie algebras, Lie groups and manifolds.

Importing this package switches JAX to 64-bit floating point (see :mod:`manifolds`).
"""

from __future__ import annotations

import importlib
import importlib.metadata
import warnings

import manifolds  # noqa: F401  (switches 64-bit mode on before anything is traced)
from manifolds._arguments import module_dir_function

from . import (
    _class_members,  # noqa: F401  (what help() lists of the classes)
    bodies,
    models,
    testing,
)
from .dissipation.adiabatic import AdiabaticJumps
from .dissipation.base import Dissipation
from .dissipation.brackets import DoubleBracket, FourBracket, InnerProductDissipation, KillingDissipation
from .dissipation.factor import Factor
from .dissipation.friction import EulerPoincareForce, Friction, FrictionOperator
from .dissipation.heating import BathConduction
from .dissipation.landau_lifshitz import LandauLifshitz
from .dissipation.lindblad import LindbladJumps
from .dissipation.potential import ActivatedFriction, CoulombFriction, DissipationPotential, PowerLawFriction
from .dissipation.projected_metric import LocalProjectedMetric, ProjectedMetric
from .dissipation.quantum import ThermalJumps
from .dissipation.steepest_ascent import SteepestEntropyAscent
from .errors import (
    AxiomError,
    CasimirError,
    ConvergenceError,
    FileError,
    FunctionError,
    IndefiniteError,
    IndexOutOfRangeError,
    InputError,
    IntegrationError,
    LiethermoError,
    NonFiniteError,
    SpecError,
)
from .functions import magnetism
from .functions.density import VonNeumann
from .functions.energy import Energy, Function, Quadratic, TimeDependent
from .functions.gradients import CoordinateIncrement, DiscreteGradient, Gonzalez, MeanValue
from .functions.mechanics import Each, Kinetic, Potential
from .functions.time_span import PiecewiseConstant
from .integrators import (
    DiscreteHerglotz,
    FiniteDifference,
    KrausMethod,
    LieVariational,
    MetriplecticGauss,
    MetriplecticMidpoint,
    MetriplecticRungeKutta,
    MetriplecticTaylor,
    OneStepMethod,
    Reference,
    VariationalGauss,
    VariationalIntegrator,
    registered_methods,
)
from .models import torques
from .results.audit import Audit
from .results.ensemble import Ensemble
from .results.files import load
from .results.solution import Solution
from .results.status import Stats, Status
from .runs.adaptive import Adaptive
from .runs.ensemble import ensemble
from .runs.events import Relaxed
from .runs.flow import flow
from .runs.integrate import integrate
from .runs.noise import Fluctuations
from .runs.propagator import Propagator
from .runs.steady_cycle import SteadyCycle, steady_cycle
from .runs.suggest import MethodSuggestion, suggest_method, suggest_step
from .studies.axes import Zipped, latin_hypercube, replicas, sobol, zipped
from .studies.measures import At
from .studies.progress import StudyStatus
from .studies.store_results import load_study
from .studies.study import Study
from .systems import (
    ChetaevSystem,
    ComposedSystem,
    ContactSystem,
    Copies,
    Equilibria,
    Equilibrium,
    EulerPoincareClosedSystem,
    EulerPoincareSystem,
    EvolutionSystem,
    HeatBaths,
    Herglotz,
    LiePoissonSystem,
    Linearisation,
    Membrane,
    MetriplecticSystem,
    QuantumSystem,
    Reaction,
    RotatingFrame,
    SimpleClosedSystem,
    SpinSystem,
    Stability,
    Subsystem,
    System,
    ThermodynamicHerglotz,
    equilibria,
    linearise,
    steady_state,
)
from .systems.composed.graph_files import Graph, read_graph

__all__ = [
    "ActivatedFriction",
    "Adaptive",
    "AdiabaticJumps",
    "At",
    "Audit",
    "AxiomError",
    "BathConduction",
    "CasimirError",
    "ChetaevSystem",
    "ComposedSystem",
    "ContactSystem",
    "ConvergenceError",
    "CoordinateIncrement",
    "Copies",
    "CoulombFriction",
    "DiscreteGradient",
    "DiscreteHerglotz",
    "Dissipation",
    "DissipationPotential",
    "DoubleBracket",
    "Each",
    "Energy",
    "Ensemble",
    "Equilibria",
    "Equilibrium",
    "EulerPoincareClosedSystem",
    "EulerPoincareForce",
    "EulerPoincareSystem",
    "EvolutionSystem",
    "Factor",
    "FileError",
    "FiniteDifference",
    "Fluctuations",
    "FourBracket",
    "Friction",
    "FrictionOperator",
    "Function",
    "FunctionError",
    "Gonzalez",
    "Graph",
    "HeatBaths",
    "Herglotz",
    "IndefiniteError",
    "IndexOutOfRangeError",
    "InnerProductDissipation",
    "InputError",
    "IntegrationError",
    "KillingDissipation",
    "Kinetic",
    "KrausMethod",
    "LandauLifshitz",
    "LiePoissonSystem",
    "LieVariational",
    "LiethermoError",
    "LindbladJumps",
    "Linearisation",
    "LocalProjectedMetric",
    "MeanValue",
    "Membrane",
    "MethodSuggestion",
    "MetriplecticGauss",
    "MetriplecticMidpoint",
    "MetriplecticRungeKutta",
    "MetriplecticSystem",
    "MetriplecticTaylor",
    "NonFiniteError",
    "OneStepMethod",
    "PiecewiseConstant",
    "Potential",
    "PowerLawFriction",
    "ProjectedMetric",
    "Propagator",
    "Quadratic",
    "QuantumSystem",
    "Reaction",
    "Reference",
    "Relaxed",
    "RotatingFrame",
    "SimpleClosedSystem",
    "Solution",
    "SpecError",
    "SpinSystem",
    "Stability",
    "Stats",
    "Status",
    "SteadyCycle",
    "SteepestEntropyAscent",
    "Study",
    "StudyStatus",
    "Subsystem",
    "System",
    "ThermalJumps",
    "ThermodynamicHerglotz",
    "TimeDependent",
    "VariationalGauss",
    "VariationalIntegrator",
    "VonNeumann",
    "Zipped",
    "bodies",
    "ensemble",
    "equilibria",
    "flow",
    "integrate",
    "latin_hypercube",
    "learn",
    "linearise",
    "load",
    "load_study",
    "magnetism",
    "models",
    "plot",
    "read_graph",
    "registered_methods",
    "replicas",
    "sobol",
    "steady_cycle",
    "steady_state",
    "suggest_method",
    "suggest_step",
    "testing",
    "torques",
    "zipped",
]

_INTEROP = ("diffrax", "scipy", "sympy")

_DEPRECATED_TYPES = {
    "AttitudeSystem": ".systems",
    "ChartSystem": ".systems",
    "DrivenSystem": ".systems",
    "GlobalRateWarning": ".dissipation.projected_metric",
    "InCharts": ".integrators",
    "WithAttitude": ".integrators",
}
"""Modules of types that only the library makes; they were public names in 0.2."""


__dir__ = module_dir_function(__all__, "__version__")


def __getattr__(name: str):
    if name == "plot":  # matplotlib is imported only when a picture is wanted
        return importlib.import_module(".results.plot", __name__)
    if name == "learn":  # what most runs do without
        return importlib.import_module(".learn", __name__)
    if name in _INTEROP:  # each imports the package that it is named after
        return importlib.import_module(f".interop.{name}", __name__)
    if name in _DEPRECATED_TYPES:
        module = importlib.import_module(_DEPRECATED_TYPES[name], __name__)
        warnings.warn(
            f"liethermo.{name} will be removed, since only the library makes it; it is {module.__name__}.{name}",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(module, name)
    if name == "__version__":
        return importlib.metadata.version("liethermo")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
