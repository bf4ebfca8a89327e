"""The property suites of this package, for algebras, groups and spaces of one's own.

Each ``check_*`` puts an object through what every registered one goes through. It returns a :class:`Report`, or raises
:class:`PropertyError` with the table of what was measured.
"""

from .._names import public_dir
from .algebras import check_algebra
from .groups import check_group
from .report import PropertyError, Report, Suite
from .spaces import check_space

__all__ = ["PropertyError", "Report", "Suite", "check_algebra", "check_group", "check_space"]
__dir__ = public_dir(__all__)
