"""Errors of the geometry layer: each carries the value found, the tolerance and what to do."""

from __future__ import annotations

import sys
import warnings


class ManifoldsError(Exception):
    """Base class of every error raised on purpose by :mod:`manifolds`."""


class ShapeError(ManifoldsError, ValueError):
    """An array whose last axes do not fit the algebra, group or manifold."""


class ComponentError(ManifoldsError, TypeError):
    """Components of the wrong kind: complex, textual or ragged where real numbers are meant."""


class ParameterError(ManifoldsError, ValueError):
    """A catalogue entry asked for with a parameter outside its range."""


class ForkError(ManifoldsError, RuntimeError):
    """A process that was forked after JAX had run is to compile a program, which it cannot."""


class PrecisionError(ManifoldsError, RuntimeError):
    """JAX has been set to single precision, in which no law holds to rounding."""


class SizeError(ParameterError):
    """Something that would not fit into the memory of this machine, refused before it is tried."""


class DomainError(ManifoldsError, ValueError):
    """A map evaluated outside its domain, such as the logarithm of -I in SU(2)."""


class OffManifoldError(DomainError):
    """A point off its state space, or a vector that is not tangent to it.

    Attributes
    ----------
    residual, tolerance : float
        How far it is away, relative to its size, and how far it may be.
    """

    def __init__(self, message: str, *, residual: float, tolerance: float):
        super().__init__(message)
        self.residual, self.tolerance = residual, tolerance


class SpaceError(ManifoldsError, TypeError):
    """An operation that a state space does not have, or an object that cannot be one."""


class LieAlgebraError(ManifoldsError, ValueError):
    """Data that do not define a Lie algebra, or an operation this algebra does not have.

    Attributes
    ----------
    residual, tolerance : float or None
        How far the axiom is from holding, and how far it may be.
    indices : tuple of int
        The offending basis elements, counted from 0.
    """

    def __init__(self, message: str, *, residual=None, tolerance=None, indices: tuple[int, ...] = ()):
        super().__init__(message)
        self.residual, self.tolerance, self.indices = residual, tolerance, indices


class AntisymmetryError(LieAlgebraError):
    """``C[a, b, :] != -C[b, a, :]``."""


class JacobiError(LieAlgebraError):
    """``[[a, b], c] + [[b, c], a] + [[c, a], b] != 0``."""


class ClosureError(LieAlgebraError):
    """Matrices that are dependent, or whose commutators leave their span."""


class RepresentationError(LieAlgebraError):
    """Matrices ``rho_a`` with ``[rho_a, rho_b] != rho([e_a, e_b])``."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """A warning that points to the line of the user's that led to it, however deep inside the library it arises."""
    frame, depth = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("liethermo", "manifolds"):
        frame, depth = frame.f_back, depth + 1
    warnings.warn(message, category, stacklevel=depth)
