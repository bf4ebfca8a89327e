"""Functions that a method is asked to hold exactly, besides what the system is known to conserve."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InputError
from ..functions.checks import check_scalar, recognised
from ..functions.energy import Energy, as_energy, function_name
from ..systems import System


def preserved_functions(preserve) -> tuple[Energy, ...]:
    """Those of ``preserve=``: one function, or a sequence of them."""
    functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
    return tuple(as_energy(C, "a preserved function") for C in functions)


def seen_on(system: System, C: Energy) -> Energy:
    """A preserved function as one of the state vectors of a system."""
    C = check_scalar(system.on_states(C), system.dim, "a preserved function")
    return recognised(C, system.dim) if system.space is None else C


def check_preserved(system: System, functions: Sequence[Energy]) -> None:
    """Raise InputError where the system does not conserve one of the functions.

    Where that cannot be found out, as outside the domain of an entropy, they count as claimed.
    """
    for C, kept in zip(functions, system.conserves(tuple(functions)), strict=True):
        if kept is False:
            name = function_name(C) or str(C)
            raise InputError(
                f"the system does not conserve the preserved function {name}: holding it would change the "
                "dynamics. Give a dissipation that preserves it too, such as ProjectedMetric(preserve=...)"
            )
