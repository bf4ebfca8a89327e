"""Property suites of this package, for user-defined algebras, groups and spaces.

Each ``check_*`` runs the checks of every registered object of that kind. It returns a :class:`Report`, or raises
:class:`PropertyError` with the table of the residuals.
"""

from .._arguments import module_dir_function
from .suites import PropertyError, Report, Suite, check_algebra, check_group, check_space

__all__ = ["PropertyError", "Report", "Suite", "check_algebra", "check_group", "check_space"]
__dir__ = module_dir_function(__all__)
