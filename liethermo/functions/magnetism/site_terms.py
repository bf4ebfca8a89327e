"""Energies of single spins: anisotropies of any order, and the Zeeman energy in fields that depend on site and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arguments import is_integer
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.structures.spins import Lattice as PeriodicSpins
from manifolds.structures.spins import (
    VectorComponents,
    add_vectors,
    dot_vectors,
    scale_vectors,
    split_vectors,
    sum_of_dots,
)

from ...errors import InputError
from ..conditions import checked_numbers
from ..energy import Energy, TimeDependent
from ..indices import clique_pattern
from .spin_energy import SpinEnergy, check_finite, checked_site_values, lattice_shape


def anisotropy(sites, strength=1.0, axis=(0.0, 0.0, 1.0)) -> Energy:
    """Return the uniaxial anisotropy, ``-sum K_i (n_i . s_i)^2``: an easy axis for K > 0, a hard axis for K < 0.

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    strength : float, or array of the shape of the sites
        K_i.
    axis : array, shape (3,) or ``(*sites, 3)``
        n_i, which is not normalised.

    Returns
    -------
    Energy

    See Also
    --------
    uniaxial_anisotropy, cubic_anisotropy, stevens_anisotropy : anisotropies of higher order.

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    K = checked_site_values(strength, shape, (), "an anisotropy constant")
    n = checked_site_values(axis, shape, (3,), "an axis")
    if not is_traced((K, n)) and not (np.count_nonzero(np.asarray(n), axis=-1) > 1).any():  # every axis is x, y or z
        return QuadraticSiteEnergy(shape, -2.0 * K[..., None] * n**2, None, None)
    return QuadraticSiteEnergy(shape, -2.0 * K, None, n)


def uniaxial_anisotropy(sites, coefficients: Mapping, axis=(0.0, 0.0, 1.0)) -> Energy:
    """Return a uniaxial anisotropy of any order, ``-sum_i sum_p K_p (n_i . s_i)^p``.

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    coefficients : mapping from int to float, or to an array of the shape of the sites
        K_p (energy) by the power p >= 1, such as ``{2: K1, 4: K2, 6: K3}``.
    axis : array, shape (3,) or ``(*sites, 3)``
        n_i, which is not normalised.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    _require_mapping(coefficients, "the coefficients of a uniaxial anisotropy", "{2: 0.5}")
    if any(not is_integer(p) or p < 1 for p in coefficients):
        raise InputError(f"the powers of a uniaxial anisotropy must be positive integers, got {list(coefficients)}")
    n = checked_site_values(axis, shape, (3,), "an axis")
    frame = jnp.stack([jnp.zeros_like(n), jnp.zeros_like(n), n], axis=-2)
    terms = {(0, 0, int(p)): -checked_numbers(K, "an anisotropy constant") for p, K in coefficients.items()}
    return polynomial_anisotropy(shape, terms, frame)


def cubic_anisotropy(sites, first=1.0, second=0.0, axes=None) -> Energy:
    """Return the energy of cubic anisotropy, ``sum K1 (x^2 y^2 + y^2 z^2 + z^2 x^2) + K2 x^2 y^2 z^2``.

    The sum is over the sites, and x, y, z are the components of a spin along the cubic axes. K1 > 0 makes the cubic
    axes easy, as in iron.

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    first, second : float, or array of the shape of the sites
        K1 and K2 (energy).
    axes : array, shape (3, 3) or ``(*sites, 3, 3)``, optional
        The cubic axes, in rows; x, y and z by default.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    K1, K2 = (checked_numbers(K, "an anisotropy constant") for K in (first, second))
    terms = {(2, 2, 0): K1, (0, 2, 2): K1, (2, 0, 2): K1}
    if is_traced(K2) or np.any(np.asarray(K2)):
        terms[2, 2, 2] = K2
    return polynomial_anisotropy(sites, terms, axes)


def stevens_anisotropy(sites, coefficients: Mapping, axes=None) -> Energy:
    r"""Return the energy of a crystal field, ``sum_i sum B_kq O_kq(s_i)``, with Stevens functions of rank 2, 4 and 6.

    These are the leading powers of the operators in the spin, such as ``O_20 = 3 z^2 - r^2``,
    ``O_40 = 35 z^4 - 30 z^2 r^2 + 3 r^4`` and ``O_43 = z (x^3 - 3 x y^2)`` with r = \|s\|. For q < 0 the real part of
    ``(x + i y)^q`` is replaced by its imaginary part [Hutchings 1964; Rudowicz & Chung 2004].

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    coefficients : mapping from (int, int) to float, or to an array of the shape of the sites
        B_kq (energy) by (k, q), with k = 2, 4 or 6 and \|q\| <= k.
    axes : array, shape (3, 3) or ``(*sites, 3, 3)``, optional
        Axes of quantisation, in rows; x, y and z by default.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    terms: dict[tuple[int, int, int], jax.Array] = {}
    _require_mapping(coefficients, "the coefficients of Stevens functions", "{(2, 0): 0.5}")
    for pair, B in coefficients.items():
        k, q = pair if isinstance(pair, tuple) and len(pair) == 2 else (None, None)
        if k not in STEVENS_FACTORS or not isinstance(q, int | np.integer) or abs(q) > k:
            raise InputError(f"a Stevens function needs a pair (k, q) with k = 2, 4 or 6 and |q| <= k, got {pair}")
        value = checked_numbers(B, "a Stevens coefficient")
        for powers, factor in stevens_monomials(int(k), int(q)).items():
            terms[powers] = terms.get(powers, 0.0) + factor * value
    return polynomial_anisotropy(sites, terms, axes)


def polynomial_anisotropy(sites, terms: Mapping, axes=None) -> Energy:
    """Return an anisotropy ``sum_i sum_p c_p x_i^p1 y_i^p2 z_i^p3``, a polynomial in the components of each spin.

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    terms : mapping from (int, int, int) to float, or to an array of the shape of the sites
        The coefficients c_p (energy) by the powers of x, y and z.
    axes : array, shape (3, 3) or ``(*sites, 3, 3)``, optional
        Vectors n_1, n_2, n_3 in rows; ``x_i = n_1 . s_i``, and so on. x, y and z by default.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> iron = lt.magnetism.polynomial_anisotropy(1, {(2, 2, 0): 0.5})
    >>> round(float(iron([0.6, 0.8, 0.0])), 6)
    0.1152
    """
    shape = lattice_shape(sites)
    _require_mapping(terms, "the terms of an anisotropy", "{(2, 2, 0): 0.5}")
    powers = list(terms)
    if not powers or not all(_is_power_triple(p) for p in powers):
        raise InputError(f"an anisotropy needs powers (p1, p2, p3) of non-negative integers, got {powers}")
    values = tuple(checked_site_values(c, shape, (), "an anisotropy coefficient") for c in terms.values())
    frame = None if axes is None else check_finite(checked_numbers(axes, "the axes of an anisotropy"), "the axes")
    if frame is not None and frame.shape not in ((3, 3), (*shape, 3, 3)):
        raise InputError(f"the axes of an anisotropy must have shape (3, 3) or {(*shape, 3, 3)}, got {frame.shape}")
    return SitePolynomial(shape, tuple((int(a), int(b), int(c)) for a, b, c in powers), values, frame)


def _require_mapping(value, what: str, example: str) -> None:
    """Raise InputError if a value is not a mapping; the message has an example of one."""
    if not isinstance(value, Mapping):
        raise InputError(f"{what} must be a dict such as {example}, got {type(value).__name__}")


def _is_power_triple(powers) -> bool:
    """Return whether a value is a tuple of three non-negative integers."""
    return isinstance(powers, tuple) and len(powers) == 3 and all(is_integer(p) and p >= 0 for p in powers)


def zeeman(sites, field, moment=1.0) -> Energy:
    """Return the energy in a magnetic field, ``-sum mu_i B_i . s_i``.

    Parameters
    ----------
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.
    field : array, shape (3,) or ``(*sites, 3)``; or function of the time to such an array
        B_i, which may depend on the time.
    moment : float, or array of the shape of the sites
        mu_i.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> energy = lt.magnetism.zeeman(1, lambda t: jnp.array([jnp.cos(t), jnp.sin(t), 0.0]))
    >>> float(energy([1.0, 0.0, 0.0], 0.0))
    -1.0
    """
    shape = lattice_shape(sites)
    moment = checked_site_values(moment, shape, (), "a moment")
    if callable(field):
        result = jax.eval_shape(lambda t: jnp.asarray(field(t), dtype=jnp.float64), jnp.zeros(()))
        if result.shape not in ((3,), (*shape, 3)):
            raise InputError(f"a field of the time must have shape (3,) or {(*shape, 3)}, got {result.shape}")
        return TimeDependent(DrivenZeeman(field, moment, shape))
    B = checked_site_values(field, shape, (3,), "a field")
    return QuadraticSiteEnergy(shape, None, -moment[..., None] * B, None)


class DrivenZeeman(Module):
    """The Zeeman energy as a function of the spins and the time.

    Attributes
    ----------
    field : function of the time
    moment : array, shape () or that of the sites
    sites : tuple of int
    """

    field: Callable
    moment: jax.Array
    sites: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x, t):
        spins = x.reshape(-1)[: 3 * math.prod(self.sites)].reshape(*self.sites, 3)
        return -jnp.sum(self.moment[..., None] * spins * jnp.asarray(self.field(t)))


STEVENS_FACTORS: dict[int, tuple[dict[tuple[int, int], float], ...]] = {
    2: ({(2, 0): 3.0, (0, 1): -1.0}, {(1, 0): 1.0}, {(0, 0): 1.0}),
    4: (
        {(4, 0): 35.0, (2, 1): -30.0, (0, 2): 3.0},
        {(3, 0): 7.0, (1, 1): -3.0},
        {(2, 0): 7.0, (0, 1): -1.0},
        {(1, 0): 1.0},
        {(0, 0): 1.0},
    ),
    6: (
        {(6, 0): 231.0, (4, 1): -315.0, (2, 2): 105.0, (0, 3): -5.0},
        {(5, 0): 33.0, (3, 1): -30.0, (1, 2): 5.0},
        {(4, 0): 33.0, (2, 1): -18.0, (0, 2): 1.0},
        {(3, 0): 11.0, (1, 1): -3.0},
        {(2, 0): 11.0, (0, 1): -1.0},
        {(1, 0): 1.0},
        {(0, 0): 1.0},
    ),
}
"""Factors of the Stevens functions beside ``Re (x + i y)^q``, for q = 0, 1, …: coefficients by powers of z and r^2."""


def stevens_monomials(k: int, q: int) -> dict[tuple[int, int, int], float]:
    """Return a Stevens function as coefficients by the powers of x, y and z."""
    m = abs(q)
    result: dict[tuple[int, int, int], float] = {}
    for j in range(m + 1):  # (x + i y)^m = sum binom(m, j) x^(m - j) (i y)^j
        if j % 2 != (1 if q < 0 else 0):
            continue
        planar_sign = (-1.0) ** (j // 2)
        for (z_power, r_power), factor in STEVENS_FACTORS[k][m].items():
            for a in range(r_power + 1):
                for b in range(r_power - a + 1):
                    c = r_power - a - b
                    count = math.factorial(r_power) // (math.factorial(a) * math.factorial(b) * math.factorial(c))
                    powers = (m - j + 2 * a, j + 2 * b, z_power + 2 * c)
                    result[powers] = result.get(powers, 0.0) + planar_sign * math.comb(m, j) * factor * count
    return {powers: value for powers, value in result.items() if value}


class QuadraticSiteEnergy(SpinEnergy):
    """The energy ``sum_i A_i (n_i . s_i)^2 / 2 + b_i . s_i``; without n, the first term is ``sum_ic A_ic s_ic^2 / 2``.

    Attributes
    ----------
    A : array, shape () or that of the sites; (3,) or ``(*sites, 3)`` without n; or None
    b, n : array, shape (3,) or ``(*sites, 3)``, or None
    """

    A: jax.Array | None
    b: jax.Array | None
    n: jax.Array | None

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        linear = jnp.zeros(()) if self.b is None else sum_of_dots(split_vectors(self.b), spins.site_spins)
        return linear + (
            0.0 if self.A is None else 0.5 * sum_of_dots(self._quadratic_gradient(spins.site_spins), spins.site_spins)
        )

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        if self.A is None:
            assert self.b is not None
            a, b, c = (jnp.broadcast_to(component, self.sites) for component in split_vectors(self.b))
            return a, b, c
        quadratic_gradient = self._quadratic_gradient(spins.site_spins)
        return quadratic_gradient if self.b is None else add_vectors(quadratic_gradient, split_vectors(self.b))

    def _quadratic_gradient(self, spins: VectorComponents) -> VectorComponents:
        """Return ``A_i (n_i . s_i) n_i``."""
        assert self.A is not None
        if self.n is None:
            A = split_vectors(self.A)
            return A[0] * spins[0], A[1] * spins[1], A[2] * spins[2]
        n = split_vectors(self.n)
        return scale_vectors(self.A * dot_vectors(n, spins), n)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(np.arange(3 * math.prod(self.sites)).reshape(-1, 3), dim)

    def multiple(self, factor) -> Energy:
        A, b = (None if value is None else factor * value for value in (self.A, self.b))
        return QuadraticSiteEnergy(self.sites, A, b, self.n)


class SitePolynomial(SpinEnergy):
    """A polynomial in the components of each spin.

    Attributes
    ----------
    powers : tuple of triples of int
    coefficients : tuple of arrays, shape () or that of the sites
    frame : array, shape (3, 3) or ``(*sites, 3, 3)``, or None
        Vectors in rows, along which the components are taken.
    """

    powers: tuple[tuple[int, int, int], ...] = eqx.field(static=True)
    coefficients: tuple[jax.Array, ...]
    frame: jax.Array | None

    @property
    def degree(self) -> float:
        return float(max(map(sum, self.powers)))

    @property
    def is_quadratic(self) -> bool:
        return self.degree <= 2.0

    def _components_in_frame(self, spins: VectorComponents) -> VectorComponents:
        """Return the components of the spins along the vectors of the frame, each of the shape of the sites."""
        if self.frame is None:
            return spins
        a, b, c = (dot_vectors(split_vectors(self.frame[..., axis, :]), spins) for axis in range(3))
        return a, b, c

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        tables = self._power_tables(spins)
        total = jnp.zeros(())
        for powers, c in zip(self.powers, self.coefficients, strict=True):
            total = total + c * _evaluate_monomial(tables, powers, self.sites)
        return jnp.sum(jnp.broadcast_to(total, self.sites))

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        tables = self._power_tables(spins)
        slopes = [jnp.zeros(self.sites) for _ in range(3)]
        for powers, c in zip(self.powers, self.coefficients, strict=True):
            for axis in range(3):
                if powers[axis]:
                    lowered_powers = tuple(p - int(a == axis) for a, p in enumerate(powers))
                    slopes[axis] = slopes[axis] + powers[axis] * c * _evaluate_monomial(
                        tables, lowered_powers, self.sites
                    )
        if self.frame is None:
            return slopes[0], slopes[1], slopes[2]
        x_gradients, y_gradients, z_gradients = (
            scale_vectors(slopes[axis], split_vectors(self.frame[..., axis, :])) for axis in range(3)
        )
        return add_vectors(add_vectors(x_gradients, y_gradients), z_gradients)

    def _power_tables(self, spins: PeriodicSpins) -> list[list[jax.Array]]:
        """Return a list of the powers 1, 2, … of the spins for each of their components in the frame."""
        tables = []
        for axis, component in enumerate(self._components_in_frame(spins.site_spins)):
            table = [component]
            for _ in range(1, max(powers[axis] for powers in self.powers)):
                table.append(table[-1] * component)
            tables.append(table)
        return tables

    def multiple(self, factor) -> Energy:
        return SitePolynomial(self.sites, self.powers, tuple(factor * c for c in self.coefficients), self.frame)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(np.arange(3 * math.prod(self.sites)).reshape(-1, 3), dim)


def _evaluate_monomial(tables: list[list[jax.Array]], powers, sites: tuple[int, ...]) -> jax.Array:
    """Return the product of powers of the components on each site, from tables of the powers 1, 2, …."""
    factors = [table[p - 1] for table, p in zip(tables, powers, strict=True) if p]
    return math.prod(factors[1:], start=factors[0]) if factors else jnp.ones(sites)
