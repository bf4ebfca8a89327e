"""Property suites for methods, dissipations and systems that users define.

Each ``check_*`` tests an object as the registered ones are tested. It returns a report, or raises
:class:`PropertyError` with the table of measurements. The suites of algebras, groups and spaces are in
:mod:`manifolds.testing`.
"""

from manifolds._arguments import module_dir_function
from manifolds.testing import PropertyError, Report

from .equilibrium import check_equilibrium
from .relations import RELATIONS, check_relations
from .suites import check_dissipation, check_method, check_system

__all__ = [
    "RELATIONS",
    "PropertyError",
    "Report",
    "check_dissipation",
    "check_equilibrium",
    "check_method",
    "check_relations",
    "check_system",
]
__dir__ = module_dir_function(__all__)
