"""Integrators: each defines a step, its order and its guarantees; how it is run is the engines' business."""

from .base import OneStepMethod, registered_methods
from .charts import InCharts
from .gauss import MetriplecticGauss
from .herglotz import DiscreteHerglotz
from .midpoint import MetriplecticMidpoint
from .reconstruction import WithAttitude
from .reference import Reference
from .runge_kutta import MetriplecticRungeKutta
from .taylor import MetriplecticTaylor
from .variational.discrete import DiscreteSystem, FiniteDifference
from .variational.gauss import VariationalGauss
from .variational.lie import LieVariational
from .variational.schemes import VariationalIntegrator

DEFAULT_METHOD = MetriplecticGauss(1)
"""The method has order 2; where energy and entropy are quadratic it is the midpoint scheme."""

METHODS: dict[str, type] = {type(method).__name__: type(method) for method in registered_methods(special=True)} | {
    "Reference": Reference
}
"""The integrators by name, as spec files give them; one registered in a module imported above is among them."""

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "DiscreteHerglotz",
    "DiscreteSystem",
    "FiniteDifference",
    "InCharts",
    "LieVariational",
    "MetriplecticGauss",
    "MetriplecticMidpoint",
    "MetriplecticRungeKutta",
    "MetriplecticTaylor",
    "OneStepMethod",
    "Reference",
    "VariationalGauss",
    "VariationalIntegrator",
    "WithAttitude",
    "registered_methods",
]
