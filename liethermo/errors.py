"""Errors of the dynamics layer; each message says what is wrong, what is allowed and what to do."""

from __future__ import annotations

from collections.abc import Mapping

import manifolds.errors


class LiethermoError(Exception):
    """Base class of every error raised on purpose by :mod:`liethermo`."""


class InputError(LiethermoError, ValueError):
    """An argument that cannot be used: wrong shape, not finite, not positive, an unknown name."""


class FunctionError(LiethermoError, TypeError):
    """A user's function whose result does not have the required type or shape."""


class IndexOutOfRangeError(manifolds.errors.IndexOutOfRangeError, FunctionError):
    """A function of a system with a constant index that is out of range for its array.

    Attributes
    ----------
    index, size : int
        The index, and how many entries the axis has.
    where : str
        The line of the user's code, as far as JAX knows.
    access : str
        What JAX would do: "read" or "write" another entry, "fill" the result with NaN, or "drop" what is to be written.
    """


class AxiomError(LiethermoError, ValueError):
    """A system that is not metriplectic: some axiom fails at a point.

    Attributes
    ----------
    residual, tolerance : float
    """

    def __init__(self, message: str, *, residual: float, tolerance: float):
        super().__init__(message)
        self.residual, self.tolerance = residual, tolerance


class CasimirError(AxiomError):
    """The entropy is not a Casimir function: ``Pi grad S != 0``."""


class IndefiniteError(AxiomError):
    """A matrix or form that must be positive semidefinite has a negative eigenvalue (given as ``residual``)."""


class FileError(LiethermoError, OSError):
    """A result file that is missing, incomplete, foreign or cannot be written.

    Attributes
    ----------
    solution : Solution or None
        The run that :func:`integrate` could not write.
    """

    def __init__(self, message: str, solution=None):
        super().__init__(message)
        self.solution = solution


class IntegrationError(LiethermoError, ArithmeticError):
    """A run that stopped early.

    Attributes
    ----------
    solution : Solution or None
        The trajectory up to the last good step; ``solution.status`` says where and why it stopped. None if the run is
        complete, and only a state between its steps cannot be found.
    """

    def __init__(self, message: str, solution):
        super().__init__(message)
        self.solution = solution


class ConvergenceError(IntegrationError):
    """Equations could not be solved: those of an implicit step, or of a steady state."""


class NonFiniteError(IntegrationError):
    """A step met NaN or infinity: usually a user's function outside its domain."""


class SpecError(LiethermoError, ValueError):
    """A spec file that cannot be run.

    Attributes
    ----------
    problems : tuple of str
        All faults, one line each: the key, its value and what is allowed.
    """

    def __init__(self, path, problems):
        self.problems = tuple(problems)
        super().__init__("\n  ".join([f"{path} cannot be run:", *self.problems]))


def refuse_replaced_members(cls: type, replacements: Mapping[str, str]) -> None:
    """Raise TypeError if a class defines a member by a former name, under which the library does not call it.

    Parameters
    ----------
    cls : type
    replacements : mapping
        The present name of each member, by its former name.
    """
    for name, replacement in replacements.items():
        if name in cls.__dict__:
            raise TypeError(f"{cls.__name__} defines {name}, which nothing calls. Override {replacement}")
