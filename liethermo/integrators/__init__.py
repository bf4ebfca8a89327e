"""Integrators: each defines a step, its order and its guarantees; the engines run them."""

from .base import OneStepMethod, registered_methods
from .charts import InCharts
from .gauss import MetriplecticGauss
from .herglotz import DiscreteHerglotz
from .kraus import KrausMethod
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
"""Method of runs without ``method=``: order 2, and the midpoint scheme if energy and entropy are quadratic."""

METHODS: dict[str, type] = {type(method).__name__: type(method) for method in registered_methods(special=True)} | {
    "Reference": Reference
}
"""The integrators by name, as in spec files; an integrator registered in a module imported above is included."""

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "DiscreteHerglotz",
    "DiscreteSystem",
    "FiniteDifference",
    "InCharts",
    "KrausMethod",
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
