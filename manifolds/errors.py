"""Errors of the geometry layer; each states the value found, the tolerance and the remedy."""

from __future__ import annotations

import sys
import warnings


class ManifoldsError(Exception):
    """Base class of every error raised on purpose by :mod:`manifolds`."""


class ShapeError(ManifoldsError, ValueError):
    """Raised when the last axes of an array do not fit the algebra, group or manifold."""


class ComponentError(ManifoldsError, TypeError):
    """Raised when components are complex, textual or ragged but must be real numbers."""


class ParameterError(ManifoldsError, ValueError):
    """Raised when a parameter is outside its allowed range."""


class ForkError(ManifoldsError, RuntimeError):
    """Raised when a process that was forked after JAX had run is about to compile a program."""


class PrecisionError(ManifoldsError, RuntimeError):
    """Raised when JAX has been set to single precision, in which no law holds to rounding."""


class SizeError(ParameterError):
    """Raised before an object is built that would not fit into the memory of this machine."""


class DomainError(ManifoldsError, ValueError):
    """Raised when a map is evaluated outside its domain, such as the logarithm of -I in SU(2)."""


class OffManifoldError(DomainError):
    """Raised when a point is not on its state space, or a vector is not tangent to it.

    Attributes
    ----------
    residual, tolerance : float
        Distance from the space, relative to the size of the point or vector, and its limit.
    """

    def __init__(self, message: str, *, residual: float, tolerance: float):
        super().__init__(message)
        self.residual, self.tolerance = residual, tolerance


class SpaceError(ManifoldsError, TypeError):
    """Raised when a state space lacks an operation, or an object cannot be a state space."""


class IndexOutOfRangeError(ManifoldsError, IndexError):
    """A function with a constant index that is out of range for its array.

    Attributes
    ----------
    index, size : int
        The index, and how many entries the axis has.
    where : str
        The line of the user's code, as far as JAX knows.
    access : str
        What JAX would do: "read" or "write" another entry, "fill" the result with NaN, or "drop" what is to be written.
    """

    def __init__(self, index: int, size: int, where: str, function: str = "a function", *, access: str = "read"):
        self.index, self.size, self.where, self.access = index, size, where, access
        python_rule = f"counts from 0, so the last index is {size - 1}" if size else "finds no entry in it"
        noun = "entry" if size == 1 else "entries"
        jax_rule, advice = {
            "read": ("take another entry", f'x.at[{index}].get(mode="clip")'),
            "write": ("change another entry", 'mode="clip" in x.at[...].set(...), add or another method'),
            "fill": ("read NaN", 'mode="fill"'),
            "drop": ("change no entry", 'mode="drop" in x.at[...].set(...), add or another method'),
        }[access]
        super().__init__(
            f"{function} has the index {index} of an axis with {size} {noun}, which is out of range ({where}). "
            f"Python {python_rule}. JAX would {jax_rule} without a word; where that is meant, write {advice}"
        )

    def with_function(self, function: str) -> IndexOutOfRangeError:
        """Return the same error, saying which function has the index."""
        return type(self)(self.index, self.size, self.where, function, access=self.access)


class LieAlgebraError(ManifoldsError, ValueError):
    """Raised when data do not define a Lie algebra, or the algebra lacks an operation.

    Attributes
    ----------
    residual, tolerance : float or None
        Violation of the axiom, and its limit.
    indices : tuple of int
        The offending basis elements, counted from 0.
    """

    def __init__(self, message: str, *, residual=None, tolerance=None, indices: tuple[int, ...] = ()):
        super().__init__(message)
        self.residual, self.tolerance, self.indices = residual, tolerance, indices


class AntisymmetryError(LieAlgebraError):
    """Raised when structure constants are not antisymmetric: ``C[a, b, :] != -C[b, a, :]``."""


class JacobiError(LieAlgebraError):
    """Raised when the Jacobi identity fails: ``[[a, b], c] + [[b, c], a] + [[c, a], b] != 0``."""


class ClosureError(LieAlgebraError):
    """Raised when matrices are linearly dependent, or their commutators leave their span."""


class RepresentationError(LieAlgebraError):
    """Raised when matrices ``rho_a`` are not a representation: ``[rho_a, rho_b] != rho([e_a, e_b])``."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning that points to the user's line that led to it, however deep in the library it arises."""
    frame, depth = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("liethermo", "manifolds"):
        frame, depth = frame.f_back, depth + 1
    warnings.warn(message, category, stacklevel=depth)
